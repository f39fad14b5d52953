/// @file
/// The openings of a lung: patches of airway, their edges, and what share of the airway each body has.
#pragma once

#include "pulmo/mesh/mesh.hpp"

#include <array>
#include <string>
#include <vector>

namespace pulmo {

/// A connected body and its part of the airway.
struct BodyOpening {
  std::string name;                       ///< as Mesh::regions calls the body
  PetscReal area = 0, area_share = 0;     ///< of the airway, mm^2 and share of the whole airway
  PetscReal volume = 0, volume_share = 0; ///< of the lung, mm^3 and share of the whole lung
  /// int N dA over the body's airway, mm^2, and int (X - centre of the body) x N dA, mm^3: what a uniform pressure on
  /// it exerts, per unit of pressure. Both are zero where the airway is a closed surface.
  std::array<PetscReal, 3> push{}, turn{};
  PetscReal size = 0; ///< (volume of the body)^(1/3), mm
};

/// The airway of a mesh.
struct Openings {
  PetscInt patches = 0; ///< sets of facets that hang together at their edges
  std::vector<BodyOpening> bodies;

  /// Names the bodies whose share of the airway's area and of the lung's volume differ by more than a tenth (of their
  /// share of the volume), with both shares; empty if there is none.
  std::string unequal_shares() const;
};

/// Looks at the facets of the surfaces @p names, together.
PetscErrorCode find_openings(const Mesh &mesh, const std::vector<std::string> &names, Openings &openings);

/// A segment of the edge of a surface: coordinates of its ends, mm.
using RimSegment = std::array<PetscReal, 6>;
/// The edge of the surfaces @p names, together: the edges with a facet of theirs on one side only. On all ranks.
PetscErrorCode find_rim(const Mesh &mesh, const std::vector<std::string> &names, std::vector<RimSegment> &rim);

/// Names of the bodies (Mesh::regions) with a facet of one of the surfaces @p names.
PetscErrorCode bodies_with(const Mesh &mesh, const std::vector<std::string> &names, std::vector<std::string> &bodies);

/// User error if the gas pressure on the surfaces @p walls pushes or turns a body that nothing holds but pins against
/// rigid motion: pins bear no load, so that there is no equilibrium. @p holders: the surfaces where something else
/// holds the lung.
PetscErrorCode check_wall_load(const Mesh &mesh, const std::vector<std::string> &walls,
                               const std::vector<std::string> &holders);

} // namespace pulmo
