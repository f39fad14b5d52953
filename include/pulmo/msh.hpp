/// @file
/// Looks through a gmsh mesh file before PETSc reads it.
#pragma once

#include <string>

namespace pulmo {

/// What is wrong with the bytes @p content of an MSH file (2.2 or 4.1, ASCII or binary), as the words that follow its
/// name in a sentence that says how to fix it; empty if nothing is. PETSc's reader trusts the counts, tags and node numbers
/// of a file; what passes here is safe for it and is a mesh of linear tetrahedra and of their faces.
std::string msh_fault(const std::string &content);

/// Whether PETSc keeps a label of this name for itself.
bool is_petsc_label(const std::string &name);

} // namespace pulmo
