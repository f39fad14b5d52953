// What several ranks know of one mesh point, put together.
#include "pulmo/mesh/shared_points.hpp"

namespace pulmo {

PetscErrorCode combine_shared(DM dm, MPI_Op op, std::vector<PetscInt> &values)
{
  PetscSF sf;
  PetscInt roots;

  PetscFunctionBeginUser;
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  if (roots < 0) PetscFunctionReturn(PETSC_SUCCESS); // one rank
  std::vector<PetscInt> sent = values;
  PetscCall(PetscSFReduceBegin(sf, MPIU_INT, sent.data(), values.data(), op));
  PetscCall(PetscSFReduceEnd(sf, MPIU_INT, sent.data(), values.data(), op));
  sent = values;
  PetscCall(PetscSFBcastBegin(sf, MPIU_INT, sent.data(), values.data(), MPI_REPLACE));
  PetscCall(PetscSFBcastEnd(sf, MPIU_INT, sent.data(), values.data(), MPI_REPLACE));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
