// The part of Sweep that is about the pressure at the opening and the scalar unknowns of effects.
#include "pulmo/adjoint/sweep.hpp"

#include "pulmo/mesh/mesh.hpp"

namespace pulmo {

namespace {

/// Of the modulus: a change of pressure over which few kernels have a kink, and rounding is small.
constexpr PetscReal curved = 1e-7;

} // namespace

/// The residual is linear in both, so that a difference over any step is exact; but what is remembered may follow from
/// the pressure as it likes.
PetscErrorCode Sweep::make_column(const StageRecord &record, std::size_t scalar, Vec column)
{
  const bool free = record.airway.mode == Airway::Mode::free;
  const PetscReal L = model_.composition().mesh().length(),
                  change = free ? record.stage.slope * L * L * L : model_.modulus() * (memory_ ? curved : 1);

  PetscFunctionBeginUser;
  const auto residual_at = [&](PetscReal by, Vec F) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(VecCopy(x_, past_));
    PetscCall(VecCopy(rate_, other_));
    if (!free && gas_) {
      std::vector<PetscReal> values = values_of(record), rates(values.size(), 0);
      values[scalar] += by;
      rates[scalar] = by * record.stage.slope;
      PetscCall(model_.airway().fill(past_, values));
      PetscCall(VecZeroEntries(work_));
      PetscCall(model_.airway().fill(work_, rates));
      PetscCall(VecAXPY(other_, 1, work_));
    }
    PetscCall(model_.set_step(record.stage, record.airway.pressure + (free || scalar > 0 ? 0 : by),
                              record.airway.flow + (free ? by : 0)));
    PetscCall(model_.residual(record.time, past_, other_, F));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(residual_at(change, column));
  PetscCall(residual_at(-change, work_));
  PetscCall(VecAXPBY(column, -1 / (2 * change), 1 / (2 * change), work_));
  PetscCall(model_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::make_columns(const StageRecord &record)
{
  const bool wanted = targets_ || record.airway.mode != Airway::Mode::held || record.airway.by_start != 0;

  PetscFunctionBeginUser;
  for (std::size_t a = 0; a < acting_.size(); ++a)
    if (wanted)
      PetscCall(make_column(record, acting_[a], columns_[a]));
    else
      PetscCall(VecZeroEntries(columns_[a]));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::along_columns(Vec z, std::vector<PetscReal> &by_scalar) const
{
  PetscFunctionBeginUser;
  by_scalar.assign(storages_.size(), 0);
  for (std::size_t a = 0; a < acting_.size(); ++a) PetscCall(dot(z, columns_[a], by_scalar[acting_[a]]));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscReal Sweep::gas_rate(const StageRecord &record, PetscInt number) const
{
  PetscReal Q = record.stage.slope * volume(number), beside = record.stage.slope * scalars_.stored(scalars(number));
  for (int i = 0; i < 2; ++i) {
    if (record.past[i] < 0) continue;
    Q += record.weight[i] * volume(record.past[i]);
    beside += record.weight[i] * scalars_.stored(scalars(record.past[i]));
  }
  return Q + beside;
}

ScalarUnknowns::OpeningEquation Sweep::equation(const StageRecord &record, PetscInt number) const
{
  return [&record, this, rate = gas_rate(record, number)](PetscReal P, PetscReal gas) {
    return Airway::equation(model_, scene_.facts().tube, record.airway.control, record.airway.target,
                            record.stage.slope, P, gas, rate);
  };
}

std::vector<PetscReal> Sweep::values_of(const StageRecord &record) const
{
  return scalars_.of_effects() ? record.airway.scalars : std::vector<PetscReal>{record.airway.pressure};
}

PetscErrorCode Sweep::recall_scalars(const StageRecord &record, PetscInt number)
{
  std::vector<PetscReal> past(storages_.size(), 0);

  PetscFunctionBeginUser;
  for (int i = 0; i < 2; ++i)
    for (std::size_t j = 0; scalars_.of_effects() && record.past[i] >= 0 && j < past.size(); ++j)
      past[j] += record.weight[i] * scalars(record.past[i])[j];
  scalars_.begin(values_of(record), true, record.stage.slope, past);
  scalars_.recall(volume(number), record.airway.flows);
  rows_ = scalars_.rows(equation(record, number));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<PetscReal> Sweep::weighted_scalars(const Solved &stage) const
{
  std::vector<PetscReal> sums(count_, 0);
  if (stage.record.airway.mode != Airway::Mode::solved) return sums;
  const ScalarUnknowns::Rows rows = scalars_.rows(equation(stage.record, stage.number));
  for (std::size_t k = 0; k < count_; ++k)
    for (std::size_t i = 0; i < rows.c.size(); ++i) sums[k] += stage.multipliers[k][i] * rows.c[i];
  return sums;
}

void Sweep::want_gas(PetscReal derivative, Wanted &wanted) const
{
  wanted.volume += derivative;
  for (std::size_t j = 0; j < storages_.size(); ++j) wanted.scalars[j] += derivative * storages_[j];
}

void Sweep::want_past_volumes(const StageRecord &record, PetscReal by_flow, std::size_t k, Pending &pending) const
{
  for (int i = 0; i < 2; ++i)
    if (record.past[i] >= 0) wanted(pending, record.past[i], k).volume += by_flow * record.weight[i];
}

PetscErrorCode Sweep::begin_borders()
{
  const std::size_t n = storages_.size();

  PetscFunctionBeginUser;
  volume_.seen = rows_.by_volume[0] != 0;
  if (volume_.seen) {
    PetscCall(VecZeroEntries(work_));
    PetscCall(model_.add_volume_gradient(x_, nullptr, -rows_.by_volume[0], work_));
    PetscCall(to_global(work_, volume_.right));
  }
  for (std::size_t a = 0; a < fluxes_.size(); ++a) {
    Border &border = fluxes_[a];
    std::vector<PetscReal> unit(n, 0);
    unit[acting_[a]] = 1 / model_.row_scale(pressure);
    border.seen = false;
    for (std::size_t i = 0; i < n; ++i) border.seen = border.seen || rows_.by_flow[i * n + acting_[a]] != 0;
    if (!border.seen) continue;
    PetscCall(VecZeroEntries(held_));
    PetscCall(model_.airway().fill_global(held_, unit));
    PetscCall(MatMult(simulation_.matrix(), held_, border.right));
    PetscCall(VecScale(border.right, -1));
    PetscCall(VecZeroEntries(border.z));
    PetscCall(model_.airway().fill(border.z, unit));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sweep::solve_borders(std::string &failure)
{
  PetscFunctionBeginUser;
  const auto solve_one = [&](Border &border, bool at_nodes) -> PetscErrorCode {
    PetscFunctionBeginUser;
    border.by_scalar.assign(storages_.size(), 0);
    if (!border.seen) PetscFunctionReturn(PETSC_SUCCESS);
    PetscCall(model_.airway().set(border.right, 0));
    PetscCall(solve(border.right, product_, failure));
    PetscCall(to_local(product_, at_nodes ? work_ : border.z));
    if (at_nodes) PetscCall(VecAXPY(border.z, 1, work_));
    PetscCall(along_columns(border.z, border.by_scalar));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(solve_one(volume_, false));
  for (Border &border : fluxes_) PetscCall(solve_one(border, true));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<PetscReal> Sweep::solve_scalars(const std::vector<PetscReal> &wanted) const
{
  const std::size_t n = wanted.size();
  std::vector<PetscReal> system(n * n), multipliers(n);
  for (std::size_t j = 0; j < n; ++j) {
    multipliers[j] = -wanted[j];
    for (std::size_t i = 0; i < n; ++i) {
      PetscReal &entry = system[j * n + i] = rows_.by_scalar[i * n + j];
      if (i == 0) entry += volume_.by_scalar[j];
      for (std::size_t a = 0; a < fluxes_.size(); ++a)
        entry += rows_.by_flow[i * n + acting_[a]] * fluxes_[a].by_scalar[j];
    }
  }
  solve_dense(std::move(system), multipliers);
  return multipliers;
}

/// Adds the multipliers of the scalars' equations to what is solved for number @p k.
PetscErrorCode Sweep::add_scalars(const StageRecord &record, std::size_t k, const std::vector<PetscReal> &wanted,
                                  Solved &result, std::string &failure)
{
  const std::size_t n = wanted.size();
  const std::vector<PetscReal> m = solve_scalars(wanted);

  PetscFunctionBeginUser;
  if (!std::all_of(m.begin(), m.end(), [](PetscReal one) { return std::isfinite(one); }))
    failure = "the equations of the airway's pressures leave these open in a step of the sweep";
  if (volume_.seen) PetscCall(VecAXPY(result.adjoint[k], m[0], volume_.z));
  for (std::size_t a = 0; a < fluxes_.size(); ++a) {
    PetscReal by_flux = 0;
    for (std::size_t i = 0; i < n; ++i) by_flux += m[i] * rows_.by_flow[i * n + acting_[a]];
    if (fluxes_[a].seen) PetscCall(VecAXPY(result.adjoint[k], by_flux, fluxes_[a].z));
  }
  result.multipliers[k] = m;
  result.by_volume[k] += m[0] * rows_.by_volume[0];
  result.by_flow[k] += m[0] * rows_.opening.by_flow;
  result.by_target[k] = m[0] * rows_.opening.by_target;
  if (record.airway.control != Control::flow) result.by_drop[k] -= result.by_target[k];
  for (std::size_t j = 0; j < n; ++j) {
    result.by_rate[k][j] += m[0] * rows_.opening.by_flow * storages_[j];
    for (std::size_t i = 0; i < n; ++i) result.by_rate[k][j] += m[i] * rows_.by_rate[i * n + j];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Sweep::look_back_at_scalars(const StageRecord &record, std::size_t k, const Solved &result, Pending &pending)
{
  const Airway::Condition &airway = record.airway;
  if (airway.mode == Airway::Mode::free) want_past_volumes(record, result.by_flow[k], k, pending);
  if (airway.mode == Airway::Mode::solved)
    want_past_volumes(record, result.multipliers[k][0] * rows_.opening.by_flow, k, pending);
  for (int i = 0; i < 2 && scalars_.of_effects(); ++i)
    for (std::size_t j = 0; record.past[i] >= 0 && j < storages_.size(); ++j)
      wanted(pending, record.past[i], k).scalars[j] += record.weight[i] * result.by_rate[k][j];
  Wanted &start = wanted(pending, record.phase_start, k);
  if (airway.control == Control::flow)
    want_gas(result.by_target[k] * airway.by_start, start);
  else
    want_ventilator_pressure(record.phase_start, result.by_target[k] * airway.by_start, start);
}

} // namespace pulmo
