#include "pulmo/fem/permeability_range.hpp"

#include <algorithm>

namespace pulmo {

PetscErrorCode permeability_at_rest(const PermeabilityLaw &law, const Model &model, PermeabilityRange &range)
{
  const PetscInt cells = model.assembly().cells();
  PetscReal extremes[2] = {-PETSC_MAX_REAL, 0}; // -least, largest

  PetscFunctionBeginUser;
  for (PetscInt c = 0; c < (model.composition().varying() ? cells : std::min<PetscInt>(1, cells)); ++c) {
    const PetscReal k = law.at_rest(model.constants_at(c));
    extremes[0] = std::max(extremes[0], -k);
    extremes[1] = std::max(extremes[1], k);
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, extremes, 2, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)model.dm())));
  range = {-extremes[0], extremes[1]};
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
