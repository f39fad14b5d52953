/// @file
/// A scene in words, before its run: what is in it, what is not, how far its tissue goes (`-scene_view`).
#pragma once

#include "pulmo/time/simulation.hpp"

#include <string>
#include <vector>

namespace pulmo {

/// The options `-scene_view` and `-scene_view_only`.
class SceneView {
public:
  PetscErrorCode declare(Options &options);
  /// Whether the run is to end when the scene has been told.
  bool only() const { return only_; }
  /// Prints the scene if the options ask for it. Collective.
  PetscErrorCode print(const Options &options, const Scene &scene, const Model &model,
                       const Simulation &simulation) const;

private:
  bool view_ = false, only_ = false;
};

/// Sentences on uniform inflation of the tissue alone: where it ends, and what the pressures and volumes of the run
/// make of it. Where parameters differ from place to place each set of them speaks, or, if there are many, the softest
/// and the stiffest. Collective.
PetscErrorCode describe_range(const Scene &scene, const Model &model, std::vector<std::string> &lines);

/// Warns of a pressure that no equilibrium holds. Only where that is certain: nothing but the same tissue all over
/// holds the lung.
PetscErrorCode warn_beyond_law(MPI_Comm comm, const Scene &scene, const Model &model);

} // namespace pulmo
