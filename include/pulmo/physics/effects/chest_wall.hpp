/// @file
/// Effect `chest_wall`: springs between lung surface and surroundings (Aviles-Rojas & Hurtado 2022, eq. 39).
///
/// Traction T = -K_s u (the paper prints +K_s, which would push outward), by default with the full
/// displacement vector on pleura and airway: the reading that reproduces the paper's Table 2. Direction
/// `normal` is the paper's text, T = -K_s (u . N) N.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <array>
#include <utility>

namespace pulmo {

struct ChestWallKernels {
  static constexpr std::size_t max_surfaces = 8;

  struct Parameters {
    static constexpr const char *owner = "chest_wall";
    PetscScalar stiffness[max_surfaces]; ///< K_s of each surface, kPa/mm
    PetscScalar normal_only;             ///< 1: only the normal component is resisted
  };

  /// f0 = K_s u, or K_s (u . N) N.
  template <std::size_t I>
  static void spring(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    const PetscScalar *u = point.u, K = k.stiffness[I];
    const PetscReal *N = point.normal;
    const PetscScalar u_N = u[0] * N[0] + u[1] * N[1] + u[2] * N[2];
    for (int i = 0; i < 3; ++i) f0[i] += K * (k.normal_only != 0 ? u_N * N[i] : u[i]);
  }
  template <std::size_t I>
  static void spring_tangent(const Point &point, const Parameters &k, PetscScalar g0[])
  {
    const PetscReal *N = point.normal;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) g0[3 * i + j] += k.stiffness[I] * (k.normal_only != 0 ? N[i] * N[j] : i == j);
  }

  /// K_s a . b, or K_s (a . N) (b . N).
  static PetscScalar product(const Parameters &k, std::size_t i, const PetscScalar a[3], const PetscScalar b[3],
                             const PetscReal N[3])
  {
    const auto dot = [](const PetscScalar x[3], const PetscScalar y[3]) {
      return x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
    };
    return k.stiffness[i] * (k.normal_only != 0 ? dot(a, N) * dot(b, N) : dot(a, b));
  }
  /// Growth of 1/2 K_s |u|^2 over a step, kPa mm.
  template <std::size_t I>
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar middle[3], step[3];
    for (int i = 0; i < 3; ++i) {
      middle[i] = (now.u[i] + before.u[i]) / 2;
      step[i] = now.u[i] - before.u[i];
    }
    return product(k, I, middle, step, now.normal);
  }
  /// What backward Euler loses in the springs: 1/2 K_s |du|^2, kPa mm.
  template <std::size_t I>
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar step[3];
    for (int i = 0; i < 3; ++i) step[i] = now.u[i] - before.u[i];
    return product(k, I, step, step, now.normal) / 2;
  }

  /// The callbacks of each surface, so that a kernel knows its stiffness.
  template <std::size_t... I>
  static constexpr std::array<Callback<PetscBdPointFunc>, sizeof...(I)> residuals(std::index_sequence<I...>)
  {
    return {surface_residual<Parameters, spring<I>>...};
  }
  template <std::size_t... I>
  static constexpr std::array<Callback<PetscBdPointJac>, sizeof...(I)> jacobians(std::index_sequence<I...>)
  {
    return {surface_jacobian<Parameters, spring_tangent<I>>...};
  }
  template <std::size_t... I>
  static constexpr std::array<Callback<EnergyDensity>, sizeof...(I)> stored_energies(std::index_sequence<I...>)
  {
    return {energy_density<Parameters, stored<I>>...};
  }
  template <std::size_t... I>
  static constexpr std::array<Callback<EnergyDensity>, sizeof...(I)> numerical_losses(std::index_sequence<I...>)
  {
    return {energy_density<Parameters, numerical<I>>...};
  }
};

class ChestWall final : public Effect {
public:
  const char *name() const override { return "chest_wall"; }
  const char *about() const override { return "springs on the lung surface (chest wall, eq. 39)"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscReal common = 0.08;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "springs hold the lung surface", on_));
    options.group(name(), about(), on_, "-chest_wall");
    PetscCall(options.names("surfaces", "surfaces with springs", surfaces_));
    PetscCall(options.real("stiffness", "kPa/mm", Range::not_negative(), "spring stiffness K_s per area", common));
    PetscCall(options.choice("direction", {"full", "normal"}, "what a spring resists: u, or u . N", direction_));
    PulmoUserCheck(surfaces_.size() <= ChestWallKernels::max_surfaces, options.comm(),
                   "-chest_wall_surfaces names more than %d surfaces; join some of them in the mesh",
                   static_cast<int>(ChestWallKernels::max_surfaces));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      PetscReal &own = parameters_.stiffness[i];
      bool given;
      options.hand_down(common, own);
      PetscCall(options.given("stiffness_" + surfaces_[i], given));
      PetscCall(options.real("stiffness_" + surfaces_[i], "kPa/mm", Range::not_negative(),
                             "K_s of surface " + surfaces_[i], own));
      if (given) options.only_volumes(own);
      varies_[i] = options.varies(own);
    }
    options.drop_varying(common);
    parameters_.normal_only = direction_ == "normal";
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PetscCall(mesh.require_surfaces(surfaces_, "-chest_wall_surfaces"));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = ChestWallKernels;
    static constexpr auto each = std::make_index_sequence<K::max_surfaces>();
    static constexpr auto residuals = K::residuals(each);
    static constexpr auto jacobians = K::jacobians(each);
    static constexpr auto stored = K::stored_energies(each);
    static constexpr auto numerical = K::numerical_losses(each);

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      if (parameters_.stiffness[i] == 0 && !varies_[i]) continue;
      c.surface_residual("K_s u . eta", surfaces_[i], displacement, f0(residuals[i]));
      c.surface_jacobian("K_s", surfaces_[i], displacement, displacement, g0(jacobians[i]));
      c.energy(Energy::stored, "elastic_springs", surfaces_[i], stored[i]);
      c.energy(Energy::numerical, "numerical_dissipation", surfaces_[i], numerical[i]);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = false;
  std::string direction_ = "full";
  std::vector<std::string> surfaces_{"pleura", "airway"};
  ChestWallKernels::Parameters parameters_{};
  std::array<bool, ChestWallKernels::max_surfaces> varies_{}; ///< not the same all over a surface
};

} // namespace pulmo
