/// @file
/// What becomes of PETSc's errors: sentences for what a user can fix, traces for bugs.
#pragma once

#include "pulmo/input/options.hpp"

#include <vector>

namespace pulmo {

/// PETSc's error handler. Its own errors and those that PETSc finds in the value of an option are told in a sentence
/// by one rank. An error that PETSc's solvers raise by themselves (they were asked for by options) is told in a
/// sentence with these options, on whichever ranks it is raised. All else keeps PETSc's trace.
///
/// Where an error comes from is known only once it has left PETSc: until then its trace is kept.
class ErrorHandler {
public:
  ErrorHandler() = default;
  ~ErrorHandler();
  ErrorHandler(const ErrorHandler &) = delete;
  ErrorHandler &operator=(const ErrorHandler &) = delete;
  /// Call once, after PetscInitialize.
  PetscErrorCode setup();
  /// As PETSc calls it; @p handler is an ErrorHandler.
  static PetscErrorCode handle(MPI_Comm comm, int line, const char *function, const char *file, PetscErrorCode code,
                               PetscErrorType type, const char *message, void *handler);

private:
  struct Frame {
    MPI_Comm comm;
    int line;
    std::string function, file;
    PetscErrorCode code;
    PetscErrorType type;
    std::string message;
  };

  PetscErrorCode solver_error() const;
  /// Whether all ranks come here within some seconds.
  bool all_meet() const;

  MPI_Comm comm_ = MPI_COMM_NULL; ///< of its own
  std::vector<Frame> trace_;      ///< of an error that is still within PETSc
};

} // namespace pulmo
