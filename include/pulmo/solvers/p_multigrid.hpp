/// @file
/// The PC type `p_multigrid`.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Registers the PC type `p_multigrid`: two levels, the displacement above its P1 interpolant, Galerkin coarse matrix
/// with rigid-body modes. Options under the prefix of the PC: `-pmg_levels_*` (smoother), `-pmg_coarse_*` (the P1
/// problem). Needs a matrix of the displacement alone, or a DisplacementBlock.
PetscErrorCode register_p_multigrid();

/// Whether options say that the preconditioner with @p prefix is a p_multigrid that needs no copy of its block of @p A
/// (view_displacement). A user error if it is one and A is of a type that it cannot do with.
PetscErrorCode reads_in_place(const char *prefix, Mat A, bool &reads);

} // namespace pulmo
