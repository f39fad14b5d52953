// The connected bodies of a mesh: numbering, openings, regions, pins.
#include "pulmo/mesh.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <set>

namespace pulmo {

namespace {

/// body[vertex - begin]: a number that all vertices of one connected body share, on all ranks.
PetscErrorCode find_bodies(DM dm, PetscInt begin, PetscInt end, std::vector<PetscInt> &body)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt cell_begin, cell_end, point_end, roots, changed = 1;
  PetscSF sf;
  IS numbering;
  const PetscInt *numbers;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &point_end));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  PetscCall(DMPlexGetVertexNumbering(dm, &numbering));
  PetscCall(ISGetIndices(numbering, &numbers));
  std::vector<PetscInt> of(static_cast<std::size_t>(point_end), PETSC_MAX_INT), sent;
  for (PetscInt v = begin; v < end; ++v)
    of[v] = numbers[v - begin] < 0 ? -(numbers[v - begin] + 1) : numbers[v - begin];
  PetscCall(ISRestoreIndices(numbering, &numbers));

  // vertices joined by cells of this rank: a tree for each body, known by its root
  std::vector<PetscInt> parent(static_cast<std::size_t>(point_end));
  std::iota(parent.begin(), parent.end(), 0);
  const auto root = [&](PetscInt v) {
    while (parent[v] != v) v = parent[v] = parent[parent[v]];
    return v;
  };
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n;
    PetscCall(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    const PetscInt joined = root(closure[2 * (n - 1)]); // vertices come last
    for (PetscInt i = 0; i < n; ++i)
      if (closure[2 * i] >= begin && closure[2 * i] < end) parent[root(closure[2 * i])] = joined;
    PetscCall(DMPlexRestoreTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
  }

  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  while (changed) { // the least number spreads over each body, then over ranks
    changed = 0;
    for (PetscInt v = begin; v < end; ++v) {
      PetscInt &least = of[root(v)];
      if (of[v] < least) changed = 1;
      least = std::min(least, of[v]);
    }
    for (PetscInt v = begin; v < end; ++v) {
      if (of[v] != of[root(v)]) changed = 1;
      of[v] = of[root(v)];
    }
    if (roots >= 0) {
      sent = of;
      PetscCall(PetscSFReduceBegin(sf, MPIU_INT, sent.data(), of.data(), MPI_MIN));
      PetscCall(PetscSFReduceEnd(sf, MPIU_INT, sent.data(), of.data(), MPI_MIN));
      sent = of;
      PetscCall(PetscSFBcastBegin(sf, MPIU_INT, sent.data(), of.data(), MPI_REPLACE));
      PetscCall(PetscSFBcastEnd(sf, MPIU_INT, sent.data(), of.data(), MPI_REPLACE));
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &changed, 1, MPIU_INT, MPI_MAX, comm));
  }
  body.assign(of.begin() + begin, of.begin() + end);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The least number of a body above @p last, over all ranks; PETSC_MAX_INT after the last.
PetscErrorCode next_body(MPI_Comm comm, const std::vector<PetscInt> &body, PetscInt last, PetscInt &next)
{
  PetscFunctionBeginUser;
  next = PETSC_MAX_INT;
  for (PetscInt number : body)
    if (number > last) next = std::min(next, number);
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &next, 1, MPIU_INT, MPI_MIN, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Mesh::require_in_each_body(const std::vector<std::string> &names, const std::string &complaint) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin, end, last = -1;
  std::vector<PetscInt> body;
  std::set<PetscInt> reached; // bodies

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &begin, &end));
  PetscCall(find_bodies(dm_, begin, end, body));
  for (const std::string &name : names) {
    std::vector<PetscInt> points;
    PetscCall(facets(name, points));
    for (const PetscInt facet : points) {
      const PetscInt *cone;
      PetscCall(DMPlexGetCone(dm_, facet, &cone));   // edges
      PetscCall(DMPlexGetCone(dm_, cone[0], &cone)); // vertices
      reached.insert(body[cone[0] - begin]);
    }
  }
  for (;;) {
    PetscInt next;
    PetscReal sums[5] = {0, 0, 0, 0, 0}; // coordinates and number of the body's vertices, ranks where it is reached
    PetscCall(next_body(comm, body, last, next));
    if (next == PETSC_MAX_INT) break;
    sums[4] = static_cast<PetscReal>(reached.count(next));
    for (PetscInt v = begin; v < end; ++v) {
      PetscReal x[3];
      if (body[v - begin] != next) continue;
      PetscCall(node_coordinates(v, x));
      for (int d = 0; d < 3; ++d) sums[d] += x[d];
      ++sums[3];
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums, 5, MPIU_REAL, MPI_SUM, comm));
    PulmoUserCheck(sums[4] > 0, comm, "the body around (%.6g, %.6g, %.6g) mm of mesh %s %s",
                   (double)(sums[0] / sums[3]), (double)(sums[1] / sums[3]), (double)(sums[2] / sums[3]), file_.c_str(),
                   complaint.c_str());
    last = next;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::regions(std::vector<Region> &list) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt vertex_begin, vertex_end, begin, end, last = -1;
  std::vector<PetscInt> body_of, cell_body;
  struct Body {
    Region region;
    PetscReal centroid[3];
  };
  std::vector<Body> bodies;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &vertex_begin, &vertex_end));
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  PetscCall(find_bodies(dm_, vertex_begin, vertex_end, body_of));
  for (PetscInt c = begin; c < end; ++c) {
    const PetscInt *cone = &c; // a face, an edge, a vertex of the cell
    for (int depth = 0; depth < 3; ++depth) PetscCall(DMPlexGetCone(dm_, cone[0], &cone));
    cell_body.push_back(body_of[cone[0] - vertex_begin]);
  }
  for (;;) {
    PetscInt next;
    PetscReal moments[4] = {0, 0, 0, 0};
    Body body;
    PetscCall(next_body(comm, body_of, last, next));
    if (next == PETSC_MAX_INT) break;
    for (PetscInt c = 0; c < end - begin; ++c) {
      PetscReal volume, centre[3];
      if (cell_body[c] != next) continue;
      body.region.cells.push_back(c);
      PetscCall(DMPlexComputeCellGeometryFVM(dm_, begin + c, &volume, centre, nullptr));
      moments[3] += volume;
      for (int d = 0; d < 3; ++d) moments[d] += volume * centre[d];
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, moments, 4, MPIU_REAL, MPI_SUM, comm));
    for (int d = 0; d < 3; ++d) body.centroid[d] = moments[d] / moments[3];
    body.region.body = true;
    bodies.push_back(body);
    last = next;
  }
  // the numbers of the bodies depend on how the mesh is distributed, their places do not
  const PetscReal rounding = 1e-6 * length_;
  std::sort(bodies.begin(), bodies.end(), [rounding](const Body &a, const Body &b) {
    for (int d = 0; d < 3; ++d)
      if (std::abs(a.centroid[d] - b.centroid[d]) > rounding) return a.centroid[d] < b.centroid[d];
    return false;
  });

  list.clear();
  for (const Part &part : parts_) {
    if (part.dimension != 3) continue;
    Region region;
    region.name = part.name;
    PetscCall(elements(part, region.cells));
    for (PetscInt &c : region.cells) c -= begin;
    for (Body &body : bodies) {
      int same = body.region.cells == region.cells;
      PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &same, 1, MPI_INT, MPI_LAND, comm));
      if (!same || !body.region.name.empty()) continue;
      region.body = true;
      body.region.name = part.name;
    }
    list.push_back(region);
  }
  std::sort(list.begin(), list.end(), [](const Region &a, const Region &b) { return a.name < b.name; });
  int unnamed = 0;
  for (Body &body : bodies) {
    if (!body.region.name.empty()) continue;
    body.region.name = "body_" + std::to_string(++unnamed);
    list.push_back(body.region);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::rigid_pins(std::vector<Pin> &pins) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscInt begin, end, last = -1;
  std::vector<PetscInt> body;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &begin, &end));
  PetscCall(find_bodies(dm_, begin, end, body));
  pins.clear();
  for (;;) { // bodies in the order of their numbers
    PetscInt next;
    std::vector<PetscInt> vertices;
    PetscCall(next_body(comm, body, last, next));
    if (next == PETSC_MAX_INT) break;
    for (PetscInt v = begin; v < end; ++v)
      if (body[v - begin] == next) vertices.push_back(v);
    PetscCall(pin_body(vertices, pins));
    last = next;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::pin_body(const std::vector<PetscInt> &vertices, std::vector<Pin> &pins) const
{
  using Coordinates = std::array<PetscReal, 3>;
  constexpr PetscReal off_axis = 3; // weight of what leads away from an axis
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  PetscMPIInt size;
  std::array<Coordinates, 3> chosen{};
  int along = 2, across = 0; // the axis that AB is close to; the second axis of the plane that ABC is close to

  PetscFunctionBeginUser;
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
