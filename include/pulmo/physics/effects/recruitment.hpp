/// @file
/// Effect `recruitment`: airspaces that are closed open above one pressure and close below another, and take up volume.
///
/// Each point has an open share x in [0, 1] (after Bates & Irvin 2002):
///   dx/dt = s_o (p - p_o)_+ - s_c (p_c - p)_+,   0 <= x <= 1,
/// with the local transpulmonary pressure p: that of the gas, what `prestress` adds, and the pull of the muscles. What
/// is open takes up its volume without stress: the stress-free state grows by J_r = (1 + a x) / (1 + a x_0), and the
/// energy per volume of the mesh is J_r W(F J_r^(-1/3)). Air is J - 1 + Phi0 as ever, so mass is conserved as ever. The
/// rate is that of the time scheme, at the end of the step, and x is clipped then; where it is not, x depends on p, and
/// so does the stress. Through airspaces that are closed less gas may flow: the permeability is that of the airflow
/// times eps + (1 - eps) x, which takes the flux -(1 - eps) (1 - x) Q away.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/physics/effect.hpp"

namespace pulmo {

struct RecruitmentKernels {
  struct Parameters {
    static constexpr const char *owner = "recruitment";
    PetscScalar opening_pressure = 12;   ///< p_o, cmH2O
    PetscScalar closing_pressure = 4;    ///< p_c, cmH2O
    PetscScalar opening_rate = 0.5;      ///< s_o, 1/(cmH2O s)
    PetscScalar closing_rate = 0.2;      ///< s_c, 1/(cmH2O s)
    PetscScalar gain = 0.5;              ///< a
    PetscScalar start = 0;               ///< x_0
    PetscScalar prestress = 0;           ///< transpulmonary pressure where that of the gas is 0, kPa
    PetscScalar suction = 0;             ///< SceneFacts::pleural_suction, as constants::to_scalar() packs it
    PetscScalar stress = 0, tangent = 0; ///< LawFunctions, as constants::to_scalar() packs them
  };

  struct Share {
    PetscScalar x, dx_dp; ///< 1, 1/kPa
  };
  /// x at the end of the step.
  static Share open(const Point &point, const Parameters &k)
  {
    if (!point.memory.last) return {k.start, 0};
    if (point.step.last_weight == 0) return {point.memory.last[0], 0}; // no step: TimeScheme asks for the gas at hand
    const auto suction = constants::to_pointer<decltype(SceneFacts::pleural_suction)>(k.suction);
    const PetscScalar pull = k.prestress + (suction ? suction(point.t, point.constants) : 0),
                      p = (point.gas_pressure() + pull) / units::kPa_per_cmH2O, a = point.step.slope;
    const PetscScalar rate =
        k.opening_rate * std::max(p - k.opening_pressure, 0.) - k.closing_rate * std::max(k.closing_pressure - p, 0.);
    const PetscScalar slope = p > k.opening_pressure ? k.opening_rate : p < k.closing_pressure ? k.closing_rate : 0;
    const PetscScalar x = (rate - point.past(0)) / a;
    if (x <= 0) return {0, 0};
    if (x >= 1) return {1, 0};
    return {x, slope / (a * units::kPa_per_cmH2O)};
  }

  static PetscScalar volume_ratio(PetscScalar x, const Parameters &k)
  {
    return (1 + k.gain * x) / (1 + k.gain * k.start);
  }
  static void stress_free(const Point &point, const PetscScalar constants[], When when, PetscScalar G[9])
  {
    const auto k = constants::get<Parameters>(constants);
    const Point own = point.as_seen_by<Parameters>(constants);
    const PetscScalar x = when == When::now ? open(own, k).x : own.memory.last ? own.memory.last[0] : k.start;
    const PetscScalar shrink = 1 / std::cbrt(volume_ratio(x, k));
    for (int i = 0; i < 9; ++i) G[i] *= shrink;
  }

  /// Adds dP/dp to @p to. With G = s G' it is dP/ds = ((dP/dF) : F - 2 P) / s that x changes.
  static void stress_by_pressure(const Point &point, const PetscScalar constants[], PetscScalar to[9])
  {
    const auto k = constants::get<Parameters>(constants);
    const Share share = open(point.as_seen_by<Parameters>(constants), k);
    if (share.dx_dp == 0) return;
    PetscScalar P[9] = {0}, A[81] = {0};
    constants::to_pointer<LawFunctions::Stress>(k.stress)(point, P);
    constants::to_pointer<LawFunctions::Tangent>(k.tangent)(point, A);
    const PetscScalar relative = -k.gain / (3 * (1 + k.gain * share.x)) * share.dx_dp; // (ds/dp) / s
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) {
        PetscScalar along = 0;
        for (int m = 0; m < 3; ++m)
          for (int L = 0; L < 3; ++L) along += A[27 * i + 9 * m + 3 * J + L] * point.state.F[3 * m + L];
        to[3 * i + J] += relative * (along - 2 * P[3 * i + J]);
      }
  }
  /// g2 of (displacement, pressure).
  static void tangent_by_pressure(const Point &point, const Parameters &, PetscScalar g2[])
  {
    stress_by_pressure(point, point.constants, g2);
  }
  /// x, and the volume that what is open takes up at the strain at hand, per volume of the mesh: J (1 - 1 / (1 + a x)).
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    value[0] = open(point, k).x;
    value[1] = point.state.J * k.gain * value[0] / (1 + k.gain * value[0]);
  }
};

/// What closed airspaces take away from the flux of airflow.
struct ClosedFlowKernels {
  struct Flow {
    static constexpr const char *owner = "recruitment_flow";
    PetscScalar permeability = 1; ///< eps, share of the permeability that is left where all is closed
    // FluxFunctions, as constants::to_scalar() packs them; those of a force on the gas are 0 where there is none
    PetscScalar flux = 0, flux_by_displacement = 0, flux_by_pressure = 0, dissipation = 0;
    PetscScalar force_flux = 0, force_flux_by_displacement = 0, force_work = 0, force_heat = 0;
  };
  using Parameters = Both<RecruitmentKernels::Parameters, Flow>;

  /// -(1 - eps) (1 - x), and its derivative by p, 1/kPa.
  struct Missing {
    PetscScalar share, by_p;
  };
  static Missing missing(const Point &point, const Parameters &k)
  {
    const RecruitmentKernels::Share open = RecruitmentKernels::open(point, k.own);
    const PetscScalar closed = 1 - k.other.permeability;
    return {-closed * (1 - open.x), closed * open.dx_dp};
  }

  static void flux(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    add<3>(missing(point, k).share, {k.other.flux, k.other.force_flux}, point, f1);
  }
  static void flux_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    add<27>(missing(point, k).share, {k.other.flux_by_displacement, k.other.force_flux_by_displacement}, point, g3);
  }
  static void flux_by_pressure(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    add<9>(missing(point, k).share, {k.other.flux_by_pressure, 0}, point, g3);
  }
  /// g2 of (mass, pressure), by way of x.
  static void flux_by_share(const Point &point, const Parameters &k, PetscScalar g2[])
  {
    add<3>(missing(point, k).by_p, {k.other.flux, k.other.force_flux}, point, g2);
  }
  /// Heat of the flow, and work of a force on it, that there is not.
  static PetscScalar heat(const Point &now, const Point &, const Parameters &k)
  {
    return missing(now, k).share * sum({k.other.dissipation, k.other.force_heat}, now);
  }
  static PetscScalar work(const Point &now, const Point &, const Parameters &k)
  {
    return missing(now, k).share * sum({k.other.force_work, 0}, now);
  }

private:
  using Functions = std::array<PetscScalar, 2>;

  /// Adds @p share of what the functions say.
  template <int n>
  static void add(PetscScalar share, const Functions &functions, const Point &point, PetscScalar to[])
  {
    if (share == 0) return;
    PetscScalar whole[n] = {0};
    for (const PetscScalar f : functions)
      if (const auto function = constants::to_pointer<FluxFunctions::Function>(f)) function(point, whole);
    for (int i = 0; i < n; ++i) to[i] += share * whole[i];
  }
  static PetscScalar sum(const Functions &functions, const Point &point)
  {
    PetscScalar all = 0;
    for (const PetscScalar f : functions)
      if (const auto function = constants::to_pointer<FluxFunctions::Energy>(f)) all += function(point);
    return all;
  }
};

class Recruitment final : public Effect {
public:
  const char *name() const override { return "recruitment"; }
  const char *about() const override { return "airspaces open and close by pressure (after Bates & Irvin 2002)"; }
  const char *absence() const override { return "airspaces neither open nor close"; }
  /// Low thresholds, so that a gentle breath crosses them.
  std::string example() const override
  {
    return "-recruitment -recruitment_opening_pressure 0.4 -recruitment_closing_pressure 0.2 -recruitment_gain 0.2 "
           "-recruitment_start 0.3";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    RecruitmentKernels::Parameters &k = parameters_;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "airspaces open and close by pressure", on_));
    options.group(name(), about(), on_, "-recruitment");
    PetscCall(options.real("opening_pressure", "cmH2O", Range::any(),
                           "transpulmonary pressure above which airspaces open", k.opening_pressure));
    PetscCall(options.real("closing_pressure", "cmH2O", Range::any(),
                           "transpulmonary pressure below which airspaces close", k.closing_pressure));
    PetscCall(options.real("opening_rate", "1/(cmH2O s)", Range::not_negative(),
                           "share that opens in a second for each cmH2O above that", k.opening_rate));
    PetscCall(options.real("closing_rate", "1/(cmH2O s)", Range::not_negative(),
                           "share that closes in a second for each cmH2O below that", k.closing_rate));
    PetscCall(options.real("gain", "-", Range::not_negative(),
                           "volume that the tissue gains when all airspaces open, over that with all closed", k.gain));
    PetscCall(options.real("start", "-", Range::between(0, 1), "share that is open in the shape of the mesh", k.start));
    PetscCall(options.real("permeability", "-", Range::between(1e-6, 1),
                           "share of the permeability that is left where all airspaces are closed; 1: all of it",
                           flow_.permeability));
    slows_ = flow_.permeability != 1 || options.varies(flow_.permeability);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.stress_free.push_back(RecruitmentKernels::stress_free);
    facts.stress_by_pressure = RecruitmentKernels::stress_by_pressure;
    if (slows_)
      facts.least_permeability = [](const PetscScalar c[]) -> PetscReal {
        return constants::get<ClosedFlowKernels::Flow>(c).permeability;
      };
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(facts.airflow || facts.ventilator, options.comm(),
                   "-recruitment needs a gas pressure: give -ventilator, -airflow or both");
    PulmoUserCheck(facts.airflow || !slows_, options.comm(),
                   "-recruitment_permeability needs gas that flows: give -airflow, or leave it out");
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = RecruitmentKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    const LawFunctions law = facts.law->functions(true);
    parameters_.stress = constants::to_scalar(law.stress);
    parameters_.tangent = constants::to_scalar(law.tangent);
    parameters_.suction = constants::to_scalar(facts.pleural_suction);
    parameters_.prestress = facts.prestress ? facts.prestress->pressure : 0;
    c.parameters(parameters_);
    c.require(
        {[](const PetscScalar constants[]) {
           const auto k = constants::get<P>(constants);
           return k.closing_pressure <= k.opening_pressure;
         },
         "-recruitment_closing_pressure is above -recruitment_opening_pressure in some part of the lung (or all of "
         "it): between the two airspaces would open and close at once; give that part a lower one"});
    c.remember({{"open_share", "1"}, {"recruited_volume", "1"}}, remembered<P, K::remember>);
    c.average(0, "open_share");
    c.integrate(1, "recruited_volume_ml", 1 / units::mm3_per_ml);
    if (facts.airflow) c.jacobian("dP'/dp", displacement, pressure, g2(volume_jacobian<P, K::tangent_by_pressure>));
    c.energy(Energy::dissipated, "recruitment", "", facts.law->callbacks(true).released);
    if (slows_) flow_terms(c, facts);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  void flow_terms(Composition &c, const SceneFacts &facts) const
  {
    using K = ClosedFlowKernels;
    using P = K::Parameters;
    const FluxFunctions law = facts.permeability->functions();
    flow_.flux = constants::to_scalar(law.flux);
    flow_.flux_by_displacement = constants::to_scalar(law.flux_by_displacement);
    flow_.flux_by_pressure = constants::to_scalar(law.flux_by_pressure);
    flow_.dissipation = constants::to_scalar(law.dissipation);
    if (facts.gravity) { // which brings a force on the gas
      flow_.force_flux = constants::to_scalar(law.force_flux);
      flow_.force_flux_by_displacement = constants::to_scalar(law.force_flux_by_displacement);
      flow_.force_work = constants::to_scalar(law.force_work);
      flow_.force_heat = constants::to_scalar(law.force_heat);
    }
    c.parameters(flow_);
    c.residual("(1 - eps) (1 - x) Q . Grad q", pressure, f1(volume_residual<P, K::flux>));
    c.jacobian("flux of the closed", pressure, displacement, g3(volume_jacobian<P, K::flux_by_displacement>));
    c.jacobian("flux of the closed", pressure, pressure, g2(volume_jacobian<P, K::flux_by_share>),
               g3(volume_jacobian<P, K::flux_by_pressure>));
    c.energy(Energy::dissipated, "resistive", "", energy_density<P, K::heat>);
    if (facts.gravity) c.energy(Energy::external, "external", "", energy_density<P, K::work>);
  }

  bool on_ = false, slows_ = false; ///< slows_: what is closed lets less gas through
  mutable RecruitmentKernels::Parameters parameters_;
  mutable ClosedFlowKernels::Flow flow_;
};

} // namespace pulmo
