/// @file
/// Permeability laws of the airflow effect: k in mm^2/(kPa s), spatially isotropic (k = kappa / eta), so that the flux
/// in the deformed lung is q = -k grad p and the pull-back Q = k J F^-1 F^-T (-Grad p).
///
/// A law is one header in pulmo/physics/permeability/: a struct with
///
///   static constexpr const char *name, *about;             option value; formula and publication
///   struct Parameters { static constexpr const char *owner = "permeability"; PetscScalar ...; };
///   static PetscErrorCode declare(Options &, Parameters &);
///   static PermeabilityValue permeability(PetscScalar J, const Parameters &);
///
/// and one line in src/physics/registry.cpp. A law of the porosity has, in place of the last,
///
///   static PermeabilityValue permeability(PetscScalar J, const Parameters &, const Porosity &);
///
/// It is never asked where no air is left, J - 1 + Phi0 <= 0: such states are refused.
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/point.hpp"
#include "pulmo/physics/porosity.hpp"

#include <memory>

namespace pulmo {

/// k and its derivative by J.
struct PermeabilityValue {
  PetscScalar k;     ///< mm^2/(kPa s)
  PetscScalar dk_dJ; ///< mm^2/(kPa s)
};

/// Declares -airflow_permeability: k at J = 1, of every law here.
static inline PetscErrorCode declare_permeability(Options &options, PetscScalar &k)
{
  PetscFunctionBeginUser;
  PetscCall(options.real("permeability", "mm^2/(kPa s)", Range::positive(), "permeability over viscosity at rest", k));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether a law depends on the porosity.
template <class Law, class = void>
constexpr bool reads_porosity = false;
template <class Law>
constexpr bool reads_porosity<
    Law, std::void_t<decltype(Law::permeability(1., std::declval<const typename Law::Parameters &>(), Porosity{}))>> =
    true;

/// What the kernels of a law read.
template <class Law>
using PermeabilityParameters =
    std::conditional_t<reads_porosity<Law>, Both<typename Law::Parameters, Porosity>, typename Law::Parameters>;

template <class Law>
PermeabilityValue permeability_of(PetscScalar J, const PermeabilityParameters<Law> &p)
{
  if constexpr (reads_porosity<Law>)
    return Law::permeability(J, p.own, p.other);
  else
    return Law::permeability(J, p);
}

/// A force on the gas, kPa per mm of the deformed lung, beside -grad p. An effect that brings one adds the terms of
/// GasForceCallbacks; airflow knows of none.
struct GasForce {
  static constexpr const char *owner = "gas_force";
  PetscScalar value[3] = {0, 0, 0}; ///< a dead load: Step::load counts
};

/// What a force on the gas adds to the flux of a permeability law.
struct GasForceCallbacks {
  Callback<PetscPointFunc> flux;                ///< f1 of the mass row
  Callback<PetscPointJac> flux_by_displacement; ///< g3 of (mass, displacement)
  Callback<EnergyDensity> work;                 ///< of the force on the flux, kPa in a step
  Callback<EnergyDensity> heat;                 ///< by which the heat of the flow differs from that of -grad p alone
};

/// A law's kernels for those of other effects (DarcyKernels), with all parameters in Point::constants; they add to what
/// they are given.
struct FluxFunctions {
  using Function = void (*)(const Point &, PetscScalar to[]);
  using Energy = PetscScalar (*)(const Point &);
  Function flux, flux_by_displacement, flux_by_pressure;
  Energy dissipation;
  Function force_flux, force_flux_by_displacement; ///< of GasForce
  Energy force_work, force_heat;
};

/// The flux kernels of airflow with permeability law @p Law; see effects/airflow.hpp.
template <class Law>
struct DarcyKernels;

/// A permeability law chosen at run time.
class PermeabilityLaw {
public:
  virtual ~PermeabilityLaw() = default;
  virtual const char *name() const = 0;
  virtual const char *about() const = 0;
  virtual bool needs_air() const = 0; ///< it is a law of the porosity, which must be positive
  virtual PetscErrorCode declare(Options &options) = 0;
  virtual const PetscScalar *parameters(PetscInt *count) const = 0;
  /// k at J = 1 with the parameters among @p constants (Model::constants_at), mm^2/(kPa s).
  virtual PetscReal at_rest(const PetscScalar constants[]) const = 0;
  virtual Callback<PetscPointFunc> flux_callback() const = 0;
  virtual Callback<PetscPointJac> flux_by_displacement_callback() const = 0;
  virtual Callback<PetscPointJac> flux_by_pressure_callback() const = 0;
  virtual Callback<EnergyDensity> dissipation_callback() const = 0;
  virtual GasForceCallbacks gas_force_callbacks() const = 0;
  virtual FluxFunctions functions() const = 0;
};

template <class Law>
class PermeabilityLawOf final : public PermeabilityLaw {
public:
  using Kernels = DarcyKernels<Law>;
  using Parameters = PermeabilityParameters<Law>;

  const char *name() const override { return Law::name; }
  const char *about() const override { return Law::about; }
  bool needs_air() const override { return reads_porosity<Law>; }
  PetscErrorCode declare(Options &options) override { return Law::declare(options, parameters_); }
  const PetscScalar *parameters(PetscInt *count) const override
  {
    *count = sizeof(parameters_) / sizeof(PetscScalar);
    return reinterpret_cast<const PetscScalar *>(&parameters_);
  }
  PetscReal at_rest(const PetscScalar constants[]) const override
  {
    return permeability_of<Law>(1, constants::get<Parameters>(constants)).k;
  }
  Callback<PetscPointFunc> flux_callback() const override { return volume_residual<Parameters, Kernels::flux>; }
  Callback<PetscPointJac> flux_by_displacement_callback() const override
  {
    return volume_jacobian<Parameters, Kernels::flux_by_displacement>;
  }
  Callback<PetscPointJac> flux_by_pressure_callback() const override
  {
    return volume_jacobian<Parameters, Kernels::flux_by_pressure>;
  }
  Callback<EnergyDensity> dissipation_callback() const override
  {
    return energy_density<Parameters, Kernels::dissipation>;
  }
  GasForceCallbacks gas_force_callbacks() const override
  {
    using P = Both<Parameters, GasForce>;
    return {volume_residual<P, Kernels::force_flux>, volume_jacobian<P, Kernels::force_flux_by_displacement>,
            energy_density<P, Kernels::force_work>, energy_density<P, Kernels::force_heat>};
  }
  FluxFunctions functions() const override
  {
    using P = Both<Parameters, GasForce>;
    return {function<Parameters, Kernels::flux>,
            function<Parameters, Kernels::flux_by_displacement>,
            function<Parameters, Kernels::flux_by_pressure>,
            energy<Parameters, Kernels::dissipation>,
            function<P, Kernels::force_flux>,
            function<P, Kernels::force_flux_by_displacement>,
            energy<P, Kernels::force_work>,
            energy<P, Kernels::force_heat>};
  }

private:
  template <class P, Kernel<P> K>
  static void function(const Point &point, PetscScalar to[])
  {
    K(point, constants::get<P>(point.constants), to);
  }
  template <class P, EnergyKernel<P> K>
  static PetscScalar energy(const Point &point)
  {
    return K(point, point, constants::get<P>(point.constants));
  }

  typename Law::Parameters parameters_;
};

} // namespace pulmo
