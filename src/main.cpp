// pulmo: whole-lung poromechanics.
//
//        ventilator p(t)                 momentum  int (P' - J p F^-T) : Grad eta + springs = 0
//             |                          mass      int dJ/dt q - int Q . Grad q              = 0
//   ~~~~~~~ airway ~~~~~~~               Q = -k J F^-1 F^-T Grad p
//  (   tissue u, air p    )  pleura with springs K_s
//
// mpiexec -n N pulmo -dm_plex_filename LUNG.msh -options_file SCENE.opts -options_file SOLVER.opts ...
#include "pulmo/command_line.hpp"
#include "pulmo/pulmo.hpp"

#include <cstdio>

int main(int argc, char **argv)
{
  bool finished = false;
  int rank;

  if (MPI_Init(&argc, &argv) != MPI_SUCCESS) return 1;
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  int faulty = 0;
  if (rank == 0) { // option files may be on its disk alone: PETSc reads them there, too
    const std::string fault = pulmo::command_line_fault({argv + 1, argv + argc});
    faulty = !fault.empty();
    if (faulty) std::fprintf(stderr, "pulmo: error: %s\n", fault.c_str());
  }
  MPI_Bcast(&faulty, 1, MPI_INT, 0, MPI_COMM_WORLD);
  if (faulty) {
    MPI_Finalize();
    return 1;
  }
  PetscErrorCode code = PetscInitialize(&argc, &argv, nullptr, "pulmo: whole-lung poromechanics\n");
  if (code == 0) code = pulmo::initialize();
  if (code == 0) code = pulmo::run(pulmo::Registry::standard(), finished);
  if (code != 0 && code != PETSC_ERR_USER_INPUT) (void)MPI_Abort(PETSC_COMM_WORLD, 2); // maybe not on all ranks
  if (PetscFinalize() != 0) finished = false;
  MPI_Finalize();
  return code == 0 && finished ? 0 : 1;
}
