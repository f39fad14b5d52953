#include "pulmo/fem/permeability_range.hpp"

#include <algorithm>

namespace pulmo {

PetscErrorCode permeability_at_rest(const SceneFacts &facts, const Model &model, PermeabilityRange &range)
{
  const PetscInt cells = model.assembly().cells();
  PetscReal extremes[2] = {-PETSC_MAX_REAL, 0}; // -least, largest

  PetscFunctionBeginUser;
  for (PetscInt c = 0; c < (model.composition().varying() ? cells : std::min<PetscInt>(1, cells)); ++c) {
    const PetscScalar *constants = model.constants_at(c);
    const PetscReal k = facts.permeability->at_rest(constants);
    const PetscReal share = facts.least_permeability ? facts.least_permeability(constants) : 1;
    extremes[0] = std::max(extremes[0], -share * k);
    extremes[1] = std::max(extremes[1], k);
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 2, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)model.dm())));
  range = {-extremes[0], extremes[1]};
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
