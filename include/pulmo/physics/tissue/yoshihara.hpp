/// @file
/// CM4: compressible neo-Hookean law (Yoshihara et al. 2017).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = c (I1 - 3) + c/beta (I3^-beta - 1). No barrier at zero porosity; free inflation has a limit point
/// at J = 2.534, 16.83 cmH2O, above which there is no equilibrium.
struct Yoshihara {
  static constexpr const char *name = "yoshihara", *alias = "cm4";
  static constexpr const char *source = "Yoshihara et al. 2017; Aviles-Rojas & Hurtado 2022, Table 1, CM4";
  static constexpr bool uses_I2 = false;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar c = 1.298;   ///< kPa
    PetscScalar beta = 0.75; ///< -
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("c", "kPa", Range::positive(), "neo-Hookean stiffness", k.c));
    PetscCall(options.real("beta", "-", Range::positive(), "volumetric exponent, nu / (1 - 2 nu)", k.beta));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    return k.c * inv.I1_minus_3 + k.c / k.beta * inv.power_of_I3_minus_1(-k.beta);
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const PetscScalar u_m1 = std::expm1(-2 * k.beta * inv.log_J()), r = 1 / inv.J;
    EnergyDerivatives e;
    e.W1 = k.c;
    e.WJ = -2 * k.c * (u_m1 + 1) * r;
    e.WJJ = 2 * k.c * (2 * k.beta + 1) * (u_m1 + 1) * r * r;
    return e;
  }
};

} // namespace pulmo
