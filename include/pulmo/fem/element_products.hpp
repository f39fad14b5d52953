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
  PetscScalar *left, *right, *block; ///< [rank][stride of test], [rank][stride of trial], [node][stride of trial]

  static constexpr PetscInt rows_per_point = dim + 1;

  static std::size_t scratch_size(const TabulatedFields &f)
  {
    std::size_t widest = 0;
    for (PetscInt i = 0; i < f.n; ++i) widest = std::max(widest, Scratch::padded(f.basis[i].stride));
    return (2 * static_cast<std::size_t>(f.points * rows_per_point) + widest + 8) * widest;
  }
  MatrixBuilder(const PointData &d, Scratch &scratch) : data(d)
  {
    std::size_t widest = 0;
    for (PetscInt i = 0; i < d.fields->n; ++i) widest = std::max(widest, Scratch::padded(d.fields->basis[i].stride));
    left = scratch.take(d.fields->points * rows_per_point * widest);
    right = scratch.take(d.fields->points * rows_per_point * widest);
    block = scratch.take(widest * widest);
  }

  /// The rows of R of one pair of components, R[r] = w (sum_d g_rd G_d + g_r B).
  void fill_right(PetscInt trial, PetscInt pair, PetscInt pairs, const PetscScalar *g0, const PetscScalar *g1,
                  const PetscScalar *g2, const PetscScalar *g3) const
  {
    const ScalarBasis &basis = data.fields->basis[trial];
    const PetscInt n = basis.stride;
    PetscScalar *r = right;
    for (PetscInt q = 0; q < data.fields->points; ++q) {
      const PetscScalar w = data.weights[q], *B = basis.values + q * n, *G = data.gradients[trial] + q * dim * n;
      const auto row = [&](const PetscScalar *g, const PetscScalar *value) {
        const PetscScalar v = value ? w * *value : 0;
        if (g) {
          const PetscScalar s[3] = {w * g[0], w * g[1], w * g[2]};
          combine(n, s, G, r);
          if (value)
            for (PetscInt b = 0; b < n; b += 4) four(r + b) += v * four(B + b);
        } else {
          for (PetscInt b = 0; b < n; b += 4) four(r + b) = v * four(B + b);
        }
        r += n;
      };
      const PetscInt place = q * pairs + pair;
      if (g2 || g3)
        for (PetscInt d = 0; d < dim; ++d)
          row(g3 ? g3 + (place * dim + d) * dim : nullptr, g2 ? g2 + place * dim + d : nullptr);
      if (g0 || g1) row(g1 ? g1 + place * dim : nullptr, g0 ? g0 + place : nullptr);
    }
  }

  void add(PetscInt test, PetscInt trial, const PetscScalar *g0, const PetscScalar *g1, const PetscScalar *g2,
           const PetscScalar *g3, PetscScalar *matrix) const
  {
    const ScalarBasis &bi = data.fields->basis[test], &bj = data.fields->basis[trial];
    const PetscInt Ci = bi.components, Cj = bj.components, ni = bi.stride, nj = bj.stride, Nq = data.fields->points;
    const bool by_gradient = g2 || g3, by_value = g0 || g1; // of the test function
    const PetscInt per_point = dim * by_gradient + by_value, rank = Nq * per_point;

    for (PetscInt q = 0; q < Nq; ++q) {
      PetscScalar *l = left + q * per_point * ni;
      if (by_gradient) {
        const PetscScalar *G = data.gradients[test] + q * dim * ni;
        for (PetscInt i = 0; i < dim * ni; ++i) l[i] = G[i];
        l += dim * ni;
      }
      if (by_value)
        for (PetscInt i = 0; i < ni; ++i) l[i] = bi.values[q * ni + i];
    }
    for (PetscInt c = 0; c < Ci; ++c) {
      for (PetscInt e = 0; e < Cj; ++e) {
        const PetscInt pair = c * Cj + e;
        fill_right(trial, pair, Ci * Cj, g0, g1, g2, g3);
        for (PetscInt i = 0; i < bi.nodes * nj; ++i) block[i] = 0;
        product(bi.nodes, rank, left, ni, right, nj, block);
        for (PetscInt a = 0; a < bi.nodes; ++a) {
          PetscScalar *row = matrix + (bi.offset + a * Ci + c) * data.fields->element_size + bj.offset + e;
          for (PetscInt b = 0; b < bj.nodes; ++b) row[b * Cj] += block[a * nj + b];
        }
      }
    }
  }
};

} // namespace pulmo::element
