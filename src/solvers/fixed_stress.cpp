#include "pulmo/solvers/fixed_stress.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/fem/free_dofs.hpp"
#include "pulmo/fem/pattern.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/physics/point.hpp"

#include <algorithm>
#include <array>
#include <numeric>

namespace pulmo {

PetscErrorCode FixedStress::setup(DM dm, const Assembly &assembly)
{
  const PetscInt field = pressure;
  PetscSection section, global;
  DMHandle sub;
  ISHandle is;
  PetscDS ds;
  PetscInt begin, end, size, *element_sizes;

  PetscFunctionBeginUser;
  PetscCall(DMGetDS(dm, &ds));
  PetscCall(PetscDSGetDimensions(ds, &element_sizes));
  n_u_ = element_sizes[displacement];
  n_p_ = element_sizes[pressure];
  PetscCheck(n_p_ <= max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d nodes", max_nodes);
  PetscCall(make_mass_matrix(ds));
  PetscCall(DMCreateSubDM(dm, 1, &field, is.out(), sub.out()));
  PetscCall(create_matrix(sub, matrix_.out()));
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMGetGlobalSection(sub, &global));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  PetscCall(PetscSectionGetStorageSize(section, &size));
  PetscSection alone; // of the pressure
  PetscCall(DMGetLocalSection(sub, &alone));
  point_row_.assign(end, -1);
  std::vector<PetscInt> row(size, -1), dofs; // [local dof]
  std::vector<PetscReal> x(size, 0);         // [local dof]: the node's coordinate in its direction
  std::vector<std::array<PetscReal, 3>> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt n, offset;
    bool owned = false;
    PetscCall(PetscSectionGetFieldDof(section, p, displacement, &n));
    PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
    PetscCall(node_coordinates(dm, p, n / 3, nodes));
    for (PetscInt i = 0; i < n; ++i) x[offset + i] = nodes[i / 3][i % 3];
    PetscCall(free_dofs(alone, global, p, 0, dofs, owned));
    if (dofs.empty()) continue;
    PetscCheck(dofs.size() == 1, PETSC_COMM_SELF, PETSC_ERR_SUP, "several nodes of the pressure at a mesh point");
    PetscCall(PetscSectionGetFieldOffset(section, p, pressure, &offset));
    row[offset] = dofs[0];
    if (owned) point_row_[p] = dofs[0];
  }
  position_.reserve(n_u_ * assembly.cells());
  rows_.reserve(n_p_ * assembly.cells());
  for (PetscInt c = 0; c < assembly.cells(); ++c) {
    const PetscInt *of_cell = assembly.cell_dofs(c);
    PetscReal middle[3] = {0, 0, 0};
    for (PetscInt i = 0; i < n_u_; ++i) middle[i % 3] += 3 * x[of_cell[i]] / static_cast<PetscReal>(n_u_);
    for (PetscInt i = 0; i < n_u_; ++i) position_.push_back(x[of_cell[i]] - middle[i % 3]);
    for (PetscInt a = 0; a < n_p_; ++a) rows_.push_back(row[of_cell[n_u_ + a]]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Of the pressure's basis functions on a cell of volume 1.
PetscErrorCode FixedStress::make_mass_matrix(PetscDS ds)
{
  PetscFE fe;
  PetscInt n;
  const PetscReal *xi, *weights;
  QuadratureHandle rule;
  PetscTabulation T;

  PetscFunctionBeginUser;
  PetscCall(PetscDTSimplexQuadrature(3, 4, PETSCDTSIMPLEXQUAD_MINSYM, rule.out())); // exact up to P2 times P2
  PetscCall(PetscQuadratureGetData(rule, nullptr, nullptr, &n, &xi, &weights));
  const PetscReal total = std::accumulate(weights, weights + n, PetscReal(0));
  PetscCall(PetscDSGetDiscretization(ds, pressure, (PetscObject *)&fe));
  PetscCall(PetscFECreateTabulation(fe, 1, n, xi, 0, &T));
  mass_.assign(n_p_ * n_p_, 0);
  for (PetscInt q = 0; q < n; ++q)
    for (PetscInt a = 0; a < n_p_; ++a)
      for (PetscInt b = 0; b < n_p_; ++b)
        mass_[n_p_ * a + b] += weights[q] / total * T->T[0][q * n_p_ + a] * T->T[0][q * n_p_ + b];
  PetscCall(PetscTabulationDestroy(&T));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FixedStress::begin()
{
  PetscFunctionBeginUser;
  PetscCall(MatZeroEntries(matrix_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FixedStress::add(PetscInt c, ElementOf what, const PetscScalar *matrix, const PetscReal row_scale[],
                                bool)
{
  const PetscInt nu = n_u_, size = nu + n_p_;
  const PetscReal *w = &position_[c * nu];
  PetscScalar bulk = 0, wave = 0, storage = 0, load = 0, S[max_nodes * max_nodes];

  PetscFunctionBeginHot;
  if (what == ElementOf::facet) PetscFunctionReturn(PETSC_SUCCESS);
  for (PetscInt i = 0; i < size; ++i) {
    const PetscScalar *row = matrix + i * size;
    PetscScalar along[3] = {0, 0, 0}; // of this row in direction w, by components of w
    for (PetscInt j = 0; j < nu; j += 3)
      for (PetscInt d = 0; d < 3; ++d) along[d] += row[j + d] * w[j + d];
    const PetscScalar all = along[0] + along[1] + along[2];
    if (i >= nu) {
      storage += all * row_scale[pressure];
    } else {
      bulk += w[i] * all * row_scale[displacement];
      wave += 3 * w[i] * along[i % 3] * row_scale[displacement];
      for (PetscInt j = nu; j < size; ++j) load += w[i] * row[j] * row_scale[displacement];
    }
  }
  // K may vanish or be negative where the tissue softens; M is positive as long as the tissue is elliptic
  const PetscScalar stiffness = std::max((3 * bulk + 2 * wave) / 5, wave / 4);
  const PetscScalar c_e = stiffness > 0 ? -storage * load / stiffness : 0;
  for (PetscInt a = 0; a < n_p_; ++a)
    for (PetscInt b = 0; b < n_p_; ++b)
      S[n_p_ * a + b] =
          row_scale[pressure] * matrix[(nu + a) * size + nu + b] + (c_e > 0 ? c_e * mass_[n_p_ * a + b] : 0);
  PetscCall(MatSetValues(matrix_, n_p_, &rows_[n_p_ * c], n_p_, &rows_[n_p_ * c], S, ADD_VALUES));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FixedStress::end(const std::vector<PetscInt> &closed)
{
  std::vector<PetscInt> rows;

  PetscFunctionBeginUser;
  for (const PetscInt p : closed)
    if (point_row_[p] >= 0) rows.push_back(point_row_[p]);
  PetscCall(MatAssemblyBegin(matrix_, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(matrix_, MAT_FINAL_ASSEMBLY));
  PetscCall(MatZeroRowsColumns(matrix_, (PetscInt)rows.size(), rows.data(), 1, nullptr, nullptr));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
