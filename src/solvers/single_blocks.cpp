#include "pulmo/solvers/single_blocks.hpp"

#include "pulmo/fem/sequential_parts.hpp"

#include <petsc/private/petscimpl.h>

#include <cmath>
#include <numeric>
#include <utility>
#include <vector>

namespace pulmo {

namespace {

/// Four floats of which three count: a column of a block, the vector of a node.
typedef float FloatVector __attribute__((vector_size(16), aligned(4), may_alias));

constexpr PetscInt block_size = 9;  ///< floats of a block, stored by columns
constexpr PetscInt vector_size = 4; ///< floats of a node's vector, the last one without meaning

/// The scattered reads of a vector keep the machine from seeing that blocks lie one behind the other: they are asked
/// for so many floats ahead.
constexpr PetscInt ahead = 2048;

using NodeVectors = std::vector<float>; ///< [node][vector_size]

/// Rows of blocks in compressed form.
struct Blocks {
  std::vector<PetscInt> begin{0}; ///< [node + 1]
  std::vector<PetscInt> column;   ///< [block]: node
  std::vector<float> value;       ///< [block][column][row], and room to load a vector from the last column

  void allocate() { value.assign(block_size * column.size() + 1, 0); }
  /// Appends a block to a row; rows come in order.
  void add(PetscInt node, PetscInt block_column)
  {
    close_rows(node);
    column.push_back(block_column);
  }
  /// The rows before @p node are complete.
  void close_rows(PetscInt node) { begin.resize(node + 1, static_cast<PetscInt>(column.size())); }
};

FloatVector &at(NodeVectors &x, PetscInt node)
{
  return *reinterpret_cast<FloatVector *>(&x[vector_size * node]);
}

/// B x
FloatVector times(const float *B, FloatVector x)
{
  const auto column = [B](int j) { return *reinterpret_cast<const FloatVector *>(B + 3 * j); };
  return column(0) * x[0] + column(1) * x[1] + column(2) * x[2];
}

/// r - sum over the blocks of row @p node times x
FloatVector subtract(const Blocks &blocks, PetscInt node, NodeVectors &x, FloatVector r)
{
  FloatVector other = {0, 0, 0, 0}; // two sums, so that one need not wait for the other
  const PetscInt end = blocks.begin[node + 1];
  PetscInt k = blocks.begin[node];
  for (; k + 1 < end; k += 2) {
    __builtin_prefetch(&blocks.value[block_size * k] + ahead);
    r -= times(&blocks.value[block_size * k], at(x, blocks.column[k]));
    other += times(&blocks.value[block_size * (k + 1)], at(x, blocks.column[k + 1]));
  }
  if (k < end) r -= times(&blocks.value[block_size * k], at(x, blocks.column[k]));
  return r - other;
}

/// The inverse of a 3 x 3 matrix; zero for a singular one, whose node the smoother then leaves alone.
void invert(const float *a, float *inverse)
{
  const double A[9] = {a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8]};
  const double cofactor[9] = {A[4] * A[8] - A[7] * A[5], A[7] * A[2] - A[1] * A[8], A[1] * A[5] - A[4] * A[2],
                              A[6] * A[5] - A[3] * A[8], A[0] * A[8] - A[6] * A[2], A[3] * A[2] - A[0] * A[5],
                              A[3] * A[7] - A[6] * A[4], A[6] * A[1] - A[0] * A[7], A[0] * A[4] - A[3] * A[1]};
  const double determinant = A[0] * cofactor[0] + A[3] * cofactor[1] + A[6] * cofactor[2];
  for (int i = 0; i < 9; ++i) {
    const auto entry = static_cast<float>(cofactor[i] / determinant);
    inverse[i] = std::isfinite(entry) ? entry : 0;
  }
}

struct SingleBlocks {
  Blocks lower, upper, foreign; ///< columns before and behind the diagonal; columns of other ranks
  std::vector<float> diagonal, inverse;
  PetscInt nodes = 0;
  std::vector<PetscInt> row;                      ///< [node]: the first of its three in the matrix's part of this rank
  std::vector<PetscInt> node_of, foreign_node_of; ///< [column] of the two parts; -1: not wanted
  NodeVectors x, b, r, ghosts;
  VecHandle ghost_values;
  VecScatter scatter = nullptr;

  ~SingleBlocks() { (void)VecScatterDestroy(&scatter); }
};

/// Calls @p block(node, column node, values, length of a row of values) for each block of a sequential AIJ matrix.
/// @p row: the first of each node's; @p node_of: the node of each column, -1 for one that is not wanted.
template <class Function>
PetscErrorCode for_each_block(Mat A, const std::vector<PetscInt> &row, const std::vector<PetscInt> &node_of,
                              const Function &block)
{
  PetscInt rows;
  const PetscInt *i, *j;
  const PetscScalar *a;
  PetscBool done;

  PetscFunctionBeginUser;
  PetscCall(MatGetRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscCheck(done, PETSC_COMM_SELF, PETSC_ERR_SUP, "the matrix does not show its rows");
  PetscCall(MatSeqAIJGetArrayRead(A, &a));
  for (std::size_t node = 0; node < row.size(); ++node) {
    const PetscInt r = row[node], length = i[r + 1] - i[r];
    PetscCheck(i[r + 2] - i[r + 1] == length && i[r + 3] - i[r + 2] == length, PETSC_COMM_SELF, PETSC_ERR_ARG_WRONG,
               "the matrix is not made of 3 x 3 blocks");
    for (PetscInt k = i[r]; k < i[r + 1];) {
      const PetscInt column = node_of[j[k]];
      if (column < 0) {
        ++k;
        continue;
      }
      PetscCheck(k + 2 < i[r + 1] && node_of[j[k + 2]] == column, PETSC_COMM_SELF, PETSC_ERR_ARG_WRONG,
                 "the matrix is not made of 3 x 3 blocks");
      block(static_cast<PetscInt>(node), column, a + k, length);
      k += 3;
    }
  }
  PetscCall(MatSeqAIJRestoreArrayRead(A, &a));
  PetscCall(MatRestoreRowIJ(A, 0, PETSC_FALSE, PETSC_FALSE, &rows, &i, &j, &done));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Transposes one block of rows into single precision.
void copy_block(const PetscScalar *a, PetscInt length, float *B)
{
  for (int j = 0; j < 3; ++j)
    for (int i = 0; i < 3; ++i) B[3 * j + i] = static_cast<float>(a[i * length + j]);
}

PetscErrorCode to_single(Vec v, NodeVectors &values)
{
  const ReadArray array(v);

  PetscFunctionBeginUser;
  for (std::size_t node = 0; node < values.size() / vector_size; ++node)
    for (std::size_t d = 0; d < 3; ++d) values[vector_size * node + d] = static_cast<float>(array.data()[3 * node + d]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode to_double(const NodeVectors &values, Vec v)
{
  WriteArray array(v);

  PetscFunctionBeginUser;
  for (std::size_t node = 0; node < values.size() / vector_size; ++node)
    for (std::size_t d = 0; d < 3; ++d) array.data()[3 * node + d] = values[vector_size * node + d];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// b -= (columns of other ranks) x
PetscErrorCode subtract_foreign(SingleBlocks &self, Vec x, NodeVectors &b)
{
  PetscFunctionBeginUser;
  if (!self.scatter) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(VecScatterBegin(self.scatter, x, self.ghost_values, INSERT_VALUES, SCATTER_FORWARD));
  PetscCall(VecScatterEnd(self.scatter, x, self.ghost_values, INSERT_VALUES, SCATTER_FORWARD));
  PetscCall(to_single(self.ghost_values, self.ghosts));
  for (PetscInt node = 0; node < self.nodes; ++node)
    at(b, node) = subtract(self.foreign, node, self.ghosts, at(b, node));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// r = b - A x
PetscErrorCode residual(Mat single, Vec b, Vec x, Vec r)
{
  SingleBlocks *self;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(single, &self));
  PetscCall(to_single(x, self->x));
  PetscCall(to_single(b, self->r));
  PetscCall(subtract_foreign(*self, x, self->r));
  for (PetscInt node = 0; node < self->nodes; ++node) {
    FloatVector sum = at(self->r, node) - times(&self->diagonal[block_size * node], at(self->x, node));
    sum = subtract(self->lower, node, self->x, sum);
    at(self->r, node) = subtract(self->upper, node, self->x, sum);
  }
  PetscCall(to_double(self->r, r));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode multiply(Mat single, Vec x, Vec y)
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(y));
  PetscCall(residual(single, y, x, y));
  PetscCall(VecScale(y, -1));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode get_diagonal(Mat single, Vec d)
{
  SingleBlocks *self;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(single, &self));
  WriteArray array(d);
  for (PetscInt node = 0; node < self->nodes; ++node)
    for (int i = 0; i < 3; ++i) array[3 * node + i] = self->diagonal[block_size * node + 4 * i];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// MatSOR: block Gauss-Seidel by nodes within the rank. A forward sweep leaves r = b - L x, which the backward sweep
/// after it needs again; from x = 0 the pair reads the matrix once.
PetscErrorCode sweep(Mat single, Vec b, PetscReal omega, MatSORType type, PetscReal shift, PetscInt iterations,
                     PetscInt local_iterations, Vec x)
{
  constexpr int forward = SOR_FORWARD_SWEEP | SOR_LOCAL_FORWARD_SWEEP,
                backward = SOR_BACKWARD_SWEEP | SOR_LOCAL_BACKWARD_SWEEP;
  bool zero = type & SOR_ZERO_INITIAL_GUESS;
  SingleBlocks *self;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(single, &self));
  PulmoUserCheck(omega == 1 && shift == 0 && !(type & ~(forward | backward | SOR_ZERO_INITIAL_GUESS)),
                 PetscObjectComm((PetscObject)single),
                 "-pmg_single smooths by plain Gauss-Seidel sweeps: leave out -..._pmg_levels_pc_sor_omega and "
                 "-..._pc_sor_diagonal_shift, or add -fieldsplit_displacement_pmg_single off");
  if (!zero) PetscCall(to_single(x, self->x));
  const auto solve = [self](PetscInt node, FloatVector r) {
    at(self->x, node) = times(&self->inverse[block_size * node], r);
  };
  for (PetscInt it = 0; it < iterations; ++it) {
    PetscCall(to_single(b, self->b));
    if (!zero) PetscCall(subtract_foreign(*self, x, self->b));
    for (PetscInt local = 0; local < local_iterations; ++local, zero = false) {
      if (type & forward) {
        for (PetscInt node = 0; node < self->nodes; ++node) {
          const FloatVector r = at(self->r, node) = subtract(self->lower, node, self->x, at(self->b, node));
          solve(node, zero ? r : subtract(self->upper, node, self->x, r));
        }
        if (type & backward)
          for (PetscInt node = self->nodes; node-- > 0;)
            solve(node, subtract(self->upper, node, self->x, at(self->r, node)));
      } else {
        for (PetscInt node = self->nodes; node-- > 0;) {
          const FloatVector r = subtract(self->upper, node, self->x, at(self->b, node));
          solve(node, zero ? r : subtract(self->lower, node, self->x, r));
        }
      }
    }
    PetscCall(to_double(self->x, x));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode destroy(Mat single)
{
  SingleBlocks *self;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(single, &self));
  delete self;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The nodes of this rank and of the columns of @p owned.
PetscErrorCode find_nodes(SingleBlocks &self, Mat A, IS rows)
{
  PetscInt begin, end, n;

  PetscFunctionBeginUser;
  PetscCall(MatGetOwnershipRange(A, &begin, &end));
  std::vector<PetscInt> wanted(static_cast<std::size_t>(end - begin));
  std::iota(wanted.begin(), wanted.end(), 0);
  if (rows) {
    const PetscInt *row;
    PetscCall(ISGetLocalSize(rows, &n));
    PetscCall(ISGetIndices(rows, &row));
    wanted.resize(static_cast<std::size_t>(n));
    for (PetscInt i = 0; i < n; ++i) wanted[i] = row[i] - begin;
    PetscCall(ISRestoreIndices(rows, &row));
  }
  self.nodes = static_cast<PetscInt>(wanted.size()) / 3;
  self.node_of.assign(static_cast<std::size_t>(end - begin), -1);
  for (PetscInt node = 0; node < self.nodes; ++node) {
    const PetscInt first = wanted[3 * node];
    self.row.push_back(first);
    for (PetscInt d = 0; d < 3; ++d) {
      PetscCheck(wanted[3 * node + d] == first + d, PETSC_COMM_SELF, PETSC_ERR_ARG_WRONG,
                 "the rows are not those of whole nodes");
      self.node_of[first + d] = node;
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Those of other ranks whose columns are @p columns of @p A, and the way to their vectors.
PetscErrorCode find_ghosts(SingleBlocks &self, Mat A, Mat foreign, const PetscInt columns[])
{
  PetscInt n, begin, block_begin;
  VecHandle number, numbers, x;
  ISHandle from, of_block;
  VecScatter scatter;
  std::vector<PetscInt> ghosts; // numbers in the block

  PetscFunctionBeginUser;
  // each rank tells the numbers that its columns have in the block
  PetscCall(MatGetOwnershipRange(A, &begin, nullptr));
  PetscCall(MatCreateVecs(A, number.out(), nullptr));
  PetscCall(VecCreateMPI(PetscObjectComm((PetscObject)A), 3 * self.nodes, PETSC_DETERMINE, x.out()));
  PetscCall(VecGetOwnershipRange(x, &block_begin, nullptr));
  PetscCall(VecSet(number, -1));
  {
    WriteArray value(number);
    for (PetscInt node = 0; node < self.nodes; ++node)
      for (PetscInt d = 0; d < 3; ++d) value[self.row[node] + d] = block_begin + 3 * node + d;
  }
  PetscCall(MatGetLocalSize(foreign, nullptr, &n));
  PetscCall(ISCreateGeneral(PETSC_COMM_SELF, n, columns, PETSC_COPY_VALUES, from.out()));
  PetscCall(VecCreateSeq(PETSC_COMM_SELF, n, numbers.out()));
  PetscCall(VecScatterCreate(number, from, numbers, nullptr, &scatter));
  PetscCall(VecScatterBegin(scatter, number, numbers, INSERT_VALUES, SCATTER_FORWARD));
  PetscCall(VecScatterEnd(scatter, number, numbers, INSERT_VALUES, SCATTER_FORWARD));
  PetscCall(VecScatterDestroy(&scatter));
  self.foreign_node_of.assign(static_cast<std::size_t>(n), -1);
  {
    const ReadArray value(numbers);
    for (PetscInt k = 0; k < n; ++k)
      if (value[k] >= 0) {
        self.foreign_node_of[k] = static_cast<PetscInt>(ghosts.size()) / 3;
        ghosts.push_back(static_cast<PetscInt>(value[k]));
      }
  }
  const auto n_ghosts = static_cast<PetscInt>(ghosts.size());
  PetscCall(ISCreateGeneral(PETSC_COMM_SELF, n_ghosts, ghosts.data(), PETSC_COPY_VALUES, of_block.out()));
  PetscCall(VecCreateSeq(PETSC_COMM_SELF, n_ghosts, self.ghost_values.out()));
  PetscCall(VecScatterCreate(x, of_block, self.ghost_values, nullptr, &self.scatter));
  self.ghosts.assign(vector_size * (n_ghosts / 3), 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode create_single_blocks(Mat A, IS rows, Mat *single)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)A);
  auto *self = new SingleBlocks;
  Mat owned, foreign;
  const PetscInt *columns;

  PetscFunctionBeginUser;
  PetscCall(sequential_parts(A, &owned, &foreign, &columns));
  PetscCall(find_nodes(*self, A, rows));
  PetscCall(MatCreateShell(comm, 3 * self->nodes, 3 * self->nodes, PETSC_DETERMINE, PETSC_DETERMINE, self, single));
  PetscCall(MatSetBlockSize(*single, 3));
  PetscCall(MatShellSetOperation(*single, MATOP_DESTROY, (void (*)(void))destroy));
  PetscCall(MatShellSetOperation(*single, MATOP_MULT, (void (*)(void))multiply));
  PetscCall(MatShellSetOperation(*single, MATOP_RESIDUAL, (void (*)(void))residual));
  PetscCall(MatShellSetOperation(*single, MATOP_SOR, (void (*)(void))sweep));
  PetscCall(MatShellSetOperation(*single, MATOP_GET_DIAGONAL, (void (*)(void))get_diagonal));

  PetscCall(for_each_block(owned, self->row, self->node_of,
                           [&](PetscInt node, PetscInt column, const PetscScalar *, PetscInt) {
                             if (column != node) (column < node ? self->lower : self->upper).add(node, column);
                           }));
  for (NodeVectors *v : {&self->x, &self->b, &self->r}) v->assign(vector_size * self->nodes, 0);
  self->diagonal.assign(block_size * self->nodes + 1, 0);
  self->inverse.assign(block_size * self->nodes + 1, 0);
  if (foreign) {
    PetscCall(find_ghosts(*self, A, foreign, columns));
    PetscCall(for_each_block(
        foreign, self->row, self->foreign_node_of,
        [&](PetscInt node, PetscInt column, const PetscScalar *, PetscInt) { self->foreign.add(node, column); }));
  }
  for (Blocks *blocks : {&self->lower, &self->upper, &self->foreign}) {
    blocks->close_rows(self->nodes);
    blocks->allocate();
  }
  PetscCall(update_single_blocks(*single, A));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode update_single_blocks(Mat single, Mat A)
{
  SingleBlocks *self;
  Mat owned, foreign;
  const PetscInt *columns;

  PetscFunctionBeginUser;
  PetscCall(MatShellGetContext(single, &self));
  PetscCall(sequential_parts(A, &owned, &foreign, &columns));
  float *lower = self->lower.value.data(), *upper = self->upper.value.data();
  PetscCall(for_each_block(
      owned, self->row, self->node_of, [&](PetscInt node, PetscInt column, const PetscScalar *a, PetscInt length) {
        float *&next = column < node ? lower : upper;
        float *B = column == node ? &self->diagonal[block_size * node] : std::exchange(next, next + block_size);
        copy_block(a, length, B);
      }));
  for (PetscInt node = 0; node < self->nodes; ++node)
    invert(&self->diagonal[block_size * node], &self->inverse[block_size * node]);
  if (foreign) {
    float *next = self->foreign.value.data();
    PetscCall(for_each_block(foreign, self->row, self->foreign_node_of,
                             [&](PetscInt, PetscInt, const PetscScalar *a, PetscInt length) {
                               copy_block(a, length, std::exchange(next, next + block_size));
                             }));
  }
  PetscCall(PetscObjectStateIncrease((PetscObject)single));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
