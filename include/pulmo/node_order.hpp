/// @file
/// An order of a mesh's nodes that depends on nothing but the mesh: not on its numbering, not on the ranks.
#pragma once

#include "pulmo/petsc.hpp"

#include <vector>

namespace pulmo {

/// Mesh points of @p dm that carry a node (vertices, then edges) and are owned by this rank.
PetscErrorCode owned_nodes(DM dm, std::vector<PetscInt> &nodes);

/// Nodes sorted by kind (vertices, then edges), coordinates and, where several nodes lie at one place (the two sides of
/// a fissure), by the cells around them. Values travel to rank 0 in that order, and back.
class NodeOrder {
public:
  /// Collective. Ends with a user error if the mesh has the same cell twice.
  PetscErrorCode setup(DM dm);
  bool ready() const { return !identity_.empty(); }

  /// Tells this mesh from every other: counts, and a hash of coordinates (mm) and cells.
  const std::string &identity() const { return identity_; }
  /// Values of a field of a local vector, constrained ones included, on rank 0: [node][component].
  PetscErrorCode gather(PetscInt field, Vec local, std::vector<double> &values) const;
  /// The other way round; all ranks get the values of all nodes that they have. @p fits (on all ranks): there are as
  /// many values as the field takes; else nothing is done.
  PetscErrorCode scatter(PetscInt field, const std::vector<double> &values, Vec local, bool &fits) const;

private:
  /// On rank 0: how many values of a field each rank owns.
  PetscErrorCode count(PetscInt field, PetscInt &components, std::vector<PetscMPIInt> &counts,
                       std::vector<PetscMPIInt> &offsets) const;
  /// Calls @p copy(first of a node's values as gathered, the same in order) for every node of the field (rank 0).
  template <class Copy>
  void each_node(PetscInt components, std::size_t n_values, Copy copy) const;

  DM dm_ = nullptr; ///< must outlive this
  std::vector<PetscInt> nodes_;
  std::vector<std::size_t> place_; ///< rank 0: [node as gathered] -> place in the order
  std::size_t n_vertices_ = 0;     ///< rank 0
  std::string identity_;
};

} // namespace pulmo
