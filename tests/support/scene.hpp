/// @file
/// Helpers for tests that build or run a scene from a string of options.
#pragma once

#include "pulmo/pulmo.hpp"

#include <gtest/gtest.h>

#include <cstdlib>
#include <string>

namespace pulmo::test {

/// Fails the test if a PETSc call fails.
#define PULMO_OK(call) ASSERT_EQ(static_cast<int>(call), 0) << #call

/// The source folder (tests run in it, but may be started elsewhere).
inline std::string source(const std::string &path)
{
  const char *dir = std::getenv("PULMO_SOURCE_DIR");
  return (dir ? std::string(dir) + "/" : std::string()) + path;
}

/// Replaces the whole options database by @p options.
inline PetscErrorCode set_options(const std::string &options)
{
  PetscFunctionBeginUser;
  PetscCall(PetscOptionsClear(nullptr));
  PetscCall(PetscOptionsInsertString(nullptr, options.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Builds the scene of @p options.
inline PetscErrorCode prepare(Run &run, const std::string &options)
{
  PetscFunctionBeginUser;
  PetscCall(set_options(options));
  PetscCall(run.declare());
  PetscCall(run.setup());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
