/// @file
/// Effect `airflow`: Darcy flow of the alveolar air through the deforming tissue.
///
/// Weak form (Aviles-Rojas & Hurtado 2022, eqs. 33-34, material form), p in kPa:
///   momentum: adds  - int J p F^-T : Grad eta
///   mass:     int dJ/dt q - int Q . Grad q (+ int Q.N q on the boundary: natural condition, no flux) = 0
///   Q = k J F^-1 F^-T (-Grad p)
/// dJ/dt is exactly conservative. Backward Euler: with D = dt Grad u_t, (det F - det(F - D)) / dt, which is
/// (J^n+1 - J^n) / dt, written out so that nothing cancels. With more than one state before (BDF2) the kernel gives the
/// share of the present, slope (J - 1), and TimeScheme adds that of the past.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/numerical_gas_loss.hpp"

namespace pulmo {

/// Terms of the gas that no permeability law changes.
struct AirflowKernels {
  /// f1 of the momentum row: -p J F^-T.
  static void gas_stress(const Point &point, const NoParameters &, PetscScalar f1[])
  {
    for (int i = 0; i < 9; ++i) f1[i] -= point.p * point.state.cof_F[i];
  }
  static void gas_stress_by_displacement(const Point &point, const NoParameters &, PetscScalar g3[])
  {
    add_cofactor_derivative(point.state.F, -point.p, g3);
  }
  static void gas_stress_by_pressure(const Point &point, const NoParameters &, PetscScalar g2[])
  {
    for (int i = 0; i < 9; ++i) g2[i] -= point.state.cof_F[i];
  }

  /// f0 of the mass row: the conservative dJ/dt = cof F : F' - dt F : cof F' + dt^2 det F' with F' = Grad u_t, 1/s.
  static void porosity_rate(const Point &point, const NoParameters &, PetscScalar f0[])
  {
    const PointState &s = point.state;
    const PetscScalar dt = point.step.dt;
    PetscScalar cof_rate[9];
    if (point.step.multistep) {
      f0[0] += point.step.slope * s.J_minus_1;
      return;
    }
    cofactor(s.H_rate, cof_rate);
    f0[0] += contract(s.cof_F, s.H_rate) - dt * contract(s.F, cof_rate) + dt * dt * determinant(s.H_rate);
  }
  static void porosity_rate_by_displacement(const Point &point, const NoParameters &, PetscScalar g1[])
  {
    const PointState &s = point.state;
    const PetscScalar dt = point.step.dt, a = point.shift;
    PetscScalar cof_rate[9], cross[9];
    if (point.step.multistep) {
      for (int i = 0; i < 9; ++i) g1[i] += a * s.cof_F[i];
      return;
    }
    cofactor(s.H_rate, cof_rate);
    tensor_cross(s.F, s.H_rate, cross);
    // d/dF gives cross - dt cof_rate, d/dF' gives cof F - dt cross + dt^2 cof_rate
    for (int i = 0; i < 9; ++i) g1[i] += (1 - a * dt) * (cross[i] - dt * cof_rate[i]) + a * s.cof_F[i];
  }
};

/// Darcy flux with permeability k(J).
template <class Law>
struct DarcyKernels {
  using Parameters = PermeabilityParameters<Law>;

  /// f1 of the mass row: -Q = k/J cof^T cof Grad p, mm/s.
  static void flux(const Point &point, const Parameters &parameters, PetscScalar f1[])
  {
    const PointState &s = point.state;
    const PetscScalar *cof = s.cof_F, *g = point.grad_p;
    const PetscScalar k_J = permeability_of<Law>(s.J, parameters).k / s.J;
    PetscScalar b[3]; // cof Grad p
    for (int i = 0; i < 3; ++i) b[i] = cof[3 * i] * g[0] + cof[3 * i + 1] * g[1] + cof[3 * i + 2] * g[2];
    for (int I = 0; I < 3; ++I) f1[I] += k_J * (cof[I] * b[0] + cof[3 + I] * b[1] + cof[6 + I] * b[2]);
  }
  /// Heat of the flow in a step: dt Q . K^-1 Q = dt k/J |cof Grad p|^2, kPa.
  static PetscScalar dissipation(const Point &point, const Point &, const Parameters &parameters)
  {
    const PetscScalar *g = point.grad_p;
    PetscScalar f1[3] = {0, 0, 0};
    flux(point, parameters, f1);
    return point.step.dt * (f1[0] * g[0] + f1[1] * g[1] + f1[2] * g[2]);
  }
  /// g3 of (mass, pressure): k/J cof^T cof.
  static void flux_by_pressure(const Point &point, const Parameters &parameters, PetscScalar g3[])
  {
    const PointState &s = point.state;
    const PetscScalar *cof = s.cof_F;
    const PetscScalar k_J = permeability_of<Law>(s.J, parameters).k / s.J;
    for (int I = 0; I < 3; ++I)
      for (int L = 0; L < 3; ++L)
        g3[3 * I + L] += k_J * (cof[I] * cof[L] + cof[3 + I] * cof[3 + L] + cof[6 + I] * cof[6 + L]);
  }
  /// g3 of (mass, displacement): d(-Q)_I / dF_kL.
  static void flux_by_displacement(const Point &point, const Parameters &parameters, PetscScalar g3[])
  {
    const PointState &s = point.state;
    const PetscScalar *cof = s.cof_F, *g = point.grad_p;
    const PermeabilityValue v = permeability_of<Law>(s.J, parameters);
    const PetscScalar r = 1 / s.J;
    PetscScalar C_inv[9], a[3], b[3]; // C^-1, C^-1 Grad p, F^-T Grad p
    for (int i = 0; i < 3; ++i) b[i] = r * (cof[3 * i] * g[0] + cof[3 * i + 1] * g[1] + cof[3 * i + 2] * g[2]);
    for (int I = 0; I < 3; ++I) {
      a[I] = r * (cof[I] * b[0] + cof[3 + I] * b[1] + cof[6 + I] * b[2]);
      for (int L = 0; L < 3; ++L)
        C_inv[3 * I + L] = r * r * (cof[I] * cof[L] + cof[3 + I] * cof[3 + L] + cof[6 + I] * cof[6 + L]);
    }
    for (int k = 0; k < 3; ++k)
      for (int I = 0; I < 3; ++I)
        for (int L = 0; L < 3; ++L)
          g3[9 * k + 3 * I + L] += (v.k + s.J * v.dk_dJ) * cof[3 * k + L] * a[I] -
                                   v.k * (cof[3 * k + I] * a[L] + s.J * C_inv[3 * I + L] * b[k]);
  }

  // A force f on the gas: Q = k J F^-1 (f - F^-T Grad p), so it adds -k J F^-1 f = -k cof^T f to f1.

  static void force_flux(const Point &point, const Both<Parameters, GasForce> &p, PetscScalar f1[])
  {
    const PetscScalar *cof = point.state.cof_F, *f = p.other.value;
    const PetscScalar k = point.step.load * permeability_of<Law>(point.state.J, p.own).k;
    for (int I = 0; I < 3; ++I) f1[I] -= k * (cof[I] * f[0] + cof[3 + I] * f[1] + cof[6 + I] * f[2]);
  }
  /// -d(k cof_iI f_i) / dF_kL.
  static void force_flux_by_displacement(const Point &point, const Both<Parameters, GasForce> &p, PetscScalar g3[])
  {
    const PetscScalar *cof = point.state.cof_F, *f = p.other.value, load = point.step.load;
    const PermeabilityValue v = permeability_of<Law>(point.state.J, p.own);
    PetscScalar cof_by_F[81] = {0}; // [i][k][I][L]
    add_cofactor_derivative(point.state.F, load * v.k, cof_by_F);
    for (int k = 0; k < 3; ++k)
      for (int I = 0; I < 3; ++I)
        for (int L = 0; L < 3; ++L)
          for (int i = 0; i < 3; ++i)
            g3[9 * k + 3 * I + L] -=
                (load * v.dk_dJ * cof[3 * k + L] * cof[3 * i + I] + cof_by_F[27 * i + 9 * k + 3 * I + L]) * f[i];
  }
  /// dt Q . F^T f = dt k (J f - cof Grad p) . f.
  static PetscScalar force_work(const Point &point, const Point &, const Both<Parameters, GasForce> &p)
  {
    return force_power(point, p, 1);
  }
  /// Heat of the flow, dt k/J |J f - cof Grad p|^2, less dissipation().
  static PetscScalar force_heat(const Point &point, const Point &, const Both<Parameters, GasForce> &p)
  {
    return force_power(point, p, 2);
  }

private:
  /// dt k (J f - @p share cof Grad p) . f.
  static PetscScalar force_power(const Point &point, const Both<Parameters, GasForce> &p, PetscScalar share)
  {
    const PetscScalar *cof = point.state.cof_F, *g = point.grad_p, J = point.state.J;
    PetscScalar sum = 0;
    for (int i = 0; i < 3; ++i) {
      const PetscScalar f = point.step.load * p.other.value[i];
      sum += f * (J * f - share * (cof[3 * i] * g[0] + cof[3 * i + 1] * g[1] + cof[3 * i + 2] * g[2]));
    }
    return point.step.dt * permeability_of<Law>(J, p.own).k * sum;
  }
};

/// Alveolar pressure field (kPa), its gas stress, mass balance and Darcy flux. Where the lung is open the
/// ventilator holds p or prescribes the flux.
class Airflow final : public Effect {
public:
  explicit Airflow(std::vector<std::unique_ptr<PermeabilityLaw>> laws) : laws_(std::move(laws)) {}

  const char *name() const override { return "airflow"; }
  const char *about() const override { return "Darcy flow of alveolar air (mass balance, pressure field)"; }
  const char *absence() const override { return "the gas has one pressure everywhere: no resistance to its flow"; }
  bool active() const override { return on_; }
  /// Open to the ventilator; without airflow the surfaces that would be.
  const std::vector<std::string> &surfaces() const { return surfaces_; }
  const PermeabilityLaw &permeability() const { return *laws_[chosen_]; }
  /// Heat of the flow in a step, by point: quadratic in Grad p, kPa.
  Callback<EnergyDensity> dissipation() const { return laws_[chosen_]->dissipation_callback(); }

  PetscErrorCode declare(Options &options) override
  {
    std::vector<std::string> names;
    std::string wanted = laws_.front()->name();
    std::size_t chosen = 0;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "air flows through the tissue; off: one uniform gas pressure", on_));
    options.group(name(), about(), on_, "-airflow");
    PetscCall(options.names("surfaces", "surfaces that are open to the ventilator", surfaces_));
    for (const auto &law : laws_) names.emplace_back(law->name());
    PetscCall(options.choice("permeability_law", names, "how permeability follows deformation", wanted));
    while (names[chosen] != wanted) ++chosen;
    chosen_ = chosen;
    for (std::size_t i = 0; i < laws_.size(); ++i) {
      options.group(name(), "permeability law " + names[i] + ", " + laws_[i]->about(), on_ && i == chosen,
                    on_ ? "-airflow_permeability_law " + names[i] : "-airflow");
      PetscCall(laws_[i]->declare(options));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.airflow = true;
    facts.permeability = laws_[chosen_].get();
    facts.porosity = true; // for the numbers: gas at rest, porosity of the fields
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &, const Mesh &mesh, const SceneFacts &) override
  {
    PetscFunctionBeginUser;
    PetscCall(mesh.require_surfaces(surfaces_, "-airflow_surfaces"));
    PetscCall(mesh.require_in_each_body(surfaces_,
                                        "is joined to no facet that -airflow_surfaces names, so that no air gets in; "
                                        "name its opening, or join the bodies or remove this one in gmsh"));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  void fields(Composition &c) const override { c.field("pressure", 1, c.elements().pressure_degree, "kPa"); }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = AirflowKernels;
    using P = NoParameters;
    const PermeabilityLaw &darcy = *laws_[chosen_];
    PetscInt count;

    PetscFunctionBeginUser;
    const PetscScalar *permeability = darcy.parameters(&count);
    c.parameters("permeability", permeability, count);
    if (darcy.needs_air()) c.need_air();
    c.residual("-J p F^-T : Grad eta", displacement, f1(volume_residual<P, K::gas_stress>));
    c.residual("dJ/dt q", pressure, f0(volume_residual<P, K::porosity_rate>));
    c.residual("-Q . Grad q", pressure, f1(darcy.flux_callback()));
    c.jacobian("gas stress", displacement, displacement, g3(volume_jacobian<P, K::gas_stress_by_displacement>));
    c.jacobian("gas stress", displacement, pressure, g2(volume_jacobian<P, K::gas_stress_by_pressure>));
    c.jacobian("porosity rate", pressure, displacement, g1(volume_jacobian<P, K::porosity_rate_by_displacement>));
    c.jacobian("flux", pressure, displacement, g3(darcy.flux_by_displacement_callback()));
    c.jacobian("flux", pressure, pressure, g3(darcy.flux_by_pressure_callback()));
    c.energy(Energy::dissipated, "resistive", "", dissipation());
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, numerical_gas_loss>);
    for (const std::string &surface : surfaces_) {
      Constraint open;
      open.name = "airway pressure";
      open.field = pressure;
      open.component[0] = true;
      open.surface = surface;
      open.at_airway = true;
      c.constrain(open);
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  std::vector<std::unique_ptr<PermeabilityLaw>> laws_;
  std::size_t chosen_ = 0;
  bool on_ = false;
  std::vector<std::string> surfaces_{"airway"};
};

} // namespace pulmo
