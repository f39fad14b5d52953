/// @file
/// The mesh file that `-mesh_save` writes and that ranks read together, each a part of it: no rank ever has all of it.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/mesh/mesh_file.hpp"

#include <cstdint>

namespace pulmo {

/// What the file says of the whole mesh; every rank knows it.
struct SavedMesh {
  /// As NamedMesh::Part.
  struct Part {
    std::string name;
    int dimension = 2;
    std::int64_t elements = 0;
    double measure = 0; ///< unscaled
    bool inside = false;
  };
  /// A part of the mesh that one rank reads: cells and nodes that follow one another.
  struct Slice {
    std::int64_t first_cell = 0, first_node = 0;
    std::vector<std::array<int, 4>> cells;    ///< right-handed, numbers of nodes of the whole mesh
    std::vector<std::array<int, 4>> facets;   ///< of each cell, beside each corner: the part that the facet opposite
                                              ///< to it belongs to, -1 for none
    std::vector<int> volumes;                 ///< of each cell: which of SavedMesh::volumes
    std::vector<int> places;                  ///< of each cell: as NamedMesh::place
    std::vector<std::array<double, 3>> nodes; ///< unscaled
  };

  std::int64_t cells = 0, nodes = 0;
  std::int64_t tetrahedra = 0;           ///< of the file that it was made of
  double volume = 0;                     ///< unscaled
  double scale = 1;                      ///< -mesh_scale
  bool scale_given = false;              ///< by the user
  std::vector<std::string> prefer;       ///< -mesh_prefer
  std::vector<std::string> notes;        ///< what a user should know of it, in sentences
  std::vector<Part> parts;               ///< in the order of NamedMesh::parts
  std::vector<std::vector<int>> volumes; ///< lists of parts that a cell may belong to, the empty one among them

  /// What there is to say of @p mesh. Scale, preference and notes of others are the caller's.
  static SavedMesh of(const NamedMesh &mesh);
};

/// The bytes of a file of @p mesh, whose cells are written in @p order (numbers of cells, each once): neighbours in
/// space should be neighbours there, since ranks read what follows one another. Empty if it could not be made.
std::vector<char> image_of(const SavedMesh &about, const NamedMesh &mesh, const std::vector<int> &order);

/// Whether @p file is marked as such a file (on the calling rank).
bool is_saved_mesh(const std::string &file);

/// Reads a file, on every rank a slice that is as large as any other. @p fault, on all ranks: what is wrong with it, as
/// the words that follow its name in a sentence that says how to fix it; empty if nothing is. Collective.
PetscErrorCode read_saved_mesh(MPI_Comm comm, const std::string &file, SavedMesh &mesh, SavedMesh::Slice &slice,
                               std::string &fault);

} // namespace pulmo
