/// @file
/// What several ranks know of one mesh point, put together.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <vector>

namespace pulmo {

/// Combines @p values, one for each local mesh point, with those that other ranks have for the same points. Collective.
PetscErrorCode combine_shared(DM dm, MPI_Op op, std::vector<PetscInt> &values);

/// The facets of this rank that are of one cell alone, over all ranks: the boundary. Collective.
PetscErrorCode outer_facets(DM dm, std::vector<PetscInt> &facets);

} // namespace pulmo
