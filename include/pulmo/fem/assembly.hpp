/// @file
/// The loop over cells: gathers coefficients in blocks, integrates them through PetscFE, adds the element vectors
/// and matrices. No more than one block of element matrices exists.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/fem/integration.hpp"
#include "pulmo/fem/matrix_map.hpp"
#include "pulmo/fem/tabulation.hpp"
#include "pulmo/physics/kinematics.hpp"

#include <functional>
#include <vector>

namespace pulmo {

/// What a state of the lung measures, over all ranks.
struct Measures {
  PetscReal volume_change = 0;    ///< int (J - 1) over the reference volume, mm^3
  PetscReal min_J = 1, max_J = 1; ///< over quadrature points and cell corners
  PetscReal min_J_points = 1;     ///< over quadrature points only
  PetscReal min_air = 1;          ///< least J - 1 + Phi0, where there must be air (Assembly::need_air); else 1
  PetscReal min_air_points = 1;   ///< over quadrature points only
  PetscReal airless_J = 0;        ///< 1 - Phi0 of that cell, if airless()
  PetscReal where[3] = {0, 0, 0}; ///< material centroid of the cell with min_J, with min_air if airless(), mm
  PetscInt cell = -1;             ///< its number on rank @p rank
  PetscMPIInt rank = 0;

  /// No kernel may see the state, though it is not inside out.
  bool airless() const { return min_J > 0 && !(min_air > 0); }
};

class ParameterFields;
class PointMemory;

/// What an element matrix or vector is the share of.
enum class ElementOf { cell, facet };

/// Takes the element matrices while a Jacobian is assembled.
class CellMatrices {
public:
  virtual ~CellMatrices() = default;
  /// Begins a new Jacobian.
  virtual PetscErrorCode begin() = 0;
  /// Adds cell @p c (counted from 0), or a facet of it, from its element matrix, rows scaled by @p row_scale; what is
  /// assembled is the transposed of that if @p transposed.
  virtual PetscErrorCode add(PetscInt c, ElementOf what, const PetscScalar *matrix, const PetscReal row_scale[],
                             bool transposed) = 0;
  /// Completes it; @p closed: mesh points whose pressure is held. Collective.
  virtual PetscErrorCode end(const std::vector<PetscInt> &closed) = 0;
};

/// Assembly over the cells and named facets of a DM whose fields, PetscDS and sections are complete.
class Assembly {
public:
  /// Cells per block: the element matrices of a block stay in the second-level cache.
  static constexpr PetscInt block_cells = 32;
  /// One block in so many is timed callback by callback.
  static constexpr PetscInt timed_share = 16;

  Assembly() = default;
  ~Assembly();
  Assembly(const Assembly &) = delete;
  Assembly &operator=(const Assembly &) = delete;

  /// What is assembled: everything, or the facets only (cells are then PETSc's own affair).
  enum class Part { all, facets };

  /// @p rate_ds: for PetscFE types other than pulmo's, the PetscDS of the auxiliary field that carries x_t. @p varying:
  /// parameters that differ from place to place, or null.
  PetscErrorCode setup(DM dm, PetscDS rate_ds, const ParameterFields *varying);
  /// What kernels remember; must outlive this.
  PetscErrorCode remember(const PointMemory &memory);

  /// Adds the residual of the local vectors @p x and @p x_t to F; rows of field f are multiplied by row_scale[f].
  PetscErrorCode residual(Part part, PetscReal t, Vec x, Vec x_t, const PetscReal row_scale[], Vec F);
  /// The same residual times each of the local vectors @p weights, cell by cell; a facet counts to the cell behind it.
  /// @p sums: [weight][cell of this rank].
  PetscErrorCode weighted_residual(Part part, PetscReal t, Vec x, Vec x_t, const PetscReal row_scale[],
                                   const std::vector<Vec> &weights, std::vector<std::vector<PetscReal>> &sums);
  /// Adds @p change to a constant that differs from place to place (ParameterFields::offsets()), wherever it is.
  void change_varying(std::size_t which, PetscReal change);
  /// A = dF/dx + shift dF/dx_t, rows scaled alike; Part::facets adds to A.
  /// The element matrices go to each of @p also, too. Collective.
  PetscErrorCode jacobian(Part part, PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[], Mat A,
                          const std::vector<CellMatrices *> &also = {});
  /// The same transposed, for Part::all; columns of A are what is scaled then.
  PetscErrorCode transposed_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[], Mat A,
                                     const std::vector<CellMatrices *> &also = {});
  /// Adds that transposed Jacobian times @p z to @p y, element by element and without a matrix. All are local vectors;
  /// what is held has rows and columns, too.
  PetscErrorCode add_transposed_product(PetscReal t, Vec x, Vec x_t, PetscReal shift, const PetscReal row_scale[],
                                        Vec z, Vec y);
  using TakeMatrix = std::function<PetscErrorCode(PetscInt cell, const PetscScalar *matrix)>;
  /// Hands over the element matrices of dF/dx + shift dF/dx_t, rows not scaled: of all cells, then of the facets as
  /// matrices of the cell behind.
  PetscErrorCode cell_matrices(PetscReal t, Vec x, Vec x_t, PetscReal shift, const TakeMatrix &take);
  /// From now on the air is measured: @p airless_J is 1 - Phi0 of each cell.
  void need_air(std::vector<PetscReal> airless_J) { airless_J_ = std::move(airless_J), needs_air_ = true; }
  /// J and its integral for the local vector @p x. Collective.
  PetscErrorCode measure(Vec x, Measures &measures) const;
  /// Largest |ln(J in y / J in x)| of all quadrature points, local vectors with J > 0. Collective.
  PetscErrorCode largest_J_change(Vec x, Vec y, PetscReal &change) const;
  /// Largest |change of the pressure| (kPa) of any node from @p x to @p y. Collective.
  PetscErrorCode largest_pressure_change(Vec x, Vec y, PetscReal &change) const;
  /// int cof F(x) : Grad y, the derivative of int (J - 1) in direction @p y, mm^3. Collective.
  PetscErrorCode volume_derivative(Vec x, Vec y, PetscReal &derivative) const;
  /// Adds @p factor times the derivative of int (J - 1) q by the displacements to @p y; q is the pressure field of @p
  /// weight, or 1 if that is null. Local vectors. @p cells: of this rank, all of them if null.
  PetscErrorCode add_volume_gradient(Vec x, Vec weight, PetscReal factor, Vec y,
                                     const std::vector<PetscInt> *cells = nullptr);
  /// int (J - 1) q, mm^3, cell by cell; q is the pressure field of each of @p weights. Local vectors.
  /// @p sums: [weight][cell of this rank].
  PetscErrorCode weighted_volume(Vec x, const std::vector<Vec> &weights, std::vector<std::vector<PetscReal>> &sums);

  /// Kinematic states at the quadrature points, then the corners, of cell @p c (counted from 0).
  void point_states(PetscInt c, const PetscScalar *x, std::vector<PointState> &states) const;
  /// Weights of the quadrature points, summing to 1.
  const std::vector<PetscReal> &relative_weights() const { return relative_weights_; }
  PetscInt cells() const { return layout_.cells; }
  const CellLayout &layout() const { return layout_; }
  /// Offsets in the local vector of the dofs of cell @p c, field by field in the order of the basis.
  const PetscInt *cell_dofs(PetscInt c) const { return layout_.cell_dofs(c); }
  const IntegrationLog &log() const { return log_; }

private:
  struct Facets;

  PetscErrorCode setup_cells();
  PetscErrorCode setup_facets();
  PetscErrorCode setup_varying(const ParameterFields &fields);
  /// Gathers coefficients in blocks of cells, then of facets, integrates each block and scatters the results.
  template <class OnCells, class OnFacets, class Scatter>
  PetscErrorCode for_blocks(Part part, Vec x, Vec x_t, PetscInt result_size, OnCells &&on_cells, OnFacets &&on_facets,
                            Scatter &&scatter);
  /// The same for the vectors of the residual.
  template <class Scatter>
  PetscErrorCode for_vectors(Part part, PetscReal t, Vec x, Vec x_t, Scatter &&scatter);
  /// The same for the matrices of dF/dx + shift dF/dx_t.
  template <class Scatter>
  PetscErrorCode for_matrices(Part part, PetscReal t, Vec x, Vec x_t, PetscReal shift, Scatter &&scatter);
  PetscErrorCode prepare_weighing();
  PetscInt places_per_call() const;
  PetscErrorCode put_places(const std::vector<PetscReal> &rows, const std::string &surface, PetscInt begin);
  PetscFEGeom block_geometry(PetscInt begin, PetscInt n);

  DM dm_ = nullptr; ///< not owned
  PetscDS ds_ = nullptr, rate_ds_ = nullptr;
  PetscInt n_fields_ = 0, first_cell_ = 0;
  CellLayout layout_;
  std::vector<PetscReal> v0_, J_, invJ_, detJ_;
  element::BasisTable watched_;  ///< of displacement where J is watched: the quadrature points, then the corners
  element::BasisTable weighing_; ///< of pressure at the same points, once add_volume_gradient() weighs by it
  PetscInt watched_points_ = 0;
  std::vector<PetscReal> watched_at_; ///< these points in the reference cell
  std::vector<PetscReal> rule_weights_, relative_weights_;
  bool needs_air_ = false;
  std::vector<PetscReal> airless_J_; ///< of each cell
  std::vector<Facets *> facets_;
  MatrixMap map_;
  PlaceData places_;
  const PointMemory *memory_ = nullptr;
  PlaceMemory place_memory_;              ///< of the place at hand, for PetscFE types other than pulmo's
  PetscInt place_memory_constant_ = 0;    ///< where its address is among the constants
  std::vector<PetscReal> cell_constants_; ///< [cell][those that differ]
  IntegrationLog log_;
};

} // namespace pulmo
