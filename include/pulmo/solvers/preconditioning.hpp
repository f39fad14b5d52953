/// @file
/// What options say of the preconditioner before PETSc takes them.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <string>

namespace pulmo {

/// What -pc_type says; a user error if nothing does.
PetscErrorCode wanted_pc(MPI_Comm comm, std::string &type);
/// For a matrix of the displacement alone: where -pc_type is fieldsplit, what a solver file says of the displacement
/// split preconditions the whole. To be called before options are taken.
PetscErrorCode precondition_one_field(KSP ksp);

} // namespace pulmo
