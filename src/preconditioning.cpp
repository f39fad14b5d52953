#include "pulmo/preconditioning.hpp"

#include "pulmo/mesh.hpp"
#include "pulmo/pattern.hpp"
#include "pulmo/point.hpp"
#include "pulmo/single_blocks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <petsc/private/pcimpl.h>

namespace pulmo {

namespace {

/// Global number of each free dof of field @p f at a point, -1 for a constrained one. Also for ghosts.
PetscErrorCode free_dofs(PetscSection section, PetscSection global, PetscInt point, PetscInt f, PetscInt dofs[3],
                         PetscInt &n, bool &owned)
{
  PetscInt offset, field_offset, first, constrained;
  const PetscInt *which = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscSectionGetFieldDof(section, point, f, &n));
  if (n == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscSectionGetOffset(section, point, &offset));
  PetscCall(PetscSectionGetFieldOffset(section, point, f, &field_offset));
  PetscCall(PetscSectionGetOffset(global, point, &first));
  owned = first >= 0;
  if (!owned) first = -(first + 1);
  PetscCall(PetscSectionGetConstraintDof(section, point, &constrained));
  if (constrained) PetscCall(PetscSectionGetConstraintIndices(section, point, &which));
  for (PetscInt d = 0; d < n; ++d) {
    const PetscInt local = field_offset - offset + d; // among the dofs of the point
    const auto before = std::count_if(which, which + constrained, [&](PetscInt c) { return c < local; });
    const bool held = std::find(which, which + constrained, local) != which + constrained;
    dofs[d] = held ? -1 : first + local - static_cast<PetscInt>(before);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Three translations and three rotations as vectors of the layout @p section, @p global.
PetscErrorCode rigid_body_modes(DM dm, PetscSection section, PetscSection global, PetscInt f, MatNullSpace *modes)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt begin, end, size;
  Vec v[6];

  PetscFunctionBeginUser;
  PetscCall(PetscSectionGetConstrainedStorageSize(global, &size));
  for (Vec &mode : v) PetscCall(VecCreateMPI(comm, size, PETSC_DETERMINE, &mode));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt dofs[3], n;
    PetscReal x[3];
    bool owned = false;
    PetscCall(free_dofs(section, global, p, f, dofs, n, owned));
    if (n != 3 || !owned) continue;
    PetscCall(node_coordinates(dm, p, x));
    for (PetscInt d = 0; d < 3; ++d) {
      const PetscInt next = (d + 1) % 3, last = (d + 2) % 3; // rotation about axis k moves along k+1 by -x[k+2], ...
      if (dofs[d] < 0) continue;
      PetscCall(VecSetValue(v[d], dofs[d], 1, INSERT_VALUES));
      PetscCall(VecSetValue(v[3 + last], dofs[d], -x[next], INSERT_VALUES));
      PetscCall(VecSetValue(v[3 + next], dofs[d], x[last], INSERT_VALUES));
    }
  }
  for (Vec mode : v) {
    PetscCall(VecAssemblyBegin(mode));
    PetscCall(VecAssemblyEnd(mode));
  }
  // orthonormal, as MatNullSpace wants them
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j < i; ++j) {
      PetscScalar dot;
      PetscCall(VecDot(v[i], v[j], &dot));
      PetscCall(VecAXPY(v[i], -dot, v[j]));
    }
    PetscCall(VecNormalize(v[i], nullptr));
  }
  PetscCall(MatNullSpaceCreate(comm, PETSC_FALSE, 6, v, modes));
  for (Vec &mode : v) PetscCall(VecDestroy(&mode));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode make_modes(DM dm, PetscInt, PetscInt field, MatNullSpace *modes)
{
  PetscSection section, global;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMGetGlobalSection(dm, &global));
  PetscCall(rigid_body_modes(dm, section, global, field, modes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

// ------------------------------------------------------------------------------------------------- p-multigrid

struct PMultigrid {
  PC mg = nullptr;
  Mat interpolation = nullptr, coarse = nullptr;
  Mat single = nullptr; ///< P2 in single precision, if so asked for
  PetscBool use_single = PETSC_FALSE;
};

/// The interpolation from P1 to the P2 displacement of @p dm, and the rigid-body modes of P1.
PetscErrorCode make_interpolation(DM dm, PetscInt block_size, Mat *P, MatNullSpace *modes)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscSection fine, fine_global;
  SectionHandle coarse, coarse_global;
  PetscSF sf;
  PetscInt begin, end, vertex_begin, vertex_end, rows, columns;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &fine));
  PetscCall(DMGetGlobalSection(dm, &fine_global));
  PetscCall(PetscSectionGetChart(fine, &begin, &end));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  PetscCall(PetscSectionCreate(comm, coarse.out()));
  PetscCall(PetscSectionSetNumFields(coarse, 1));
  PetscCall(PetscSectionSetFieldComponents(coarse, 0, 3));
  PetscCall(PetscSectionSetChart(coarse, begin, end));
  for (PetscInt p = vertex_begin; p < vertex_end; ++p) {
    PetscInt n;
    PetscCall(PetscSectionSetDof(coarse, p, 3));
    PetscCall(PetscSectionSetFieldDof(coarse, p, 0, 3));
    PetscCall(PetscSectionGetFieldConstraintDof(fine, p, displacement, &n));
    PetscCall(PetscSectionSetConstraintDof(coarse, p, n));
    PetscCall(PetscSectionSetFieldConstraintDof(coarse, p, 0, n));
  }
  PetscCall(PetscSectionSetUp(coarse));
  for (PetscInt p = vertex_begin; p < vertex_end; ++p) {
    PetscInt n;
    const PetscInt *which;
    PetscCall(PetscSectionGetFieldConstraintDof(fine, p, displacement, &n));
    if (n == 0) continue;
    PetscCall(PetscSectionGetFieldConstraintIndices(fine, p, displacement, &which));
    PetscCall(PetscSectionSetConstraintIndices(coarse, p, which));
    PetscCall(PetscSectionSetFieldConstraintIndices(coarse, p, 0, which));
  }
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSectionCreateGlobalSection(coarse, sf, PETSC_FALSE, PETSC_FALSE, coarse_global.out()));
  PetscCall(PetscSectionGetConstrainedStorageSize(fine_global, &rows));
  PetscCall(PetscSectionGetConstrainedStorageSize(coarse_global, &columns));

  PetscCall(MatCreate(comm, P));
  PetscCall(MatSetSizes(*P, rows, columns, PETSC_DETERMINE, PETSC_DETERMINE));
  if (block_size == 3) PetscCall(MatSetBlockSizes(*P, 3, 3)); // no node is held in part
  PetscCall(MatSetType(*P, MATAIJ));
  PetscCall(MatSeqAIJSetPreallocation(*P, 2, nullptr));
  PetscCall(MatMPIAIJSetPreallocation(*P, 2, nullptr, 2, nullptr));
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt row[3], n;
    bool owned = false;
    PetscCall(free_dofs(fine, fine_global, p, displacement, row, n, owned));
    if (n != 3 || !owned) continue;
    const PetscInt *ends = &p;
    PetscInt n_ends = 1;
    if (p < vertex_begin || p >= vertex_end) {
      PetscCall(DMPlexGetCone(dm, p, &ends));
      PetscCall(DMPlexGetConeSize(dm, p, &n_ends));
      PetscCheck(n_ends == 2, comm, PETSC_ERR_SUP, "p_multigrid is for P2 displacement on tetrahedra");
    }
    for (PetscInt e = 0; e < n_ends; ++e) {
      PetscInt column[3];
      bool unused;
      PetscCall(free_dofs(coarse, coarse_global, ends[e], 0, column, n, unused));
      for (PetscInt d = 0; d < 3; ++d)
        if (row[d] >= 0 && column[d] >= 0) PetscCall(MatSetValue(*P, row[d], column[d], 1. / n_ends, INSERT_VALUES));
    }
  }
  PetscCall(MatAssemblyBegin(*P, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(*P, MAT_FINAL_ASSEMBLY));
  PetscCall(rigid_body_modes(dm, coarse, coarse_global, 0, modes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode setup_p_multigrid(PC pc)
{
  auto *self = static_cast<PMultigrid *>(pc->data);
  const MPI_Comm comm = PetscObjectComm((PetscObject)pc);
  Mat A, B;
  KSP coarse, smoother;
  PetscInt block_size;

  PetscFunctionBeginUser;
  PetscCall(PCGetOperators(pc, &A, &B));
  PetscCall(MatGetBlockSize(B, &block_size));
  if (!self->mg) {
    DM dm;
    PetscInt n_fields = 0, rows, fine_rows;
    PetscSection global = nullptr;
    const char *prefix;
    MatNullSpace modes;
    PetscCall(PCGetDM(pc, &dm));
    if (dm) {
      PetscCall(DMGetNumFields(dm, &n_fields));
      PetscCall(DMGetGlobalSection(dm, &global));
    }
    PulmoUserCheck(n_fields == 1, comm,
                   "-pc_type p_multigrid preconditions the displacement: give it to -fieldsplit_displacement_pc_type");
    PetscCall(MatGetLocalSize(B, &rows, nullptr));
    PetscCall(PetscSectionGetConstrainedStorageSize(global, &fine_rows));
    PetscCheck(rows == fine_rows, comm, PETSC_ERR_ARG_SIZ, "p_multigrid: the matrix is not that of the displacement");
    PetscCall(make_interpolation(dm, block_size, &self->interpolation, &modes));
    PetscCall(MatPtAP(B, self->interpolation, MAT_INITIAL_MATRIX, 1, &self->coarse));
    PetscCall(MatSetNearNullSpace(self->coarse, modes));
    PetscCall(MatNullSpaceDestroy(&modes));
    PetscCall(PCCreate(comm, &self->mg));
    PetscCall(PetscObjectIncrementTabLevel((PetscObject)self->mg, (PetscObject)pc, 1));
    PetscCall(PCSetType(self->mg, PCMG));
    PetscCall(PCGetOptionsPrefix(pc, &prefix));
    PetscCall(PCSetOptionsPrefix(self->mg, prefix));
    PetscCall(PCAppendOptionsPrefix(self->mg, "p"));
    PetscCall(PCMGSetLevels(self->mg, 2, nullptr));
    PetscCall(PCMGSetInterpolation(self->mg, 1, self->interpolation));
    PetscCall(PCSetFromOptions(self->mg));
  } else {
    PetscCall(MatPtAP(B, self->interpolation, MAT_REUSE_MATRIX, 1, &self->coarse));
  }
  PetscCall(PCMGGetCoarseSolve(self->mg, &coarse));
  PetscCall(KSPSetOperators(coarse, self->coarse, self->coarse));
  PetscCall(PCMGGetSmoother(self->mg, 1, &smoother));
  if (self->single) {
    PetscCall(update_single_blocks(self->single, B));
  } else if (self->use_single && block_size == 3) {
    PC smooth;
    PetscBool fits;
    PetscCall(KSPSetFromOptions(smoother));
    PetscCall(KSPGetPC(smoother, &smooth));
    PetscCall(PetscObjectTypeCompareAny((PetscObject)smooth, &fits, PCSOR, PCJACOBI, PCNONE, ""));
    PulmoUserCheck(fits, comm,
                   "-pmg_single smooths by sor, jacobi or none: change -fieldsplit_displacement_pmg_levels_pc_type or "
                   "add -fieldsplit_displacement_pmg_single off");
    PetscCall(create_single_blocks(B, &self->single));
  }
  if (self->single) A = B = self->single;
  PetscCall(KSPSetOperators(smoother, A, B));
  PetscCall(PCSetOperators(self->mg, A, B));
  PetscCall(PCSetUp(self->mg));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode apply_p_multigrid(PC pc, Vec x, Vec y)
{
  PetscFunctionBeginUser;
  PetscCall(PCApply(static_cast<PMultigrid *>(pc->data)->mg, x, y));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode reset_p_multigrid(PC pc)
{
  auto *self = static_cast<PMultigrid *>(pc->data);

  PetscFunctionBeginUser;
  PetscCall(PCDestroy(&self->mg));
  PetscCall(MatDestroy(&self->interpolation));
  PetscCall(MatDestroy(&self->coarse));
  PetscCall(MatDestroy(&self->single));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode destroy_p_multigrid(PC pc)
{
  PetscFunctionBeginUser;
  PetscCall(reset_p_multigrid(pc));
  delete static_cast<PMultigrid *>(pc->data);
  pc->data = nullptr;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode p_multigrid_options(PC pc, PetscOptionItems *PetscOptionsObject)
{
  auto *self = static_cast<PMultigrid *>(pc->data);

  PetscFunctionBeginUser;
  PetscOptionsHeadBegin(PetscOptionsObject, "p-multigrid");
  PetscCall(PetscOptionsBool("-pmg_single", "keep the P2 matrix in single precision for the smoother", "",
                             self->use_single, &self->use_single, nullptr));
  PetscOptionsHeadEnd();
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode view_p_multigrid(PC pc, PetscViewer viewer)
{
  PetscFunctionBeginUser;
  const bool single = static_cast<PMultigrid *>(pc->data)->single;
  PetscCall(PetscViewerASCIIPrintf(viewer, "  P2 displacement above P1%s\n", single ? ", P2 in single precision" : ""));
  if (auto *mg = static_cast<PMultigrid *>(pc->data)->mg) PetscCall(PCView(mg, viewer));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_p_multigrid(PC pc)
{
  PetscFunctionBeginUser;
  pc->data = new PMultigrid;
  pc->ops->setup = setup_p_multigrid;
  pc->ops->apply = apply_p_multigrid;
  pc->ops->reset = reset_p_multigrid;
  pc->ops->destroy = destroy_p_multigrid;
  pc->ops->setfromoptions = p_multigrid_options;
  pc->ops->view = view_p_multigrid;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode register_p_multigrid()
{
  PetscFunctionBeginUser;
  PetscCall(PCRegister("p_multigrid", create_p_multigrid));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode attach_rigid_body_modes(DM dm)
{
  const PetscInt field = displacement;
  PetscInt n_fields;

  PetscFunctionBeginUser;
  PetscCall(DMGetNumFields(dm, &n_fields));
  if (n_fields == 1) {
    PetscCall(DMSetNearNullSpaceConstructor(dm, displacement, make_modes));
  } else { // a split takes them from the discretisation of its field
    DMHandle sub;
    PetscObject element;
    MatNullSpace modes;
    PetscCall(DMCreateSubDM(dm, 1, &field, nullptr, sub.out()));
    PetscCall(make_modes(sub, field, 0, &modes));
    PetscCall(DMGetField(dm, field, nullptr, &element));
    PetscCall(PetscObjectCompose(element, "nearnullspace", (PetscObject)modes));
    PetscCall(MatNullSpaceDestroy(&modes));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

// ------------------------------------------------------------------------------------------------ fixed stress

PetscErrorCode FixedStress::setup(DM dm)
{
  const PetscInt field = pressure;
  PetscSection section, global;
  DMHandle sub;
  ISHandle is;
  PetscInt begin, end, cell_begin, cell_end;

  PetscFunctionBeginUser;
  dm_ = dm;
  PetscCall(DMCreateSubDM(dm, 1, &field, is.out(), sub.out()));
  PetscCall(create_matrix(sub, matrix_.out()));
  PetscCall(DMGetLocalSection(sub, &section));
  PetscCall(DMGetGlobalSection(sub, &global));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  point_row_.assign(end, -1);
  std::vector<PetscInt> row(end, -1);
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt dofs[3] = {-1, -1, -1}, n;
    bool owned = false;
    PetscCall(free_dofs(section, global, p, 0, dofs, n, owned));
    if (n == 0) continue;
    row[p] = dofs[0];
    if (owned) point_row_[p] = dofs[0];
  }
  PetscCall(DMGetLocalSection(dm, &section));
  std::vector<PetscReal> x(static_cast<std::size_t>(3 * end), PETSC_MAX_REAL); // of the nodes of the displacement
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt dof;
    PetscCall(PetscSectionGetFieldDof(section, p, displacement, &dof));
    if (dof == 3) PetscCall(node_coordinates(dm, p, &x[3 * p]));
  }
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  rows_.reserve(vertices_ * (cell_end - cell_begin));
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n_closure;
    PetscReal middle[3] = {0, 0, 0};
    const std::size_t first = position_.size();
    PetscCall(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n_closure, &closure));
    for (PetscInt i = 0; i < n_closure; ++i) {
      const PetscReal *node = &x[3 * closure[2 * i]];
      if (node[0] != PETSC_MAX_REAL) position_.insert(position_.end(), node, node + 3);
    }
    for (PetscInt i = n_closure - vertices_; i < n_closure; ++i) rows_.push_back(row[closure[2 * i]]); // come last
    PetscCall(DMPlexRestoreTransitiveClosure(dm, c, PETSC_TRUE, &n_closure, &closure));
    nodes_ = static_cast<PetscInt>(position_.size() - first) / 3;
    if (c == cell_begin) position_.reserve(3 * nodes_ * (cell_end - cell_begin));
    for (std::size_t i = first; i < position_.size(); ++i) middle[(i - first) % 3] += position_[i] / (PetscReal)nodes_;
    for (std::size_t i = first; i < position_.size(); ++i) position_[i] -= middle[(i - first) % 3];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FixedStress::begin()
{
  PetscFunctionBeginUser;
  PetscCall(MatZeroEntries(matrix_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FixedStress::add(PetscInt c, const PetscScalar *matrix, const PetscReal row_scale[])
{
  const PetscInt nu = 3 * nodes_, size = nu + vertices_;
  const PetscReal *w = &position_[c * nu];
  PetscScalar stiffness = 0, storage = 0, load = 0, S[16];

  PetscFunctionBeginHot;
  for (PetscInt i = 0; i < size; ++i) {
    const PetscScalar *row = matrix + i * size;
    PetscScalar along = 0; // of this row in direction w
    for (PetscInt j = 0; j < nu; ++j) along += row[j] * w[j];
    if (i >= nu) {
      storage += along * row_scale[pressure];
    } else {
      stiffness += w[i] * along * row_scale[displacement];
      for (PetscInt j = nu; j < size; ++j) load += w[i] * row[j] * row_scale[displacement];
    }
  }
  // S - A_pp is positive where the tissue stands a dilation; elsewhere (softening) nothing is added
  const PetscScalar c_e = stiffness > 0 ? -storage * load / stiffness : 0;
  for (PetscInt a = 0; a < vertices_; ++a)
    for (PetscInt b = 0; b < vertices_; ++b)
      S[vertices_ * a + b] =
          row_scale[pressure] * matrix[(nu + a) * size + nu + b] + (c_e > 0 ? c_e * (a == b ? 2 : 1) / 20 : 0);
  PetscCall(MatSetValues(matrix_, vertices_, &rows_[vertices_ * c], vertices_, &rows_[vertices_ * c], S, ADD_VALUES));
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
