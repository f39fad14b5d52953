/// @file
/// Hyperelastic tissue laws: stress and tangent from the derivatives of W by the invariants, once for all laws.
///
/// A law is one header in pulmo/physics/tissue/: a struct with
///
///   static constexpr const char *name, *alias, *source;   option value, short alias, publication
///   static constexpr bool uses_I2;                        whether W depends on I2 at all
///   struct Parameters { static constexpr const char *owner = "tissue"; PetscScalar ...; };
///   static PetscErrorCode declare(Options &, Parameters &);
///   template <class T> static T W(const Invariants<T> &, const Parameters &);   energy density, kPa
///
/// and one line in src/physics/registry.cpp. The derivatives of W come from dual numbers. A law that also has
///
///   static EnergyDerivatives derivatives(const Invariants<> &, const Parameters &);
///
/// takes these instead: faster, and compared with the others by the tests. A law of the principal stretches, in any
/// order of them, has in place of uses_I2 and W
///
///   static StretchDerivatives of_stretches(const PetscScalar minus_1[3], const Parameters &);   of l_a - 1
///
/// which is no number where the law has no answer. A law that depends on the reference porosity has
///
///   static PetscScalar &porosity(Parameters &);   becomes -tissue_porosity, whose default it holds before
#pragma once

#include "pulmo/physics/dual.hpp"
#include "pulmo/physics/point.hpp"
#include "pulmo/physics/principal.hpp"
#include "pulmo/physics/stress_free.hpp"

#include <cmath>
#include <limits>
#include <memory>

namespace pulmo {

class Options;

/// Invariants of C = F^T F as differences from the reference state, free of cancellation near F = I.
template <class T = PetscScalar>
struct Invariants {
  T I1_minus_3; ///< tr C - 3
  T I2_minus_3; ///< 1/2 [(tr C)^2 - tr C^2] - 3; not a number for laws that do not say that they use it
  T J_minus_1;  ///< det F - 1
  T J;          ///< det F

  // accurate near the reference state:
  /// ln J.
  T log_J() const { return log1p(J_minus_1); }
  /// I3^n - 1 with I3 = J^2.
  T power_of_I3_minus_1(PetscScalar n) const { return expm1(2 * n * log_J()); }
  /// I1 I3^(-1/3) - 3.
  T isochoric_I1_minus_3() const
  {
    const T y = power_of_I3_minus_1(1. / 3);
    return (I1_minus_3 - 3 * y) / (1 + y);
  }
};

/// Derivatives of W (kPa) with I1, I2 and J as independent variables (I3 = J^2).
struct EnergyDerivatives {
  PetscScalar W1 = 0, W2 = 0, WJ = 0;
  PetscScalar W11 = 0, W12 = 0, W1J = 0, W22 = 0, W2J = 0, WJJ = 0;
};

/// x^n for a small whole n >= 0.
template <class T>
T whole_power(T x, int n)
{
  T r = 1;
  for (; n > 0; n >>= 1, x *= x)
    if (n & 1) r *= x;
  return r;
}

/// Whether a law has the derivatives of its W by hand.
template <class Law, class = void>
constexpr bool has_derivatives = false;
template <class Law>
constexpr bool
    has_derivatives<Law, std::void_t<decltype(Law::derivatives(std::declval<const Invariants<> &>(),
                                                               std::declval<const typename Law::Parameters &>()))>> =
        true;

/// Whether a law is one of the principal stretches.
template <class Law, class = void>
constexpr bool of_stretches = false;
template <class Law>
constexpr bool
    of_stretches<Law, std::void_t<decltype(Law::of_stretches(std::declval<const PetscScalar *>(),
                                                             std::declval<const typename Law::Parameters &>()))>> =
        true;

/// Whether a law depends on the reference porosity.
template <class Law, class = void>
constexpr bool has_porosity = false;
template <class Law>
constexpr bool has_porosity<Law, std::void_t<decltype(Law::porosity(std::declval<typename Law::Parameters &>()))>> =
    true;

/// A law that gives its W alone, whatever else it has.
template <class Law>
struct EnergyAlone {
  static constexpr const char *name = Law::name, *alias = Law::alias, *source = Law::source;
  static constexpr bool uses_I2 = Law::uses_I2;
  using Parameters = typename Law::Parameters;
  static PetscErrorCode declare(Options &options, Parameters &k) { return Law::declare(options, k); }
  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    return Law::W(inv, k);
  }
};

/// W of a law with the dual numbers @p D in place of its invariants: I1, J, and I2 if the law uses it.
template <class Law, class D, class T, int N>
D dual_energy(const T (&value)[N], const typename Law::Parameters &k)
{
  D at[N], I2(std::numeric_limits<PetscScalar>::quiet_NaN());
  seed(value, at);
  if constexpr (Law::uses_I2)
    I2 = at[2];
  else
    I2.d.fill(I2.v); // what is not offered must not pass for a constant
  return Law::W(Invariants<D>{at[0], I2, at[1], at[1] + 1.0}, k);
}

/// The derivatives of a law: its own, or those that dual numbers give; second ones only if @p second.
template <class Law, bool second>
EnergyDerivatives energy_derivatives(const Invariants<> &inv, const typename Law::Parameters &k)
{
  if constexpr (has_derivatives<Law>) {
    return Law::derivatives(inv, k);
  } else {
    constexpr int n = Law::uses_I2 ? 3 : 2, I1 = 0, J = 1, I2 = n - 1; // I2: if the law uses it
    using D = Dual<PetscScalar, n>;
    EnergyDerivatives e;
    PetscScalar value[n] = {inv.I1_minus_3, inv.J_minus_1};
    if constexpr (Law::uses_I2) value[I2] = inv.I2_minus_3;
    if constexpr (second) {
      D once[n];
      seed(value, once);
      const Dual<D, n> W = dual_energy<Law, Dual<D, n>>(once, k);
      e.W1 = W.v.d[I1], e.WJ = W.v.d[J];
      e.W11 = W.d[I1].d[I1], e.W1J = W.d[I1].d[J], e.WJJ = W.d[J].d[J];
      if constexpr (Law::uses_I2) {
        e.W2 = W.v.d[I2];
        e.W12 = W.d[I1].d[I2], e.W22 = W.d[I2].d[I2], e.W2J = W.d[I2].d[J];
      }
    } else {
      const D W = dual_energy<Law, D>(value, k);
      e.W1 = W.d[I1], e.WJ = W.d[J];
      if constexpr (Law::uses_I2) e.W2 = W.d[I2];
    }
    return e;
  }
}

/// The invariants at a point; C (9 entries) is filled only if @p with_I2.
static inline Invariants<> invariants(const PointState &s, bool with_I2, PetscScalar C[9])
{
  const PetscScalar *H = s.H;
  Invariants<> inv{2 * (H[0] + H[4] + H[8]) + contract(H, H), std::numeric_limits<PetscScalar>::quiet_NaN(),
                   s.J_minus_1, s.J};
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
  static void half_dI2_dF(const PointState &s, const Invariants<> &inv, const PetscScalar C[9], PetscScalar B[9])
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
    if constexpr (of_stretches<Law>) {
      const PrincipalStretches at(s);
      add_principal_stress(at, Law::of_stretches(at.minus_1, k), f1);
    } else {
      PetscScalar C[9];
      const Invariants<> inv = invariants(s, Law::uses_I2, C);
      const EnergyDerivatives e = energy_derivatives<Law, false>(inv, k);
      for (int i = 0; i < 9; ++i) f1[i] += 2 * e.W1 * s.F[i] + e.WJ * s.cof_F[i];
      if constexpr (Law::uses_I2) {
        PetscScalar B[9];
        half_dI2_dF(s, inv, C, B);
        for (int i = 0; i < 9; ++i) f1[i] += 2 * e.W2 * B[i];
      }
    }
  }

  /// Strain energy density W, kPa.
  static PetscScalar energy(const PointState &s, const Parameters &k)
  {
    if constexpr (of_stretches<Law>) {
      return Law::of_stretches(PrincipalStretches(s).minus_1, k).W;
    } else {
      PetscScalar C[9];
      return Law::W(invariants(s, Law::uses_I2, C), k);
    }
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
    if constexpr (of_stretches<Law>)
      add_principal_tangent(
          PrincipalStretches(s), [&](const PetscScalar *minus_1) { return Law::of_stretches(minus_1, k); }, g3);
    else
      tangent_of_invariants(s, k, g3);
  }

private:
  static void tangent_of_invariants(const PointState &s, const Parameters &k, PetscScalar g3[])
  {
    const PetscScalar *F = s.F, *cof = s.cof_F;
    PetscScalar C[9], B[9];
    const Invariants<> inv = invariants(s, Law::uses_I2, C);
    const EnergyDerivatives e = energy_derivatives<Law, true>(inv, k);

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

/// A point of which a kernel reads no more than its state.
static inline Point bare_point(const PointState &state)
{
  return {state, nullptr, 0, nullptr, 0, 0, nullptr, nullptr, {}};
}

/// The same kernels for tissue that is not free of stress in the shape of the mesh (pulmo/physics/stress_free.hpp).
template <class Law>
struct StrainedKernels {
  using Kernels = TissueKernels<Law>;
  using Parameters = Both<typename Law::Parameters, StressFree>;

  template <When when>
  static void stress_when(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const FeltState felt(point, point.state, k.other, when);
    PetscScalar P[9] = {0};
    Kernels::stress(bare_point(felt.state), k.own, P);
    felt.add_stress(P, f1);
  }
  template <When when>
  static void tangent_when(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    const FeltState felt(point, point.state, k.other, when);
    PetscScalar A[81] = {0};
    Kernels::tangent(bare_point(felt.state), k.own, A);
    felt.add_tangent(A, g3);
  }
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    stress_when<When::now>(point, k, f1);
  }
  static void tangent(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    tangent_when<When::now>(point, k, g3);
  }
  // the stress-free shape at the start of the step is told by what @p now remembers
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &k)
  {
    const FeltState end(now, now.state, k.other, When::now), start(now, before.state, k.other, When::accepted);
    return Kernels::energy(end.state, k.own) / end.det - Kernels::energy(start.state, k.own) / start.det;
  }
  /// Energy that the tissue gives up in a step as its stress-free shape changes, at the strain of its end.
  static PetscScalar released(const Point &now, const Point &, const Parameters &k)
  {
    const FeltState end(now, now.state, k.other, When::now), start(now, now.state, k.other, When::accepted);
    return Kernels::energy(start.state, k.own) / start.det - Kernels::energy(end.state, k.own) / end.det;
  }
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar P[9] = {0}, D[9];
    stress(now, k, P);
    for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
    return contract(P, D) - stored(now, before, k) - released(now, before, k);
  }
};

/// A law's stress and tangent for kernels of other effects, with all parameters in Point::constants; they add to what
/// they are given.
struct LawFunctions {
  using Stress = void (*)(const Point &, PetscScalar P[9]);
  using Tangent = void (*)(const Point &, PetscScalar A[81]);
  Stress stress;
  Tangent tangent;
};

/// Callbacks of the tissue's own terms.
struct LawCallbacks {
  Callback<PetscPointFunc> stress;
  Callback<PetscPointJac> tangent;
  Callback<EnergyDensity> stored, numerical;
  Callback<EnergyDensity> released; ///< for an effect whose stress-free shape changes; null if that is the mesh's
};

/// A tissue law chosen at run time: its options, its parameters and its kernels.
class TissueLaw {
public:
  virtual ~TissueLaw() = default;
  virtual const char *name() const = 0;
  virtual const char *alias() const = 0;
  virtual const char *source() const = 0;
  virtual PetscErrorCode declare(Options &options) = 0;
  /// The law's own copy of the reference porosity; it holds the law's default. Null: the law does not depend on it.
  virtual PetscScalar *porosity() = 0;
  virtual const PetscScalar *parameters(PetscInt *count) const = 0;
  /// @p strained: effects say where the tissue is free of stress.
  virtual LawCallbacks callbacks(bool strained) const = 0;
  virtual LawFunctions functions(bool strained) const = 0;
  /// The same law with all derivatives from its W by dual numbers (tests compare both).
  virtual std::unique_ptr<TissueLaw> energy_alone() const = 0;
  /// Strain energy density W at a state, kPa, with the law's parameters among @p constants, or its own if null.
  virtual PetscScalar energy(const PointState &state, const PetscScalar *constants) const = 0;
  PetscScalar energy(const PointState &state) const { return energy(state, nullptr); }
  /// P' in an accepted state, kPa. With @p constants (Model::constants_at): with the parameters and the stress-free
  /// shape that they hold, of which effects know by @p accepted (PointMemory; of all of them); null: dW/dF with the
  /// law's own parameters.
  virtual void stress(const PointState &state, const PetscScalar *constants, const Memory &accepted,
                      PetscScalar P[9]) const = 0;
  /// dP'/dF, kPa, stored [i][k][J][L].
  virtual void tangent(const PointState &state, const PetscScalar *constants, const Memory &accepted,
                       PetscScalar A[81]) const = 0;
  // what is remembered is that of the start
  void stress(const PointState &state, const PetscScalar *constants, PetscScalar P[9]) const
  {
    stress(state, constants, {}, P);
  }
  void stress(const PointState &state, PetscScalar P[9]) const { stress(state, nullptr, P); }
  void tangent(const PointState &state, const PetscScalar *constants, PetscScalar A[81]) const
  {
    tangent(state, constants, {}, A);
  }
  void tangent(const PointState &state, PetscScalar A[81]) const { tangent(state, nullptr, A); }
};

template <class Law>
class TissueLawOf final : public TissueLaw {
public:
  using Kernels = TissueKernels<Law>;
  using Strained = StrainedKernels<Law>;
  using Parameters = typename Law::Parameters;

  TissueLawOf() = default;
  explicit TissueLawOf(const Parameters &parameters) : parameters_(parameters) {}

  const char *name() const override { return Law::name; }
  const char *alias() const override { return Law::alias; }
  const char *source() const override { return Law::source; }
  PetscErrorCode declare(Options &options) override { return Law::declare(options, parameters_); }
  PetscScalar *porosity() override
  {
    if constexpr (has_porosity<Law>)
      return &Law::porosity(parameters_);
    else
      return nullptr;
  }
  const PetscScalar *parameters(PetscInt *count) const override
  {
    *count = sizeof(Parameters) / sizeof(PetscScalar);
    return reinterpret_cast<const PetscScalar *>(&parameters_);
  }
  LawCallbacks callbacks(bool strained) const override
  {
    if (!strained) return callbacks_of<Kernels>();
    LawCallbacks callbacks = callbacks_of<Strained>();
    callbacks.released = energy_density<typename Strained::Parameters, Strained::released>;
    return callbacks;
  }
  LawFunctions functions(bool strained) const override
  {
    return strained ? functions_of<Strained>() : functions_of<Kernels>();
  }
  std::unique_ptr<TissueLaw> energy_alone() const override
  {
    using Alone = std::conditional_t<has_derivatives<Law>, EnergyAlone<Law>, Law>;
    return std::make_unique<TissueLawOf<Alone>>(parameters_);
  }
  using TissueLaw::energy;
  using TissueLaw::stress;
  using TissueLaw::tangent;
  PetscScalar energy(const PointState &state, const PetscScalar *constants) const override
  {
    return Kernels::energy(state, constants ? constants::get<Parameters>(constants) : parameters_);
  }
  void stress(const PointState &state, const PetscScalar *constants, const Memory &accepted,
              PetscScalar P[9]) const override
  {
    for (int i = 0; i < 9; ++i) P[i] = 0;
    if (!constants) return Kernels::stress(bare_point(state), parameters_, P);
    const auto k = constants::get<typename Strained::Parameters>(constants);
    if (k.other.count > 0)
      Strained::template stress_when<When::accepted>(remembering(state, constants, accepted), k, P);
    else
      Kernels::stress(bare_point(state), k.own, P);
  }
  void tangent(const PointState &state, const PetscScalar *constants, const Memory &accepted,
               PetscScalar A[81]) const override
  {
    for (int i = 0; i < 81; ++i) A[i] = 0;
    if (!constants) return Kernels::tangent(bare_point(state), parameters_, A);
    const auto k = constants::get<typename Strained::Parameters>(constants);
    if (k.other.count > 0)
      Strained::template tangent_when<When::accepted>(remembering(state, constants, accepted), k, A);
    else
      Kernels::tangent(bare_point(state), k.own, A);
  }

private:
  static Point remembering(const PointState &state, const PetscScalar *constants, const Memory &accepted)
  {
    Point point = bare_point(state);
    point.constants = constants;
    point.of_all = accepted;
    return point;
  }
  template <class K>
  static LawCallbacks callbacks_of()
  {
    using P = typename K::Parameters;
    return {volume_residual<P, K::stress>,
            volume_jacobian<P, K::tangent>,
            energy_density<P, K::stored>,
            energy_density<P, K::numerical>,
            {}};
  }
  template <class K>
  static LawFunctions functions_of()
  {
    using P = typename K::Parameters;
    return {
        [](const Point &point, PetscScalar stress[9]) { K::stress(point, constants::get<P>(point.constants), stress); },
        [](const Point &point, PetscScalar tangent[81]) {
          K::tangent(point, constants::get<P>(point.constants), tangent);
        }};
  }

  Parameters parameters_;
};

} // namespace pulmo
