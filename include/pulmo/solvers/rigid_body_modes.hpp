/// @file
/// Translations and rotations, for algebraic multigrid.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Three translations and three rotations of field @p f of @p dm, orthonormal; what is held is left out.
PetscErrorCode create_rigid_body_modes(DM dm, PetscInt f, MatNullSpace *modes);

/// Makes matrices of the displacement field of @p dm, also after a fieldsplit, carry the six rigid-body modes.
PetscErrorCode attach_rigid_body_modes(DM dm);

} // namespace pulmo
