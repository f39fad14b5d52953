#include "pulmo/solvers/p1_space.hpp"

#include "pulmo/base/simd.hpp"
#include "pulmo/fem/free_dofs.hpp"
#include "pulmo/fem/pattern.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/physics/point.hpp"

#include <algorithm>

namespace pulmo {

PetscErrorCode create_p1_space(DM dm, DM *p1)
{
  PetscSection fine;
  SectionHandle coarse;
  PetscInt begin, end, vertex_begin, vertex_end;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &fine));
  PetscCall(PetscSectionGetChart(fine, &begin, &end));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  PetscCall(PetscSectionCreate(PetscObjectComm((PetscObject)dm), coarse.out()));
  PetscCall(PetscSectionSetNumFields(coarse, 1));
  PetscCall(PetscSectionSetFieldComponents(coarse, 0, 3));
  PetscCall(PetscSectionSetChart(coarse, begin, end));
  for (PetscInt p = vertex_begin; p < vertex_end; ++p) {
    PetscInt n;
    PetscCall(PetscSectionSetDof(coarse, p, 3));
    PetscCall(PetscSectionSetFieldDof(coarse, p, 0, 3));
    PetscCall(PetscSectionGetFieldConstraintDof(fine, p, displacement, &n));
    PetscCall(PetscSectionSetConstraintDof(coarse, p, n));
    PetscCall(PetscSectionSetFieldConstraintDof(coarse, p, 0, n));
  }
  PetscCall(PetscSectionSetUp(coarse));
  for (PetscInt p = vertex_begin; p < vertex_end; ++p) {
    PetscInt n;
    const PetscInt *which;
    PetscCall(PetscSectionGetFieldConstraintDof(fine, p, displacement, &n));
    if (n == 0) continue;
    PetscCall(PetscSectionGetFieldConstraintIndices(fine, p, displacement, &which));
    PetscCall(PetscSectionSetConstraintIndices(coarse, p, which));
    PetscCall(PetscSectionSetFieldConstraintIndices(coarse, p, 0, which));
  }
  PetscCall(DMClone(dm, p1));
  PetscCall(DMSetLocalSection(*p1, coarse));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_p1_interpolation(DM dm, DM p1, PetscInt block_size, Mat *P)
{
  PetscSection fine, fine_global, coarse, coarse_global;
  PetscInt begin, end, rows, columns;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &fine));
  PetscCall(DMGetGlobalSection(dm, &fine_global));
  PetscCall(DMGetLocalSection(p1, &coarse));
  PetscCall(DMGetGlobalSection(p1, &coarse_global));
  PetscCall(PetscSectionGetChart(fine, &begin, &end));
  PetscCall(PetscSectionGetConstrainedStorageSize(fine_global, &rows));
  PetscCall(PetscSectionGetConstrainedStorageSize(coarse_global, &columns));

  PetscCall(MatCreate(PetscObjectComm((PetscObject)dm), P));
  PetscCall(MatSetSizes(*P, rows, columns, PETSC_DETERMINE, PETSC_DETERMINE));
  if (block_size == 3) PetscCall(MatSetBlockSizes(*P, 3, 3));
  PetscCall(MatSetType(*P, MATAIJ));
  PetscCall(MatSeqAIJSetPreallocation(*P, 3, nullptr));
  PetscCall(MatMPIAIJSetPreallocation(*P, 3, nullptr, 3, nullptr));
  std::vector<PetscInt> row, column;
  std::vector<ElementNode> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    bool owned = false, unused;
    PetscCall(free_dofs(fine, fine_global, p, displacement, row, owned));
    if (!owned) continue;
    PetscCall(nodes_at(dm, p, static_cast<PetscInt>(row.size()) / 3, nodes));
    for (std::size_t k = 0; k < nodes.size(); ++k)
      for (PetscInt i = 0; i < nodes[k].n; ++i) {
        PetscCall(free_dofs(coarse, coarse_global, nodes[k].vertices[i], 0, column, unused));
        for (std::size_t d = 0; d < 3; ++d)
          if (row[3 * k + d] >= 0 && column[d] >= 0)
            PetscCall(MatSetValue(*P, row[3 * k + d], column[d], nodes[k].weights[i], INSERT_VALUES));
      }
  }
  PetscCall(MatAssemblyBegin(*P, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(*P, MAT_FINAL_ASSEMBLY));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode P1Matrix::setup(DM dm, const Assembly &assembly, bool &fits)
{
  const CellLayout &cells = assembly.layout();
  PetscSection section;
  PetscInt vertex_begin, vertex_end;

  PetscFunctionBeginUser;
  PetscCall(check(dm, fits));
  if (!fits) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(create_p1_space(dm, space_.out()));
  PetscCall(create_matrix(space_, matrix_.out()));
  PetscCall(find_shares(dm, cells));
  layout_.cells = cells.cells;
  layout_.size = size;
  layout_.points = vertices;
  layout_.field_of.assign(size, 0);
  for (PetscInt i = 0; i < size; ++i) layout_.point_of.push_back(i / 3);
  PetscCall(DMGetLocalSection(space_, &section));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  for (PetscInt c = 0; c < cells.cells; ++c)
    for (PetscInt i = 0; i < cells.points; ++i) {
      const PetscInt point = cells.cell_points(c)[i];
      PetscInt offset;
      if (point < vertex_begin || point >= vertex_end) continue;
      PetscCall(PetscSectionGetOffset(section, point, &offset));
      layout_.of_cell.push_back(point);
      for (PetscInt d = 0; d < 3; ++d) layout_.dofs.push_back(offset + d);
    }
  PetscCall(map_.setup(space_, layout_, matrix_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode P1Matrix::check(DM dm, bool &fits) const
{
  PetscSection section;
  PetscInt begin, end;
  std::vector<ElementNode> nodes;
  int fit = 1;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  for (PetscInt p = begin; p < end && fit; ++p) {
    PetscInt n, held;
    PetscCall(PetscSectionGetFieldDof(section, p, displacement, &n));
    PetscCall(PetscSectionGetFieldConstraintDof(section, p, displacement, &held));
    if (held == 0) continue;
    fit = held == n;
    PetscCall(nodes_at(dm, p, n / 3, nodes));
    for (const ElementNode &node : nodes)
      for (PetscInt i = 0; i < node.n; ++i) {
        PetscCall(PetscSectionGetFieldConstraintDof(section, node.vertices[i], displacement, &held));
        fit = fit && held == 3;
      }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &fit, 1, MPI_INT, MPI_LAND, PetscObjectComm((PetscObject)dm)));
  fits = fit;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Looks at the first cell: all others see their nodes in the same places of the reference cell.
PetscErrorCode P1Matrix::find_shares(DM dm, const CellLayout &cells)
{
  PetscSection section;
  PetscInt vertex_begin, vertex_end;
  std::vector<PetscInt> corners;
  std::vector<ElementNode> nodes;

  PetscFunctionBeginUser;
  width_ = cells.size;
  PetscCheck(cells.size <= 3 * max_nodes, PETSC_COMM_SELF, PETSC_ERR_SUP, "elements with more than %d nodes",
             max_nodes);
  n_u_ = static_cast<PetscInt>(std::count(cells.field_of.begin(), cells.field_of.end(), displacement));
  if (cells.cells == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  for (PetscInt i = 0; i < cells.points; ++i) {
    const PetscInt point = cells.cell_points(0)[i];
    if (point >= vertex_begin && point < vertex_end) corners.push_back(point);
  }
  for (PetscInt node = 0; node < n_u_ / 3; ++node) {
    const PetscInt point = cells.cell_points(0)[cells.point_of[3 * node]];
    PetscInt n, offset;
    PetscCall(PetscSectionGetFieldDof(section, point, displacement, &n));
    PetscCall(PetscSectionGetFieldOffset(section, point, displacement, &offset));
    PetscCall(nodes_at(dm, point, n / 3, nodes));
    const ElementNode &at = nodes[(cells.cell_dofs(0)[3 * node] - offset) / 3];
    for (PetscInt i = 0; i < at.n; ++i) {
      const auto corner = std::find(corners.begin(), corners.end(), at.vertices[i]) - corners.begin();
      shares_[corner].push_back({node, at.weights[i]});
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode P1Matrix::begin()
{
  PetscFunctionBeginUser;
  PetscCall(MatZeroEntries(matrix_));
  PetscCall(map_.begin());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode P1Matrix::add(PetscInt c, ElementOf, const PetscScalar *matrix, const PetscReal row_scale[],
                             bool transposed)
{
  Vector4 row_sums[3 * max_nodes][vertices]; // three components and one without meaning
  PetscScalar result[size * size];

  PetscFunctionBeginHot;
  for (PetscInt i = 0; i < n_u_; ++i) {
    const PetscScalar *row = matrix + i * width_;
    for (PetscInt v = 0; v < vertices; ++v) {
      Vector4 sum{};
      for (const Share &s : shares_[v])
        sum += s.weight * Vector4{row[3 * s.node], row[3 * s.node + 1], row[3 * s.node + 2], 0};
      row_sums[i][v] = sum;
    }
  }
  for (PetscInt i = 0; i < size; ++i)
    for (PetscInt v = 0; v < vertices; ++v) {
      Vector4 sum{};
      for (const Share &s : shares_[i / 3]) sum += s.weight * row_sums[3 * s.node + i % 3][v];
      for (PetscInt d = 0; d < 3; ++d) result[i * size + 3 * v + d] = sum[d];
    }
  if (transposed)
    for (PetscInt i = 0; i < size; ++i)
      for (PetscInt j = 0; j < i; ++j) std::swap(result[i * size + j], result[j * size + i]);
  PetscCall(map_.add(c, result, &row_scale[displacement], matrix_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode P1Matrix::end(const std::vector<PetscInt> &)
{
  PetscFunctionBeginUser;
  PetscCall(map_.end(matrix_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
