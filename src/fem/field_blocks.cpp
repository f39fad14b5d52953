#include "pulmo/fem/field_blocks.hpp"

#include <vector>

namespace pulmo {

namespace {

/// Copies the entries of @p A in @p rows and in columns for which @p wanted holds to @p block. @p fits: the block has
/// as many entries in each row; else nothing can be said of it.
PetscErrorCode copy_entries(Mat A, PetscInt n, const PetscInt rows[], const std::vector<char> &wanted, Mat block,
                            bool &fits)
{
  PetscInt n_rows, n_block_rows;
  const PetscInt *i, *j, *block_i, *block_j;
  const PetscScalar *a;
  PetscScalar *to;
  PetscBool done;

  PetscFunctionBeginUser;
  PetscCall(MatGetRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &i, &j, &done));
  PetscCall(MatGetRowIJ(block, 0, PETSC_FALSE, PETSC_FALSE, &n_block_rows, &block_i, &block_j, &done));
  PetscCall(MatSeqAIJGetArrayRead(A, &a));
  PetscCall(MatSeqAIJGetArray(block, &to));
  fits = n_block_rows == n;
  for (PetscInt r = 0; r < n && fits; ++r) {
    PetscScalar *next = to + block_i[r], *const end = to + block_i[r + 1];
    for (PetscInt k = i[rows[r]]; k < i[rows[r] + 1]; ++k) {
      if (next < end) *next = a[k]; // overwritten by the next one if it is not wanted
      next += wanted[j[k]];
    }
    fits = next == end;
  }
  PetscCall(MatSeqAIJRestoreArray(block, &to));
  PetscCall(MatSeqAIJRestoreArrayRead(A, &a));
  PetscCall(MatRestoreRowIJ(block, 0, PETSC_FALSE, PETSC_FALSE, &n_block_rows, &block_i, &block_j, &done));
  PetscCall(MatRestoreRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &i, &j, &done));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_block(Mat A, IS rows, IS columns, MatReuse reuse, Mat *block)
{
  PetscBool ascend, sequential = PETSC_FALSE;
  bool copied = false;

  PetscFunctionBeginUser;
  PetscCall(ISSorted(columns, &ascend));
  if (reuse == MAT_REUSE_MATRIX) PetscCall(PetscObjectTypeCompare((PetscObject)*block, MATSEQAIJ, &sequential));
  if (sequential && ascend) {
    PetscInt size, n_rows, n_columns;
    const PetscInt *row, *column;
    PetscCall(MatGetSize(A, nullptr, &size));
    PetscCall(ISGetLocalSize(rows, &n_rows));
    PetscCall(ISGetLocalSize(columns, &n_columns));
    PetscCall(ISGetIndices(rows, &row));
    PetscCall(ISGetIndices(columns, &column));
    std::vector<char> wanted(static_cast<std::size_t>(size), 0);
    for (PetscInt k = 0; k < n_columns; ++k) wanted[column[k]] = 1;
    PetscCall(copy_entries(A, n_rows, row, wanted, *block, copied));
    PetscCall(ISRestoreIndices(columns, &column));
    PetscCall(ISRestoreIndices(rows, &row));
  }
  if (copied) PetscFunctionReturn(PETSC_SUCCESS);
  Mat *blocks = block; // the rest is what MatCreateSubMatrix() does itself
  PetscCall(MatCreateSubMatrices(A, 1, &rows, &columns, reuse, &blocks));
  if (reuse == MAT_REUSE_MATRIX) PetscFunctionReturn(PETSC_SUCCESS);
  *block = blocks[0];
  PetscCall(PetscFree(blocks));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode copy_blocks_in_order(Mat A)
{
  PetscBool sequential;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectTypeCompare((PetscObject)A, MATSEQAIJ, &sequential));
  if (sequential) PetscCall(MatSetOperation(A, MATOP_CREATE_SUBMATRIX, (void (*)())create_block));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
