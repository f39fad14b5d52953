/// @file
/// Small dense products of an element: aligned scratch memory, rows of numbers in vector registers.
#pragma once

#include "pulmo/base/simd.hpp"

#include <petscsys.h>

#include <cstdlib>
#include <cstring>
#include <new>

namespace pulmo::element {

/// Zeroed, 64-byte aligned scratch memory that lives for one block of cells.
class Scratch {
public:
  explicit Scratch(std::size_t n)
      : data_(static_cast<PetscScalar *>(std::aligned_alloc(64, (n * sizeof(PetscScalar) + 127) / 64 * 64)))
  {
    if (!data_) throw std::bad_alloc();
    std::memset(data_, 0, n * sizeof(PetscScalar));
  }
  ~Scratch() { std::free(data_); }
  Scratch(const Scratch &) = delete;
  Scratch &operator=(const Scratch &) = delete;
  PetscScalar *take(std::size_t n)
  {
    PetscScalar *p = data_ + used_;
    used_ += (n + 7) / 8 * 8;
    return p;
  }
  static std::size_t padded(std::size_t n) { return (n + 7) / 8 * 8; }

private:
  PetscScalar *data_;
  std::size_t used_ = 0;
};

static inline const Vector4InArray &four(const double *p)
{
  return *reinterpret_cast<const Vector4InArray *>(p);
}
static inline Vector4InArray &four(double *p)
{
  return *reinterpret_cast<Vector4InArray *>(p);
}

/// out = s[0] G_0 + s[1] G_1 + s[2] G_2 for three rows of @p n doubles, one after the other; n is a multiple of 4.
static inline void combine(PetscInt n, const double s[3], const double *G, double *out)
{
  const double s0 = s[0], s1 = s[1], s2 = s[2];
  for (PetscInt a = 0; a < n; a += 4)
    four(out + a) = s0 * four(G + a) + s1 * four(G + n + a) + s2 * four(G + 2 * n + a);
}

/// K[a][b] = sum_r L[r][a] R[r][b]. Rows of L and R have strides @p lda and @p ldb, rows of K @p ldb.
template <int Rows, int Vectors>
static inline void product_tile(PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb, double *K)
{
  Vector4 sum[Rows][Vectors] = {};
  for (PetscInt r = 0; r < rank; ++r) {
    for (int a = 0; a < Rows; ++a) {
      const double l = L[r * lda + a];
      for (int v = 0; v < Vectors; ++v) sum[a][v] += l * four(R + r * ldb + 4 * v);
    }
  }
  for (int a = 0; a < Rows; ++a)
    for (int v = 0; v < Vectors; ++v) four(K + a * ldb + 4 * v) = sum[a][v];
}

/// The same for any number of rows; @p ldb is a multiple of 4.
template <int Vectors>
static inline void product_rows(PetscInt rows, PetscInt rank, const double *L, PetscInt lda, const double *R,
                                PetscInt ldb, double *K)
{
  PetscInt a = 0;
  for (; a + 5 <= rows; a += 5) product_tile<5, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
  for (; a + 4 <= rows; a += 4) product_tile<4, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
  for (; a < rows; ++a) product_tile<1, Vectors>(rank, L + a, lda, R, ldb, K + a * ldb);
}

static inline void product(PetscInt rows, PetscInt rank, const double *L, PetscInt lda, const double *R, PetscInt ldb,
                           double *K)
{
  PetscInt b = 0;
  for (; b + 12 <= ldb; b += 12) product_rows<3>(rows, rank, L, lda, R + b, ldb, K + b);
  if (ldb - b == 8) product_rows<2>(rows, rank, L, lda, R + b, ldb, K + b);
  if (ldb - b == 4) product_rows<1>(rows, rank, L, lda, R + b, ldb, K + b);
}

} // namespace pulmo::element
