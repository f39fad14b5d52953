/// @file
/// CM2: exponential law of Fung type (Ma et al. 2013).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = c exp(a (I1/2 - 3/2)^2 + b (I2/4 - I1/2 + 3/4)). No barrier at zero porosity.
struct Ma {
  static constexpr const char *name = "ma", *alias = "cm2";
  static constexpr const char *source = "Ma et al. 2013; Aviles-Rojas & Hurtado 2022, Table 1, CM2";
  static constexpr bool uses_I2 = true;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar a = 0.43; ///< -
    PetscScalar b = -0.6; ///< -
    PetscScalar c = 2.0;  ///< kPa
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("a", "-", Range::any(), "exponent of (tr E)^2", k.a));
    PetscCall(options.real("b", "-", Range::any(), "exponent of the second invariant of E", k.b));
    PetscCall(options.real("c", "kPa", Range::positive(), "stiffness", k.c));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    const T e1 = inv.I1_minus_3, e2 = inv.I2_minus_3;
    return k.c * exp(k.a / 4 * e1 * e1 + k.b * (e2 / 4 - e1 / 2));
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const PetscScalar E = W(inv, k), Q1 = k.a / 2 * inv.I1_minus_3 - k.b / 2, Q2 = k.b / 4;
    EnergyDerivatives e;
    e.W1 = E * Q1;
    e.W2 = E * Q2;
    e.W11 = E * (Q1 * Q1 + k.a / 2);
    e.W12 = E * Q1 * Q2;
    e.W22 = E * Q2 * Q2;
    return e;
  }
};

} // namespace pulmo
