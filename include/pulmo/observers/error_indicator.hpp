/// @file
/// Cell-wise indicators of the error in space, by recovery (Zienkiewicz & Zhu 1987, 1992).
///
/// A smoother stress P* (gradient of pressure g*) is recovered from the computed one: around each vertex a polynomial
/// of the degree of u (p) is fitted to the values in the cells that share it, and P* (g*) in a cell blends the
/// polynomials of its corners by their barycentric coordinates. What is left to the computed field measures its error:
///
///   tissue  1/2 int |P* - P'|^2 / M      the energy of the error in stress, J; M: the modulus that scales the model
///   flow    int (g* - Grad p) . K (g* - Grad p)     the power that the error in flow dissipates, W; K = k J C^-1
///
/// Both add up over cells. The root of the sum over that of the same integral of P' (of Grad p) is the relative error
/// of the stress (of the flow) in that norm.
#pragma once

#include "pulmo/fem/sampling.hpp"
#include "pulmo/physics/scene.hpp"

#include <array>

namespace pulmo {

/// Least-squares polynomials around the vertices of a mesh, and the field that they blend to.
class Recovery {
public:
  /// Points per cell at which a field is sampled: the centroid of constants, four points of linear fields.
  enum class Samples { centroid, four };

  /// Polynomials are of degree 1 for Samples::centroid, 2 for Samples::four; lower at vertices whose cells are too few
  /// for that.
  PetscErrorCode setup(DM dm, const Sampling &sampling, Samples samples);
  /// Fits polynomials to @p values, [cell][point][component].
  PetscErrorCode fit(const std::vector<PetscScalar> &values, PetscInt components);
  /// The recovered field at the point of cell @p c with barycentric coordinates @p lambda, after fit().
  void evaluate(std::size_t c, const PetscReal lambda[4], PetscScalar value[]) const;

private:
  /// Monomials 1, x, y, z, x^2, ...: how many a degree has.
  static constexpr std::array<int, 3> n_monomials{1, 4, 10};
  static constexpr int most_monomials = 10;

  struct Cell {
    std::array<PetscInt, 4> vertices;          ///< from 0, in the order of Sampling's corners
    std::array<std::array<PetscReal, 3>, 4> x; ///< mm
    PetscReal volume;                          ///< mm^3
  };

  int invert_moments(PetscScalar *moments) const;
  /// Sums over ranks what is stored for each vertex.
  PetscErrorCode sum_over_ranks(PetscInt per_vertex, std::vector<PetscScalar> &values) const;
  /// Monomials at a point of cell @p c about its corner @p k.
  void monomials(const Cell &cell, int k, const PetscReal lambda[4], PetscReal m[most_monomials]) const;

  DM dm_ = nullptr; ///< not owned
  PetscInt components_ = 0, vertex_begin_ = 0, n_vertices_ = 0;
  int degree_ = 0;
  PetscReal length_ = 1;                         ///< makes monomials dimensionless, mm
  std::vector<std::array<PetscReal, 4>> points_; ///< barycentric coordinates of the samples
  std::vector<Cell> cells_;
  std::vector<int> degrees_;                         ///< [vertex]
  std::vector<PetscScalar> inverses_, coefficients_; ///< [vertex][monomial][monomial], [vertex][component][monomial]
};

/// The indicators of a state.
struct CellErrors {
  std::vector<PetscScalar> tissue, flow; ///< [cell of this rank], J and W (flow: empty without airflow)
  PetscReal stress = 0, dissipation = 0; ///< of the whole lung: the same integrals of P' and Grad p, J and W
};

/// Estimates the errors of a scene's states.
class ErrorIndicator {
public:
  ErrorIndicator(const Scene &scene, const Model &model) : scene_(scene), model_(model) {}
  PetscErrorCode setup();
  PetscErrorCode estimate(Vec local, CellErrors &errors);

private:
  const Scene &scene_;
  const Model &model_;
  Sampling sampling_;
  Recovery stress_, gradient_;
};

} // namespace pulmo
