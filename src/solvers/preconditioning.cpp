#include "pulmo/solvers/preconditioning.hpp"

#include "pulmo/input/errors.hpp"

namespace pulmo {

PetscErrorCode wanted_pc(MPI_Comm comm, std::string &type)
{
  char text[64] = "";
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-pc_type", text, sizeof(text), &given));
  PulmoUserCheck(
      given, comm,
      "no linear solver: give a solver file, e.g. -options_file petsc_options/solvers/direct.opts (or -pc_type)");
  type = text;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode precondition_one_field(KSP ksp)
{
  std::string type;
  PC pc;

  PetscFunctionBeginUser;
  PetscCall(wanted_pc(PetscObjectComm((PetscObject)ksp), type));
  if (type != PCFIELDSPLIT) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(KSPGetPC(ksp, &pc));
  PetscCall(PCSetOptionsPrefix(pc, "fieldsplit_displacement_"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
