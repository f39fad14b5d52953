#include "pulmo/fem/matrix_map.hpp"

#include "pulmo/fem/sequential_parts.hpp"

#include <algorithm>

namespace pulmo {

namespace {

constexpr PetscInt max_size = 128;

/// Columns of an element matrix whose entries go to one part of the matrix. Most are the three components of a node,
/// which are neighbours there as here.
struct Columns {
  struct Column {
    PetscInt first, point, free_index; ///< the first column, the mesh point of the cell, its place among the point's
  };
  Column threes[max_size / 3], ones[max_size];
  PetscInt n_threes = 0, n_ones = 0;
  PetscInt place_of_threes[max_size / 3], place_of_ones[max_size];

  /// @p offset: where the mesh points' columns begin in the rows at hand.
  void place(const std::int32_t *offset)
  {
    for (PetscInt k = 0; k < n_threes; ++k) place_of_threes[k] = offset[threes[k].point] + threes[k].free_index;
    for (PetscInt k = 0; k < n_ones; ++k) place_of_ones[k] = offset[ones[k].point] + ones[k].free_index;
  }
  void add(const PetscScalar *entries, PetscScalar scale, PetscScalar *row) const
  {
    for (PetscInt k = 0; k < n_threes; ++k) {
      const PetscScalar *from = entries + threes[k].first;
      PetscScalar *to = row + place_of_threes[k];
      for (int d = 0; d < 3; ++d) to[d] += scale * from[d];
    }
    for (PetscInt k = 0; k < n_ones; ++k) row[place_of_ones[k]] += scale * entries[ones[k].first];
  }
};

} // namespace

PetscErrorCode MatrixMap::setup(DM dm, const CellLayout &layout, Mat A)
{
  PetscObjectId id;
  PetscBool seq, mpi;
  PointRows rows;
  Ghosts ghosts;

  PetscFunctionBeginUser;
  PetscCall(PetscObjectGetId((PetscObject)A, &id));
  if (matrix_ == id) PetscFunctionReturn(PETSC_SUCCESS);
  *this = MatrixMap();
  layout_ = &layout;
  matrix_ = id;
  PetscCall(MatGetOwnershipRange(A, &row_begin_, nullptr));
  PetscCall(PetscObjectTypeCompare((PetscObject)A, MATSEQAIJ, &seq));
  PetscCall(PetscObjectTypeCompare((PetscObject)A, MATMPIAIJ, &mpi));
  direct_ = seq || mpi;
  PetscCall(find_free_dofs(dm, rows));
  if (!direct_) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(find_ghost_rows(dm, rows, ghosts));
  PetscCall(find_offsets(A, rows, ghosts));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Free dofs and their global numbers.
PetscErrorCode MatrixMap::find_free_dofs(DM dm, PointRows &rows)
{
  PetscSection section, global;
  PetscInt point_begin, point_end, n_local;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMGetGlobalSection(dm, &global));
  PetscCall(PetscSectionGetChart(section, &point_begin, &point_end));
  PetscCall(PetscSectionGetStorageSize(section, &n_local));
  global_.assign(n_local, -1);
  row_.assign(n_local, 0);
  free_index_.assign(n_local, -1);
  owned_.assign(point_end, 0);
  rows.first.assign(point_end, 0);
  rows.count.assign(point_end, 0);
  for (PetscInt p = point_begin; p < point_end; ++p) {
    PetscInt dof, offset, constrained, first, k = 0;
    const PetscInt *which = nullptr;
    PetscCall(PetscSectionGetDof(section, p, &dof));
    if (dof == 0) continue;
    PetscCall(PetscSectionGetOffset(section, p, &offset));
    PetscCall(PetscSectionGetConstraintDof(section, p, &constrained));
    if (constrained) PetscCall(PetscSectionGetConstraintIndices(section, p, &which));
    PetscCall(PetscSectionGetOffset(global, p, &first));
    owned_[p] = first >= 0;
    if (first < 0) first = -(first + 1);
    rows.first[p] = first;
    for (PetscInt d = 0; d < dof; ++d) {
      if (std::find(which, which + constrained, d) != which + constrained) continue;
      free_index_[offset + d] = static_cast<std::int8_t>(k);
      global_[offset + d] = first + k;
      row_[offset + d] = first + k - row_begin_;
      ++k;
    }
    rows.count[p] = k;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Rows of other ranks: their columns are the free dofs of all mesh points that share a cell with them.
PetscErrorCode MatrixMap::find_ghost_rows(DM dm, const PointRows &rows, Ghosts &ghosts)
{
  PetscSection section;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  for (PetscInt c = 0; c < layout_->cells; ++c) {
    const PetscInt *points = layout_->cell_points(c);
    for (PetscInt i = 0; i < layout_->points; ++i)
      if (!owned_[points[i]])
        for (PetscInt j = 0; j < layout_->points; ++j) ghosts[points[i]][points[j]] = 0;
  }
  ghost_begin_.push_back(0);
  for (auto &[point, row] : ghosts) {
    PetscInt offset, dof, length = 0;
    std::vector<PetscInt> row_columns;
    for (auto &[column, place] : row) {
      place = static_cast<std::int32_t>(length);
      for (PetscInt k = 0; k < rows.count[column]; ++k) row_columns.push_back(rows.first[column] + k);
      length += rows.count[column];
    }
    PetscCall(PetscSectionGetOffset(section, point, &offset));
    PetscCall(PetscSectionGetDof(section, point, &dof));
    for (PetscInt d = 0; d < dof; ++d) {
      if (free_index_[offset + d] < 0) continue;
      row_[offset + d] = -static_cast<PetscInt>(ghost_rows_.size()) - 1;
      ghost_rows_.push_back(global_[offset + d]);
      ghost_columns_.insert(ghost_columns_.end(), row_columns.begin(), row_columns.end());
      ghost_begin_.push_back(static_cast<PetscInt>(ghost_columns_.size()));
    }
  }
  ghost_values_.assign(ghost_columns_.size(), 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Offsets of column points within the rows of row points.
PetscErrorCode MatrixMap::find_offsets(Mat A, const PointRows &rows, Ghosts &ghosts)
{
  const PetscInt *garray = nullptr, *columns[2] = {nullptr, nullptr};
  PetscInt n_garray = 0;

  PetscFunctionBeginUser;
  PetscCall(sequential_parts(A, &diagonal_, &off_diagonal_, &garray));
  if (off_diagonal_) PetscCall(MatGetSize(off_diagonal_, nullptr, &n_garray));
  PetscInt n_rows;
  PetscBool done;
  PetscCall(MatGetRowIJ(diagonal_, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &rows_[0], &columns[0], &done));
  if (off_diagonal_)
    PetscCall(MatGetRowIJ(off_diagonal_, 0, PETSC_FALSE, PETSC_FALSE, &n_rows, &rows_[1], &columns[1], &done));
  offset_.resize(static_cast<std::size_t>(layout_->cells) * layout_->points * layout_->points);
  for (PetscInt c = 0; c < layout_->cells; ++c) {
    const PetscInt *points = layout_->cell_points(c);
    for (PetscInt i = 0; i < layout_->points; ++i) {
      for (PetscInt j = 0; j < layout_->points; ++j) {
        std::int32_t &offset = offset_[(c * layout_->points + i) * layout_->points + j];
        offset = 0;
        if (rows.count[points[i]] == 0 || rows.count[points[j]] == 0) continue;
        if (!owned_[points[i]]) {
          offset = ghosts[points[i]][points[j]];
          continue;
        }
        const int part = owned_[points[j]] ? 0 : 1;
        PetscInt column = rows.first[points[j]];
        if (part == 0)
          column -= row_begin_;
        else {
          const PetscInt *place = std::lower_bound(garray, garray + n_garray, column);
          PetscCheck(place < garray + n_garray && *place == column, PETSC_COMM_SELF, PETSC_ERR_PLIB,
                     "the matrix lacks a column of a neighbouring rank");
          column = static_cast<PetscInt>(place - garray);
        }
        const PetscInt row = rows.first[points[i]] - row_begin_;
        const PetscInt *begin = columns[part] + rows_[part][row], *end = columns[part] + rows_[part][row + 1];
        const PetscInt *place = std::lower_bound(begin, end, column);
        PetscCheck(place < end && *place == column, PETSC_COMM_SELF, PETSC_ERR_PLIB,
                   "the matrix pattern lacks an entry of the element matrices");
        offset = static_cast<std::int32_t>(place - begin);
      }
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode MatrixMap::begin()
{
  PetscFunctionBeginUser;
  std::fill(ghost_values_.begin(), ghost_values_.end(), 0.0);
  if (diagonal_) PetscCall(MatSeqAIJGetArray(diagonal_, &values_[0]));
  if (off_diagonal_) PetscCall(MatSeqAIJGetArray(off_diagonal_, &values_[1]));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode MatrixMap::add(PetscInt cell, const PetscScalar *matrix, const PetscReal row_scale[], Mat A)
{
  const PetscInt size = layout_->size;
  const PetscInt *dofs = layout_->cell_dofs(cell), *points = layout_->cell_points(cell);

  PetscFunctionBeginHot;
  PetscCheck(size <= max_size, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d dofs", (int)max_size);
  if (!direct_) {
    PetscScalar scaled[max_size];
    PetscInt columns[max_size];
    for (PetscInt i = 0; i < size; ++i) columns[i] = global_[dofs[i]];
    for (PetscInt i = 0; i < size; ++i) {
      for (PetscInt j = 0; j < size; ++j) scaled[j] = row_scale[layout_->field_of[i]] * matrix[i * size + j];
      PetscCall(MatSetValues(A, 1, &columns[i], size, columns, scaled, ADD_VALUES));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  Columns columns[2]; // of this rank, of the others
  for (PetscInt j = 0; j < size; ++j) {
    const PetscInt point = layout_->point_of[j];
    const auto free = [&](PetscInt k) { return k < size && layout_->point_of[k] == point ? free_index_[dofs[k]] : -1; };
    const PetscInt first = free(j);
    if (first < 0) continue;
    Columns &c = columns[owned_[points[point]] ? 0 : 1];
    const bool three = free(j + 1) == first + 1 && free(j + 2) == first + 2;
    (three ? c.threes[c.n_threes++] : c.ones[c.n_ones++]) = {j, point, first};
    if (three) j += 2;
  }
  // lets the memory begin to bring the rows of the next cell, which would be waited for one after the other (in vain
  // where columns are of other ranks, which is harmless)
  if (cell + 1 < layout_->cells) {
    const PetscInt *next = layout_->cell_dofs(cell + 1), n = layout_->points;
    for (PetscInt i = 0; i < size; ++i) {
      if (free_index_[next[i]] < 0 || row_[next[i]] < 0) continue;
      const PetscScalar *row = values_[0] + rows_[0][row_[next[i]]];
      const std::int32_t *offset = &offset_[((cell + 1) * n + layout_->point_of[i]) * n];
      for (PetscInt j = 0; j < n; ++j) __builtin_prefetch(row + offset[j], 1);
    }
  }
  PetscInt current = -1;
  for (PetscInt i = 0; i < size; ++i) {
    if (free_index_[dofs[i]] < 0) continue;
    const PetscInt point = layout_->point_of[i];
    if (point != current)
      for (Columns &c : columns) c.place(&offset_[(cell * layout_->points + point) * layout_->points]);
    current = point;
    const PetscScalar *entries = matrix + i * size, scale = row_scale[layout_->field_of[i]];
    const PetscInt row = row_[dofs[i]];
    for (int part = 0; part < (off_diagonal_ ? 2 : 1); ++part)
      columns[part].add(entries, scale,
                        row < 0 ? &ghost_values_[ghost_begin_[-row - 1]] : values_[part] + rows_[part][row]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode MatrixMap::end(Mat A)
{
  PetscFunctionBeginUser;
  if (diagonal_) PetscCall(MatSeqAIJRestoreArray(diagonal_, &values_[0]));
  if (off_diagonal_) PetscCall(MatSeqAIJRestoreArray(off_diagonal_, &values_[1]));
  for (std::size_t r = 0; r < ghost_rows_.size(); ++r) {
    const PetscInt n = ghost_begin_[r + 1] - ghost_begin_[r];
    PetscCall(MatSetValues(A, 1, &ghost_rows_[r], n, &ghost_columns_[ghost_begin_[r]], &ghost_values_[ghost_begin_[r]],
                           ADD_VALUES));
  }
  PetscCall(MatAssemblyBegin(A, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(A, MAT_FINAL_ASSEMBLY));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
