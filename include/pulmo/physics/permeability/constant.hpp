/// @file
/// Permeability that does not follow the deformation (Aviles-Rojas & Hurtado 2022).
#pragma once

#include "pulmo/physics/permeability.hpp"

namespace pulmo {

/// k constant in the deformed configuration.
struct ConstantPermeability {
  static constexpr const char *name = "constant", *about = "k = k0 (Aviles-Rojas & Hurtado 2022)";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4; ///< mm^2/(kPa s)
  };

  static PetscErrorCode declare(Options &options, Parameters &p) { return declare_permeability(options, p.k); }

  static PermeabilityValue permeability(PetscScalar, const Parameters &p) { return {p.k, 0}; }
};

} // namespace pulmo
