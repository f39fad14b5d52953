/// @file
/// Small effects for verification scenes.
#pragma once

#include "pulmo/pulmo.hpp"

#include <functional>
#include <memory>
#include <string>

namespace pulmo::test {

/// An effect that is always on and has no options.
class TestEffect : public Effect {
public:
  PetscErrorCode declare(Options &options) final
  {
    options.group(name(), about());
    return PETSC_SUCCESS;
  }
  bool active() const final { return true; }
};

/// Prescribes values of a field on one surface: all components, or those named by letters of "xyz".
class Essential final : public TestEffect {
public:
  using Value = std::function<void(PetscReal t, const PetscReal x[3], PetscScalar value[3])>;

  Essential(PetscInt field, std::string surface, Value value, std::string components)
      : field_(field), surface_(std::move(surface)), value_(std::move(value)), components_(std::move(components))
  {}
  const char *name() const override { return "test_essential"; }
  const char *about() const override { return "prescribed field on a surface (verification)"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    Constraint hold;
    hold.name = "prescribed on " + surface_;
    hold.field = field_;
    for (int i = 0; i < (field_ == displacement ? 3 : 1); ++i)
      hold.component[i] = components_.find("xyz"[i]) != std::string::npos;
    hold.surface = surface_;
    hold.value = value_;
    c.constrain(hold);
    return PETSC_SUCCESS;
  }

private:
  PetscInt field_;
  std::string surface_;
  Value value_;
  std::string components_;
};

inline void add_essential(Registry &r, PetscInt field, const std::string &surface, const Essential::Value &value,
                          const std::string &components = "xyz")
{
  r.effect([=] { return std::make_unique<Essential>(field, surface, value, components); });
}

} // namespace pulmo::test
