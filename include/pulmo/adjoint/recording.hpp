/// @file
/// `-sweep_*`: keeps the states of a run for whoever sweeps back over it afterwards.
#pragma once

#include "pulmo/time/simulation.hpp"

#include <memory>

namespace pulmo {

class Recording {
public:
  /// Declares the settings of sweeps; @p wanted: something asks for one.
  PetscErrorCode declare(Options &options, bool wanted);
  /// Lets the simulation keep its stages; a file beside memory would be in @p folder.
  PetscErrorCode attach(Simulation &simulation, const std::string &folder);
  /// Why some rank does not have all states; empty: they are there. Collective.
  PetscErrorCode complaint(MPI_Comm comm, std::string &text) const;
  const Trajectory &trajectory() const { return *trajectory_; }
  /// Of the linear systems, relative.
  PetscReal tolerance() const { return tolerance_; }

private:
  PetscReal memory_ = 2000, tolerance_ = 1e-6;
  std::unique_ptr<Trajectory> trajectory_;
};

} // namespace pulmo
