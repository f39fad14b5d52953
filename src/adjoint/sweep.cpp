#include "pulmo/adjoint/sweep.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"

#include <cmath>

namespace pulmo {

namespace {

/// Shares of a vector's norm below this are rounding.
constexpr PetscReal rounding = 1e-9;

} // namespace

std::string Sweep::obstacle(const Scene &scene, const Model &model)
{
  const Composition &composition = model.composition();
  if (!model.own_integration()) return "needs pulmo's own integration: leave -petscfe_type out";
  if (!composition.memories().empty())
    return "does not know yet how what -" + composition.memories().front().effect + " remembers changes";
  if (composition.n_scalars() > 0)
    return "does not know yet the unknowns of -" + composition.scalar_groups().front().effect;
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

PetscErrorCode Sweep::setup()
{
  PetscInt fields;

  PetscFunctionBeginUser;
  PetscCall(DMGetNumFields(model_.dm(), &fields));
  gas_ = fields > pressure;
  for (VecHandle *v : {&x_, &rate_, &past_, &column_, &work_, &other_}) PetscCall(create(*v));
  for (VecHandle *v : {&right_, &held_, &product_}) PetscCall(DMCreateGlobalVector(model_.dm(), v->out()));
  volumes_.assign(trajectory_.stages().size(), 0);
  flows_ = volumes_;
  for (std::size_t i = 0; i < volumes_.size(); ++i) {
    const PetscInt row = trajectory_.stages()[i].row;
    if (row < 0) continue;
    const SignalRow &r = simulation_.rows()[static_cast<std::size_t>(row)];
    volumes_[i] = r.volume * units::mm3_per_ml;
    flows_[i] = r.flow * units::mm3_per_ml;
  }
  for (std::size_t i = 0; i < volumes_.size(); ++i) { // of a half step no row tells
    if (trajectory_.stages()[i].row >= 0) continue;
    Measures measures;
    PetscCall(trajectory_.state(static_cast<PetscInt>(i), x_));
    PetscCall(model_.measure(x_, measures));
    volumes_[i] = measures.volume_change;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

Sweep::Wanted &Sweep::wanted(Pending &pending, PetscInt stage, std::size_t functional) const
{
  return pending[stage][functional];
}

void Sweep::want_ventilator_pressure(PetscInt stage, PetscReal derivative, Wanted &wanted) const
{
  const auto &tube = scene_.facts().tube;
  wanted.pressure += derivative;
  if (tube) wanted.flow += derivative * tube->slope(flows_[static_cast<std::size_t>(stage)]);
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
  model_.set_load(record.load);
  model_.airway().hold(record.airway.mode != Airway::Mode::free);
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The residual is linear in both, so that a difference over any step is exact.
PetscErrorCode Sweep::make_column(const StageRecord &record)
{
  const bool free = record.airway.mode == Airway::Mode::free;
  const PetscReal L = model_.composition().mesh().length(),
                  change = free ? record.stage.slope * L * L * L : model_.modulus();

  PetscFunctionBeginUser;
  const auto residual_at = [&](PetscReal by, Vec F) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(VecCopy(x_, past_));
    PetscCall(VecCopy(rate_, other_));
    if (!free && gas_) {
      PetscCall(model_.airway().fill(past_, record.airway.pressure + by));
      PetscCall(VecZeroEntries(work_));
      PetscCall(model_.airway().fill(work_, by * record.stage.slope));
      PetscCall(VecAXPY(other_, 1, work_));
    }
    PetscCall(
        model_.set_step(record.stage, record.airway.pressure + (free ? 0 : by), record.airway.flow + (free ? by : 0)));
    PetscCall(model_.residual(record.time, past_, other_, F));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(residual_at(change, column_));
  PetscCall(residual_at(-change, work_));
  PetscCall(VecAXPBY(column_, -1 / (2 * change), 1 / (2 * change), work_));
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
  SNES snes;
  KSP ksp;
  KSPConvergedReason reason;
  PetscInt iterations;

  PetscFunctionBeginUser;
  PetscCall(TSGetSNES(simulation_.ts(), &snes));
  PetscCall(SNESGetKSP(snes, &ksp));
  PetscCall(VecZeroEntries(solution)); // with -ksp_initial_guess_nonzero it is one
  PetscCall(KSPSolve(ksp, right, solution));
  PetscCall(KSPGetConvergedReason(ksp, &reason));
  PetscCall(KSPGetIterationNumber(ksp, &iterations));
  ++solves_;
  krylov_ += iterations;
  if (reason < 0)
    failure = std::string("a linear system of the sweep was not solved (") + KSPConvergedReasons[reason] + ")";
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
    if (record.past[i] <= 0) continue; // at rest at the start
    Wanted &before = wanted(pending, record.past[i], functional);
    if (!before.state) PetscCall(create(before.state));
    if (*other_rates_) PetscCall(VecAXPY(before.state, record.weight[i], other_));
    if (!gas_ || (*other_rates_ && !record.stage.multistep)) continue;
    PetscCall(trajectory_.state(record.past[i], past_));
    PetscCall(model_.add_volume_gradient(past_, z, record.weight[i] * scale, before.state));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::run(const std::vector<Functional> &functionals, PetscReal tolerance, const Visit &visit,
                          std::string &failure)
{
  const std::size_t count = functionals.size();
  const auto &stages = trajectory_.stages();
  const auto &tube = scene_.facts().tube;
  const PetscReal L = model_.composition().mesh().length(), h3 = L * L * L;
  SNES snes;
  KSP ksp;
  PetscReal given, kept_slope = 0;
  PetscInt lag, age = 0;
  Airway::Mode kept_mode = Airway::Mode::held;
  Pending pending;
  std::vector<VecHandle> adjoint(count);
  VecHandle solution, border, local_border;
  Mat matrix = simulation_.matrix();

  PetscFunctionBeginUser;
  PetscCall(setup());
  for (VecHandle &z : adjoint) PetscCall(create(z));
  PetscCall(create(local_border));
  PetscCall(VecDuplicate(right_, solution.out()));
  PetscCall(VecDuplicate(right_, border.out()));
  PetscCall(TSGetSNES(simulation_.ts(), &snes));
  PetscCall(SNESGetKSP(snes, &ksp));
  PetscCall(SNESGetLagPreconditioner(snes, &lag));
  PetscCall(KSPGetTolerances(ksp, &given, nullptr, nullptr, nullptr));
  PetscCall(KSPSetTolerances(ksp, tolerance, PETSC_DEFAULT, PETSC_DEFAULT, PETSC_DEFAULT));
  for (std::size_t n = stages.size(); n-- > 1;) {
    for (std::size_t k = 0; k < count; ++k) {
      if (stages[n].row < 0) continue;
      const auto row = static_cast<std::size_t>(stages[n].row);
      const Functional &f = functionals[k];
      if (f.by_volume[row] == 0 && f.by_pressure[row] == 0 && f.by_flow[row] == 0) continue;
      pending[static_cast<PetscInt>(n)].resize(count);
      pending[static_cast<PetscInt>(n)][k].volume += f.by_volume[row] / units::mm3_per_ml;
      pending[static_cast<PetscInt>(n)][k].flow += f.by_flow[row] / units::mm3_per_ml;
      want_ventilator_pressure(static_cast<PetscInt>(n), f.by_pressure[row] / units::kPa_per_cmH2O,
                               pending[static_cast<PetscInt>(n)][k]);
    }
    const auto found = pending.find(static_cast<PetscInt>(n));
    if (found == pending.end()) continue; // nothing depends on it
    std::vector<Wanted> want = std::move(found->second);
    pending.erase(found);
    const StageRecord &record = stages[n];
    const Airway::Condition &airway = record.airway;
    const bool held = gas_ && airway.mode != Airway::Mode::free, solved = airway.mode == Airway::Mode::solved,
               flows = airway.control == Control::flow;
    const PetscReal slope = record.stage.slope;
    for (const PetscInt past : record.past)
      if (past >= 0) pending[past].resize(count);
    pending[record.phase_start].resize(count);

    PetscCall(recall(record, static_cast<PetscInt>(n)));
    PetscCall(make_column(record));
    PetscCall(model_.transposed_jacobian(record.time, x_, rate_, slope, matrix));
    PetscCall(KSPSetOperators(ksp, matrix, matrix));
    // a preconditioner is kept as long as that of a Jacobian is, for stages of one kind
    const bool same_kind = kept_slope == slope && kept_mode == airway.mode;
    age = same_kind && age < lag ? age + 1 : 1;
    kept_slope = slope;
    kept_mode = airway.mode;
    PetscCall(KSPSetReusePreconditioner(ksp, age > 1 ? PETSC_TRUE : PETSC_FALSE));
    // what the flow into a held airway wants stands at its nodes, and acts on the other rows before these are closed
    std::vector<VecHandle> rights(count);
    for (std::size_t k = 0; k < count; ++k) {
      Wanted &w = want[k];
      PetscCall(VecDuplicate(right_, rights[k].out()));
      if (!gas_) { // the flow is the rate of the volume
        w.volume += w.flow * slope;
        for (int i = 0; i < 2; ++i)
          if (record.past[i] >= 0) wanted(pending, record.past[i], k).volume += w.flow * record.weight[i];
      }
      PetscCall(VecZeroEntries(work_));
      if (w.state) PetscCall(VecCopy(w.state, work_));
      if (w.volume != 0) PetscCall(model_.add_volume_gradient(x_, nullptr, w.volume, work_));
      if (airway.mode == Airway::Mode::free) PetscCall(model_.airway().add_mean_gradient(w.pressure, work_));
      PetscCall(to_global(work_, rights[k]));
      if (held && w.flow != 0) {
        PetscCall(VecZeroEntries(held_));
        PetscCall(model_.airway().set(held_, w.flow / model_.row_scale(pressure)));
        PetscCall(MatMult(matrix, held_, product_));
        PetscCall(VecAXPY(rights[k], 1, product_));
      }
      PetscCall(VecScale(rights[k], -1));
    }
    PetscCall(model_.airway().close_rows(matrix, false));
    const auto close = [&](Vec right) -> PetscErrorCode {
      PetscFunctionBeginUser;
      if (airway.mode != Airway::Mode::free) PetscCall(model_.airway().set(right, 0));
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    // c(P, V) = 0
    PetscReal by_P = 0, by_V = 0, by_target = 0, by_Q = 0, border_column = 0;
    if (solved) {
      if (flows) {
        by_V = 1 / h3;
        by_target = -1 / h3;
      } else {
        PetscReal Q = slope * volumes_[n];
        for (int i = 0; i < 2; ++i)
          if (record.past[i] >= 0) Q += record.weight[i] * volumes_[static_cast<std::size_t>(record.past[i])];
        by_P = 1 / model_.modulus();
        by_Q = tube ? tube->slope(Q) / model_.modulus() : 0;
        by_V = by_Q * slope;
        by_target = -1 / model_.modulus();
      }
      PetscCall(VecZeroEntries(work_));
      PetscCall(model_.add_volume_gradient(x_, nullptr, -by_V, work_));
      PetscCall(to_global(work_, right_));
      PetscCall(close(right_));
      PetscCall(solve(right_, border, failure));
      PetscCall(to_local(border, local_border));
      PetscCall(dot(local_border, column_, border_column));
    }
    Solved result{record, x_, rate_, {}, {}};
    for (std::size_t k = 0; k < count && failure.empty(); ++k) {
      Wanted &w = want[k];
      Vec z = adjoint[k];
      PetscReal by_column, at_nodes = 0, target;
      result.adjoint.push_back(z);
      result.by_target.push_back(0);
      if (w.nothing()) { // no later row of this number
        PetscCall(VecZeroEntries(z));
        continue;
      }
      PetscCall(close(rights[k]));
      PetscCall(solve(rights[k], solution, failure));
      PetscCall(to_local(solution, z));
      if (held) PetscCall(model_.airway().fill(z, w.flow / model_.row_scale(pressure)));
      PetscCall(dot(z, column_, by_column));
      if (held && w.state) PetscCall(model_.airway().sum(w.state, at_nodes));
      const PetscReal by_pressure = w.pressure + at_nodes + by_column;
      if (airway.mode == Airway::Mode::free) {
        const PetscReal by_flow = w.flow + by_column;
        target = by_flow * slope;
        for (int i = 0; i < 2; ++i)
          if (record.past[i] >= 0) wanted(pending, record.past[i], k).volume += by_flow * record.weight[i];
      } else if (solved) {
        const PetscReal multiplier = -by_pressure / (by_P + border_column);
        PetscCall(VecAXPY(z, multiplier, local_border));
        target = multiplier * by_target;
        for (int i = 0; i < 2; ++i)
          if (record.past[i] >= 0) wanted(pending, record.past[i], k).volume += multiplier * by_Q * record.weight[i];
      } else {
        target = by_pressure;
      }
      Wanted &start = wanted(pending, record.phase_start, k);
      if (flows)
        start.volume += target * airway.by_start;
      else
        want_ventilator_pressure(record.phase_start, target * airway.by_start, start);
      PetscCall(look_back(record, z, k, pending));
      result.by_target.back() = target;
    }
    if (!failure.empty()) break;
    if (visit) PetscCall(visit(result));
  }
  PetscCall(KSPSetTolerances(ksp, given, PETSC_DEFAULT, PETSC_DEFAULT, PETSC_DEFAULT));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
