/// @file
/// What a user is told of a lung under pressure (`-prestress`): of every part of it, with its own parameters.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/physics/scene.hpp"

#include <string>

namespace pulmo {

/// Warns of an unloaded lung that is no lung's, of tissue that is nearly neutral on the way to the mesh, and of an
/// unloaded lung that has less volume than its own solid; notes a law that is made from the porosity. Collective.
PetscErrorCode warn_of_prestress(MPI_Comm comm, const Scene &scene, const Model &model);

/// Says that the tissue of a part of the lung does not take the transpulmonary pressure by uniform inflation; empty if
/// all of it does. The end of a sentence on why no unloaded shape was found. Collective.
PetscErrorCode find_weak_part(const Scene &scene, const Composition &composition, std::string &text);

} // namespace pulmo
