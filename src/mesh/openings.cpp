#include "pulmo/mesh/openings.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/shared_points.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <sstream>

namespace pulmo {

namespace {

/// A push of less than this share of area times pressure is rounding of a closed surface.
constexpr PetscReal no_push = 1e-6;

/// Shares that differ by more than this share of the volume's are told.
constexpr PetscReal notable_difference = 0.1;

PetscErrorCode facets_of(const Mesh &mesh, const std::vector<std::string> &names, std::vector<PetscInt> &facets)
{
  PetscFunctionBeginUser;
  facets.clear();
  for (const std::string &name : names) {
    std::vector<PetscInt> some;
    PetscCall(mesh.facets(name, some));
    facets.insert(facets.end(), some.begin(), some.end());
  }
  std::sort(facets.begin(), facets.end());
  facets.erase(std::unique(facets.begin(), facets.end()), facets.end()); // a facet may have two names
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// How many sets of these facets hang together at their edges, over all ranks.
PetscErrorCode count_patches(DM dm, const std::vector<PetscInt> &facets, PetscInt &patches)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscMPIInt rank;
  PetscInt points, before, changed = 1;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &points));
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Exscan(&points, &before, 1, MPIU_INT, MPI_SUM, comm));
  if (rank == 0) before = 0; // MPI leaves it undefined
  // each edge of a facet starts with a number of its own; the least one spreads over facets and ranks
  std::vector<PetscInt> number(static_cast<std::size_t>(points), PETSC_MAX_INT), shared;
  std::vector<std::array<PetscInt, 3>> edges;
  for (PetscInt facet : facets) {
    const PetscInt *cone;
    PetscCall(DMPlexGetCone(dm, facet, &cone));
    edges.push_back({cone[0], cone[1], cone[2]});
    for (PetscInt e : edges.back()) number[e] = before + e;
  }
  while (changed) {
    for (bool moved = true; moved;) {
      moved = false;
      for (const auto &edge : edges) {
        const PetscInt least = std::min({number[edge[0]], number[edge[1]], number[edge[2]]});
        for (PetscInt e : edge) {
          moved = moved || number[e] != least;
          number[e] = least;
        }
      }
    }
    shared = number;
    PetscCall(combine_shared(dm, MPI_MIN, shared));
    changed = 0;
    for (const auto &edge : edges)
      for (PetscInt e : edge)
        if (shared[e] != number[e]) changed = 1;
    number = shared;
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &changed, 1, MPIU_INT, MPI_MAX, comm));
  }
  patches = 0;
  for (PetscInt last = -1;; ++patches) {
    PetscInt next = PETSC_MAX_INT;
    for (const auto &edge : edges)
      if (number[edge[0]] > last) next = std::min(next, number[edge[0]]);
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &next, 1, MPIU_INT, MPI_MIN, comm));
    if (next == PETSC_MAX_INT) break;
    last = next;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The connected bodies, and for each cell of this rank the place of its body in that list.
PetscErrorCode find_bodies(const Mesh &mesh, std::vector<Mesh::Region> &bodies, std::vector<std::size_t> &body_of)
{
  PetscInt begin, end;
  std::vector<Mesh::Region> all;

  PetscFunctionBeginUser;
  PetscCall(mesh.regions(all));
  bodies.clear();
  for (const Mesh::Region &region : all)
    if (region.body) bodies.push_back(region);
  PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
  body_of.assign(static_cast<std::size_t>(end - begin), 0);
  for (std::size_t b = 0; b < bodies.size(); ++b)
    for (PetscInt c : bodies[b].cells) body_of[c] = b;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Body of the cell behind an outer facet.
PetscErrorCode body_behind(DM dm, PetscInt facet, const std::vector<std::size_t> &body_of, std::size_t &body)
{
  const PetscInt *support;
  PetscInt begin;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, nullptr));
  PetscCall(DMPlexGetSupport(dm, facet, &support));
  body = body_of[support[0] - begin];
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string percent(PetscReal share)
{
  std::ostringstream text;
  text.precision(3);
  text << 100 * share << " %";
  return text.str();
}

} // namespace

std::string Openings::unequal_shares() const
{
  std::string text;
  for (const BodyOpening &b : bodies)
    if (std::abs(b.area_share - b.volume_share) > notable_difference * b.volume_share)
      text += (text.empty() ? "" : ", ") + b.name + " has " + percent(b.area_share) + " of the airway's area and " +
              percent(b.volume_share) + " of the volume";
  return text;
}

PetscErrorCode find_openings(const Mesh &mesh, const std::vector<std::string> &names, Openings &openings)
{
  const DM dm = mesh.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  constexpr std::size_t n = 11; // volume and its first moment, area and its moments
  PetscInt begin;
  std::vector<PetscInt> facets;
  std::vector<Mesh::Region> bodies;
  std::vector<std::size_t> body_of;

  PetscFunctionBeginUser;
  PetscCall(facets_of(mesh, names, facets));
  PetscCall(count_patches(dm, facets, openings.patches));
  PetscCall(find_bodies(mesh, bodies, body_of));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, nullptr));
  std::vector<PetscReal> sums(n * bodies.size(), 0);
  for (std::size_t c = 0; c < body_of.size(); ++c) {
    PetscReal volume, centre[3];
    PetscReal *sum = &sums[n * body_of[c]];
    PetscCall(DMPlexComputeCellGeometryFVM(dm, begin + static_cast<PetscInt>(c), &volume, centre, nullptr));
    sum[0] += volume;
    for (int d = 0; d < 3; ++d) sum[1 + d] += volume * centre[d];
  }
  for (PetscInt facet : facets) {
    const PetscInt *support;
    PetscReal area, x[3], N[3], inside[3], outward = 0;
    std::size_t body = 0;
    PetscCall(body_behind(dm, facet, body_of, body));
    PetscCall(DMPlexComputeCellGeometryFVM(dm, facet, &area, x, N));
    PetscCall(DMPlexGetSupport(dm, facet, &support));
    PetscCall(DMPlexComputeCellGeometryFVM(dm, support[0], nullptr, inside, nullptr));
    for (int d = 0; d < 3; ++d) outward += N[d] * (x[d] - inside[d]);
    PetscReal *sum = &sums[n * body];
    sum[4] += area;
    for (int d = 0; d < 3; ++d) {
      const int e = (d + 1) % 3, f = (d + 2) % 3;
      const PetscReal side = outward < 0 ? -area : area;
      sum[5 + d] += side * N[d];
      sum[8 + d] += side * (x[e] * N[f] - x[f] * N[e]);
    }
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPIU_REAL, MPI_SUM, comm));
  PetscReal area = 0, volume = 0;
  openings.bodies.clear();
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const PetscReal *sum = &sums[n * b];
    BodyOpening opening;
    opening.name = bodies[b].name;
    opening.volume = sum[0];
    opening.area = sum[4];
    opening.size = std::cbrt(sum[0]);
    for (int d = 0; d < 3; ++d) {
      const int e = (d + 1) % 3, f = (d + 2) % 3;
      opening.push[d] = sum[5 + d];
      opening.turn[d] = sum[8 + d] - (sum[1 + e] * sum[5 + f] - sum[1 + f] * sum[5 + e]) / sum[0];
    }
    area += opening.area;
    volume += opening.volume;
    openings.bodies.push_back(opening);
  }
  for (BodyOpening &b : openings.bodies) {
    b.area_share = area > 0 ? b.area / area : 0;
    b.volume_share = b.volume / volume;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode find_rim(const Mesh &mesh, const std::vector<std::string> &names, std::vector<RimSegment> &rim)
{
  const DM dm = mesh.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt points;
  PetscMPIInt size;
  std::vector<PetscInt> facets;
  std::vector<PetscReal> mine;

  PetscFunctionBeginUser;
  PetscCall(facets_of(mesh, names, facets));
  PetscCall(DMPlexGetChart(dm, nullptr, &points));
  std::vector<PetscInt> here(static_cast<std::size_t>(points), 0), everywhere;
  for (PetscInt facet : facets) {
    const PetscInt *edges;
    PetscCall(DMPlexGetCone(dm, facet, &edges));
    for (int e = 0; e < 3; ++e) ++here[edges[e]];
  }
  everywhere = here;
  PetscCall(combine_shared(dm, MPI_SUM, everywhere));
  for (PetscInt e = 0; e < points; ++e) {
    const PetscInt *ends;
    if (here[e] != 1 || everywhere[e] != 1) continue;
    PetscCall(DMPlexGetCone(dm, e, &ends));
    for (int i = 0; i < 2; ++i) {
      PetscReal x[3];
      PetscCall(mesh.node_coordinates(ends[i], x));
      mine.insert(mine.end(), x, x + 3);
    }
  }
  PetscCallMPI(MPI_Comm_size(comm, &size));
  std::vector<PetscMPIInt> counts(size), starts(size, 0);
  auto count = static_cast<PetscMPIInt>(mine.size());
  PetscCallMPI(MPI_Allgather(&count, 1, MPI_INT, counts.data(), 1, MPI_INT, comm));
  std::partial_sum(counts.begin(), counts.end() - 1, starts.begin() + 1);
  std::vector<PetscReal> all(static_cast<std::size_t>(starts.back() + counts.back()));
  PetscCallMPI(
      MPI_Allgatherv(mine.data(), count, MPIU_REAL, all.data(), counts.data(), starts.data(), MPIU_REAL, comm));
  rim.resize(all.size() / 6);
  for (std::size_t i = 0; i < all.size(); ++i) rim[i / 6][i % 6] = all[i];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode bodies_with(const Mesh &mesh, const std::vector<std::string> &names, std::vector<std::string> &list)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  std::vector<PetscInt> facets;
  std::vector<Mesh::Region> bodies;
  std::vector<std::size_t> body_of;

  PetscFunctionBeginUser;
  PetscCall(facets_of(mesh, names, facets));
  PetscCall(find_bodies(mesh, bodies, body_of));
  std::vector<int> reached(bodies.size(), 0);
  for (PetscInt facet : facets) {
    std::size_t body = 0;
    PetscCall(body_behind(mesh.dm(), facet, body_of, body));
    reached[body] = 1;
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, reached.data(), static_cast<PetscMPIInt>(reached.size()), MPI_INT, MPI_MAX, comm));
  list.clear();
  for (std::size_t b = 0; b < bodies.size(); ++b)
    if (reached[b]) list.push_back(bodies[b].name);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode check_wall_load(const Mesh &mesh, const std::vector<std::string> &walls,
                               const std::vector<std::string> &holders)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  const auto length = [](const std::array<PetscReal, 3> &a) { return std::hypot(a[0], a[1], a[2]); };
  Openings openings;
  std::vector<std::string> held;

  PetscFunctionBeginUser;
  PetscCall(find_openings(mesh, walls, openings));
  PetscCall(bodies_with(mesh, holders, held));
  for (const BodyOpening &b : openings.bodies) {
    if (std::find(held.begin(), held.end(), b.name) != held.end()) continue;
    const PetscReal push = length(b.push), turn = length(b.turn);
    PulmoUserCheck(push <= no_push * b.area && turn <= no_push * b.area * b.size, comm,
                   "there is no equilibrium: the gas on its airway wall pushes the lung (%s) with %.3g N and turns it "
                   "with %.3g N mm per cmH2O, and only the pins of -support_rigid hold it, which bear no load; give "
                   "-lumen_pressure off (scenes/paper.opts), springs (-chest_wall) or -support_surfaces",
                   b.name.c_str(), (double)(push * units::kPa_per_cmH2O * units::newton_per_kPa_mm2),
                   (double)(turn * units::kPa_per_cmH2O * units::newton_per_kPa_mm2));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
