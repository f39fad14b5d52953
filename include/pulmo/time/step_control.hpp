/// @file
/// Steps chosen by their error in time, in clinical units.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/input/options.hpp"

namespace pulmo {

/// Estimates the error that one step makes in the volume of the lung and in the airway pressure from divided
/// differences of the last values since the last kink, and proposes the next step.
///
/// Leading terms of the local errors: dt^2/2 y'' of backward Euler; (1 + w)^2 / (6 w (1 + 2 w)) dt^3 y''' of BDF2, with
/// w = dt / dt before (Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, section III.5).
class StepControl {
public:
  /// What is known at the end of a step.
  struct Value {
    double time = 0, volume = 0, pressure = 0; ///< s, ml, cmH2O
  };
  /// What a phase leaves free; the rest is as prescribed and has no error.
  struct Free {
    bool volume = true, pressure = true;
  };

  /// Declares -step_volume_tolerance, -step_pressure_tolerance and -step_J_change.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return volume_tolerance_ > 0 || pressure_tolerance_ > 0; }
  PetscReal volume_tolerance() const { return volume_tolerance_; }     ///< ml
  PetscReal pressure_tolerance() const { return pressure_tolerance_; } ///< cmH2O
  PetscReal J_change() const { return J_change_; }                     ///< that a step may make, as |ln J|; 0: any
  /// The length of a step that would change J by somewhat less than it may, over that of one that made @p change.
  double length_within_J_change(double change) const;
  PetscErrorCode persist(Archive &archive);

  /// Forgets all before @p value: the time derivatives jump there.
  void restart(const Value &value) { past_ = {value}; }
  /// Takes note of an accepted step.
  void accept(const Value &value);
  /// The error of a step of a scheme of order @p order that ends at @p value, over what is tolerated; none while too
  /// few steps have been made since the last kink.
  std::optional<double> error(int order, const Value &value, Free free) const;
  /// How much longer a step may be that has @p error now.
  static double growth(int order, double error);

private:
  PetscReal volume_tolerance_ = 0, pressure_tolerance_ = 0; ///< ml, cmH2O
  PetscReal J_change_ = 0;
  std::vector<Value> past_; ///< the last one first
};

} // namespace pulmo
