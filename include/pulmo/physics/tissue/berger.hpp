/// @file
/// CM1: compressible neo-Hookean law with a barrier at zero porosity (Berger et al. 2016).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = mu/2 (I1 - 3) + lambda/4 (J^2 - 1) - (mu + lambda/2) ln(J - 1 + phi0).
/// With phi0 < 1 the reference state is not free of stress (dW/dJ = -0.0050 kPa at J = 1 with the paper's
/// values): the paper's own choice, kept.
struct Berger {
  static constexpr const char *name = "berger", *alias = "cm1";
  static constexpr const char *source = "Berger et al. 2016; Aviles-Rojas & Hurtado 2022, Table 1, CM1";
  static constexpr bool uses_I2 = false;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar mu = 0.2808;     ///< kPa
    PetscScalar lambda = 0.4212; ///< kPa
    PetscScalar phi0 = 0.99;     ///< reference porosity of the law, -
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("mu", "kPa", Range::positive(), "shear modulus of the tissue", k.mu));
    PetscCall(options.real("lambda", "kPa", Range::not_negative(), "first Lame parameter", k.lambda));
    PetscCall(options.real("phi0", "-", {0, 1.0 + 1e-15, true}, "reference porosity of the barrier", k.phi0));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    const PetscScalar m = k.mu + k.lambda / 2;
    return k.mu / 2 * inv.I1_minus_3 + k.lambda / 4 * inv.J_minus_1 * (inv.J + 1) - m * log(inv.J_minus_1 + k.phi0);
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const PetscScalar porosity = inv.J_minus_1 + k.phi0, m = k.mu + k.lambda / 2;
    EnergyDerivatives e;
    e.W1 = k.mu / 2;
    e.WJ = k.lambda / 2 * inv.J - m / porosity;
    e.WJJ = k.lambda / 2 + m / (porosity * porosity);
    return e;
  }
};

} // namespace pulmo
