/// @file
/// An order of a mesh's nodes that depends on nothing but the mesh: not on its numbering, not on the ranks.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <array>
#include <vector>

namespace pulmo {

/// Mesh points of @p dm below dimension @p dimension (vertices, then edges, then faces) that this rank owns.
PetscErrorCode owned_points(DM dm, PetscInt dimension, std::vector<PetscInt> &points);

/// A number made of the coordinates of a mesh point's corners, whatever their order.
PetscErrorCode hash_corners(DM dm, PetscInt point, std::uint64_t &h);

/// Mesh points sorted by kind (vertices, edges, faces), coordinates and, where several lie at one place (the two sides
/// of a fissure), by the cells around them. Values of their nodes travel to rank 0 in that order, and back.
class NodeOrder {
public:
  /// Collective. Ends with a user error if the mesh has the same cell twice.
  PetscErrorCode setup(DM dm);
  bool ready() const { return !identity_.empty(); }

  /// Tells this mesh from every other: counts, and a hash of coordinates (mm) and cells.
  const std::string &identity() const { return identity_; }
  /// Values of a field of a local vector, constrained ones included, on rank 0: [node][component];
  /// of two nodes on an edge first that beside the vertex that comes first.
  PetscErrorCode gather(PetscInt field, Vec local, std::vector<double> &values) const;
  /// The other way round; all ranks get the values of all nodes that they have. @p fits (on all ranks): there are as
  /// many values as the field takes; else nothing is done.
  PetscErrorCode scatter(PetscInt field, const std::vector<double> &values, Vec local, bool &fits) const;

private:
  static constexpr std::size_t kinds = 3; ///< vertices, edges, faces
  using Widths = std::array<std::size_t, kinds>;

  /// How many values a field has at a mesh point of each kind; on rank 0 how many each rank owns.
  PetscErrorCode count(PetscInt field, Widths &widths, std::vector<PetscMPIInt> &counts,
                       std::vector<PetscMPIInt> &offsets) const;
  /// Where the values of a field at each owned point are in a local vector, in order: dofs of points_.
  PetscErrorCode owned_dofs(PetscInt field, std::vector<PetscInt> &dofs) const;
  /// Calls @p copy(first of a point's values as gathered, the same in order, how many) for every point (rank 0).
  template <class Copy>
  void each_point(const Widths &widths, Copy copy) const;

  DM dm_ = nullptr; ///< must outlive this
  std::vector<PetscInt> points_;
  std::vector<char> reversed_;              ///< [of points_]: an edge whose second vertex comes first
  std::vector<std::size_t> place_;          ///< rank 0: [point as gathered] -> place in the order
  std::array<std::size_t, kinds> counts_{}; ///< rank 0: points of each kind
  std::string identity_;
};

} // namespace pulmo
