/// @file
/// Faces of a mesh's boundary that lie on one another although the mesh does not join them: nodes that are there twice,
/// or parts that were meshed apart and have other nodes each where they meet.
#pragma once

#include <array>
#include <vector>

namespace pulmo {

/// A face of one cell only.
struct BoundaryFace {
  std::array<int, 3> nodes{};
  int opposite = 0; ///< the fourth node of its cell
  int cell = 0;
};

/// A face that lies on another one.
struct Touch {
  int face = 0, other = 0;    ///< indices
  double distance = 0;        ///< from its centre to the plane of the other one
  double share = 0;           ///< the same in sizes of their cells
  bool overlaps = false;      ///< both cells lie on the same side
  bool matches = false;       ///< each of its nodes lies on one of the other one
  std::array<int, 2> twins{}; ///< those of such nodes that are furthest apart, where it matches
  double twins_distance = 0;  ///< between them
};

/// Finds the faces whose centre is not further than @p share sizes of their cells from another face that has the same
/// plane, but for some degrees; for each the nearest one, in the order of @p faces. The size of a cell is the least of
/// its edges and of its height over the face: however thin a layer of cells is, its two sides do not touch.
std::vector<Touch> touching_faces(const std::vector<std::array<double, 3>> &nodes,
                                  const std::vector<BoundaryFace> &faces, double share);

} // namespace pulmo
