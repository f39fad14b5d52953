/// @file
/// Effect `ventilator`: what the machine does at the airway over time.
///
/// With airflow the pressure is prescribed on the open surfaces (Aviles-Rojas & Hurtado 2022, section 2.5).
/// Without airflow the gas pressure is uniform and loads the tissue: - int p J F^-T : Grad eta.
#pragma once

#include "pulmo/effect.hpp"
#include "pulmo/units.hpp"

namespace pulmo {

struct UniformGasKernels {
  /// f1 = -p J F^-T with the prescribed pressure.
  static void gas_stress(const Point &point, const NoParameters &, PetscScalar f1[])
  {
    for (int i = 0; i < 9; ++i) f1[i] -= point.step.gas_pressure * point.state.cof_F[i];
  }
  static void gas_stress_by_displacement(const Point &point, const NoParameters &, PetscScalar g3[])
  {
    add_cofactor_derivative(point.state.F, -point.step.gas_pressure, g3);
  }
};

class Ventilator final : public Effect {
public:
  const char *name() const override { return "ventilator"; }
  const char *about() const override { return "pressure-controlled ventilation (section 2.5)"; }
  bool active() const override { return mode_ != "off"; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.choice("", {"off", "pcv"}, "mode of ventilation", mode_));
    options.group(name(), about(), active(), "-ventilator pcv");
    PetscCall(options.real("pip", "cmH2O", Range::any(), "peak inspiratory pressure above atmospheric", pip_));
    PetscCall(options.real("peep", "cmH2O", Range::any(), "positive end-expiratory pressure", peep_));
    PetscCall(options.real("inspiration", "s", Range::positive(), "duration of inspiration", inspiration_));
    PetscCall(options.real("pause", "s", Range::not_negative(), "duration of the end-inspiratory pause", pause_));
    PetscCall(options.real("expiration", "s", Range::positive(), "duration of expiration", expiration_));
    PetscCall(options.real("ramp", "s", Range::not_negative(), "rise of pressure at the start of inspiration", ramp_));
    PetscCall(options.real("ramp_down", "s", Range::not_negative(),
                           "fall of pressure at the start of expiration (0: from the first step)", ramp_down_));
    PetscCall(options.whole("breaths", "-", Range::between(1, 100000), "number of breaths", breaths_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.ventilator = std::make_shared<Programme>(programme());
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(ramp_ <= inspiration_, options.comm(),
                   "-ventilator_ramp %g s is longer than -ventilator_inspiration %g s; shorten the ramp", (double)ramp_,
                   (double)inspiration_);
    PulmoUserCheck(ramp_down_ <= expiration_, options.comm(),
                   "-ventilator_ramp_down %g s is longer than -ventilator_expiration %g s; shorten the ramp",
                   (double)ramp_down_, (double)expiration_);
    PulmoUserCheck(pip_ >= peep_, options.comm(),
                   "-ventilator_pip %g cmH2O is below -ventilator_peep %g cmH2O; raise pip or lower peep", (double)pip_,
                   (double)peep_);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = UniformGasKernels;
    using P = NoParameters;

    PetscFunctionBeginUser;
    if (!facts.airflow) {
      c.residual("-J p F^-T : Grad eta", displacement, nullptr, volume_residual<P, K::gas_stress>);
      c.jacobian("gas stress", displacement, displacement, nullptr, nullptr, nullptr,
                 volume_jacobian<P, K::gas_stress_by_displacement>);
      c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, numerical_gas_loss>);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// The phases: with PEEP first `settle` (0 -> PEEP), then inspiration, pause, expiration of each breath.
  Programme programme() const
  {
    const PetscReal pip = pip_ * units::kPa_per_cmH2O, peep = peep_ * units::kPa_per_cmH2O;
    std::vector<Phase> phases;
    PetscReal t = 0;
    const auto add = [&](const char *name, PetscInt breath, PetscReal duration, PetscReal from, PetscReal to,
                         PetscReal ramp) {
      phases.push_back({name, breath, t, t + duration, from, to, ramp});
      t += duration;
    };
    if (peep_ != 0) add("settle", 0, ramp_ + expiration_, 0, peep, ramp_);
    for (PetscInt b = 1; b <= breaths_; ++b) {
      add("inspiration", b, inspiration_, peep, pip, ramp_);
      if (pause_ > 0) add("pause", b, pause_, pip, pip, 0);
      add("expiration", b, expiration_, pip, peep, ramp_down_);
    }
    return Programme(std::move(phases));
  }
  /// cmH2O.
  PetscReal peep() const { return peep_; }

private:
  std::string mode_ = "off";
  PetscReal pip_ = 6, peep_ = 0, inspiration_ = 1, pause_ = 0, expiration_ = 2, ramp_ = 0.1, ramp_down_ = 0;
  PetscInt breaths_ = 1;
};

} // namespace pulmo
