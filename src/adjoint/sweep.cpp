#include "pulmo/adjoint/sweep.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

namespace pulmo {

namespace {

/// Shares of a vector's norm below this are rounding.
constexpr PetscReal rounding = 1e-9;

/// A linear system counts as solved if no more than so many times its tolerance is left, or this share in any case: a
/// method without iterations, or one that looks at a preconditioned residual, may say so of others.
constexpr PetscReal loosest = 100, least = 1e-8;

} // namespace

std::string Sweep::obstacle(const Scene &scene, const Model &model)
{
  const Composition &composition = model.composition();
  if (!model.own_integration()) return "needs pulmo's own integration: leave -petscfe_type out";
  if (const std::string of_memory = MemorySweep::obstacle(composition); !of_memory.empty()) return of_memory;
  if (scene.facts().flow_past_limit_points)
    return "knows no change from prescribed pressure to prescribed flow: leave -ventilator_on_limit_point out";
  if (!scene.facts().ventilator) return "is about the numbers of a breath: it needs -ventilator";
  return "";
}

PetscErrorCode Sweep::create(VecHandle &local) const
{
  PetscFunctionBeginUser;
  PetscCall(DMCreateLocalVector(model_.dm(), local.out()));
  PetscCall(VecZeroEntries(local));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::setup(const std::vector<Functional> &functionals)
{
  PetscInt fields;
  std::vector<Mesh::Region> regions;

  PetscFunctionBeginUser;
  if (model_.composition().memory_acts()) memory_ = std::make_unique<MemorySweep>(model_);
  PetscCall(DMGetNumFields(model_.dm(), &fields));
  gas_ = fields > pressure;
  storages_ = scalars_.storages();
  acting_ = scalars_.of_effects() ? model_.airway().acting() : std::vector<std::size_t>{0};
  columns_.resize(acting_.size());
  fluxes_.resize(scalars_.of_effects() ? acting_.size() : 0); // without these no equation sees a flux
  for (VecHandle *v : {&x_, &rate_, &past_, &work_, &other_, &volume_.z}) PetscCall(create(*v));
  for (VecHandle &column : columns_) PetscCall(create(column));
  for (VecHandle *v : {&right_, &held_, &product_, &residual_, &volume_.right})
    PetscCall(DMCreateGlobalVector(model_.dm(), v->out()));
  for (Border &border : fluxes_) {
    PetscCall(create(border.z));
    PetscCall(VecDuplicate(right_, border.right.out()));
  }
  count_ = functionals.size();
  parts_.assign(count_, {});
  PetscCall(scene_.mesh().regions(regions));
  for (std::size_t k = 0; k < count_; ++k)
    for (const Mesh::Region &region : regions)
      if (functionals[k].part && functionals[k].part->region == region.name) parts_[k] = region.cells;
  volumes_.assign(trajectory_.stages().size(), 0);
  flows_ = volumes_;
  for (std::size_t i = 0; i < volumes_.size(); ++i) {
    const PetscInt row = trajectory_.stages()[i].row;
    if (row < 0) continue;
    const SignalRow &r = simulation_.rows()[static_cast<std::size_t>(row)];
    volumes_[i] = r.volume * units::mm3_per_ml;
    flows_[i] = (r.flow + r.stored_flow) * units::mm3_per_ml;
  }
  for (std::size_t i = 0; i < volumes_.size(); ++i) { // of a half step no row tells
    if (trajectory_.stages()[i].row >= 0) continue;
    Measures measures;
    PetscCall(trajectory_.state(static_cast<PetscInt>(i), x_));
    PetscCall(model_.measure(x_, measures));
    volumes_[i] = measures.volume_change;
    flows_[i] = gas_rate(trajectory_.stages()[i], static_cast<PetscInt>(i));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

Sweep::Wanted &Sweep::wanted(Pending &pending, PetscInt stage, std::size_t functional) const
{
  std::vector<Wanted> &all = pending[stage];
  if (all.empty()) {
    all.resize(count_);
    for (Wanted &one : all) one.scalars.resize(storages_.size(), 0);
  }
  return all[functional];
}

void Sweep::want_ventilator_pressure(PetscInt stage, PetscReal derivative, Wanted &wanted) const
{
  const auto &tube = scene_.facts().tube;
  wanted.scalars[0] += derivative;
  if (!tube) return;
  const PetscReal by_flow = derivative * tube->slope(flow(stage));
  wanted.drop += derivative;
  wanted.flow += by_flow;
  wanted.stored += by_flow;
}

PetscErrorCode Sweep::recall(const StageRecord &record, PetscInt number)
{
  PetscFunctionBeginUser;
  PetscCall(trajectory_.state(number, x_));
  PetscCall(VecAXPBY(rate_, record.stage.slope, 0, x_));
  for (int i = 0; i < 2; ++i) {
    if (record.past[i] < 0) continue;
    PetscCall(trajectory_.state(record.past[i], past_));
    PetscCall(VecAXPY(rate_, record.weight[i], past_));
  }
  if (memory_) {
    MemorySweep::Values last, earlier;
    PetscCall(trajectory_.remembered(record.past[0], last));
    if (record.past[1] >= 0) PetscCall(trajectory_.remembered(record.past[1], earlier));
    model_.memory()->show(last, earlier);
  }
  model_.set_load(record.load);
  model_.airway().hold(record.airway.mode != Airway::Mode::free);
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::to_global(Vec local, Vec global) const
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(global));
  PetscCall(DMLocalToGlobal(model_.dm(), local, ADD_VALUES, global));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::to_local(Vec global, Vec local) const
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(local)); // what is prescribed has no equation
  PetscCall(DMGlobalToLocal(model_.dm(), global, INSERT_VALUES, local));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::dot(Vec a, Vec b, PetscReal &sum) const
{
  PetscFunctionBeginUser;
  PetscCall(VecDot(a, b, &sum));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &sum, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)model_.dm())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::solve(Vec right, Vec solution, std::string &failure)
{
  KSPConvergedReason reason;
  PetscInt iterations;

  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(solution)); // with -ksp_initial_guess_nonzero it is one
  PetscCall(KSPSolve(ksp_, right, solution));
  PetscCall(KSPGetConvergedReason(ksp_, &reason));
  PetscCall(KSPGetIterationNumber(ksp_, &iterations));
  ++solves_;
  krylov_ += iterations;
  PetscReal left, size;
  PetscCall(MatMult(simulation_.matrix(), solution, residual_));
  PetscCall(VecAXPY(residual_, -1, right));
  PetscCall(VecNorm(residual_, NORM_2, &left));
  PetscCall(VecNorm(right, NORM_2, &size));
  if (reason < 0 || !(left <= std::max(loosest * tolerance_, least) * size)) {
    std::ostringstream text;
    text.precision(2);
    text << "the solver leaves " << left / size << " of a linear system of the sweep (" << KSPConvergedReasons[reason]
         << "); -options_file petsc_options/solvers/direct.opts solves whatever the run solved";
    failure = text.str();
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::compare_rates(const StageRecord &record)
{
  const PetscReal slope = record.stage.slope;
  VecHandle z, by_rate, by_gas;
  PetscRandom random;
  PetscReal left, size;

  PetscFunctionBeginUser;
  PetscCall(create(z)); // multipliers of a stage may have nothing that a rate acts on
  PetscCall(PetscRandomCreate(PETSC_COMM_SELF, &random));
  PetscCall(VecSetRandom(z, random));
  PetscCall(PetscRandomDestroy(&random));
  PetscCall(create(by_rate));
  PetscCall(create(by_gas));
  PetscCall(model_.add_transposed_product(record.time, x_, rate_, 0, z, by_gas));
  PetscCall(VecScale(by_gas, -1));
  PetscCall(model_.add_transposed_product(record.time, x_, rate_, slope, z, by_gas));
  PetscCall(VecNorm(by_gas, NORM_2, &size));
  if (record.stage.multistep)
    PetscCall(VecCopy(x_, past_));
  else
    PetscCall(trajectory_.state(record.past[0], past_));
  if (gas_) PetscCall(model_.add_volume_gradient(past_, z, slope * model_.row_scale(pressure), by_rate));
  PetscCall(VecAXPY(by_gas, -1, by_rate));
  PetscCall(VecNorm(by_gas, NORM_2, &left));
  PetscReal norms[2] = {left, size};
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, norms, 2, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)model_.dm())));
  other_rates_ = norms[0] > rounding * norms[1];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::look_back(const StageRecord &record, Vec z, std::size_t functional, Pending &pending)
{
  const PetscReal slope = record.stage.slope, scale = gas_ ? model_.row_scale(pressure) : 0;

  PetscFunctionBeginUser;
  if (!other_rates_) PetscCall(compare_rates(record));
  if (*other_rates_) { // (dR/dx_t)^T z, of a multistep rate without the gas
    PetscCall(VecZeroEntries(other_));
    PetscCall(model_.add_transposed_product(record.time, x_, rate_, 0, z, other_));
    PetscCall(VecScale(other_, -1));
    PetscCall(model_.add_transposed_product(record.time, x_, rate_, slope, z, other_));
    PetscCall(VecScale(other_, 1 / slope));
    if (gas_ && record.stage.multistep) PetscCall(model_.add_volume_gradient(x_, z, -scale, other_));
  }
  for (int i = 0; i < 2; ++i) {
    if (record.past[i] < 0) continue;
    Wanted &before = wanted(pending, record.past[i], functional);
    if (!before.state) PetscCall(create(before.state));
    if (*other_rates_) PetscCall(VecAXPY(before.state, record.weight[i], other_));
    if (!gas_ || (*other_rates_ && !record.stage.multistep)) continue;
    PetscCall(trajectory_.state(record.past[i], past_));
    PetscCall(model_.add_volume_gradient(past_, z, record.weight[i] * scale, before.state));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::want_by_memory(const StageRecord &record, std::vector<Wanted> &want, Pending &pending)
{
  std::vector<MemorySweep::OfState> numbers(count_);
  std::vector<VecHandle> by_rate(count_);

  PetscFunctionBeginUser;
  for (std::size_t k = 0; k < count_; ++k) {
    if (want[k].memory.empty()) continue;
    if (!want[k].state) PetscCall(create(want[k].state));
    PetscCall(create(by_rate[k]));
    numbers[k] = {want[k].weights(), want[k].state, by_rate[k], 0};
  }
  PetscCall(memory_->by_state(record.time, x_, rate_, numbers));
  for (std::size_t k = 0; k < count_; ++k) {
    if (want[k].memory.empty()) continue;
    want[k].scalars[0] += numbers[k].by_pressure;
    for (int i = 0; i < 2; ++i) {
      if (record.past[i] < 0) continue;
      Wanted &before = wanted(pending, record.past[i], k);
      if (!before.state) PetscCall(create(before.state));
      PetscCall(VecAXPY(before.state, record.weight[i], by_rate[k]));
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::look_back_at_memory(const Solved &stage, Pending &pending)
{
  const StageRecord &record = stage.record;
  std::vector<MemorySweep::OfPast> numbers;

  PetscFunctionBeginUser;
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  for (std::size_t k = 0; k < count_; ++k) {
    MemorySweep::OfPast number{stage.by_memory[k], stage.adjoint[k], nullptr, nullptr};
    for (int i = 0; i < 2; ++i) {
      if (record.past[i] < 0) continue;
      MemorySweep::Values &before = wanted(pending, record.past[i], k).memory;
      before.resize(model_.memory()->size(), 0);
      (i == 0 ? number.by_last : number.by_earlier) = &before;
    }
    numbers.push_back(number);
  }
  PetscCall(memory_->by_past(record.time, x_, rate_, numbers));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::weighted_residual(const Solved &stage, bool facets, std::vector<std::vector<PetscReal>> &sums)
{
  const StageRecord &record = stage.record;

  PetscFunctionBeginUser;
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  PetscCall(model_.weighted_residual(facets, record.time, stage.state, stage.rate, stage.adjoint, sums));
  if (memory_)
    PetscCall(memory_->add_weighted(facets, false, record.time, stage.state, stage.rate, stage.by_memory, sums));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::weighted_start(bool facets, std::vector<std::vector<PetscReal>> &sums)
{
  std::vector<const MemorySweep::Values *> weights;

  PetscFunctionBeginUser;
  sums.assign(count_, std::vector<PetscReal>(static_cast<std::size_t>(model_.assembly().cells()), 0));
  PetscCall(model_.set_step(1, 0)); // as it is when the model is built
  for (const Wanted &w : start_) weights.push_back(w.weights());
  PetscCall(memory_->add_weighted(facets, true, 0, nullptr, nullptr, weights, sums));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::make_shifts(const std::vector<Functional> &functionals, PetscInt stage, const Pending &pending)
{
  const auto found = pending.find(stage);

  PetscFunctionBeginUser;
  for (Shift *shift : shifts_) {
    if (shift->stage != stage) continue;
    shift->change.assign(count_, 0);
    shift->volume.assign(count_, 0);
    const auto record = [&](PetscInt n) -> const StageRecord & {
      return trajectory_.stages()[static_cast<std::size_t>(n)];
    };
    const auto row = [&](PetscInt n) -> const SignalRow & {
      return simulation_.rows()[static_cast<std::size_t>(record(n).row)];
    };
    const std::vector<PetscReal> from = values_of(record(shift->from)), to = values_of(record(shift->to));
    const PetscReal flow = units::mm3_per_ml * (row(shift->to).flow - row(shift->from).flow),
                    stored = units::mm3_per_ml * (row(shift->to).stored_flow - row(shift->from).stored_flow);
    MemorySweep::Values before, after;
    PetscCall(trajectory_.state(shift->from, past_));
    PetscCall(trajectory_.state(shift->to, other_));
    PetscCall(VecAXPY(other_, -1, past_));
    // to first order as all else is: what a prescribed flow makes of volume and state then cancels
    const auto volume_change = [&](const std::vector<PetscInt> *part, PetscReal &sum) -> PetscErrorCode {
      PetscFunctionBeginUser;
      PetscCall(VecZeroEntries(work_));
      PetscCall(model_.add_volume_gradient(past_, nullptr, 1, work_, part));
      PetscCall(dot(work_, other_, sum));
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    PetscReal whole = 0;
    PetscCall(volume_change(nullptr, whole));
    for (std::size_t k = 0; k < count_; ++k) {
      PetscReal looked_at = whole;
      if (functionals[k].part) PetscCall(volume_change(&parts_[k], looked_at));
      shift->volume[k] = looked_at / units::mm3_per_ml;
    }
    if (found == pending.end()) continue;
    if (memory_) {
      PetscCall(trajectory_.remembered(shift->from, before));
      PetscCall(trajectory_.remembered(shift->to, after));
    }
    for (std::size_t k = 0; k < count_; ++k) {
      const Wanted &w = found->second[k];
      PetscReal by_state = 0, by_memory = 0, by_scalars = 0;
      if (w.state) PetscCall(dot(w.state, other_, by_state));
      for (std::size_t i = 0; i < w.memory.size(); ++i) by_memory += w.memory[i] * (after[i] - before[i]);
      if (memory_)
        PetscCallMPI(
            MPI_Allreduce(MPI_IN_PLACE, &by_memory, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)model_.dm())));
      for (std::size_t i = 0; i < w.scalars.size(); ++i) by_scalars += w.scalars[i] * (to[i] - from[i]);
      shift->change[k] = by_state + by_memory + by_scalars + w.volume * whole + w.flow * flow + w.stored * stored;
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Adds what the numbers want of the row that a stage ends.
void Sweep::want_row(const std::vector<Functional> &functionals, PetscInt stage, Pending &pending) const
{
  const PetscInt number = trajectory_.stages()[static_cast<std::size_t>(stage)].row;
  if (number < 0) return;
  const auto row = static_cast<std::size_t>(number);
  for (std::size_t k = 0; k < functionals.size(); ++k) {
    const Functional &f = functionals[k];
    if (f.by_volume[row] == 0 && f.by_pressure[row] == 0 && f.by_flow[row] == 0) continue;
    Wanted &w = wanted(pending, stage, k);
    (f.part ? w.part : w.volume) += f.by_volume[row] / units::mm3_per_ml;
    w.flow += f.by_flow[row] / units::mm3_per_ml;
    want_ventilator_pressure(stage, f.by_pressure[row] / units::kPa_per_cmH2O, w);
  }
}

/// Fills the matrix with the transposed Jacobian of a stage, no row closed.
PetscErrorCode Sweep::assemble(const StageRecord &record, PetscInt number)
{
  const Mat matrix = simulation_.matrix();
  SNES snes;
  PetscInt lag;
  PetscBool once;

  PetscFunctionBeginUser;
  PetscCall(recall(record, number));
  PetscCall(make_columns(record));
  PetscCall(model_.transposed_jacobian(record.time, x_, rate_, record.stage.slope, matrix));
  PetscCall(KSPSetOperators(ksp_, matrix, matrix));
  // a preconditioner is kept as long as that of a Jacobian is, for stages of one kind, unless it alone has to solve
  PetscCall(PetscObjectTypeCompare((PetscObject)ksp_, KSPPREONLY, &once));
  PetscCall(TSGetSNES(simulation_.ts(), &snes));
  PetscCall(SNESGetLagPreconditioner(snes, &lag));
  const bool same_kind = !once && kept_.slope == record.stage.slope && kept_.mode == record.airway.mode;
  kept_ = {same_kind && kept_.age < lag ? kept_.age + 1 : 1, record.stage.slope, record.airway.mode};
  PetscCall(KSPSetReusePreconditioner(ksp_, kept_.age > 1 ? PETSC_TRUE : PETSC_FALSE));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Minus what number @p k wants of a stage, as a right-hand side. What the flow into a held airway wants stands at its
/// nodes, and acts on the other rows, which are not closed yet.
PetscErrorCode Sweep::right_side(const StageRecord &record, std::size_t k, Wanted &w, Pending &pending, Vec right)
{
  const bool free = record.airway.mode == Airway::Mode::free;

  PetscFunctionBeginUser;
  if (!gas_) { // the flow is the rate of the volume
    w.volume += w.flow * record.stage.slope;
    want_past_volumes(record, w.flow, k, pending);
  }
  PetscCall(VecZeroEntries(work_));
  if (w.state) PetscCall(VecCopy(w.state, work_));
  if (w.volume != 0) PetscCall(model_.add_volume_gradient(x_, nullptr, w.volume, work_));
  if (w.part != 0) PetscCall(model_.add_volume_gradient(x_, nullptr, w.part, work_, &parts_[k]));
  if (free) PetscCall(model_.airway().add_mean_gradient(w.scalars[0], work_));
  PetscCall(to_global(work_, right));
  if (gas_ && !free && w.flow != 0) {
    PetscCall(VecZeroEntries(held_));
    PetscCall(model_.airway().set(held_, w.flow / model_.row_scale(pressure)));
    PetscCall(MatMult(simulation_.matrix(), held_, product_));
    PetscCall(VecAXPY(right, 1, product_));
  }
  PetscCall(VecScale(right, -1));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Solves for z of number @p k, and adds what that wants of earlier stages.
PetscErrorCode Sweep::solve_stage(const StageRecord &record, std::size_t k, const Wanted &w, Vec right,
                                  Pending &pending, Solved &result, std::string &failure)
{
  const Vec z = result.adjoint[k];
  const Airway::Condition &airway = record.airway;
  const bool free = airway.mode == Airway::Mode::free, held = gas_ && !free;
  std::vector<PetscReal> by_columns, at_nodes, by_scalar = w.scalars;

  PetscFunctionBeginUser;
  if (!free) PetscCall(model_.airway().set(right, 0));
  PetscCall(solve(right, product_, failure));
  PetscCall(to_local(product_, z));
  if (held) PetscCall(model_.airway().fill(z, w.flow / model_.row_scale(pressure)));
  PetscCall(along_columns(z, by_columns));
  if (held && w.state) {
    PetscCall(model_.airway().sum(w.state, at_nodes));
    for (std::size_t j = 0; j < by_scalar.size(); ++j) by_scalar[j] += at_nodes[j];
  }
  result.by_volume[k] = w.volume;
  result.by_flow[k] = gas_ ? 0 : w.flow;
  result.by_drop[k] = w.drop;
  for (std::size_t j = 0; j < storages_.size(); ++j) {
    result.by_rate[k][j] = w.stored * storages_[j];
    by_scalar[j] += record.stage.slope * result.by_rate[k][j];
  }
  switch (airway.mode) {
  case Airway::Mode::free:
    result.by_mean_pressure[k] = w.scalars[0];
    result.by_flow[k] = w.flow + by_columns[0];
    result.by_target[k] = result.by_flow[k] * record.stage.slope;
    break;
  case Airway::Mode::solved:
    for (std::size_t j = 0; j < by_scalar.size(); ++j) by_scalar[j] += by_columns[j];
    PetscCall(add_scalars(record, k, by_scalar, result, failure));
    break;
  case Airway::Mode::held:
    result.by_target[k] = by_scalar[0] + by_columns[0];
  }
  look_back_at_scalars(record, k, result, pending);
  PetscCall(look_back(record, z, k, pending));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::run(const std::vector<Functional> &functionals, PetscReal tolerance, const Visit &visit,
                          std::string &failure)
{
  const auto &stages = trajectory_.stages();
  SNES snes;
  PetscReal relative, absolute;
  Pending pending;
  std::vector<VecHandle> adjoint(functionals.size()), rights(functionals.size());

  PetscFunctionBeginUser;
  tolerance_ = tolerance;
  PetscCall(setup(functionals));
  for (VecHandle &z : adjoint) PetscCall(create(z));
  for (VecHandle &right : rights) PetscCall(VecDuplicate(right_, right.out()));
  PetscCall(TSGetSNES(simulation_.ts(), &snes));
  PetscCall(SNESGetKSP(snes, &ksp_));
  PetscCall(KSPGetTolerances(ksp_, &relative, &absolute, nullptr, nullptr));
  // right-hand sides are in units of the numbers: none is small by itself
  PetscCall(KSPSetTolerances(ksp_, tolerance, 0, PETSC_DEFAULT, PETSC_DEFAULT));
  for (auto n = static_cast<PetscInt>(stages.size()) - 1; n > 0 && failure.empty() && !stopped_; --n) {
    if (stop_request_) PetscCall(stop_request_->asked(stopped_));
    const StageRecord &record = stages[static_cast<std::size_t>(n)];
    PetscCall(make_shifts(functionals, n, pending));
    want_row(functionals, n, pending);
    const auto found = pending.find(n);
    if (found == pending.end()) continue; // nothing depends on it
    std::vector<Wanted> want = std::move(found->second);
    pending.erase(found);
    PetscCall(assemble(record, n));
    if (memory_) PetscCall(want_by_memory(record, want, pending));
    for (std::size_t k = 0; k < count_; ++k) PetscCall(right_side(record, k, want[k], pending, rights[k]));
    const bool solved = record.airway.mode == Airway::Mode::solved;
    if (solved) {
      PetscCall(recall_scalars(record, n));
      PetscCall(begin_borders());
    }
    PetscCall(model_.airway().close_rows(simulation_.matrix(), false));
    if (solved) PetscCall(solve_borders(failure));
    const std::vector<PetscReal> none(count_, 0);
    const std::vector<std::vector<PetscReal>> of_scalars(count_, std::vector<PetscReal>(storages_.size(), 0));
    Solved result{n, record, x_, rate_, {}, none, none, none, none, none, of_scalars, of_scalars, {}, {}};
    for (std::size_t k = 0; k < count_; ++k) {
      result.adjoint.push_back(adjoint[k]);
      result.by_memory.push_back(want[k].weights());
      result.of_part.push_back({functionals[k].part ? &parts_[k] : nullptr, want[k].part});
    }
    for (std::size_t k = 0; k < count_; ++k) {
      if (want[k].nothing()) // no later row of this number
        PetscCall(VecZeroEntries(adjoint[k]));
      else
        PetscCall(solve_stage(record, k, want[k], rights[k], pending, result, failure));
    }
    if (memory_ && failure.empty()) PetscCall(look_back_at_memory(result, pending));
    if (visit && failure.empty()) PetscCall(visit(result));
  }
  PetscCall(make_shifts(functionals, 0, pending));
  start_ = std::move(pending[0]);
  PetscCall(KSPSetTolerances(ksp_, relative, absolute, PETSC_DEFAULT, PETSC_DEFAULT));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
