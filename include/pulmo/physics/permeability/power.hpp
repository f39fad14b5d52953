/// @file
/// Permeability as a power of the air in the pores (after Kowalczyk 1993, Berger et al. 2016).
#pragma once

#include "pulmo/physics/permeability.hpp"

#include <cmath>

namespace pulmo {

/// k = k0 a^n with a = (J - 1 + Phi0) / Phi0. The section of a pore grows with the 2/3 power of its volume: n = 2/3.
struct PowerPermeability {
  static constexpr const char *name = "power",
                              *about = "k = k0 ((J - 1 + Phi0) / Phi0)^n (after Kowalczyk 1993, Berger et al. 2016)";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4;    ///< k0, mm^2/(kPa s)
    PetscScalar n = 2. / 3; ///< -
  };

  static PetscErrorCode declare(Options &options, Parameters &p)
  {
    PetscFunctionBeginUser;
    PetscCall(declare_permeability(options, p.k));
    PetscCall(options.real("permeability_exponent", "-", Range::not_negative(), "n, of the air in the pores", p.n));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  static PermeabilityValue permeability(PetscScalar J, const Parameters &p, const Porosity &porosity)
  {
    const PetscScalar a = porosity.air(J), k = p.k * std::pow(a, p.n);
    return {k, p.n * k / (a * porosity.reference)};
  }
};

} // namespace pulmo
