/// @file
/// Hyperelastic tissue laws: stress and tangent from the derivatives of W by the invariants, once for all laws.
///
/// A law is one header in pulmo/physics/tissue/: a struct with
///
///   static constexpr const char *name, *alias, *source;   option value, short alias, publication
///   static constexpr bool uses_I2;                        whether W depends on I2 at all
///   struct Parameters { static constexpr const char *owner = "tissue"; PetscScalar ...; };
///   static PetscErrorCode declare(Options &, Parameters &);
///   static EnergyDerivatives energy(const Invariants &, const Parameters &);
///
/// and one line in src/physics/registry.cpp.
#pragma once

#include "pulmo/physics/point.hpp"

#include <cmath>
#include <memory>

namespace pulmo {

class Options;

/// Invariants of C = F^T F as differences from the reference state, free of cancellation near F = I.
struct Invariants {
  PetscScalar I1_minus_3; ///< tr C - 3
  PetscScalar I2_minus_3; ///< 1/2 [(tr C)^2 - tr C^2] - 3 (only set for laws that use I2)
  PetscScalar J_minus_1;  ///< det F - 1
  PetscScalar J;          ///< det F

  /// ln J, accurate near J = 1.
  PetscScalar log_J() const { return std::log1p(J_minus_1); }
};

/// W (kPa) and its derivatives with I1, I2 and J as independent variables (I3 = J^2).
struct EnergyDerivatives {
  PetscScalar W = 0;
  PetscScalar W1 = 0, W2 = 0, WJ = 0;
  PetscScalar W11 = 0, W12 = 0, W1J = 0, W22 = 0, W2J = 0, WJJ = 0;
};

/// x^n for a small whole n >= 0.
static inline PetscScalar whole_power(PetscScalar x, int n)
{
  PetscScalar r = 1;
  for (; n > 0; n >>= 1, x *= x)
    if (n & 1) r *= x;
  return r;
}

/// The invariants at a point; C (9 entries) is filled only if @p with_I2.
static inline Invariants invariants(const PointState &s, bool with_I2, PetscScalar C[9])
{
  const PetscScalar *H = s.H;
  Invariants inv{2 * (H[0] + H[4] + H[8]) + contract(H, H), 0, s.J_minus_1, s.J};
  if (with_I2) {
    PetscScalar D[9]; // C - I
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        D[3 * i + j] = H[3 * i + j] + H[3 * j + i] + H[i] * H[j] + H[3 + i] * H[3 + j] + H[6 + i] * H[6 + j];
    inv.I2_minus_3 = 2 * inv.I1_minus_3 + 0.5 * (inv.I1_minus_3 * inv.I1_minus_3 - contract(D, D));
    for (int i = 0; i < 9; ++i) C[i] = D[i] + (i % 4 == 0);
  }
  return inv;
}

/// The kernels of a law: everything that PETSc needs of it.
template <class Law>
struct TissueKernels {
  using Parameters = typename Law::Parameters;

  /// dI2/dF / 2 = I1 F - F C.
  static void half_dI2_dF(const PointState &s, const Invariants &inv, const PetscScalar C[9], PetscScalar B[9])
  {
    const PetscScalar I1 = inv.I1_minus_3 + 3;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        B[3 * i + j] =
            I1 * s.F[3 * i + j] - (s.F[3 * i] * C[j] + s.F[3 * i + 1] * C[3 + j] + s.F[3 * i + 2] * C[6 + j]);
  }

  /// Adds the effective first Piola-Kirchhoff stress P' = dW/dF (kPa) to f1:
  /// P' = 2 W1 F + 2 W2 (I1 F - F C) + WJ cof F.
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const PointState &s = point.state;
    PetscScalar C[9];
    const Invariants inv = invariants(s, Law::uses_I2, C);
    const EnergyDerivatives e = Law::energy(inv, k);
    for (int i = 0; i < 9; ++i) f1[i] += 2 * e.W1 * s.F[i] + e.WJ * s.cof_F[i];
    if constexpr (Law::uses_I2) {
      PetscScalar B[9];
      half_dI2_dF(s, inv, C, B);
      for (int i = 0; i < 9; ++i) f1[i] += 2 * e.W2 * B[i];
    }
  }

  /// Strain energy density W, kPa.
  static PetscScalar energy(const PointState &s, const Parameters &k)
  {
    PetscScalar C[9];
    return Law::energy(invariants(s, Law::uses_I2, C), k).W;
  }

  /// Growth of W over a step, kPa.
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    return energy(now.state, k) - energy(before.state, k);
  }

  /// What backward Euler loses in the tissue: P' : dF - dW with the stress at the end of the step, kPa.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar P[9] = {0}, D[9];
    stress(now, k, P);
    for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
    return contract(P, D) - stored(now, before, k);
  }

  /// Adds the tangent dP'/dF (kPa), stored [i][k][J][L], to g3.
  static void tangent(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    const PointState &s = point.state;
    const PetscScalar *F = s.F, *cof = s.cof_F;
    PetscScalar C[9], B[9];
    const Invariants inv = invariants(s, Law::uses_I2, C);
    const EnergyDerivatives e = Law::energy(inv, k);

    // second derivatives: sum over a, b of W_ab (dI_a/dF) x (dI_b/dF); X[iJ] collects what multiplies each factor
    PetscScalar XF[9], XB[9], Xcof[9];
    for (int i = 0; i < 9; ++i) {
      XF[i] = 4 * e.W11 * F[i] + 2 * e.W1J * cof[i];
      Xcof[i] = 2 * e.W1J * F[i] + e.WJJ * cof[i];
    }
    if constexpr (Law::uses_I2) {
      half_dI2_dF(s, inv, C, B);
      for (int i = 0; i < 9; ++i) {
        XF[i] += 4 * e.W12 * B[i];
        XB[i] = 4 * e.W12 * F[i] + 4 * e.W22 * B[i] + 2 * e.W2J * cof[i];
        Xcof[i] += 2 * e.W2J * B[i];
      }
    }
    for (int i = 0; i < 3; ++i)
      for (int m = 0; m < 3; ++m)
        for (int J = 0; J < 3; ++J)
          for (int L = 0; L < 3; ++L) {
            PetscScalar A = F[3 * i + J] * XF[3 * m + L] + cof[3 * i + J] * Xcof[3 * m + L];
            if constexpr (Law::uses_I2) A += B[3 * i + J] * XB[3 * m + L];
            g3[27 * i + 9 * m + 3 * J + L] += A;
          }

    // first derivatives: 2 W1 dF/dF + WJ d(cof F)/dF
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) g3[30 * i + 6 * i + 4 * J] += 2 * e.W1;
    add_cofactor_derivative(F, e.WJ, g3);

    // 2 W2 d(I1 F - F C)/dF
    if constexpr (Law::uses_I2) {
      const PetscScalar I1 = inv.I1_minus_3 + 3;
      for (int i = 0; i < 3; ++i)
        for (int m = 0; m < 3; ++m) {
          const PetscScalar b_im = F[3 * i] * F[3 * m] + F[3 * i + 1] * F[3 * m + 1] + F[3 * i + 2] * F[3 * m + 2];
          for (int J = 0; J < 3; ++J)
            for (int L = 0; L < 3; ++L) {
              PetscScalar d = 2 * F[3 * i + J] * F[3 * m + L] - F[3 * i + L] * F[3 * m + J];
              if (J == L) d -= b_im;
              if (i == m) d -= C[3 * J + L];
              if (i == m && J == L) d += I1;
              g3[27 * i + 9 * m + 3 * J + L] += 2 * e.W2 * d;
            }
        }
    }
  }
};

/// A law's stress and tangent for kernels of other effects, with its parameters among the constants of PetscDS
/// (Point::constants); they add to what they are given.
struct LawFunctions {
  using Stress = void (*)(const PointState &, const PetscScalar constants[], PetscScalar P[9]);
  using Tangent = void (*)(const PointState &, const PetscScalar constants[], PetscScalar A[81]);
  Stress stress;
  Tangent tangent;
};

/// A tissue law chosen at run time: its options, its parameters and its kernels.
class TissueLaw {
public:
  virtual ~TissueLaw() = default;
  virtual const char *name() const = 0;
  virtual const char *alias() const = 0;
  virtual const char *source() const = 0;
  virtual PetscErrorCode declare(Options &options) = 0;
  virtual const PetscScalar *parameters(PetscInt *count) const = 0;
  virtual Callback<PetscPointFunc> stress_callback() const = 0;
  virtual Callback<PetscPointJac> tangent_callback() const = 0;
  virtual Callback<EnergyDensity> stored_callback() const = 0;
  virtual Callback<EnergyDensity> numerical_callback() const = 0;
  virtual LawFunctions functions() const = 0;
  /// Strain energy density W at a state, kPa.
  virtual PetscScalar energy(const PointState &state) const = 0;
  /// P' = dW/dF at a state, kPa, with the parameters among @p constants (Model::constants_at), or the law's own if
  /// null.
  virtual void stress(const PointState &state, const PetscScalar *constants, PetscScalar P[9]) const = 0;
  void stress(const PointState &state, PetscScalar P[9]) const { stress(state, nullptr, P); }
  /// dP'/dF, kPa, stored [i][k][J][L].
  virtual void tangent(const PointState &state, const PetscScalar *constants, PetscScalar A[81]) const = 0;
  void tangent(const PointState &state, PetscScalar A[81]) const { tangent(state, nullptr, A); }
};

template <class Law>
class TissueLawOf final : public TissueLaw {
public:
  using Kernels = TissueKernels<Law>;
  using Parameters = typename Law::Parameters;

  const char *name() const override { return Law::name; }
  const char *alias() const override { return Law::alias; }
  const char *source() const override { return Law::source; }
  PetscErrorCode declare(Options &options) override { return Law::declare(options, parameters_); }
  const PetscScalar *parameters(PetscInt *count) const override
  {
    *count = sizeof(Parameters) / sizeof(PetscScalar);
    return reinterpret_cast<const PetscScalar *>(&parameters_);
  }
  Callback<PetscPointFunc> stress_callback() const override { return volume_residual<Parameters, Kernels::stress>; }
  Callback<PetscPointJac> tangent_callback() const override { return volume_jacobian<Parameters, Kernels::tangent>; }
  Callback<EnergyDensity> stored_callback() const override { return energy_density<Parameters, Kernels::stored>; }
  Callback<EnergyDensity> numerical_callback() const override { return energy_density<Parameters, Kernels::numerical>; }
  LawFunctions functions() const override
  {
    return {[](const PointState &s, const PetscScalar c[], PetscScalar P[9]) {
              Kernels::stress(bare(s), constants::get<Parameters>(c), P);
            },
            [](const PointState &s, const PetscScalar c[], PetscScalar A[81]) {
              Kernels::tangent(bare(s), constants::get<Parameters>(c), A);
            }};
  }
  PetscScalar energy(const PointState &state) const override { return Kernels::energy(state, parameters_); }
  using TissueLaw::stress;
  using TissueLaw::tangent;
  void stress(const PointState &state, const PetscScalar *constants, PetscScalar P[9]) const override
  {
    for (int i = 0; i < 9; ++i) P[i] = 0;
    Kernels::stress(bare(state), among(constants), P);
  }
  void tangent(const PointState &state, const PetscScalar *constants, PetscScalar A[81]) const override
  {
    for (int i = 0; i < 81; ++i) A[i] = 0;
    Kernels::tangent(bare(state), among(constants), A);
  }

private:
  Parameters among(const PetscScalar *constants) const
  {
    return constants ? constants::get<Parameters>(constants) : parameters_;
  }
  static Point bare(const PointState &state) { return {state, nullptr, 0, nullptr, 0, 0, nullptr, nullptr, {}}; }

  Parameters parameters_;
};

} // namespace pulmo
