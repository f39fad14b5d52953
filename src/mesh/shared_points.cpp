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

PetscErrorCode outer_facets(DM dm, std::vector<PetscInt> &facets)
{
  PetscInt begin, end, point_end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &point_end));
  PetscCall(DMPlexGetHeightStratum(dm, 1, &begin, &end));
  std::vector<PetscInt> cells(static_cast<std::size_t>(point_end), 0);
  for (PetscInt f = begin; f < end; ++f) PetscCall(DMPlexGetSupportSize(dm, f, &cells[f]));
  const std::vector<PetscInt> here = cells;
  PetscCall(combine_shared(dm, MPI_SUM, cells));
  facets.clear();
  for (PetscInt f = begin; f < end; ++f)
    if (cells[f] == 1 && here[f] == 1) facets.push_back(f);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
