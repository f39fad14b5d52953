/// @file
/// The Lagrange elements of displacement and pressure, and where their nodes lie on a mesh.
#pragma once

#include "pulmo/input/options.hpp"

#include <array>

namespace pulmo {

/// Degrees of the Lagrange elements on tetrahedra (`-elements`). The pressure is one degree below the displacement
/// (Taylor & Hood 1973), or both are linear: that pair is cheap, and not stable where the tissue is undrained.
struct Elements {
  PetscInt displacement_degree = 2, pressure_degree = 1;

  /// Declares -elements.
  PetscErrorCode declare(Options &options);
  const char *name() const;
};

/// A node of an element: a mean of vertices of the mesh.
struct ElementNode {
  PetscInt n;                       ///< how many vertices
  std::array<PetscInt, 3> vertices; ///< mesh points
  std::array<PetscReal, 3> weights;
};

/// The @p n nodes at a vertex, edge or face of @p dm, in the order of its dofs: 1 in the middle, or 2 on an edge (P3),
/// at the Gauss-Lobatto points and from the first vertex of its cone to the second.
PetscErrorCode nodes_at(DM dm, PetscInt point, PetscInt n, std::vector<ElementNode> &nodes);

/// Their coordinates, mm.
PetscErrorCode node_coordinates(DM dm, PetscInt point, PetscInt n, std::vector<std::array<PetscReal, 3>> &x);
/// Coordinates of a vertex of @p dm or of the middle of an edge or face, mm.
PetscErrorCode node_coordinates(DM dm, PetscInt point, PetscReal x[3]);

} // namespace pulmo
