/// @file
/// Exponential skeleton of the lung (after Patte, Genet & Chapelle 2022).
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo {

/// W = beta1 (I1 - 3 - 2 ln J) + beta2 (I2 - 3 - 4 ln J) + alpha (exp(delta (J^2 - 1 - 2 ln J)) - 1).
/// The paper could not be read: formula and values are those of its authors' code (dolfin_mech, skeleton of its lung
/// material; c1, c2, alpha, gamma of its examples). Their energy of the compressible solid has no place here, where
/// solid and air are incompressible. Free of stress at rest. Stiffens without end: there is no pressure that it does
/// not hold. No barrier at zero porosity.
struct Patte {
  static constexpr const char *name = "patte", *alias = ""; // CM1 to CM5 are Table 1 of the paper
  static constexpr const char *source = "after Patte, Genet & Chapelle 2022; values of dolfin_mech";
  static constexpr bool uses_I2 = true;

  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar beta1 = 0.2;  ///< kPa
    PetscScalar beta2 = 0.4;  ///< kPa
    PetscScalar alpha = 0.16; ///< kPa
    PetscScalar delta = 0.5;  ///< -
  };

  static PetscErrorCode declare(Options &options, Parameters &k)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("beta1", "kPa", Range::not_negative(), "stiffness of I1", k.beta1));
    PetscCall(options.real("beta2", "kPa", Range::not_negative(), "stiffness of I2", k.beta2));
    PetscCall(options.real("alpha", "kPa", Range::not_negative(), "volumetric stiffness", k.alpha));
    PetscCall(options.real("delta", "-", Range::not_negative(), "exponent of the volumetric stiffening", k.delta));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    const T l = inv.log_J(), d = inv.J_minus_1 * (inv.J + 1.0) - 2 * l;
    return k.beta1 * (inv.I1_minus_3 - 2 * l) + k.beta2 * (inv.I2_minus_3 - 4 * l) + k.alpha * expm1(k.delta * d);
  }

  static EnergyDerivatives derivatives(const Invariants<> &inv, const Parameters &k)
  {
    const PetscScalar r = 1 / inv.J, JJ_1 = inv.J_minus_1 * (inv.J + 1), d = JJ_1 - 2 * inv.log_J();
    const PetscScalar d_J = 2 * JJ_1 * r, d_JJ = 2 * (1 + r * r), E = k.alpha * k.delta * std::exp(k.delta * d);
    EnergyDerivatives e;
    e.W1 = k.beta1;
    e.W2 = k.beta2;
    e.WJ = -(2 * k.beta1 + 4 * k.beta2) * r + E * d_J;
    e.WJJ = (2 * k.beta1 + 4 * k.beta2) * r * r + E * (d_JJ + k.delta * d_J * d_J);
    return e;
  }
};

} // namespace pulmo
