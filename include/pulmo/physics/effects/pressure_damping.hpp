/// @file
/// Effect `pressure_damping`: takes the oscillation out of the pressure beside a jump that drains slowly.
///
/// Adds  int h^2 / (c M) Grad p_t . Grad q  to the mass balance (a perturbation of the flow equation as in Aguilar,
/// Gaspar, Lisbona & Rodrigo 2008). In one dimension it turns the storage matrix of P1 pressure into its lumped form,
/// for which the first step is monotone however small k dt is: with c = 6 that of P2-P1, M^-1 times the mass matrix,
/// with c = 4 (theirs) that of P1-P1, where the tissue sees only the mean pressure of a cell. It vanishes where the
/// pressure is at rest and with h^2, the order of the pressure itself; q = 1 gives zero, so no air is lost or made.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

namespace pulmo {

struct PressureDampingKernels {
  struct Parameters {
    static constexpr const char *owner = "pressure_damping";
    PetscScalar beta; ///< h^2 / (c M), mm^2/kPa
  };

  static void flux(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    for (int i = 0; i < 3; ++i) f1[i] += k.beta * point.grad_p_t[i];
  }
  static void flux_by_pressure(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    for (int i = 0; i < 9; i += 4) g3[i] += k.beta * point.shift;
  }
  /// What it takes from the energy balance in a step, kPa.
  static PetscScalar loss(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar sum = 0;
    for (int i = 0; i < 3; ++i) sum += k.beta * (now.grad_p[i] - before.grad_p[i]) * now.grad_p[i];
    return sum;
  }
};

class PressureDamping final : public Effect {
public:
  const char *name() const override { return "pressure_damping"; }
  const char *about() const override { return "no oscillating pressure at very low permeability (numerical)"; }
  const char *absence() const override { return "oscillations of the pressure are not damped (numerical)"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "damp oscillations of the pressure", on_));
    options.group(name(), about(), on_, "-pressure_damping");
    PetscCall(options.real("length", "mm", Range::not_negative(), "edge of a cell, h (0: twice the mean cell size)",
                           length_));
    PetscCall(
        options.real("modulus", "kPa", Range::positive(), "stiffness of the tissue in uniaxial strain, M", modulus_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.pressure_damping = true;
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(facts.airflow, options.comm(), "-pressure_damping needs a pressure field: give -airflow");
    PulmoUserCheck(facts.elements.pressure_degree == 1, options.comm(),
                   "-pressure_damping is for linear pressure: leave it out, or give -elements P2-P1 or P1-P1");
    const PetscReal h = length_ > 0 ? length_ : mesh.edge();
    parameters_.beta = h * h / ((facts.elements.displacement_degree == 1 ? 4 : 6) * modulus_);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = PressureDampingKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    c.residual("h^2/(c M) Grad p_t . Grad q", pressure, f1(volume_residual<P, K::flux>));
    c.jacobian("damping", pressure, pressure, g3(volume_jacobian<P, K::flux_by_pressure>));
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::loss>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = false;
  PetscReal length_ = 0, modulus_ = 3; // most laws are 1 to 9 kPa at rest
  PressureDampingKernels::Parameters parameters_{};
};

} // namespace pulmo
