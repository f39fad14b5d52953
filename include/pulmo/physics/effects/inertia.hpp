/// @file
/// Effect `inertia`: mass of tissue and air resists acceleration.
///
/// With the density per reference volume R = (1 - Phi0) rho_t + (J - 1 + Phi0) rho_a (Phi0: -tissue_porosity) and the
/// acceleration a of the tissue:
///   momentum: adds  + int R a . eta
/// The velocity is remembered at the points of the cells, so that a = slope v + past(v) as every rate has it: each time
/// scheme keeps its order. A run starts at rest, v = 0.
///
/// The gas is carried along with the tissue. Its motion relative to it, by Darcy's law, is without mass: that is lost
/// where the gas in the airways swings by itself (inertance). Gas that flows in joins at the velocity of the tissue:
/// what it brings of kinetic energy counts as external work.
#pragma once

#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/porosity.hpp"

#include <cmath>

namespace pulmo {

struct InertiaKernels {
  struct Own {
    static constexpr const char *owner = "inertia";
    PetscScalar tissue_density = 1050, air_density = 1.2; ///< kg/m^3
  };
  using Parameters = Both<Own, Porosity>;

  static constexpr PetscScalar kPa_per_mm = 1e-9; ///< of 1 kg/m^3 times 1 mm/s^2

  /// R, kPa s^2/mm^2.
  static PetscScalar density(const PointState &s, const Parameters &p)
  {
    return kPa_per_mm * p.other.density(s.J_minus_1, p.own.tissue_density, p.own.air_density);
  }
  static PetscScalar acceleration(const Point &point, int i) { return point.step.slope * point.u_t[i] + point.past(i); }

  /// f0 = R a.
  static void force(const Point &point, const Parameters &p, PetscScalar f0[])
  {
    const PetscScalar R = density(point.state, p);
    for (int i = 0; i < 3; ++i) f0[i] += R * acceleration(point, i);
  }
  /// g0 = R da/du.
  static void mass(const Point &point, const Parameters &p, PetscScalar g0[])
  {
    const PetscScalar m = density(point.state, p) * point.step.slope * point.shift;
    for (int i = 0; i < 3; ++i) g0[4 * i] += m;
  }
  /// g1 = a dR/dF: the air that a point takes in has mass.
  static void force_by_air(const Point &point, const Parameters &p, PetscScalar g1[])
  {
    for (int i = 0; i < 3; ++i) {
      const PetscScalar a = kPa_per_mm * p.own.air_density * acceleration(point, i);
      for (int j = 0; j < 9; ++j) g1[9 * i + j] += a * point.state.cof_F[j];
    }
  }
  static void remember(const Point &point, const Parameters &, PetscScalar v[])
  {
    for (int i = 0; i < 3; ++i) v[i] = point.u_t[i];
  }

  // The work R a . du of a step of backward Euler, du = dt v, is R (v - w) . v with the velocity w before, and that is
  // what kinetic energy grows by, less what joins, and a loss:
  //   R (v^2 - w^2) / 2 + R (v - w)^2 / 2,   R v^2 / 2 - R0 w^2 / 2 = R (v^2 - w^2) / 2 + (R - R0) w^2 / 2

  static PetscScalar before(const Point &now, int i) { return now.memory.last ? now.memory.last[i] : 0; }
  /// Growth of the kinetic energy R v^2 / 2, kPa.
  static PetscScalar kinetic(const Point &now, const Point &last, const Parameters &p)
  {
    PetscScalar v2 = 0, w2 = 0;
    for (int i = 0; i < 3; ++i) {
      v2 += now.u_t[i] * now.u_t[i];
      w2 += before(now, i) * before(now, i);
    }
    return (density(now.state, p) * v2 - density(last.state, p) * w2) / 2;
  }
  /// What air that joins brings, (R - R0) w^2 / 2, kPa.
  static PetscScalar joining(const Point &now, const Point &last, const Parameters &p)
  {
    PetscScalar w2 = 0;
    for (int i = 0; i < 3; ++i) w2 += before(now, i) * before(now, i);
    return kPa_per_mm * p.own.air_density * (now.state.J_minus_1 - last.state.J_minus_1) * w2 / 2;
  }
  /// What backward Euler loses, R (v - w)^2 / 2, kPa.
  static PetscScalar numerical(const Point &now, const Point &, const Parameters &p)
  {
    PetscScalar sum = 0;
    for (int i = 0; i < 3; ++i) {
      const PetscScalar change = now.u_t[i] - before(now, i);
      sum += change * change;
    }
    return density(now.state, p) * sum / 2;
  }
};

class Inertia final : public Effect {
public:
  const char *name() const override { return "inertia"; }
  const char *about() const override { return "mass of tissue and air resists acceleration"; }
  const char *absence() const override { return "nothing has inertia: forces balance at every moment"; }
  std::string example() const override { return "-inertia -inertia_air_density 30 -tissue_porosity 0.7"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "mass of tissue and air resists acceleration", on_));
    options.group(name(), about(), on_, "-inertia");
    PetscCall(options.real("tissue_density", "kg/m^3", Range::positive(), "density of tissue without air",
                           parameters_.tissue_density));
    PetscCall(
        options.real("air_density", "kg/m^3", Range::not_negative(), "density of the gas", parameters_.air_density));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.porosity = facts.inertia = true;
    return PETSC_SUCCESS;
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = InertiaKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    c.remember({{"velocity_x", "mm/s"}, {"velocity_y", "mm/s"}, {"velocity_z", "mm/s"}}, remembered<P, K::remember>);
    c.residual("R a . eta", displacement, f0(volume_residual<P, K::force>));
    c.jacobian("mass", displacement, displacement, g0(volume_jacobian<P, K::mass>));
    c.bears_nothing();
    c.jacobian("mass of the air", displacement, displacement, g1(volume_jacobian<P, K::force_by_air>));
    c.energy(Energy::stored, "kinetic", "", energy_density<P, K::kinetic>);
    c.energy(Energy::external, "external", "", energy_density<P, K::joining>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    if (facts.gravity)
      c.require({[mass = facts.gravity->mass.function](const PetscScalar constants[]) {
                   return weighs_as(mass, constants, 0) && weighs_as(mass, constants, 1);
                 },
                 "-inertia and -gravity give tissue or air two densities; give -inertia_tissue_density and "
                 "-inertia_air_density what -gravity_tissue_density and -gravity_air_density are"});
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  /// Whether @p mass, a density by weight, is that of inertia where a side is longer by @p strain.
  static bool weighs_as(EnergyDensity mass, const PetscScalar constants[], PetscScalar strain)
  {
    constexpr PetscReal rounding = 1e-12;
    const PetscScalar H[9] = {strain, 0, 0, 0, 0, 0, 0, 0, 0};
    PointState state;
    make_point_state(H, nullptr, state);
    const Point point{state, nullptr, 0, nullptr, 0, 0, nullptr, nullptr, Step()};
    const PetscScalar heavy = InertiaKernels::kPa_per_mm * mass(point, point, constants),
                      inert = InertiaKernels::density(state, constants::get<InertiaKernels::Parameters>(constants));
    return std::abs(heavy - inert) <= rounding * inert;
  }

  bool on_ = false;
  InertiaKernels::Own parameters_;
};

} // namespace pulmo
