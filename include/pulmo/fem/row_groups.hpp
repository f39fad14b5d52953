/// @file
/// A faster product of a matrix whose rows come in groups with the same columns: the dofs of a mesh point.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// From now on MatMult() of @p A (AIJ, assembled, with its final pattern) gathers the entries of the vector once
/// for all rows of a mesh point, and multiplies in vectors. The result differs from PETSc's by rounding
/// only. On several ranks the columns of other ranks stay with PETSc. Other types of matrix are left as they are.
PetscErrorCode group_rows(Mat A);

} // namespace pulmo
