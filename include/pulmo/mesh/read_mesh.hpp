/// @file
/// Reads a mesh file, gmsh's or another format that PETSc knows.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/mesh/mesh_file.hpp"

namespace pulmo {

/// Reads @p file on the calling rank alone. @p fault: what is wrong with it, as the words that follow its name in a
/// sentence that says how to fix it; empty if nothing is.
PetscErrorCode read_mesh_file(const std::string &file, MeshFile &mesh, std::string &fault);

/// What a user is told of MeshFile::periodic.
std::string periodic_note(const std::string &file);

/// Looks at a mesh file, on rank 0 alone unless ranks read it together, so that an unreadable one is a clear error on
/// all ranks that names @p option.
PetscErrorCode check_mesh_file(MPI_Comm comm, const char *option, const std::string &file);

} // namespace pulmo
