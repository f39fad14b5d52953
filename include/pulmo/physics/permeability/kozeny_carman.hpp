/// @file
/// Permeability of packed grains (after Kozeny 1927, Carman 1937).
#pragma once

#include "pulmo/physics/permeability.hpp"

namespace pulmo {

/// k ~ phi^3 / (1 - phi)^2 of the Eulerian porosity phi = (J - 1 + Phi0) / J. As 1 - phi = (1 - Phi0) / J, Phi0 cancels
/// in the denominator and k = k0 a^3 / J with a = (J - 1 + Phi0) / Phi0: no pole, however large J.
struct KozenyCarmanPermeability {
  static constexpr const char *name = "kozeny_carman",
                              *about = "k = k0 ((J - 1 + Phi0) / Phi0)^3 / J (after Kozeny 1927, Carman 1937)";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4; ///< k0, mm^2/(kPa s)
  };

  static PetscErrorCode declare(Options &options, Parameters &p) { return declare_permeability(options, p.k); }

  static PermeabilityValue permeability(PetscScalar J, const Parameters &p, const Porosity &porosity)
  {
    const PetscScalar a = porosity.air(J), k = p.k * a * a * a / J;
    return {k, p.k * 3 * a * a / (porosity.reference * J) - k / J};
  }
};

} // namespace pulmo
