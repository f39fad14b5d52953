/// @file
/// Keeps what a verification problem is judged by, step by step.
#pragma once

#include "support/scene.hpp"
#include "verification/support/fields.hpp"

#include <functional>
#include <string>
#include <vector>

namespace pulmo::test {

/// Means over vertices and the force that a prescribed displacement bears.
class History final : public Observer {
public:
  struct Quantity {
    std::function<bool(const Sample &)> where;
    std::function<double(const Sample &)> what;
  };

  /// @p held: name of the constraint whose force is kept (empty: none).
  History(Model &model, std::vector<Quantity> quantities, std::string held = "")
      : means(quantities.size()), model_(model), quantities_(std::move(quantities)), held_(std::move(held))
  {}

  PetscErrorCode observe(const StepReport &step) override
  {
    const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
    std::vector<double> sums(2 * quantities_.size(), 0);
    PetscFunctionBeginUser;
    PetscCall(sample_corners(model_.dm(), step.local, [&](const Sample &s) {
      for (std::size_t i = 0; i < quantities_.size(); ++i)
        if (quantities_[i].where(s)) {
          sums[2 * i] += quantities_[i].what(s);
          ++sums[2 * i + 1];
        }
    }));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), (PetscMPIInt)sums.size(), MPI_DOUBLE, MPI_SUM, comm));
    for (std::size_t i = 0; i < quantities_.size(); ++i) means[i].push_back(sums[2 * i] / sums[2 * i + 1]);
    times.push_back(step.row.time);
    volume.push_back(1000 * step.row.volume);
    if (!held_.empty()) PetscCall(keep_force(step));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::vector<double> times;                   ///< s
  std::vector<double> volume;                  ///< int (J - 1), mm^3
  std::vector<std::vector<double>> means;      ///< of each quantity
  std::vector<std::array<PetscReal, 3>> force; ///< on the body, kPa mm^2

private:
  Model &model_;
  std::vector<Quantity> quantities_;
  std::string held_;
  VecHandle before_, rate_, residual_;

  /// The residual of the momentum rows that the constraint has taken out.
  PetscErrorCode keep_force(const StepReport &step)
  {
    std::vector<std::array<PetscReal, 3>> forces;
    PetscFunctionBeginUser;
    if (!before_) {
      for (VecHandle *v : {&before_, &rate_, &residual_}) PetscCall(VecDuplicate(step.local, v->out()));
      force.push_back({0, 0, 0});
    } else {
      PetscCall(VecWAXPY(rate_, -1, before_, step.local));
      PetscCall(VecScale(rate_, 1 / step.row.dt));
      PetscCall(model_.residual(step.row.time, step.local, rate_, residual_));
      PetscCall(model_.reactions(residual_, forces));
      for (std::size_t i = 0; i < forces.size(); ++i)
        if (model_.composition().constraints()[i].name == held_) force.push_back(forces[i]);
    }
    PetscCall(VecCopy(step.local, before_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
};

} // namespace pulmo::test
