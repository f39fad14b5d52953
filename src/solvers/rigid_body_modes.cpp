#include "pulmo/solvers/rigid_body_modes.hpp"

#include "pulmo/fem/free_dofs.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/physics/point.hpp"

namespace pulmo {

namespace {

PetscErrorCode make_modes(DM dm, PetscInt, PetscInt field, MatNullSpace *modes)
{
  PetscFunctionBeginUser;
  PetscCall(create_rigid_body_modes(dm, field, modes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode create_rigid_body_modes(DM dm, PetscInt f, MatNullSpace *modes)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscSection section, global;
  PetscInt begin, end, size;
  Vec v[6];

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMGetGlobalSection(dm, &global));
  PetscCall(PetscSectionGetConstrainedStorageSize(global, &size));
  for (Vec &mode : v) PetscCall(VecCreateMPI(comm, size, PETSC_DETERMINE, &mode));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  std::vector<PetscInt> dofs;
  std::vector<std::array<PetscReal, 3>> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    bool owned = false;
    PetscCall(free_dofs(section, global, p, f, dofs, owned));
    if (!owned) continue;
    PetscCall(node_coordinates(dm, p, static_cast<PetscInt>(dofs.size()) / 3, nodes));
    for (std::size_t i = 0; i < dofs.size(); ++i) {
      const std::size_t d = i % 3, next = (d + 1) % 3, last = (d + 2) % 3;
      const auto &x = nodes[i / 3];
      if (dofs[i] < 0) continue;
      PetscCall(VecSetValue(v[d], dofs[i], 1, INSERT_VALUES)); // rotation about axis k moves along k+1 by -x[k+2], ...
      PetscCall(VecSetValue(v[3 + last], dofs[i], -x[next], INSERT_VALUES));
      PetscCall(VecSetValue(v[3 + next], dofs[i], x[last], INSERT_VALUES));
    }
  }
  for (Vec mode : v) {
    PetscCall(VecAssemblyBegin(mode));
    PetscCall(VecAssemblyEnd(mode));
  }
  // orthonormal, as MatNullSpace wants them
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j < i; ++j) {
      PetscScalar dot;
      PetscCall(VecDot(v[i], v[j], &dot));
      PetscCall(VecAXPY(v[i], -dot, v[j]));
    }
    PetscCall(VecNormalize(v[i], nullptr));
  }
  PetscCall(MatNullSpaceCreate(comm, PETSC_FALSE, 6, v, modes));
  for (Vec &mode : v) PetscCall(VecDestroy(&mode));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode attach_rigid_body_modes(DM dm)
{
  const PetscInt field = displacement;
  PetscInt n_fields;

  PetscFunctionBeginUser;
  PetscCall(DMGetNumFields(dm, &n_fields));
  if (n_fields == 1) {
    PetscCall(DMSetNearNullSpaceConstructor(dm, displacement, make_modes));
  } else { // a split takes them from the discretisation of its field
    DMHandle sub;
    PetscObject element;
    MatNullSpace modes;
    PetscCall(DMCreateSubDM(dm, 1, &field, nullptr, sub.out()));
    PetscCall(make_modes(sub, field, 0, &modes));
    PetscCall(DMGetField(dm, field, nullptr, &element));
    PetscCall(PetscObjectCompose(element, "nearnullspace", (PetscObject)modes));
    PetscCall(MatNullSpaceDestroy(&modes));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
