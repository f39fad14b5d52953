/// @file
/// Element vectors and matrices from what callbacks return at the points: sums over all points as small dense products.
#pragma once

#include "pulmo/fem/tabulation.hpp"

namespace pulmo::element {

/// vector[node * C + c] += sum_q w (f0_c B + f1_cd G_d), with f1 taken to the reference cell instead of G from it.
static inline void add_to_vector(const PointData &data, PetscInt field, const PetscScalar *f0, const PetscScalar *f1,
                                 PetscScalar *vector)
{
  const ScalarBasis &basis = data.fields->basis[field];
  const PetscInt C = basis.components, n = basis.stride;
  const PetscReal *K = data.inverse_J;
  alignas(64) PetscScalar sum[max_nodes];
  for (PetscInt c = 0; c < C; ++c) {
    for (PetscInt a = 0; a < n; ++a) sum[a] = 0;
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      const PetscScalar w = data.weights[q], *B = basis.values + q * n, *D = basis.derivatives + q * dim * n;
      if (f0) {
        const PetscScalar s = w * f0[q * C + c];
        for (PetscInt a = 0; a < n; a += 4) four(sum + a) += s * four(B + a);
      }
      if (f1) {
        const PetscScalar *f = f1 + (q * C + c) * dim;
        PetscScalar s[dim];
        for (PetscInt e = 0; e < dim; ++e)
          s[e] = w * (f[0] * K[e * dim] + f[1] * K[e * dim + 1] + f[2] * K[e * dim + 2]);
        for (PetscInt a = 0; a < n; a += 4)
          four(sum + a) += s[0] * four(D + a) + s[1] * four(D + n + a) + s[2] * four(D + 2 * n + a);
      }
    }
    for (PetscInt a = 0; a < basis.nodes; ++a) vector[basis.offset + a * C + c] += sum[a];
  }
}

/// The element matrix of one pair of fields from g0 ... g3 at all points (null where a pair has none).
struct MatrixBuilder {
  const PointData &data;
  PetscScalar *left, *right, *block; ///< [rank][stride of test], [rank][columns of trial], [node][columns of trial]

  static constexpr PetscInt rows_per_point = dim + 1;

  /// Columns of a field in the element matrix, padded to a multiple of 4.
  static PetscInt columns(const ScalarBasis &basis) { return (basis.nodes * basis.components + 3) / 4 * 4; }
  static PetscInt most_columns(const TabulatedFields &f)
  {
    PetscInt most = 0;
    for (PetscInt i = 0; i < f.n; ++i) most = std::max({most, columns(f.basis[i]), f.basis[i].stride});
    return most + 4; // the last node is written with four components
  }
  static std::size_t scratch_size(const TabulatedFields &f)
  {
    const PetscInt most = most_columns(f);
    return 2 * Scratch::padded(f.points * rows_per_point * most) + Scratch::padded(most * most);
  }
  MatrixBuilder(const PointData &d, Scratch &scratch) : data(d)
  {
    const PetscInt most = most_columns(*d.fields);
    left = scratch.take(d.fields->points * rows_per_point * most);
    right = scratch.take(d.fields->points * rows_per_point * most);
    block = scratch.take(most * most);
  }

  /// The rows of R of component @p c of the test field, R[r][b * C + e] = w (sum_d g_rd G_d + g_r B) with the
  /// components e of the trial field side by side, as the element matrix has them.
  template <int C>
  void fill_right(const ScalarBasis &trial, const PetscScalar *gradients, PetscInt c, PetscInt Ci,
                  const PetscScalar *g0, const PetscScalar *g1, const PetscScalar *g2, const PetscScalar *g3) const
  {
    const PetscInt n = trial.stride, nodes = trial.nodes, width = columns(trial);
    PetscScalar *r = right;
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      const PetscScalar w = data.weights[q], *B = trial.values + q * n, *G = gradients + q * dim * n;
      const PetscInt pair = (q * Ci + c) * C;
      const auto over_components = [&](const PetscScalar *g, PetscInt stride) {
        return w * Vector4{g[0], C > 1 ? g[stride] : 0, C > 2 ? g[2 * stride] : 0, 0};
      };
      const auto row = [&](const PetscScalar *g, const PetscScalar *value, PetscInt stride) {
        const Vector4 v = value ? over_components(value, stride) : Vector4{};
        if (g) {
          const Vector4 s0 = over_components(g, stride * dim), s1 = over_components(g + 1, stride * dim),
                        s2 = over_components(g + 2, stride * dim);
          for (PetscInt b = 0; b < nodes; ++b)
            four(r + b * C) = s0 * G[b] + s1 * G[n + b] + s2 * G[2 * n + b] + v * B[b];
        } else {
          for (PetscInt b = 0; b < nodes; ++b) four(r + b * C) = v * B[b];
        }
        r += width;
      };
      if (g2 || g3)
        for (PetscInt d = 0; d < dim; ++d)
          row(g3 ? g3 + (pair * dim + d) * dim : nullptr, g2 ? g2 + pair * dim + d : nullptr, dim);
      if (g0 || g1) row(g1 ? g1 + pair * dim : nullptr, g0 ? g0 + pair : nullptr, 1);
    }
  }

  void add(PetscInt test, PetscInt trial, const PetscScalar *g0, const PetscScalar *g1, const PetscScalar *g2,
           const PetscScalar *g3, PetscScalar *matrix) const
  {
    const ScalarBasis &bi = data.fields->basis[test], &bj = data.fields->basis[trial];
    const PetscInt Ci = bi.components, ni = bi.stride, width = columns(bj), Nq = data.fields->points;
    const bool by_gradient = g2 || g3, by_value = g0 || g1; // of the test function
    const PetscInt rank = Nq * (dim * by_gradient + by_value);

    PetscScalar *l = left;
    for (PetscInt q = 0; q < Nq; ++q) {
      if (by_gradient) l = std::copy_n(data.gradients[test] + q * dim * ni, dim * ni, l);
      if (by_value) l = std::copy_n(bi.values + q * ni, ni, l);
    }
    for (PetscInt c = 0; c < Ci; ++c) {
      (bj.components == 1   ? fill_right<1>(bj, data.gradients[trial], c, Ci, g0, g1, g2, g3)
       : bj.components == 2 ? fill_right<2>(bj, data.gradients[trial], c, Ci, g0, g1, g2, g3)
                            : fill_right<3>(bj, data.gradients[trial], c, Ci, g0, g1, g2, g3));
      product(bi.nodes, rank, left, ni, right, width, block);
      for (PetscInt a = 0; a < bi.nodes; ++a) {
        PetscScalar *row = matrix + (bi.offset + a * Ci + c) * data.fields->element_size + bj.offset;
        for (PetscInt b = 0; b < bj.nodes * bj.components; ++b) row[b] += block[a * width + b];
      }
    }
  }
};

} // namespace pulmo::element
