// main() of every GoogleTest program: PETSc first, then the tests; a failing rank ends all ranks.
#include "pulmo/pulmo.hpp"

#include <gtest/gtest.h>

int main(int argc, char **argv)
{
  ::testing::InitGoogleTest(&argc, argv);
  if (PetscInitialize(&argc, &argv, nullptr, nullptr) != 0) return 1;
  int result = pulmo::initialize() == 0 ? RUN_ALL_TESTS() : 1;
  if (PetscFinalize() != 0) result = 1;
  return result;
}
