/// @file
/// The stress-free shape of a lung whose mesh is under load (Unloading): solved for before a run.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/physics/scene.hpp"

namespace pulmo {

/// Solves for the stress-free shape of @p scene, if it asks for one, with the run's own SNES, KSP and PC. @p
/// composition is that of the run; @p modulus as for Model::build(). A load that Newton's method cannot take at once is
/// put on in shares. Collective.
PetscErrorCode solve_unloaded_shape(Options &options, const Scene &scene, const Model &model,
                                    const Composition &composition, PetscReal modulus);

} // namespace pulmo
