/// @file
/// Pins against the rigid motions that nothing else holds, and what they bear.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/fem/held.hpp"

namespace pulmo {

/// Where an effect asked for it, pins the motions that are left free, and nothing else: to be called once all effects
/// have spoken. A body that is wholly free is pinned 3-2-1 along the axes.
PetscErrorCode pin_free_motions(Composition &composition);

/// The largest force that the pins bear in a run: none, unless a load goes along a motion that they alone hold.
class PinForces {
public:
  /// @p forces: on each constraint, kPa mm^2. @p local: the state at time @p t; @p gas_pressure: kPa.
  PetscErrorCode follow(const Model &model, const std::vector<std::array<PetscReal, 3>> &forces, Vec local, PetscReal t,
                        PetscReal gas_pressure);
  PetscErrorCode persist(Archive &archive);
  /// Says at the end of a run that the pins bore a load.
  PetscErrorCode warn(const Model &model) const;

  PetscReal largest() const { return largest_; } ///< of one pin, kPa mm^2
  /// Whether it is more than rounding and the tolerances of the solver leave.
  bool loaded() const { return largest_ > faint * loads_; }

private:
  static constexpr PetscReal faint = 1e-5;

  PetscReal largest_ = 0, loads_ = 0; ///< loads_: what acts inside the tissue and on its surface, kPa mm^2
  PetscReal time_ = 0;                ///< s
  PetscInt body_ = -1;
  std::array<PetscReal, 3> sum_{}; ///< of the pins of that body then
};

} // namespace pulmo
