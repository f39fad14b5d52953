/// @file
/// Permeability laws of the airflow effect: k(J) in mm^2/(kPa s), spatially isotropic (k = kappa / eta).
///
/// A law is a struct with `name`, `Parameters` (owner "permeability"), `declare` and
/// `Value permeability(J, Parameters)`, and one line in src/physics/registry.cpp.
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/physics/point.hpp"

namespace pulmo {

/// k and its derivative by J.
struct PermeabilityValue {
  PetscScalar k;     ///< mm^2/(kPa s)
  PetscScalar dk_dJ; ///< mm^2/(kPa s)
};

/// k constant in the deformed configuration (the paper's choice).
struct ConstantPermeability {
  static constexpr const char *name = "constant";

  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 1e4; ///< mm^2/(kPa s)
  };

  static PetscErrorCode declare(Options &options, Parameters &p)
  {
    PetscFunctionBeginUser;
    PetscCall(options.real("permeability", "mm^2/(kPa s)", Range::positive(), "permeability over viscosity", p.k));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  static PermeabilityValue permeability(PetscScalar, const Parameters &p) { return {p.k, 0}; }
};

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

/// The flux kernels of airflow with permeability law @p Law; see effects/airflow.hpp.
template <class Law>
struct DarcyKernels;

/// A permeability law chosen at run time.
class PermeabilityLaw {
public:
  virtual ~PermeabilityLaw() = default;
  virtual const char *name() const = 0;
  virtual PetscErrorCode declare(Options &options) = 0;
  virtual const PetscScalar *parameters(PetscInt *count) const = 0;
  virtual PetscReal at_rest() const = 0; ///< k at J = 1, mm^2/(kPa s)
  virtual Callback<PetscPointFunc> flux_callback() const = 0;
  virtual Callback<PetscPointJac> flux_by_displacement_callback() const = 0;
  virtual Callback<PetscPointJac> flux_by_pressure_callback() const = 0;
  virtual Callback<EnergyDensity> dissipation_callback() const = 0;
  virtual GasForceCallbacks gas_force_callbacks() const = 0;
};

template <class Law>
class PermeabilityLawOf final : public PermeabilityLaw {
public:
  using Kernels = DarcyKernels<Law>;
  using Parameters = typename Law::Parameters;

  const char *name() const override { return Law::name; }
  PetscErrorCode declare(Options &options) override { return Law::declare(options, parameters_); }
  const PetscScalar *parameters(PetscInt *count) const override
  {
    *count = sizeof(Parameters) / sizeof(PetscScalar);
    return reinterpret_cast<const PetscScalar *>(&parameters_);
  }
  PetscReal at_rest() const override { return Law::permeability(1, parameters_).k; }
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

private:
  Parameters parameters_;
};

} // namespace pulmo
