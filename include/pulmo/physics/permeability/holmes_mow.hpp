/// @file
/// Permeability of soft tissue that closes as it is compressed (after Holmes & Mow 1990).
#pragma once

#include "pulmo/physics/permeability.hpp"

#include <cmath>

namespace pulmo {

/// k = k0 a^n exp(M (J^2 - 1) / 2) with a = (J - 1 + Phi0) / Phi0. Made for cartilage; no values are published for
/// lungs.
struct HolmesMowPermeability {
  static constexpr const char *name = "holmes_mow",
                              *about =
                                  "k = k0 ((J - 1 + Phi0) / Phi0)^n exp(M (J^2 - 1) / 2) (after Holmes & Mow 1990)";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4;    ///< k0, mm^2/(kPa s)
    PetscScalar n = 2. / 3; ///< -
    PetscScalar M = 0.5;    ///< -
  };

  static PetscErrorCode declare(Options &options, Parameters &p)
  {
    PetscFunctionBeginUser;
    PetscCall(declare_permeability(options, p.k));
    PetscCall(options.real("permeability_exponent", "-", Range::not_negative(), "n, of the air in the pores", p.n));
    PetscCall(options.real("permeability_growth", "-", Range::not_negative(), "M, growth with J^2", p.M));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  static PermeabilityValue permeability(PetscScalar J, const Parameters &p, const Porosity &porosity)
  {
    const PetscScalar a = porosity.air(J), k = p.k * std::pow(a, p.n) * std::exp(p.M * (J - 1) * (J + 1) / 2);
    return {k, k * (p.n / (a * porosity.reference) + p.M * J)};
  }
};

} // namespace pulmo
