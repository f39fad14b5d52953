/// @file
/// A closed surface of triangles: that of the lung's own mesh, or of a file (STL, MSH).
#pragma once

#include "pulmo/base/petsc.hpp"

#include <array>
#include <string>
#include <vector>

namespace pulmo {

class Mesh;

/// Triangles that together enclose a volume. Each turns counterclockwise, seen from outside. Neither the order of the
/// triangles nor that of their corners in the file shows in it.
struct ClosedSurface {
  using Place = std::array<double, 3>;
  using Corners = std::array<Place, 3>; ///< of one triangle

  std::vector<Place> nodes; ///< mm
  std::vector<std::array<int, 3>> triangles;

  /// The corners of the box around it.
  Place lowest() const;
  Place highest() const;
  /// Diagonal of that box.
  double size() const;
  /// "hash ...", the same for the same triangles.
  std::string hash() const;
};

/// Joins triangles where their corners are the same numbers, and turns each body of them outwards; one that lies within
/// another is a hole in it. Returns what is wrong with them, as the words that follow
/// "the surface" in a sentence; empty if nothing is.
std::string join_triangles(std::vector<ClosedSurface::Corners> list, ClosedSurface &surface);

/// Reads the bytes of an STL file, ASCII or binary. Returns what is wrong with it, as the words that follow its name;
/// empty if nothing is.
std::string read_stl(const std::string &content, std::vector<ClosedSurface::Corners> &list);

/// Reads @p file (.stl, or a mesh of triangles or of tetrahedra that pulmo reads) and multiplies its coordinates with
/// @p scale. User error that names @p option where that is no closed surface. Collective.
PetscErrorCode read_closed_surface(MPI_Comm comm, const std::string &option, const std::string &file, PetscReal scale,
                                   ClosedSurface &surface);

/// The boundary of a mesh, the same on any number of ranks. User error that names @p option where it is no closed
/// surface. Collective.
PetscErrorCode boundary_of(const Mesh &mesh, const std::string &option, ClosedSurface &surface);

} // namespace pulmo
