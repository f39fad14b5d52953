/// @file
/// The condition at the airway opening: what the phase at hand prescribes there, and the one equation that goes with a
/// pressure that is an unknown.
#pragma once

#include "pulmo/fem/scalar_unknowns.hpp"
#include "pulmo/physics/partner.hpp"
#include "pulmo/time/step_control.hpp"
#include "pulmo/time/time_scheme.hpp"

namespace pulmo {

/// Steers the airway of a model through the phases of a programme.
///
/// held    the pressure is prescribed on the open surfaces;
/// free    the flux is prescribed there, by area, and the pressure field is free;
/// solved  the pressure P at the opening (without airflow: of all gas) is the unknown of one scalar equation c = 0: a
///         prescribed volume, (V - V_target) / h^3, or what is prescribed at the ventilator,
///         (P + K1 Q + K2 |Q| Q - P_ventilator) / modulus. The open surfaces have that pressure, or those that an
///         airway tree gives them.
///
/// A flow phase prescribes the volume at the end of each step, so that errors of the solver do not add up.
///
/// Past a limit point of the pressure (SceneFacts::flow_past_limit_points) a flow of constant size is prescribed in a
/// pressure phase, too: inwards where the lung has less than the pressure of the phase, else outwards, until the
/// unknown pressure meets that.
class Airway final : public Partner {
public:
  enum class Mode { held, free, solved };

  /// @p scheme: where rates come from.
  Airway(Model &model, const SceneFacts &facts, const TimeScheme &scheme)
      : model_(model), facts_(facts), scheme_(scheme), scalars_(model)
  {}

  const char *name() const override { return "airway"; }
  /// The run begins at rest.
  void start()
  {
    before_.assign(scalars_.size(), 0);
    scalars_.begin(before_, false, 1, {}); // the first step of BDF2 looks back at all of them
  }
  /// Begins a phase at lung volume @p volume (mm^3 above rest) whose first step is to take @p first_step s. A ramp of
  /// pressure without a start value starts from what the ventilator has then.
  void begin_phase(const Phase &phase, PetscReal volume, PetscReal first_step);
  /// The scheme has begun the stage.
  void begin(PetscReal t, PetscReal step_end) override;
  /// Asks for the step again, with the limit of the phase held, if the ventilator's pressure exceeds that (to the end
  /// of the phase, if such an attempt is accepted): a shorter one would let the flow overshoot. Past a limit point it
  /// asks for the step again with the pressure of the phase held, if that was met.
  Verdict judge(const Attempt &attempt) override;
  std::string why() const override
  {
    return flows_ ? "with the pressure of the phase held" : "with the limit of the phase held";
  }
  void reject(Verdict how) override { retake_ = how == Verdict::again && (limited_ || returns() || exceeds_); }
  void accept(const Attempt &attempt) override;
  /// What a step needs of the phase and of the steps before it; the phase was begun.
  PetscErrorCode past(Past &past) override;
  /// Whether the step accepted last met what ends the phase early.
  bool phase_is_over() const { return over_; }
  /// From the state accepted last on a flow is prescribed, if the scene asks for that and a pressure was until now.
  /// Whether that is so.
  bool flow_on();
  /// The size of that flow, mm^3/s.
  PetscReal flow_past_limit() const { return flow_past_limit_; }
  /// Whether steps that begin now are past a limit point; and makes it so.
  bool past_limit() const { return past_limit_; }
  void past_limit(bool past) { past_limit_ = past; }
  /// Whether the next attempt is to hold the pressure that was met (the limit of the phase, or past a limit point what
  /// the phase prescribes), as the one before it asked; and makes it so.
  bool retakes() const { return retake_; }
  void retake(bool held) { retake_ = held; }
  /// After past() has read: takes the scalars, and puts those that have no node into a global vector.
  PetscErrorCode restore(Vec X);

  /// Puts the prescribed pressure, or the last known ones, into a global vector.
  PetscErrorCode guess(Vec X) const;
  /// Makes an increment of the state one that Newton may take: held pressures do not change, unknown ones by one value.
  PetscErrorCode hold(Vec increment) const;
  /// Hands the step to the model; what is unknown has its value in @p X.
  PetscErrorCode apply(Vec X);
  /// Closes the rows of the airway in a global residual at @p X; @p volume: of the lung, mm^3 above rest; @p local_F:
  /// the local residual.
  PetscErrorCode close(PetscReal volume, Vec local_F, Vec X, Vec F);
  /// Completes a Newton step (ScalarUnknowns::complete).
  PetscErrorCode complete(SNES snes, Mat A, Vec X, Vec Y, Vec local, PetscInt &krylov)
  {
    return scalars_.complete(snes, equation(), A, X, Y, local, krylov);
  }
  /// The equation of the opening in the step at hand.
  ScalarUnknowns::OpeningEquation equation() const;
  /// The same of any stage, at pressure @p P and @p gas beyond the opening that changes at @p rate. @p target: as in
  /// Condition; @p slope: of the rate by the gas, 1/s.
  static ScalarUnknowns::Opening equation(const Model &model, const std::optional<AirwayResistance> &tube,
                                          Control control, PetscReal target, PetscReal slope, PetscReal P,
                                          PetscReal gas, PetscReal rate);
  ScalarUnknowns &scalars() { return scalars_; }
  const ScalarUnknowns &scalars() const { return scalars_; }

  /// Whether the volume of a flow phase was met when close() was called last.
  bool satisfied() const;
  /// By how much a solved step at lung volume @p volume and local residual @p local_F misses what is prescribed: mm^3,
  /// or kPa at the ventilator or in the equations of scalars.
  struct Unmet {
    PetscReal volume = 0, pressure = 0;
  };
  PetscErrorCode unmet(PetscReal volume, Vec local_F, Unmet &unmet);
  /// Pressure at the opening, kPa: what is held, the unknown, or the mean over the free surface.
  PetscErrorCode pressure(Vec local, PetscReal &pressure);
  /// Flow through the opening, where @p flow enters the lung, mm^3/s.
  PetscReal opening_flow(PetscReal flow) const { return flow + scalars_.stored(scalars_.rates()); }
  /// Pressure at the ventilator's side of the tube, kPa, at flow @p flow through the opening, mm^3/s.
  PetscReal ventilator_pressure(PetscReal flow) const
  {
    return pressure_ + (facts_.tube ? facts_.tube->drop(flow) : 0);
  }
  /// Whether the volume is held: a prescribed flow of zero.
  bool holds_volume() const { return control() == Control::flow && !flows_ && phase_.to == 0 && phase_.ramp == 0; }

  Mode mode() const { return mode_; }
  /// What the stage at hand asks of the airway, for whoever makes its equations again.
  struct Condition {
    Mode mode = Mode::held;
    Control control = Control::pressure;
    PetscReal target = 0;   ///< what is prescribed: pressure at the ventilator, kPa, or volume of the gas, mm^3
    PetscReal by_start = 0; ///< its derivative by the pressure (kPa) or volume (mm^3) with which the phase began
    PetscReal share = 0;    ///< that the pressure at the start of the phase has in a target of pressure
    bool limited = false;   ///< the target is the limit of the phase
    PetscReal pressure = 0; ///< at the opening, kPa
    PetscReal flow = 0;     ///< prescribed on a free airway, mm^3/s
    /// Where effects have scalars: all of them, the opening's first, kPa; what flows into the lung by each, mm^3/s.
    std::vector<PetscReal> scalars = {}, flows = {};
  };
  Condition condition() const;
  /// What of volume and pressure the step at hand leaves free.
  StepControl::Free free_values() const { return {control() != Control::flow, mode_ != Mode::held}; }
  /// Flow prescribed in the step at hand, mm^3/s.
  PetscReal flow() const { return scheme_.flow(volume_target_); }

private:
  /// Whether the step at hand holds the pressure of the phase for the first time since a limit point.
  bool returns() const { return phase_.control == Control::pressure && past_limit_ && !flows_; }
  /// What the phase prescribes: after its limit was reached a pressure, past a limit point a flow.
  Control control() const { return limited_ ? Control::pressure : flows_ ? Control::flow : phase_.control; }
  void set_mode();
  /// The pressure that the phase prescribes, kPa.
  PetscReal prescribed_pressure(PetscReal t, PetscReal step_end) const;
  /// The share that the pressure at the start of the phase has in it.
  PetscReal share_of_start(PetscReal t, PetscReal step_end) const;
  /// Rate of the gas beyond the opening at volume @p gas of it (mm^3 above rest), mm^3/s.
  PetscReal gas_flow(PetscReal gas) const { return scheme_.slope() * gas + past_flow_; }

  Model &model_;
  const SceneFacts &facts_;
  const TimeScheme &scheme_;
  ScalarUnknowns scalars_;
  std::vector<PetscReal> before_ = {0}; ///< scalars before the step, kPa
  Phase phase_;
  Mode mode_ = Mode::held;
  bool starts_from_before_ = false;                   ///< a ramp begins at what the ventilator has then
  PetscReal share_of_start_ = 0;                      ///< in target_
  bool limited_ = false, limited_before_ = false;     ///< the limit is held now, was held in the step before
  bool exceeds_ = false;                              ///< the attempt judged last exceeds it, or met the pressure
  bool retake_ = false;                               ///< the next attempt is the first one with that held
  bool flows_ = false, past_limit_ = false;           ///< a flow is prescribed past a limit point now, from here on
  bool inwards_ = true;                               ///< where that flow goes
  PetscReal flow_past_limit_ = 0;                     ///< its size, mm^3/s
  PetscReal pressure_ = 0;                            ///< at the opening now, kPa
  PetscReal ventilator_before_ = 0;                   ///< at the ventilator before the step, kPa
  PetscReal target_ = 0;                              ///< pressure that the phase prescribes, kPa
  PetscReal volume_begin_ = 0;                        ///< of the gas at the begin of the phase, mm^3
  PetscReal volume_target_ = 0, volume_ = 0;          ///< of the gas: prescribed; at the last close(), mm^3
  PetscReal time_before_ = 0, volume_before_ = 0;     ///< at the last accepted step, s and of the gas, mm^3
  PetscReal past_flow_ = 0;                           ///< share of the past in the rate of that, mm^3/s
  PetscReal first_step_ = 0;                          ///< of the phase, s
  PetscReal highest_flow_ = 0, highest_pressure_ = 0; ///< of the phase, into the lung and at the ventilator
  bool over_ = false;                                 ///< the phase ends early
};

} // namespace pulmo
