/// @file
/// The permeability of a lung at rest: its largest value over the cells, and the least that effects may leave of it.
#pragma once

#include "pulmo/fem/model.hpp"

namespace pulmo {

struct PermeabilityRange {
  PetscReal least = PETSC_MAX_REAL, largest = 0; ///< mm^2/(kPa s)
};

/// Collective.
PetscErrorCode permeability_at_rest(const SceneFacts &facts, const Model &model, PermeabilityRange &range);

} // namespace pulmo
