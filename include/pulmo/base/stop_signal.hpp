/// @file
/// A run that is asked to stop, by a signal or by who started it.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Whoever may end a run before its end.
class StopRequest {
public:
  virtual ~StopRequest() = default;
  /// Whether the run is to stop after the step at hand. Collective.
  virtual PetscErrorCode asked(bool &stop) = 0;
};

/// Takes note of SIGTERM, SIGINT and SIGUSR1 while it lives. A second one ends the process at once. (One object at a
/// time: a process has one set of signal handlers.)
class StopSignal final : public StopRequest {
public:
  explicit StopSignal(MPI_Comm comm);
  ~StopSignal() override;
  StopSignal(const StopSignal &) = delete;
  StopSignal &operator=(const StopSignal &) = delete;

  /// Whether any rank was asked to stop. Collective.
  PetscErrorCode asked(bool &stop) override;
  /// The signal's name, once asked() said so.
  const char *name() const;

private:
  MPI_Comm comm_;
  int signal_ = 0;
};

} // namespace pulmo
