// What a state of the lung measures: J at the points and corners of the cells, its extremes, its integral.
#include "pulmo/fem/assembly.hpp"

#include "pulmo/base/simd.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

/// Displacements of the nodes of a cell; the fourth entry is zero.
struct NodeDisplacements {
  Vector4 of[max_nodes];
  Vector4 &operator[](PetscInt a) { return of[a]; }
  const Vector4 &operator[](PetscInt a) const { return of[a]; }
};

static void gather_displacements(const PetscInt *dofs, PetscInt nodes, const PetscScalar *x, NodeDisplacements &u)
{
  for (PetscInt a = 0; a < nodes; ++a) u[a] = Vector4{x[dofs[3 * a]], x[dofs[3 * a + 1]], x[dofs[3 * a + 2]], 0};
}

/// Grad u at a sample point, with @p D the derivatives of the basis there, from the cell's displacements.
static void sample_gradient(const PetscReal *D, const PetscReal *inverse, PetscInt nodes, const NodeDisplacements &u,
                            PetscScalar H[9])
{
  Vector4 along[3] = {}; // the axes of the reference cell
  for (PetscInt a = 0; a < nodes; ++a)
    for (int g = 0; g < 3; ++g) along[g] += D[3 * a + g] * u[a];
  for (int d = 0; d < 3; ++d) {
    const Vector4 h = along[0] * inverse[d] + along[1] * inverse[3 + d] + along[2] * inverse[6 + d];
    for (int i = 0; i < 3; ++i) H[3 * i + d] = h[i];
  }
}

void Assembly::point_states(PetscInt c, const PetscScalar *x, std::vector<PointState> &states) const
{
  NodeDisplacements u;
  states.resize(sample_points_);
  gather_displacements(cell_dofs(c), nodes_, x, u);
  for (PetscInt q = 0; q < sample_points_; ++q) {
    PetscScalar H[9];
    sample_gradient(&sample_gradients_[q * nodes_ * 3], &invJ_[9 * c], nodes_, u, H);
    make_point_state(H, nullptr, states[q]);
  }
}

PetscErrorCode Assembly::measure(Vec x, Measures &measures) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  const auto n_rule = static_cast<PetscInt>(sample_weights_.size());
  struct {
    double value;
    int rank;
  } least{PETSC_MAX_REAL, 0}, winner;
  double volume = 0, extremes[2] = {-PETSC_MAX_REAL, -PETSC_MAX_REAL}; // max J, -(min J at points)
  PetscInt where = -1;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &least.rank));
  const ReadArray xs(x);
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    NodeDisplacements u;
    gather_displacements(cell_dofs(c), nodes_, xs.data(), u);
    double sum = 0;
    for (PetscInt q = 0; q < sample_points_; ++q) {
      PetscScalar H[9];
      sample_gradient(&sample_gradients_[q * nodes_ * 3], &invJ_[9 * c], nodes_, u, H);
      const double Jm1 = jacobian_minus_one(H), J = 1 + Jm1;
      extremes[0] = std::max(extremes[0], J);
      if (q < n_rule) {
        sum += sample_weights_[q] * Jm1;
        extremes[1] = std::max(extremes[1], std::isnan(J) ? PETSC_MAX_REAL : -J);
      }
      if (!(J >= least.value)) { // also taken when J is not a number
        least.value = std::isnan(J) ? -PETSC_MAX_REAL : J;
        where = c;
      }
    }
    volume += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPI_DOUBLE, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 2, MPI_DOUBLE, MPI_MAX, comm));
  PetscCallMPI(MPI_Allreduce(&least, &winner, 1, MPI_DOUBLE_INT, MPI_MINLOC, comm));
  measures.volume_change = volume;
  measures.max_J = extremes[0];
  measures.min_J_points = -extremes[1];
  measures.min_J = winner.value;
  measures.rank = winner.rank;
  measures.cell = where;
  if (winner.rank == least.rank && where >= 0)
    for (int d = 0; d < 3; ++d) // reference coordinates of the centroid are -1/2
      measures.where[d] =
          v0_[3 * where + d] + (J_[9 * where + 3 * d] + J_[9 * where + 3 * d + 1] + J_[9 * where + 3 * d + 2]) / 2;
  PetscCallMPI(MPI_Bcast(measures.where, 3, MPIU_REAL, winner.rank, comm));
  PetscCallMPI(MPI_Bcast(&measures.cell, 1, MPIU_INT, winner.rank, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Assembly::volume_derivative(Vec x, Vec y, PetscReal &derivative) const
{
  PetscFunctionBeginUser;
  const ReadArray xs(x), ys(y);
  derivative = 0;
  for (PetscInt c = 0; c < layout_.cells; ++c) {
    NodeDisplacements u, v;
    gather_displacements(cell_dofs(c), nodes_, xs.data(), u);
    gather_displacements(cell_dofs(c), nodes_, ys.data(), v);
    PetscReal sum = 0;
    for (std::size_t q = 0; q < sample_weights_.size(); ++q) {
      PetscScalar H[9], G[9], cof_F[9];
      const PetscReal *gradients = &sample_gradients_[q * nodes_ * 3];
      sample_gradient(gradients, &invJ_[9 * c], nodes_, u, H);
      sample_gradient(gradients, &invJ_[9 * c], nodes_, v, G);
      for (int i = 0; i < 3; ++i) H[4 * i] += 1;
      cofactor(H, cof_F);
      sum += sample_weights_[q] * contract(cof_F, G);
    }
    derivative += sum * detJ_[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &derivative, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)dm_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
