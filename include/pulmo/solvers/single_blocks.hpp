/// @file
/// A matrix of 3 x 3 blocks kept a second time in single precision, for smoothers.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Makes a shell matrix with the entries of @p A (AIJ, block size 3, on any number of ranks) in single precision. It
/// multiplies, forms residuals and smooths (`-pc_type sor`: block Gauss-Seidel by 3 x 3 blocks, within a rank) with
/// half of A's memory traffic and vector instructions; for preconditioners, whose precision does not touch the
/// solution's.
PetscErrorCode create_single_blocks(Mat A, Mat *single);

/// Takes new entries from @p A, which has the pattern it was made with.
PetscErrorCode update_single_blocks(Mat single, Mat A);

} // namespace pulmo
