/// @file
/// The fixed-stress matrix for Schur fieldsplits.
#pragma once

#include "pulmo/fem/assembly.hpp"

#include <vector>

namespace pulmo {

/// The fixed-stress approximation of the Schur complement on the pressure,
///   S = A_pp + sum over cells of c M / |M|,  c = (1' A_pu w)(w' A_up 1)/s,
/// with w a uniform dilation of the cell: the pressure's own block and the storage that the tissue's compliance gives
/// (Kim, Tchelepi & Juanes 2011; White, Castelletto & Tchelepi 2016). Tissue under a pressure that is the same all
/// around moves against its bulk modulus, k = w' A_uu w; under a pressure that changes from cell to cell against the
/// modulus of a plane wave, m = 3 sum over the axes of w_d' A_uu w_d (isotropic: k = 9 K, m = 9 (K + 4/3 G)).
/// s is (3 k + 2 m)/5 and at least m/4: where a law is neutral k is nothing or less, but m is positive as long as the
/// law is elliptic. Made of the element matrices alone, so it knows no tissue law.
class FixedStress final : public CellMatrices {
public:
  /// @p dm with fields displacement and pressure.
  PetscErrorCode setup(DM dm, const Assembly &assembly);
  Mat matrix() const { return matrix_; }

  PetscErrorCode begin() override;
  PetscErrorCode add(PetscInt c, ElementOf what, const PetscScalar *matrix, const PetscReal row_scale[],
                     bool transposed) override;
  PetscErrorCode end(const std::vector<PetscInt> &closed) override;

private:
  PetscErrorCode make_mass_matrix(PetscDS ds);

  MatHandle matrix_;
  PetscInt n_u_ = 0, n_p_ = 0;      ///< dofs of a cell
  std::vector<PetscReal> mass_;     ///< [n_p][n_p]
  std::vector<PetscReal> position_; ///< [cell][n_u]: nodes relative to the cell's middle, mm
  std::vector<PetscInt> rows_;      ///< [cell][n_p]: row of the matrix
  std::vector<PetscInt> point_row_; ///< [mesh point]: row of its pressure on this rank, -1 if not owned
};

} // namespace pulmo
