/// @file
/// Effect `chest_wall`: springs between lung surface and surroundings (Aviles-Rojas & Hurtado 2022, eq. 39).
///
/// Traction per reference area T = -K_s (1 + s |d|) d (the paper prints +K_s, which would push outward; s = 0 there).
/// By `-chest_wall_direction`:
///   full            d = u, on pleura and airway: the reading that reproduces the paper's Table 2
///   normal          d = (u . N) N, the paper's text
///   current_normal  d = (u . n) n with the normal n of the deformed surface, cof F N / |cof F N|: no friction
///
/// With g(a) = K_s (1 + s |a|) a and u_n = u . n the last one is f = g n, and its tangent
///   df = g' n (n . du + u . dn) + g dn,   dn = (I - n n) d(cof F N) / |cof F N|,   g' = K_s (1 + 2 s |a|).
/// It is not symmetric: f . du = dW - g u . dn with the stored energy W = K_s (u_n^2 / 2 + s |u_n|^3 / 3), so where the
/// surface turns while it slides the wall does work g u . dn, which has a row of its own in the energy balance. The
/// other two have a potential, W with |u| or |u . N|.
///
/// `-chest_wall_offset` p_o: where u = 0 the wall pulls with that suction. T = +p_o J F^-T N follows the surface, so
/// that it turns and pushes no lung that it encloses; its potential is -p_o times the volume.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/follower_pressure.hpp"

#include <array>
#include <cmath>
#include <utility>

namespace pulmo {

struct ChestWallKernels {
  static constexpr std::size_t max_surfaces = 8;
  enum Direction { full, normal, current_normal };

  struct Parameters {
    static constexpr const char *owner = "chest_wall";
    PetscScalar stiffness[max_surfaces];  ///< K_s of each surface, kPa/mm
    PetscScalar direction;                ///< Direction: what a spring resists
    PetscScalar stiffening[max_surfaces]; ///< s, 1/mm
    PetscScalar offset[max_surfaces];     ///< p_o, cmH2O
  };

  static PetscScalar dot(const PetscScalar a[3], const PetscScalar b[3])
  {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  }
  /// The direction that a spring resists, N or n. @return |cof F N|, where that counts
  static PetscScalar wall_normal(const Point &point, const Parameters &k, PetscScalar n[3])
  {
    if (k.direction != current_normal) {
      for (int i = 0; i < 3; ++i) n[i] = point.normal[i];
      return 1;
    }
    for (int i = 0; i < 3; ++i) n[i] = 0;
    add_follower_pressure(point, 1, n);
    const PetscScalar length = std::sqrt(dot(n, n));
    for (int i = 0; i < 3; ++i) n[i] /= length;
    return length;
  }

  /// f0 = K_s (1 + s |d|) d.
  template <std::size_t I>
  static void spring(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    const PetscScalar *u = point.u, s = k.stiffening[I];
    PetscScalar K = k.stiffness[I], n[3];
    if (k.direction == full) {
      if (s != 0) K *= 1 + s * std::sqrt(dot(u, u));
      for (int i = 0; i < 3; ++i) f0[i] += K * u[i];
      return;
    }
    wall_normal(point, k, n);
    const PetscScalar u_n = dot(u, n);
    if (s != 0) K *= 1 + s * std::abs(u_n);
    for (int i = 0; i < 3; ++i) f0[i] += K * (u_n * n[i]);
  }
  /// g0 = K_s ((1 + s |u|) I + s u u / |u|), or g' n n.
  template <std::size_t I>
  static void spring_tangent(const Point &point, const Parameters &k, PetscScalar g0[])
  {
    const PetscScalar *u = point.u, K = k.stiffness[I], s = k.stiffening[I];
    PetscScalar n[3];
    if (k.direction == full) {
      const PetscScalar length = s != 0 ? std::sqrt(dot(u, u)) : 0;
      for (int i = 0; i < 3; ++i) {
        g0[4 * i] += K * (1 + s * length);
        if (length > 0)
          for (int j = 0; j < 3; ++j) g0[3 * i + j] += K * s * (u[i] * u[j] / length);
      }
      return;
    }
    wall_normal(point, k, n);
    const PetscScalar slope = K * (1 + 2 * s * std::abs(dot(u, n)));
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) g0[3 * i + j] += slope * (n[i] * n[j]);
  }
  /// g1 = g' n (u . dn/dF) + g dn/dF, of current_normal.
  template <std::size_t I>
  static void spring_turns(const Point &point, const Parameters &k, PetscScalar g1[])
  {
    const PetscScalar *u = point.u, K = k.stiffness[I], s = k.stiffening[I];
    PetscScalar n[3], by_F[27] = {0}; // d(cof F N)_i / dF_kL, [i][k][L]
    const PetscScalar length = wall_normal(point, k, n), u_n = dot(u, n), force = K * (1 + s * std::abs(u_n)) * u_n,
                      slope = K * (1 + 2 * s * std::abs(u_n));
    add_follower_pressure_by_displacement(point, 1, by_F);
    for (int kL = 0; kL < 9; ++kL) {
      PetscScalar dn[3];
      for (int i = 0; i < 3; ++i) dn[i] = by_F[9 * i + kL] / length;
      const PetscScalar along = dot(n, dn);
      for (int i = 0; i < 3; ++i) dn[i] -= along * n[i];
      const PetscScalar moved = slope * dot(u, dn);
      for (int i = 0; i < 3; ++i) g1[9 * i + kL] += moved * n[i] + force * dn[i];
    }
  }

  /// A spring over a step: lengths |d| before and now, what it stores, what it does by turning, what backward Euler
  /// loses. With a mean m of the force over the step, m Delta a = Delta W, and means of u and n:
  /// Delta W = m (n . Delta u + u . Delta n).
  struct Stretch {
    PetscScalar stored, turning, numerical; ///< kPa mm

    Stretch(const Point &now, const Point &before, const Parameters &k, std::size_t surface)
    {
      const PetscScalar K = k.stiffness[surface], s = k.stiffening[surface];
      PetscScalar middle[3], step[3];
      for (int i = 0; i < 3; ++i) {
        middle[i] = (now.u[i] + before.u[i]) / 2;
        step[i] = now.u[i] - before.u[i];
      }
      if (k.direction == full) {
        const PetscScalar a = std::sqrt(dot(before.u, before.u)), b = std::sqrt(dot(now.u, now.u)),
                          growth = dot(middle, step), more = s * cubes(a, b);
        stored = K * growth + K * growth * more;
        turning = 0;
        numerical = K * dot(step, step) / 2 + K * (s * b * dot(now.u, step) - growth * more);
        return;
      }
      PetscScalar n[3], last[3], mean[3], turn[3];
      wall_normal(now, k, n);
      wall_normal(before, k, last);
      for (int i = 0; i < 3; ++i) {
        mean[i] = (n[i] + last[i]) / 2;
        turn[i] = n[i] - last[i];
      }
      const PetscScalar a = dot(before.u, last), b = dot(now.u, n), along = dot(mean, step), across = dot(middle, turn),
                        centre = (a + b) / 2, more = s * cubes(std::abs(a), std::abs(b)), growth = along + across;
      stored = K * (centre * growth) + K * (centre * growth) * more;
      turning = K * centre * (1 + more) * across;
      numerical = K * (growth * along) / 2 + K * (s * std::abs(b) * b - centre * more) * along +
                  K * (1 + s * std::abs(b)) * b * dot(turn, step) / 2;
    }

  private:
    /// (b^3 - a^3) / 3 over (b^2 - a^2) / 2, of lengths.
    static PetscScalar cubes(PetscScalar a, PetscScalar b)
    {
      return a + b > 0 ? 2 * (a * a + a * b + b * b) / (3 * (a + b)) : 0;
    }
  };
  /// Growth of K_s (|d|^2 / 2 + s |d|^3 / 3) over a step, kPa mm.
  template <std::size_t I>
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    return Stretch(now, before, k, I).stored;
  }
  /// Work that a wall does on the lung because it turns, g u . dn, kPa mm: it is no one's energy.
  template <std::size_t I>
  static PetscScalar turning(const Point &now, const Point &before, const Parameters &k)
  {
    return Stretch(now, before, k, I).turning;
  }
  /// What backward Euler loses in the springs, kPa mm: 1/2 K_s |du|^2 where they neither stiffen nor turn.
  template <std::size_t I>
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    return Stretch(now, before, k, I).numerical;
  }

  template <std::size_t I>
  static PetscScalar offset_pressure(const Point &point, const Parameters &k)
  {
    return -point.step.load * k.offset[I] * units::kPa_per_cmH2O;
  }
  /// f0 = -p_o cof F N.
  template <std::size_t I>
  static void pull(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    add_follower_pressure(point, offset_pressure<I>(point, k), f0);
  }
  template <std::size_t I>
  static void pull_by_displacement(const Point &point, const Parameters &k, PetscScalar g1[])
  {
    add_follower_pressure_by_displacement(point, offset_pressure<I>(point, k), g1);
  }
  template <std::size_t I>
  static PetscScalar pull_work(const Point &now, const Point &before, const Parameters &k)
  {
    return follower_pressure_work(now, before, offset_pressure<I>(now, k));
  }

  /// The callbacks of one surface, so that a kernel knows its parameters.
  struct Callbacks {
    Callback<PetscBdPointFunc> spring, pull;
    Callback<PetscBdPointJac> spring_tangent, spring_turns, pull_by_displacement;
    Callback<EnergyDensity> stored, turning, numerical, pull_work;
  };
  template <std::size_t... I>
  static constexpr std::array<Callbacks, sizeof...(I)> callbacks(std::index_sequence<I...>)
  {
    using P = Parameters;
    return {Callbacks{surface_residual<P, spring<I>>, surface_residual<P, pull<I>>,
                      surface_jacobian<P, spring_tangent<I>>, surface_jacobian<P, spring_turns<I>>,
                      surface_jacobian<P, pull_by_displacement<I>>, energy_density<P, stored<I>>,
                      energy_density<P, turning<I>>, energy_density<P, numerical<I>>,
                      energy_density<P, pull_work<I>>}...};
  }
};

class ChestWall final : public Effect {
public:
  const char *name() const override { return "chest_wall"; }
  const char *about() const override { return "springs on the lung surface (chest wall, eq. 39)"; }
  std::string example() const override
  {
    return "-chest_wall -chest_wall_direction current_normal -chest_wall_stiffening 0.3 -chest_wall_offset 0.5";
  }
  bool active() const override { return on_; }
  const char *absence() const override { return "no springs hold the lung"; }

  PetscErrorCode declare(Options &options) override
  {
    using K = ChestWallKernels;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "springs hold the lung surface", on_));
    options.group(name(), about(), on_, "-chest_wall");
    PetscCall(options.names("surfaces", "surfaces with springs", surfaces_));
    PulmoUserCheck(surfaces_.size() <= K::max_surfaces, options.comm(),
                   "-chest_wall_surfaces names more than %d surfaces; join some of them in the mesh",
                   static_cast<int>(K::max_surfaces));
    PetscCall(options.choice("direction", {"full", "normal", "current_normal"},
                             "what a spring resists: u, u . N, or u . n with the normal of the deformed surface",
                             direction_));
    PetscCall(by_surface(options,
                         {"stiffness", "kPa/mm", Range::not_negative(), "spring stiffness K_s per area", stiffness_},
                         parameters_.stiffness));
    PetscCall(by_surface(
        options,
        {"stiffening", "1/mm", Range::not_negative(), "s: springs have the stiffness K_s (1 + s |u|)", stiffening_},
        parameters_.stiffening));
    PetscCall(
        by_surface(options,
                   {"offset", "cmH2O", Range::any(),
                    "pull of the wall where u = 0: outward (opens the lung), negative: it presses inward", offset_},
                   parameters_.offset));
    parameters_.direction = direction_ == "full" ? K::full : direction_ == "normal" ? K::normal : K::current_normal;
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PetscCall(mesh.require_surfaces(surfaces_, "-chest_wall_surfaces"));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      springs_[i] = parameters_.stiffness[i] != 0 || options.varies(parameters_.stiffness[i]);
      pulls_[i] = parameters_.offset[i] != 0 || options.varies(parameters_.offset[i]);
      const bool stiffens = parameters_.stiffening[i] != 0 || options.varies(parameters_.stiffening[i]);
      PulmoUserCheck(springs_[i] || !stiffens, options.comm(),
                     "-chest_wall_stiffening has nothing to stiffen on surface '%s', where K_s is 0; give "
                     "-chest_wall_stiffness, or -chest_wall_stiffening_%s 0",
                     surfaces_[i].c_str(), surfaces_[i].c_str());
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = ChestWallKernels;
    static constexpr auto callbacks = K::callbacks(std::make_index_sequence<K::max_surfaces>());

    PetscFunctionBeginUser;
    c.parameters(parameters_);
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      const K::Callbacks &k = callbacks[i];
      const std::string &surface = surfaces_[i];
      if (springs_[i]) {
        c.surface_residual("K_s u . eta", surface, displacement, f0(k.spring));
        c.surface_jacobian("K_s", surface, displacement, displacement, g0(k.spring_tangent));
        c.energy(Energy::stored, "elastic_springs", surface, k.stored);
        c.energy(Energy::numerical, "numerical_dissipation", surface, k.numerical);
      }
      if (springs_[i] && parameters_.direction == K::current_normal) {
        c.surface_jacobian("K_s u . dn", surface, displacement, displacement, g1(k.spring_turns));
        c.energy(Energy::external, "turning_springs", surface, k.turning);
      }
      if (pulls_[i]) {
        c.surface_residual("-p_o cof F N . eta", surface, displacement, f0(k.pull));
        c.surface_jacobian("offset", surface, displacement, displacement, g1(k.pull_by_displacement));
        c.energy(Energy::external, "external", surface, k.pull_work);
      }
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  struct Number {
    std::string name;
    const char *unit;
    Range range;
    std::string help;
    PetscReal &common;
  };

  /// Reads a number for all surfaces, and for each of them.
  PetscErrorCode by_surface(Options &options, Number number, PetscReal value[])
  {
    PetscFunctionBeginUser;
    PetscCall(options.real(number.name, number.unit, number.range, number.help, number.common));
    for (std::size_t i = 0; i < surfaces_.size(); ++i) {
      const std::string name = number.name + "_" + surfaces_[i];
      bool given;
      options.hand_down(number.common, value[i]);
      PetscCall(options.given(name, given));
      PetscCall(options.real(name, number.unit, number.range, number.name + " of surface " + surfaces_[i], value[i]));
      if (given) options.only_volumes(value[i]);
    }
    options.drop_varying(number.common);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  bool on_ = false;
  std::string direction_ = "full";
  std::vector<std::string> surfaces_{"pleura", "airway"};
  PetscReal stiffness_ = 0.08, stiffening_ = 0, offset_ = 0; ///< of surfaces without a number of their own
  ChestWallKernels::Parameters parameters_{};
  std::array<bool, ChestWallKernels::max_surfaces> springs_{}, pulls_{}; ///< which surfaces have any
};

} // namespace pulmo
