/// @file
/// Effect `prestress`: the mesh is a lung under a transpulmonary pressure p_tp, as it was imaged, and not one at rest.
///
/// The tissue is that of a smaller lung, inflated by J0 the same way in all directions: its law is that of F F0,
/// F0 = J0^(1/3) I, and J0 is what p_tp makes of a free piece of it, W'(J0) = p_tp. What held the lung in that shape
/// goes on to pull on its whole boundary as a follower, t = p_tp J F^-T N: a pleural pressure of -p_tp. As
/// Div cof F = 0 this is, inside the lung,
///   P = (dW/dF)(F F0) F0^T / J0 - p_tp cof F,
/// which is zero at u = 0 in every point of any mesh. Porosity, permeability and springs are those of the mesh.
/// A uniform stretch is the simplest of the states that Govindjee & Mihalic (1996) and Patte, Genet & Chapelle (2022)
/// look for.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/law_range.hpp"

#include <limits>

namespace pulmo {

struct PrestressKernels {
  struct Parameters {
    static constexpr const char *owner = "prestress";
    PetscScalar pressure = 0; ///< p_tp, kPa
    PetscScalar stretch = 1;  ///< J0^(1/3)
  };

  static void stress_free(const Point &, const PetscScalar constants[], When, PetscScalar G[9])
  {
    const auto k = constants::get<Parameters>(constants);
    for (int i = 0; i < 9; ++i) G[i] *= k.stretch;
  }

  /// f1 = -p_tp cof F.
  static void follower(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    for (int i = 0; i < 9; ++i) f1[i] -= k.pressure * point.state.cof_F[i];
  }
  static void follower_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    add_cofactor_derivative(point.state.F, -k.pressure, g3);
  }
  /// Work of the pleural pressure in a step: p_tp dJ, kPa.
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    return k.pressure * (now.state.J_minus_1 - before.state.J_minus_1);
  }
  /// The momentum balance has cof F : dF instead of dJ.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar D[9];
    for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
    return k.pressure * volume_beyond_linear(now.state.F, D);
  }
};

class Prestress final : public Effect {
public:
  const char *name() const override { return "prestress"; }
  const char *about() const override { return "the mesh is a lung under transpulmonary pressure (uniform stretch)"; }
  std::string example() const override { return "-prestress -prestress_pressure 2"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the mesh is a lung under pressure, not one at rest", on_));
    options.group(name(), about(), on_, "-prestress");
    PetscCall(options.real("pressure", "cmH2O", Range::any(),
                           "transpulmonary pressure (alveolar less pleural) in the shape of the mesh; pressures of the "
                           "run are counted from the alveolar pressure of that shape",
                           pressure_));
    PetscCall(options.choice("method", {"stretch"}, "how the unloaded lung is found: a uniform stretch", method_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.stress_free.push_back(PrestressKernels::stress_free);
    facts.prestress = PrestressFacts{pressure_ * units::kPa_per_cmH2O, [](const PetscScalar constants[]) {
                                       const auto k = constants::get<PrestressKernels::Parameters>(constants);
                                       return 1 / (k.stretch * k.stretch * k.stretch);
                                     }};
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    LawRange::State end;

    PetscFunctionBeginUser;
    parameters_.pressure = facts.prestress->pressure;
    const auto inflated = inflated_J(*facts.law, parameters_.pressure, nullptr, &end);
    PulmoUserCheck(inflated, options.comm(),
                   "-prestress_pressure %g cmH2O: -tissue %s with these parameters takes no more than %.3g cmH2O from "
                   "rest by uniform inflation; give a pressure below that, another law, or other parameters",
                   (double)pressure_, facts.law->name(), (double)(end.pressure / units::kPa_per_cmH2O));
    const PetscReal J0 = *inflated;
    parameters_.stretch = std::cbrt(J0);
    const PetscReal at_rest = inflation_stiffness(*facts.law, 1);
    PetscReal stiffness = inflation_stiffness(*facts.law, J0); // the least on the way there
    for (int i = 1; i < path; ++i)
      stiffness = std::min(stiffness, inflation_stiffness(*facts.law, std::pow(J0, (PetscReal)i / path)));
    if (J0 < least_stretch || J0 > largest_stretch)
      PetscCall(PetscPrintf(options.comm(),
                            "pulmo: warning: -prestress_pressure %g cmH2O with -tissue %s: the unloaded lung has %.3g "
                            "of the volume of the mesh, which is no lung's; give the transpulmonary pressure of the "
                            "image, some 5 cmH2O\n",
                            (double)pressure_, facts.law->name(), (double)(1 / J0)));
    if (stiffness < nearly_neutral * at_rest)
      PetscCall(PetscPrintf(
          options.comm(),
          "pulmo: warning: -tissue %s is nearly neutral at -prestress_pressure %g cmH2O: dp/dJ is "
          "%.3g cmH2O on the way there at its least, %.3g at rest, and the unloaded lung has %.3g of the volume; small "
          "changes of pressure or parameters move these numbers far\n",
          facts.law->name(), (double)pressure_, (double)(stiffness / units::kPa_per_cmH2O),
          (double)(at_rest / units::kPa_per_cmH2O), (double)(1 / J0)));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = PrestressKernels;
    using P = K::Parameters;
    const TissueLaw &law = *facts.law;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    c.derive({&parameters_.stretch,
              [&law](std::vector<PetscScalar> constants) {
                StressFree::forget(constants);
                const auto J0 = inflated_J(law, constants::get<P>(constants.data()).pressure, constants.data());
                return J0 ? std::cbrt(*J0) : std::numeric_limits<PetscScalar>::quiet_NaN();
              },
              "-prestress_pressure: -tissue " + std::string(law.name()) +
                  " with the parameters of some part of the lung does not take that pressure from rest by uniform "
                  "inflation; give a lower pressure, or that part other parameters"});
    c.residual("-p_tp cof F : Grad eta", displacement, f1(volume_residual<P, K::follower>));
    c.jacobian("-p_tp d(cof F)/dF", displacement, displacement, g3(volume_jacobian<P, K::follower_by_displacement>));
    c.energy(Energy::external, "pleural_pressure", "", energy_density<P, K::work>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  static constexpr PetscReal nearly_neutral = 0.25;
  static constexpr int path = 50;                                      ///< states that are looked at on the way to J0
  static constexpr PetscReal least_stretch = 0.7, largest_stretch = 4; ///< J0 of a lung

  bool on_ = false;
  PetscReal pressure_ = 5;
  std::string method_ = "stretch";
  PrestressKernels::Parameters parameters_;
};

} // namespace pulmo
