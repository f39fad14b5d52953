/// @file
/// What the names of a mesh mark, so that two meshes can be compared by it.
#pragma once

#include "pulmo/mesh/mesh.hpp"

namespace pulmo {

/// A named surface or volume of a mesh, known by where it is: not by numbering, ranks or file format.
struct NamedPart {
  bool surface = false;
  std::string name;
  std::uint64_t count = 0; ///< its facets or cells
  std::uint64_t hash = 0;  ///< of their corners
};

/// Every surface and every region of @p mesh, also those that no effect uses. The same on all ranks.
PetscErrorCode find_named_parts(const Mesh &mesh, std::vector<NamedPart> &parts);

/// A line for each part, and back. False if @p text is not what text_of() makes.
std::string text_of(const std::vector<NamedPart> &parts);
bool read_named_parts(const std::string &text, std::vector<NamedPart> &parts);

/// The first way in which the parts of a mesh differ from those @p there of another with the same cells, as in "there
/// the surface 'airway' has 4 facets, here 6"; empty if they do not.
std::string difference(const std::vector<NamedPart> &there, const std::vector<NamedPart> &here);

} // namespace pulmo
