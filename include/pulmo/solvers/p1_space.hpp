/// @file
/// The P1 interpolant of the displacement: the coarse space of p-multigrid.
#pragma once

#include "pulmo/fem/assembly.hpp"
#include "pulmo/fem/matrix_map.hpp"

#include <array>
#include <vector>

namespace pulmo {

/// A clone of @p dm with a displacement at the vertices alone, held where that of @p dm (its first field) is held.
PetscErrorCode create_p1_space(DM dm, DM *p1);

/// The interpolation from @p p1, made of @p dm, to the displacement of @p dm. @p block_size: 3 if no node of @p dm is
/// held in part.
PetscErrorCode create_p1_interpolation(DM dm, DM p1, PetscInt block_size, Mat *P);

/// The matrix of the displacement in that space, P' A_uu P, made of the matrices of cells and facets: cells interpolate
/// within themselves. Neither A_uu nor the product is needed then.
class P1Matrix final : public CellMatrices {
public:
  /// @p fits: each node of @p dm is free or held in all directions, and one that is held has no free vertex beside it.
  /// Else this cannot be used. Collective.
  PetscErrorCode setup(DM dm, const Assembly &assembly, bool &fits);
  Mat matrix() const { return matrix_; }

  PetscErrorCode begin() override;
  PetscErrorCode add(PetscInt c, ElementOf what, const PetscScalar *matrix, const PetscReal row_scale[],
                     bool transposed) override;
  PetscErrorCode end(const std::vector<PetscInt> &closed) override;

private:
  /// A node of a cell that follows a vertex of the cell.
  struct Share {
    PetscInt node;
    PetscReal weight;
  };
  static constexpr PetscInt vertices = 4, size = 3 * vertices;

  PetscErrorCode find_shares(DM dm, const CellLayout &cells);
  PetscErrorCode check(DM dm, bool &fits) const;

  DMHandle space_;
  MatHandle matrix_;
  CellLayout layout_;
  MatrixMap map_;
  PetscInt n_u_ = 0, width_ = 0;                    ///< displacement's dofs of a cell; all of them
  std::array<std::vector<Share>, vertices> shares_; ///< the same for all cells, as these see their nodes
};

} // namespace pulmo
