/// @file
/// Units: the solver works in mm, s, kPa; users speak of cmH2O, ml and ml/s.
#pragma once

namespace pulmo::units {

constexpr double kPa_per_cmH2O = 0.0980665; ///< by definition of the conventional water column
constexpr double mm3_per_ml = 1000.0;
constexpr double newton_per_kPa_mm2 = 1e-3;
constexpr double kPa_mm_per_mN_m = 1e-3; // surface tension
constexpr double j_per_kPa_mm3 = 1e-6;

} // namespace pulmo::units
