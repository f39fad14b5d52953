/// @file
/// Basis functions at the points of a rule, and what callbacks read at these points of one cell or face.
#pragma once

#include "pulmo/fem/dense.hpp"
#include "pulmo/physics/point.hpp"

#include <algorithm>
#include <vector>

namespace pulmo::element {

constexpr PetscInt dim = 3;
constexpr PetscInt max_fields = 4;
constexpr PetscInt max_components = 3;

/// One scalar component of a Lagrange basis at the points of a rule, rows padded to a multiple of 4.
struct ScalarBasis {
  PetscInt nodes = 0, components = 0, stride = 0, offset = 0; ///< offset: of the field in the element vector
  const PetscScalar *values = nullptr;                        ///< [point][stride]
  const PetscScalar *derivatives = nullptr;                   ///< [point][dim][stride], in the reference cell
};

/// Value and gradient at point @p q of a field that is node[a] at node a, a vector of components; @p inverse: of the
/// cell's map, d(reference)/d(real).
template <class V>
static inline void interpolate(const ScalarBasis &basis, PetscInt q, const PetscReal inverse[dim * dim], const V node[],
                               V &value, V gradient[dim])
{
  const PetscInt n = basis.stride;
  const PetscScalar *B = basis.values + q * n, *D = basis.derivatives + q * dim * n;
  V s{}, s_0{}, s_1{}, s_2{}; // value, derivatives in the reference cell
  for (PetscInt a = 0; a < basis.nodes; ++a) {
    s += B[a] * node[a];
    s_0 += D[a] * node[a];
    s_1 += D[n + a] * node[a];
    s_2 += D[2 * n + a] * node[a];
  }
  value = s;
  for (PetscInt d = 0; d < dim; ++d)
    gradient[d] = inverse[d] * s_0 + inverse[dim + d] * s_1 + inverse[2 * dim + d] * s_2;
}

/// One component of an element's basis at points of one's own.
class BasisTable {
public:
  /// @p xi: points of the reference cell, one after the other.
  PetscErrorCode setup(PetscFE fe, const std::vector<PetscReal> &xi);
  ScalarBasis basis() const { return {nodes_, components_, stride_, 0, values_.data(), derivatives_.data()}; }
  PetscInt nodes() const { return nodes_; }

private:
  PetscInt nodes_ = 0, components_ = 0, stride_ = 0;
  std::vector<PetscScalar> values_, derivatives_;
};

/// The fields of a PetscDS at a rule.
struct TabulatedFields {
  PetscInt n = 0, points = 0, element_size = 0, total_components = 0;
  PetscInt uOff[max_fields + 1], uOff_x[max_fields + 1]; ///< as PetscDS: where a field's values and gradients begin
  ScalarBasis basis[max_fields];
};

/// Scalars that make_fields() takes for @p replicas.
std::size_t fields_scratch(PetscInt n, PetscTabulation *T, PetscInt replicas);

/// Copies one component of PETSc's tabulation. @p replica: the face of the reference cell, 0 for cells.
PetscErrorCode make_fields(PetscDS ds, PetscTabulation *T, PetscInt replica, Scratch &scratch, TabulatedFields &fields);

/// Everything that callbacks read at the points of one cell or face.
struct PointData {
  const TabulatedFields *fields;
  PetscScalar *gradients[max_fields];  ///< [point][dim][stride], real space; for matrices only
  PetscReal inverse_J[dim * dim];      ///< d(reference)/d(real)
  PetscScalar *u, *u_t, *u_x, *rate_x; ///< [point][...] with the offsets of TabulatedFields; rate_x: gradients of u_t
  PetscScalar *weights;                ///< quadrature weight times det J
  PetscReal *x, *normals;              ///< [point][3]
  std::vector<PointState> states;
  std::vector<Memory> memory; ///< [point]; empty if nothing is remembered here

  PointData(const TabulatedFields &f, Scratch &scratch, bool matrices)
      : fields(&f), states(static_cast<std::size_t>(f.points)), with_gradients(matrices)
  {
    for (PetscInt i = 0; i < f.n; ++i) gradients[i] = scratch.take(f.points * dim * f.basis[i].stride);
    u = scratch.take(f.points * f.total_components);
    u_t = scratch.take(f.points * f.total_components);
    u_x = scratch.take(f.points * f.total_components * dim);
    rate_x = scratch.take(f.points * f.total_components * dim);
    weights = scratch.take(f.points);
    x = scratch.take(f.points * dim);
    normals = scratch.take(f.points * dim);
  }
  static std::size_t scratch_size(const TabulatedFields &f)
  {
    std::size_t size = Scratch::padded(f.points) + 2 * Scratch::padded(f.points * dim);
    for (PetscInt i = 0; i < f.n; ++i) size += Scratch::padded(f.points * dim * f.basis[i].stride);
    return size + 4 * Scratch::padded(f.points * f.total_components * dim);
  }

  /// Field values, rates and kinematic states (for matrices the basis' gradients, too) from the element's coefficients.
  void evaluate(const PetscReal inverse[dim * dim], const PetscScalar coefficients[],
                const PetscScalar coefficients_t[])
  {
    std::copy_n(inverse, dim * dim, inverse_J);
    for (PetscInt f = 0; f < fields->n; ++f) {
      evaluate(f, coefficients, coefficients_t);
      if (with_gradients) map_gradients(f);
    }
    for (PetscInt q = 0; q < fields->points; ++q) {
      const PetscInt offset = q * fields->total_components * dim + fields->uOff_x[displacement];
      make_point_state(u_x + offset, rate_x + offset, states[q]);
    }
  }

private:
  void map_gradients(PetscInt f)
  {
    const PetscInt n = fields->basis[f].stride;
    for (PetscInt q = 0; q < fields->points; ++q) {
      for (PetscInt d = 0; d < dim; ++d) {
        const PetscReal s[3] = {inverse_J[d], inverse_J[dim + d], inverse_J[2 * dim + d]};
        combine(n, s, fields->basis[f].derivatives + q * dim * n, gradients[f] + (q * dim + d) * n);
      }
    }
  }

  void evaluate(PetscInt f, const PetscScalar coefficients[], const PetscScalar coefficients_t[])
  {
    switch (fields->basis[f].components) {
    case 1:
      evaluate_components<1, Vector2>(f, coefficients, coefficients_t);
      break;
    case 2:
      evaluate_components<2, Vector8>(f, coefficients, coefficients_t);
      break;
    default:
      evaluate_components<3, Vector8>(f, coefficients, coefficients_t);
    }
  }

  /// Values and gradients of field @p f of @p C components and of its rate at all points. @p V: the components of a
  /// node, then, in its second half, their rates.
  template <PetscInt C, class V>
  void evaluate_components(PetscInt f, const PetscScalar coefficients[], const PetscScalar coefficients_t[])
  {
    constexpr int half = sizeof(V) / sizeof(PetscScalar) / 2;
    const ScalarBasis &basis = fields->basis[f];
    const PetscInt Nc = fields->total_components, n = basis.nodes;
    V node[max_nodes] = {};
    for (PetscInt a = 0; a < n; ++a)
      for (int c = 0; c < C; ++c) {
        node[a][c] = coefficients[basis.offset + a * C + c];
        if (coefficients_t) node[a][half + c] = coefficients_t[basis.offset + a * C + c];
      }
    for (PetscInt q = 0; q < fields->points; ++q) {
      V s, g[dim];
      interpolate(basis, q, inverse_J, node, s, g);
      PetscScalar *value = u + q * Nc + fields->uOff[f], *rate = u_t + q * Nc + fields->uOff[f];
      PetscScalar *gradient = u_x + q * Nc * dim + fields->uOff_x[f];
      PetscScalar *gradient_t = rate_x + q * Nc * dim + fields->uOff_x[f];
      for (int c = 0; c < C; ++c) {
        value[c] = s[c];
        rate[c] = s[half + c];
        for (int d = 0; d < dim; ++d) {
          gradient[c * dim + d] = g[d][c];
          gradient_t[c * dim + d] = g[d][half + c];
        }
      }
    }
  }

  bool with_gradients;
};

} // namespace pulmo::element
