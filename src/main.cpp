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
#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

namespace {

/// PETSc reports an unreadable -options_file with a stack trace; this finds the first one (also in the files that
/// are read) so that it can be said in a sentence. Empty if all can be read.
std::string unreadable_options_file(const std::vector<std::string> &words, int depth = 0)
{
  constexpr int deepest = 16; // files that ask for one another without end
  for (std::size_t i = 0; i + 1 < words.size(); ++i) {
    if (words[i] != "-options_file") continue;
    std::ifstream file(words[i + 1]);
    if (!file || std::filesystem::is_directory(words[i + 1]) || depth == deepest) return words[i + 1];
    std::vector<std::string> inside;
    for (std::string line; std::getline(file, line);) {
      std::istringstream stream(line.substr(0, line.find('#')));
      for (std::string word; stream >> word;) inside.push_back(word);
    }
    const std::string lost = unreadable_options_file(inside, depth + 1);
    if (!lost.empty()) return lost;
  }
  return "";
}

} // namespace

int main(int argc, char **argv)
{
  bool finished = false;
  int rank;

  if (MPI_Init(&argc, &argv) != MPI_SUCCESS) return 1;
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  const std::string lost = unreadable_options_file({argv + 1, argv + argc});
  if (!lost.empty()) {
    if (rank == 0)
      std::fprintf(stderr, "pulmo: error: -options_file %s cannot be read; check its name\n", lost.c_str());
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
