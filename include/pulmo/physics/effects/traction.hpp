/// @file
/// Effect `traction`: dead load (kPa per reference area, fixed direction) on named surfaces, held from t = 0 on. Where
/// the first step of a run has to be cut the load is cut with it. Its components may be expressions of x, y, z and t
/// (load_expression.hpp).
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/load_expression.hpp"

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

  /// The same for expressions.
  struct Expressions {
    static constexpr const char *owner = "traction_expressions";
    PetscScalar load[max_surfaces]; ///< const LoadExpression *, as constants::to_scalar() packs it; of numbers: 0
  };

  template <std::size_t I>
  static void expressed(const Point &point, const Expressions &k, PetscScalar T[3])
  {
    constants::to_pointer<const LoadExpression *>(k.load[I])->at(point.t, point.x, T);
  }
  template <std::size_t I>
  static void expressed_load(const Point &point, const Expressions &k, PetscScalar f0[])
  {
    PetscScalar T[3];
    expressed<I>(point, k, T);
    for (int i = 0; i < 3; ++i) f0[i] -= point.step.load * T[i];
  }
  template <std::size_t I>
  static PetscScalar expressed_work(const Point &now, const Point &before, const Expressions &k)
  {
    PetscScalar T[3], sum = 0;
    expressed<I>(now, k, T);
    for (int i = 0; i < 3; ++i) sum += now.step.load * T[i] * (now.u[i] - before.u[i]);
    return sum;
  }

  /// The callbacks of one surface.
  struct Callbacks {
    Callback<PetscBdPointFunc> load, expressed_load;
    Callback<EnergyDensity> work, expressed_work;
  };
  template <std::size_t... I>
  static constexpr std::array<Callbacks, sizeof...(I)> callbacks(std::index_sequence<I...>)
  {
    return {Callbacks{surface_residual<Parameters, load<I>>, surface_residual<Expressions, expressed_load<I>>,
                      energy_density<Parameters, work<I>>, energy_density<Expressions, expressed_work<I>>}...};
  }
};

class Traction final : public Effect {
public:
  const char *name() const override { return "traction"; }
  const char *about() const override { return "dead load on named surfaces"; }
  std::string example() const override
  {
    return "-traction -traction_surfaces airway -traction_value 0.1,0.2*t-0.05,0.2+1e-3*y";
  }
  bool active() const override { return on_; }
  const char *absence() const override { return "no dead load pulls on a surface"; }

  PetscErrorCode declare(Options &options) override
  {
    std::vector<Expression> common(3);

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "dead load on surfaces", on_));
    options.group(name(), about(), on_, "-traction");
    PetscCall(options.names("surfaces", "loaded surfaces", surfaces_));
    PetscCall(options.expressions(
        "value", "kPa", "traction per reference area; numbers, or expressions of x, y, z (mm), t (s)", common));
    PulmoUserCheck(surfaces_.size() <= TractionKernels::max_surfaces, options.comm(),
                   "-traction_surfaces names more than %d surfaces; join some of them in the mesh",
                   static_cast<int>(TractionKernels::max_surfaces));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      LoadExpression &load = loads_[i];
      bool given;
      load.values = common;
      PetscCall(options.given("value_" + surfaces_[i], given));
      load.option = given ? "-traction_value_" + surfaces_[i] : "-traction_value";
      PetscCall(
          options.expressions("value_" + surfaces_[i], "kPa", "traction on surface " + surfaces_[i], load.values));
      for (int d = 0; load.constant() && d < 3; ++d) parameters_.value[i][d] = load.values[d].at(0, nullptr);
    }
    comm_ = options.comm();
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PulmoUserCheck(!surfaces_.empty(), options.comm(), "-traction needs -traction_surfaces NAME,...");
    PetscCall(mesh.require_surfaces(surfaces_, "-traction_surfaces"));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) PetscCall(check_start(mesh, surfaces_[i], loads_[i]));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    for (std::size_t i = 0; i < surfaces_.size(); ++i) announce_courses(loads_[i], facts);
    return PETSC_SUCCESS;
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = TractionKernels;
    static constexpr auto callbacks = K::callbacks(std::make_index_sequence<K::max_surfaces>());
    bool expressed = false;

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      const bool number = loads_[i].constant();
      c.surface_residual("-T . eta", surfaces_[i], displacement,
                         f0(number ? callbacks[i].load : callbacks[i].expressed_load));
      c.energy(Energy::external, "external", surfaces_[i], number ? callbacks[i].work : callbacks[i].expressed_work);
      if (number) continue;
      expressed = true;
      loads_[i].facts = &facts;
      expressions_.load[i] = constants::to_scalar(&std::as_const(loads_[i]));
    }
    if (expressed) c.parameters(expressions_);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::vector<std::unique_ptr<Partner>> partners(const SceneFacts &) const override
  {
    std::vector<const LoadExpression *> loads;
    for (std::size_t i = 0; i < surfaces_.size(); ++i) loads.push_back(&loads_[i]);
    return LoadWatch::over(name(), comm_, loads);
  }

private:
  bool on_ = false;
  std::vector<std::string> surfaces_;
  MPI_Comm comm_ = MPI_COMM_NULL;
  TractionKernels::Parameters parameters_{};
  mutable std::array<LoadExpression, TractionKernels::max_surfaces> loads_;
  mutable TractionKernels::Expressions expressions_{};
};

} // namespace pulmo
