/// @file
/// The nodes of the pressure field on the surfaces open to the ventilator, in groups of one pressure each, and the rows
/// of global vectors where scalar unknowns live.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/physics/effect.hpp"

#include <algorithm>
#include <string>
#include <vector>

namespace pulmo {

class Mesh;

/// While the airway is held, all its nodes have the pressure of their group, and their rows do not say what the field
/// is: identity in the Jacobian, x - value in a residual. A scalar unknown is kept in such a row, its value in the
/// state and its equation in the residual, so that norms and line searches see it; the pressure of a group in a row of
/// that group. Where there are too few (without airflow there are none) the first cell has dofs of no field for them.
class AirwayNodes {
public:
  /// Adds dofs of their own to a section before it is in use, on the first cell of the first rank that has one, in
  /// blocks of @p block; element loops do not see them. @p scalars: how many are needed. Collective.
  PetscErrorCode add_rows(DM dm, PetscInt scalars, PetscInt block, SectionHandle &section);
  /// What has one pressure, and the scalar that this is.
  struct Group {
    std::string name; ///< of the scalar
    std::vector<SurfacePart> surfaces;
    PetscInt scalar = 0;
  };
  /// Finds the nodes once the section is in use. @p groups: all that is open to the ventilator. @p open: the surfaces
  /// that are. @p held_as_airway: by mesh point, whether the pressure there is the airway's. User error if a part of
  /// these surfaces is in no group, a group has none of them, or two groups touch. Collective.
  PetscErrorCode setup(DM dm, const Mesh &mesh, const Elements &elements, const std::vector<Group> &groups,
                       const std::vector<std::string> &open, const std::vector<bool> &held_as_airway, PetscInt scalars);

  /// Scalars that no row is left for: these cannot be solved for.
  PetscInt homeless() const { return homeless_; }
  /// The scalars that the fields see: the pressures of groups, and that of all gas where it has dofs of its own.
  std::vector<std::size_t> acting() const;
  PetscReal area() const { return area_; } ///< of all groups, mm^2
  /// The pressure is held from now on (so it is at the start), or free.
  void hold(bool held) { held_ = held; }
  /// The pressure that each scalar stands for, kPa; by number of the scalar.
  void set_pressures(std::vector<PetscReal> scalars) { value_ = std::move(scalars); }
  void set_pressure(PetscReal all) { std::fill(value_.begin(), value_.end(), all); }

  /// Writes the held pressures into a local vector; with @p rate also (value - @p before) / dt.
  void constrain(WriteArray &local) const;
  void constrain_rate(const ReadArray &now, const ReadArray &before, PetscReal dt, WriteArray &rate) const;
  /// While the pressure is held: x - value in the rows of all nodes of a global residual, and zero in those of the
  /// scalars, whose equations follow.
  PetscErrorCode close_rows(Vec X, Vec F) const;
  /// The same for a Jacobian: identity. @p keep_flux: keeps what the rows say of the flux first. Collective.
  PetscErrorCode close_rows(Mat A, bool keep_flux);
  /// Mesh points of the nodes while they are held.
  std::vector<PetscInt> closed_points() const;

  /// The scalars that a global vector holds, or their equations. Collective.
  PetscErrorCode scalars(Vec X, std::vector<PetscReal> &values) const;
  /// Writes scalars into their rows of a global vector.
  PetscErrorCode set_scalars(Vec X, const std::vector<PetscReal> &values) const;
  /// Writes @p values, one for each scalar, into the rows of the nodes whose pressure they are, and into their own.
  PetscErrorCode set(Vec X, const std::vector<PetscReal> &values) const;
  /// One value for all.
  PetscErrorCode set(Vec X, PetscReal value) const { return set(X, std::vector<PetscReal>(homes_.size(), value)); }

  /// Mean pressure over all groups (eq. 48), kPa, from a local vector. Collective.
  PetscErrorCode mean_pressure(Vec local, PetscReal &mean) const;
  /// Adds @p factor times the derivative of that mean to a local vector.
  PetscErrorCode add_mean_gradient(PetscReal factor, Vec local) const;
  /// Writes @p values, by scalar, at the nodes whose pressure they are, of a local vector, and of a global one.
  PetscErrorCode fill(Vec local, const std::vector<PetscReal> &values) const;
  PetscErrorCode fill_global(Vec X, const std::vector<PetscReal> &values) const;
  /// One value for all nodes.
  PetscErrorCode fill(Vec local, PetscReal value) const
  {
    return fill(local, std::vector<PetscReal>(value_.size(), value));
  }
  /// Sums of a local vector over the nodes of each scalar. Collective.
  PetscErrorCode sum(Vec local, std::vector<PetscReal> &sums) const { return flows(local, 1, sums); }
  /// Flow into the lung by the pressure of each scalar, mm^3/s: the consistent flux, from a local residual whose mass
  /// rows were scaled by @p scale. Where p is held the mass residual is - int Q.N q; summed over the nodes where the
  /// lung is open it is exactly the rate of int (J - 1). Collective.
  PetscErrorCode flows(Vec F, PetscReal scale, std::vector<PetscReal> &flows) const;
  /// Derivative of these flows by the Jacobian that was closed last, in the direction of @p y (a global vector; the
  /// rows of the nodes are overwritten) for the fields and of @p scalars for the pressures of the nodes. Collective.
  PetscErrorCode flow_derivatives(Vec y, const std::vector<PetscReal> &scalars, PetscReal scale,
                                  std::vector<PetscReal> &derivatives) const;

private:
  /// A node.
  struct Node {
    PetscInt point, dof; ///< mesh point; offset in the local vector
    PetscInt row;        ///< in the global vector, -1 on ranks that do not own it
    PetscInt group;
    PetscReal area; ///< integral of its basis function over this rank's facets, mm^2
  };
  /// A row of a global vector that this rank owns and that says nothing of a field while the airway is held.
  struct ClosedRow {
    PetscInt row;
    PetscInt scalar; ///< whose value is in the state there; -1: none, and zero is
  };

  PetscErrorCode find_homes(PetscInt scalars);
  std::size_t scalar_of(const Node &node) const
  {
    return static_cast<std::size_t>(groups_[static_cast<std::size_t>(node.group)].scalar);
  }

  MPI_Comm comm_ = MPI_COMM_NULL;
  std::vector<Group> groups_;
  std::vector<Node> nodes_;
  std::vector<ClosedRow> closed_;
  std::vector<PetscInt> homes_; ///< row of each scalar, on the rank that owns it; else -1
  PetscInt first_ = 0;          ///< global row that this rank's begin with
  PetscInt own_rows_ = 0;       ///< dofs of no field on the first cell of rank own_rank_
  PetscMPIInt own_rank_ = 0;
  std::vector<PetscReal> value_; ///< of each scalar
  PetscReal area_ = 0;
  PetscInt homeless_ = 0;
  bool held_ = true;
  MatHandle flux_rows_; ///< of the nodes that this rank owns, before they were closed
};

} // namespace pulmo
