/// @file
/// A scene: the effects that the options ask for, and the mesh they act on.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/openings.hpp"
#include "pulmo/physics/effects/airflow.hpp"
#include "pulmo/physics/effects/tissue.hpp"
#include "pulmo/physics/effects/ventilator.hpp"
#include "pulmo/physics/registry.hpp"

namespace pulmo {

class Scene {
public:
  explicit Scene(const Registry &registry);

  /// Declares the options of every effect and of the mesh.
  PetscErrorCode declare(Options &options);
  /// Does no more than save the mesh; prepare() is not called then.
  PetscErrorCode save_mesh(const Options &options, bool overwrite) { return mesh_.save(options, overwrite); }
  /// Reads the mesh and checks every active effect against it.
  PetscErrorCode prepare(Options &options);
  /// What the active effects put together.
  PetscErrorCode compose(Composition &composition) const;

  /// Lets the ventilator begin with its phase `settle`; before the simulation is set up.
  void settle_first() { facts_.ventilator = facts_.settling.programme; }

  const Mesh &mesh() const { return mesh_; }
  const SceneFacts &facts() const { return facts_; }
  /// The airway, where it lets air flow that a ventilator prescribes.
  const std::optional<Openings> &openings() const { return openings_; }
  const Tissue &tissue() const { return *tissue_; }
  const Airflow &airflow() const { return *airflow_; }
  /// All effects that a scene may ask for, in order of registration.
  const std::vector<std::unique_ptr<Effect>> &effects() const { return effects_; }
  /// Those that this one asks for, in the same order.
  std::vector<const Effect *> active() const;

private:
  PetscErrorCode share_flow(Options &options);

  Mesh mesh_;
  SceneFacts facts_;
  std::optional<Openings> openings_;
  std::vector<std::unique_ptr<Effect>> effects_;
  Tissue *tissue_; // these two are elements of effects_
  Airflow *airflow_;
};

} // namespace pulmo
