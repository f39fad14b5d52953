/// @file
/// Effect `tube`: the endotracheal tube between ventilator and airway.
///
/// Pressure drop after Rohrer (1915): P_ventilator - P_airway = K1 Q + K2 |Q| Q with the flow Q into the lung; K2 = 0
/// is a linear resistance. The tube ends in one airway pressure, which a pressure phase leaves to be solved for; in
/// flow phases the drop is only added to what the ventilator shows.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/physics/effect.hpp"

namespace pulmo {

class Tube final : public Effect {
public:
  const char *name() const override { return "tube"; }
  const char *about() const override { return "endotracheal tube, pressure drop K1 Q + K2 |Q| Q (Rohrer 1915)"; }
  const char *absence() const override { return "nothing resists between ventilator and airway"; }
  std::string example() const override { return "-tube -tube_k1 20"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "a tube between ventilator and airway", on_));
    options.group(name(), about(), on_, "-tube");
    PetscCall(options.real("k1", "cmH2O s/l", Range::not_negative(), "linear coefficient", k1_));
    PetscCall(options.real("k2", "cmH2O s^2/l^2", Range::not_negative(), "quadratic coefficient", k2_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.tube = resistance();
    facts.tube_again = [this] { return resistance(); };
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(k1_ > 0 || k2_ > 0, options.comm(),
                   "-tube has no resistance: give -tube_k1, -tube_k2 or both, or leave -tube out");
    PulmoUserCheck(facts.ventilator, options.comm(), "-tube needs a -ventilator at its other end");
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  AirwayResistance resistance() const
  {
    constexpr PetscReal mm3_per_l = 1000 * units::mm3_per_ml;
    return {k1_ * units::kPa_per_cmH2O / mm3_per_l, k2_ * units::kPa_per_cmH2O / (mm3_per_l * mm3_per_l)};
  }

  bool on_ = false;
  PetscReal k1_ = 0, k2_ = 0;
};

} // namespace pulmo
