#include "pulmo/fem/tabulation.hpp"

namespace pulmo::element {

namespace {

/// Copies component 0 of PETSc's tabulation to rows of @p stride. @p replica: the face of the reference cell, 0 for
/// cells.
void copy_component(const PetscTabulation T, PetscInt replica, PetscInt stride, PetscScalar *values,
                    PetscScalar *derivatives)
{
  for (PetscInt q = 0; q < T->Np; ++q)
    for (PetscInt a = 0; a < T->Nb / T->Nc; ++a) {
      const PetscInt row = ((replica * T->Np + q) * T->Nb + a * T->Nc) * T->Nc; // component 0 of node a
      values[q * stride + a] = T->T[0][row];
      for (PetscInt d = 0; d < dim; ++d) derivatives[(q * dim + d) * stride + a] = T->T[1][row * dim + d];
    }
}

/// Entries of a row that nodes take.
PetscInt padded_stride(PetscInt nodes)
{
  return (nodes + 3) / 4 * 4;
}

} // namespace

PetscErrorCode BasisTable::setup(PetscFE fe, const std::vector<PetscReal> &xi)
{
  PetscTabulation T;

  PetscFunctionBeginUser;
  PetscCall(PetscFECreateTabulation(fe, 1, static_cast<PetscInt>(xi.size()) / dim, xi.data(), 1, &T));
  components_ = T->Nc;
  nodes_ = T->Nb / T->Nc; // a vector field repeats the scalar basis for each component
  PetscCheck(nodes_ <= max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d nodes", max_nodes);
  stride_ = padded_stride(nodes_);
  values_.assign(static_cast<std::size_t>(T->Np * stride_), 0);
  derivatives_.assign(static_cast<std::size_t>(T->Np * dim * stride_), 0);
  copy_component(T, 0, stride_, values_.data(), derivatives_.data());
  PetscCall(PetscTabulationDestroy(&T));
  PetscFunctionReturn(PETSC_SUCCESS);
}

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
    basis.stride = padded_stride(basis.nodes);
    basis.offset = fields.element_size;
    PetscScalar *B = scratch.take(Np * basis.stride), *D = scratch.take(Np * dim * basis.stride);
    copy_component(T[f], replica, basis.stride, B, D);
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
