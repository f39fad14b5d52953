/// @file
/// Effect `lumen_pressure`: the gas in the airway presses on the airway wall.
///
/// Without it the total traction on the airway is the spring alone, as in the paper. With it the traction
/// gains -p J F^-T N, with the local field p on the surface (the uniform gas pressure without airflow).
/// It is on by default wherever there is a ventilator. (Without one the airway is at atmospheric pressure, p = 0.)
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/follower_pressure.hpp"

#include <algorithm>

namespace pulmo {

struct LumenPressureKernels {
  /// f0 = p cof F N.
  static void wall(const Point &point, const NoParameters &, PetscScalar f0[])
  {
    add_follower_pressure(point, point.gas_pressure(), f0);
  }
  static void wall_by_displacement(const Point &point, const NoParameters &, PetscScalar g1[])
  {
    add_follower_pressure_by_displacement(point, point.gas_pressure(), g1);
  }
  /// g0 = cof F N.
  static void wall_by_pressure(const Point &point, const NoParameters &, PetscScalar g0[])
  {
    add_follower_pressure(point, 1, g0);
  }
  static PetscScalar work(const Point &now, const Point &before, const NoParameters &)
  {
    return follower_pressure_work(now, before, now.gas_pressure());
  }
};

class LumenPressure final : public Effect {
public:
  const char *name() const override { return "lumen_pressure"; }
  const char *about() const override { return "gas pressure on the airway wall"; }
  const char *absence() const override { return "the gas does not press on the airway wall"; }
  bool active() const override { return on_; }
  const std::vector<std::string> &surfaces() const { return surfaces_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.given("", given_));
    PetscCall(options.flag("",
                           "the gas presses on the airway wall, in every scene with a ventilator (off: the paper's "
                           "reading)",
                           on_));
    options.group(name(), about(), on_, "-lumen_pressure");
    PetscCall(options.given("surfaces", surfaces_given_));
    PetscCall(options.names("surfaces", "surfaces on which the gas presses (default: those of -airflow_surfaces)",
                            surfaces_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode consider(Options &options, const Mesh &mesh, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    if (!on_) PetscFunctionReturn(PETSC_SUCCESS);
    if (!surfaces_given_) {
      surfaces_ = facts.airway_surfaces;
      options.settle("surfaces", name(), surfaces_);
    }
    if (given_ || surfaces_given_ || (facts.ventilator && facts.airflow)) PetscFunctionReturn(PETSC_SUCCESS);
    // not asked for: on where there is a gas and a wall
    const auto exists = [&](const std::string &surface) { return mesh.surfaces().count(surface) > 0; };
    on_ = facts.ventilator && std::all_of(surfaces_.begin(), surfaces_.end(), exists);
    if (on_) PetscFunctionReturn(PETSC_SUCCESS);
    options.turn_off(name());
    if (facts.ventilator)
      PetscCall(PetscPrintf(options.comm(),
                            "pulmo: note: the mesh has no surface %s, so the gas presses on no airway wall; name the "
                            "wall with -lumen_pressure_surfaces, or give -lumen_pressure off\n",
                            surfaces_.front().c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &facts) override
  {
    PetscFunctionBeginUser;
    PetscCall(mesh.require_surfaces(surfaces_, "-lumen_pressure_surfaces"));
    PulmoUserCheck(facts.airflow || facts.ventilator, options.comm(),
                   "-lumen_pressure needs a gas pressure: give -ventilator, -airflow or both");
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = LumenPressureKernels;
    using P = NoParameters;

    PetscFunctionBeginUser;
    for (const std::string &surface : surfaces_) {
      c.surface_residual("p cof F N . eta", surface, displacement, f0(surface_residual<P, K::wall>));
      c.surface_jacobian("wall pressure", surface, displacement, displacement,
                         g1(surface_jacobian<P, K::wall_by_displacement>));
      if (facts.airflow)
        c.surface_jacobian("wall pressure", surface, displacement, pressure,
                           g0(surface_jacobian<P, K::wall_by_pressure>));
      c.energy(Energy::external, "external", surface, energy_density<P, K::work>);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = true, given_ = false, surfaces_given_ = false;
  std::vector<std::string> surfaces_{"airway"};
};

} // namespace pulmo
