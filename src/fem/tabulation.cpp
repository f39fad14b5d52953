#include "pulmo/fem/tabulation.hpp"

namespace pulmo::element {

std::size_t fields_scratch(PetscInt n, PetscTabulation *T, PetscInt replicas)
{
  std::size_t size = 0;
  for (PetscInt f = 0; f < n; ++f)
    size += 4 * Scratch::padded(static_cast<std::size_t>(replicas * T[f]->Np * (T[f]->Nb + 4)));
  return size;
}

PetscErrorCode make_fields(PetscDS ds, PetscTabulation *T, PetscInt replica, Scratch &scratch, TabulatedFields &fields)
{
  PetscFunctionBeginUser;
  PetscCall(PetscDSGetNumFields(ds, &fields.n));
  PetscCheck(fields.n <= max_fields, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d fields", (int)max_fields);
  fields.points = T[0]->Np;
  fields.uOff[0] = fields.uOff_x[0] = fields.element_size = 0;
  for (PetscInt f = 0; f < fields.n; ++f) {
    ScalarBasis &basis = fields.basis[f];
    const PetscInt Nc = T[f]->Nc, Nb = T[f]->Nb, Np = T[f]->Np;
    PetscCheck(Np == fields.points, PETSC_COMM_SELF, PETSC_ERR_ARG_INCOMP, "fields differ in their quadrature");
    PetscCheck(Nb / Nc <= max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d nodes", max_nodes);
    PetscCheck(Nc <= max_components, PETSC_COMM_SELF, PETSC_ERR_SUP, "more than %d components", (int)max_components);
    basis.components = Nc;
    basis.nodes = Nb / Nc;
    basis.stride = (basis.nodes + 3) / 4 * 4;
    basis.offset = fields.element_size;
    PetscScalar *B = scratch.take(Np * basis.stride), *D = scratch.take(Np * dim * basis.stride);
    for (PetscInt q = 0; q < Np; ++q) {
      for (PetscInt a = 0; a < basis.nodes; ++a) {
        const PetscInt row = ((replica * Np + q) * Nb + a * Nc) * Nc; // component 0 of node a
        B[q * basis.stride + a] = T[f]->T[0][row];
        for (PetscInt d = 0; d < dim; ++d) D[(q * dim + d) * basis.stride + a] = T[f]->T[1][row * dim + d];
      }
    }
    basis.values = B;
    basis.derivatives = D;
    fields.element_size += Nb;
    fields.uOff[f + 1] = fields.uOff[f] + Nc;
    fields.uOff_x[f + 1] = fields.uOff_x[f] + Nc * dim;
  }
  fields.total_components = fields.uOff[fields.n];
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::element
