/// @file
/// CM5: Yeoh-type isochoric law with volumetric penalty (Rausch et al. 2011).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = c_q (Ibar - 3)^2 + c_c (Ibar - 3)^3 + kappa/4 (J^2 - 1 - 2 ln J), Ibar = I1 I3^-1/3.
/// The shear modulus at F = I is zero. No barrier at zero porosity.
struct Rausch {
  static constexpr const char *name = "rausch", *alias = "cm5";
  static constexpr const char *source = "Rausch et al. 2011; Aviles-Rojas & Hurtado 2022, Table 1, CM5";
  static constexpr bool uses_I2 = false;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar c_q = 4.1;    ///< kPa
    PetscScalar c_c = 20.7;   ///< kPa
    PetscScalar kappa = 16.5; ///< kPa
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("c_q", "kPa", Range::not_negative(), "quadratic isochoric stiffness", k.c_q));
    PetscCall(options.real("c_c", "kPa", Range::not_negative(), "cubic isochoric stiffness", k.c_c));
    PetscCall(options.real("kappa", "kPa", Range::positive(), "bulk modulus", k.kappa));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    const T x = inv.isochoric_I1_minus_3();
    return x * x * (k.c_q + k.c_c * x) + k.kappa / 4 * (inv.J_minus_1 * (inv.J + 1) - 2 * inv.log_J());
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const PetscScalar l = inv.log_J(), y = std::expm1(2 * l / 3); // J^2/3 - 1
    const PetscScalar s = 1 / (1 + y), r = 1 / inv.J;
    const PetscScalar x = s * (inv.I1_minus_3 - 3 * y); // Ibar - 3
    const PetscScalar x_J = -2. / 3 * (x + 3) * r, x_1J = -2. / 3 * s * r, x_JJ = 10. / 9 * (x + 3) * r * r;
    const PetscScalar G = x * (2 * k.c_q + 3 * k.c_c * x), GG = 2 * k.c_q + 6 * k.c_c * x;

    EnergyDerivatives e;
    e.W1 = G * s;
    e.WJ = G * x_J + k.kappa / 2 * inv.J_minus_1 * (inv.J + 1) * r;
    e.W11 = GG * s * s;
    e.W1J = GG * s * x_J + G * x_1J;
    e.WJJ = GG * x_J * x_J + G * x_JJ + k.kappa / 2 * (1 + r * r);
    return e;
  }
};

} // namespace pulmo
