#include "pulmo/adjoint/recording.hpp"

#include <algorithm>

namespace pulmo {

PetscErrorCode Recording::declare(Options &options, bool wanted)
{
  PetscFunctionBeginUser;
  options.group("sweep", "sweeps back over a run", wanted, "-sensitivities or -error_estimate");
  PetscCall(options.real("memory", "MB", Range::not_negative(),
                         "for the states of the run on each rank; more of them go to a file in the output directory",
                         memory_));
  PetscCall(options.real("rtol", "-", Range::between(1e-14, 0.1), "relative tolerance of the sweep's linear systems",
                         tolerance_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Recording::attach(Simulation &simulation, const std::string &folder)
{
  const PetscReal most = 1e18; // bytes: what a whole number holds

  PetscFunctionBeginUser;
  trajectory_ = std::make_unique<Trajectory>(static_cast<std::size_t>(std::min(memory_ * 1e6, most)), folder);
  simulation.record(*trajectory_);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Recording::complaint(MPI_Comm comm, std::string &text) const
{
  PetscMPIInt rank, lacking; // the first rank that has not all states

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  lacking = trajectory_->complaint().empty() ? PETSC_MPI_INT_MAX : rank;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &lacking, 1, MPI_INT, MPI_MIN, comm));
  text = trajectory_->complaint();
  if (lacking == PETSC_MPI_INT_MAX) PetscFunctionReturn(PETSC_SUCCESS);
  PetscMPIInt length = static_cast<PetscMPIInt>(text.size());
  PetscCallMPI(MPI_Bcast(&length, 1, MPI_INT, lacking, comm));
  text.resize(static_cast<std::size_t>(length));
  PetscCallMPI(MPI_Bcast(text.data(), length, MPI_CHAR, lacking, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
