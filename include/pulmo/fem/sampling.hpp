/// @file
/// States of the lung at quadrature points of cells and of named surfaces, for observers that integrate over them.
#pragma once

#include "pulmo/fem/model.hpp"

#include <array>

namespace pulmo {

/// A state at one point.
struct PointSample {
  PointState state;
  PetscReal x[3];                       ///< material coordinates, mm
  PetscScalar u[3];                     ///< mm
  PetscScalar p;                        ///< kPa (airflow only)
  PetscScalar grad_p[3];                ///< kPa/mm (airflow only)
  PetscScalar u_t[3], p_t, grad_p_t[3]; ///< rates, as that in the state: of make_rates(), else 0
};

/// What a number has as derivatives by what a sample holds: by Grad u, u, p and Grad p.
struct SampleDerivative : std::array<PetscScalar, 16> {
  static constexpr std::size_t u = 9, p = 12, grad_p = 13; ///< where these begin; Grad u is first
};

/// The points of the model's own rules in the integrator's order, so that integrals match the weak form term by term.
class Sampling {
public:
  /// A cell, or a facet with the cell behind it.
  struct Element {
    PetscInt cell;         ///< on this rank, counted from 0
    PetscInt table;        ///< which of the rules: 0 that of cells, then those of the faces as a cell counts them
    PetscReal measure;     ///< volume or area, reference configuration, mm^3 or mm^2
    PetscReal normal[3];   ///< outward unit normal (facets only)
    PetscReal v0[3], J[9]; ///< x = v0 + J (xi + 1)
    PetscReal inverse[9];  ///< of J
  };

  PetscErrorCode setup(const Model &model);
  /// All cells of this rank.
  const std::vector<Element> &cells() const { return cells_; }
  /// The facets of a named surface.
  PetscErrorCode surface(const Mesh &mesh, const std::string &name, std::vector<Element> &facets) const;
  /// Weights of the points of @p element, summing to its measure when multiplied with it.
  const std::vector<PetscReal> &weights(const Element &element) const { return tables_[element.table].weights; }
  PetscInt points_of_cell() const { return static_cast<PetscInt>(tables_.front().weights.size()); }
  PetscInt points_of_facet() const { return static_cast<PetscInt>(tables_.back().weights.size()); }
  /// Where the points of @p element are, [point][3], mm.
  void coordinates(const Element &element, std::vector<PetscReal> &x) const;
  /// States at the points of @p element for the local vector @p x.
  void sample(const Element &element, const PetscScalar *x, std::vector<PointSample> &samples) const;
  /// Adds to the local vector @p y what @p derivatives at the points of @p element are by the vector of sample().
  void add_derivatives(const Element &element, const std::vector<SampleDerivative> &derivatives, PetscScalar *y) const;
  /// Gives @p now the rates that backward Euler finds in it after @p before, @p dt seconds earlier.
  static void make_rates(const PointSample &before, PetscReal dt, PointSample &now);
  /// Gives @p now the rates that the sample @p rate of a vector of rates holds.
  static void take_rates(const PointSample &rate, PointSample &now);
  /// A sample as kernels see it.
  Point point(const PointSample &sample, const Element &element, PetscReal t, const Step &step,
              const Memory &memory = {}) const
  {
    return {sample.state,
            sample.u,
            sample.p,
            gas_ ? sample.grad_p : nullptr,
            t,
            0,
            sample.x,
            element.table > 0 ? element.normal : nullptr,
            step,
            sample.u_t,
            sample.p_t,
            gas_ ? sample.grad_p_t : nullptr,
            memory};
  }

private:
  /// Basis functions at the points of a rule on the reference cell.
  struct Table {
    std::vector<PetscReal> weights, xi; ///< weights sum to 1
    element::BasisTable u, p;
  };

  PetscErrorCode add_table(const std::vector<PetscReal> &xi, const std::vector<PetscReal> &weights);

  DM dm_ = nullptr; ///< not owned
  const Assembly *assembly_ = nullptr;
  bool gas_ = false;
  std::vector<Table> tables_; ///< of the cell, then of its faces
  std::vector<Element> cells_;
};

} // namespace pulmo
