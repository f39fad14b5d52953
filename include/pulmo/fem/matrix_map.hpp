/// @file
/// Where the entries of element matrices go in a sparse matrix: found once, so that they are added in place.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <cstdint>
#include <map>
#include <vector>

namespace pulmo {

/// The dofs of all cells of this rank.
struct CellLayout {
  PetscInt cells = 0, size = 0;   ///< size: dofs of a cell
  PetscInt points = 0;            ///< mesh points of a cell that carry dofs
  std::vector<PetscInt> dofs;     ///< [cell][size]: offset in the local vector
  std::vector<PetscInt> of_cell;  ///< [cell][points]: mesh points
  std::vector<PetscInt> point_of; ///< [size]: which of these points a dof of the element belongs to
  std::vector<PetscInt> field_of; ///< [size]

  const PetscInt *cell_dofs(PetscInt c) const { return &dofs[c * size]; }
  const PetscInt *cell_points(PetscInt c) const { return &of_cell[c * points]; }
};

/// Dofs of one mesh point are neighbours in every row, and all rows of a mesh point have the same pattern: one offset
/// per pair of mesh points of a cell is enough. Rows of other ranks are summed here and sent once.
class MatrixMap {
public:
  /// Positions in @p A for the cells of @p layout, which must outlive this; once for each matrix. Collective.
  PetscErrorCode setup(DM dm, const CellLayout &layout, Mat A);
  /// Opens A; add() comes next.
  PetscErrorCode begin();
  /// Adds the element matrix of cell @p cell, rows of field f multiplied by row_scale[f].
  PetscErrorCode add(PetscInt cell, const PetscScalar *matrix, const PetscReal row_scale[], Mat A);
  /// Closes and assembles A. Collective.
  PetscErrorCode end(Mat A);

private:
  /// What belongs to a mesh point's dofs: global number of the first free one, how many are free.
  struct PointRows {
    std::vector<PetscInt> first, count;
  };
  using Ghosts = std::map<PetscInt, std::map<PetscInt, std::int32_t>>; ///< row point -> column point -> offset

  PetscErrorCode find_free_dofs(DM dm, PointRows &rows);
  PetscErrorCode find_ghost_rows(DM dm, const PointRows &rows, Ghosts &ghosts);
  PetscErrorCode find_offsets(Mat A, const PointRows &rows, Ghosts &ghosts);

  const CellLayout *layout_ = nullptr;
  PetscObjectId matrix_ = 0; ///< which matrix: an address may be used again
  PetscInt row_begin_ = 0;   ///< the first row of this rank
  bool direct_ = false;      ///< AIJ: entries are added in place
  Mat diagonal_ = nullptr, off_diagonal_ = nullptr;
  const PetscInt *rows_[2] = {nullptr, nullptr}; ///< CSR row pointers of the two parts
  PetscScalar *values_[2] = {nullptr, nullptr};  ///< their entries, while a Jacobian is assembled
  std::vector<std::int32_t> offset_;             ///< [cell][row point][column point]
  std::vector<PetscInt> global_;                 ///< [local dof]: global number of a free dof, -1 if constrained
  std::vector<PetscInt> row_;                    ///< [local dof]: owned: local row; ghost: -(ghost row) - 1
  std::vector<std::int8_t> free_index_;          ///< [local dof]: place among the free dofs of its mesh point, or -1
  std::vector<std::uint8_t> owned_;              ///< [mesh point]
  std::vector<PetscInt> ghost_begin_, ghost_columns_, ghost_rows_;
  std::vector<PetscScalar> ghost_values_;
};

} // namespace pulmo
