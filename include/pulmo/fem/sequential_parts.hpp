/// @file
/// The sequential matrices that an AIJ matrix is made of.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Columns of this rank and of others. @p foreign is null on one rank, and else has @p columns, their global numbers.
inline PetscErrorCode sequential_parts(Mat A, Mat *owned, Mat *foreign, const PetscInt **columns)
{
  PetscBool parallel;

  PetscFunctionBeginUser;
  *owned = A;
  *foreign = nullptr;
  *columns = nullptr;
  PetscCall(PetscObjectBaseTypeCompare((PetscObject)A, MATMPIAIJ, &parallel));
  if (parallel) PetscCall(MatMPIAIJGetSeqAIJ(A, owned, foreign, columns));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
