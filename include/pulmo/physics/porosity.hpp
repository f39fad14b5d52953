/// @file
/// Reference porosity Phi0: a property of the tissue (`-tissue_porosity`), read by kernels and observers.
#pragma once

#include <petscsys.h>

namespace pulmo {

/// Handed over where SceneFacts::porosity says that something reads it; may differ by region.
struct Porosity {
  static constexpr const char *owner = "porosity";
  PetscScalar reference = 0.99; ///< Phi0: share of the lung's volume at rest that is air

  /// Air in the pores over that at rest, (J - 1 + Phi0) / Phi0; its derivative by J is 1 / Phi0.
  PetscScalar air(PetscScalar J) const { return (J - 1 + reference) / reference; }
  /// J at which none is left.
  PetscScalar least_J() const { return 1 - reference; }
  /// Density of tissue with densities @p tissue and @p air per volume at rest, (1 - Phi0) rho_t + (J - 1 + Phi0) rho_a.
  PetscScalar density(PetscScalar J_minus_1, PetscScalar tissue, PetscScalar air) const
  {
    return (1 - reference) * tissue + (J_minus_1 + reference) * air;
  }
  /// Eulerian porosity where the volume has changed by J.
  PetscScalar at(PetscScalar J) const { return 1 - (1 - reference) / J; }
};

} // namespace pulmo
