/// @file
/// What the ventilator does over time: a list of phases.
#pragma once

#include <petscsys.h>

#include <string>
#include <vector>

namespace pulmo {

/// One phase (begin, end]: the airway pressure goes linearly from @p from to @p to within @p ramp and stays.
struct Phase {
  std::string name;   ///< inspiration, pause, expiration, settle, ...
  PetscInt breath;    ///< counted from 1; 0 before the first breath
  PetscReal begin;    ///< s
  PetscReal end;      ///< s
  PetscReal from, to; ///< airway pressure, kPa
  PetscReal ramp;     ///< s; 0: @p to holds from the first step on

  /// Airway pressure at a time of this phase, kPa.
  PetscReal pressure(PetscReal t) const;
};

/// The phases of a run, in order and without gaps.
class Programme {
public:
  explicit Programme(std::vector<Phase> phases) : phases_(std::move(phases)) {}

  const std::vector<Phase> &phases() const { return phases_; }
  /// Airway pressure at time t, kPa; at a switch that of the phase that ends there.
  PetscReal pressure(PetscReal t) const;
  PetscReal end() const { return phases_.empty() ? 0 : phases_.back().end; }

private:
  std::vector<Phase> phases_;
};

} // namespace pulmo
