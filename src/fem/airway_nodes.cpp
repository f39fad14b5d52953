// The airway's nodes and the rows where scalar unknowns live.
#include "pulmo/fem/airway_nodes.hpp"

#include "pulmo/input/errors.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/shared_points.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <set>

namespace pulmo {

namespace {

/// Nodes that hold one value by different sums differ by less than this share of it.
constexpr PetscReal rounding = 1e-14;

/// Copies a section, with room for @p more dofs of no field at the point @p at.
PetscErrorCode widen(PetscSection section, PetscInt at, PetscInt more, PetscSection *wider)
{
  PetscInt begin, end, n_fields, dof;

  PetscFunctionBeginUser;
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  PetscCall(PetscSectionGetNumFields(section, &n_fields));
  PetscCall(PetscSectionCreate(PetscObjectComm((PetscObject)section), wider));
  PetscCall(PetscSectionSetNumFields(*wider, n_fields));
  PetscCall(PetscSectionSetChart(*wider, begin, end));
  for (PetscInt f = 0; f < n_fields; ++f) {
    PetscInt components;
    const char *name;
    PetscCall(PetscSectionGetFieldComponents(section, f, &components));
    PetscCall(PetscSectionSetFieldComponents(*wider, f, components));
    PetscCall(PetscSectionGetFieldName(section, f, &name));
    PetscCall(PetscSectionSetFieldName(*wider, f, name));
  }
  for (PetscInt p = begin; p < end; ++p) {
    PetscCall(PetscSectionGetDof(section, p, &dof));
    PetscCall(PetscSectionSetDof(*wider, p, dof + (p == at ? more : 0)));
    PetscCall(PetscSectionGetConstraintDof(section, p, &dof));
    PetscCall(PetscSectionSetConstraintDof(*wider, p, dof));
    for (PetscInt f = 0; f < n_fields; ++f) {
      PetscCall(PetscSectionGetFieldDof(section, p, f, &dof));
      PetscCall(PetscSectionSetFieldDof(*wider, p, f, dof));
      PetscCall(PetscSectionGetFieldConstraintDof(section, p, f, &dof));
      PetscCall(PetscSectionSetFieldConstraintDof(*wider, p, f, dof));
    }
  }
  PetscCall(PetscSectionSetUp(*wider));
  for (PetscInt p = begin; p < end; ++p) {
    const PetscInt *which;
    PetscCall(PetscSectionGetConstraintDof(section, p, &dof));
    if (dof == 0) continue;
    PetscCall(PetscSectionGetConstraintIndices(section, p, &which));
    PetscCall(PetscSectionSetConstraintIndices(*wider, p, which));
    for (PetscInt f = 0; f < n_fields; ++f) {
      PetscCall(PetscSectionGetFieldConstraintIndices(section, p, f, &which));
      PetscCall(PetscSectionSetFieldConstraintIndices(*wider, p, f, which));
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The facets of this rank that @p part has.
PetscErrorCode facets_of(const Mesh &mesh, const SurfacePart &part, std::vector<PetscInt> &facets)
{
  std::vector<Mesh::Region> regions;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(mesh.facets(part.surface, facets));
  if (part.region.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(mesh.regions(regions));
  PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
  std::vector<bool> inside(static_cast<std::size_t>(end - begin), false);
  for (const Mesh::Region &region : regions)
    if (region.name == part.region)
      for (const PetscInt cell : region.cells) inside[cell] = true;
  std::vector<PetscInt> all = std::move(facets);
  facets.clear();
  for (const PetscInt facet : all) {
    const PetscInt *cells;
    PetscCall(DMPlexGetSupport(mesh.dm(), facet, &cells));
    if (inside[cells[0] - begin]) facets.push_back(facet);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode AirwayNodes::add_rows(DM dm, PetscInt scalars, PetscInt block, SectionHandle &section)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  SectionHandle wider;
  PetscInt cell_begin, cell_end;
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  PetscMPIInt first = cell_end > cell_begin ? rank : PETSC_MPI_INT_MAX;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &first, 1, MPI_INT, MPI_MIN, comm));
  own_rank_ = first;
  own_rows_ = (scalars + block - 1) / block * block; // whole blocks, so that the matrix keeps its block size
  PetscCall(widen(section, rank == first ? cell_begin : -1, own_rows_, wider.out()));
  section = std::move(wider);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::setup(DM dm, const Mesh &mesh, const Elements &elements, const std::vector<Group> &groups,
                                  const std::vector<std::string> &open, const std::vector<bool> &held_as_airway,
                                  PetscInt scalars)
{
  PetscSection section, global;
  PetscInt begin, end;
  std::vector<PetscInt> facets;
  std::map<PetscInt, PetscReal> share; // of a mesh point, mm^2

  PetscFunctionBeginUser;
  comm_ = PetscObjectComm((PetscObject)dm);
  groups_ = groups;
  value_.assign(static_cast<std::size_t>(std::max<PetscInt>(scalars, 1)), 0);
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMGetGlobalSection(dm, &global)); // made here, used by DMPlexGetPointGlobalField
  PetscCall(DMPlexGetChart(dm, &begin, &end));
  const auto n_groups = static_cast<PetscInt>(groups.size());
  std::vector<PetscInt> last(static_cast<std::size_t>(end), -1), first(last.size(), n_groups); // group of a mesh point
  std::set<PetscInt> found;
  for (std::size_t g = 0; g < groups.size(); ++g)
    for (const SurfacePart &part : groups[g].surfaces) {
      PetscCall(facets_of(mesh, part, facets));
      auto n = static_cast<PetscInt>(facets.size());
      PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &n, 1, MPIU_INT, MPI_SUM, comm_));
      PulmoUserCheck(n > 0, comm_, "branch '%s' ends at %s, which has no facets: no gas gets into the lung there",
                     groups[g].name.c_str(), part.text().c_str());
      found.insert(facets.begin(), facets.end());
      for (PetscInt facet : facets) {
        PetscInt *closure = nullptr, n_closure;
        PetscReal area;
        PetscCall(DMPlexComputeCellGeometryFVM(dm, facet, &area, nullptr, nullptr));
        PetscCall(DMPlexGetTransitiveClosure(dm, facet, PETSC_TRUE, &n_closure, &closure));
        // the face, its edges, its vertices: a third each for the vertices of P1, for the edges of P2
        const PetscInt nodes = elements.pressure_degree == 1 ? 4 : 1;
        for (PetscInt j = nodes; j < nodes + 3; ++j) share[closure[2 * j]] += area / 3;
        for (PetscInt j = 0; j < n_closure; ++j) {
          const PetscInt p = closure[2 * j];
          last[p] = std::max(last[p], static_cast<PetscInt>(g));
          first[p] = std::min(first[p], static_cast<PetscInt>(g));
        }
        PetscCall(DMPlexRestoreTransitiveClosure(dm, facet, PETSC_TRUE, &n_closure, &closure));
      }
    }
  PetscReal left_out = 0; // mm^2
  for (const std::string &surface : open) {
    PetscCall(mesh.facets(surface, facets));
    for (PetscInt facet : facets) {
      PetscReal area;
      if (found.count(facet) > 0) continue;
      PetscCall(DMPlexComputeCellGeometryFVM(dm, facet, &area, nullptr, nullptr));
      left_out += area;
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &left_out, 1, MPIU_REAL, MPI_SUM, comm_));
  PulmoUserCheck(left_out == 0, comm_,
                 "%.4g mm^2 of the airway are fed by no branch of -airway_tree; give each surface of "
                 "-airflow_surfaces, and each part of "
                 "the volume that it belongs to, a branch",
                 (double)left_out);
  // a node may be on a rank that has none of the surface's facets
  PetscCall(combine_shared(dm, MPI_MAX, last));
  PetscCall(combine_shared(dm, MPI_MIN, first));
  PetscInt two[2] = {-1, -1};
  for (PetscInt p = begin; p < end; ++p)
    if (last[p] > first[p]) {
      two[0] = first[p];
      two[1] = last[p];
    }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, two, 2, MPIU_INT, MPI_MAX, comm_));
  PulmoUserCheck(two[0] < 0, comm_,
                 "branches '%s' and '%s' end at parts of the airway that touch (%s, %s), and a node cannot have the "
                 "pressure of both; leave facets of another surface between them, or give them one branch",
                 groups[std::max<PetscInt>(two[0], 0)].name.c_str(), groups[std::max<PetscInt>(two[1], 0)].name.c_str(),
                 groups[std::max<PetscInt>(two[0], 0)].surfaces.front().text().c_str(),
                 groups[std::max<PetscInt>(two[1], 0)].surfaces.front().text().c_str());
  for (PetscInt p = begin; p < end && !groups.empty(); ++p) {
    PetscInt dof, offset, row, row_end;
    if (!held_as_airway[p] || last[p] < 0) continue;
    PetscCall(PetscSectionGetFieldDof(section, p, pressure, &dof));
    if (dof == 0) continue;
    PetscCall(PetscSectionGetFieldOffset(section, p, pressure, &offset));
    PetscCall(DMPlexGetPointGlobalField(dm, p, pressure, &row, &row_end));
    nodes_.push_back({p, offset, row < 0 ? -1 : row, last[p], share.count(p) ? share[p] : 0});
  }
  area_ = 0;
  for (const Node &node : nodes_) {
    area_ += node.area;
    if (node.row >= 0) closed_.push_back({node.row, static_cast<PetscInt>(scalar_of(node))});
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &area_, 1, MPIU_REAL, MPI_SUM, comm_));
  PetscMPIInt rank;
  PetscCallMPI(MPI_Comm_rank(comm_, &rank));
  if (own_rows_ > 0 && rank == own_rank_) {
    PetscInt cell, offset, dof;
    PetscCall(DMPlexGetHeightStratum(dm, 0, &cell, nullptr));
    PetscCall(PetscSectionGetOffset(global, cell, &offset));
    PetscCall(PetscSectionGetDof(global, cell, &dof));
    for (PetscInt d = 0; d < own_rows_; ++d) closed_.push_back({offset + dof - own_rows_ + d, -1});
  }
  Vec X;
  PetscCall(DMGetGlobalVector(dm, &X));
  PetscCall(VecGetOwnershipRange(X, &first_, nullptr));
  PetscCall(DMRestoreGlobalVector(dm, &X));
  PetscCall(find_homes(scalars));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The pressure of a group lives in the first row of that group, on the first rank that has one; the others in the rows
/// that are left, rank by rank.
PetscErrorCode AirwayNodes::find_homes(PetscInt scalars)
{
  PetscMPIInt rank, size;
  std::vector<bool> taken(closed_.size(), false);

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm_, &rank));
  PetscCallMPI(MPI_Comm_size(comm_, &size));
  homes_.assign(static_cast<std::size_t>(scalars), -1);
  std::vector<PetscMPIInt> first(homes_.size(), PETSC_MPI_INT_MAX);
  for (const ClosedRow &closed : closed_)
    if (closed.scalar >= 0 && closed.scalar < scalars) first[closed.scalar] = rank;
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, first.data(), static_cast<PetscMPIInt>(first.size()), MPI_INT, MPI_MIN, comm_));
  for (std::size_t i = 0; i < closed_.size(); ++i) {
    const PetscInt s = closed_[i].scalar;
    if (s < 0 || s >= scalars || first[s] != rank || homes_[s] >= 0) continue;
    homes_[s] = closed_[i].row;
    taken[i] = true;
  }
  const auto left = static_cast<PetscInt>(std::count(taken.begin(), taken.end(), false));
  PetscInt before = 0, all = left;
  PetscCallMPI(MPI_Exscan(&left, &before, 1, MPIU_INT, MPI_SUM, comm_));
  if (rank == 0) before = 0;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &all, 1, MPIU_INT, MPI_SUM, comm_));
  const auto homeless = static_cast<PetscInt>(std::count(first.begin(), first.end(), PETSC_MPI_INT_MAX));
  homeless_ = std::max<PetscInt>(homeless - all, 0);
  PetscInt next = 0; // of the rows that are left, and of the scalars without a home, both counted over all ranks
  std::vector<PetscInt> free;
  for (std::size_t i = 0; i < closed_.size(); ++i)
    if (!taken[i]) free.push_back(static_cast<PetscInt>(i));
  for (PetscInt s = 0; s < scalars; ++s) {
    if (first[s] != PETSC_MPI_INT_MAX) continue;
    const PetscInt place = next++ - before;
    if (place < 0 || place >= left) continue;
    ClosedRow &closed = closed_[free[place]];
    closed.scalar = s;
    homes_[s] = closed.row;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void AirwayNodes::constrain(WriteArray &local) const
{
  if (!held_) return;
  for (const Node &node : nodes_) local[node.dof] = value_[scalar_of(node)];
}

void AirwayNodes::constrain_rate(const ReadArray &now, const ReadArray &before, PetscReal dt, WriteArray &rate) const
{
  if (!held_) return;
  for (const Node &node : nodes_) rate[node.dof] = (now[node.dof] - before[node.dof]) / dt;
}

PetscErrorCode AirwayNodes::close_rows(Vec X, Vec F) const
{
  PetscFunctionBeginUser;
  if (!held_ || closed_.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const ReadArray x(X);
  WriteArray f(F);
  for (const ClosedRow &closed : closed_) {
    const PetscReal value = closed.scalar >= 0 ? value_[closed.scalar] : 0;
    const PetscScalar off = x[closed.row - first_] - value;
    f[closed.row - first_] = std::abs(off) > rounding * std::abs(value) ? off : 0;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::close_rows(Mat A, bool keep_flux)
{
  std::vector<PetscInt> rows;

  PetscFunctionBeginUser;
  if (!held_) PetscFunctionReturn(PETSC_SUCCESS);
  if (keep_flux) {
    ISHandle of_nodes, columns;
    PetscInt begin, end;
    for (const Node &node : nodes_)
      if (node.row >= 0) rows.push_back(node.row);
    PetscCall(MatGetOwnershipRangeColumn(A, &begin, &end));
    PetscCall(ISCreateGeneral(comm_, (PetscInt)rows.size(), rows.data(), PETSC_COPY_VALUES, of_nodes.out()));
    PetscCall(ISCreateStride(comm_, end - begin, begin, 1, columns.out()));
    PetscCall(MatCreateSubMatrix(A, of_nodes, columns, MAT_INITIAL_MATRIX, flux_rows_.out()));
  }
  rows.clear();
  for (const ClosedRow &closed : closed_) rows.push_back(closed.row);
  PetscCall(MatZeroRowsColumns(A, (PetscInt)rows.size(), rows.data(), 1, nullptr, nullptr));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<PetscInt> AirwayNodes::closed_points() const
{
  std::vector<PetscInt> points;
  if (held_)
    for (const Node &node : nodes_) points.push_back(node.point);
  return points;
}

PetscErrorCode AirwayNodes::scalars(Vec X, std::vector<PetscReal> &values) const
{
  PetscFunctionBeginUser;
  values.assign(homes_.size(), 0);
  {
    const ReadArray x(X);
    for (std::size_t s = 0; s < homes_.size(); ++s)
      if (homes_[s] >= 0) values[s] = x[homes_[s] - first_];
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<PetscMPIInt>(values.size()), MPIU_REAL, MPI_SUM, comm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::set_scalars(Vec X, const std::vector<PetscReal> &values) const
{
  PetscFunctionBeginUser;
  WriteArray x(X);
  for (std::size_t s = 0; s < homes_.size(); ++s)
    if (homes_[s] >= 0) x[homes_[s] - first_] = values[s];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::set(Vec X, const std::vector<PetscReal> &values) const
{
  PetscFunctionBeginUser;
  WriteArray x(X);
  for (const ClosedRow &closed : closed_)
    if (closed.scalar >= 0) x[closed.row - first_] = values[closed.scalar];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::mean_pressure(Vec local, PetscReal &mean) const
{
  PetscFunctionBeginUser;
  const ReadArray x(local);
  mean = 0;
  for (const Node &node : nodes_) mean += node.area * x[node.dof] / area_;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &mean, 1, MPIU_REAL, MPI_SUM, comm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::add_mean_gradient(PetscReal factor, Vec local) const
{
  PetscFunctionBeginUser;
  WriteArray x(local);
  for (const Node &node : nodes_) x[node.dof] += factor * node.area / area_;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::fill(Vec local, const std::vector<PetscReal> &values) const
{
  PetscFunctionBeginUser;
  WriteArray x(local);
  for (const Node &node : nodes_) x[node.dof] = values[scalar_of(node)];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::fill_global(Vec X, const std::vector<PetscReal> &values) const
{
  PetscFunctionBeginUser;
  WriteArray x(X);
  for (const Node &node : nodes_)
    if (node.row >= 0) x[node.row - first_] = values[scalar_of(node)];
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<std::size_t> AirwayNodes::acting() const
{
  std::vector<std::size_t> list;
  for (const Group &group : groups_) list.push_back(static_cast<std::size_t>(group.scalar));
  if (own_rows_ > 0) list.push_back(0);
  return list;
}

PetscErrorCode AirwayNodes::flows(Vec F, PetscReal scale, std::vector<PetscReal> &flows) const
{
  PetscFunctionBeginUser;
  flows.assign(value_.size(), 0);
  {
    const ReadArray f(F);
    for (const Node &node : nodes_) flows[scalar_of(node)] += f[node.dof] / scale;
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, flows.data(), static_cast<PetscMPIInt>(flows.size()), MPIU_REAL, MPI_SUM, comm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode AirwayNodes::flow_derivatives(Vec y, const std::vector<PetscReal> &scalars, PetscReal scale,
                                             std::vector<PetscReal> &derivatives) const
{
  VecHandle product;

  PetscFunctionBeginUser;
  PetscCall(fill_global(y, scalars));
  PetscCall(MatCreateVecs(flux_rows_, nullptr, product.out()));
  PetscCall(MatMult(flux_rows_, y, product));
  derivatives.assign(value_.size(), 0);
  {
    const ReadArray f(product);
    PetscInt i = 0;
    for (const Node &node : nodes_)
      if (node.row >= 0) derivatives[scalar_of(node)] += f[i++] / scale;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, derivatives.data(), static_cast<PetscMPIInt>(derivatives.size()), MPIU_REAL,
                             MPI_SUM, comm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
