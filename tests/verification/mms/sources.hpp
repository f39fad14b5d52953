/// @file
/// Loads that make a manufactured solution solve pulmo's equations, as kernels.
#pragma once

#include "verification/mms/manufactured.hpp"

#include "pulmo/pulmo.hpp"

#include <array>
#include <functional>
#include <unordered_map>

namespace mms {

using namespace pulmo;

constexpr double spring = 0.8; ///< kPa/mm

/// The permeability of the manufactured problems with its derivative by hand.
struct RationalPermeability {
  static constexpr const char *name = "rational", *about = "k = k0 J^2 / (2 - J / 2)";
  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k0 = mms::k0;
  };
  static PetscErrorCode declare(Options &, Parameters &) { return PETSC_SUCCESS; }
  static PermeabilityValue permeability(PetscScalar J, const Parameters &p)
  {
    const double q = 2 - J / 2;
    return {p.k0 * J * J / q, p.k0 * (2 * J / q + J * J / (2 * q * q))};
  }
};

using Place = std::array<double, 3>;
struct HashOfPlace {
  std::size_t operator()(const Place &x) const
  {
    std::size_t h = 0;
    for (double v : x) h = h * 1000003 + std::hash<double>()(v);
    return h;
  }
};

/// Loads that make Solution solve the problem.
template <class Law, class Solution>
struct Sources {
  using P = NoParameters;
  /// Every term, every residual of a step asks for the same places: each is worked out once for a time.
  static const State &exact(const Point &point)
  {
    static std::unordered_map<Place, State, HashOfPlace> known;
    static double time = 0;
    if (point.t != time) known.clear();
    time = point.t;
    const auto [at, is_new] = known.try_emplace(Place{point.x[0], point.x[1], point.x[2]});
    if (is_new) at->second = state<Law, Solution>(point.t, point.x);
    return at->second;
  }

  // strong form: body force, mass source, tractions, outward flux. Over a step the source holds the exact increment of
  // J, so that backward Euler makes no error and what is left is the error in space.
  static void body_force(const Point &point, const P &, PetscScalar f0[])
  {
    const State &s = exact(point);
    for (int i = 0; i < 3; ++i) f0[i] -= s.B[i];
  }
  static void mass_source(const Point &point, const P &, PetscScalar f0[])
  {
    const double dt = point.step.dt;
    const State &s = exact(point);
    f0[0] -= (s.J - J_of<Solution>(point.t - dt, point.x)) / dt + s.div_Q;
  }
  /// The same with the rate itself: backward Euler and BDF2 then make the error of their order.
  static void mass_source_rate(const Point &point, const P &, PetscScalar f0[])
  {
    const State &s = exact(point);
    f0[0] -= s.dJ_dt + s.div_Q;
  }
  enum class Wall { plain, sprung, pressurised };
  template <Wall W>
  static void traction(const Point &point, const P &, PetscScalar f0[])
  {
    const State &s = exact(point);
    for (int i = 0; i < 3; ++i) {
      double T = W == Wall::sprung ? spring * s.u[i] : 0;
      for (int j = 0; j < 3; ++j)
        T += (s.P[3 * i + j] + (W == Wall::pressurised ? s.p * s.cof_F[3 * i + j] : 0)) * point.normal[j];
      f0[i] -= T;
    }
  }
  static void outflow(const Point &point, const P &, PetscScalar f0[])
  {
    const State &s = exact(point);
    for (int i = 0; i < 3; ++i) f0[0] += s.Q[i] * point.normal[i];
  }

  // weak form, for the order in time: the exact stress, flux and rate of J against the test functions, so that the
  // interpolant solves the semi-discrete problem exactly and what is left is the error in time.
  static void stress(const Point &point, const P &, PetscScalar f1[])
  {
    const State &s = exact(point);
    for (int i = 0; i < 9; ++i) f1[i] -= s.P[i];
  }
  static void rate(const Point &point, const P &, PetscScalar f0[]) { f0[0] -= exact(point).dJ_dt; }
  static void flux(const Point &point, const P &, PetscScalar f1[])
  {
    const State &s = exact(point);
    for (int i = 0; i < 3; ++i) f1[i] += s.Q[i];
  }
};

/// Values of the solution and of its gradients.
template <class Solution>
void values(double t, const double x[3], double u[3], double grad_u[9], double &p, double grad_p[3])
{
  using D = Dual<double, 4>;
  const double at[4] = {x[0], x[1], x[2], t};
  D X[4], U[3];
  seed(at, X);
  Solution::displacement(X, U);
  const D pressure_value = Solution::pressure(X);
  p = pressure_value.v;
  for (int i = 0; i < 3; ++i) {
    u[i] = U[i].v;
    grad_p[i] = pressure_value.d[i];
    for (int j = 0; j < 3; ++j) grad_u[3 * i + j] = U[i].d[j];
  }
}

} // namespace mms
