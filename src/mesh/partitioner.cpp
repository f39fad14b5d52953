// METIS as a partitioner of PETSc's.
#include "pulmo/mesh/mesh.hpp"

#include <petsc/private/partitionerimpl.h>

#include <metis.h>

namespace pulmo {

namespace {

/// METIS k-way partition of the dual graph. Only the rank that holds the mesh has vertices (as after reading a
/// file); a graph that is spread over ranks is refused.
PetscErrorCode partition_metis(PetscPartitioner partitioner, PetscInt n_parts, PetscInt n_vertices, PetscInt start[],
                               PetscInt adjacency[], PULMO_PARTITION_WEIGHTS, PetscSection section, IS *partition)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)partitioner);
  PetscInt holders = n_vertices > 0;
  std::vector<PetscInt> order(static_cast<std::size_t>(n_vertices));
  std::vector<idx_t> part(static_cast<std::size_t>(n_vertices), 0);

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &holders, 1, MPIU_INT, MPI_SUM, comm));
  PulmoUserCheck(holders <= 1, comm,
                 "-petscpartitioner_type metis partitions a mesh that one rank holds; use ptscotch to partition anew");
  if (n_vertices > 0 && n_parts > 1) {
    std::vector<idx_t> xadj(start, start + n_vertices + 1), adjncy(adjacency, adjacency + start[n_vertices]);
    idx_t nv = n_vertices, ncon = 1, np = n_parts, cut = 0, options[METIS_NOPTIONS];
    METIS_SetDefaultOptions(options);
    options[METIS_OPTION_SEED] = 1;
    const int code = METIS_PartGraphKway(&nv, &ncon, xadj.data(), adjncy.data(), nullptr, nullptr, nullptr, &np,
                                         nullptr, nullptr, options, &cut, part.data());
    PetscCheck(code == METIS_OK, PETSC_COMM_SELF, PETSC_ERR_LIB, "METIS_PartGraphKway returned %d", code);
  }
  std::vector<PetscInt> count(static_cast<std::size_t>(n_parts) + 1, 0);
  for (idx_t p : part) {
    PetscCall(PetscSectionAddDof(section, p, 1));
    ++count[static_cast<std::size_t>(p) + 1];
  }
  for (PetscInt p = 0; p < n_parts; ++p) count[p + 1] += count[p];
  for (PetscInt v = 0; v < n_vertices; ++v) order[count[part[v]]++] = v;
  PetscCall(PetscSectionSetUp(section));
  PetscCall(ISCreateGeneral(comm, n_vertices, order.data(), PETSC_COPY_VALUES, partition));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_metis(PetscPartitioner partitioner)
{
  PetscFunctionBeginUser;
  partitioner->noGraph = PETSC_FALSE;
  partitioner->ops->partition = partition_metis;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode register_metis_partitioner()
{
  PetscFunctionBeginUser;
  PetscCall(PetscPartitionerRegister("metis", create_metis));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
