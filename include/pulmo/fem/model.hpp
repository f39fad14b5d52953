/// @file
/// The discrete model: fields, PetscDS, sections and constraints of a scene, residual and Jacobian.
#pragma once

#include "pulmo/fem/airway_nodes.hpp"
#include "pulmo/fem/assembly.hpp"
#include "pulmo/physics/effect.hpp"

#include <array>

namespace pulmo {

/// The equations of a scene on its mesh.
///
/// Residual rows are made dimensionless: momentum by (modulus x length^2), mass by (length^3 slope), with the
/// tissue's bulk modulus at F = I and the mean cell size. Tolerances then mean the same for a mouse and a man, and
/// neither field hides behind the other in the norm.
class Model {
public:
  Model();
  ~Model();
  /// Declares -quadrature_degree; its default and least value are those of @p elements.
  PetscErrorCode declare(Options &options, const Elements &elements);
  /// The rule of @p other, in place of declare().
  void integrate_as(const Model &other) { quadrature_degree_ = other.quadrature_degree_; }
  /// A rule of degree @p degree, in place of declare().
  void integrate_to(PetscInt degree) { quadrature_degree_ = degree; }
  PetscInt quadrature_degree() const { return quadrature_degree_; }
  /// @p modulus: tissue stiffness that scales the equations, kPa. The composition's effects must outlive the model.
  PetscErrorCode build(Composition composition, PetscReal modulus);

  DM dm() const { return dm_; }
  const Composition &composition() const { return *composition_; }
  const Assembly &assembly() const { return assembly_; }
  bool own_integration() const { return own_; }

  /// Tells the kernels the stage at hand, the pressure held at the airway (kPa) and the flow into the lung that is
  /// prescribed while none is held (mm^3/s). A slope of 0 leaves the rate of J out.
  PetscErrorCode set_step(const Stage &stage, PetscReal airway_pressure, PetscReal airway_flow = 0);
  /// Share of the dead loads that is there from the next set_step() on.
  void set_load(PetscReal load) { step_.load = load; }
  PetscReal load() const { return step_.load; }
  const Step &step() const { return step_; }
  /// The nodes on the surfaces open to the ventilator. Held nodes keep their rows.
  AirwayNodes &airway() { return airway_; }
  const AirwayNodes &airway() const { return airway_; }

  /// Writes the prescribed values of time @p t into a local vector; with @p rate also (value - @p before) / dt.
  PetscErrorCode constrain(PetscReal t, Vec local) const;
  PetscErrorCode constrain_rate(Vec local, Vec before, PetscReal dt, Vec rate) const;

  /// Local residual, rows scaled. @p x and @p x_t are local vectors with constrained values in place. Rows of held
  /// nodes hold the flux that enters there.
  PetscErrorCode residual(PetscReal t, Vec x, Vec x_t, Vec F);
  /// That residual, or the share of the facets in it, times each of the local vectors @p weights, cell by cell
  /// (Assembly::weighted_residual).
  PetscErrorCode weighted_residual(bool facets, PetscReal t, Vec x, Vec x_t, const std::vector<Vec> &weights,
                                   std::vector<std::vector<PetscReal>> &sums)
  {
    return assembly_.weighted_residual(facets ? Assembly::Part::facets : Assembly::Part::all, t, x, x_t,
                                       row_scale_.data(), weights, sums);
  }
  /// Sums of a global residual over the nodes, by field and in its units: kPa mm^2; mm^3/s.
  struct ResidualSums {
    std::vector<PetscReal> absolute, net;
  };
  PetscErrorCode residual_sums(Vec F, ResidualSums &sums) const;
  /// Sums of the absolute loads on the nodes. @p force, kPa mm^2: the forces at F = I under the pressure of @p local (a
  /// local vector), and those that supports bear in the local residual @p F. @p gas, mm^3/s: sources at rest, and what
  /// flows through nodes of a prescribed pressure other than the airway's. The step must have been set.
  PetscErrorCode loads(PetscReal t, Vec local, Vec F, PetscReal &force, PetscReal &gas);
  /// A matrix for jacobian(), of type -dm_mat_type.
  PetscErrorCode create_matrix(Mat *A) const;
  /// Global Jacobian dF/dx + shift dF/dx_t, rows scaled.
  PetscErrorCode jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A);

  /// The transpose of that Jacobian with the rows and columns of the airway's nodes as they are:
  /// AirwayNodes::close_rows() closes them. Needs pulmo's own integration.
  PetscErrorCode transposed_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A);
  /// Adds that transpose times @p z to @p y, without a matrix; local vectors, what is held included.
  PetscErrorCode add_transposed_product(PetscReal t, Vec x, Vec x_t, PetscReal shift, Vec z, Vec y)
  {
    return assembly_.add_transposed_product(t, x, x_t, shift, row_scale_.data(), z, y);
  }

  /// The element matrices of that Jacobian (Assembly::cell_matrices).
  PetscErrorCode cell_matrices(PetscReal t, Vec x, Vec x_t, PetscReal shift, const Assembly::TakeMatrix &take)
  {
    return assembly_.cell_matrices(t, x, x_t, shift, take);
  }

  /// Global numbers of the rows of a field.
  IS field_rows(FieldIndex field) const { return field_rows_[field]; }

  /// Lets each Jacobian hand its element matrices to @p matrices, too, which must outlive the model.
  void also_fill(CellMatrices &matrices) { also_.push_back(&matrices); }

  PetscErrorCode measure(Vec x, Measures &measures) const { return assembly_.measure(x, measures); }
  PetscErrorCode largest_J_change(Vec x, Vec y, PetscReal &change) const
  {
    return assembly_.largest_J_change(x, y, change);
  }
  PetscErrorCode largest_pressure_change(Vec x, Vec y, PetscReal &change) const
  {
    return assembly_.largest_pressure_change(x, y, change);
  }
  /// d(int (J - 1))/dx in direction @p y, mm^3 (local vectors).
  PetscErrorCode volume_derivative(Vec x, Vec y, PetscReal &derivative) const
  {
    return assembly_.volume_derivative(x, y, derivative);
  }
  /// Adds @p factor times the derivative of int (J - 1) q by the displacements to @p y (Assembly::add_volume_gradient).
  PetscErrorCode add_volume_gradient(Vec x, Vec weight, PetscReal factor, Vec y,
                                     const std::vector<PetscInt> *cells = nullptr)
  {
    return assembly_.add_volume_gradient(x, weight, factor, y, cells);
  }
  /// int (J - 1) q cell by cell (Assembly::weighted_volume).
  PetscErrorCode weighted_volume(Vec x, const std::vector<Vec> &weights, std::vector<std::vector<PetscReal>> &sums)
  {
    return assembly_.weighted_volume(x, weights, sums);
  }
  /// Force that each of the composition's constraints bears (a pin, a held surface), from a local residual, kPa mm^2:
  /// the sum of its displacement rows.
  PetscErrorCode reactions(Vec F, std::vector<std::array<PetscReal, 3>> &forces) const;

  /// What kernels are told in a cell (of this rank, counted from 0), or on a facet of @p surface with that cell behind
  /// it, since the last set_step(); good until the next call.
  const PetscScalar *constants_at(PetscInt cell, const std::string &surface = "") const;

  /// What effects remember at the points; null if none does.
  PointMemory *memory() const { return memory_.get(); }

  /// Adds @p change, everywhere, to what kernels are told at places @p places of their constants
  /// (Composition::constant_at), and to what follows from that; 0 ends it. Where parameters differ from place to place
  /// nothing may follow from them. set_step() comes next.
  void change_parameter(const std::vector<PetscInt> &places, PetscReal change);

  PetscReal row_scale(PetscInt field) const { return row_scale_[field]; }
  PetscReal modulus() const { return modulus_; } ///< tissue stiffness that scales the equations, kPa

private:
  struct Prescribed {
    PetscInt dof;            ///< offset in the local vector
    std::int16_t constraint; ///< which of the composition
    std::int16_t component;
    PetscReal x[3]; ///< mm
  };

  /// Which of the composition's constraints holds what at each mesh point; -1: none does.
  struct Holders {
    std::array<std::vector<PetscInt>, 3> displacement; ///< by component
    std::vector<PetscInt> pressure, airway;            ///< prescribed; steered by the ventilator
    std::array<std::vector<PetscInt> *, 5> all()
    {
      return {&displacement[0], &displacement[1], &displacement[2], &pressure, &airway};
    }
  };

  PetscErrorCode create_fields();
  PetscErrorCode create_weak_form();
  PetscErrorCode create_section();
  PetscErrorCode add_symmetries(PetscSection section) const;
  PetscErrorCode find_holders(Holders &holders);
  PetscErrorCode find_airway(const Holders &holders);
  PetscErrorCode pack_constants();
  PetscErrorCode add_volume_terms(PetscDS ds) const;
  /// PETSc's own loops over cells: constants are the same everywhere there.
  bool stock_loops() const { return !own_ && !composition().varying() && !memory_; }
  PetscErrorCode create_stock();
  PetscErrorCode stock_residual(PetscReal t, Vec x, Vec x_t, Vec F);
  PetscErrorCode stock_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A);

  std::unique_ptr<Composition> composition_;
  const Mesh *mesh_ = nullptr;
  DMHandle dm_, stock_dm_, rate_dm_;
  VecHandle rate_, scale_;
  std::vector<Prescribed> prescribed_;
  std::vector<PetscScalar> constants_;
  mutable std::vector<PetscScalar> local_constants_; ///< of constants_at()
  AirwayNodes airway_;
  bool closes_rows_ = false;         ///< the airway has rows that say nothing of a field while it is held
  std::vector<ISHandle> field_rows_; ///< global rows of each field that this rank owns
  Step step_;
  struct {
    std::vector<PetscInt> places;
    PetscReal by = 0;
  } change_; ///< of a parameter
  PetscReal modulus_ = 1;
  std::vector<PetscReal> row_scale_;
  PetscInt quadrature_degree_ = 3;
  bool own_ = true;
  Assembly assembly_;
  std::vector<CellMatrices *> also_;
  std::unique_ptr<PointMemory> memory_;
};

} // namespace pulmo
