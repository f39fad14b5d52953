/// @file
/// Small effects for verification scenes.
#pragma once

#include "pulmo/pulmo.hpp"

#include <memory>
#include <string>

namespace pulmo::test
{

/// Prescribes values of a field (all components) on one surface.
class Essential final : public Effect
{
public:
  using Value = std::function<void(PetscReal t, const PetscReal x[3], PetscScalar value[3])>;

  Essential(PetscInt field, std::string surface, Value value)
      : field_(field), surface_(std::move(surface)), value_(std::move(value))
  {
  }
  const char *name() const override { return "test_essential"; }
  const char *about() const override { return "prescribed field on a surface (verification)"; }
  PetscErrorCode declare(Options &options) override
  {
    options.group(name(), about());
    return PETSC_SUCCESS;
  }
  bool active() const override { return true; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    Constraint hold;
    hold.name = "prescribed on " + surface_;
    hold.field = field_;
    for (int i = 0; i < (field_ == displacement ? 3 : 1); ++i) hold.component[i] = true;
    hold.surface = surface_;
    hold.value = value_;
    c.constrain(hold);
    return PETSC_SUCCESS;
  }

private:
  PetscInt field_;
  std::string surface_;
  Value value_;
};

inline void add_essential(Registry &r, PetscInt field, const std::string &surface, const Essential::Value &value)
{
  r.effect([=] { return std::make_unique<Essential>(field, surface, value); });
}

} // namespace pulmo::test
