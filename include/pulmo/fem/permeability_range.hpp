/// @file
/// The permeability of a lung at rest: its least and largest value over the cells.
#pragma once

#include "pulmo/fem/model.hpp"

namespace pulmo {

struct PermeabilityRange {
  PetscReal least = PETSC_MAX_REAL, largest = 0; ///< mm^2/(kPa s)
};

/// Collective.
PetscErrorCode permeability_at_rest(const PermeabilityLaw &law, const Model &model, PermeabilityRange &range);

} // namespace pulmo
