// What it takes to read a mesh, and to set up a scene on it: wall seconds, and the peak memory of every rank. Called by
// hand (docs/performance/scaling.md).
//
//   pulmo_mesh_benchmark -dm_plex_filename ... -options_file ... [-benchmark_setup on]
//
// Without -benchmark_setup it does no more than read the mesh. Prints one JSON object.
#include "pulmo/pulmo.hpp"

#include <sys/resource.h>
#include <vector>

namespace {

using namespace pulmo;

/// Peak memory so far of each rank, MB, on rank 0.
PetscErrorCode peaks(std::vector<double> &all)
{
  struct rusage usage {};
  PetscMPIInt size;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  getrusage(RUSAGE_SELF, &usage);
  const double own = (double)usage.ru_maxrss * 1024 / 1e6; // Linux counts kB
  all.resize(static_cast<std::size_t>(size));
  PetscCallMPI(MPI_Gather(&own, 1, MPI_DOUBLE, all.data(), 1, MPI_DOUBLE, 0, PETSC_COMM_WORLD));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print(const char *name, const std::vector<double> &values)
{
  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(PETSC_COMM_WORLD, ", \"%s\": [", name));
  for (std::size_t i = 0; i < values.size(); ++i)
    PetscCall(PetscPrintf(PETSC_COMM_WORLD, "%s%.1f", i ? ", " : "", values[i]));
  PetscCall(PetscPrintf(PETSC_COMM_WORLD, "]"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode measure()
{
  Run run(Registry::standard());
  Mesh mesh;
  Options options(PETSC_COMM_WORLD);
  std::vector<double> before, after;
  PetscLogDouble start, end;
  PetscBool whole = PETSC_FALSE;
  PetscInt cells;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, "-benchmark_setup", &whole, nullptr));
  PetscCall(PetscOptionsClearValue(nullptr, "-benchmark_setup"));
  PetscCall(peaks(before));
  PetscCallMPI(MPI_Barrier(PETSC_COMM_WORLD));
  PetscCall(PetscTime(&start));
  if (whole) {
    PetscCall(run.declare());
    PetscCall(run.setup());
    cells = run.scene().mesh().cells();
  } else {
    PetscCall(mesh.declare(options));
    PetscCall(mesh.read(options, false));
    cells = mesh.cells();
  }
  PetscCallMPI(MPI_Barrier(PETSC_COMM_WORLD));
  PetscCall(PetscTime(&end));
  PetscCall(peaks(after));
  PetscCall(PetscPrintf(PETSC_COMM_WORLD, "{\"cells\": %d, \"seconds\": %.3f", static_cast<int>(cells), end - start));
  PetscCall(print("before_MB", before));
  PetscCall(print("peak_MB", after));
  PetscCall(PetscPrintf(PETSC_COMM_WORLD, "}\n"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

int main(int argc, char **argv)
{
  if (PetscInitialize(&argc, &argv, nullptr, nullptr) != 0) return 1;
  int code = pulmo::initialize();
  if (code == 0) code = measure();
  if (PetscFinalize() != 0) code = 1;
  return code == 0 ? 0 : 1;
}
