// The connected bodies of a mesh: numbering, openings, regions, pins.
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/shared_points.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>

namespace pulmo {

namespace {

/// of[cell - begin]: a number that all cells of one connected body share, on all ranks. Bodies are joined by facets.
PetscErrorCode number_bodies(DM dm, PetscInt begin, PetscInt end, std::vector<PetscInt> &of)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt face_begin, face_end, point_end, changed = 1, first = 0;
  const PetscInt n = end - begin;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &point_end));
  PetscCall(DMPlexGetHeightStratum(dm, 1, &face_begin, &face_end));
  PetscCallMPI(MPI_Exscan(&n, &first, 1, MPIU_INT, MPI_SUM, comm));

  // cells joined on this rank: a tree for each body, known by its root
  std::vector<PetscInt> parent(static_cast<std::size_t>(n));
  std::iota(parent.begin(), parent.end(), 0);
  const auto root = [&](PetscInt c) {
    while (parent[c] != c) c = parent[c] = parent[parent[c]];
    return c;
  };
  const auto cells_of = [&](PetscInt face, PetscInt &count, const PetscInt *&cells) {
    PetscFunctionBeginUser;
    PetscCall(DMPlexGetSupportSize(dm, face, &count));
    PetscCall(DMPlexGetSupport(dm, face, &cells));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscInt count;
  const PetscInt *cells;
  for (PetscInt face = face_begin; face < face_end; ++face) {
    PetscCall(cells_of(face, count, cells));
    if (count == 2) parent[root(cells[0] - begin)] = root(cells[1] - begin);
  }

  // the least number of a cell spreads over each body, and through the shared faces over ranks
  std::vector<PetscInt> least(static_cast<std::size_t>(n), PETSC_MAX_INT), at_face;
  for (PetscInt c = 0; c < n; ++c) least[root(c)] = std::min(least[root(c)], first + c);
  while (changed) {
    changed = 0;
    at_face.assign(static_cast<std::size_t>(point_end), PETSC_MAX_INT);
    for (PetscInt face = face_begin; face < face_end; ++face) {
      PetscCall(cells_of(face, count, cells));
      if (count > 0) at_face[face] = least[root(cells[0] - begin)];
    }
    PetscCall(combine_shared(dm, MPI_MIN, at_face));
    for (PetscInt face = face_begin; face < face_end; ++face) {
      PetscCall(cells_of(face, count, cells));
      if (count == 0) continue;
      PetscInt &number = least[root(cells[0] - begin)];
      if (at_face[face] < number) changed = 1;
      number = std::min(number, at_face[face]);
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &changed, 1, MPIU_INT, MPI_MAX, comm));
  }
  of.resize(static_cast<std::size_t>(n));
  for (PetscInt c = 0; c < n; ++c) of[c] = least[root(c)];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// All values of all ranks, each once, in order.
PetscErrorCode union_of(MPI_Comm comm, std::vector<PetscInt> &values)
{
  PetscMPIInt size, n;

  PetscFunctionBeginUser;
  std::sort(values.begin(), values.end());
  values.erase(std::unique(values.begin(), values.end()), values.end());
  PetscCallMPI(MPI_Comm_size(comm, &size));
  std::vector<PetscMPIInt> counts(size), offsets(size, 0);
  n = static_cast<PetscMPIInt>(values.size());
  PetscCallMPI(MPI_Allgather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, comm));
  std::partial_sum(counts.begin(), counts.end() - 1, offsets.begin() + 1);
  std::vector<PetscInt> all(static_cast<std::size_t>(offsets.back() + counts.back()));
  PetscCallMPI(MPI_Allgatherv(values.data(), n, MPIU_INT, all.data(), counts.data(), offsets.data(), MPIU_INT, comm));
  std::sort(all.begin(), all.end());
  all.erase(std::unique(all.begin(), all.end()), all.end());
  values = std::move(all);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Mesh::bodies(std::vector<Body> &list) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin, end;
  std::vector<PetscInt> number;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  PetscCall(number_bodies(dm_, begin, end, number));
  std::vector<PetscInt> numbers = number;
  PetscCall(union_of(comm, numbers));
  list.assign(numbers.size(), Body());
  std::vector<PetscReal> moments(4 * numbers.size(), 0);
  for (PetscInt c = 0; c < end - begin; ++c) {
    const auto b =
        static_cast<std::size_t>(std::lower_bound(numbers.begin(), numbers.end(), number[c]) - numbers.begin());
    PetscReal volume, centre[3];
    list[b].cells.push_back(c);
    PetscCall(DMPlexComputeCellGeometryFVM(dm_, begin + c, &volume, centre, nullptr));
    for (int d = 0; d < 3; ++d) moments[4 * b + d] += volume * centre[d];
    moments[4 * b + 3] += volume;
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, moments.data(), static_cast<PetscMPIInt>(moments.size()), MPIU_REAL, MPI_SUM, comm));
  for (std::size_t b = 0; b < list.size(); ++b) {
    list[b].volume = moments[4 * b + 3];
    for (int d = 0; d < 3; ++d) list[b].centroid[d] = moments[4 * b + d] / list[b].volume;
  }
  // the numbers of the bodies depend on how the mesh is distributed, their places do not
  const PetscReal rounding = 1e-6 * length_;
  std::sort(list.begin(), list.end(), [rounding](const Body &a, const Body &b) {
    for (int d = 0; d < 3; ++d)
      if (std::abs(a.centroid[d] - b.centroid[d]) > rounding) return a.centroid[d] < b.centroid[d];
    return a.volume < b.volume * (1 - 1e-9);
  });
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::body_of_cells(const std::vector<Body> &list, std::vector<PetscInt> &body_of) const
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  body_of.assign(static_cast<std::size_t>(end - begin), -1);
  for (std::size_t b = 0; b < list.size(); ++b)
    for (const PetscInt c : list[b].cells) body_of[c] = static_cast<PetscInt>(b);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::require_in_each_body(const std::vector<std::string> &names, const std::string &complaint) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin;
  std::vector<Body> list;
  std::vector<PetscInt> body_of;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, nullptr));
  PetscCall(bodies(list));
  PetscCall(body_of_cells(list, body_of));
  std::vector<int> reached(list.size(), 0);
  for (const std::string &name : names) {
    std::vector<PetscInt> points;
    PetscCall(facets(name, points));
    for (const PetscInt facet : points) {
      const PetscInt *cell;
      PetscCall(DMPlexGetSupport(dm_, facet, &cell));
      reached[body_of[cell[0] - begin]] = 1;
    }
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, reached.data(), static_cast<PetscMPIInt>(reached.size()), MPI_INT, MPI_MAX, comm));
  for (std::size_t b = 0; b < list.size(); ++b)
    PulmoUserCheck(reached[b], comm, "%s %s", body_text(list[b]).c_str(), complaint.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Mesh::body_text(const Body &body) const
{
  char text[120];
  std::snprintf(text, sizeof(text), "the body around (%.6g, %.6g, %.6g) mm of mesh ", (double)body.centroid[0],
                (double)body.centroid[1], (double)body.centroid[2]);
  return text + file_;
}

PetscErrorCode Mesh::hinge(const std::vector<Body> &list, Hinge &found) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin, end, cell_begin, point_end;
  PetscMPIInt size;
  std::vector<PetscInt> body_of;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &begin, &end));
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &cell_begin, nullptr));
  PetscCall(DMPlexGetChart(dm_, nullptr, &point_end));
  PetscCall(body_of_cells(list, body_of));
  std::vector<PetscInt> least(static_cast<std::size_t>(point_end), PETSC_MAX_INT), largest(least.size(), -1);
  for (std::size_t c = 0; c < body_of.size(); ++c) {
    PetscInt *closure = nullptr, n;
    const PetscInt cell = cell_begin + static_cast<PetscInt>(c);
    PetscCall(DMPlexGetTransitiveClosure(dm_, cell, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i) {
      const PetscInt p = closure[2 * i];
      least[p] = std::min(least[p], body_of[c]);
      largest[p] = std::max(largest[p], body_of[c]);
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, cell, PETSC_TRUE, &n, &closure));
  }
  PetscCall(combine_shared(dm_, MPI_MIN, least));
  PetscCall(combine_shared(dm_, MPI_MAX, largest));
  // the one of least coordinates, whatever the ranks are
  using Candidate = std::array<double, 5>;
  Candidate best{HUGE_VAL, 0, 0, -1, -1};
  for (PetscInt v = begin; v < end; ++v) {
    PetscReal x[3];
    if (least[v] >= largest[v]) continue;
    PetscCall(node_coordinates(v, x));
    best = std::min(best, Candidate{x[0], x[1], x[2], (double)least[v], (double)largest[v]});
  }
  PetscCallMPI(MPI_Comm_size(comm, &size));
  std::vector<Candidate> all(size);
  PetscCallMPI(MPI_Allgather(best.data(), 5, MPI_DOUBLE, all.data(), 5, MPI_DOUBLE, comm));
  best = *std::min_element(all.begin(), all.end());
  for (int d = 0; d < 3; ++d) found.x[d] = best[d];
  for (int i = 0; i < 2; ++i) found.body[i] = static_cast<PetscInt>(best[3 + i]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::regions(std::vector<Region> &list) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin, end;
  std::vector<Body> all;
  std::vector<Region> parts; // one for each body

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  PetscCall(bodies(all));
  for (Body &body : all) parts.push_back({"", true, std::move(body.cells)});

  list.clear();
  for (const Part &part : parts_) {
    if (part.dimension != 3) continue;
    Region region;
    region.name = part.name;
    PetscCall(elements(part, region.cells));
    for (PetscInt &c : region.cells) c -= begin;
    for (Region &body : parts) {
      int same = body.cells == region.cells;
      PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &same, 1, MPI_INT, MPI_LAND, comm));
      if (!same || !body.name.empty()) continue;
      region.body = true;
      body.name = part.name;
    }
    list.push_back(region);
  }
  std::sort(list.begin(), list.end(), [](const Region &a, const Region &b) { return a.name < b.name; });
  int unnamed = 0;
  for (Region &body : parts) {
    if (!body.name.empty()) continue;
    body.name = "body_" + std::to_string(++unnamed);
    list.push_back(body);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::vertices(const Body &body, std::vector<PetscInt> &points) const
{
  PetscInt begin, end, cell_begin;

  PetscFunctionBeginUser;
  points.clear();
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &begin, &end));
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &cell_begin, nullptr));
  for (const PetscInt c : body.cells) {
    PetscInt *closure = nullptr, n;
    PetscCall(DMPlexGetTransitiveClosure(dm_, cell_begin + c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i)
      if (closure[2 * i] >= begin && closure[2 * i] < end) points.push_back(closure[2 * i]);
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, cell_begin + c, PETSC_TRUE, &n, &closure));
  }
  std::sort(points.begin(), points.end());
  points.erase(std::unique(points.begin(), points.end()), points.end());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::rigid_pins(const Body &body, std::vector<Pin> &pins) const
{
  using Coordinates = std::array<PetscReal, 3>;
  constexpr PetscReal off_axis = 3; // weight of what leads away from an axis
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscMPIInt size;
  std::array<Coordinates, 3> chosen{};
  int along = 2, across = 0; // the axis that AB is close to; the second axis of the plane that ABC is close to
  std::vector<PetscInt> vertices;

  PetscFunctionBeginUser;
  pins.clear();
  PetscCall(this->vertices(body, vertices));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  // A: the lowest vertex. B: far from A and close to an axis through A. C: far from AB and close to a plane of two
  // axes through it. Then the held components hardly turn a lung that swells. Ranks that share a vertex have the same
  // coordinates for it, so the choice by coordinates is the same on all.
  const auto score = [&](int k, const Coordinates &x, int axis) {
    Coordinates d;
    for (int i = 0; i < 3; ++i) d[i] = std::abs(x[i] - chosen[0][i]);
    if (k == 0) return -x[2];
    const int next = (axis + 1) % 3, last = (axis + 2) % 3;
    if (k == 1) return d[axis] - off_axis * (d[next] + d[last]);
    return axis == along ? -PETSC_MAX_REAL : d[axis] - off_axis * d[3 - along - axis];
  };
  for (int k = 0; k < 3; ++k) {
    // score, then (ties must not depend on how the mesh is numbered and distributed) coordinates and axis, negative
    using Candidate = std::array<double, 5>;
    Candidate best{-PETSC_MAX_REAL, 0, 0, 0, 0};
    for (PetscInt v : vertices) {
      Coordinates x;
      PetscCall(node_coordinates(v, x.data()));
      for (int axis = 0; axis < 3; ++axis)
        best = std::max(best, Candidate{score(k, x, axis), -x[0], -x[1], -x[2], -(double)axis});
    }
    std::vector<Candidate> all(size);
    PetscCallMPI(MPI_Allgather(best.data(), 5, MPI_DOUBLE, all.data(), 5, MPI_DOUBLE, comm));
    best = *std::max_element(all.begin(), all.end());
    for (int d = 0; d < 3; ++d) chosen[k][d] = -best[1 + d];
    const int axis = static_cast<int>(-best[4]);
    if (k == 1) along = axis;
    if (k == 2) across = axis;
  }
  for (int k = 0; k < 3; ++k) {
    Pin pin;
    for (int d = 0; d < 3; ++d) {
      pin.x[d] = chosen[k][d];
      pin.component[d] = k == 0 || (k == 1 && d != along) || (k == 2 && d == 3 - along - across);
    }
    for (PetscInt v : vertices) {
      Coordinates x;
      PetscCall(node_coordinates(v, x.data()));
      if (x == chosen[k]) pin.vertex = v;
    }
    pins.push_back(pin);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
