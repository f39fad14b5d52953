/// @file
/// Effect `support`: prescribed displacement components on surfaces, and pins of single vertices against the rigid
/// motions that nothing else holds (a lung without springs, K_s = 0: all six of each body). Displacements may be
/// expressions of x, y, z and t (load_expression.hpp).
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/load_expression.hpp"

#include <array>

namespace pulmo {

class Support final : public Effect {
public:
  const char *name() const override { return "support"; }
  const char *about() const override { return "prescribed displacement on surfaces, pins against rigid motions"; }
  const char *absence() const override { return "no displacement is prescribed, and nothing is pinned"; }
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
      held.load.option = "-support_displacement_" + surface;
      held.load.values.resize(3);
      PetscCall(options.expressions(
          "displacement_" + surface, "mm",
          "their values on surface " + surface + "; numbers, or expressions of x, y, z (mm), t (s)", held.load.values));
      PulmoUserCheck(!held.components.empty() && held.components.find_first_not_of("xyz") == std::string::npos,
                     options.comm(), "-support_components_%s '%s' is not made of the letters x, y and z",
                     surface.c_str(), held.components.c_str());
      held_.push_back(held);
    }
    comm_ = options.comm();
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(rigid_ || !surfaces_.empty(), options.comm(),
                   "-support holds nothing: give -support_surfaces NAME,... or -support_rigid");
    PetscCall(mesh.require_surfaces(surfaces_, "-support_surfaces"));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      for (int d = 0; d < 3; ++d) {
        Expression &value = held_[i].load.values[d];
        if (held_[i].holds(d) || (value.constant() && value.at(0, nullptr) == 0)) continue;
        PetscCall(PetscPrintf(options.comm(),
                              "pulmo: warning: -support_displacement_%s gives %s mm along %c, which "
                              "-support_components_%s %s does not hold: it is not used; add the component, or leave "
                              "its value 0\n",
                              surfaces_[i].c_str(), value.text().c_str(), "xyz"[d], surfaces_[i].c_str(),
                              held_[i].components.c_str()));
        value = 0;
      }
      PetscCall(check_start(mesh, surfaces_[i], held_[i].load));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    for (std::size_t i = 0; i < surfaces_.size(); ++i) announce_courses(held_[i].load, facts);
    return PETSC_SUCCESS;
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    PetscFunctionBeginUser;
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      Constraint hold;
      hold.name = "u on " + surfaces_[i];
      hold.surface = surfaces_[i];
      for (int d = 0; d < 3; ++d) hold.component[d] = held_[i].holds(d);
      held_[i].load.facts = &facts;
      hold.value = [load = &std::as_const(held_[i].load)](PetscReal t, const PetscReal x[3], PetscScalar u[3]) {
        load->at(t, x, u);
      };
      c.constrain(hold);
    }
    if (rigid_) c.pin_free_motions();
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::vector<std::unique_ptr<Partner>> partners(const SceneFacts &) const override
  {
    std::vector<const LoadExpression *> loads;
    for (const Held &held : held_) loads.push_back(&held.load);
    return LoadWatch::over(name(), comm_, loads);
  }

private:
  struct Held {
    std::string components = "xyz";
    LoadExpression load; ///< prescribed displacement, mm

    bool holds(int d) const { return components.find("xyz"[d]) != std::string::npos; }
  };

  bool on_ = false, rigid_ = false;
  std::vector<std::string> surfaces_;
  mutable std::vector<Held> held_;
  MPI_Comm comm_ = MPI_COMM_NULL;
};

} // namespace pulmo
