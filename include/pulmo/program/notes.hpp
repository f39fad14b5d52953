/// @file
/// What a user is told of a scene and of a run, beside its numbers: notes, warnings, and refusals of what cannot be
/// meant.
#pragma once

#include "pulmo/observers/gravity_audit.hpp"
#include "pulmo/observers/regions.hpp"
#include "pulmo/time/simulation.hpp"

namespace pulmo {

/// Before the run, all but what belongs to single observers. @p settle_note: what settle_under_loads() said.
/// Collective.
PetscErrorCode look_ahead(MPI_Comm comm, const Scene &scene, const Model &model, const Simulation &simulation,
                          const std::string &settle_note);
/// A lung at rest has 0.2 to 0.3 g/ml, where the default porosity (the paper's, for which weight is nothing) gives
/// 0.012.
PetscErrorCode note_weightless(MPI_Comm comm, const Scene &scene, const GravityAudit &gravity);
/// Elements of equal order are not stable where the tissue is undrained: in steps @p dt (s) in which pressure spreads
/// by less than half a cell, k M dt < (h/2)^2. Says so, once.
PetscErrorCode warn_of_equal_order(MPI_Comm comm, const Scene &scene, const Model &model, PetscReal dt, bool &warned);
/// After the run. @p settles: loads move the lung at rest. Collective.
PetscErrorCode look_back(MPI_Comm comm, const Options &options, const Scene &scene, const Model &model,
                         const Simulation &simulation, const RegionAudit &regions, bool settles,
                         bool &warned_of_elements);

} // namespace pulmo
