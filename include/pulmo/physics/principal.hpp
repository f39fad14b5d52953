/// @file
/// Principal values and axes of a symmetric tensor, and what a function of the principal stretches gives: P and dP/dF.
#pragma once

#include "pulmo/physics/kinematics.hpp"

#include <cmath>
#include <limits>

namespace pulmo {

/// Makes @p S diagonal by Jacobi rotations, and multiplies the rows of @p axes (or null) by them: from the identity on
/// they become its axes. Values that are the same keep all their digits, which the characteristic polynomial halves.
static inline void diagonalize(PetscScalar S[3][3], PetscScalar axes[3][3])
{
  constexpr int sweeps = 20;
  const auto clear = [&] { return S[0][1] == 0 && S[0][2] == 0 && S[1][2] == 0; };
  for (int sweep = 0; sweep < sweeps && !clear(); ++sweep)
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        if (S[p][q] == 0) continue;
        const int r = 3 - p - q;
        const PetscScalar theta = (S[q][q] - S[p][p]) / (2 * S[p][q]);
        const PetscScalar t = std::copysign(1 / (std::abs(theta) + std::hypot(theta, 1)), theta);
        const PetscScalar c = 1 / std::hypot(t, 1), s = t * c, of_p = S[r][p], of_q = S[r][q];
        S[p][p] -= t * S[p][q];
        S[q][q] += t * S[p][q];
        S[p][q] = S[q][p] = 0;
        S[r][p] = S[p][r] = c * of_p - s * of_q;
        S[r][q] = S[q][r] = s * of_p + c * of_q;
        for (int i = 0; axes && i < 3; ++i) {
          const PetscScalar a = axes[p][i], b = axes[q][i];
          axes[p][i] = c * a - s * b;
          axes[q][i] = s * a + c * b;
        }
      }
}

/// F = sum of l_a n_a x N_a.
struct PrincipalStretches {
  PetscScalar minus_1[3]; ///< l_a - 1 without cancellation; no numbers unless J > 0
  PetscScalar N[3][3];    ///< [a]: axes before the deformation
  PetscScalar n[3][3];    ///< [a]: and after it

  explicit PrincipalStretches(const PointState &s)
  {
    const PetscScalar *H = s.H;
    PetscScalar D[3][3]; // C - I
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        D[i][j] = H[3 * i + j] + H[3 * j + i] + H[i] * H[j] + H[3 + i] * H[3 + j] + H[6 + i] * H[6 + j];
        N[i][j] = i == j;
      }
    diagonalize(D, N);
    for (int a = 0; a < 3; ++a) {
      const PetscScalar l = s.J > 0 ? std::sqrt(1 + D[a][a]) : std::numeric_limits<PetscScalar>::quiet_NaN();
      minus_1[a] = D[a][a] / (1 + l);
      for (int i = 0; i < 3; ++i)
        n[a][i] = (s.F[3 * i] * N[a][0] + s.F[3 * i + 1] * N[a][1] + s.F[3 * i + 2] * N[a][2]) / l;
    }
  }
};

/// W (kPa) of the principal stretches, in any order of them, and its derivatives by them.
struct StretchDerivatives {
  PetscScalar W = 0, first[3] = {0, 0, 0}, second[3][3] = {{0}};
};

/// Adds P = sum of W_a n_a x N_a to @p P.
static inline void add_principal_stress(const PrincipalStretches &at, const StretchDerivatives &e, PetscScalar P[9])
{
  for (int a = 0; a < 3; ++a)
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) P[3 * i + J] += e.first[a] * at.n[a][i] * at.N[a][J];
}

/// (W_a - W_b) / (l_a - l_b) of @p derivatives(l - 1), which are @p e at @p minus_1; W_aa - W_ab where the two
/// stretches are one. Along the line from one order of the two to the other, W_a - W_b is the integral of that:
/// Simpson's rule has more digits than the quotient where they are close.
template <class Derivatives>
PetscScalar stretch_quotient(const PetscScalar minus_1[3], const StretchDerivatives &e, int a, int b,
                             const Derivatives &derivatives)
{
  constexpr PetscScalar close = 1e-3; // the rule's error grows as its fourth power, that of the quotient as 1 over it
  const PetscScalar difference = minus_1[a] - minus_1[b], quotient = (e.first[a] - e.first[b]) / difference;
  if (std::abs(difference) > close) return quotient;
  const PetscScalar here = (e.second[a][a] + e.second[b][b]) / 2 - e.second[a][b];
  if (difference == 0) return here;
  PetscScalar middle[3] = {minus_1[0], minus_1[1], minus_1[2]};
  middle[a] = middle[b] = (minus_1[a] + minus_1[b]) / 2;
  const StretchDerivatives m = derivatives(middle);
  if (!std::isfinite(m.W)) return quotient; // the law may have an answer on both sides only
  return (here + 2 * ((m.second[a][a] + m.second[b][b]) / 2 - m.second[a][b])) / 3;
}

/// Adds dP/dF, stored [i][k][J][L], of @p derivatives(l - 1) to @p A: with M_ab = n_a x N_b the sum of
/// W_ab M_aa x M_bb, and for each pair (q (M_ab + M_ba) x (M_ab + M_ba) + r (M_ab - M_ba) x (M_ab - M_ba)) / 2 with
/// q = (W_a - W_b) / (l_a - l_b), r = (W_a + W_b) / (l_a + l_b).
template <class Derivatives>
void add_principal_tangent(const PrincipalStretches &at, const Derivatives &derivatives, PetscScalar A[81])
{
  const StretchDerivatives e = derivatives(at.minus_1);
  const auto add = [&](PetscScalar factor, const PetscScalar X[9], const PetscScalar Y[9]) {
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)
        for (int J = 0; J < 3; ++J)
          for (int L = 0; L < 3; ++L) A[27 * i + 9 * k + 3 * J + L] += factor * X[3 * i + J] * Y[3 * k + L];
  };
  PetscScalar M[3][3][9];
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b)
      for (int i = 0; i < 3; ++i)
        for (int J = 0; J < 3; ++J) M[a][b][3 * i + J] = at.n[a][i] * at.N[b][J];
  for (int a = 0; a < 3; ++a) {
    PetscScalar sum[9];
    for (int i = 0; i < 9; ++i)
      sum[i] = e.second[a][0] * M[0][0][i] + e.second[a][1] * M[1][1][i] + e.second[a][2] * M[2][2][i];
    add(1, M[a][a], sum);
  }
  for (int a = 0; a < 3; ++a) {
    const int b = (a + 1) % 3;
    const PetscScalar q = stretch_quotient(at.minus_1, e, a, b, derivatives);
    const PetscScalar r = (e.first[a] + e.first[b]) / (2 + at.minus_1[a] + at.minus_1[b]);
    PetscScalar symmetric[9], skew[9];
    for (int i = 0; i < 9; ++i) {
      symmetric[i] = M[a][b][i] + M[b][a][i];
      skew[i] = M[a][b][i] - M[b][a][i];
    }
    add(q / 2, symmetric, symmetric);
    add(r / 2, skew, skew);
  }
}

} // namespace pulmo
