/// @file
/// Values of a computed state at points of the cells, through PETSc's tabulations: nothing of pulmo's own integrator.
#pragma once

#include "pulmo/physics/point.hpp"

#include <functional>
#include <vector>

namespace pulmo::test {

/// The fields at one point of one cell.
struct Sample {
  PetscReal x[3];                           ///< mm
  PetscReal weight;                         ///< of the quadrature, mm^3
  PetscScalar u[3], grad_u[9];              ///< mm, - (row by row)
  PetscScalar p = 0, grad_p[3] = {0, 0, 0}; ///< kPa, kPa/mm

  PetscScalar J() const
  {
    const PetscScalar *H = grad_u;
    const PetscScalar F[9] = {1 + H[0], H[1], H[2], H[3], 1 + H[4], H[5], H[6], H[7], 1 + H[8]};
    return F[0] * (F[4] * F[8] - F[5] * F[7]) - F[1] * (F[3] * F[8] - F[5] * F[6]) + F[2] * (F[3] * F[7] - F[4] * F[6]);
  }
};

/// Calls @p visit for points @p reference (in PETSc's reference tetrahedron [-1, 1], three numbers each) of every cell.
inline PetscErrorCode sample_cells(DM dm, Vec local, const std::vector<PetscReal> &reference,
                                   const std::vector<PetscReal> &weights,
                                   const std::function<void(const Sample &)> &visit)
{
  const auto n_points = static_cast<PetscInt>(reference.size() / 3);
  PetscInt begin, end, n_fields;
  PetscFE fe[2] = {nullptr, nullptr};
  PetscTabulation table[2] = {nullptr, nullptr};

  PetscFunctionBeginUser;
  PetscCall(DMGetNumFields(dm, &n_fields));
  for (PetscInt f = 0; f < std::min<PetscInt>(n_fields, 2); ++f) {
    PetscCall(DMGetField(dm, f, nullptr, (PetscObject *)&fe[f]));
    PetscCall(PetscFECreateTabulation(fe[f], 1, n_points, reference.data(), 1, &table[f]));
  }
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    PetscReal v0[3], jacobian[9], inverse[9], det;
    PetscInt size = 0;
    PetscScalar *values = nullptr;
    PetscCall(DMPlexComputeCellGeometryAffineFEM(dm, c, v0, jacobian, inverse, &det));
    PetscCall(DMPlexVecGetClosure(dm, nullptr, local, c, &size, &values));
    for (PetscInt q = 0; q < n_points; ++q) {
      Sample s{};
      const PetscReal *xi = &reference[3 * q];
      for (int i = 0; i < 3; ++i) {
        s.x[i] = v0[i];
        for (int j = 0; j < 3; ++j) s.x[i] += jacobian[3 * i + j] * (xi[j] + 1);
      }
      s.weight = weights.empty() ? 0 : weights[q] * det;
      const PetscScalar *coefficient = values;
      for (int f = 0; f < 2 && table[f]; ++f) {
        const PetscInt nb = table[f]->Nb, nc = table[f]->Nc;
        for (PetscInt b = 0; b < nb; ++b)
          for (PetscInt k = 0; k < nc; ++k) {
            const PetscReal phi = table[f]->T[0][(q * nb + b) * nc + k],
                            *dphi = &table[f]->T[1][((q * nb + b) * nc + k) * 3];
            (f == 0 ? s.u[k] : s.p) += coefficient[b] * phi;
            for (int i = 0; i < 3; ++i)
              (f == 0 ? s.grad_u[3 * k + i] : s.grad_p[i]) +=
                  coefficient[b] * (dphi[0] * inverse[i] + dphi[1] * inverse[3 + i] + dphi[2] * inverse[6 + i]);
          }
        coefficient += nb;
      }
      visit(s);
    }
    PetscCall(DMPlexVecRestoreClosure(dm, nullptr, local, c, &size, &values));
  }
  for (auto &t : table)
    if (t) PetscCall(PetscTabulationDestroy(&t));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// At the points of a rule of @p degree.
inline PetscErrorCode sample_rule(DM dm, Vec local, PetscInt degree, const std::function<void(const Sample &)> &visit)
{
  QuadratureHandle rule;
  PetscInt n;
  const PetscReal *points, *weights;

  PetscFunctionBeginUser;
  PetscCall(PetscDTStroudConicalQuadrature(3, 1, degree / 2 + 1, -1, 1, rule.out()));
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &n, &points, &weights));
  PetscCall(sample_cells(dm, local, std::vector<PetscReal>(points, points + 3 * n),
                         std::vector<PetscReal>(weights, weights + n), visit));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// At the corners of every cell (a vertex is visited once for each of its cells).
inline PetscErrorCode sample_corners(DM dm, Vec local, const std::function<void(const Sample &)> &visit)
{
  PetscFunctionBeginUser;
  PetscCall(sample_cells(dm, local, {-1, -1, -1, 1, -1, -1, -1, 1, -1, -1, -1, 1}, {}, visit));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
