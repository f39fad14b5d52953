/// @file
/// Reads gmsh's mesh files.
#pragma once

#include "pulmo/mesh/mesh_file.hpp"

#include <string>

namespace pulmo {

/// Reads the bytes @p content of an MSH file (2.2 or 4.1, ASCII or binary). Returns what is wrong with it, as the words
/// that follow its name in a sentence that says how to fix it; empty if nothing is.
std::string read_msh(const std::string &content, MeshFile &mesh);

/// Whether PETSc keeps a label of this name for itself.
bool is_petsc_label(const std::string &name);

} // namespace pulmo
