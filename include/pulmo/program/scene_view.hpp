/// @file
/// A scene in words, before its run: what is in it, what is not, how far its tissue goes (`-scene_view`).
#pragma once

#include "pulmo/time/simulation.hpp"

#include <string>
#include <vector>

namespace pulmo {

/// What is said of a scene: a sentence each.
struct SceneWords {
  /// An effect that the program knows, in use or not.
  struct Effect {
    std::string name, words; ///< words: what it does in this scene, or what its absence leaves out
    bool active = false;
    std::vector<Options::Setting> settings; ///< of an active one: its options as the run uses them
  };
  std::vector<std::string> mesh;
  std::vector<Effect> effects;
  std::vector<std::string> range, breathing, numerics; ///< how far the tissue goes, how it breathes, how it is solved
};

/// Collective.
PetscErrorCode describe_scene(const Options &options, const Scene &scene, const Model &model,
                              const Simulation &simulation, SceneWords &words);

/// Prints them. Collective.
PetscErrorCode print_scene(MPI_Comm comm, const SceneWords &words);

/// Writes them to @p file as JSON, with the options that were given and where each is from, so that a run which is at
/// work or was killed can still say what it is. Collective.
PetscErrorCode write_scene(const Options &options, const SceneWords &words, const std::string &file);

/// Sentences on uniform inflation of the tissue alone: where it ends, and what the pressures and volumes of the run
/// make of it. Where parameters differ from place to place each set of them speaks, or, if there are many, the softest
/// and the stiffest. Collective.
PetscErrorCode describe_range(const Scene &scene, const Model &model, std::vector<std::string> &lines);

/// Warns of a pressure that no equilibrium holds. Only where that is certain: nothing but the same tissue all over
/// holds the lung.
PetscErrorCode warn_beyond_law(MPI_Comm comm, const Scene &scene, const Model &model);

} // namespace pulmo
