/// @file
/// A run that is asked to stop by a signal.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Takes note of SIGTERM, SIGINT and SIGUSR1 while it lives. A second one ends the process at once. (One object at a
/// time: a process has one set of signal handlers.)
class StopSignal {
public:
  explicit StopSignal(MPI_Comm comm);
  ~StopSignal();
  StopSignal(const StopSignal &) = delete;
  StopSignal &operator=(const StopSignal &) = delete;

  /// Whether any rank was asked to stop. Collective.
  PetscErrorCode asked(bool &stop);
  /// The signal's name, once asked() said so.
  const char *name() const;

private:
  MPI_Comm comm_;
  int signal_ = 0;
};

} // namespace pulmo
