#include "pulmo/solvers/preconditioning.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/fem/pattern.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/physics/point.hpp"
#include "pulmo/solvers/single_blocks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <petsc/private/pcimpl.h>

namespace pulmo {

namespace {

/// Global number of each free dof of field @p f at a point, -1 for a constrained one. Also for ghosts.
PetscErrorCode free_dofs(PetscSection section, PetscSection global, PetscInt point, PetscInt f,
                         std::vector<PetscInt> &dofs, bool &owned)
{
  PetscInt n, offset, field_offset, first, constrained;
  const PetscInt *which = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscSectionGetFieldDof(section, point, f, &n));
  dofs.resize(static_cast<std::size_t>(n));
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
  std::vector<PetscInt> dofs;
  std::vector<std::array<PetscReal, 3>> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    bool owned = false;
    PetscCall(free_dofs(section, global, p, f, dofs, owned));
    if (!owned) continue;
    PetscCall(node_coordinates(dm, p, static_cast<PetscInt>(dofs.size()) / 3, nodes));
    for (std::size_t i = 0; i < dofs.size(); ++i) {
      const std::size_t d = i % 3, next = (d + 1) % 3, last = (d + 2) % 3;
      const auto &x = nodes[i / 3];
      if (dofs[i] < 0) continue;
      PetscCall(VecSetValue(v[d], dofs[i], 1, INSERT_VALUES)); // rotation about axis k moves along k+1 by -x[k+2], ...
      PetscCall(VecSetValue(v[3 + last], dofs[i], -x[next], INSERT_VALUES));
      PetscCall(VecSetValue(v[3 + next], dofs[i], x[last], INSERT_VALUES));
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
  Mat single = nullptr; ///< the matrix in single precision, if so asked for
  PetscBool use_single = PETSC_FALSE;
};

/// The interpolation from P1 to the displacement of @p dm, and the rigid-body modes of P1.
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
  PetscCall(compat::create_global_section(coarse, sf, coarse_global.out()));
  PetscCall(PetscSectionGetConstrainedStorageSize(fine_global, &rows));
  PetscCall(PetscSectionGetConstrainedStorageSize(coarse_global, &columns));

  PetscCall(MatCreate(comm, P));
  PetscCall(MatSetSizes(*P, rows, columns, PETSC_DETERMINE, PETSC_DETERMINE));
  if (block_size == 3) PetscCall(MatSetBlockSizes(*P, 3, 3)); // no node is held in part
  PetscCall(MatSetType(*P, MATAIJ));
  PetscCall(MatSeqAIJSetPreallocation(*P, 3, nullptr));
  PetscCall(MatMPIAIJSetPreallocation(*P, 3, nullptr, 3, nullptr));
  std::vector<PetscInt> row, column;
  std::vector<ElementNode> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    bool owned = false, unused;
    PetscCall(free_dofs(fine, fine_global, p, displacement, row, owned));
    if (!owned) continue;
    PetscCall(nodes_at(dm, p, static_cast<PetscInt>(row.size()) / 3, nodes));
    for (std::size_t k = 0; k < nodes.size(); ++k)
      for (PetscInt i = 0; i < nodes[k].n; ++i) {
        PetscCall(free_dofs(coarse, coarse_global, nodes[k].vertices[i], 0, column, unused));
        for (std::size_t d = 0; d < 3; ++d)
          if (row[3 * k + d] >= 0 && column[d] >= 0)
            PetscCall(MatSetValue(*P, row[3 * k + d], column[d], nodes[k].weights[i], INSERT_VALUES));
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

PetscErrorCode p_multigrid_options(PC pc, compat::OptionItems PetscOptionsObject)
{
  auto *self = static_cast<PMultigrid *>(pc->data);

  PetscFunctionBeginUser;
  PetscOptionsHeadBegin(PetscOptionsObject, "p-multigrid");
  PetscCall(PetscOptionsBool("-pmg_single", "keep the displacement's matrix in single precision for the smoother", "",
                             self->use_single, &self->use_single, nullptr));
  PetscOptionsHeadEnd();
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode view_p_multigrid(PC pc, PetscViewer viewer)
{
  PetscFunctionBeginUser;
  const bool single = static_cast<PMultigrid *>(pc->data)->single;
  PetscCall(PetscViewerASCIIPrintf(viewer, "  displacement above its P1 interpolant%s\n",
                                   single ? ", in single precision" : ""));
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

PetscErrorCode wanted_pc(MPI_Comm comm, std::string &type)
{
  char text[64] = "";
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-pc_type", text, sizeof(text), &given));
  PulmoUserCheck(
      given, comm,
      "no linear solver: give a solver file, e.g. -options_file petsc_options/solvers/direct.opts (or -pc_type)");
  type = text;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode precondition_one_field(KSP ksp)
{
  std::string type;
  PC pc;

  PetscFunctionBeginUser;
  PetscCall(wanted_pc(PetscObjectComm((PetscObject)ksp), type));
  if (type != PCFIELDSPLIT) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(KSPGetPC(ksp, &pc));
  PetscCall(PCSetOptionsPrefix(pc, "fieldsplit_displacement_"));
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

PetscErrorCode FixedStress::add(PetscInt c, const PetscScalar *matrix, const PetscReal row_scale[])
{
  const PetscInt nu = n_u_, size = nu + n_p_;
  const PetscReal *w = &position_[c * nu];
  PetscScalar bulk = 0, wave = 0, storage = 0, load = 0, S[max_nodes * max_nodes];

  PetscFunctionBeginHot;
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
