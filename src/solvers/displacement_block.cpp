#include "pulmo/solvers/displacement_block.hpp"

#include "pulmo/base/attached.hpp"

#include <petsc/private/petscimpl.h>

namespace pulmo {

namespace {

using CreateBlock = PetscErrorCode (*)(Mat, IS, IS, MatReuse, Mat *);

constexpr const char *wanted = "pulmo_view_displacement", *name = "pulmo_displacement_block";

/// What a matrix knows of the view that it is to give.
struct WantedView {
  IS rows = nullptr;
  P1Matrix *p1 = nullptr;
  CreateBlock copy = nullptr; ///< how it makes other blocks

  ~WantedView() { (void)ISDestroy(&rows); }
};

/// The shell's context.
struct View : DisplacementBlock {
  VecHandle x, y; ///< of the whole matrix, once something multiplies

  ~View()
  {
    (void)MatDestroy(&whole);
    (void)ISDestroy(&rows);
  }
};

PetscErrorCode view_of(Mat shell, View **view)
{
  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(shell, view));
  if (!(*view)->x) PetscCall(MatCreateVecs((*view)->whole, (*view)->x.out(), (*view)->y.out()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode multiply(Mat shell, Vec x, Vec y)
{
  View *view = nullptr;

  PetscFunctionBeginUser;
  PetscCall(view_of(shell, &view));
  PetscCall(VecZeroEntries(view->x));
  PetscCall(VecISCopy(view->x, view->rows, SCATTER_FORWARD, x));
  PetscCall(MatMult(view->whole, view->x, view->y));
  PetscCall(VecISCopy(view->y, view->rows, SCATTER_REVERSE, y));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode get_diagonal(Mat shell, Vec d)
{
  View *view = nullptr;

  PetscFunctionBeginUser;
  PetscCall(view_of(shell, &view));
  PetscCall(MatGetDiagonal(view->whole, view->y));
  PetscCall(VecISCopy(view->y, view->rows, SCATTER_REVERSE, d));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode destroy(Mat shell)
{
  View *view = nullptr;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(shell, &view));
  delete view;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_view(Mat A, const WantedView &want, Mat *block)
{
  PetscInt n, N;

  PetscFunctionBeginUser;
  auto *view = new View;
  view->whole = A;
  view->rows = want.rows;
  view->p1 = want.p1;
  PetscCall(PetscObjectReference((PetscObject)A));
  PetscCall(PetscObjectReference((PetscObject)want.rows));
  PetscCall(ISGetLocalSize(want.rows, &n));
  PetscCall(ISGetSize(want.rows, &N));
  PetscCall(MatCreateShell(PetscObjectComm((PetscObject)A), n, n, N, N, view, block));
  PetscCall(MatSetBlockSize(*block, 3));
  PetscCall(MatShellSetOperation(*block, MATOP_DESTROY, (void (*)(void))destroy));
  PetscCall(MatShellSetOperation(*block, MATOP_MULT, (void (*)(void))multiply));
  PetscCall(MatShellSetOperation(*block, MATOP_GET_DIAGONAL, (void (*)(void))get_diagonal));
  PetscCall(attach_pointer<DisplacementBlock>((PetscObject)*block, name, view));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_block(Mat A, IS rows, IS columns, MatReuse reuse, Mat *block)
{
  WantedView *want = nullptr;
  PetscBool mine = PETSC_FALSE;

  PetscFunctionBeginUser;
  PetscCall(find_attached((PetscObject)A, wanted, &want));
  PetscCheck(want, PetscObjectComm((PetscObject)A), PETSC_ERR_PLIB, "a matrix without its view of the displacement");
  PetscCall(ISEqual(rows, want->rows, &mine));
  if (mine) PetscCall(ISEqual(columns, want->rows, &mine));
  if (!mine) {
    PetscCall(want->copy(A, rows, columns, reuse, block));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (reuse == MAT_INITIAL_MATRIX) PetscCall(create_view(A, *want, block));
  PetscCall(PetscObjectStateIncrease((PetscObject)*block));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode DisplacementBlock::find(Mat A, DisplacementBlock **block)
{
  PetscFunctionBeginUser;
  PetscCall(find_attached((PetscObject)A, name, block));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode view_displacement(Mat A, IS rows, P1Matrix &p1)
{
  void (*copy)(void) = nullptr;

  PetscFunctionBeginUser;
  PetscCall(MatGetOperation(A, MATOP_CREATE_SUBMATRIX, &copy));
  auto *want = new WantedView;
  want->rows = rows;
  want->p1 = &p1;
  want->copy = reinterpret_cast<CreateBlock>(copy);
  PetscCall(PetscObjectReference((PetscObject)rows));
  PetscCall(attach_owned((PetscObject)A, wanted, want));
  PetscCall(MatSetOperation(A, MATOP_CREATE_SUBMATRIX, (void (*)(void))create_block));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
