/// @file
/// Effect `traction`: dead load (kPa per reference area, fixed direction) on named surfaces, held from t = 0 on. Where
/// the first step of a run has to be cut the load is cut with it.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <array>
#include <utility>

namespace pulmo {

struct TractionKernels {
  static constexpr std::size_t max_surfaces = 8;

  struct Parameters {
    static constexpr const char *owner = "traction";
    PetscScalar value[max_surfaces][3]; ///< T of each surface, kPa
  };

  /// f0 = -T.
  template <std::size_t I>
  static void load(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    for (int i = 0; i < 3; ++i) f0[i] -= point.step.load * k.value[I][i];
  }

  /// Work of the load in a step: T . du, kPa mm.
  template <std::size_t I>
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar sum = 0;
    for (int i = 0; i < 3; ++i) sum += now.step.load * k.value[I][i] * (now.u[i] - before.u[i]);
    return sum;
  }

  template <std::size_t... I>
  static constexpr std::array<Callback<PetscBdPointFunc>, sizeof...(I)> residuals(std::index_sequence<I...>)
  {
    return {surface_residual<Parameters, load<I>>...};
  }
  template <std::size_t... I>
  static constexpr std::array<Callback<EnergyDensity>, sizeof...(I)> works(std::index_sequence<I...>)
  {
    return {energy_density<Parameters, work<I>>...};
  }
};

class Traction final : public Effect {
public:
  const char *name() const override { return "traction"; }
  const char *about() const override { return "dead load on named surfaces"; }
  std::string example() const override { return "-traction -traction_surfaces airway -traction_value 0.1,-0.05,0.2"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscReal common[3] = {0, 0, 0};

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "dead load on surfaces", on_));
    options.group(name(), about(), on_, "-traction");
    PetscCall(options.names("surfaces", "loaded surfaces", surfaces_));
    PetscCall(options.vector("value", "kPa", "traction per reference area", common));
    PulmoUserCheck(surfaces_.size() <= TractionKernels::max_surfaces, options.comm(),
                   "-traction_surfaces names more than %d surfaces; join some of them in the mesh",
                   static_cast<int>(TractionKernels::max_surfaces));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      for (int d = 0; d < 3; ++d) parameters_.value[i][d] = common[d];
      PetscCall(
          options.vector("value_" + surfaces_[i], "kPa", "traction on surface " + surfaces_[i], parameters_.value[i]));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(!surfaces_.empty(), options.comm(), "-traction needs -traction_surfaces NAME,...");
    PetscCall(mesh.require_surfaces(surfaces_, "-traction_surfaces"));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    static constexpr auto each = std::make_index_sequence<TractionKernels::max_surfaces>();
    static constexpr auto residuals = TractionKernels::residuals(each);
    static constexpr auto works = TractionKernels::works(each);

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      c.surface_residual("-T . eta", surfaces_[i], displacement, f0(residuals[i]));
      c.energy(Energy::external, "external", surfaces_[i], works[i]);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = false;
  std::vector<std::string> surfaces_;
  TractionKernels::Parameters parameters_{};
};

} // namespace pulmo
