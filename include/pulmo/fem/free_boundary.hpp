/// @file
/// Boundary of the lung that no effect uses: nothing holds it, loads it or lets air through.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

namespace pulmo {

/// All facets of one name that no term and no constraint of a composition touches.
struct FreeBoundary {
  std::string name;                             ///< empty: facets without any
  PetscReal area = 0, share = 0;                ///< mm^2; of the whole boundary
  PetscReal centroid[3], lowest[3], highest[3]; ///< mm
};

/// Which effects use a surface is read from their terms and constraints. In the order of the names.
PetscErrorCode find_free_boundary(const Composition &composition, std::vector<FreeBoundary> &parts);

/// One note on all of it, if there is any. @p airflow: it is sealed, too.
PetscErrorCode note_free_boundary(const Composition &composition, bool airflow);

} // namespace pulmo
