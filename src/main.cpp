// pulmo: whole-lung poromechanics.
//
//        ventilator p(t)                 momentum  int (P' - J p F^-T) : Grad eta + springs = 0
//             |                          mass      int dJ/dt q - int Q . Grad q              = 0
//   ~~~~~~~ airway ~~~~~~~               Q = -k J F^-1 F^-T Grad p
//  (   tissue u, air p    )  pleura with springs K_s
//
// mpiexec -n N pulmo -dm_plex_filename LUNG.msh -options_file SCENE.opts -options_file SOLVER.opts ...
#include "pulmo/pulmo.hpp"

#include <cstdio>
#include <cstring>

namespace {

/// PETSc reports an unreadable -options_file with a stack trace; say it in a sentence before it starts.
bool options_files_readable(int argc, char **argv)
{
  for (int i = 1; i + 1 < argc; ++i) {
    if (std::strcmp(argv[i], "-options_file") != 0) continue;
    std::FILE *f = std::fopen(argv[i + 1], "r");
    if (!f) {
      std::fprintf(stderr, "pulmo: error: -options_file %s cannot be read; check its name\n", argv[i + 1]);
      return false;
    }
    std::fclose(f);
  }
  return true;
}

} // namespace

int main(int argc, char **argv)
{
  bool finished = false;

  if (!options_files_readable(argc, argv)) return 1;
  if (PetscInitialize(&argc, &argv, nullptr, "pulmo: whole-lung poromechanics\n") != 0) return 1;
  PetscErrorCode code = pulmo::initialize();
  if (code == 0) code = pulmo::run(pulmo::Registry::standard(), finished);
  if (code != 0 && code != PETSC_ERR_USER_INPUT) (void)MPI_Abort(PETSC_COMM_WORLD, 2); // maybe not on all ranks
  if (PetscFinalize() != 0) return 1;
  return code == 0 && finished ? 0 : 1;
}
