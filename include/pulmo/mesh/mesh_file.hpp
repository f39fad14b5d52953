/// @file
/// What a mesh file says, whatever its format, and the mesh that pulmo makes of it: the same for all files that hold
/// the same cells and names.
#pragma once

#include <array>
#include <string>
#include <vector>

namespace pulmo {

/// Cells whose volume is not above this share of (longest edge)^3 are degenerate.
constexpr double degenerate_share = 1e-10 / 6;

/// Faces of the boundary that are not further than this share of their cells' size from others lie on them. A fissure
/// that is meshed as two surfaces is an order of magnitude wider: 0.1 mm at edges of 3 mm are 0.03.
constexpr double torn_share = 1e-3;
/// Up to this share they may be meant to: sides of a curved surface that were meshed apart are so far from each other.
constexpr double gap_share = 2e-2;

/// A mesh file as it was read.
struct MeshFile {
  /// A physical group.
  struct Group {
    int dimension = 0;
    long tag = 0;
    std::string name; ///< empty: it has only its number
  };
  /// An element of N nodes. One that belongs to several groups is there once for each.
  template <int N>
  struct Element {
    long id = 0;
    int group = -1; ///< index of its group, -1 for none
    std::array<int, N> nodes{};
  };

  std::vector<std::array<double, 3>> nodes; ///< as in the file, unscaled
  std::vector<long> node_tags;              ///< their numbers in the file; empty if it has none
  std::vector<Element<4>> cells;            ///< left- or right-handed, in the order of the file
  std::vector<Element<3>> facets;
  std::vector<Group> groups;
  bool periodic = false; ///< ties surfaces to one another, of which pulmo takes no heed
};

/// A tetrahedral mesh and the parts of it that have names. Neither the numbers of nodes, elements and groups in the
/// file nor their order, nor the handedness of cells, show in it.
struct NamedMesh {
  /// The facets or cells that carry one name.
  struct Part {
    std::string name;
    int dimension = 2;         ///< 2: facets, 3: cells
    std::vector<int> elements; ///< indices into facets or cells, ascending
    double measure = 0;        ///< area or volume, unscaled
    bool inside = false;       ///< has facets within the volume
  };

  std::vector<std::array<double, 3>> nodes; ///< unscaled; those of cells, in the order of their coordinates
  std::vector<std::array<int, 4>> cells;    ///< right-handed, in the order of their nodes
  std::vector<int> place;                 ///< of each cell among the tetrahedra of the file (the first, if it is there
                                          ///< more than once)
  int tetrahedra = 0;                     ///< of the file
  std::vector<std::array<int, 3>> facets; ///< those with a name
  std::vector<Part> parts;                ///< facets first, in the order of their names
  double volume = 0;                      ///< unscaled
  std::vector<std::string> notes;         ///< what a user should know of it, in sentences
};

/// Makes @p mesh of @p file. A facet that carries several names gets the first of @p prefer that is among them. Returns
/// what is wrong with the file, as the words that follow its name in a sentence that says how to fix it; empty if
/// nothing is. @p scale: of the places and sizes in the sentences, to mm.
std::string make_named_mesh(const MeshFile &file, const std::vector<std::string> &prefer, double scale,
                            NamedMesh &mesh);

} // namespace pulmo
