/// @file
/// Manufactured solutions and what drives them: stress, body force, flux and mass source, by nested automatic
/// differentiation (pulmo/physics/dual.hpp) of three things only: the displacement u(x, t), the pressure p(x, t) and
/// the energy W of Table 1 (Aviles-Rojas & Hurtado 2022) as a function of the invariants. None of pulmo's own
/// kinematics, stress or flux is used. Exact to rounding (checked in mms.cpp against the closed forms of free inflation
/// and by differences).
#pragma once

#include "pulmo/physics/dual.hpp"

namespace mms {

using pulmo::cos;
using pulmo::Dual;
using pulmo::exp;
using pulmo::log;
using pulmo::pow;
using pulmo::seed;
using pulmo::sin;

/// Energies, kPa; I3 = J^2. `gas` scales the manufactured pressure to the stiffness of the law: with a gas pressure as
/// large as the shear modulus and dead loads the exact solution is no stable equilibrium.
struct Berger {
  static constexpr const char *name = "berger";
  static constexpr double gas = 0.1;
  template <class T>
  static T W(const T &I1, const T &, const T &J)
  {
    const double mu = 0.2808, lambda = 0.4212, phi0 = 0.99;
    return 0.5 * mu * (I1 - 3.0) + 0.25 * lambda * (J * J - 1.0) - (mu + 0.5 * lambda) * log(J - 1.0 + phi0);
  }
};
struct Ma {
  static constexpr const char *name = "ma";
  static constexpr double gas = 0.1;
  template <class T>
  static T W(const T &I1, const T &I2, const T &)
  {
    const double a = 0.43, b = -0.6, c = 2;
    const T e = 0.5 * I1 - 1.5;
    return c * exp(a * (e * e) + b * (0.25 * I2 - 0.5 * I1 + 0.75));
  }
};
struct Birzle {
  static constexpr const char *name = "birzle";
  static constexpr double gas = 0.1;
  template <class T>
  static T W(const T &I1, const T &, const T &J)
  {
    const double c = 0.3567, beta = 1.075, c1 = 0.2782, c3 = 5.766e-3;
    const T I3 = J * J, iso = I1 * pow(I3, -1.0 / 3) - 3.0, vol = pow(I3, 1.0 / 3) - 1.0, vol2 = vol * vol;
    return c * (I1 - 3.0) + c / beta * (pow(I3, -beta) - 1.0) + c1 * (iso * iso * iso) + c3 * (vol2 * vol2 * vol2);
  }
};
struct Yoshihara {
  static constexpr const char *name = "yoshihara";
  static constexpr double gas = 1;
  template <class T>
  static T W(const T &I1, const T &, const T &J)
  {
    const double c = 1.298, beta = 0.75;
    return c * (I1 - 3.0) + c / beta * (pow(J * J, -beta) - 1.0);
  }
};
struct Rausch {
  static constexpr const char *name = "rausch";
  static constexpr double gas = 0.1;
  template <class T>
  static T W(const T &I1, const T &, const T &J)
  {
    const double cq = 4.1, cc = 20.7, kappa = 16.5;
    const T iso = I1 * pow(J * J, -1.0 / 3) - 3.0;
    return cq * (iso * iso) + cc * (iso * iso * iso) + 0.25 * kappa * (J * J - 1.0 - 2.0 * log(J));
  }
};

struct Patte {
  static constexpr const char *name = "patte";
  static constexpr double gas = 0.5;
  template <class T>
  static T W(const T &I1, const T &I2, const T &J)
  {
    const double beta1 = 0.2, beta2 = 0.4, alpha = 0.16, delta = 0.5;
    return beta1 * (I1 - 3.0 - 2.0 * log(J)) + beta2 * (I2 - 3.0 - 4.0 * log(J)) +
           alpha * (exp(delta * (J * J - 1.0 - 2.0 * log(J))) - 1.0);
  }
};

/// Permeability of the manufactured problems: k = k0 J^2 / (2 - J/2), mm^2/(kPa s). Any smooth law will do.
constexpr double k0 = 4;
template <class T>
T permeability(const T &J)
{
  return k0 * (J * J) / (2.0 - 0.5 * J);
}

/// u and p that no finite element holds: strains of 10 to 30 %, J between 0.87 and 1.36 at t = 1. X = (x, y, z,
/// t).
template <class Law>
struct Waves {
  template <class T>
  static void displacement(const T X[4], T u[3])
  {
    const T &x = X[0], &y = X[1], &z = X[2], &t = X[3];
    u[0] = t * (0.075 * sin(1.7 * x + 0.8 * y - 0.5 * z + 0.3));
    u[1] = t * (0.06 * cos(1.2 * x - 1.5 * y + 0.9 * z) + 0.04 * y);
    u[2] = t * (0.07 * sin(0.7 * x + 1.1 * y + 1.6 * z - 0.4));
  }
  template <class T>
  static T pressure(const T X[4])
  {
    return Law::gas * (0.3 + 0.25 * sin(1.5 * X[0] - 0.9 * X[1] + 1.2 * X[2] + 0.5 * X[3]));
  }
};

/// The same u with a p that P1 holds (the flux still varies, with C^-1 and k(J)): shows the order of u by itself.
template <class Law>
struct WavesLinearPressure : Waves<Law> {
  template <class T>
  static T pressure(const T X[4])
  {
    return Law::gas * (0.3 + 0.2 * X[0] - 0.15 * X[1] + 0.25 * X[2] + 0.1 * X[3]);
  }
};

/// u in P2 and p in P1 at every time, but no polynomial in time.
template <class Law>
struct Polynomials {
  template <class T>
  static void displacement(const T X[4], T u[3])
  {
    const T &x = X[0], &y = X[1], &z = X[2];
    const T f = sin(1.4 * X[3]), g = exp(0.8 * X[3]) - 1.0;
    u[0] = f * (0.20 * x + 0.06 * (x * y) - 0.05 * (z * z));
    u[1] = g * (0.07 * y - 0.05 * (x * x) + 0.03 * (y * z));
    u[2] = f * (0.12 * z + 0.08 * (y * y)) - g * (0.04 * (x * z));
  }
  template <class T>
  static T pressure(const T X[4])
  {
    return Law::gas * ((0.2 + 0.3 * sin(2.0 * X[3])) * (1.0 - 0.6 * X[0] + 0.3 * X[1]) + 0.15 * (cos(X[3]) * X[2]));
  }
};

/// Everything the weak form needs at one point; tensors row by row, first index spatial.
struct State {
  double u[3], grad_u[9], p, grad_p[3];
  double J, dJ_dt;
  double P_effective[9]; ///< dW/dF, kPa
  double cof_F[9];
  double P[9];  ///< dW/dF - p cof F
  double B[3];  ///< -Div P, kPa/mm
  double Q[3];  ///< mm/s
  double div_Q; ///< 1/s
};

template <class T>
void cofactors(const T A[9], T cof[9])
{
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
      cof[3 * i + j] = A[3 * a + c] * A[3 * b + d] - A[3 * a + d] * A[3 * b + c];
    }
}

/// W of a deformation gradient.
template <class Law, class T>
T energy(const T F[9])
{
  T C[9], cof[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) C[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
  const T I1 = C[0] + C[4] + C[8];
  const T I2 = C[0] * C[4] - C[1] * C[3] + C[4] * C[8] - C[5] * C[7] + C[0] * C[8] - C[2] * C[6];
  cofactors(F, cof);
  return Law::W(I1, I2, F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]);
}

/// P' = dW/dF, with whatever derivatives the entries of F carry.
template <class Law, class T>
void effective_stress(const T F[9], T P[9])
{
  Dual<T, 9> seeded[9];
  seed(F, seeded);
  const Dual<T, 9> W = energy<Law>(seeded);
  for (int i = 0; i < 9; ++i) P[i] = W.d[i];
}

template <class Law, class Solution>
State state(double t, const double x[3])
{
  using D = Dual<double, 4>; // derivatives by x, y, z, t
  using DD = Dual<D, 4>;     // and once more
  const double at[4] = {x[0], x[1], x[2], t};
  D once[4];
  DD X[4], u[3];
  seed(at, once);
  seed(once, X);
  Solution::displacement(X, u);
  const DD p = Solution::pressure(X);

  D F[9], cof[9], P_effective[9], P[9], Q[3];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) F[3 * i + j] = u[i].d[j] + (i == j ? 1.0 : 0.0);
  cofactors(F, cof);
  const D J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2];
  effective_stress<Law>(F, P_effective);
  for (int i = 0; i < 9; ++i) P[i] = P_effective[i] - p.v * cof[i];

  // Q = -k J C^-1 Grad p with C^-1 = cof C / det C
  D C[9], cof_C[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) C[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
  cofactors(C, cof_C);
  const D factor = -(permeability(J) * J / (J * J));
  for (int i = 0; i < 3; ++i)
    Q[i] = factor * (cof_C[3 * i] * p.d[0] + cof_C[3 * i + 1] * p.d[1] + cof_C[3 * i + 2] * p.d[2]);

  State s{};
  s.p = p.v.v;
  s.J = J.v;
  s.dJ_dt = J.d[3];
  for (int i = 0; i < 3; ++i) {
    s.u[i] = u[i].v.v;
    s.grad_p[i] = p.d[i].v;
    s.Q[i] = Q[i].v;
    s.div_Q += Q[i].d[i];
    for (int j = 0; j < 3; ++j) {
      s.grad_u[3 * i + j] = u[i].d[j].v;
      s.B[i] -= P[3 * i + j].d[j];
    }
  }
  for (int i = 0; i < 9; ++i) {
    s.P_effective[i] = P_effective[i].v;
    s.P[i] = P[i].v;
    s.cof_F[i] = cof[i].v;
  }
  return s;
}

/// J alone, for the increment over a step.
template <class Solution>
double J_of(double t, const double x[3])
{
  const double at[4] = {x[0], x[1], x[2], t};
  Dual<double, 4> X[4], u[3];
  seed(at, X);
  Solution::displacement(X, u);
  double F[9], cof[9];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) F[3 * i + j] = u[i].d[j] + (i == j ? 1.0 : 0.0);
  cofactors(F, cof);
  return F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2];
}

} // namespace mms
