/// @file
/// How far a tissue law goes: stiffness against inflation and against plane waves, and the range of J and pressure in
/// which free inflation, F = J^(1/3) I and p = dW/dJ, has both.
#pragma once

#include "pulmo/physics/tissue_law.hpp"

#include <optional>
#include <string>

namespace pulmo {

/// Stiffness of the tissue against the softest of all plane waves at a state: the least eigenvalue over all directions
/// n (of the reference state) of the acoustic tensor A_iJkL n_J n_L, kPa. At zero or below the law is not elliptic
/// there: shape or volume change by themselves. A gas pressure adds nothing to it.
struct AcousticStiffness {
  PetscReal least = PETSC_MAX_REAL; ///< kPa
  PetscReal direction[3] = {0, 0, 0};
};
/// @p refine: search on around the softest of the directions tried.
AcousticStiffness acoustic_stiffness(const TissueLaw &law, const PointState &state, bool refine = true,
                                     const PetscScalar *constants = nullptr);

/// dp/dJ of tissue that inflates freely, F = J^(1/3) I and p = dW/dJ, kPa: at zero or below nothing but what holds the
/// lung from outside keeps it from going on by itself. @p constants: as in TissueLaw::stress.
PetscReal inflation_stiffness(const TissueLaw &law, PetscReal J, const PetscScalar *constants = nullptr);

/// Why tissue with these parameters is not stable at rest; empty if it is. Free inflation must take pressure, and no
/// plane wave may grow by itself. A law's own stress at rest counts in both; no stiffness against shear at all (CM5)
/// is allowed.
std::string unstable_at_rest(const TissueLaw &law, const PetscScalar *constants = nullptr);
/// p = dW/dJ of tissue that inflates freely, kPa.
PetscReal inflation_pressure(const TissueLaw &law, PetscReal J, const PetscScalar *constants = nullptr);

/// Where free inflation from rest ends. What is empty does not end between LawRange::least_J and largest_J.
struct LawRange {
  static constexpr PetscReal least_J = 0.02, largest_J = 50;
  struct State {
    PetscReal J, pressure; ///< -, kPa
  };
  std::optional<State> largest;     ///< a limit point, dp/dJ = 0: the largest pressure that the law holds
  std::optional<State> least;       ///< the same under suction
  std::optional<State> waves_above; ///< J > 1 at which plane waves meet no stiffness: not elliptic beyond
  std::optional<State> waves_below; ///< the same with J < 1
  std::optional<State> softest;     ///< where dp/dJ is least in inflation: it stiffens from there on
  PetscReal softest_share = 1;      ///< dp/dJ there over that at rest
};
/// With the parameters that no region has for itself, or those of @p constants, of which StressFree::forget() was
/// called.
LawRange law_range(const TissueLaw &law, const PetscScalar *constants = nullptr);

/// J of free inflation from rest to a pressure (kPa); nothing if dp/dJ turns negative before, or J leaves the range
/// above. @p end: where it ends then. With @p constants of which StressFree::forget() was called, rest is that of the
/// law.
std::optional<PetscReal> inflated_J(const TissueLaw &law, PetscReal pressure, const PetscScalar *constants = nullptr,
                                    LawRange::State *end = nullptr);

} // namespace pulmo
