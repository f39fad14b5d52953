#include "pulmo/fem/pattern.hpp"

#include "pulmo/base/huge_pages.hpp"
#include "pulmo/fem/field_blocks.hpp"
#include "pulmo/fem/row_groups.hpp"
#include "pulmo/fem/sequential_parts.hpp"

#include <algorithm>
#include <numeric>
#include <petsc/private/dmimpl.h>
#include <utility>
#include <vector>

namespace pulmo {

namespace {

/// Lists of numbers one behind the other: list i is [begin[i], begin[i + 1]).
struct Lists {
  std::vector<PetscInt> begin{0}, entries;

  const PetscInt *first(PetscInt i) const { return entries.data() + begin[i]; }
  const PetscInt *last(PetscInt i) const { return entries.data() + begin[i + 1]; }
  void close() { begin.push_back(static_cast<PetscInt>(entries.size())); }
};

/// The free dofs of a mesh point: consecutive in the global numbering.
struct FreeDofs {
  PetscInt first, n;

  bool operator<(const FreeDofs &other) const { return first < other.first; }
  bool operator==(const FreeDofs &other) const { return first == other.first; }
};

/// The rows of a matrix by mesh point.
class Pattern {
public:
  PetscErrorCode setup(DM dm);
  PetscErrorCode allocate(Mat A) const;
  PetscErrorCode fill(Mat A) const;

private:
  PetscErrorCode find_points();
  void find_neighbours();
  PetscErrorCode gather_from_others();
  PetscErrorCode merge();

  DM dm_ = nullptr;
  PetscInt end_ = 0;
  std::vector<FreeDofs> dofs_; ///< [mesh point]
  std::vector<char> owned_;    ///< [mesh point]
  Lists cells_;                ///< [cell]: mesh points with free dofs of a field
  Lists neighbours_;           ///< [mesh point]: those that share a cell of this rank with it
  Lists others_;               ///< [mesh point]: first, n of neighbours that other ranks know, one after the other
  std::vector<PetscInt> row_points_;
  std::vector<std::size_t> row_begin_{0};
  std::vector<FreeDofs> rows_; ///< [row point]: columns in ascending order
};

PetscErrorCode Pattern::setup(DM dm)
{
  PetscFunctionBeginUser;
  dm_ = dm;
  PetscCall(find_points());
  find_neighbours();
  PetscCall(gather_from_others());
  PetscCall(merge());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Pattern::find_points()
{
  PetscSection section, global;
  PetscInt begin, cell_begin, cell_end, n_fields;
  std::vector<char> coupled; // [mesh point]: has a field (dofs of none do not meet those of their cell)

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(DMGetGlobalSection(dm_, &global));
  PetscCall(PetscSectionGetChart(section, &begin, &end_));
  PetscCall(PetscSectionGetNumFields(section, &n_fields));
  PetscCheck(begin == 0, PETSC_COMM_SELF, PETSC_ERR_PLIB, "mesh points are counted from %d", (int)begin);
  dofs_.assign(end_, {0, 0});
  owned_.assign(end_, 0);
  coupled.assign(end_, 0);
  for (PetscInt p = 0; p < end_; ++p) {
    PetscInt dof, constrained, first;
    PetscCall(PetscSectionGetDof(section, p, &dof));
    PetscCall(PetscSectionGetConstraintDof(section, p, &constrained));
    if (dof == constrained) continue;
    PetscCall(PetscSectionGetOffset(global, p, &first));
    owned_[p] = first >= 0;
    dofs_[p] = {first >= 0 ? first : -(first + 1), dof - constrained};
    for (PetscInt f = 0; f < n_fields && !coupled[p]; ++f) {
      PetscCall(PetscSectionGetFieldDof(section, p, f, &dof));
      coupled[p] = dof > 0;
    }
  }
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &cell_begin, &cell_end));
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n;
    PetscCall(DMPlexGetTransitiveClosure(dm_, c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i)
      if (coupled[closure[2 * i]]) cells_.entries.push_back(closure[2 * i]);
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, c, PETSC_TRUE, &n, &closure));
    cells_.close();
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Pattern::find_neighbours()
{
  const auto n_cells = static_cast<PetscInt>(cells_.begin.size()) - 1;
  Lists cells_of; // [mesh point]
  std::vector<PetscInt> seen_by(end_, -1);

  cells_of.begin.assign(end_ + 1, 0);
  cells_of.entries.resize(cells_.entries.size());
  for (const PetscInt p : cells_.entries) ++cells_of.begin[p + 1];
  std::partial_sum(cells_of.begin.begin(), cells_of.begin.end(), cells_of.begin.begin());
  std::vector<PetscInt> next(cells_of.begin.begin(), cells_of.begin.end() - 1);
  for (PetscInt c = 0; c < n_cells; ++c)
    for (const PetscInt *p = cells_.first(c); p < cells_.last(c); ++p) cells_of.entries[next[*p]++] = c;

  for (PetscInt p = 0; p < end_; ++p) {
    const auto add = [&](PetscInt q) {
      if (seen_by[q] == p) return;
      seen_by[q] = p;
      neighbours_.entries.push_back(q);
    };
    if (dofs_[p].n > 0) add(p);
    for (const PetscInt *c = cells_of.first(p); c < cells_of.last(p); ++c)
      std::for_each(cells_.first(*c), cells_.last(*c), add);
    neighbours_.close();
  }
}

/// Each rank tells the owners of its ghost points which neighbours it knows of them.
PetscErrorCode Pattern::gather_from_others()
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSF sf, multi; // multi: one root for each ghost of a point
  SFHandle of_entries;
  SectionHandle leaf_section, root_section;
  PetscInt roots, n_leaves, multi_roots, size, *remote_offsets = nullptr;
  const PetscInt *leaves, *degree;
  std::vector<PetscInt> sent, sent_n(end_, 0), received_n;

  PetscFunctionBeginUser;
  PetscCall(DMGetPointSF(dm_, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, &n_leaves, &leaves, nullptr));
  if (roots < 0) { // one rank
    others_.begin.assign(end_ + 1, 0);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(PetscSFComputeDegreeBegin(sf, &degree));
  PetscCall(PetscSFComputeDegreeEnd(sf, &degree));
  PetscCall(PetscSFGetMultiSF(sf, &multi));
  PetscCall(PetscSFGetGraph(multi, &multi_roots, nullptr, nullptr, nullptr));
  PetscCall(PetscSectionCreate(comm, leaf_section.out()));
  PetscCall(PetscSectionSetChart(leaf_section, 0, end_));
  for (PetscInt i = 0; i < n_leaves; ++i) {
    const PetscInt p = leaves ? leaves[i] : i;
    sent_n[p] = 2 * (neighbours_.begin[p + 1] - neighbours_.begin[p]);
    PetscCall(PetscSectionSetDof(leaf_section, p, sent_n[p]));
  }
  PetscCall(PetscSectionSetUp(leaf_section));
  PetscCall(PetscSectionGetStorageSize(leaf_section, &size));
  sent.resize(size);
  for (PetscInt i = 0; i < n_leaves; ++i) {
    const PetscInt p = leaves ? leaves[i] : i;
    PetscInt place;
    PetscCall(PetscSectionGetOffset(leaf_section, p, &place));
    for (const PetscInt *q = neighbours_.first(p); q < neighbours_.last(p); ++q) {
      sent[place++] = dofs_[*q].first;
      sent[place++] = dofs_[*q].n;
    }
  }
  received_n.assign(multi_roots, 0);
  PetscCall(PetscSFReduceBegin(multi, MPIU_INT, sent_n.data(), received_n.data(), MPI_REPLACE));
  PetscCall(PetscSFReduceEnd(multi, MPIU_INT, sent_n.data(), received_n.data(), MPI_REPLACE));
  PetscCall(PetscSectionCreate(comm, root_section.out()));
  PetscCall(PetscSectionSetChart(root_section, 0, multi_roots));
  for (PetscInt i = 0; i < multi_roots; ++i) PetscCall(PetscSectionSetDof(root_section, i, received_n[i]));
  PetscCall(PetscSectionSetUp(root_section));
  PetscCall(PetscSectionGetStorageSize(root_section, &size));
  others_.entries.assign(size, 0);
  PetscCall(PetscSFCreateRemoteOffsets(multi, root_section, leaf_section, &remote_offsets));
  PetscCall(PetscSFCreateSectionSF(multi, root_section, remote_offsets, leaf_section, of_entries.out()));
  PetscCall(PetscFree(remote_offsets));
  PetscCall(PetscSFReduceBegin(of_entries, MPIU_INT, sent.data(), others_.entries.data(), MPI_REPLACE));
  PetscCall(PetscSFReduceEnd(of_entries, MPIU_INT, sent.data(), others_.entries.data(), MPI_REPLACE));
  for (PetscInt p = 0, root = 0, n = 0; p < end_; ++p) { // the roots of a point are neighbours
    for (PetscInt i = 0; p < roots && i < degree[p]; ++i) n += received_n[root++];
    others_.begin.push_back(n);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Pattern::merge()
{
  PetscFunctionBeginUser;
  for (PetscInt p = 0; p < end_; ++p)
    if (owned_[p]) row_points_.push_back(p);
  // rows in the order of their numbers: the matrix is filled from front to back
  std::sort(row_points_.begin(), row_points_.end(), [&](PetscInt p, PetscInt q) { return dofs_[p] < dofs_[q]; });
  rows_.reserve(neighbours_.entries.size());
  for (const PetscInt p : row_points_) {
    const auto start = static_cast<std::ptrdiff_t>(rows_.size());
    for (const PetscInt *q = neighbours_.first(p); q < neighbours_.last(p); ++q) rows_.push_back(dofs_[*q]);
    for (const PetscInt *q = others_.first(p); q < others_.last(p); q += 2) rows_.push_back({q[0], q[1]});
    std::sort(rows_.begin() + start, rows_.end());
    rows_.erase(std::unique(rows_.begin() + start, rows_.end()), rows_.end());
    row_begin_.push_back(rows_.size());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Pattern::allocate(Mat A) const
{
  PetscInt row_begin, row_end;

  PetscFunctionBeginUser;
  PetscCall(MatGetOwnershipRange(A, &row_begin, &row_end));
  std::vector<PetscInt> here(row_end - row_begin, 0), elsewhere(row_end - row_begin, 0);
  for (std::size_t r = 0; r < row_points_.size(); ++r) {
    const FreeDofs row = dofs_[row_points_[r]];
    PetscInt n[2] = {0, 0};
    for (std::size_t i = row_begin_[r]; i < row_begin_[r + 1]; ++i)
      n[rows_[i].first < row_begin || rows_[i].first >= row_end] += rows_[i].n;
    std::fill_n(here.begin() + (row.first - row_begin), row.n, n[0]);
    std::fill_n(elsewhere.begin() + (row.first - row_begin), row.n, n[1]);
  }
  PetscCall(MatSeqAIJSetPreallocation(A, 0, here.data()));
  PetscCall(MatMPIAIJSetPreallocation(A, 0, here.data(), 0, elsewhere.data()));

  Mat owned, foreign;
  const PetscInt *columns;
  PetscScalar *entries;
  PetscCall(sequential_parts(A, &owned, &foreign, &columns));
  PetscCall(MatSeqAIJGetArray(owned, &entries));
  prefer_huge_pages(entries, sizeof(*entries) * std::accumulate(here.begin(), here.end(), std::size_t(0)));
  PetscCall(MatSeqAIJRestoreArray(owned, &entries));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Pattern::fill(Mat A) const
{
  std::vector<PetscInt> columns;
  std::vector<PetscScalar> zeros;

  PetscFunctionBeginUser;
  for (std::size_t r = 0; r < row_points_.size(); ++r) {
    const FreeDofs row = dofs_[row_points_[r]];
    columns.clear();
    for (std::size_t i = row_begin_[r]; i < row_begin_[r + 1]; ++i)
      for (PetscInt k = 0; k < rows_[i].n; ++k) columns.push_back(rows_[i].first + k);
    if (zeros.size() < columns.size()) zeros.resize(columns.size(), 0);
    for (PetscInt i = row.first; i < row.first + row.n; ++i)
      PetscCall(MatSetValues(A, 1, &i, (PetscInt)columns.size(), columns.data(), zeros.data(), INSERT_VALUES));
  }
  PetscCall(MatAssemblyBegin(A, MAT_FINAL_ASSEMBLY));
  PetscCall(MatAssemblyEnd(A, MAT_FINAL_ASSEMBLY));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode create_matrix(DM dm, Mat *A)
{
  PetscBool aij;

  PetscFunctionBeginUser;
  PetscCall(DMSetMatrixPreallocateSkip(dm, PETSC_TRUE));
  PetscCall(DMCreateMatrix(dm, A));
  PetscCall(DMSetMatrixPreallocateSkip(dm, PETSC_FALSE));
  PetscCall(PetscObjectBaseTypeCompareAny((PetscObject)*A, &aij, MATSEQAIJ, MATMPIAIJ, ""));
  if (!aij) {
    PetscCall(MatDestroy(A));
    PetscCall(DMCreateMatrix(dm, A));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  Pattern pattern;
  PetscCall(
      PetscLogEventBegin(DM_CreateMatrix, dm, nullptr, nullptr, nullptr)); // -log_view has it under the usual name
  PetscCall(pattern.setup(dm));
  PetscCall(pattern.allocate(*A));
  PetscCall(pattern.fill(*A));
  PetscCall(group_rows(*A));
  PetscCall(copy_blocks_in_order(*A));
  PetscCall(PetscLogEventEnd(DM_CreateMatrix, dm, nullptr, nullptr, nullptr));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
