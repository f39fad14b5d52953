#include "pulmo/fem/row_groups.hpp"

#include "pulmo/base/attached.hpp"
#include "pulmo/base/simd.hpp"
#include "pulmo/fem/sequential_parts.hpp"

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

namespace pulmo {

namespace {

constexpr PetscInt most_rows = 4; ///< three components of the displacement and the pressure
constexpr PetscInt piece = 16;    ///< entries of a row that are multiplied together

/// Reading the entries of the matrix is what takes time, and the scattered reads of the vector keep the machine from
/// seeing that they lie one behind the other: they are asked for so many entries ahead.
constexpr PetscInt ahead = 1024;

/// Columns that follow one another: those of a mesh point.
struct Run {
  std::int32_t first, n;
};

/// Rows of a matrix by groups: rows [row[g], row[g + 1]) have the same columns, runs [run[g], run[g + 1]).
struct RowGroups {
  std::vector<PetscInt> row;
  std::vector<std::size_t> run{0};
  std::vector<Run> runs;
  std::vector<PetscScalar> packed[2]; ///< entries of the vector in the order of a group's columns, then zeros
};

const Vector8InArray &eight(const PetscScalar *p)
{
  return *reinterpret_cast<const Vector8InArray *>(p);
}

/// Copies the entries of @p x, which has @p size, that group @p g multiplies; @p n: how many those are.
void pack(const RowGroups &groups, std::size_t g, PetscInt n, const PetscScalar *x, PetscInt size, PetscScalar *packed)
{
  PetscScalar *to = packed;
  for (std::size_t k = groups.run[g]; k < groups.run[g + 1]; ++k) {
    const Run run = groups.runs[k];
    if (run.first + most_rows <= size)
      std::copy_n(x + run.first, most_rows, to); // always as many: what is too much is overwritten by what follows
    else
      std::copy_n(x + run.first, run.n, to);
    to += run.n;
  }
  std::fill_n(packed + n, piece, 0.0);
}

/// A row of @p n entries times as many of @p x, behind which zeros stand. Reads whole pieces.
PetscScalar multiply_row(PetscInt n, const PetscScalar *row, const PetscScalar *x)
{
  Vector8 even = {}, odd = {};
  for (PetscInt k = 0; k < n; k += piece) {
    __builtin_prefetch(row + k + ahead);
    __builtin_prefetch(row + k + 8 + ahead);
    even += eight(row + k) * eight(x + k);
    odd += eight(row + k + 8) * eight(x + k + 8);
  }
  even += odd;
  PetscScalar sum = 0;
  for (int i = 0; i < 8; ++i) sum += even[i];
  return sum;
}

constexpr const char *name = "pulmo_row_groups";

PetscErrorCode multiply(Mat A, Vec x, Vec y)
{
  RowGroups *self = nullptr;
  PetscInt rows, size;
  const PetscInt *i, *j;
  const PetscScalar *a;
  PetscBool done;

  PetscFunctionBeginUser;
  PetscCall(find_attached((PetscObject)A, name, &self));
  PetscCheck(self, PetscObjectComm((PetscObject)A), PETSC_ERR_PLIB, "a matrix without its groups of rows");
  PetscCall(MatGetSize(A, nullptr, &size));
  PetscCall(MatGetRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscCall(MatSeqAIJGetArrayRead(A, &a));
  {
    const ReadArray xs(x);
    WriteArray ys(y);
    const std::size_t n_groups = self->row.size() - 1;
    const auto pack_group = [&](std::size_t g) {
      const PetscInt row = self->row[g];
      pack(*self, g, i[row + 1] - i[row], xs.data(), size, self->packed[g % 2].data());
    };
    if (n_groups > 0) pack_group(0);
    for (std::size_t g = 0; g < n_groups; ++g) {
      if (g + 1 < n_groups) pack_group(g + 1); // what was just written cannot be read at once
      const PetscScalar *packed = self->packed[g % 2].data();
      for (PetscInt row = self->row[g]; row < self->row[g + 1]; ++row) {
        const PetscInt n = i[row + 1] - i[row];
        ys[row] = i[row] + n + piece <= i[rows] ? multiply_row(n, a + i[row], packed)
                                                : std::inner_product(a + i[row], a + i[row + 1], packed, 0.0);
      }
    }
  }
  PetscCall(PetscLogFlops(2.0 * i[rows]));
  PetscCall(MatSeqAIJRestoreArrayRead(A, &a));
  PetscCall(MatRestoreRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode group_rows(Mat A)
{
  Mat foreign;
  PetscInt rows;
  const PetscInt *i, *j, *columns;
  PetscBool done, plain;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectTypeCompareAny((PetscObject)A, &plain, MATSEQAIJ, MATMPIAIJ, ""));
  if (!plain) PetscFunctionReturn(PETSC_SUCCESS); // another product
  PetscCall(sequential_parts(A, &A, &foreign, &columns));
  PetscCall(MatGetRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscCheck(done, PETSC_COMM_SELF, PETSC_ERR_SUP, "the matrix does not show its rows");
  auto *groups = new RowGroups;
  PetscInt longest = 0;
  for (PetscInt row = 0, first = 0; row < rows; ++row) {
    const PetscInt n = i[row + 1] - i[row];
    if (row > 0 && row - first < most_rows && n == i[first + 1] - i[first] &&
        std::equal(j + i[row], j + i[row + 1], j + i[first]))
      continue;
    first = row;
    groups->row.push_back(row);
    for (const PetscInt *c = j + i[row], *end = c + n; c < end; ++c) {
      const bool follows = groups->runs.size() > groups->run.back() && groups->runs.back().n < most_rows &&
                           *c == groups->runs.back().first + groups->runs.back().n;
      if (follows)
        ++groups->runs.back().n;
      else
        groups->runs.push_back({static_cast<std::int32_t>(*c), 1});
    }
    groups->run.push_back(groups->runs.size());
    longest = std::max(longest, n);
  }
  groups->row.push_back(rows);
  groups->runs.shrink_to_fit();
  for (std::vector<PetscScalar> &packed : groups->packed) packed.assign(longest + piece, 0);
  PetscCall(MatRestoreRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscCall(attach_owned((PetscObject)A, name, groups));
  PetscCall(MatSetOperation(A, MATOP_MULT, (void (*)())multiply));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
