/// @file
/// Permeability that grows exponentially with the change of volume (after Lai & Mow 1980).
#pragma once

#include "pulmo/physics/permeability.hpp"

#include <cmath>

namespace pulmo {

/// k = k0 exp(M (J - 1) / Phi0): (J - 1) / Phi0 is the change of the air in the pores over that at rest. With M = 2/3
/// it has the slope of the power law at rest.
struct ExponentialPermeability {
  static constexpr const char *name = "exponential", *about = "k = k0 exp(M (J - 1) / Phi0) (after Lai & Mow 1980)";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4;    ///< k0, mm^2/(kPa s)
    PetscScalar M = 2. / 3; ///< -
  };

  static PetscErrorCode declare(Options &options, Parameters &p)
  {
    PetscFunctionBeginUser;
    PetscCall(declare_permeability(options, p.k));
    PetscCall(
        options.real("permeability_growth", "-", Range::not_negative(), "M, growth with the air in the pores", p.M));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  static PermeabilityValue permeability(PetscScalar J, const Parameters &p, const Porosity &porosity)
  {
    const PetscScalar k = p.k * std::exp(p.M * (J - 1) / porosity.reference);
    return {k, p.M * k / porosity.reference};
  }
};

} // namespace pulmo
