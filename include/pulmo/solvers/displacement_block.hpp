/// @file
/// The displacement's block of the Jacobian where no copy of its entries is needed.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

class P1Matrix;

/// A block of rows and columns of an AIJ matrix, and what takes the place of its entries in `p_multigrid`: the entries
/// themselves are read where they are.
struct DisplacementBlock {
  Mat whole = nullptr; ///< the matrix with all fields
  IS rows = nullptr;   ///< of @p whole, global numbers, in the order of the block's
  P1Matrix *p1 = nullptr;

  /// Null if @p A is a matrix of its own.
  static PetscErrorCode find(Mat A, DisplacementBlock **block);
};

/// From now on MatCreateSubMatrix(@p A, rows, rows) makes a shell matrix that carries a DisplacementBlock; all other
/// blocks remain copies. The shell multiplies by way of all of @p A, which is slow: preconditioners that are wanted
/// here do not. @p p1 must outlive A.
PetscErrorCode view_displacement(Mat A, IS rows, P1Matrix &p1);

} // namespace pulmo
