/// @file
/// A matrix of 3 x 3 blocks kept a second time in single precision, for smoothers.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Makes a shell matrix with the entries of @p A (AIJ, block size 3, on any number of ranks) in single precision. It
/// multiplies, forms residuals and smooths (`-pc_type sor`: block Gauss-Seidel by 3 x 3 blocks, within a rank) with
/// half of A's memory traffic and vector instructions; for preconditioners, whose precision does not touch the
/// solution's.
/// @p rows: not all of A but these of its rows and columns (global numbers, each three neighbours a node), which A's
/// rows may hold among others; null: all.
PetscErrorCode create_single_blocks(Mat A, IS rows, Mat *single);

/// Takes new entries from @p A, which has the pattern it was made with, and the same rows.
PetscErrorCode update_single_blocks(Mat single, Mat A);

} // namespace pulmo
