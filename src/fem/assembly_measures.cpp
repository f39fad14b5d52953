// What a state of the lung measures: J at the points and corners of the cells, its extremes, its integral.
#include "pulmo/fem/assembly.hpp"

#include "pulmo/base/simd.hpp"

#include <algorithm>
#include <cmath>
#include <memory>

namespace pulmo {

namespace {

/// Displacement in one cell, for its gradient at the points of a table.
class CellDisplacement {
public:
  CellDisplacement(const element::BasisTable &table, const PetscReal inverse[9], const PetscInt *dofs,
                   const PetscScalar *x)
      : basis_(table.basis()), inverse_(inverse)
  {
    for (PetscInt a = 0; a < basis_.nodes; ++a)
      node_[a] = Vector4{x[dofs[3 * a]], x[dofs[3 * a + 1]], x[dofs[3 * a + 2]], 0};
  }
  /// Grad u at point @p q.
  void gradient(PetscInt q, PetscScalar H[9]) const
  {
    Vector4 value, g[3];
    element::interpolate(basis_, q, inverse_, node_, value, g);
    for (int i = 0; i < 3; ++i)
      for (int d = 0; d < 3; ++d) H[3 * i + d] = g[d][i];
  }

private:
  element::ScalarBasis basis_;
  const PetscReal *inverse_;
  Vector4 node_[max_nodes];
};

} // namespace

void Assembly::point_states(PetscInt c, const PetscScalar *x, std::vector<PointState> &states) const
{
  const CellDisplacement u(watched_, &invJ_[9 * c], cell_dofs(c), x);
  states.resize(watched_points_);
  for (PetscInt q = 0; q < watched_points_; ++q) {
    PetscScalar H[9];
    u.gradient(q, H);
    make_point_state(H, nullptr, states[q]);
  }
}

PetscErrorCode Assembly::measure(Vec x, Measures &measures) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  const auto n_rule = static_cast<PetscInt>(rule_weights_.size());
  struct Least {
    double value = PETSC_MAX_REAL;
    int rank = 0;
  } least[2], winner[2];                                                   // of J, of the air
  double volume = 0, extremes[3] = {-PETSC_MAX_REAL, -PETSC_MAX_REAL, -1}; // max J, -(min J, min air at points)
  PetscInt where[2] = {-1, -1};
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  least[0].rank = least[1].rank = rank;
  if (needs_air_)
    extremes[2] = -PETSC_MAX_REAL;
  else
    least[1].value = 1;
  const ReadArray xs(x);
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    const CellDisplacement u(watched_, &invJ_[9 * c], cell_dofs(c), xs.data());
    double sum = 0;
    for (PetscInt q = 0; q < watched_points_; ++q) {
      PetscScalar H[9];
      u.gradient(q, H);
      const double Jm1 = jacobian_minus_one(H), J = 1 + Jm1;
      extremes[0] = std::max(extremes[0], J);
      if (q < n_rule) {
        sum += rule_weights_[q] * Jm1;
        extremes[1] = std::max(extremes[1], std::isnan(J) ? PETSC_MAX_REAL : -J);
      }
      if (!(J >= least[0].value)) { // also taken when J is not a number
        least[0].value = std::isnan(J) ? -PETSC_MAX_REAL : J;
        where[0] = c;
      }
      if (!needs_air_) continue;
      const double air = J - airless_J_[c]; // J that is not a number is told by min_J
      if (q < n_rule) extremes[2] = std::max(extremes[2], -air);
      if (air < least[1].value) {
        least[1].value = air;
        where[1] = c;
      }
    }
    volume += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPI_DOUBLE, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 3, MPI_DOUBLE, MPI_MAX, comm));
  PetscCallMPI(MPI_Allreduce(least, winner, 2, MPI_DOUBLE_INT, MPI_MINLOC, comm));
  measures.volume_change = volume;
  measures.max_J = extremes[0];
  measures.min_J_points = -extremes[1];
  measures.min_J = winner[0].value;
  measures.min_air_points = -extremes[2];
  measures.min_air = winner[1].value;
  const int worst = measures.airless() ? 1 : 0;
  const PetscInt cell = where[worst];
  measures.rank = winner[worst].rank;
  measures.cell = cell;
  if (measures.rank == rank && cell >= 0) {
    if (needs_air_) measures.airless_J = airless_J_[cell];
    for (int d = 0; d < 3; ++d) // reference coordinates of the centroid are -1/2
      measures.where[d] =
          v0_[3 * cell + d] + (J_[9 * cell + 3 * d] + J_[9 * cell + 3 * d + 1] + J_[9 * cell + 3 * d + 2]) / 2;
  }
  PetscCallMPI(MPI_Bcast(measures.where, 3, MPIU_REAL, measures.rank, comm));
  PetscCallMPI(MPI_Bcast(&measures.cell, 1, MPIU_INT, measures.rank, comm));
  if (measures.airless()) PetscCallMPI(MPI_Bcast(&measures.airless_J, 1, MPIU_REAL, measures.rank, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::largest_J_change(Vec x, Vec y, PetscReal &change) const
{
  PetscFunctionBeginUser;
  change = 0;
  {
    const ReadArray xs(x), ys(y);
    for (PetscInt c = 0; c < layout_.cells; ++c) {
      const CellDisplacement u(watched_, &invJ_[9 * c], cell_dofs(c), xs.data());
      const CellDisplacement v(watched_, &invJ_[9 * c], cell_dofs(c), ys.data());
      for (std::size_t q = 0; q < rule_weights_.size(); ++q) {
        PetscScalar H[9], G[9];
        u.gradient(static_cast<PetscInt>(q), H);
        v.gradient(static_cast<PetscInt>(q), G);
        const PetscReal Jm1 = jacobian_minus_one(H);
        change = std::max(change, std::abs(std::log1p((jacobian_minus_one(G) - Jm1) / (1 + Jm1))));
      }
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &change, 1, MPIU_REAL, MPIU_MAX, PetscObjectComm((PetscObject)dm_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::largest_pressure_change(Vec x, Vec y, PetscReal &change) const
{
  PetscFunctionBeginUser;
  change = 0;
  {
    const ReadArray xs(x), ys(y);
    for (PetscInt i = 0; i < layout_.size; ++i) {
      if (layout_.field_of[i] != pressure) continue;
      for (PetscInt c = 0; c < layout_.cells; ++c) {
        const PetscInt dof = cell_dofs(c)[i];
        change = std::max(change, std::abs(ys[dof] - xs[dof]));
      }
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &change, 1, MPIU_REAL, MPIU_MAX, PetscObjectComm((PetscObject)dm_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::volume_derivative(Vec x, Vec y, PetscReal &derivative) const
{
  PetscFunctionBeginUser;
  const ReadArray xs(x), ys(y);
  derivative = 0;
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    const CellDisplacement u(watched_, &invJ_[9 * c], cell_dofs(c), xs.data());
    const CellDisplacement v(watched_, &invJ_[9 * c], cell_dofs(c), ys.data());
    PetscReal sum = 0;
    for (std::size_t q = 0; q < rule_weights_.size(); ++q) {
      PetscScalar H[9], G[9], cof_F[9];
      u.gradient(static_cast<PetscInt>(q), H);
      v.gradient(static_cast<PetscInt>(q), G);
      for (int i = 0; i < 3; ++i) H[4 * i] += 1;
      cofactor(H, cof_F);
      sum += rule_weights_[q] * contract(cof_F, G);
    }
    derivative += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &derivative, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)dm_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The pressure field at the points where J is watched, once something is weighed by it.
PetscErrorCode Assembly::prepare_weighing()
{
  PetscFE fe;

  PetscFunctionBeginUser;
  if (weighing_.nodes() > 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscDSGetDiscretization(ds_, pressure, (PetscObject *)&fe));
  PetscCall(weighing_.setup(fe, watched_at_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::weighted_volume(Vec x, const std::vector<Vec> &weights,
                                         std::vector<std::vector<PetscReal>> &sums)
{
  std::vector<std::unique_ptr<ReadArray>> arrays;

  PetscFunctionBeginUser;
  PetscCall(prepare_weighing());
  const ReadArray xs(x);
  const element::ScalarBasis mass = weighing_.basis();
  for (const Vec weight : weights) arrays.push_back(std::make_unique<ReadArray>(weight));
  sums.assign(weights.size(), std::vector<PetscReal>(static_cast<std::size_t>(layout_.cells), 0));
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    const PetscInt *dofs = cell_dofs(c), *mass_dofs = dofs + 3 * watched_.basis().nodes;
    const CellDisplacement u(watched_, &invJ_[9 * c], dofs, xs.data());
    for (std::size_t q = 0; q < rule_weights_.size(); ++q) {
      PetscScalar H[9];
      u.gradient(static_cast<PetscInt>(q), H);
      const PetscReal gain = rule_weights_[q] * detJ_[c] * jacobian_minus_one(H);
      const PetscReal *values = mass.values + static_cast<PetscInt>(q) * mass.stride;
      for (std::size_t k = 0; k < weights.size(); ++k)
        for (PetscInt a = 0; a < mass.nodes; ++a)
          sums[k][static_cast<std::size_t>(c)] += gain * values[a] * (*arrays[k])[mass_dofs[a]];
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::add_volume_gradient(Vec x, Vec weight, PetscReal factor, Vec y,
                                             const std::vector<PetscInt> *cells)
{
  const element::ScalarBasis basis = watched_.basis();

  PetscFunctionBeginUser;
  if (weight) PetscCall(prepare_weighing());
  const ReadArray xs(x), qs(weight ? weight : x);
  WriteArray ys(y);
  const PetscInt count = cells ? static_cast<PetscInt>(cells->size()) : layout_.cells;
  for (PetscInt n = 0; n < count; ++n) {
    const PetscInt c = cells ? (*cells)[static_cast<std::size_t>(n)] : n, *dofs = cell_dofs(c),
                   *mass_dofs = dofs + 3 * basis.nodes;
    const PetscReal *inverse = &invJ_[9 * c];
    const CellDisplacement u(watched_, inverse, dofs, xs.data());
    Vector4 sum[max_nodes] = {};
    for (std::size_t q = 0; q < rule_weights_.size(); ++q) {
      PetscScalar H[9], cof_F[9], value = weight ? 0 : 1;
      if (weight) {
        const element::ScalarBasis mass = weighing_.basis();
        for (PetscInt a = 0; a < mass.nodes; ++a)
          value += mass.values[static_cast<PetscInt>(q) * mass.stride + a] * qs[mass_dofs[a]];
      }
      u.gradient(static_cast<PetscInt>(q), H);
      for (int i = 0; i < 3; ++i) H[4 * i] += 1;
      cofactor(H, cof_F);
      Vector4 along[3]; // cof F by the directions of the reference cell
      for (int e = 0; e < 3; ++e) {
        along[e] = Vector4{};
        for (int d = 0; d < 3; ++d) along[e] += inverse[3 * e + d] * Vector4{cof_F[d], cof_F[3 + d], cof_F[6 + d], 0};
        along[e] *= factor * value * rule_weights_[q] * detJ_[c];
      }
      const PetscScalar *D = basis.derivatives + static_cast<PetscInt>(q) * 3 * basis.stride;
      for (PetscInt a = 0; a < basis.nodes; ++a)
        sum[a] += D[a] * along[0] + D[basis.stride + a] * along[1] + D[2 * basis.stride + a] * along[2];
    }
    for (PetscInt a = 0; a < basis.nodes; ++a)
      for (int i = 0; i < 3; ++i) ys[dofs[3 * a + i]] += sum[a][i];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
