/// @file
/// The discrete model: fields, PetscDS, sections and constraints of a scene, residual and Jacobian.
#pragma once

#include "pulmo/assembly.hpp"
#include "pulmo/effect.hpp"

#include <array>

namespace pulmo {

/// The equations of a scene on its mesh.
///
/// Residual rows are made dimensionless: momentum by (modulus x length^2), mass by (length^3 / dt), with the
/// tissue's bulk modulus at F = I and the mean cell size. Tolerances then mean the same for a mouse and a man, and
/// neither field hides behind the other in the norm.
class Model {
public:
  /// Declares -quadrature_degree.
  PetscErrorCode declare(Options &options);
  /// @p modulus: tissue stiffness that scales the equations, kPa. The composition's effects must outlive the model.
  PetscErrorCode build(Composition composition, PetscReal modulus);

  DM dm() const { return dm_; }
  const Composition &composition() const { return *composition_; }
  const Assembly &assembly() const { return assembly_; }
  bool own_integration() const { return own_; }

  /// Tells the kernels the step that ends at @p t: its size (s) and the airway pressure (kPa).
  PetscErrorCode set_step(PetscReal dt, PetscReal airway_pressure);

  /// Writes the prescribed values of time @p t into a local vector; with @p rate also (value - @p before) / dt.
  PetscErrorCode constrain(PetscReal t, Vec local) const;
  PetscErrorCode constrain_rate(Vec local, Vec before, PetscReal dt, Vec rate) const;

  /// Local residual, rows scaled. @p x and @p x_t are local vectors with constrained values in place.
  PetscErrorCode residual(PetscReal t, Vec x, Vec x_t, Vec F);
  /// Global Jacobian dF/dx + shift dF/dx_t, rows scaled.
  PetscErrorCode jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A);
  PetscErrorCode measure(Vec x, Measures &measures) const { return assembly_.measure(x, measures); }
  /// Flow into the lung, mm^3/s: the consistent flux, from a local residual. Where p is prescribed the mass residual
  /// is - int Q.N q; summed over the nodes where the lung is open it is exactly the rate of int (J - 1).
  PetscErrorCode airway_flow(Vec F, PetscReal &flow) const;
  /// Force that each of the composition's constraints bears (a pin, a held surface), from a local residual, kPa mm^2:
  /// the sum of its displacement rows.
  PetscErrorCode reactions(Vec F, std::vector<std::array<PetscReal, 3>> &forces) const;

  PetscReal row_scale(PetscInt field) const { return row_scale_[field]; }

private:
  struct Prescribed {
    PetscInt dof;            ///< offset in the local vector
    std::int16_t constraint; ///< which of the composition
    std::int16_t component;
    PetscReal x[3]; ///< mm
  };

  PetscErrorCode create_fields();
  PetscErrorCode create_weak_form();
  PetscErrorCode create_section();
  PetscErrorCode find_constraints(std::vector<PetscInt> &constraint_of);
  PetscErrorCode pack_constants();
  PetscErrorCode add_volume_terms(PetscDS ds) const;
  PetscErrorCode create_stock();
  PetscErrorCode stock_residual(PetscReal t, Vec x, Vec x_t, Vec F);
  PetscErrorCode stock_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A);

  std::unique_ptr<Composition> composition_;
  const Mesh *mesh_ = nullptr;
  DMHandle dm_, stock_dm_, rate_dm_;
  VecHandle rate_, scale_;
  std::vector<Prescribed> prescribed_;
  std::vector<PetscScalar> constants_;
  Step step_{1, 0};
  PetscReal modulus_ = 1;
  std::vector<PetscReal> row_scale_;
  PetscInt quadrature_degree_ = 3;
  bool own_ = true;
  Assembly assembly_;
};

} // namespace pulmo
