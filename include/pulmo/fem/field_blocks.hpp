/// @file
/// Blocks of a matrix that are copied out of it again and again: those of the fields, for fieldsplits.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// From now on MatCreateSubMatrix(@p A, ..., MAT_REUSE_MATRIX, ...) copies entries in the order they have and sorts
/// nothing, if the columns asked for ascend. For a sequential AIJ matrix; others are left as they are.
PetscErrorCode copy_blocks_in_order(Mat A);

} // namespace pulmo
