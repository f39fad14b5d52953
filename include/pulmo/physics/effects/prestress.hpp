/// @file
/// Effect `prestress`: the mesh is a lung under a transpulmonary pressure p_tp, as it was imaged, and not one at rest.
///
/// The tissue is that of a smaller lung, inflated by J0 the same way in all directions: its law is that of F F0,
/// F0 = J0^(1/3) I, and J0 is what p_tp makes of a free piece of it, W'(J0) = p_tp. What held the lung in that shape
/// goes on to pull on its whole boundary as a follower, t = p_tp J F^-T N: a pleural pressure of -p_tp. As
/// Div cof F = 0 this is, inside the lung,
///   P = (dW/dF)(F F0) F0^T / J0 - p_tp cof F,
/// which is zero at u = 0 in every point of any mesh. Porosity, permeability and springs are those of the mesh.
///
/// A uniform stretch bears no weight, and where parts of the lung differ the parts do not fit. -prestress_method
/// inverse looks for the shape of the unloaded lung (after Govindjee & Mihalic 1996; Patte, Genet & Chapelle 2022):
/// where the tissue at x of the mesh goes once it is unloaded, x + U(x). With f = I + Grad U and F0 = f^-1 in each
/// point
///   int sigma(F0) : grad eta = loads of the mesh,   sigma(F) = (dW/dF)(F) F^T / det F.
/// The pleura carries the weight, too: its pressure rises along gravity by the mean weight per volume, as in a fluid,
/// so that t = pi(X) cof F N with pi = p_tp + g . (X - c), g of each body less its mean weight and c its centre. Inside
/// the lung this is
///   - int pi cof F : Grad eta - int cof F g . eta.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/law_range.hpp"

#include <algorithm>
#include <limits>

namespace pulmo {

struct PrestressKernels {
  struct Parameters {
    static constexpr const char *owner = "prestress";
    PetscScalar pressure = 0; ///< p_tp, kPa
    PetscScalar stretch = 1;  ///< J0^(1/3)
  };

  static void stress_free(const Point &, const PetscScalar constants[], When, PetscScalar G[9])
  {
    const auto k = constants::get<Parameters>(constants);
    for (int i = 0; i < 9; ++i) G[i] *= k.stretch;
  }

  /// f1 = -p_tp cof F.
  static void follower(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    for (int i = 0; i < 9; ++i) f1[i] -= k.pressure * point.state.cof_F[i];
  }
  static void follower_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    add_cofactor_derivative(point.state.F, -k.pressure, g3);
  }
  /// Work of the pleural pressure in a step: p_tp dJ, kPa.
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    return k.pressure * (now.state.J_minus_1 - before.state.J_minus_1);
  }
  /// The momentum balance has cof F : dF instead of dJ.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar D[9];
    for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
    return k.pressure * volume_beyond_linear(now.state.F, D);
  }
};

/// The reaction of the pleura that carries the weight, and the problem of the unloaded shape.
struct UnloadingKernels {
  /// What the state that was found is remembered under, and all that the problem needs.
  struct Parameters {
    static constexpr const char *owner = "unloading";
    static constexpr bool given_at_start = true;
    PetscScalar pressure = 0;            ///< p_tp, kPa
    PetscScalar stress = 0, tangent = 0; ///< LawFunctions, as constants::to_scalar() packs them
    PetscScalar mass = 0;                ///< GravityFacts::mass, packed; 0: no weight
    PetscScalar force[3] = {0, 0, 0};    ///< weight of 1 kg/m^3, kPa/mm
    PetscScalar lifted = 0;              ///< density that gas at rest carries, kg/m^3
  };

  static void stress_free(const Point &point, const PetscScalar constants[], When, PetscScalar G[9])
  {
    const Memory own = point.as_seen_by<Parameters>(constants).memory;
    if (!own.last) return;
    PetscScalar product[9];
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        product[3 * i + J] = G[3 * i] * own.last[J] + G[3 * i + 1] * own.last[3 + J] + G[3 * i + 2] * own.last[6 + J];
    std::copy_n(product, 9, G);
  }
  /// All of it stays as it is.
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    const Unloading::AtPoint start(k.pressure);
    std::copy_n(point.memory.last ? point.memory.last : start.data(), Unloading::AtPoint::count, value);
  }

  /// pi, kPa.
  static PetscScalar pleural(const Point &point, const Parameters &k)
  {
    return point.memory.last ? point.memory.last[Unloading::AtPoint::pleural] : k.pressure;
  }
  /// g, kPa/mm.
  static PetscScalar gradient(const Point &point, int d)
  {
    return point.memory.last ? point.memory.last[Unloading::AtPoint::gradient + d] : 0;
  }
  /// cof F g, kPa/mm.
  static void pull(const Point &point, PetscScalar to[3])
  {
    for (int i = 0; i < 3; ++i) {
      to[i] = 0;
      for (int J = 0; J < 3; ++J) to[i] += point.state.cof_F[3 * i + J] * gradient(point, J);
    }
  }
  static void follower(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const PetscScalar pi = pleural(point, k);
    for (int i = 0; i < 9; ++i) f1[i] -= pi * point.state.cof_F[i];
  }
  static void follower_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    add_cofactor_derivative(point.state.F, -pleural(point, k), g3);
  }
  static void pulling(const Point &point, const Parameters &, PetscScalar f0[])
  {
    PetscScalar force[3];
    pull(point, force);
    for (int i = 0; i < 3; ++i) f0[i] -= force[i];
  }
  static void pulling_by_displacement(const Point &point, const Parameters &, PetscScalar g1[])
  {
    PetscScalar D[81] = {0};
    add_cofactor_derivative(point.state.F, 1, D);
    for (int ik = 0; ik < 9; ++ik)
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L) g1[3 * ik + L] -= D[9 * ik + 3 * J + L] * gradient(point, J);
  }
  /// Work of the pleural pressure in a step, kPa: pi dJ + cof F g . du.
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar force[3], sum = pleural(now, k) * (now.state.J_minus_1 - before.state.J_minus_1);
    pull(now, force);
    for (int i = 0; i < 3; ++i) sum += force[i] * (now.u[i] - before.u[i]);
    return sum;
  }
  /// The momentum balance has cof F : dF instead of dJ.
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar D[9];
    for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
    return pleural(now, k) * volume_beyond_linear(now.state.F, D);
  }

  // the unloaded shape; F of these points is f
  /// F0 = f^-1 as a state of the tissue, and sigma.
  struct Unloaded {
    PointState felt;
    PetscScalar sigma[9] = {0};

    Unloaded(const Point &point, const Parameters &k)
    {
      PetscScalar H[9], P[9] = {0};
      for (int i = 0; i < 3; ++i)
        for (int J = 0; J < 3; ++J) H[3 * i + J] = point.state.cof_F[3 * J + i] / point.state.J - (i == J);
      make_point_state(H, nullptr, felt);
      Point tissue = bare_point(felt);
      tissue.constants = point.constants;
      constants::to_pointer<LawFunctions::Stress>(k.stress)(tissue, P);
      for (int i = 0; i < 3; ++i)
        for (int J = 0; J < 3; ++J) sigma[3 * i + J] = row_product(P + 3 * i, felt.F + 3 * J) / felt.J;
    }
  };
  static PetscScalar row_product(const PetscScalar a[3], const PetscScalar b[3])
  {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  }
  /// Weight that the tissue carries in the shape of the mesh, kPa/mm.
  static void weight(const PetscScalar constants[], const Parameters &k, PetscScalar to[3])
  {
    const PetscScalar zero[9] = {0};
    PetscScalar density = 0;
    if (k.mass != 0) {
      PointState mesh;
      make_point_state(zero, nullptr, mesh);
      const Point point = bare_point(mesh);
      density = constants::to_pointer<EnergyDensity>(k.mass)(point, point, constants) - k.lifted;
    }
    for (int d = 0; d < 3; ++d) to[d] = density * k.force[d];
  }
  static void unloaded_stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    const Unloaded tissue(point, k);
    const PetscScalar pi = point.step.load * pleural(point, k);
    for (int i = 0; i < 9; ++i) f1[i] += tissue.sigma[i] - (i % 4 == 0 ? pi : 0);
  }
  static void unloaded_weight(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    PetscScalar w[3];
    weight(point.constants, k, w);
    for (int d = 0; d < 3; ++d) f0[d] -= point.step.load * (w[d] + gradient(point, d));
  }
  /// d sigma/d f with dF0 = -F0 df F0: stored [i][k][J][L], kPa.
  static void unloaded_tangent(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    const Unloaded tissue(point, k);
    const PetscScalar *F = tissue.felt.F;
    PetscScalar A[81] = {0}, P[9] = {0}, pulled[81]; // pulled: [i][J][k][N] = A_iMkN F_JM
    Point of_tissue = bare_point(tissue.felt);
    of_tissue.constants = point.constants;
    constants::to_pointer<LawFunctions::Tangent>(k.tangent)(of_tissue, A);
    constants::to_pointer<LawFunctions::Stress>(k.stress)(of_tissue, P);
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        for (int m = 0; m < 3; ++m)
          for (int N = 0; N < 3; ++N) {
            PetscScalar sum = 0;
            for (int M = 0; M < 3; ++M) sum += A[27 * i + 9 * m + 3 * M + N] * F[3 * J + M];
            // sigma_iJ also holds P_iM F_JM
            pulled[27 * i + 9 * J + 3 * m + N] = sum + (m == J ? P[3 * i + N] : 0);
          }
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) {
            PetscScalar sum = 0;
            for (int m = 0; m < 3; ++m)
              for (int N = 0; N < 3; ++N) sum += pulled[27 * i + 9 * J + 3 * m + N] * F[3 * m + a] * F[3 * b + N];
            g3[27 * i + 9 * a + 3 * J + b] += tissue.sigma[3 * i + J] * F[3 * b + a] - sum / tissue.felt.J;
          }
  }
};

class Prestress final : public Effect {
public:
  const char *name() const override { return "prestress"; }
  const char *about() const override { return "the mesh is a lung under transpulmonary pressure"; }
  const char *absence() const override { return "the mesh is taken for a lung at rest, under no pressure"; }
  std::string example() const override { return "-prestress -prestress_pressure 2"; }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the mesh is a lung under pressure, not one at rest", on_));
    options.group(name(), about(), on_, "-prestress");
    PetscCall(options.real("pressure", "cmH2O", Range::any(),
                           "transpulmonary pressure (alveolar less pleural) in the shape of the mesh; pressures of the "
                           "run are counted from the alveolar pressure of that shape",
                           pressure_));
    PetscCall(options.choice("method", {"stretch", "inverse"},
                             "how the unloaded lung is found: a uniform stretch; or solved for, so that the lung is in "
                             "equilibrium with its weight and its parts fit",
                             method_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    const PetscReal pressure = pressure_ * units::kPa_per_cmH2O;
    if (method_ == "inverse") {
      unloading_ = std::make_shared<Unloading>();
      facts.stress_free.push_back(UnloadingKernels::stress_free);
      facts.prestress = PrestressFacts{pressure, nullptr, unloading_};
      return PETSC_SUCCESS;
    }
    facts.stress_free.push_back(PrestressKernels::stress_free);
    facts.prestress = PrestressFacts{pressure,
                                     [](const PetscScalar constants[]) {
                                       const auto k = constants::get<PrestressKernels::Parameters>(constants);
                                       return 1 / (k.stretch * k.stretch * k.stretch);
                                     },
                                     nullptr};
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &, const SceneFacts &facts) override
  {
    LawRange::State end;

    PetscFunctionBeginUser;
    parameters_.pressure = facts.prestress->pressure;
    const auto inflated = inflated_J(*facts.law, parameters_.pressure, nullptr, &end);
    const bool by_part = std::any_of(options.varying().begin(), options.varying().end(),
                                     [](const auto &v) { return v.option.rfind("-tissue_", 0) == 0; });
    // where the law differs from part to part each of them is held to its own: terms(), solve_unloaded_shape()
    PulmoUserCheck(inflated || by_part, options.comm(),
                   "-prestress_pressure %g cmH2O: -tissue %s with these parameters takes no more than %.3g cmH2O from "
                   "rest by uniform inflation; give a pressure below that, another law, or other parameters",
                   (double)pressure_, facts.law->name(), (double)(end.pressure / units::kPa_per_cmH2O));
    parameters_.stretch = std::cbrt(inflated.value_or(1));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = PrestressKernels;
    using P = K::Parameters;
    const TissueLaw &law = *facts.law;

    PetscFunctionBeginUser;
    if (unloading_) {
      inverse_terms(c, facts);
      PetscFunctionReturn(PETSC_SUCCESS);
    }
    c.parameters(parameters_);
    c.derive({&parameters_.stretch,
              [&law](std::vector<PetscScalar> constants) {
                StressFree::forget(constants);
                const auto J0 = inflated_J(law, constants::get<P>(constants.data()).pressure, constants.data());
                return J0 ? std::cbrt(*J0) : std::numeric_limits<PetscScalar>::quiet_NaN();
              },
              "-prestress_pressure: -tissue " + std::string(law.name()) +
                  " with the parameters of some part of the lung does not take that pressure from rest by uniform "
                  "inflation; give a lower pressure, or that part other parameters"});
    c.residual("-p_tp cof F : Grad eta", displacement, f1(volume_residual<P, K::follower>));
    c.jacobian("-p_tp d(cof F)/dF", displacement, displacement, g3(volume_jacobian<P, K::follower_by_displacement>));
    c.energy(Energy::external, "pleural_pressure", "", energy_density<P, K::work>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  /// Terms of the run with the reaction that bears weight, and what the problem of the unloaded shape needs.
  void inverse_terms(Composition &c, const SceneFacts &facts) const
  {
    using K = UnloadingKernels;
    using P = K::Parameters;
    P &k = inverse_;
    const LawFunctions law = facts.law->functions(false);
    k.pressure = unloading_->pressure = parameters_.pressure;
    k.stress = constants::to_scalar(law.stress);
    k.tangent = constants::to_scalar(law.tangent);
    if (facts.gravity) {
      k.mass = constants::to_scalar(facts.gravity->mass.function);
      k.lifted = facts.airflow ? facts.gravity->air_density : 0;
      for (int d = 0; d < 3; ++d) k.force[d] = facts.gravity->force * facts.gravity->down[d];
      unloading_->weight = [&k](const PetscScalar constants[], PetscReal weight[3]) {
        K::weight(constants, k, weight);
      };
    }
    unloading_->terms = [](Composition &problem) {
      problem.residual("sigma - pi I : grad eta", displacement, f1(volume_residual<P, K::unloaded_stress>));
      problem.residual("weight that is not mean", displacement, f0(volume_residual<P, K::unloaded_weight>));
      problem.jacobian("d sigma/d f", displacement, displacement, g3(volume_jacobian<P, K::unloaded_tangent>));
    };
    c.parameters(inverse_);
    c.remember(Unloading::AtPoint::quantities(), remembered<P, K::remember>);
    c.begin_with(unloading_->points);
    c.residual("-pi cof F : Grad eta", displacement, f1(volume_residual<P, K::follower>));
    c.jacobian("-pi d(cof F)/dF", displacement, displacement, g3(volume_jacobian<P, K::follower_by_displacement>));
    c.energy(Energy::external, "pleural_pressure", "", energy_density<P, K::work>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    if (!facts.gravity) return;
    c.residual("-cof F g . eta", displacement, f0(volume_residual<P, K::pulling>));
    c.jacobian("-d(cof F)/dF g", displacement, displacement, g1(volume_jacobian<P, K::pulling_by_displacement>));
  }

  bool on_ = false;
  PetscReal pressure_ = 5;
  std::string method_ = "stretch";
  PrestressKernels::Parameters parameters_;
  std::shared_ptr<Unloading> unloading_;           ///< of method inverse, else null
  mutable UnloadingKernels::Parameters inverse_{}; ///< filled by terms() and by the solution
};

} // namespace pulmo
