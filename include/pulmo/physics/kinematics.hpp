/// @file
/// Kinematics of one point: F, cofactor and J - 1 without cancellation.
///
/// Second-order tensors are stored row by row, T[3 * i + j]; for two-point tensors such as F and P
/// the first index is spatial (component of u), the second material (direction of Grad). This is also
/// PETSc's order for Grad u and for the f1 of a vector field.
#pragma once

#include <petscsys.h>

namespace pulmo {

/// Cofactor cof A = det(A) A^-T of a 3x3 tensor; needs no inverse.
static inline void cofactor(const PetscScalar A[9], PetscScalar cof[9])
{
  cof[0] = A[4] * A[8] - A[5] * A[7];
  cof[1] = A[5] * A[6] - A[3] * A[8];
  cof[2] = A[3] * A[7] - A[4] * A[6];
  cof[3] = A[2] * A[7] - A[1] * A[8];
  cof[4] = A[0] * A[8] - A[2] * A[6];
  cof[5] = A[1] * A[6] - A[0] * A[7];
  cof[6] = A[1] * A[5] - A[2] * A[4];
  cof[7] = A[2] * A[3] - A[0] * A[5];
  cof[8] = A[0] * A[4] - A[1] * A[3];
}

/// Tensor cross product A x B, the bilinear form of the cofactor:
/// cof(A + B) = cof A + A x B + cof B (de Boer; Bonet, Gil & Ortigosa 2016).
static inline void tensor_cross(const PetscScalar A[9], const PetscScalar B[9], PetscScalar AxB[9])
{
  AxB[0] = A[4] * B[8] - A[5] * B[7] + B[4] * A[8] - B[5] * A[7];
  AxB[1] = A[5] * B[6] - A[3] * B[8] + B[5] * A[6] - B[3] * A[8];
  AxB[2] = A[3] * B[7] - A[4] * B[6] + B[3] * A[7] - B[4] * A[6];
  AxB[3] = A[2] * B[7] - A[1] * B[8] + B[2] * A[7] - B[1] * A[8];
  AxB[4] = A[0] * B[8] - A[2] * B[6] + B[0] * A[8] - B[2] * A[6];
  AxB[5] = A[1] * B[6] - A[0] * B[7] + B[1] * A[6] - B[0] * A[7];
  AxB[6] = A[1] * B[5] - A[2] * B[4] + B[1] * A[5] - B[2] * A[4];
  AxB[7] = A[2] * B[3] - A[0] * B[5] + B[2] * A[3] - B[0] * A[5];
  AxB[8] = A[0] * B[4] - A[1] * B[3] + B[0] * A[4] - B[1] * A[3];
}

/// Double contraction A : B.
static inline PetscScalar contract(const PetscScalar A[9], const PetscScalar B[9])
{
  PetscScalar s = 0;
  for (int i = 0; i < 9; ++i) s += A[i] * B[i];
  return s;
}

/// det A.
static inline PetscScalar determinant(const PetscScalar A[9])
{
  return A[0] * (A[4] * A[8] - A[5] * A[7]) + A[1] * (A[5] * A[6] - A[3] * A[8]) + A[2] * (A[3] * A[7] - A[4] * A[6]);
}

/// det(I + H) - 1 = tr H + tr cof H + det H: full relative accuracy for small H, where det F - 1 has none.
static inline PetscScalar jacobian_minus_one(const PetscScalar H[9])
{
  const PetscScalar tr_cof = (H[4] * H[8] - H[5] * H[7]) + (H[0] * H[8] - H[2] * H[6]) + (H[0] * H[4] - H[1] * H[3]);
  return (H[0] + H[4] + H[8]) + tr_cof + determinant(H);
}

/// What the linear change of volume misses over a step D that ends at F: J - J_before - cof F : D = det D - F : cof D.
static inline PetscScalar volume_beyond_linear(const PetscScalar F[9], const PetscScalar D[9])
{
  PetscScalar cof_D[9];
  cofactor(D, cof_D);
  return determinant(D) - contract(F, cof_D);
}

/// Adds factor * d(cof F)/dF, stored [i][k][J][L] (PETSc's order of g3 for a vector field):
/// d(cof F)_iJ / dF_kL = eps_ikm eps_JLN F_mN.
static inline void add_cofactor_derivative(const PetscScalar F[9], PetscScalar factor, PetscScalar g3[81])
{
  for (int i = 0; i < 3; ++i) {
    const int k = (i + 1) % 3, m = (i + 2) % 3;
    for (int J = 0; J < 3; ++J) {
      const int L = (J + 1) % 3, N = (J + 2) % 3;
      const PetscScalar f = factor * F[3 * m + N];
      // the four index pairs for which eps_ikm eps_JLN is not zero with this m and N
      g3[27 * i + 9 * k + 3 * J + L] += f;
      g3[27 * i + 9 * k + 3 * L + J] -= f;
      g3[27 * k + 9 * i + 3 * J + L] -= f;
      g3[27 * k + 9 * i + 3 * L + J] += f;
    }
  }
}

/// What every kernel at a point shares; made once per point (lengths in mm, time in s).
struct PointState {
  PetscScalar H[9];      ///< Grad u
  PetscScalar F[9];      ///< deformation gradient, I + H
  PetscScalar cof_F[9];  ///< J F^-T
  PetscScalar J;         ///< det F
  PetscScalar J_minus_1; ///< det F - 1 without cancellation
  PetscScalar H_rate[9]; ///< Grad u_t, 1/s
};

/// Fills @p s from Grad u and (or null for no motion) Grad u_t.
static inline void make_point_state(const PetscScalar grad_u[9], const PetscScalar grad_u_t[9], PointState &s)
{
  for (int i = 0; i < 9; ++i) s.H[i] = s.F[i] = grad_u[i];
  for (int i = 0; i < 9; i += 4) s.F[i] += 1.0;
  cofactor(s.F, s.cof_F);
  s.J_minus_1 = jacobian_minus_one(s.H);
  s.J = 1.0 + s.J_minus_1;
  for (int i = 0; i < 9; ++i) s.H_rate[i] = grad_u_t ? grad_u_t[i] : 0.0;
}

} // namespace pulmo
