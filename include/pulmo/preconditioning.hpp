/// @file
/// What options files can pick beyond PETSc's own preconditioners: rigid-body modes for algebraic multigrid, the PC
/// type `p_multigrid`, and the fixed-stress matrix for Schur fieldsplits.
#pragma once

#include "pulmo/petsc.hpp"

#include <vector>

namespace pulmo {

/// Registers the PC type `p_multigrid`: two levels, P2 displacement above its P1 interpolant, Galerkin coarse matrix
/// with rigid-body modes. Options under the prefix of the PC: `-pmg_levels_*` (smoother), `-pmg_coarse_*` (the P1
/// problem). The smoother works on a copy of the matrix in 3 x 3 blocks where it has nothing but such (no node held in
/// part), in half the time for a third more memory; `-pmg_levels_blocked off` leaves the copy out. Needs a matrix of
/// the displacement alone.
PetscErrorCode register_p_multigrid();

/// Makes matrices of the displacement field of @p dm, also after a fieldsplit, carry the six rigid-body modes.
PetscErrorCode attach_rigid_body_modes(DM dm);

/// The fixed-stress approximation of the Schur complement on the pressure,
///   S = A_pp + sum over cells of c M / |M|,  c = (1' A_pu w)(w' A_up 1)/(w' A_uu w),
/// with w a uniform dilation of the cell: the pressure's own block and the storage that the tissue's compliance gives
/// (Kim, Tchelepi & Juanes 2011; White, Castelletto & Tchelepi 2016). Made of the element matrices alone, so it knows
/// no tissue law.
class FixedStress {
public:
  /// @p dm with fields displacement and pressure.
  PetscErrorCode setup(DM dm);
  bool in_use() const { return matrix_; }
  Mat matrix() const { return matrix_; }

  /// Begins a new Jacobian.
  PetscErrorCode begin();
  /// Adds cell @p c (counted from 0) from its element matrix, rows scaled by @p row_scale.
  PetscErrorCode add(PetscInt c, const PetscScalar *matrix, const PetscReal row_scale[]);
  /// Completes it; @p closed: mesh points whose pressure is held.
  PetscErrorCode end(const std::vector<PetscInt> &closed);

private:
  DM dm_ = nullptr; ///< not owned
  MatHandle matrix_;
  PetscInt nodes_ = 0, vertices_ = 4;
  std::vector<PetscReal> position_; ///< [cell][node][3] relative to the cell's middle, mm
  std::vector<PetscInt> rows_;      ///< [cell][vertex]: row of the matrix
  std::vector<PetscInt> point_row_; ///< [mesh point]: row of its pressure on this rank, -1 if not owned
};

} // namespace pulmo
