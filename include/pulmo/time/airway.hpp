/// @file
/// The condition at the airway: what the phase at hand prescribes there, and the one equation that goes with a pressure
/// that is an unknown of its own.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/time/step_control.hpp"
#include "pulmo/time/time_scheme.hpp"

namespace pulmo {

/// Steers the airway of a model through the phases of a programme.
///
/// held    the pressure is prescribed on the open surfaces;
/// free    the flux is prescribed there, by area, and the pressure field is free;
/// common  the whole airway (without airflow: all gas) has one pressure P, the unknown of one scalar equation c = 0:
///         a prescribed volume, (V - V_target) / h^3, or the tube's drop, (P + K1 Q + K2 |Q| Q - P_ventilator) /
///         modulus.
///
/// A flow phase prescribes the volume at the end of each step, so that errors of the solver do not add up.
class Airway {
public:
  enum class Mode { held, free, common };

  /// @p scheme: where rates of volume come from.
  Airway(Model &model, const SceneFacts &facts, const TimeScheme &scheme)
      : model_(model), facts_(facts), scheme_(scheme)
  {}

  /// Begins a phase at lung volume @p volume (mm^3 above rest) whose first step is to take @p first_step s. A ramp of
  /// pressure without a start value starts from what the ventilator has then.
  void begin_phase(const Phase &phase, PetscReal volume, PetscReal first_step);
  /// Writes or reads what a step needs of the phase and of the steps before it; the phase was begun.
  PetscErrorCode persist(Archive &archive);
  /// After persist() has read: puts a gas pressure that has no node into a global vector.
  PetscErrorCode restore(Vec X) const
  {
    return model_.composition().common_gas_pressure() ? model_.set_carrier_value(X, pressure_before_) : PETSC_SUCCESS;
  }
  /// Begins an attempt at a stage that ends at @p t, of a step that ends at @p step_end, s; the scheme has begun it.
  void begin_stage(PetscReal t, PetscReal step_end);
  /// The attempt at hand failed and is made once more, as it was.
  void again() { retake_ = limited_; }
  /// The attempt at hand failed and a shorter one is made: that may stay below the limit.
  void cut() { retake_ = false; }
  /// Whether the step at hand is the first one that holds the limit of the phase.
  bool reaches_limit() const { return limited_ && !limited_before_; }
  /// Puts the prescribed pressure, or the last known one, into a global vector.
  PetscErrorCode guess(Vec X) const;
  /// Hands the step to the model; where P is an unknown its value is that of @p X.
  PetscErrorCode apply(Vec X);
  /// Writes the scalar equation at lung volume @p volume into its row of a global residual at @p X.
  PetscErrorCode close(PetscReal volume, Vec X, Vec F);
  /// Holds a P that is an unknown at its last value for as long as @p frozen: the assembled Jacobian is that of the
  /// residual without P and its equation.
  bool frozen() const { return frozen_; }
  void freeze(bool frozen) { frozen_ = frozen && mode_ == Mode::common; }
  /// Change of P in a Newton step, kPa, from the equation's value @p c, its derivative @p c_P and the changes of
  /// volume (mm^3) along the step for fixed P and per kPa.
  PetscReal change(PetscReal c, PetscReal c_P, PetscReal volume_fixed, PetscReal volume_per_P) const;
  /// Whether the volume of a flow phase was met when close() was called last.
  bool satisfied() const;
  /// By how much lung volume @p volume misses what the phase prescribes: mm^3, or kPa at the ventilator.
  struct Unmet {
    PetscReal volume = 0, pressure = 0;
  };
  Unmet unmet(PetscReal volume) const;
  /// Takes note of an accepted step with flow @p flow, mm^3/s.
  void accept(PetscReal flow)
  {
    pressure_before_ = pressure_;
    ventilator_before_ = ventilator_pressure(flow);
    limited_before_ = limited_;
  }
  /// Pressure at the airway, kPa: what is held, the unknown, or the mean over the free surface.
  PetscErrorCode pressure(Vec local, PetscReal &pressure);
  /// Pressure at the ventilator's side of the tube, kPa, at flow @p flow into the lung, mm^3/s.
  PetscReal ventilator_pressure(PetscReal flow) const
  {
    return pressure_ + (facts_.tube ? facts_.tube->drop(flow) : 0);
  }
  /// If the phase has a limit that the ventilator's pressure exceeds: holds the limit in the next attempt (and, if that
  /// is accepted, to the end of the phase) and tells so.
  bool limit(PetscReal flow);
  /// Whether the volume is held: a prescribed flow of zero.
  bool holds_volume() const { return control() == Control::flow && phase_.to == 0 && phase_.ramp == 0; }

  Mode mode() const { return mode_; }
  /// What of volume and pressure the step at hand leaves free.
  StepControl::Free free_values() const { return {control() != Control::flow, mode_ != Mode::held}; }
  /// Flow prescribed in the step at hand, mm^3/s.
  PetscReal flow() const { return scheme_.flow(volume_target_); }

private:
  /// What the phase prescribes: after its limit was reached a pressure.
  Control control() const { return limited_ ? Control::pressure : phase_.control; }
  void set_mode();
  /// The pressure that the phase prescribes, kPa.
  PetscReal prescribed_pressure(PetscReal t, PetscReal step_end) const;

  Model &model_;
  const SceneFacts &facts_;
  const TimeScheme &scheme_;
  Phase phase_;
  Mode mode_ = Mode::held;
  bool limited_ = false, limited_before_ = false; ///< the limit is held now, was held in the step before
  bool frozen_ = false;                           ///< freeze()
  bool retake_ = false;                           ///< the next attempt is the first one with the limit held
  PetscReal pressure_ = 0, pressure_before_ = 0;  ///< at the airway now, before the step, kPa
  PetscReal ventilator_before_ = 0;               ///< at the ventilator before the step, kPa
  PetscReal target_ = 0;                          ///< pressure that the phase prescribes, kPa
  PetscReal volume_begin_ = 0;                    ///< at the begin of the phase, mm^3
  PetscReal volume_target_ = 0, volume_ = 0;      ///< prescribed; at the last close(), mm^3
  PetscReal first_step_ = 0;                      ///< of the phase, s
};

} // namespace pulmo
