/// @file
/// An order of a mesh's cells, or of facets, that depends on nothing but the mesh: not on its numbering, not on the
/// ranks.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <array>
#include <vector>

namespace pulmo {

/// Rows of numbers, one for each cell (or facet), travel to rank 0 in that order, and back.
class CellOrder {
public:
  /// All cells. Collective.
  PetscErrorCode setup(DM dm);
  /// @p facets of this rank: mesh points of boundary facets. Collective.
  PetscErrorCode setup(DM dm, const std::vector<PetscInt> &facets);
  bool ready() const { return dm_ != nullptr; }

  /// @p mine: [cell of this rank][width]. @p all, on rank 0: the same of all cells in order. Collective.
  PetscErrorCode gather(std::size_t width, const std::vector<double> &mine, std::vector<double> &all) const;
  /// The other way round. @p fits (on all ranks): there are as many rows as cells; else nothing is done.
  /// Collective.
  PetscErrorCode scatter(std::size_t width, const std::vector<double> &all, std::vector<double> &mine,
                         bool &fits) const;

private:
  /// Tells a cell by its corners in the order of their coordinates, a facet by its cell and the corner that it lacks.
  using Key = std::array<double, 13>;

  /// The key of @p cell, or of its @p facet unless that is negative.
  static PetscErrorCode find_key(DM dm, PetscInt cell, PetscInt facet, Key &key);
  PetscErrorCode sort(DM dm, const std::vector<Key> &mine);
  /// Counts and starts, in numbers, of the ranks' rows (rank 0).
  PetscErrorCode layout(std::size_t width, std::vector<PetscMPIInt> &counts, std::vector<PetscMPIInt> &starts) const;

  DM dm_ = nullptr;                ///< must outlive this
  std::size_t mine_ = 0;           ///< cells that this rank has
  std::vector<std::size_t> place_; ///< rank 0: [cell as gathered] -> place in the order
};

} // namespace pulmo
