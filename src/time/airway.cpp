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
  if (!phase_.from) phase_.from = ventilator_before_;
  volume_begin_ = volume;
  first_step_ = first_step;
  limited_ = limited_before_ = retake_ = false;
}

PetscErrorCode Airway::persist(Archive &archive)
{
  PetscReal from = phase_.from.value_or(0);

  PetscFunctionBeginUser;
  PetscCall(archive.value("airway/phase_starts_from", from)); // kPa or mm^3/s
  phase_.from = from;
  PetscCall(archive.value("airway/limited", limited_before_));
  PetscCall(archive.value("airway/pressure_kPa", pressure_before_));
  PetscCall(archive.value("airway/ventilator_pressure_kPa", ventilator_before_));
  PetscCall(archive.value("airway/volume_at_phase_begin_mm3", volume_begin_));
  PetscCall(archive.value("airway/first_step_s", first_step_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Airway::set_mode()
{
  // the mean over a free surface is no pressure that can be held instead: a limit needs a common one
  if (control() == Control::flow)
    mode_ = facts_.free_airway() && !phase_.limit ? Mode::free : Mode::common;
  else
    mode_ = facts_.tube ? Mode::common : Mode::held;
}

PetscReal Airway::prescribed_pressure(PetscReal t, PetscReal step_end) const
{
  if (limited_) return *phase_.limit;
  // a jump of pressure is there from the start; where the first step has to be cut it is cut with it
  const PetscReal since = step_end - phase_.begin;
  if (phase_.ramp == 0 && since < first_step_) return *phase_.from + (phase_.to - *phase_.from) * since / first_step_;
  return phase_.value(t);
}

void Airway::begin_stage(PetscReal t, PetscReal step_end)
{
  limited_ = limited_before_ || retake_;
  retake_ = retake_ && scheme_.half_step(); // the whole step that follows belongs to the same attempt
  set_mode();
  if (control() == Control::flow)
    volume_target_ = volume_begin_ + phase_.delivered(t);
  else
    target_ = prescribed_pressure(t, step_end);
  pressure_ = mode_ == Mode::held ? target_ : pressure_before_; // not what a failed attempt left
}

PetscErrorCode Airway::guess(Vec X) const
{
  PetscFunctionBeginUser;
  if (mode_ != Mode::free) PetscCall(model_.set_airway_nodes(X, pressure_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::apply(Vec X)
{
  PetscFunctionBeginUser;
  if (mode_ == Mode::common && !frozen_) PetscCall(model_.carrier_value(X, pressure_));
  model_.hold_airway(mode_ != Mode::free);
  PetscCall(model_.set_step(scheme_.stage(), pressure_, mode_ == Mode::free ? flow() : 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Airway::close(PetscReal volume, Vec X, Vec F)
{
  PetscFunctionBeginUser;
  volume_ = volume;
  PetscCall(model_.close_rows(X, F));
  if (mode_ == Mode::common && !frozen_) {
    const PetscReal h = model_.composition().mesh().length(), Q = scheme_.flow(volume);
    const PetscReal c = control() == Control::flow ? (volume - volume_target_) / (h * h * h)
                                                   : (ventilator_pressure(Q) - target_) / model_.modulus();
    PetscCall(model_.set_carrier_value(F, c));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscReal Airway::change(PetscReal c, PetscReal c_P, PetscReal volume_fixed, PetscReal volume_per_P) const
{
  const PetscReal h = model_.composition().mesh().length();
  const PetscReal c_V = control() == Control::flow
                            ? 1 / (h * h * h)
                            : facts_.tube->slope(scheme_.flow(volume_)) * scheme_.slope() / model_.modulus();
  return -(c + c_V * volume_fixed) / (c_P + c_V * volume_per_P);
}

Airway::Unmet Airway::unmet(PetscReal volume) const
{
  Unmet unmet;
  if (control() == Control::flow)
    unmet.volume = std::abs(volume - volume_target_);
  else if (mode_ == Mode::common)
    unmet.pressure = std::abs(ventilator_pressure(scheme_.flow(volume)) - target_);
  return unmet;
}

bool Airway::satisfied() const
{
  if (control() != Control::flow) return true;
  const PetscReal scale = std::max(std::abs(volume_target_), PetscReal(1e-3) * model_.composition().mesh().volume());
  return std::abs(volume_ - volume_target_) <= volume_tolerance * scale;
}

PetscErrorCode Airway::pressure(Vec local, PetscReal &pressure)
{
  PetscFunctionBeginUser;
  if (mode_ == Mode::free) PetscCall(model_.airway_mean_pressure(local, pressure_));
  pressure = pressure_;
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Airway::limit(PetscReal flow)
{
  if (limited_) return false;
  retake_ = phase_.limit && ventilator_pressure(flow) > *phase_.limit;
  return retake_;
}

} // namespace pulmo
