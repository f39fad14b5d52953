/// @file
/// Effect `lumen_pressure`: the gas in the airway presses on the airway wall.
///
/// Without it the total traction on the airway is the spring alone, as in the paper. With it the traction
/// gains -p J F^-T N, with the local field p on the surface (the uniform gas pressure without airflow).
#pragma once

#include "pulmo/effect.hpp"
#include "pulmo/mesh.hpp"

namespace pulmo {

struct LumenPressureKernels {
  /// f0 = p cof F N.
  static void wall(const Point &point, const NoParameters &, PetscScalar f0[])
  {
    const PetscScalar p = point.gas_pressure(), *cof = point.state.cof_F;
    const PetscReal *N = point.normal;
    for (int i = 0; i < 3; ++i) f0[i] += p * (cof[3 * i] * N[0] + cof[3 * i + 1] * N[1] + cof[3 * i + 2] * N[2]);
  }
  /// g1 = p d(cof F N)/dF.
  static void wall_by_displacement(const Point &point, const NoParameters &, PetscScalar g1[])
  {
    PetscScalar g3[81] = {0};
    const PetscReal *N = point.normal;
    add_cofactor_derivative(point.state.F, point.gas_pressure(), g3);
    for (int ik = 0; ik < 9; ++ik)
      for (int L = 0; L < 3; ++L)
        g1[3 * ik + L] += g3[9 * ik + L] * N[0] + g3[9 * ik + 3 + L] * N[1] + g3[9 * ik + 6 + L] * N[2];
  }
  /// g0 = cof F N.
  static void wall_by_pressure(const Point &point, const NoParameters &, PetscScalar g0[])
  {
    const PetscScalar *cof = point.state.cof_F;
    const PetscReal *N = point.normal;
    for (int i = 0; i < 3; ++i) g0[i] += (cof[3 * i] * N[0] + cof[3 * i + 1] * N[1] + cof[3 * i + 2] * N[2]);
  }
  /// Work of the wall pressure on the lung in a step: -p cof F N . du, kPa mm.
  static PetscScalar work(const Point &now, const Point &before, const NoParameters &parameters)
  {
    PetscScalar f0[3] = {0, 0, 0}, sum = 0;
    wall(now, parameters, f0);
    for (int i = 0; i < 3; ++i) sum -= f0[i] * (now.u[i] - before.u[i]);
    return sum;
  }
};

class LumenPressure final : public Effect {
public:
  const char *name() const override { return "lumen_pressure"; }
  const char *about() const override { return "gas pressure on the airway wall"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the gas presses on the airway wall (off: the paper's reading)", on_));
    options.group(name(), about(), on_, "-lumen_pressure");
    PetscCall(options.names("surfaces", "surfaces on which the gas presses", surfaces_));
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
      c.surface_residual("p cof F N . eta", surface, displacement, surface_residual<P, K::wall>, nullptr);
      c.surface_jacobian("wall pressure", surface, displacement, displacement, nullptr,
                         surface_jacobian<P, K::wall_by_displacement>, nullptr, nullptr);
      if (facts.airflow)
        c.surface_jacobian("wall pressure", surface, displacement, pressure, surface_jacobian<P, K::wall_by_pressure>,
                           nullptr, nullptr, nullptr);
      c.energy(Energy::external, "external", surface, energy_density<P, K::work>);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = false;
  std::vector<std::string> surfaces_{"airway"};
};

} // namespace pulmo
