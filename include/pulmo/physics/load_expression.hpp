/// @file
/// Loads that a user gives as expressions of x, y, z (mm, in the shape of the mesh) and t (s).
///
/// t is 0 until a phase `settle` at the start of the run ends, and counts from there: a lung settles under the loads of
/// t = 0.
#pragma once

#include "pulmo/input/expression.hpp"
#include "pulmo/physics/effect.hpp"

#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// Where a phase `settle` at the start of the run ends, s; 0 without one.
PetscReal end_of_settling(const SceneFacts &facts);

/// A vector, or one number, with the expressions of its components. Values that are not finite, or out of range, are
/// kept for LoadWatch, which ends the run.
class LoadExpression {
public:
  std::string option;             ///< that gave it
  std::vector<Expression> values; ///< of each component
  Range range = Range::any();
  const SceneFacts *facts = nullptr;

  bool constant() const;
  bool of_place() const;
  /// The components at time @p t of the run.
  void at(PetscReal t, const PetscReal x[3], PetscScalar value[]) const;

  /// A value that cannot be used.
  struct Fault {
    std::size_t component;
    PetscReal value, t, x[3];
  };
  /// The first one so far, of this rank.
  const std::optional<Fault> &fault() const { return fault_; }
  void forget_fault() const { fault_.reset(); }

private:
  mutable std::optional<Fault> fault_;
};

/// A sentence, without its full stop, on the first value of @p loads that cannot be used, the same on all ranks; or
/// nothing.
PetscErrorCode find_fault(MPI_Comm comm, const std::vector<const LoadExpression *> &loads, std::string &text);

/// Adds the components of @p load, which must outlive @p facts, to SceneFacts::courses.
void announce_courses(const LoadExpression &load, SceneFacts &facts);

/// User error if @p load has a value that cannot be used on the nodes of @p surface at t = 0.
PetscErrorCode check_start(const Mesh &mesh, const std::string &surface, const LoadExpression &load);

/// Ends a run in which a load had a value that cannot be used.
class LoadWatch final : public Partner {
public:
  LoadWatch(const char *name, MPI_Comm comm, std::vector<const LoadExpression *> loads)
      : name_(name), comm_(comm), loads_(std::move(loads))
  {}

  const char *name() const override { return name_; }
  PetscErrorCode give_up(std::string &why) override { return find_fault(comm_, loads_, why); }

  /// A watch on those of @p loads that are no plain numbers; none if all are. What was evaluated before it, at times
  /// that a run need not reach, is forgotten.
  static std::vector<std::unique_ptr<Partner>> over(const char *name, MPI_Comm comm,
                                                    std::vector<const LoadExpression *> loads);

private:
  const char *name_;
  MPI_Comm comm_;
  std::vector<const LoadExpression *> loads_;
};

} // namespace pulmo
