/// @file
/// Effect `support`: prescribed displacement components on surfaces, and pins of single vertices against the rigid
/// motions that nothing else holds (a lung without springs, K_s = 0: all six of each body).
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <array>

namespace pulmo {

class Support final : public Effect {
public:
  const char *name() const override { return "support"; }
  const char *about() const override { return "prescribed displacement on surfaces, pins against rigid motions"; }
  std::string example() const override
  {
    return "-support -support_surfaces airway -support_components_airway x -support_displacement_airway 0.1,0,0";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "prescribed displacement", on_));
    options.group(name(), about(), on_, "-support");
    PetscCall(options.flag("rigid", "pin vertices against the rigid motions that nothing else holds", rigid_));
    PetscCall(options.names("surfaces", "surfaces with prescribed displacement", surfaces_));
    for (const std::string &surface : surfaces_) {
      Held held;
      PetscCall(options.text("components_" + surface, "which components, of x, y and z, e.g. xz", held.components));
      PetscCall(
          options.vector("displacement_" + surface, "mm", "their values on surface " + surface, held.value.data()));
      PulmoUserCheck(!held.components.empty() && held.components.find_first_not_of("xyz") == std::string::npos,
                     options.comm(), "-support_components_%s '%s' is not made of the letters x, y and z",
                     surface.c_str(), held.components.c_str());
      held_.push_back(held);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(rigid_ || !surfaces_.empty(), options.comm(),
                   "-support holds nothing: give -support_surfaces NAME,... or -support_rigid");
    PetscCall(mesh.require_surfaces(surfaces_, "-support_surfaces"));
    for (std::size_t i = 0; i < surfaces_.size(); ++i)
      for (int d = 0; d < 3; ++d)
        if (held_[i].value[d] != 0 && !held_[i].holds(d))
          PetscCall(PetscPrintf(options.comm(),
                                "pulmo: warning: -support_displacement_%s gives %.6g mm along %c, which "
                                "-support_components_%s %s does not hold: it is not used; add the component, or leave "
                                "its value 0\n",
                                surfaces_[i].c_str(), (double)held_[i].value[d], "xyz"[d], surfaces_[i].c_str(),
                                held_[i].components.c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    PetscFunctionBeginUser;
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      Constraint hold;
      hold.name = "u on " + surfaces_[i];
      hold.surface = surfaces_[i];
      for (int d = 0; d < 3; ++d) hold.component[d] = held_[i].holds(d);
      const std::array<PetscReal, 3> v = held_[i].value;
      hold.value = [v](PetscReal, const PetscReal[3], PetscScalar u[3]) {
        for (int d = 0; d < 3; ++d) u[d] = v[d];
      };
      c.constrain(hold);
    }
    if (rigid_) c.pin_free_motions();
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  struct Held {
    std::string components = "xyz";
    std::array<PetscReal, 3> value{0, 0, 0};

    bool holds(int d) const { return components.find("xyz"[d]) != std::string::npos; }
  };

  bool on_ = false, rigid_ = false;
  std::vector<std::string> surfaces_;
  std::vector<Held> held_;
};

} // namespace pulmo
