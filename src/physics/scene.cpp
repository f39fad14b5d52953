#include "pulmo/physics/scene.hpp"

namespace pulmo {

Scene::Scene(const Registry &registry)
{
  auto tissue = std::make_unique<Tissue>(registry.make_tissue_laws());
  auto airflow = std::make_unique<Airflow>(registry.make_permeability_laws());
  tissue_ = tissue.get();
  airflow_ = airflow.get();
  effects_.push_back(std::move(tissue));
  effects_.push_back(std::move(airflow));
  effects_.push_back(std::make_unique<Ventilator>());
  for (auto &effect : registry.make_effects()) effects_.push_back(std::move(effect));
}

PetscErrorCode Scene::declare(Options &options)
{
  PetscFunctionBeginUser;
  PetscCall(mesh_.declare(options));
  PetscCall(facts_.elements.declare(options));
  for (const auto &effect : effects_) PetscCall(effect->declare(options));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Scene::prepare(Options &options)
{
  PetscFunctionBeginUser;
  facts_.airway_surfaces = airflow_->surfaces();
  for (const auto &effect : effects_)
    if (effect->active()) PetscCall(effect->announce(facts_));
  PetscCall(mesh_.read(options, facts_.ventilator != nullptr));
  for (const auto &effect : effects_) {
    PetscCall(effect->consider(options, mesh_, facts_));
    if (effect->active()) PetscCall(effect->check(options, mesh_, facts_));
  }
  PetscCall(share_flow(options));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Decides how a prescribed flow is shared where that was left open, and warns of shares that cannot be meant.
PetscErrorCode Scene::share_flow(Options &options)
{
  PetscFunctionBeginUser;
  if (!facts_.airflow || !facts_.ventilator || !facts_.ventilator->prescribes_flow())
    PetscFunctionReturn(PETSC_SUCCESS);
  openings_.emplace();
  PetscCall(find_openings(mesh_, facts_.airway_surfaces, *openings_));
  if (facts_.flow_split == FlowSplit::automatic) {
    facts_.flow_split = openings_->patches > 1 ? FlowSplit::common_pressure : FlowSplit::uniform;
    options.settle("flow_split", "ventilator",
                   {facts_.flow_split == FlowSplit::uniform ? "uniform" : "common_pressure"});
  }
  const std::string unequal = openings_->unequal_shares();
  if (facts_.free_airway() && !unequal.empty())
    PetscCall(PetscPrintf(options.comm(),
                          "pulmo: warning: -ventilator_flow_split uniform shares the flow by area, whatever the lungs "
                          "hold: %s; -ventilator_flow_split common_pressure lets them share it as one windpipe does\n",
                          unequal.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Scene::compose(Composition &composition) const
{
  PetscFunctionBeginUser;
  for (const Effect *effect : active()) {
    composition.speaker(effect->name());
    effect->fields(composition);
  }
  for (const Effect *effect : active()) {
    composition.speaker(effect->name());
    PetscCall(effect->terms(composition, facts_));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<const Effect *> Scene::active() const
{
  std::vector<const Effect *> list;
  for (const auto &effect : effects_)
    if (effect->active()) list.push_back(effect.get());
  return list;
}

} // namespace pulmo
