/// @file
/// The free dofs of a mesh point.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <vector>

namespace pulmo {

/// Global number of each dof of field @p f at @p point, -1 for one that is held; also for points of other ranks.
PetscErrorCode free_dofs(PetscSection section, PetscSection global, PetscInt point, PetscInt f,
                         std::vector<PetscInt> &dofs, bool &owned);

} // namespace pulmo
