/// @file
/// The program as a function: what main() does after PetscInitialize. Tests call it with registries of their own.
#pragma once

#include "pulmo/time/simulation.hpp"

namespace pulmo {

/// Registers pulmo's PetscFE type, partitioner and step control, and the handler that prints user errors as one
/// sentence. Call once after PetscInitialize.
PetscErrorCode initialize();

/// A scene made ready to run: options read and checked, mesh, model and solvers built, nothing written yet.
/// Options come from PETSc's default database.
class Run {
public:
  explicit Run(const Registry &registry);

  /// Declares the options; with -help lists them.
  PetscErrorCode declare();
  /// Checks the options and builds everything.
  PetscErrorCode setup();
  /// Checks the options and saves the mesh (-mesh_save); setup() is not called then.
  PetscErrorCode save_mesh(bool overwrite);

  Options &options() { return options_; }
  const Scene &scene() const { return scene_; }
  Model &model() { return model_; }
  Simulation &simulation() { return simulation_; }
  /// What there is to say of loads that move the lung at rest; empty if there are none.
  const std::string &settle_note() const { return settle_note_; }

private:
  Options options_;
  Scene scene_;
  Model model_;
  Simulation simulation_;
  std::string settle_note_;
};

/// Lets the ventilator begin with a phase `settle` if the scene asks for that where something moves the lung at rest:
/// prescribed displacements, or forces that do not cancel while nothing is deformed and the gas is at atmospheric
/// pressure. @p note: what the user is told of it.
PetscErrorCode settle_under_loads(Scene &scene, Model &model, std::string &note);

/// Refuses a lung with a rigid motion that nothing holds, or with a wall load that nothing bears.
PetscErrorCode check_held(MPI_Comm comm, const Scene &scene, const Composition &composition);

/// Runs the scene of the options database and writes its output. @p finished tells whether the run reached its
/// end; errors that a sentence tells come back with the code of their kind, already printed.
/// @p sources: where options are from, by their names (for summary.json).
PetscErrorCode run(const Registry &registry, bool &finished, const OptionList &sources = {});

/// Of pulmo itself.
const char *version();

} // namespace pulmo
