#include "pulmo/solvers/p_multigrid.hpp"

#include "pulmo/input/errors.hpp"
#include "pulmo/solvers/displacement_block.hpp"
#include "pulmo/solvers/p1_space.hpp"
#include "pulmo/solvers/rigid_body_modes.hpp"
#include "pulmo/solvers/single_blocks.hpp"

#include <petsc/private/pcimpl.h>

#include <string>

namespace pulmo {

namespace {

struct PMultigrid {
  PC mg = nullptr;
  Mat interpolation = nullptr, coarse = nullptr;
  Mat single = nullptr; ///< the matrix in single precision, if so asked for
  PetscBool use_single = PETSC_FALSE, copy = PETSC_FALSE;
};

PetscErrorCode setup_p_multigrid(PC pc)
{
  auto *self = static_cast<PMultigrid *>(pc->data);
  const MPI_Comm comm = PetscObjectComm((PetscObject)pc);
  Mat A, B;
  KSP coarse, smoother;
  PetscInt block_size;
  DisplacementBlock *view = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PCGetOperators(pc, &A, &B));
  PetscCall(MatGetBlockSize(B, &block_size));
  PetscCall(DisplacementBlock::find(B, &view));
  if (!self->mg) {
    DM dm;
    DMHandle p1;
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
    PetscCall(create_p1_space(dm, p1.out()));
    PetscCall(create_p1_interpolation(dm, p1, block_size, &self->interpolation));
    if (view) {
      self->coarse = view->p1->matrix();
      PetscCall(PetscObjectReference((PetscObject)self->coarse));
    } else {
      PetscCall(MatPtAP(B, self->interpolation, MAT_INITIAL_MATRIX, 1, &self->coarse));
    }
    PetscCall(create_rigid_body_modes(p1, 0, &modes));
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
  } else if (!view) {
    PetscCall(MatPtAP(B, self->interpolation, MAT_REUSE_MATRIX, 1, &self->coarse));
  }
  PetscCall(PCMGGetCoarseSolve(self->mg, &coarse));
  PetscCall(KSPSetOperators(coarse, self->coarse, self->coarse));
  PetscCall(PCMGGetSmoother(self->mg, 1, &smoother));
  if (self->single) {
    PetscCall(update_single_blocks(self->single, view ? view->whole : B));
  } else if (self->use_single && block_size == 3) {
    PC smooth;
    PetscBool fits;
    PetscCall(KSPSetFromOptions(smoother));
    PetscCall(KSPGetPC(smoother, &smooth));
    PetscCall(PetscObjectTypeCompareAny((PetscObject)smooth, &fits, PCSOR, PCJACOBI, PCNONE, ""));
    PulmoUserCheck(fits, comm,
                   "-pmg_single smooths by sor, jacobi or none: change -fieldsplit_displacement_pmg_levels_pc_type or "
                   "add -fieldsplit_displacement_pmg_single off");
    PetscCall(create_single_blocks(view ? view->whole : B, view ? view->rows : nullptr, &self->single));
  }
  PetscCheck(self->single || !view, comm, PETSC_ERR_PLIB, "a view of the displacement without -pmg_single");
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
  PetscCall(
      PetscOptionsBool("-pmg_copy",
                       "copy the displacement's block out of the matrix and make that of P1 by a Galerkin product "
                       "(with -pmg_single neither is needed)",
                       "", self->copy, &self->copy, nullptr));
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

PetscErrorCode reads_in_place(const char *prefix, Mat A, bool &reads)
{
  const std::string begin = std::string("-") + prefix;
  char type[64] = "";
  PetscBool single = PETSC_FALSE, copy = PETSC_FALSE, aij;

  PetscFunctionBeginUser;
  reads = false;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, (begin + "pc_type").c_str(), type, sizeof(type), nullptr));
  if (std::string(type) != "p_multigrid") PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscObjectBaseTypeCompareAny((PetscObject)A, &aij, MATSEQAIJ, MATMPIAIJ, ""));
  PulmoUserCheck(aij, PetscObjectComm((PetscObject)A),
                 "%spc_type p_multigrid needs a matrix of type aij: leave -dm_mat_type out", begin.c_str());
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, (begin + "pmg_single").c_str(), &single, nullptr));
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, (begin + "pmg_copy").c_str(), &copy, nullptr));
  reads = single && !copy;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode register_p_multigrid()
{
  PetscFunctionBeginUser;
  PetscCall(PCRegister("p_multigrid", create_p_multigrid));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
