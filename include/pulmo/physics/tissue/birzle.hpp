/// @file
/// CM3: neo-Hookean law with coupled isochoric and volumetric terms (Birzle et al. 2019).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = c (I1 - 3) + c/beta (I3^-beta - 1) + c1 (I1 I3^-1/3 - 3)^d1 + c3 (I3^1/3 - 1)^d3.
/// Aviles-Rojas & Hurtado print c/8 for c/beta (with c/8 the tissue would hold 6.3 cmH2O at J = 1) and
/// "I33^1/3" for I3^1/3. No barrier at zero porosity; almost neutral between J = 2 and 3 (5.03 cmH2O).
struct Birzle {
  static constexpr const char *name = "birzle", *alias = "cm3";
  static constexpr const char *source = "Birzle et al. 2019; Aviles-Rojas & Hurtado 2022, Table 1, CM3";
  static constexpr bool uses_I2 = false;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar c = 0.3567;    ///< kPa
    PetscScalar beta = 1.075;  ///< -
    PetscScalar c1 = 0.2782;   ///< kPa
    PetscScalar c3 = 5.766e-3; ///< kPa
    PetscScalar d1 = 3;        ///< whole number >= 2
    PetscScalar d3 = 6;        ///< whole number >= 2
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscInt d1 = static_cast<PetscInt>(k.d1), d3 = static_cast<PetscInt>(k.d3);

    PetscFunctionBeginUser;
    PetscCall(options.real("c", "kPa", Range::positive(), "neo-Hookean stiffness", k.c));
    PetscCall(options.real("beta", "-", Range::positive(), "volumetric exponent, nu / (1 - 2 nu)", k.beta));
    PetscCall(options.real("c1", "kPa", Range::not_negative(), "isochoric stiffness", k.c1));
    PetscCall(options.real("c3", "kPa", Range::not_negative(), "volumetric stiffness", k.c3));
    PetscCall(options.whole("d1", "-", Range::between(2, 32), "isochoric exponent", d1));
    PetscCall(options.whole("d3", "-", Range::between(2, 32), "volumetric exponent", d3));
    k.d1 = static_cast<PetscScalar>(d1);
    k.d3 = static_cast<PetscScalar>(d3);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    const int d1 = static_cast<int>(k.d1), d3 = static_cast<int>(k.d3);
    return k.c * inv.I1_minus_3 + k.c / k.beta * inv.power_of_I3_minus_1(-k.beta) +
           k.c1 * whole_power(inv.isochoric_I1_minus_3(), d1) + k.c3 * whole_power(inv.power_of_I3_minus_1(1. / 3), d3);
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const int d1 = static_cast<int>(k.d1), d3 = static_cast<int>(k.d3);
    const PetscScalar l = inv.log_J(), y = std::expm1(2 * l / 3); // y = I3^1/3 - 1
    const PetscScalar s = 1 / (1 + y);                            // I3^-1/3
    const PetscScalar x = s * (inv.I1_minus_3 - 3 * y);           // I1 I3^-1/3 - 3
    const PetscScalar r = 1 / inv.J, u_m1 = std::expm1(-2 * k.beta * l);

    const PetscScalar x_J = -2. / 3 * (x + 3) * r, x_1J = -2. / 3 * s * r, x_JJ = 10. / 9 * (x + 3) * r * r;
    const PetscScalar y_J = 2. / 3 * (y + 1) * r, y_JJ = -2. / 9 * (y + 1) * r * r;
    const PetscScalar gx = k.c1 * whole_power(x, d1 - 2), gy = k.c3 * whole_power(y, d3 - 2);
    const PetscScalar Gx = d1 * gx * x, Gxx = d1 * (d1 - 1) * gx;
    const PetscScalar Gy = d3 * gy * y, Gyy = d3 * (d3 - 1) * gy;

    EnergyDerivatives e;
    e.W1 = k.c + Gx * s;
    e.WJ = -2 * k.c * (u_m1 + 1) * r + Gx * x_J + Gy * y_J;
    e.W11 = Gxx * s * s;
    e.W1J = Gxx * s * x_J + Gx * x_1J;
    e.WJJ = 2 * k.c * (2 * k.beta + 1) * (u_m1 + 1) * r * r + Gxx * x_J * x_J + Gx * x_JJ + Gyy * y_J * y_J + Gy * y_JJ;
    return e;
  }
};

} // namespace pulmo
