// Scalar unknowns in Newton's method.
#include "pulmo/fem/scalar_unknowns.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A Krylov method solves for z to a share of its right-hand side, which grows with the permeability; it is solved on,
/// so many times at most, until what is left of it adds less than this share to the residual.
constexpr int max_solves = 8;
constexpr PetscReal residual_share = 0.1;

/// Scalars are moved by this share of the tissue's stiffness for a difference quotient. The fields' residual is linear
/// in them: the quotient is exact.
constexpr PetscReal difference = 1e-4;

} // namespace

void solve_dense(std::vector<PetscReal> a, std::vector<PetscReal> &b)
{
  const std::size_t n = b.size();
  const auto row = [&](std::size_t i) { return a.begin() + static_cast<std::ptrdiff_t>(i * n); };
  for (std::size_t k = 0; k < n; ++k) {
    std::size_t pivot = k;
    for (std::size_t i = k + 1; i < n; ++i)
      if (std::abs(a[i * n + k]) > std::abs(a[pivot * n + k])) pivot = i;
    std::swap_ranges(row(k), row(k + 1), row(pivot));
    std::swap(b[k], b[pivot]);
    for (std::size_t i = k + 1; i < n; ++i) {
      const PetscReal factor = a[i * n + k] / a[k * n + k];
      if (factor == 0) continue;
      for (std::size_t j = k; j < n; ++j) a[i * n + j] -= factor * a[k * n + j];
      b[i] -= factor * b[k];
    }
  }
  for (std::size_t k = n; k-- > 0;) {
    for (std::size_t j = k + 1; j < n; ++j) b[k] -= a[k * n + j] * b[j];
    b[k] /= a[k * n + k];
  }
}

std::vector<PetscReal> ScalarUnknowns::storages() const
{
  std::vector<PetscReal> list = {0};
  for (const ScalarGroup &group : model_.composition().scalar_groups())
    for (const ScalarSpec &spec : group.scalars) list.push_back(spec.storage);
  return list;
}

PetscReal ScalarUnknowns::stored(const std::vector<PetscReal> &values) const
{
  PetscReal sum = 0;
  if (!of_effects()) return 0;
  const std::vector<PetscReal> storage = storages();
  for (std::size_t i = 0; i < values.size(); ++i) sum += storage[i] * values[i];
  return sum;
}

std::vector<PetscReal> ScalarUnknowns::rates() const
{
  std::vector<PetscReal> list;
  for (std::size_t i = 0; i < value_.size(); ++i) list.push_back(slope_ * value_[i] + past_[i]);
  return list;
}

void ScalarUnknowns::begin(std::vector<PetscReal> values, bool unknown, PetscReal slope, std::vector<PetscReal> past)
{
  value_ = std::move(values);
  unknown_ = unknown;
  slope_ = slope;
  scale_.clear();
  past_ = std::move(past);
  past_.resize(value_.size());
}

void ScalarUnknowns::recall(PetscReal volume, std::vector<PetscReal> flows)
{
  volume_ = volume;
  flow_ = std::move(flows);
}

PetscErrorCode ScalarUnknowns::take(Vec X)
{
  PetscFunctionBeginUser;
  if (unknown_ && !frozen_) PetscCall(model_.airway().scalars(X, value_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<ScalarState> ScalarUnknowns::states() const
{
  const std::vector<PetscReal> rate = rates();
  std::vector<ScalarState> list;
  for (const ScalarGroup &group : model_.composition().scalar_groups()) {
    const auto first = static_cast<std::ptrdiff_t>(1 + group.offset),
               last = first + static_cast<std::ptrdiff_t>(group.scalars.size());
    const auto part = [&](const std::vector<PetscReal> &all) {
      return std::vector<PetscReal>(all.begin() + first, all.begin() + last);
    };
    list.push_back({value_.front(), part(value_), part(rate), part(flow_)});
  }
  return list;
}

ScalarUnknowns::Rows ScalarUnknowns::rows(const OpeningEquation &opening) const
{
  const std::size_t n = size();
  const auto &groups = model_.composition().scalar_groups();
  const std::vector<PetscReal> storage = storages();
  Rows rows;
  rows.c.assign(n, 0);
  rows.by_volume.assign(n, 0);
  rows.by_scalar.assign(n * n, 0);
  rows.by_flow.assign(n * n, 0);
  rows.by_rate.assign(n * n, 0);
  const Opening first = opening(value_.front(), volume_ + stored(value_));
  rows.opening = first;
  rows.c[0] = first.c;
  rows.by_volume[0] = first.by_volume;
  for (std::size_t j = 0; j < n; ++j) rows.by_scalar[j] = first.by_volume * storage[j];
  rows.by_scalar[0] += first.by_pressure;
  if (groups.empty()) return rows;

  const std::vector<ScalarState> seen = states();
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::size_t m = groups[g].scalars.size(), at = 1 + groups[g].offset;
    ScalarRows own(m);
    groups[g].equations(seen[g], own);
    for (std::size_t i = 0; i < m; ++i) {
      const PetscReal scale = scale_of(at + i, own, i);
      rows.unmet = std::max(rows.unmet, std::abs(own.value[i]));
      rows.c[at + i] = scale * own.value[i];
      rows.by_scalar[(at + i) * n] = scale * own.by_opening[i];
      for (std::size_t j = 0; j < m; ++j) {
        rows.by_scalar[(at + i) * n + at + j] = scale * (own.by_value(i, j) + slope_ * own.by_rate(i, j));
        rows.by_flow[(at + i) * n + at + j] = scale * own.by_flow(i, j);
        rows.by_rate[(at + i) * n + at + j] = scale * own.by_rate(i, j);
      }
    }
  }
  return rows;
}

PetscReal ScalarUnknowns::scale_of(std::size_t equation, ScalarRows &own, std::size_t row) const
{
  const PetscReal L = model_.composition().mesh().length();
  PetscReal most = 0;
  scale_.resize(size(), 0);
  if (scale_[equation] > 0) return scale_[equation];
  for (std::size_t j = 0; j < own.size(); ++j) most = std::max(most, std::abs(own.by_flow(row, j)));
  return scale_[equation] = 1 / (model_.modulus() + most * slope_ * L * L * L);
}

PetscErrorCode ScalarUnknowns::close(const OpeningEquation &opening, PetscReal volume, Vec local_F, Vec F)
{
  PetscFunctionBeginUser;
  volume_ = volume;
  if (!unknown_) PetscFunctionReturn(PETSC_SUCCESS);
  if (of_effects()) PetscCall(model_.airway().flows(local_F, model_.row_scale(pressure), flow_));
  const Rows rows = this->rows(opening);
  unmet_ = rows.unmet;
  if (!frozen_ && F) PetscCall(model_.airway().set_scalars(F, rows.c));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ScalarUnknowns::create_vectors(Vec like, Vec like_local)
{
  PetscFunctionBeginUser;
  if (x_) PetscFunctionReturn(PETSC_SUCCESS);
  acting_ = model_.airway().acting();
  column_.resize(acting_.size());
  solution_.resize(acting_.size());
  for (std::size_t k = 0; k < acting_.size(); ++k) {
    PetscCall(VecDuplicate(like, column_[k].out()));
    PetscCall(VecDuplicate(like, solution_[k].out()));
  }
  PetscCall(VecDuplicate(like, x_.out()));
  PetscCall(VecDuplicate(like, r_.out()));
  PetscCall(VecDuplicate(like_local, local_y_.out()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ScalarUnknowns::along(Vec local, Vec y, const std::vector<PetscReal> &scalars, PetscReal &volume,
                                     std::vector<PetscReal> &flow)
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(local_y_)); // constrained values do not change
  PetscCall(DMGlobalToLocal(model_.dm(), y, INSERT_VALUES, local_y_));
  PetscCall(model_.volume_derivative(local, local_y_, volume));
  flow.assign(size(), 0);
  if (of_effects()) {
    PetscCall(VecCopy(y, x_));
    PetscCall(model_.airway().flow_derivatives(x_, scalars, model_.row_scale(pressure), flow));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ScalarUnknowns::complete(SNES snes, const OpeningEquation &opening, Mat A, Vec X, Vec Y, Vec local,
                                        PetscInt &krylov)
{
  const std::size_t n = size();
  const std::vector<PetscReal> nothing(n, 0);
  Vec F;
  KSP ksp;
  PetscReal norm, volume_y;
  std::vector<PetscReal> flow_y, change;

  PetscFunctionBeginUser;
  if (!unknown_) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(create_vectors(X, local));
  PetscCall(SNESGetFunction(snes, &F, nullptr, nullptr));
  if (frozen_) { // PETSc's test of the Jacobian left its residual
    freeze(false);
    PetscCall(SNESComputeFunction(snes, X, F));
  }
  PetscCall(take(X));
  const std::vector<PetscReal> values = value_;
  for (std::size_t k = 0; k < acting_.size(); ++k) {
    std::vector<PetscReal> moved = values;
    const PetscReal step = difference * std::max(model_.modulus(), std::abs(values[acting_[k]]));
    moved[acting_[k]] += step;
    PetscCall(VecCopy(X, x_));
    PetscCall(model_.airway().set(x_, moved));
    PetscCall(SNESComputeFunction(snes, x_, column_[k]));
    PetscCall(VecAXPBY(column_[k], -1 / step, 1 / step, F));
    PetscCall(model_.airway().set(column_[k], 0));
    PetscCall(VecZeroEntries(solution_[k]));
  }
  if (of_effects()) PetscCall(SNESComputeFunction(snes, X, r_)); // the flows are those of X again
  value_ = values;
  const Rows rows = this->rows(opening);
  PetscCall(SNESGetKSP(snes, &ksp));
  PetscCall(VecNorm(F, NORM_2, &norm));
  PetscCall(along(local, Y, nothing, volume_y, flow_y));
  std::vector<PetscReal> fixed(n), system = rows.by_scalar;
  for (std::size_t i = 0; i < n; ++i) {
    fixed[i] = -rows.c[i] + rows.by_volume[i] * volume_y;
    for (std::size_t j = 0; j < n; ++j) fixed[i] += rows.by_flow[i * n + j] * flow_y[j];
  }
  std::vector<PetscReal> left(acting_.size(), PETSC_MAX_REAL);
  bool failed = false;
  for (int solves = 0; solves < max_solves && !failed; ++solves) {
    bool solved = false;
    for (std::size_t k = 0; k < acting_.size() && !failed; ++k) {
      const std::size_t j = acting_[k];
      KSPConvergedReason reason;
      PetscInt iterations;
      PetscReal volume_z;
      std::vector<PetscReal> flow_z, unit = nothing;
      if (solves > 0 &&
          !(std::abs(change[j]) * left[k] * static_cast<PetscReal>(acting_.size()) > residual_share * norm))
        continue;
      solved = true;
      PetscCall(VecZeroEntries(x_)); // with -ksp_initial_guess_nonzero it is one
      PetscCall(KSPSolve(ksp, column_[k], x_));
      PetscCall(KSPGetConvergedReason(ksp, &reason));
      PetscCall(KSPGetIterationNumber(ksp, &iterations));
      krylov += iterations;
      failed = reason < 0; // the step will be cut
      PetscCall(VecAXPY(solution_[k], 1, x_));
      PetscCall(MatMult(A, x_, r_));
      PetscCall(VecAXPY(column_[k], -1, r_));
      PetscCall(VecNorm(column_[k], NORM_2, &left[k]));
      unit[j] = -1;
      PetscCall(along(local, solution_[k], unit, volume_z, flow_z));
      for (std::size_t i = 0; i < n; ++i) {
        PetscReal &entry = system[i * n + j];
        entry = rows.by_scalar[i * n + j] - rows.by_volume[i] * volume_z;
        for (std::size_t g = 0; g < n; ++g) entry -= rows.by_flow[i * n + g] * flow_z[g];
      }
    }
    if (!solved && solves > 0) break;
    change = fixed;
    solve_dense(system, change);
  }
  for (std::size_t k = 0; k < acting_.size(); ++k) PetscCall(VecAXPY(Y, change[acting_[k]], solution_[k]));
  for (PetscReal &c : change) c = -c; // the new state is X - Y
  PetscCall(model_.airway().set(Y, change));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
