/// @file
/// Effect `surfactant`: surface tension of the film that lines the alveoli, with its hysteresis.
///
/// The film's area grows as A = A0 J^(2/3), its energy per reference volume by gamma S0 d(J^(2/3)), S0 = A0/V0, so that
/// it adds to the stress
///   P' += (p_gamma - p_rest) cof F,   p_gamma = (2/3) S0 gamma J^(-1/3),   p_rest = (2/3) S0 gamma_eq
/// p_rest is what the film pulls in the geometry at rest: the tissue that is measured there bears it already, and
/// without it the lung would collapse at no pressure. Surface tension by compression and relaxation (after Saad,
/// Neumann & Acosta 2010):
///   d gamma/dt = k (gamma_eq - gamma) + eps d(ln A)/dt,   gamma_min <= gamma <= gamma_max
/// with k = k_a (adsorption) where gamma >= gamma_eq and k_r (relaxation) below, eps = eps_c while A shrinks and eps_e
/// while it grows. Rates are those of the time scheme, of gamma and of ln A, which are both remembered: a film that is
/// stretched and released faster than it relaxes comes back to where it was, however large the steps. The equation at
/// the end of a step is linear on each branch and solved for gamma exactly. `-surfactant_gamma constant`: gamma =
/// gamma_eq always, which softens the lung: p_gamma falls as J grows.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/law_range.hpp"

#include <cmath>

namespace pulmo {

struct SurfactantKernels {
  struct Parameters {
    static constexpr const char *owner = "surfactant";
    PetscScalar gamma_eq = 23, gamma_min = 2, gamma_max = 70; ///< mN/m
    PetscScalar adsorption = 2, relaxation = 0.1;             ///< k_a, k_r, 1/s
    PetscScalar compression = 120, expansion = 140;           ///< eps_c, eps_e, mN/m
    PetscScalar area = 30;                                    ///< S0, 1/mm
  };

  /// What is remembered.
  enum Remembered { tension, log_area };

  /// gamma in a state, mN/m, and its derivative by ln A.
  struct Film {
    PetscScalar log_A, gamma, by_log_A;
  };

  template <bool Dynamic>
  static Film film(const Point &point, const Parameters &k)
  {
    Film f{2.0 / 3 * std::log1p(point.state.J_minus_1), k.gamma_eq, 0};
    if (!Dynamic || !point.memory.last) return f;
    const PetscScalar a = point.step.slope, stretching = a * f.log_A + point.past(log_area);
    const PetscScalar epsilon = stretching < 0 ? k.compression : k.expansion;
    // a gamma + past = k (gamma_eq - gamma) + eps stretching; which k is told by the right-hand side at gamma_eq
    const PetscScalar drive = epsilon * stretching - point.past(tension) - a * k.gamma_eq;
    const PetscScalar divisor = a + (drive >= 0 ? k.adsorption : k.relaxation);
    f.gamma += drive / divisor;
    f.by_log_A = epsilon * a / divisor;
    if (f.gamma <= k.gamma_min || f.gamma >= k.gamma_max) {
      f.gamma = f.gamma <= k.gamma_min ? k.gamma_min : k.gamma_max;
      f.by_log_A = 0;
    }
    return f;
  }

  /// (2/3) S0 J^(-1/3), kPa by mN/m.
  static PetscScalar pull(const Point &point, const Parameters &k)
  {
    return 2.0 / 3 * units::kPa_mm_per_mN_m * k.area / std::cbrt(point.state.J);
  }
  /// p_rest, kPa.
  static PetscScalar at_rest(const Parameters &k) { return 2.0 / 3 * units::kPa_mm_per_mN_m * k.area * k.gamma_eq; }

  /// d(p_gamma)/dJ of a film of constant tension, kPa.
  static PetscReal stiffness(PetscReal J, const PetscScalar constants[])
  {
    return -at_rest(constants::get<Parameters>(constants)) / (3 * J * std::cbrt(J));
  }

  /// f1 = (p_gamma - p_rest) cof F.
  template <bool Dynamic>
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const PetscScalar excess = pull(point, k) * film<Dynamic>(point, k).gamma - at_rest(k);
    for (int i = 0; i < 9; ++i) f1[i] += excess * point.state.cof_F[i];
  }
  /// g3 = (p_gamma - p_rest) d(cof F)/dF + dp_gamma/dJ cof F x cof F.
  template <bool Dynamic>
  static void stress_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    const PointState &s = point.state;
    const Film f = film<Dynamic>(point, k);
    const PetscScalar factor = pull(point, k), by_J = factor * (2 * f.by_log_A - f.gamma) / (3 * s.J);
    add_cofactor_derivative(s.F, factor * f.gamma - at_rest(k), g3);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int m = 0; m < 9; ++m) g3[27 * i + 9 * j + m] += by_J * s.cof_F[3 * i + m / 3] * s.cof_F[3 * j + m % 3];
  }
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    const Film f = film<true>(point, k);
    value[tension] = f.gamma;
    value[log_area] = f.log_A;
  }

  /// Growth of the energy of a film of constant tension, gamma_eq S0 J^(2/3) - p_rest J, kPa.
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    const PetscScalar J = before.state.J, growth = now.state.J_minus_1 - before.state.J_minus_1;
    const PetscScalar area = std::cbrt(J * J) * std::expm1(2.0 / 3 * std::log1p(growth / J));
    return units::kPa_mm_per_mN_m * k.area * k.gamma_eq * area - at_rest(k) * growth;
  }
  /// What backward Euler loses in it.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar work = 0;
    for (int i = 0; i < 9; ++i) work += now.state.cof_F[i] * (now.state.H[i] - before.state.H[i]);
    return (pull(now, k) * k.gamma_eq - at_rest(k)) * work - stored(now, before, k);
  }
  /// Work that a film takes up beyond one of constant tension, kPa: over a breath the area of its loop.
  static PetscScalar loop(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar work = 0;
    for (int i = 0; i < 9; ++i) work += now.state.cof_F[i] * (now.state.H[i] - before.state.H[i]);
    return pull(now, k) * (film<true>(now, k).gamma - k.gamma_eq) * work;
  }
};

class Surfactant final : public Effect {
public:
  const char *name() const override { return "surfactant"; }
  const char *about() const override { return "surface tension of the alveoli (after Saad, Neumann & Acosta 2010)"; }
  const char *absence() const override
  {
    return "no surface tension of its own, but for what the tissue law holds of it";
  }
  std::string example() const override
  {
    // stiff enough films that all branches of gamma are met, and a lung that stays stable
    return "-surfactant -surfactant_gamma_eq 5 -surfactant_area 10 -surfactant_gamma_min 4.9";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    auto &k = parameters_;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "a film of surfactant pulls in the alveoli", on_));
    options.group(name(), about(), on_, "-surfactant");
    PetscCall(options.choice("gamma", {"dynamic", "constant"}, "surface tension: with hysteresis, or gamma_eq always",
                             gamma_));
    PetscCall(options.real("gamma_eq", "mN/m", Range::not_negative(), "surface tension of a film at rest", k.gamma_eq));
    PetscCall(
        options.real("gamma_min", "mN/m", Range::not_negative(), "at which a compressed film collapses", k.gamma_min));
    PetscCall(options.real("gamma_max", "mN/m", Range::not_negative(), "of a surface without a film", k.gamma_max));
    PetscCall(options.real("adsorption", "1/s", Range::not_negative(), "rate back to gamma_eq from above, k_a",
                           k.adsorption));
    PetscCall(options.real("relaxation", "1/s", Range::not_negative(), "rate back to gamma_eq from below, k_r",
                           k.relaxation));
    PetscCall(options.real("compression", "mN/m", Range::not_negative(), "elasticity of a film that shrinks, eps_c",
                           k.compression));
    PetscCall(options.real("expansion", "mN/m", Range::not_negative(), "elasticity of a film that grows, eps_e",
                           k.expansion));
    PetscCall(options.real("area", "1/mm", Range::not_negative(), "surface per volume at rest, S0", k.area));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.film_stiffness = SurfactantKernels::stiffness;
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    PetscCall(tell_softening(options.comm(), *facts.law));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = SurfactantKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    c.require({[](const PetscScalar constants[]) {
                 const auto k = constants::get<P>(constants);
                 return k.gamma_min <= k.gamma_eq && k.gamma_eq <= k.gamma_max;
               },
               "-surfactant_gamma_eq is not between -surfactant_gamma_min and -surfactant_gamma_max in some part of "
               "the lung (or all of it); give others there"});
    if (gamma_ == "constant") {
      c.residual("(p_gamma - p_rest) cof F : Grad eta", displacement, f1(volume_residual<P, K::stress<false>>));
      c.jacobian("surface tension", displacement, displacement,
                 g3(volume_jacobian<P, K::stress_by_displacement<false>>));
    } else {
      c.remember({{"surface_tension", "mN/m"}, {"log_surface_area", "-"}}, remembered<P, K::remember>);
      c.residual("(p_gamma - p_rest) cof F : Grad eta", displacement, f1(volume_residual<P, K::stress<true>>));
      c.jacobian("surface tension", displacement, displacement,
                 g3(volume_jacobian<P, K::stress_by_displacement<true>>));
      c.energy(Energy::dissipated, "viscous_surface", "", energy_density<P, K::loop>);
    }
    c.energy(Energy::stored, "elastic_surface", "", energy_density<P, K::stored>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  static constexpr PetscReal widest = 4; ///< J beyond which lungs do not grow

  /// Where the pressure of uniform inflation stops to rise, or J = widest.
  struct Limit {
    PetscReal J, pressure; ///< -, kPa
    PetscReal at_rest;     ///< dp/dJ at J = 1, kPa
  };
  static Limit limit(const TissueLaw &law, const SurfactantKernels::Parameters &k)
  {
    const auto pressure = [&](PetscReal J) {
      return inflation_pressure(law, J) + SurfactantKernels::at_rest(k) * (1 / std::cbrt(J) - 1);
    };
    constexpr PetscReal step = 1e-3;
    Limit l{widest, 0, (pressure(1 + step) - pressure(1 - step)) / (2 * step)};
    for (PetscReal J = 1, next; J < widest; J += step)
      if (next = pressure(J + step); next < pressure(J)) {
        l.J = J;
        break;
      }
    l.pressure = pressure(l.J);
    return l;
  }
  /// A film that is given time pulls with gamma_eq, and less the larger the alveoli are.
  PetscErrorCode tell_softening(MPI_Comm comm, const TissueLaw &law) const
  {
    SurfactantKernels::Parameters none = parameters_;

    PetscFunctionBeginUser;
    none.area = 0;
    const Limit with = limit(law, parameters_), without = limit(law, none);
    if (with.J < widest && with.J < without.J) {
      PetscCall(
          PetscPrintf(comm,
                      "pulmo: warning: -surfactant with -tissue %s: at constant surface tension the pressure of "
                      "uniform inflation rises to %.3g cmH2O at J = %.3g and falls beyond (without a film: %.3g "
                      "cmH2O at J = %.3g%s; dp/dJ at rest: %.3g kPa, without %.3g): past that only springs or its "
                      "neighbours hold tissue\n",
                      law.name(), (double)(with.pressure / units::kPa_per_cmH2O), (double)with.J,
                      (double)(without.pressure / units::kPa_per_cmH2O), (double)without.J,
                      without.J < widest ? "" : " and still rising", (double)with.at_rest, (double)without.at_rest));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  bool on_ = false;
  std::string gamma_ = "dynamic";
  SurfactantKernels::Parameters parameters_;
};

} // namespace pulmo
