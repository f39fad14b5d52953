#include "pulmo/fem/free_dofs.hpp"

#include <algorithm>

namespace pulmo {

PetscErrorCode free_dofs(PetscSection section, PetscSection global, PetscInt point, PetscInt f,
                         std::vector<PetscInt> &dofs, bool &owned)
{
  PetscInt n, offset, field_offset, first, constrained;
  const PetscInt *which = nullptr;

  PetscFunctionBeginUser;
  PetscCall(PetscSectionGetFieldDof(section, point, f, &n));
  dofs.resize(static_cast<std::size_t>(n));
  if (n == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscSectionGetOffset(section, point, &offset));
  PetscCall(PetscSectionGetFieldOffset(section, point, f, &field_offset));
  PetscCall(PetscSectionGetOffset(global, point, &first));
  owned = first >= 0;
  if (!owned) first = -(first + 1);
  PetscCall(PetscSectionGetConstraintDof(section, point, &constrained));
  if (constrained) PetscCall(PetscSectionGetConstraintIndices(section, point, &which));
  for (PetscInt d = 0; d < n; ++d) {
    const PetscInt local = field_offset - offset + d; // among the dofs of the point
    const auto before = std::count_if(which, which + constrained, [&](PetscInt c) { return c < local; });
    const bool held = std::find(which, which + constrained, local) != which + constrained;
    dofs[d] = held ? -1 : first + local - static_cast<PetscInt>(before);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
