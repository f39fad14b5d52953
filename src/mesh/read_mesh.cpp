#include "pulmo/mesh/read_mesh.hpp"

#include "pulmo/base/hdf5_image.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/mesh/msh.hpp"
#include "pulmo/mesh/saved_mesh.hpp"

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <sstream>

namespace pulmo {

namespace {

/// Whether the first cell of a mesh of tetrahedra has more nodes than corners.
PetscErrorCode has_curved_cells(DM dm, bool &curved)
{
  Vec coordinates;
  PetscSection section;
  PetscScalar *values = nullptr;
  PetscInt begin, end, dim, n;

  PetscFunctionBeginUser;
  curved = false;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  if (begin == end) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMGetCoordinateDim(dm, &dim));
  PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
  PetscCall(DMGetCoordinateSection(dm, &section));
  PetscCall(DMPlexVecGetClosure(dm, section, coordinates, begin, &n, &values));
  curved = n > 4 * dim;
  PetscCall(DMPlexVecRestoreClosure(dm, section, coordinates, begin, &n, &values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether PETSc takes a file of this name for gmsh's.
bool is_msh(const std::string &file)
{
  const std::string extension = std::filesystem::path(file).extension();
  return extension == ".msh" || extension == ".msh2" || extension == ".msh4";
}

/// What the labels of a mesh of PETSc's say: each value of a label is a group.
PetscErrorCode read_labels(DM dm, MeshFile &mesh)
{
  PetscInt n_labels, vertex_begin, vertex_end;
  DMLabel label;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  const auto vertices = [&](PetscInt point, int *nodes) -> PetscErrorCode {
    PetscInt *closure = nullptr, n, found = 0;
    PetscFunctionBeginUser;
    PetscCall(DMPlexGetTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i)
      if (closure[2 * i] >= vertex_begin && closure[2 * i] < vertex_end)
        nodes[found++] = static_cast<int>(closure[2 * i] - vertex_begin);
    PetscCall(DMPlexRestoreTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscInt cell_begin, cell_end, face_begin, face_end;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  PetscCall(DMPlexGetHeightStratum(dm, 1, &face_begin, &face_end));
  std::vector<char> named(static_cast<std::size_t>(cell_end - cell_begin), 0);
  PetscCall(DMGetNumLabels(dm, &n_labels));
  for (PetscInt l = 0; l < n_labels; ++l) {
    const char *name;
    ISHandle values_is;
    const PetscInt *values;
    PetscInt n_values;
    PetscCall(DMGetLabelName(dm, l, &name));
    if (is_petsc_label(name)) continue;
    PetscCall(DMGetLabel(dm, name, &label));
    PetscCall(DMLabelGetValueIS(label, values_is.out()));
    PetscCall(ISGetLocalSize(values_is, &n_values));
    PetscCall(ISGetIndices(values_is, &values));
    for (PetscInt v = 0; v < n_values; ++v) {
      const int group = static_cast<int>(mesh.groups.size()); // of facets; the next one is of cells
      ISHandle points_is;
      const PetscInt *points;
      PetscInt n_points;
      for (const int dimension : {2, 3}) mesh.groups.push_back({dimension, static_cast<long>(values[v]), name});
      PetscCall(DMLabelGetStratumIS(label, values[v], points_is.out()));
      PetscCall(ISGetLocalSize(points_is, &n_points));
      PetscCall(ISGetIndices(points_is, &points));
      for (PetscInt i = 0; i < n_points; ++i) {
        const PetscInt p = points[i];
        if (p >= face_begin && p < face_end) {
          mesh.facets.push_back({static_cast<long>(p), group, {}});
          PetscCall(vertices(p, mesh.facets.back().nodes.data()));
        } else if (p >= cell_begin && p < cell_end) {
          mesh.cells.push_back({static_cast<long>(p), group + 1, {}});
          PetscCall(vertices(p, mesh.cells.back().nodes.data()));
          named[p - cell_begin] = 1;
        }
      }
      PetscCall(ISRestoreIndices(points_is, &points));
    }
    PetscCall(ISRestoreIndices(values_is, &values));
  }
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    if (named[c - cell_begin]) continue;
    mesh.cells.push_back({static_cast<long>(c), -1, {}});
    PetscCall(vertices(c, mesh.cells.back().nodes.data()));
  }
  std::stable_sort(mesh.cells.begin(), mesh.cells.end(), [](const auto &a, const auto &b) { return a.id < b.id; });
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Reads another format of PETSc's on this rank; @p fault as read_msh().
PetscErrorCode read_other(const std::string &file, MeshFile &mesh, std::string &fault)
{
  DMHandle dm;
  char name[PETSC_MAX_PATH_LEN] = "";
  bool curved = false;
  PetscInt dim, begin, end, foreign = 0;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-dm_plex_name", name, sizeof(name), nullptr));
  PetscCall(PetscPushErrorHandler(PetscReturnErrorHandler, nullptr));
  bool readable;
  {
    const QuietHdf5 quiet; // of PETSc's own .h5
    readable = DMPlexCreateFromFile(PETSC_COMM_SELF, file.c_str(), name, PETSC_TRUE, dm.out()) == 0;
  }
  PetscCall(PetscPopErrorHandler());
  if (!readable) {
    fault = "is not a readable mesh, or is damaged; pulmo reads gmsh's MSH 2.2 and 4.1 (ASCII or binary), in files "
            "that end in .msh, and what -mesh_save wrote";
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(DMGetDimension(dm, &dim));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    DMPolytopeType type;
    PetscCall(DMPlexGetCellType(dm, c, &type));
    if (type != DM_POLYTOPE_TETRAHEDRON) ++foreign;
  }
  if (foreign == 0 && dim == 3) PetscCall(has_curved_cells(dm, curved));
  if (dim != 3)
    fault = "holds no volume elements (dimension " + std::to_string(dim) + "); mesh the volume";
  else if (foreign > 0)
    fault = "holds " + std::to_string(foreign) + " cells that are not tetrahedra; mesh with tetrahedra only";
  else if (curved)
    fault = "holds elements of higher order; save it with straight ones";
  if (!fault.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscInt vertex_begin, vertex_end;
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  for (PetscInt v = vertex_begin; v < vertex_end; ++v) {
    mesh.nodes.emplace_back();
    PetscCall(pulmo::node_coordinates(dm, v, mesh.nodes.back().data()));
  }
  PetscCall(read_labels(dm, mesh));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

std::string periodic_note(const std::string &file)
{
  return "mesh " + file + " ties surfaces to one another ($Periodic); pulmo does not: each of them moves by itself";
}

PetscErrorCode read_mesh_file(const std::string &file, MeshFile &mesh, std::string &fault)
{
  std::error_code error;
  std::ifstream in;

  PetscFunctionBeginUser;
  if (std::filesystem::is_regular_file(file, error)) in.open(file, std::ios::binary);
  if (!in.is_open() || in.peek() == std::ifstream::traits_type::eof()) {
    fault = "cannot be read: there is no such file, or it is empty; check its name";
  } else if (is_msh(file)) {
    std::ostringstream content;
    content << in.rdbuf();
    const std::string text = content.str();
    fault = read_msh(text, mesh);
    const auto periodic = text.find("$Periodic");
    mesh.periodic =
        periodic != std::string::npos && periodic > 0 && (text[periodic - 1] == '\n' || text[periodic - 1] == '\r');
    if (fault.empty() && mesh.periodic)
      PetscCall(PetscPrintf(PETSC_COMM_SELF, "pulmo: note: %s\n", periodic_note(file).c_str()));
  } else if (is_saved_mesh(file)) {
    fault = "is a mesh that -mesh_save wrote: only -dm_plex_filename takes it; give the file that it was made of";
  } else {
    PetscCall(read_other(file, mesh, fault));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode check_mesh_file(MPI_Comm comm, const char *option, const std::string &file)
{
  PetscMPIInt rank;
  std::string fault;
  bool saved = false;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) saved = is_saved_mesh(file);
  PetscCall(from_root(comm, saved));
  if (saved) {
    SavedMesh mesh;
    SavedMesh::Slice slice;
    PetscCall(read_saved_mesh(comm, file, mesh, slice, fault));
  } else if (rank == 0) {
    MeshFile mesh;
    PetscCall(read_mesh_file(file, mesh, fault));
  }
  PetscCall(from_root(comm, fault));
  PulmoUserCheck(fault.empty(), comm, "%s %s %s", option, file.c_str(), fault.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
