/// @file
/// An order of a mesh's cells that depends on nothing but the mesh: not on its numbering, not on the ranks.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <vector>

namespace pulmo {

/// Rows of numbers, one for each cell, travel to rank 0 in that order, and back.
class CellOrder {
public:
  /// Collective.
  PetscErrorCode setup(DM dm);
  bool ready() const { return dm_ != nullptr; }

  /// @p mine: [cell of this rank][width]. @p all, on rank 0: the same of all cells in order.
  PetscErrorCode gather(std::size_t width, const std::vector<double> &mine, std::vector<double> &all) const;
  /// The other way round. @p fits (on all ranks): there are as many rows as cells; else nothing is done.
  PetscErrorCode scatter(std::size_t width, const std::vector<double> &all, std::vector<double> &mine,
                         bool &fits) const;

private:
  /// Counts and starts, in numbers, of the ranks' rows (rank 0).
  PetscErrorCode layout(std::size_t width, std::vector<PetscMPIInt> &counts, std::vector<PetscMPIInt> &starts) const;

  DM dm_ = nullptr;                ///< must outlive this
  std::vector<PetscInt> cells_;    ///< mesh points that this rank owns
  std::vector<std::size_t> place_; ///< rank 0: [cell as gathered] -> place in the order
};

} // namespace pulmo
