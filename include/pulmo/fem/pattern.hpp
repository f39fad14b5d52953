/// @file
/// Matrices with their exact sparsity pattern, found from the cells of the mesh.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// A matrix for the fields of @p dm (sections complete), of type -dm_mat_type: as DMCreateMatrix makes it, in a tenth
/// of its time. All fields of the mesh points of a cell couple, also those that another rank's cells add to a row of
/// this rank; a dof of no field has its diagonal block only. All entries are there and zero. Types other than AIJ are
/// left to DMCreateMatrix.
PetscErrorCode create_matrix(DM dm, Mat *A);

} // namespace pulmo
