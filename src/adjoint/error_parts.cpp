#include "pulmo/adjoint/error_parts.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A look at the displacement stands for so many stages at most, and for none whose size (sizes()) is so many times
/// larger or smaller, where that is more than the second share of the largest of its number, and what was found of the
/// tissue more than the third of the flow's part.
constexpr PetscInt stages_a_sample = 12;
constexpr PetscReal alike = 3, counts = 0.2, matters = 0.1;

/// Of a number that looks at no more stages than these, each is looked at.
constexpr std::size_t few_stages = 3;

using ByCell = std::vector<std::vector<PetscReal>>;

void add_to(PetscReal factor, const std::vector<PetscReal> &part, std::vector<PetscReal> &sum)
{
  for (std::size_t c = 0; c < part.size(); ++c) sum[c] += factor * part[c];
}

void add(PetscReal factor, const ByCell &parts, ByCell &sums)
{
  for (std::size_t k = 0; k < parts.size(); ++k) add_to(factor, parts[k], sums[k]);
}

/// Weights of values at times @p t in the derivative at t[at] of the polynomial through them.
std::vector<PetscReal> derivative_weights(const std::vector<PetscReal> &t, std::size_t at)
{
  std::vector<PetscReal> weights(t.size(), 0);
  for (std::size_t i = 0; i < t.size(); ++i) {
    if (i == at) continue;
    weights[at] += 1 / (t[at] - t[i]);
    PetscReal product = 1 / (t[i] - t[at]);
    for (std::size_t j = 0; j < t.size(); ++j)
      if (j != i && j != at) product *= (t[at] - t[j]) / (t[i] - t[j]);
    weights[i] = product;
  }
  return weights;
}

} // namespace

std::string ErrorParts::obstacle(const Scene &scene, const Model &model)
{
  const std::string sweep = Sweep::obstacle(scene, model);
  if (!sweep.empty()) return sweep;
  const Composition &composition = model.composition();
  if (!Enrichment::exists(composition.elements())) return "needs richer elements than the run's: give -elements P2-P1";
  if (scene.facts().pressure_damping) // an error of the cells' size that stays with richer elements
    return "does not see what -pressure_damping does to the numbers";
  if (!composition.memories().empty())
    return "does not know richer elements for what -" + composition.memories().front().effect + " remembers";
  return "";
}

std::vector<double> ErrorParts::kinks() const
{
  const auto &stages = trajectory_.stages();
  std::vector<double> times;
  for (const StageRecord &record : stages) {
    const double begin = stages[static_cast<std::size_t>(record.phase_start)].time,
                 ramp = scene_.facts().ventilator->phases()[static_cast<std::size_t>(record.phase)].ramp;
    if (ramp > 0 && (times.empty() || times.back() != begin + ramp)) times.push_back(begin + ramp);
  }
  return times;
}

void ErrorParts::find_looked_at(const std::vector<Functional> &functionals)
{
  const auto &stages = trajectory_.stages();
  looked_at_.assign(stages.size(), false);
  for (const Functional &f : functionals) {
    std::vector<std::size_t> wanted;
    for (std::size_t n = 1; n < stages.size(); ++n) {
      if (stages[n].row < 0) continue;
      const auto i = static_cast<std::size_t>(stages[n].row);
      if (f.by_volume[i] != 0 || f.by_pressure[i] != 0 || f.by_flow[i] != 0) wanted.push_back(n);
    }
    if (wanted.size() > few_stages) continue;
    for (const std::size_t n : wanted) looked_at_[n] = true;
  }
}

bool ErrorParts::samples(PetscInt stage, const std::vector<PetscReal> &size, const Found &found)
{
  bool differs = sample_.size.empty() || ++sample_.age >= stages_a_sample;
  for (std::size_t k = 0; k < size.size(); ++k) {
    largest_[k] = std::max(largest_[k], size[k]);
    if (differs || size[k] < counts * largest_[k] || found.tissue[k] < matters * found.flow[k]) continue;
    differs = size[k] > alike * sample_.size[k] || sample_.size[k] > alike * size[k];
  }
  return !gas_ || differs || looked_at_[static_cast<std::size_t>(stage)];
}

PetscErrorCode ErrorParts::setup(const std::vector<Functional> &functionals)
{
  const std::size_t count = functionals.size();
  const auto cells = static_cast<std::size_t>(model_.assembly().cells());
  PetscInt fields;

  PetscFunctionBeginUser;
  PetscCall(DMGetNumFields(model_.dm(), &fields));
  gas_ = fields > pressure;
  lacking_.assign(count, {});
  rough_.assign(count, 0);
  for (ByCell *part : {&solver_, &time_, &flow_part_, &tissue_part_, &in_space_})
    part->assign(count, std::vector<PetscReal>(cells, 0));
  PetscCall(DMCreateLocalVector(model_.dm(), state_.out()));
  if (gas_) PetscCall(flow_.emplace(pressure).setup(model_));
  PetscCall(tissue_.emplace(displacement).setup(model_));
  find_looked_at(functionals);
  largest_.assign(count, 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

ErrorParts::Changes ErrorParts::better_rate(PetscInt number, bool &rough) const
{
  const auto &stages = trajectory_.stages();
  const StageRecord &record = stages[static_cast<std::size_t>(number)];
  const Phase &phase = scene_.facts().ventilator->phases()[static_cast<std::size_t>(record.phase)];
  const PetscReal begin = stages[static_cast<std::size_t>(record.phase_start)].time, kink = begin + phase.ramp,
                  nothing = 1e-6 / record.stage.slope;
  const std::size_t wanted = simulation_.scheme().order() + 2;
  // stages from one kink to the next: of the phase, on one side of its ramp's end
  const auto window = [&](bool whole) {
    std::vector<PetscInt> list;
    for (PetscInt n = record.phase_start; n < static_cast<PetscInt>(stages.size()); ++n) {
      const StageRecord &r = stages[static_cast<std::size_t>(n)];
      if (n > record.phase_start && r.phase_start != record.phase_start) break;
      const bool ramp = record.time <= kink + nothing;
      if (whole || (ramp ? r.time <= kink + nothing : r.time >= kink - nothing)) list.push_back(n);
    }
    return list;
  };
  std::vector<PetscInt> list = window(false);
  rough = list.size() < wanted;
  if (rough) list = window(true);
  std::map<PetscInt, PetscReal> weights;
  if (list.size() >= 2) {
    const std::size_t n = std::min(wanted, list.size()),
                      at = static_cast<std::size_t>(std::find(list.begin(), list.end(), number) - list.begin()),
                      before = std::min(at, n - 2), first = std::min(at - before, list.size() - n);
    std::vector<PetscReal> t;
    for (std::size_t i = 0; i < n; ++i) t.push_back(stages[static_cast<std::size_t>(list[first + i])].time);
    const std::vector<PetscReal> better = derivative_weights(t, at - first);
    for (std::size_t i = 0; i < n; ++i) weights[list[first + i]] += better[i];
    weights[number] -= record.stage.slope;
    for (int i = 0; i < 2; ++i)
      if (record.past[i] >= 0) weights[record.past[i]] -= record.weight[i];
  }
  return {weights.begin(), weights.end()};
}

/// Without airflow: else the richer pressure has it.
PetscErrorCode ErrorParts::add_solver(const Sweep::Solved &stage)
{
  ByCell parts;

  PetscFunctionBeginUser;
  PetscCall(model_.weighted_residual(false, stage.record.time, stage.state, stage.rate, stage.adjoint, parts));
  add(1, parts, solver_);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::add_time(const Sweep &sweep, const Sweep::Solved &stage)
{
  bool rough;
  const auto changes = better_rate(stage.number, rough);
  PetscReal flow = 0;
  std::vector<PetscReal> before, after, rates(1 + model_.composition().n_scalars(), 0); // rates: of scalars
  ByCell parts;

  PetscFunctionBeginUser;
  if (rough) PetscCall(total(time_, before));
  for (const auto &[number, weight] : changes) {
    flow += weight * sweep.volume(number);
    for (std::size_t j = 0; j < sweep.scalars(number).size(); ++j) rates[j] += weight * sweep.scalars(number)[j];
    if (!gas_) continue;
    PetscCall(trajectory_.state(number, state_));
    PetscCall(model_.weighted_volume(state_, stage.adjoint, parts));
    add(weight * model_.row_scale(pressure), parts, time_);
  }
  std::vector<PetscReal> at_airway;
  for (std::size_t k = 0; k < lacking_.size(); ++k) {
    at_airway.push_back(stage.by_flow[k] * flow);
    for (std::size_t j = 0; j < rates.size(); ++j) at_airway[k] += stage.by_rate[k][j] * rates[j];
    lacking_[k].steps += at_airway[k];
  }
  if (sweep.other_rates()) PetscCall(add_other_rates(stage, changes));
  if (!rough) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(total(time_, after));
  for (std::size_t k = 0; k < lacking_.size(); ++k) rough_[k] += std::abs(after[k] - before[k] + at_airway[k]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Of rates that act by more than the gas that is stored.
PetscErrorCode ErrorParts::add_other_rates(const Sweep::Solved &stage, const Changes &changes)
{
  const StageRecord &record = stage.record;
  ByCell parts;

  PetscFunctionBeginUser;
  VecHandle better; // of a multistep stage: the gas does not see it
  Stage told = record.stage;
  told.multistep = true;
  PetscCall(VecDuplicate(state_, better.out()));
  PetscCall(VecCopy(stage.rate, better));
  for (const auto &[number, weight] : changes) {
    PetscCall(trajectory_.state(number, state_));
    PetscCall(VecAXPY(better, weight, state_));
  }
  PetscCall(model_.set_step(told, record.airway.pressure, record.airway.flow));
  PetscCall(model_.weighted_residual(false, record.time, stage.state, better, stage.adjoint, parts));
  add(1, parts, time_);
  PetscCall(model_.weighted_residual(false, record.time, stage.state, stage.rate, stage.adjoint, parts));
  add(-1, parts, time_);
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::found(Found &sizes) const
{
  PetscFunctionBeginUser;
  PetscCall(total(flow_part_, sizes.flow));
  PetscCall(total(tissue_part_, sizes.tissue));
  for (std::vector<PetscReal> *sums : {&sizes.flow, &sizes.tissue})
    for (PetscReal &sum : *sums) sum = std::abs(sum);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::sizes(const Sweep::Solved &stage, std::vector<PetscReal> &sums) const
{
  const CellLayout &layout = model_.assembly().layout();

  PetscFunctionBeginUser;
  sums.clear();
  const ReadArray u(stage.state);
  for (const Vec adjoint : stage.adjoint) {
    const ReadArray z(adjoint);
    PetscReal sum = 0;
    for (PetscInt c = 0; c < layout.cells; ++c)
      for (PetscInt i = 0; i < layout.size; ++i)
        if (layout.field_of[i] == displacement) {
          const PetscInt dof = layout.cell_dofs(c)[i];
          sum += std::abs(z[dof] * u[dof]);
        }
    sums.push_back(sum);
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPIU_REAL, MPI_SUM,
                             PetscObjectComm((PetscObject)model_.dm())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::add_space(const Sweep::Solved &stage)
{
  const StageRecord &record = stage.record;
  std::vector<Enrichment::Later> later;
  std::vector<Enrichment::Past> past;
  VecHandle states[2];

  PetscFunctionBeginUser;
  for (int i = 0; gas_ && record.stage.multistep && i < 2; ++i) {
    if (record.past[i] < 0) continue;
    PetscCall(VecDuplicate(state_, states[i].out()));
    PetscCall(trajectory_.state(record.past[i], states[i]));
    past.push_back({record.weight[i] * model_.row_scale(pressure), states[i]});
  }
  if (flow_) PetscCall(flow_->add(stage, later, past, simulation_.matrix(), flow_part_, &solver_));
  for (int i = 0; gas_ && i < 2; ++i) {
    if (record.past[i] < 0) continue;
    Kept kept{record.weight[i] * model_.row_scale(pressure), {}};
    for (const Vec z : stage.adjoint) {
      VecHandle copy;
      PetscCall(VecDuplicate(z, copy.out()));
      PetscCall(VecCopy(z, copy));
      kept.adjoint.push_back(std::move(copy));
    }
    later_[record.past[i]].push_back(std::move(kept));
  }
  std::vector<PetscReal> size;
  Found so_far;
  PetscCall(sizes(stage, size));
  PetscCall(found(so_far));
  if (samples(stage.number, size, so_far)) {
    for (const Kept &kept : later_[stage.number])
      later.push_back({kept.factor, {kept.adjoint.begin(), kept.adjoint.end()}});
    sample_ = {0, size, ByCell(size.size(), std::vector<PetscReal>(in_space_.front().size(), 0))};
    PetscCall(tissue_->add(stage, later, past, simulation_.matrix(), sample_.part));
  }
  later_.erase(later_.lower_bound(stage.number), later_.end());
  for (std::size_t k = 0; k < size.size(); ++k)
    if (sample_.size[k] > 0) add_to(size[k] / sample_.size[k], sample_.part[k], tissue_part_[k]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::visit(const Sweep &sweep, const Sweep::Solved &stage)
{
  const StageRecord &record = stage.record;

  PetscFunctionBeginUser;
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  if (!flow_) PetscCall(add_solver(stage));
  const std::vector<PetscReal> of_scalars = sweep.weighted_scalars(stage);
  for (std::size_t k = 0; k < lacking_.size(); ++k) lacking_[k].solver += of_scalars[k];
  PetscCall(add_time(sweep, stage));
  PetscCall(add_space(stage));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::total(const ByCell &parts, std::vector<PetscReal> &sums) const
{
  PetscFunctionBeginUser;
  sums.clear();
  for (const std::vector<PetscReal> &cells : parts) {
    sums.push_back(0);
    for (const PetscReal part : cells) sums.back() += part;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPIU_REAL, MPI_SUM,
                             PetscObjectComm((PetscObject)model_.dm())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorParts::run(Sweep &sweep, const std::vector<Functional> &functionals, PetscReal tolerance,
                               std::string &failure)
{
  std::vector<PetscReal> sums;

  PetscFunctionBeginUser;
  PetscCall(setup(functionals));
  PetscCall(sweep.run(
      functionals, tolerance, [&](const Sweep::Solved &stage) { return visit(sweep, stage); }, failure));
  PetscCall(total(solver_, sums));
  for (std::size_t k = 0; k < sums.size(); ++k) lacking_[k].solver += sums[k];
  PetscCall(total(time_, sums));
  for (std::size_t k = 0; k < sums.size(); ++k) {
    lacking_[k].steps += sums[k];
    lacking_[k].rows = functionals[k].better_value - functionals[k].value;
  }
  PetscCall(total(flow_part_, sums));
  for (std::size_t k = 0; k < sums.size(); ++k) lacking_[k].flow_in_space = sums[k];
  PetscCall(total(tissue_part_, sums));
  for (std::size_t k = 0; k < sums.size(); ++k) lacking_[k].tissue_in_space = sums[k];
  in_space_ = flow_part_;
  add(1, tissue_part_, in_space_);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
