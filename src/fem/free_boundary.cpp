#include "pulmo/fem/free_boundary.hpp"

#include "pulmo/mesh/shared_points.hpp"

#include <algorithm>
#include <set>

namespace pulmo {

PetscErrorCode find_free_boundary(const Composition &composition, std::vector<FreeBoundary> &parts)
{
  const Mesh &mesh = composition.mesh();
  const DM dm = mesh.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  std::set<std::string> used;
  std::vector<std::string> names;
  PetscInt point_end, vertex_begin, vertex_end;
  std::vector<PetscInt> outer, facets;

  PetscFunctionBeginUser;
  for (const Term &t : composition.terms())
    if (!t.surface.empty()) used.insert(t.surface);
  for (const Constraint &c : composition.constraints())
    if (!c.surface.empty()) used.insert(c.surface);
  for (const auto &[name, surface] : mesh.surfaces()) names.push_back(name);
  names.emplace_back();
  PetscCall(DMPlexGetChart(dm, nullptr, &point_end));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  PetscCall(outer_facets(dm, outer));

  // part_of[facet]: the number of its name, -1 if something uses the facet
  const std::size_t n = names.size();
  std::vector<PetscInt> part_of(static_cast<std::size_t>(point_end), static_cast<PetscInt>(n) - 1);
  for (std::size_t i = n - 1; i-- > 0;) {
    PetscCall(mesh.facets(names[i], facets));
    for (const PetscInt f : facets) part_of[f] = static_cast<PetscInt>(i);
  }
  for (const std::string &name : used) {
    PetscCall(mesh.facets(name, facets));
    for (const PetscInt f : facets) part_of[f] = -1;
  }
  std::vector<PetscReal> moments(4 * n + 1, 0), extent(6 * n, -PETSC_MAX_REAL); // extent: -lowest, highest
  for (const PetscInt f : outer) {
    PetscReal area, centre[3];
    PetscInt *closure = nullptr, n_closure;
    PetscCall(DMPlexComputeCellGeometryFVM(dm, f, &area, centre, nullptr));
    moments[4 * n] += area;
    if (part_of[f] < 0) continue;
    const auto i = static_cast<std::size_t>(part_of[f]);
    moments[4 * i + 3] += area;
    for (int d = 0; d < 3; ++d) moments[4 * i + d] += area * centre[d];
    PetscCall(DMPlexGetTransitiveClosure(dm, f, PETSC_TRUE, &n_closure, &closure));
    for (PetscInt j = 0; j < n_closure; ++j) {
      PetscReal x[3];
      if (closure[2 * j] < vertex_begin || closure[2 * j] >= vertex_end) continue;
      PetscCall(mesh.node_coordinates(closure[2 * j], x));
      for (int d = 0; d < 3; ++d) {
        extent[6 * i + d] = std::max(extent[6 * i + d], -x[d]);
        extent[6 * i + 3 + d] = std::max(extent[6 * i + 3 + d], x[d]);
      }
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm, f, PETSC_TRUE, &n_closure, &closure));
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, moments.data(), static_cast<PetscMPIInt>(moments.size()), MPIU_REAL, MPI_SUM, comm));
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, extent.data(), static_cast<PetscMPIInt>(extent.size()), MPIU_REAL, MPI_MAX, comm));
  parts.clear();
  for (std::size_t i = 0; i < n; ++i) {
    FreeBoundary part;
    part.name = names[i];
    part.area = moments[4 * i + 3];
    if (part.area == 0) continue;
    part.share = part.area / moments[4 * n];
    for (int d = 0; d < 3; ++d) {
      part.centroid[d] = moments[4 * i + d] / part.area;
      part.lowest[d] = -extent[6 * i + d];
      part.highest[d] = extent[6 * i + 3 + d];
    }
    parts.push_back(part);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode note_free_boundary(const Composition &composition, bool airflow)
{
  std::vector<FreeBoundary> parts;
  std::string list;

  PetscFunctionBeginUser;
  PetscCall(find_free_boundary(composition, parts));
  if (parts.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const FreeBoundary &p : parts) {
    char text[240];
    std::snprintf(text, sizeof(text),
                  " (%.4g mm^2, %.3g %% of the boundary, around (%.4g, %.4g, %.4g), from (%.4g, %.4g, %.4g) to (%.4g, "
                  "%.4g, %.4g) mm)",
                  p.area, 100 * p.share, p.centroid[0], p.centroid[1], p.centroid[2], p.lowest[0], p.lowest[1],
                  p.lowest[2], p.highest[0], p.highest[1], p.highest[2]);
    list += (list.empty() ? "" : ", ") + (p.name.empty() ? "boundary without a name" : "'" + p.name + "'") + text;
  }
  PetscCall(PetscPrintf(PetscObjectComm((PetscObject)composition.mesh().dm()),
                        "pulmo: note: no effect uses %s: %s there; a plane of symmetry is held with "
                        "-support_surfaces NAME -support_components_NAME\n",
                        list.c_str(), airflow ? "the lung is free and sealed" : "the lung is free"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
