// Runs scenes as the program does, by the installed library.
#include <pulmo/pulmo.hpp>

int main(int argc, char **argv)
{
  bool finished = false;
  PetscErrorCode code = PetscInitialize(&argc, &argv, nullptr, nullptr);
  if (code == 0) code = pulmo::initialize();
  if (code == 0) code = pulmo::run(pulmo::Registry::standard(), finished);
  if (PetscFinalize() != 0) finished = false;
  return code == 0 && finished ? 0 : 1;
}
