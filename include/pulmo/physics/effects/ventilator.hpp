/// @file
/// Effect `ventilator`: what the machine does at the airway over time (Aviles-Rojas & Hurtado 2022, sections 2.5, 2.6
/// and 2.8).
///
/// With airflow: a pressure phase holds p on the open surfaces; a flow phase prescribes the outward flux
/// Q.N = -flow/area there (eq. 45, whose minus is lost in print), which adds int Q.N q to the mass balance, or keeps
/// one pressure, unknown until solved, on all of them.
/// Without airflow the gas pressure is uniform and loads the tissue: - int p J F^-T : Grad eta; in flow phases it is
/// the unknown that goes with the prescribed volume.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/numerical_gas_loss.hpp"

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

struct AirwayFluxKernels {
  /// f0 of the mass row: Q.N, mm/s.
  static void flux(const Point &point, const NoParameters &, PetscScalar f0[]) { f0[0] += point.step.airway_flux; }
};

class Ventilator final : public Effect {
public:
  const char *name() const override { return "ventilator"; }
  const char *about() const override
  {
    return "PCV, VCV, supersyringe or a programme of phases (sections 2.5, 2.6, 2.8)";
  }
  const char *absence() const override { return "no ventilator: the airway stays at atmospheric pressure"; }
  bool active() const override { return mode_ != "off"; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.choice("", {"off", "pcv", "vcv", "supersyringe", "programme"}, "mode of ventilation", mode_));
    const bool pcv = mode_ == "pcv", vcv = mode_ == "vcv", syringe = mode_ == "supersyringe";
    if (vcv) {
      pause_ = 0.25;
      ramp_ = 0;
    }
    if (syringe) {
      inspiration_ = 0.3;
      pause_ = 2;
    }

    options.group(name(), "pressure control", pcv, "-ventilator pcv");
    PetscCall(options.real("pip", "cmH2O", Range::any(), "peak inspiratory pressure above atmospheric", pip_));
    options.group(name(), "volume control", vcv, "-ventilator vcv");
    PetscCall(options.real("tidal_volume", "ml", Range::positive(), "volume of one inspiration, of the whole mesh",
                           tidal_volume_));
    options.group(name(), "supersyringe", syringe, "-ventilator supersyringe");
    PetscCall(
        options.whole("steps", "-", Range::between(1, 100000), "steps of inflation, and as many of deflation", steps_));
    PetscCall(options.real("step_volume", "ml", Range::positive(), "volume of one step", step_volume_));
    options.group(name(), "pressure and volume control", pcv || vcv, "-ventilator pcv or vcv");
    PetscCall(options.real("peep", "cmH2O", Range::any(), "positive end-expiratory pressure", peep_));
    PetscCall(options.real("expiration", "s", Range::positive(), "duration of expiration", expiration_));
    PetscCall(options.real("ramp", "s", Range::not_negative(),
                           "rise of pressure (vcv, default 0: of flow) at the start of inspiration", ramp_));
    PetscCall(options.real("ramp_down", "s", Range::not_negative(),
                           "fall of pressure at the start of expiration (0: within the first step)", ramp_down_));
    options.group(name(), "all but programme", pcv || vcv || syringe, "-ventilator pcv, vcv or supersyringe");
    PetscCall(options.real("inspiration", "s", Range::positive(),
                           "duration of inspiration (supersyringe, default 0.3: of the flow of a step)", inspiration_));
    PetscCall(options.real("pause", "s", Range::not_negative(),
                           "duration of the end-inspiratory pause (default: pcv 0, vcv 0.25, supersyringe 2 after "
                           "each step)",
                           pause_));
    PetscCall(options.whole("breaths", "-", Range::between(1, 100000), "number of breaths (supersyringe: manoeuvres)",
                            breaths_));
    options.group(name(), "programme", mode_ == "programme", "-ventilator programme");
    PetscCall(options.text("programme", "file of phases (docs/ventilator.md)", file_));
    PetscCall(options.real("dt_scale", "-", Range::positive(), "factor of each 'dt' in that file", dt_scale_));
    options.group(name(), "settling", active(), "-ventilator pcv, vcv, supersyringe or programme");
    PetscCall(options.choice("settle", {"auto", "on", "off"},
                             "whether a phase 'settle', which is no breath, comes before the first one: auto: where "
                             "PEEP or a load moves the lung at rest; off: for PEEP only",
                             settle_));
    options.tolerate("settle"); // scenes/paper.opts goes with every scene
    if (pcv || vcv) settle_duration_ = ramp_ + expiration_;
    PetscCall(options.real("settle_duration", "s", Range::positive(),
                           "duration of that phase (default: pcv and vcv ramp + expiration, else 2)",
                           settle_duration_));
    options.group(name(), "prescribed flow", active() && !pcv, "-ventilator vcv, supersyringe or programme");
    PetscCall(options.choice("flow_split", {"auto", "uniform", "common_pressure"},
                             "how patches of airway share a prescribed flow: uniform: by area (the paper's reading); "
                             "common_pressure: so that they have one pressure; auto: common_pressure where there is "
                             "more than one patch",
                             split_));
    options.tolerate("flow_split");
    const bool pressures = pcv || mode_ == "programme";
    options.group(name(), "limit points", pressures, "-ventilator pcv or programme");
    PetscCall(options.choice("on_limit_point", {"stop", "flow"},
                             "what happens where the lung holds no more of a prescribed pressure: stop: the run ends; "
                             "flow: a flow is prescribed from there on, until the pressure can be held again",
                             on_limit_point_));
    options.group(name(), "flow past limit points", pressures && on_limit_point_ == "flow",
                  "-ventilator_on_limit_point flow");
    PetscCall(options.real("limit_point_flow", "ml/s", Range::not_negative(),
                           "size of that flow (0: the mean flow of the phase up to there)", limit_point_flow_));

    PetscCall(check_settings(options));
    if (mode_ == "programme") {
      PulmoUserCheck(
          !file_.empty(), options.comm(),
          "-ventilator programme needs -ventilator_programme FILE (docs/ventilator.md shows how to write it)");
      PetscCall(read_programme(options.comm(), "-ventilator_programme", file_, read_));
      for (Phase &phase : read_)
        if (phase.dt) *phase.dt *= dt_scale_;
      PulmoUserCheck(on_limit_point_ == "stop" || Programme(read_).prescribes_pressure(), options.comm(),
                     "-ventilator_on_limit_point flow: no phase of %s prescribes a pressure, and a flow passes limit "
                     "points anyway; leave the option out",
                     file_.c_str());
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.ventilator = std::make_shared<Programme>(programme());
    facts.programme_again = [this](bool settles) { return programme(settles); };
    if (on_limit_point_ == "flow") facts.flow_past_limit_points = limit_point_flow_ * units::mm3_per_ml;
    facts.settling.off = settle_ == "off" && begins_with_breath() && !settles();
    facts.settling.pressure = starting_pressure() != 0;
    if (settle_ == "auto" && begins_with_breath() && !settles())
      facts.settling.programme = std::make_shared<Programme>(programme(true));
    facts.flow_split = split_ == "auto"      ? FlowSplit::automatic
                       : split_ == "uniform" ? FlowSplit::uniform
                                             : FlowSplit::common_pressure;
    return PETSC_SUCCESS;
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = UniformGasKernels;
    using P = NoParameters;

    PetscFunctionBeginUser;
    if (!facts.airflow) {
      c.residual("-J p F^-T : Grad eta", displacement, f1(volume_residual<P, K::gas_stress>));
      c.jacobian("gas stress", displacement, displacement, g3(volume_jacobian<P, K::gas_stress_by_displacement>));
      if (facts.unknown_opening_pressure()) c.solve_for_gas_pressure();
      c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, numerical_gas_loss>);
    }
    if (facts.free_airway())
      for (const std::string &surface : facts.airway_surfaces)
        c.surface_residual("Q.N q", surface, pressure, f0(surface_residual<P, AirwayFluxKernels::flux>));
    if (facts.flow_past_limit_points)
      c.signal("flow_past_limit_point", [](const SignalRow &row) { return row.past_limit ? 1.0 : 0.0; });
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// The phases, as far as they do not hang on what loads do at rest.
  Programme programme() const { return programme(settles()); }

private:
  /// Whether a phase `settle` comes first whatever loads do at rest.
  bool settles() const
  {
    if (settle_ == "on") return true;
    // off leaves PEEP its own: that is no load, and a breath that includes it is of no use
    return (settle_ == "auto" || mode_ != "programme") && begins_with_breath() && starting_pressure() != 0;
  }
  /// Phases before the first breath are a settling of the user's own.
  bool begins_with_breath() const { return mode_ != "programme" || read_.front().breath > 0; }
  /// The pressure that the airway has when the first breath begins, cmH2O.
  PetscReal starting_pressure() const
  {
    if (mode_ != "programme") return mode_ == "supersyringe" ? 0 : peep_;
    const Phase &first = read_.front();
    return first.control == Control::pressure ? first.from.value_or(0) / units::kPa_per_cmH2O : 0;
  }

  Programme programme(bool settle) const
  {
    ProgrammeBuilder b;
    if (settle)
      b.add("settle", 0, settle_duration_, Control::pressure, starting_pressure(),
            mode_ != "programme" && peep_ != 0 ? ramp_ : 0);
    if (mode_ == "programme")
      for (const Phase &phase : read_) b.append(phase);
    for (PetscInt breath = 1; mode_ != "programme" && breath <= breaths_; ++breath) {
      if (mode_ == "supersyringe") {
        const PetscReal flow = step_volume_ / inspiration_;
        for (PetscInt step = 0; step < 2 * steps_; ++step) {
          const bool up = step < steps_;
          b.add(up ? "inflation" : "deflation", breath, inspiration_, Control::flow, up ? flow : -flow);
          if (pause_ > 0) b.add("pause", breath, pause_, Control::flow, 0);
        }
        continue;
      }
      const bool vcv = mode_ == "vcv";
      if (vcv) // a ramp takes half its length from the plateau of flow
        b.add("inspiration", breath, inspiration_, Control::flow, tidal_volume_ / (inspiration_ - ramp_ / 2), ramp_);
      else
        b.add("inspiration", breath, inspiration_, Control::pressure, pip_, ramp_);
      if (pause_ > 0) b.add("pause", breath, pause_, vcv ? Control::flow : Control::pressure, vcv ? 0 : pip_);
      b.add("expiration", breath, expiration_, Control::pressure, peep_, ramp_down_);
    }
    return Programme(b.take());
  }

  /// Settings that contradict one another.
  PetscErrorCode check_settings(const Options &options) const
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(mode_ != "supersyringe" || steps_ * breaths_ <= 100000, options.comm(),
                   "-ventilator_steps %d times -ventilator_breaths %d are more than 100000 steps; lower one",
                   (int)steps_, (int)breaths_);
    if (mode_ != "pcv" && mode_ != "vcv") PetscFunctionReturn(PETSC_SUCCESS);
    PulmoUserCheck(ramp_ <= inspiration_, options.comm(),
                   "-ventilator_ramp %g s is longer than -ventilator_inspiration %g s; shorten the ramp", (double)ramp_,
                   (double)inspiration_);
    PulmoUserCheck(ramp_down_ <= expiration_, options.comm(),
                   "-ventilator_ramp_down %g s is longer than -ventilator_expiration %g s; shorten the ramp",
                   (double)ramp_down_, (double)expiration_);
    PulmoUserCheck(
        peep_ == 0 || ramp_ <= settle_duration_, options.comm(),
        "-ventilator_settle_duration %g s is shorter than -ventilator_ramp %g s, in which the pressure rises "
        "to PEEP; give a longer one",
        (double)settle_duration_, (double)ramp_);
    PulmoUserCheck(mode_ == "vcv" || pip_ >= peep_, options.comm(),
                   "-ventilator_pip %g cmH2O is below -ventilator_peep %g cmH2O; raise pip or lower peep", (double)pip_,
                   (double)peep_);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::string mode_ = "off", file_, split_ = "auto", settle_ = "auto", on_limit_point_ = "stop";
  PetscReal pip_ = 6, peep_ = 0, tidal_volume_ = 500, step_volume_ = 100;
  PetscReal inspiration_ = 1, pause_ = 0, expiration_ = 2, ramp_ = 0.1, ramp_down_ = 0;
  PetscReal settle_duration_ = 2, dt_scale_ = 1, limit_point_flow_ = 0;
  PetscInt breaths_ = 1, steps_ = 8;
  std::vector<Phase> read_;
};

} // namespace pulmo
