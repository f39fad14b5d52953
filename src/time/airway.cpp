// The condition at the airway opening.
#include "pulmo/time/airway.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A prescribed volume is met to this share of itself (or of a thousandth of the lung's, if that is more).
constexpr PetscReal volume_tolerance = 1e-10;

} // namespace

void Airway::begin_phase(const Phase &phase, PetscReal volume, PetscReal first_step)
{
  phase_ = phase;
  // past a limit point the phase before did not reach what it was to end at
  starts_from_before_ = !phase_.from || (past_limit_ && phase_.control == Control::pressure);
  if (starts_from_before_) phase_.from = ventilator_before_;
  volume_begin_ = volume_before_ = volume + scalars_.stored(before_);
  time_before_ = phase_.begin;
  first_step_ = first_step;
  limited_ = limited_before_ = exceeds_ = retake_ = over_ = flows_ = false;
  highest_flow_ = 0;
  highest_pressure_ = ventilator_before_;
}

PetscErrorCode Airway::past(Past &past)
{
  PetscReal from = phase_.from.value_or(0);

  PetscFunctionBeginUser;
  before_.resize(scalars_.size());
  PetscCall(past.visit("phase_starts_from", from)); // kPa or mm^3/s
  phase_.from = from;
  PetscCall(past.visit("limited", limited_before_));
  PetscCall(past.visit("pressure_kPa", before_.front()));
  PetscCall(past.visit("ventilator_pressure_kPa", ventilator_before_));
  PetscCall(past.visit("volume_at_phase_begin_mm3", volume_begin_));
  PetscCall(past.visit("first_step_s", first_step_));
  if (scalars_.of_effects()) PetscCall(past.visit("scalars_kPa", before_));
  if (facts_.flow_past_limit_points) {
    PetscCall(past.visit("past_limit_point", past_limit_));
    PetscCall(past.visit("flow_past_limit_point_mm3_per_s", flow_past_limit_));
    PetscCall(past.visit("time_before_s", time_before_));
    PetscCall(past.visit("volume_before_mm3", volume_before_));
  }
  if (phase_.may_end_early()) {
    PetscCall(past.visit("highest_flow_mm3_per_s", highest_flow_));
    PetscCall(past.visit("highest_pressure_kPa", highest_pressure_));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::restore(Vec X)
{
  PetscFunctionBeginUser;
  scalars_.begin(before_, false, 1, {});
  if (model_.composition().common_gas_pressure() || scalars_.of_effects())
    PetscCall(model_.airway().set_scalars(X, before_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Airway::set_mode()
{
  // the mean over a free surface is no pressure that can be held instead: a limit needs one that is solved for
  if (control() == Control::flow)
    mode_ = facts_.free_airway() && !phase_.limit && !flows_ ? Mode::free : Mode::solved;
  else
    mode_ = facts_.tube || scalars_.of_effects() ? Mode::solved : Mode::held;
}

PetscReal Airway::prescribed_pressure(PetscReal t, PetscReal step_end) const
{
  if (limited_) return *phase_.limit;
  // a jump of pressure is there from the start; where the first step has to be cut it is cut with it
  const PetscReal since = step_end - phase_.begin;
  if (phase_.ramp == 0 && since < first_step_) return *phase_.from + (phase_.to - *phase_.from) * since / first_step_;
  return phase_.value(t);
}

PetscReal Airway::share_of_start(PetscReal t, PetscReal step_end) const
{
  const PetscReal since = std::max<PetscReal>(t - phase_.begin, 0), until = step_end - phase_.begin;
  if (limited_) return 0;
  if (phase_.ramp == 0) return until < first_step_ ? 1 - until / first_step_ : 0;
  return since < phase_.ramp ? 1 - since / phase_.ramp : 0;
}

Airway::Condition Airway::condition() const
{
  const bool flows = control() == Control::flow;
  Condition c;
  c.mode = mode_;
  c.control = control();
  c.target = flows ? volume_target_ : target_;
  c.share = flows ? 0 : share_of_start_;
  c.by_start = flows ? 1 : starts_from_before_ ? share_of_start_ : 0;
  c.limited = limited_;
  c.pressure = pressure_;
  c.flow = mode_ == Mode::free ? flow() : 0;
  if (scalars_.of_effects()) {
    c.scalars = scalars_.values();
    c.flows = scalars_.flows();
    c.scalars.resize(scalars_.size(), 0); // nothing was solved for before the first step
    c.flows.resize(scalars_.size(), 0);
  }
  return c;
}

void Airway::begin(PetscReal t, PetscReal step_end)
{
  limited_ = phase_.control == Control::flow && (limited_before_ || retake_);
  flows_ = phase_.control == Control::pressure && past_limit_ && !retake_;
  exceeds_ = false;
  retake_ = retake_ && scheme_.half_step(); // the whole step that follows belongs to the same attempt
  set_mode();
  if (phase_.control == Control::pressure || limited_) target_ = prescribed_pressure(t, step_end);
  if (flows_) {
    inwards_ = prescribed_pressure(step_end, step_end) >= ventilator_before_;
    volume_target_ = volume_before_ + (inwards_ ? 1 : -1) * flow_past_limit_ * (t - time_before_);
  } else if (control() == Control::flow) {
    volume_target_ = volume_begin_ + phase_.delivered(t);
  }
  share_of_start_ = share_of_start(t, step_end);
  std::vector<PetscReal> values = before_; // not what a failed attempt left
  if (mode_ == Mode::held) values.front() = target_;
  pressure_ = values.front();
  const std::vector<PetscReal> past = scheme_.past_rates();
  past_flow_ = scheme_.past_flow() + scalars_.stored(past);
  scalars_.begin(values, mode_ == Mode::solved, scheme_.slope(), past);
}

ScalarUnknowns::OpeningEquation Airway::equation() const
{
  return [this, now = control(), target = control() == Control::flow ? volume_target_ : target_](PetscReal P,
                                                                                                 PetscReal gas) {
    return equation(model_, facts_.tube, now, target, scheme_.slope(), P, gas, gas_flow(gas));
  };
}

ScalarUnknowns::Opening Airway::equation(const Model &model, const std::optional<AirwayResistance> &tube,
                                         Control control, PetscReal target, PetscReal slope, PetscReal P, PetscReal gas,
                                         PetscReal rate)
{
  const PetscReal h = model.composition().mesh().length(), modulus = model.modulus();
  if (control == Control::flow) return {(gas - target) / (h * h * h), 0, 1 / (h * h * h), 0, -1 / (h * h * h)};
  const PetscReal drop = tube ? tube->drop(rate) : 0, by_rate = tube ? tube->slope(rate) : 0;
  return {(P + drop - target) / modulus, 1 / modulus, by_rate * slope / modulus, by_rate / modulus, -1 / modulus};
}

PetscErrorCode Airway::guess(Vec X) const
{
  PetscFunctionBeginUser;
  if (mode_ != Mode::free) PetscCall(model_.airway().set(X, scalars_.values()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::hold(Vec increment) const
{
  std::vector<PetscReal> change(scalars_.size(), 0);

  PetscFunctionBeginUser;
  if (mode_ == Mode::free) PetscFunctionReturn(PETSC_SUCCESS);
  // one value for all nodes of a group: those of steps with a free airway differ from node to node
  if (mode_ == Mode::solved) PetscCall(model_.airway().scalars(increment, change));
  PetscCall(model_.airway().set(increment, change));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::apply(Vec X)
{
  PetscFunctionBeginUser;
  PetscCall(scalars_.take(X));
  if (mode_ == Mode::solved) pressure_ = scalars_.opening();
  model_.airway().hold(mode_ != Mode::free);
  PetscCall(model_.set_step(scheme_.stage(), pressure_, mode_ == Mode::free ? flow() : 0));
  if (scalars_.of_effects()) model_.airway().set_pressures(scalars_.values());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::close(PetscReal volume, Vec local_F, Vec X, Vec F)
{
  PetscFunctionBeginUser;
  volume_ = volume + scalars_.stored(scalars_.values());
  PetscCall(model_.airway().close_rows(X, F));
  PetscCall(scalars_.close(equation(), volume, local_F, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::unmet(PetscReal volume, Vec local_F, Unmet &unmet)
{
  const PetscReal gas = volume + scalars_.stored(scalars_.values());

  PetscFunctionBeginUser;
  PetscCall(scalars_.close(equation(), volume, local_F, nullptr));
  unmet = Unmet();
  if (control() == Control::flow)
    unmet.volume = std::abs(gas - volume_target_);
  else if (mode_ == Mode::solved)
    unmet.pressure = std::abs(ventilator_pressure(gas_flow(gas)) - target_);
  unmet.pressure = std::max(unmet.pressure, scalars_.unmet());
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Airway::satisfied() const
{
  if (control() != Control::flow) return true;
  const PetscReal scale = std::max(std::abs(volume_target_), PetscReal(1e-3) * model_.composition().mesh().volume());
  return std::abs(volume_ - volume_target_) <= volume_tolerance * scale;
}

bool Airway::flow_on()
{
  const PetscReal mean = std::abs(volume_before_ - volume_begin_) / (time_before_ - phase_.begin);
  if (!facts_.flow_past_limit_points || phase_.control != Control::pressure || past_limit_) return false;
  flow_past_limit_ = *facts_.flow_past_limit_points > 0 ? *facts_.flow_past_limit_points : mean;
  past_limit_ = flow_past_limit_ > 0 && std::isfinite(flow_past_limit_);
  retake_ = false;
  return past_limit_;
}

PetscErrorCode Airway::pressure(Vec local, PetscReal &pressure)
{
  PetscFunctionBeginUser;
  if (mode_ == Mode::free) PetscCall(model_.airway().mean_pressure(local, pressure_));
  pressure = pressure_;
  PetscFunctionReturn(PETSC_SUCCESS);
}

Verdict Airway::judge(const Attempt &attempt)
{
  const PetscReal pressure = ventilator_pressure(attempt.flow);
  if (flows_)
    exceeds_ = inwards_ ? pressure >= target_ : pressure <= target_;
  else
    exceeds_ = !limited_ && phase_.limit && pressure > *phase_.limit;
  if (exceeds_) return Verdict::again;
  return limited_ != limited_before_ || returns() ? Verdict::kink : Verdict::accept;
}

void Airway::accept(const Attempt &attempt)
{
  before_ = scalars_.values();
  before_.front() = pressure_;
  ventilator_before_ = ventilator_pressure(attempt.flow);
  limited_before_ = limited_;
  past_limit_ = past_limit_ && !returns(); // a phase that prescribes a flow may be in between
  time_before_ = attempt.time;
  volume_before_ = attempt.volume + scalars_.stored(scalars_.values());
  over_ = false;
  if (flows_) return; // what is prescribed tells nothing of the patient
  highest_flow_ = std::max(highest_flow_, attempt.flow);
  highest_pressure_ = std::max(highest_pressure_, ventilator_before_);
  over_ = (phase_.trigger_flow && attempt.flow > *phase_.trigger_flow) ||
          (phase_.trigger_drop && ventilator_before_ < highest_pressure_ - *phase_.trigger_drop) ||
          (phase_.cycle && attempt.flow < *phase_.cycle * highest_flow_);
}

} // namespace pulmo
