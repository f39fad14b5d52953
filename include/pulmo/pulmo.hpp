/// @file
/// The program as a function: what main() does after PetscInitialize. Tests call it with registries of their own.
#pragma once

#include "pulmo/registry.hpp"

namespace pulmo {

/// Registers pulmo's PetscFE type, partitioner and step control, and the handler that prints user errors as one
/// sentence. Call once after PetscInitialize.
PetscErrorCode initialize();

/// Runs the scene of the options database. @p finished tells whether the run reached its end; user errors come
/// back as PETSC_ERR_USER_INPUT, already printed.
PetscErrorCode run(const Registry &registry, bool &finished);

} // namespace pulmo
