/// @file
/// Steps chosen by their error in time, in clinical units.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/input/options.hpp"

#include <array>
#include <string>

namespace pulmo {

/// The largest change of a quantity that a step may make at any place; one with more is cut.
struct StepBound {
  enum class Quantity {
    log_J,   ///< ln J, at quadrature points
    pressure ///< of the gas, cmH2O, at nodes; without airflow that of all gas
  };
  Quantity quantity;
  const char *option;   ///< with its hyphen
  const char *symbol;   ///< in messages
  const char *unit;     ///< with a blank before it; empty if there is none
  PetscReal most = 0;   ///< 0: any
  PetscReal change = 0; ///< that the stage judged last made

  bool in_use() const { return most > 0; }
  bool met() const { return !in_use() || change <= most; }
  /// The length of a step that would make somewhat less than the change allowed, over that of the one judged last.
  PetscReal length_within() const;
  /// Why the step judged last was not accepted; begins with the option and a colon.
  std::string complaint() const;
};

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

  /// Declares -step_volume_tolerance, -step_pressure_tolerance, -step_J_change and -step_p_change.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return volume_tolerance_ > 0 || pressure_tolerance_ > 0; }
  PetscReal volume_tolerance() const { return volume_tolerance_; }     ///< ml
  PetscReal pressure_tolerance() const { return pressure_tolerance_; } ///< cmH2O
  std::array<StepBound, 2> &bounds() { return bounds_; }
  /// The bound that asks for the shortest step after what the stage judged last changed.
  const StepBound &tightest() const;
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
  std::array<StepBound, 2> bounds_ = {{{StepBound::Quantity::log_J, "-step_J_change", "|ln J|", ""},
                                       {StepBound::Quantity::pressure, "-step_p_change", "p", " cmH2O"}}};
  std::vector<Value> past_; ///< the last one first
};

} // namespace pulmo
