/// @file
/// Effect `gravity`: weight of tissue and air.
///
/// With b = g times the unit vector along gravity and R = (1 - Phi0) rho_t + (J - 1 + Phi0) rho_a, the density per
/// reference volume (Phi0: -tissue_porosity):
///   momentum: adds  - int R b . eta
///   mass:     Q = k J F^-1 F^-T (-Grad p + rho_a F^T b), a force rho_a b on the gas (airflow only)
/// Gas at rest is hydrostatic, Grad p = rho_a F^T b, and the tissue then carries (1 - Phi0) (rho_t - rho_a) b, whatever
/// J. Without airflow the pressure of the gas is uniform and the tissue carries the weight of the air, too. Where the
/// first step of a run has to be cut the weight is cut with it.
#pragma once

#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/porosity.hpp"

#include <cmath>

namespace pulmo {

struct GravityKernels {
  struct Own {
    static constexpr const char *owner = "gravity";
    PetscScalar tissue_density = 1050, air_density = 0; ///< kg/m^3
    PetscScalar force[3] = {0, 0, 0};                   ///< weight of 1 kg/m^3, kPa/mm
  };
  using Parameters = Both<Own, Porosity>;

  /// R, kg/m^3.
  static PetscScalar density(const PointState &s, const Parameters &p)
  {
    return p.other.density(s.J_minus_1, p.own.tissue_density, p.own.air_density);
  }
  /// f0 of the momentum row: -R b.
  static void weight(const Point &point, const Parameters &p, PetscScalar f0[])
  {
    const PetscScalar R = point.step.load * density(point.state, p);
    for (int i = 0; i < 3; ++i) f0[i] -= R * p.own.force[i];
  }
  /// g1: the air that a point takes in weighs.
  static void weight_by_displacement(const Point &point, const Parameters &p, PetscScalar g1[])
  {
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 9; ++j)
        g1[9 * i + j] -= point.step.load * p.own.air_density * p.own.force[i] * point.state.cof_F[j];
  }
  /// Work of the weight in a step, R b . du, kPa.
  static PetscScalar work(const Point &now, const Point &before, const Parameters &p)
  {
    PetscScalar sum = 0;
    for (int i = 0; i < 3; ++i) sum += p.own.force[i] * (now.u[i] - before.u[i]);
    return now.step.load * density(now.state, p) * sum;
  }
  static PetscScalar mass(const Point &now, const Point &, const Parameters &p) { return density(now.state, p); }
};

class Gravity final : public Effect {
public:
  const char *name() const override { return "gravity"; }
  const char *about() const override { return "weight of tissue and air"; }
  const char *absence() const override { return "nothing has weight"; }
  std::string example() const override
  {
    return "-gravity -gravity_direction 0.3,-1,0.2 -gravity_acceleration 20 -gravity_air_density 30 "
           "-tissue_porosity 0.7";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscReal direction[3] = {0, -1, 0};

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "tissue and air have weight", on_));
    options.group(name(), about(), on_, "-gravity");
    PetscCall(
        options.vector("direction", "-", "where things fall (any length; supine in RAS axes: 0,-1,0)", direction));
    PetscCall(options.real("acceleration", "m/s^2", Range::not_negative(), "acceleration of free fall", acceleration_));
    PetscCall(options.real("tissue_density", "kg/m^3", Range::positive(), "density of tissue without air",
                           parameters_.tissue_density));
    options.only_volumes(parameters_.tissue_density);
    // one value everywhere, as the force on the gas has
    PetscCall(options.real("air_density", "kg/m^3", Range::not_negative(), "density of the gas", air_density_));
    const PetscReal length = std::hypot(direction[0], direction[1], direction[2]);
    PulmoUserCheck(length > 0, options.comm(),
                   "-gravity_direction has no length and points nowhere; give where things fall, e.g. 0,-1,0 (supine), "
                   "or leave -gravity out");
    parameters_.air_density = air_density_;
    for (int d = 0; d < 3; ++d) {
      down_[d] = direction[d] / length;
      parameters_.force[d] = kPa_per_mm * acceleration_ * down_[d];
      gas_force_.value[d] = air_density_ * parameters_.force[d];
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.porosity = true;
    facts.gravity = GravityFacts{down_, kPa_per_mm * acceleration_, air_density_,
                                 energy_density<GravityKernels::Parameters, GravityKernels::mass>};
    return PETSC_SUCCESS;
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = GravityKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    c.residual("-R b . eta", displacement, f0(volume_residual<P, K::weight>));
    c.jacobian("weight of the air", displacement, displacement, g1(volume_jacobian<P, K::weight_by_displacement>));
    c.energy(Energy::external, "external", "", energy_density<P, K::work>);
    if (facts.permeability) {
      const GasForceCallbacks gas = facts.permeability->gas_force_callbacks();
      c.parameters(gas_force_);
      c.residual("-k J F^-1 rho_a b . Grad q", pressure, f1(gas.flux));
      c.jacobian("flux by weight", pressure, displacement, g3(gas.flux_by_displacement));
      c.energy(Energy::external, "external", "", gas.work);
      c.energy(Energy::dissipated, "resistive", "", gas.heat);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  static constexpr PetscReal kPa_per_mm = 1e-6; ///< of 1 kg/m^3 times 1 m/s^2: 1 Pa/m

  bool on_ = false;
  PetscReal acceleration_ = 9.80665, air_density_ = 1.2; ///< m/s^2, kg/m^3
  std::array<PetscReal, 3> down_{};
  GravityKernels::Own parameters_;
  GasForce gas_force_;
};

} // namespace pulmo
