// METIS as a partitioner of PETSc's.
#include "pulmo/mesh/mesh.hpp"

#include <petsc/private/partitionerimpl.h>

#include <climits>
#include <metis.h>
#include <numeric>

namespace pulmo {

namespace {

constexpr MPI_Datatype metis_type()
{
  return sizeof(idx_t) == sizeof(std::int64_t) ? MPI_INT64_T : MPI_INT32_T;
}

/// Where the entries of each rank begin, and at the end their number (rank 0).
PetscErrorCode gather_counts(MPI_Comm comm, std::int64_t own, std::vector<PetscMPIInt> &counts,
                             std::vector<PetscMPIInt> &starts)
{
  PetscMPIInt rank, size;
  std::int64_t all = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCallMPI(MPI_Allreduce(&own, &all, 1, MPI_INT64_T, MPI_SUM, comm));
  PulmoUserCheck(all <= INT_MAX, comm,
                 "-petscpartitioner_type metis: the mesh is too large for METIS on one rank; "
                 "give -petscpartitioner_type simple");
  const auto n = static_cast<PetscMPIInt>(own);
  counts.assign(rank == 0 ? size : 0, 0);
  PetscCallMPI(MPI_Gather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  starts.assign(rank == 0 ? size + 1 : 0, 0);
  std::partial_sum(counts.begin(), counts.end(), starts.begin() + (rank == 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// METIS k-way partition of the dual graph, on rank 0: of a mesh that ranks share it gets the graph alone, 20 bytes a
/// cell.
PetscErrorCode partition_metis(PetscPartitioner partitioner, PetscInt n_parts, PetscInt n_vertices, PetscInt start[],
                               PetscInt adjacency[], PULMO_PARTITION_WEIGHTS, PetscSection section, IS *partition)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)partitioner);
  std::vector<PetscInt> order(static_cast<std::size_t>(n_vertices));
  std::vector<idx_t> part(static_cast<std::size_t>(n_vertices), 0), degree, adjacent, all_degrees, all, all_parts;
  std::vector<PetscMPIInt> vertices, first_vertex, edges, first_edge;
  int code = METIS_OK;

  PetscFunctionBeginUser;
  for (PetscInt v = 0; v < n_vertices; ++v) degree.push_back(start[v + 1] - start[v]);
  if (n_vertices > 0) adjacent.assign(adjacency, adjacency + start[n_vertices]);
  PetscCall(gather_counts(comm, n_vertices, vertices, first_vertex));
  PetscCall(gather_counts(comm, static_cast<std::int64_t>(adjacent.size()), edges, first_edge));
  if (!vertices.empty()) {
    all_degrees.resize(static_cast<std::size_t>(first_vertex.back()));
    all.resize(static_cast<std::size_t>(first_edge.back()));
    all_parts.assign(all_degrees.size(), 0);
  }
  PetscCallMPI(MPI_Gatherv(degree.data(), static_cast<int>(degree.size()), metis_type(), all_degrees.data(),
                           vertices.data(), first_vertex.data(), metis_type(), 0, comm));
  PetscCallMPI(MPI_Gatherv(adjacent.data(), static_cast<int>(adjacent.size()), metis_type(), all.data(), edges.data(),
                           first_edge.data(), metis_type(), 0, comm));
  adjacent = std::vector<idx_t>();
  if (!all_degrees.empty() && n_parts > 1) {
    std::vector<idx_t> xadj(1, 0);
    for (const idx_t n : all_degrees) xadj.push_back(xadj.back() + n);
    idx_t nv = static_cast<idx_t>(all_degrees.size()), ncon = 1, np = n_parts, cut = 0, options[METIS_NOPTIONS];
    METIS_SetDefaultOptions(options);
    options[METIS_OPTION_SEED] = 1;
    code = METIS_PartGraphKway(&nv, &ncon, xadj.data(), all.data(), nullptr, nullptr, nullptr, &np, nullptr, nullptr,
                               options, &cut, all_parts.data());
  }
  PetscCallMPI(MPI_Bcast(&code, 1, MPI_INT, 0, comm));
  PetscCheck(code == METIS_OK, comm, PETSC_ERR_LIB, "METIS_PartGraphKway returned %d", code);
  PetscCallMPI(MPI_Scatterv(all_parts.data(), vertices.data(), first_vertex.data(), metis_type(), part.data(),
                            static_cast<int>(part.size()), metis_type(), 0, comm));
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
