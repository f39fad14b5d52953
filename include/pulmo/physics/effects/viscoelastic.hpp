/// @file
/// Effect `viscoelastic`: tissue that relaxes, and dissipates when it is breathed.
///
/// Quasi-linear overstress on the whole second Piola-Kirchhoff stress of the law, whatever it is (after Fung 1993,
/// Biomechanics, chapter 7; Simo 1987):
///   S = S_e + sum h_i,   dh_i/dt + h_i / tau_i = g_i dS_e/dt,   P = F S
/// so that W is the response to slow changes, and fast ones meet 1 + sum g_i of it. h_i belongs to the reference
/// configuration: a rotation of the whole leaves it alone. It is driven by the change of S_e, as a law need not be free
/// of stress at rest. The rates are those of the time scheme: with slope a and the past's share p(y) in dy/dt,
///   h_i = (g_i (a S_e + p(S_e)) - p(h_i)) / (a + 1 / tau_i).
/// Three times a decade apart with equal moduli give a loss tangent near 0.1 from 0.05 to 1 Hz, as constant-phase
/// tissue has it (after Fredberg & Stamenovic 1989; Hantos et al. 1992).
#pragma once

#include "pulmo/physics/effect.hpp"

#include <array>

namespace pulmo {

struct ViscoelasticKernels {
  static constexpr int max_branches = 6, tensor = 6; ///< a symmetric tensor: xx, yy, zz, yz, xz, xy

  struct Parameters {
    static constexpr const char *owner = "viscoelastic";
    PetscScalar branches = 0;
    PetscScalar g[max_branches] = {0};   ///< moduli over those of the law, -
    PetscScalar tau[max_branches] = {0}; ///< s
    PetscScalar stress = 0, tangent = 0; ///< LawFunctions, as constants::to_scalar() packs them
    PetscScalar by_pressure = 0;         ///< StressByPressure, packed alike
  };

  /// What is remembered: S_e, then h_1, h_2, ...
  struct State {
    PetscScalar S_e[tensor], h[max_branches][tensor], sum[tensor]; ///< kPa; sum of all h
    PetscScalar c = 0;                                             ///< d(sum h)/d(S_e)
  };

  static constexpr int row[tensor] = {0, 1, 2, 1, 0, 0}, column[tensor] = {0, 1, 2, 2, 2, 1};
  /// Place of component i, j.
  static constexpr int place(int i, int j) { return i == j ? i : 6 - i - j; }

  /// S_e = F^-1 P_e.
  static void elastic_stress(const Point &point, const Parameters &k, PetscScalar S[tensor])
  {
    const PetscScalar *cof = point.state.cof_F;
    PetscScalar P[9] = {0};
    constants::to_pointer<LawFunctions::Stress>(k.stress)(point, P);
    for (int m = 0; m < tensor; ++m) { // F^-1 = cof^T / J
      const int I = row[m], J = column[m];
      S[m] = (cof[I] * P[J] + cof[3 + I] * P[3 + J] + cof[6 + I] * P[6 + J]) / point.state.J;
    }
  }
  static State overstress(const Point &point, const Parameters &k)
  {
    const PetscScalar a = point.step.slope;
    const auto n = static_cast<int>(k.branches);
    State s{};
    elastic_stress(point, k, s.S_e);
    for (int i = 0; i < n; ++i) {
      const PetscScalar divisor = 1 / (a + 1 / k.tau[i]);
      s.c += k.g[i] * a * divisor;
      for (int m = 0; m < tensor; ++m) {
        const PetscScalar rate = point.memory.last ? a * s.S_e[m] + point.past(m) : 0;
        s.h[i][m] = (k.g[i] * rate - point.past(tensor * (i + 1) + m)) * divisor;
        s.sum[m] += s.h[i][m];
      }
    }
    return s;
  }

  /// f1 = F sum h.
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const State s = overstress(point, k);
    const PetscScalar *F = point.state.F;
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L) f1[3 * i + J] += F[3 * i + L] * s.sum[place(L, J)];
  }
  /// g3 = c dP_e/dF + d_ik (sum h - c S_e)_LJ, from F dS_e = dP_e - dF S_e.
  static void stress_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    const State s = overstress(point, k);
    PetscScalar A[81] = {0};
    constants::to_pointer<LawFunctions::Tangent>(k.tangent)(point, A);
    for (int i = 0; i < 81; ++i) g3[i] += s.c * A[i];
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L) g3[30 * i + 6 * i + 3 * J + L] += s.sum[place(L, J)] - s.c * s.S_e[place(L, J)];
  }
  /// g2 of (displacement, pressure) where P_e depends on the pressure: c dP_e/dp.
  static void stress_by_pressure(const Point &point, const Parameters &k, PetscScalar g2[])
  {
    PetscScalar P[9] = {0};
    constants::to_pointer<StressByPressure>(k.by_pressure)(point, point.constants, P);
    const PetscScalar c = overstress(point, k).c;
    for (int i = 0; i < 9; ++i) g2[i] += c * P[i];
  }
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    const State s = overstress(point, k);
    const auto n = static_cast<int>(k.branches);
    for (int m = 0; m < tensor; ++m) value[m] = s.S_e[m];
    for (int i = 0; i < n; ++i)
      for (int m = 0; m < tensor; ++m) value[tensor * (i + 1) + m] = s.h[i][m];
  }
  static void by_past(const Point &point, const Parameters &k, const PetscScalar weights[],
                      const PetscScalar gradient[9], PetscScalar by[])
  {
    const PetscScalar *F = point.state.F;
    PetscScalar along[tensor] = {0}; // F sum h : gradient, by h
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L) along[place(L, J)] += F[3 * i + L] * gradient[3 * i + J];
    for (int i = 0; i < static_cast<int>(k.branches); ++i)
      for (int m = 0; m < tensor; ++m) {
        const int own = tensor * (i + 1) + m;
        const PetscScalar by_h = (weights[own] + along[m]) / (point.step.slope + 1 / k.tau[i]);
        by[m] += k.g[i] * by_h;
        by[own] -= by_h;
      }
  }
  /// Weights w of S_e are V : dP_e - V : (dF S_e), V = F^-T w.
  static void by_state(const Point &point, const Parameters &k, const PetscScalar weights[], PetscScalar by_gradient[9],
                       PetscScalar &by_p)
  {
    const State s = overstress(point, k);
    const PetscScalar a = point.step.slope;
    PetscScalar V[9] = {0}, A[81] = {0}, P[9] = {0};
    for (int m = 0; m < tensor; ++m) {
      PetscScalar w = weights[m];
      for (int i = 0; i < static_cast<int>(k.branches); ++i)
        w += k.g[i] * a / (a + 1 / k.tau[i]) * weights[tensor * (i + 1) + m];
      for (int i = 0; i < 3; ++i) V[3 * i + column[m]] += point.state.cof_F[3 * i + row[m]] / point.state.J * w;
    }
    constants::to_pointer<LawFunctions::Tangent>(k.tangent)(point, A);
    for (int m = 0; m < 3; ++m)
      for (int L = 0; L < 3; ++L)
        for (int J = 0; J < 3; ++J) {
          by_gradient[3 * m + L] -= V[3 * m + J] * s.S_e[place(L, J)];
          for (int i = 0; i < 3; ++i) by_gradient[3 * m + L] += V[3 * i + J] * A[27 * i + 9 * m + 3 * J + L];
        }
    const auto by_pressure = constants::to_pointer<StressByPressure>(k.by_pressure);
    if (!by_pressure) return;
    by_pressure(point, point.constants, P);
    for (int i = 0; i < 9; ++i) by_p += V[i] * P[i];
  }
  /// Work that the overstress takes up in a step, F sum h : dF, kPa. What a branch stores comes back within a cycle;
  /// the rest is heat.
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar P[9] = {0}, sum = 0;
    stress(now, k, P);
    for (int i = 0; i < 9; ++i) sum += P[i] * (now.state.H[i] - before.state.H[i]);
    return sum;
  }
};

class Viscoelastic final : public Effect {
public:
  const char *name() const override { return "viscoelastic"; }
  const char *about() const override { return "tissue that relaxes (quasi-linear overstress; after Fung 1993)"; }
  const char *absence() const override { return "the tissue is elastic: it does not relax, and has no hysteresis"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    using K = ViscoelasticKernels;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the tissue relaxes", on_));
    options.group(name(), about(), on_, "-viscoelastic");
    std::size_t n_times = branches_;
    PetscCall(options.reals("moduli", "-", Range::not_negative(),
                            "stiffness of each branch over that of the law, g_i (by region: 0.2,0.1,right=0.4,0.1)",
                            parameters_.g, K::max_branches, branches_));
    PetscCall(options.reals("times", "s", Range::positive(), "time in which each branch relaxes, tau_i",
                            parameters_.tau, K::max_branches, n_times));
    PulmoUserCheck(branches_ == n_times, options.comm(),
                   "-viscoelastic_moduli has %d numbers and -viscoelastic_times %d: give one of each for a branch",
                   static_cast<int>(branches_), static_cast<int>(n_times));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  /// Overstress relaxes as stress and stays as a load: without stiffness against shear nothing holds the shape.
  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    constexpr PetscScalar rest[9] = {0}, least = 1e-6;
    PointState state;
    PetscScalar A[81]; // dP_iJ/dF_kL at 27 i + 9 k + 3 J + L

    PetscFunctionBeginUser;
    make_point_state(rest, nullptr, state);
    facts.law->tangent(state, A);
    const bool no_shear = std::abs(A[4]) < least * std::abs(A[0]); // P_xy by F_xy, P_xx by F_xx
    PulmoUserCheck(!no_shear || !facts.prestress, options.comm(),
                   "-viscoelastic with -prestress and -tissue %s: that law has no stiffness against shear, and the "
                   "overstress turns cells inside out at once; give another -tissue, or leave one of the two out",
                   facts.law->name());
    if (no_shear)
      PetscCall(
          PetscPrintf(options.comm(),
                      "pulmo: warning: -viscoelastic with -tissue %s: that law has no stiffness against shear, and "
                      "what is left of relaxed stress can turn cells inside out; give another -tissue\n",
                      facts.law->name()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = ViscoelasticKernels;
    using P = K::Parameters;
    static constexpr const char *components[K::tensor] = {"xx", "yy", "zz", "yz", "xz", "xy"};
    std::vector<Quantity> quantities;

    PetscFunctionBeginUser;
    const LawFunctions law = facts.law->functions(!facts.stress_free.empty());
    parameters_.branches = static_cast<PetscScalar>(branches_);
    parameters_.stress = constants::to_scalar(law.stress);
    parameters_.tangent = constants::to_scalar(law.tangent);
    for (std::size_t i = 0; i <= branches_; ++i)
      for (const char *component : components)
        quantities.push_back(
            {(i == 0 ? "elastic_stress_" : "overstress_" + std::to_string(i) + "_") + component, "kPa"});
    c.parameters(parameters_);
    c.remember(quantities, remembered<P, K::remember>);
    c.follows(by_past<P, K::by_past>, by_state<P, K::by_state>);
    c.residual("F sum h : Grad eta", displacement, f1(volume_residual<P, K::stress>));
    c.jacobian("overstress", displacement, displacement, g3(volume_jacobian<P, K::stress_by_displacement>));
    parameters_.by_pressure = constants::to_scalar(facts.stress_by_pressure);
    if (facts.airflow && facts.stress_by_pressure)
      c.jacobian("overstress", displacement, pressure, g2(volume_jacobian<P, K::stress_by_pressure>));
    c.energy(Energy::dissipated, "viscous_tissue", "", energy_density<P, K::work>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  bool on_ = false;
  std::size_t branches_ = 3;
  mutable ViscoelasticKernels::Parameters parameters_{0, {0.2, 0.2, 0.2}, {0.1, 1, 10}, 0, 0, 0};
};

} // namespace pulmo
