#include "pulmo/mesh.hpp"

#include "pulmo/msh.hpp"
#include "pulmo/units.hpp"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <sstream>

namespace pulmo {

namespace {

/// Cells whose volume is below this share of (longest edge)^3 are degenerate.
constexpr PetscReal degenerate = 1e-10;

/// Volume outside which a ventilated lung betrays the wrong unit, mm^3 (a mouse's lung at a tenth of the size of
/// a man's holds 2500 mm^3; the same in metres 2.5e-6 mm^3).
constexpr PetscReal least_lung = 1e-1, largest_lung = 1e9;

/// Whether the first cell of a mesh has more nodes than corners.
PetscErrorCode has_curved_cells(DM dm, bool &curved)
{
  Vec coordinates;
  PetscSection section;
  PetscScalar *values = nullptr;
  PetscInt begin, end, dim, corners, n;

  PetscFunctionBeginUser;
  curved = false;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  if (begin == end) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMGetCoordinateDim(dm, &dim));
  PetscCall(DMPlexGetConeSize(dm, begin, &corners)); // of a mesh of cells and vertices
  PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
  PetscCall(DMGetCoordinateSection(dm, &section));
  PetscCall(DMPlexVecGetClosure(dm, section, coordinates, begin, &n, &values));
  curved = n > corners * dim;
  PetscCall(DMPlexVecRestoreClosure(dm, section, coordinates, begin, &n, &values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether PETSc takes a file of this name for gmsh's.
bool is_msh(const std::string &file)
{
  const std::string extension = std::filesystem::path(file).extension();
  return extension == ".msh" || extension == ".msh2" || extension == ".msh4";
}

/// Reads the file on this rank; @p fault tells what is wrong with it (msh_fault()), or is empty.
PetscErrorCode find_fault(const std::string &file, std::string &fault)
{
  std::error_code error;
  std::ifstream in;
  DMHandle trial;
  bool curved = false;

  PetscFunctionBeginUser;
  if (std::filesystem::is_regular_file(file, error)) in.open(file, std::ios::binary);
  if (!in.is_open() || in.peek() == std::ifstream::traits_type::eof()) {
    fault = "cannot be read: there is no such file, or it is empty; check its name";
  } else if (is_msh(file)) {
    std::ostringstream content;
    content << in.rdbuf();
    fault = msh_fault(content.str());
  } else { // another format of PETSc's
    PetscCall(PetscPushErrorHandler(PetscReturnErrorHandler, nullptr));
    const bool readable = DMPlexCreateFromFile(PETSC_COMM_SELF, file.c_str(), "pulmo", PETSC_FALSE, trial.out()) == 0;
    PetscCall(PetscPopErrorHandler());
    if (readable) PetscCall(has_curved_cells(trial, curved));
    if (!readable)
      fault = "is not a readable mesh; pulmo reads gmsh's MSH 2.2 and 4.1 (ASCII or binary), in files that end in .msh";
    else if (curved)
      fault = "holds elements of higher order; save it with straight ones";
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Corner coordinates (4 x 3, mm) of a local tetrahedron.
PetscErrorCode cell_corners(DM dm, PetscInt cell, PetscScalar x[12])
{
  Vec coordinates;
  PetscSection section;
  PetscScalar *values = nullptr;
  PetscInt n;

  PetscFunctionBeginUser;
  PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
  PetscCall(DMGetCoordinateSection(dm, &section));
  PetscCall(DMPlexVecGetClosure(dm, section, coordinates, cell, &n, &values));
  for (PetscInt i = 0; i < 12; ++i) x[i] = i < n ? values[i] : 0;
  PetscCall(DMPlexVecRestoreClosure(dm, section, coordinates, cell, &n, &values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Which mesh points other ranks have, too.
PetscErrorCode find_shared_points(DM dm, PetscInt point_end, std::vector<char> &shared)
{
  PetscSF sf;
  PetscInt roots, n_leaves;
  const PetscInt *leaves, *degrees;

  PetscFunctionBeginUser;
  shared.assign(static_cast<std::size_t>(point_end), 0);
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, &n_leaves, &leaves, nullptr));
  if (roots < 0) PetscFunctionReturn(PETSC_SUCCESS); // one rank
  PetscCall(PetscSFComputeDegreeBegin(sf, &degrees));
  PetscCall(PetscSFComputeDegreeEnd(sf, &degrees));
  for (PetscInt p = 0; p < roots; ++p)
    if (degrees[p] > 0) shared[p] = 1;
  for (PetscInt i = 0; i < n_leaves; ++i) shared[leaves ? leaves[i] : i] = 1;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode check_mesh_file(MPI_Comm comm, const char *option, const std::string &file)
{
  PetscMPIInt rank;
  std::string fault;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) PetscCall(find_fault(file, fault));
  PetscCall(from_root(comm, fault));
  PulmoUserCheck(fault.empty(), comm, "%s %s %s", option, file.c_str(), fault.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("mesh", "mesh (read from -dm_plex_filename)");
  PetscCall(options.given("scale", scale_given_));
  PetscCall(
      options.real("scale", "-", Range::between(1e-9, 1e9), "multiplies the coordinates read, to get mm", scale_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::read(const Options &options, bool ventilated)
{
  const MPI_Comm comm = options.comm();
  char name[PETSC_MAX_PATH_LEN] = "";
  PetscBool given;
  PetscInt dim, overlap;
  Vec coordinates;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-dm_plex_filename", name, sizeof(name), &given));
  PulmoUserCheck(given, comm, "no mesh: give -dm_plex_filename FILE.msh (pulmo's own are in meshes/)");
  file_ = name;
  PetscCall(check_mesh_file(comm, "-dm_plex_filename", file_));

  // one label per physical name
  PetscCall(PetscOptionsSetValue(nullptr, "-dm_plex_gmsh_use_regions", "true"));
  PetscCall(PetscOptionsSetValue(nullptr, "-dm_plex_gmsh_periodic", "false")); // a lung is not periodic
  // cells that are neighbours in space become neighbours in memory: mesh generators number them at random, and then
  // assembly, products and smoothers mostly wait for memory
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-dm_plex_reorder", &given));
  if (!given) PetscCall(PetscOptionsSetValue(nullptr, "-dm_plex_reorder", MATORDERINGRCM));
  PetscCall(DMCreate(comm, dm_.out()));
  PetscCall(DMSetType(dm_, DMPLEX));
  PetscCall(DMSetFromOptions(dm_));
  PetscCall(DMViewFromOptions(dm_, nullptr, "-dm_view"));
  PetscCall(DMPlexGetOverlap(dm_, &overlap));
  PulmoUserCheck(overlap == 0, comm, "-dm_distribute_overlap %d: pulmo works without overlap; leave the option out",
                 static_cast<int>(overlap));
  PetscCall(DMGetDimension(dm_, &dim));
  PulmoUserCheck(dim == 3, comm, "-dm_plex_filename %s holds no volume elements (dimension %d); mesh the volume", name,
                 static_cast<int>(dim));
  PetscCall(DMGetCoordinatesLocal(dm_, &coordinates));
  PetscCall(VecScale(coordinates, scale_));
  PetscCall(DMGetCoordinates(dm_, &coordinates));
  PetscCall(VecScale(coordinates, scale_));
  PetscCall(check_cells(options));
  PetscCall(find_surfaces(options));
  if (ventilated && !scale_given_) {
    PulmoUserCheck(volume_ >= least_lung, comm,
                   "the mesh %s holds %.3g ml, as if its coordinates were in metres: give -mesh_scale 1000 "
                   "(or -mesh_scale 1 if that is the size)",
                   name, (double)(volume_ / units::mm3_per_ml));
    PulmoUserCheck(volume_ <= largest_lung, comm,
                   "the mesh %s holds %.3g ml, as if its coordinates were in micrometres: give -mesh_scale 0.001 "
                   "(or -mesh_scale 1 if that is the size)",
                   name, (double)(volume_ / units::mm3_per_ml));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::check_cells(const Options &options)
{
  const MPI_Comm comm = options.comm();
  PetscInt begin, end;
  struct {
    double share;
    int rank;
  } worst{1, 0}, global;
  PetscReal volume = 0, centre[3] = {0, 0, 0};
  PetscInt bad = 0, foreign = 0;
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  worst.rank = rank;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    DMPolytopeType type;
    PetscScalar x[12] = {0};
    PetscReal J[9], longest = 0;
    PetscCall(DMPlexGetCellType(dm_, c, &type));
    if (type != DM_POLYTOPE_TETRAHEDRON) {
      ++foreign;
      continue;
    }
    PetscCall(cell_corners(dm_, c, x));
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < i; ++j)
        longest = std::max(longest,
                           std::hypot(x[3 * i] - x[3 * j], x[3 * i + 1] - x[3 * j + 1], x[3 * i + 2] - x[3 * j + 2]));
    for (int i = 0; i < 3; ++i)
      for (int d = 0; d < 3; ++d) J[3 * i + d] = x[3 * (i + 1) + d] - x[d];
    // DMPlex numbers the corners of a tetrahedron so that this determinant is negative for a good cell
    const PetscReal det =
        -(J[0] * (J[4] * J[8] - J[5] * J[7]) + J[1] * (J[5] * J[6] - J[3] * J[8]) + J[2] * (J[3] * J[7] - J[4] * J[6]));
    const PetscReal share = longest > 0 ? det / (longest * longest * longest) : 0;
    volume += det / 6;
    if (!(share > degenerate)) ++bad;
    if (!(share >= worst.share)) {
      worst.share = share;
      for (int d = 0; d < 3; ++d) centre[d] = (x[d] + x[3 + d] + x[6 + d] + x[9 + d]) / 4;
    }
  }
  PetscInt counts[3] = {end - begin, bad, foreign};
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, counts, 3, MPIU_INT, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPIU_REAL, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(&worst, &global, 1, MPI_DOUBLE_INT, MPI_MINLOC, comm));
  PetscCallMPI(MPI_Bcast(centre, 3, MPIU_REAL, global.rank, comm));
  cells_ = counts[0];
  volume_ = volume;
  PulmoUserCheck(cells_ > 0, comm, "-dm_plex_filename %s holds no cells", file_.c_str());
  PulmoUserCheck(counts[2] == 0, comm,
                 "-dm_plex_filename %s holds %d cells that are not tetrahedra; mesh with tetrahedra only",
                 file_.c_str(), static_cast<int>(counts[2]));
  PulmoUserCheck(counts[1] == 0, comm,
                 "-dm_plex_filename %s holds %d inverted or degenerate cells, the worst at (%.6g, %.6g, %.6g) mm with "
                 "volume / (longest edge)^3 = %.2g; mesh anew or optimise the mesh in gmsh",
                 file_.c_str(), static_cast<int>(counts[1]), (double)centre[0], (double)centre[1], (double)centre[2],
                 global.share / 6);
  length_ = std::cbrt(volume_ / static_cast<PetscReal>(cells_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::find_surfaces(const Options &options)
{
  const MPI_Comm comm = options.comm();
  PetscInt n, point_end, face_begin, face_end;
  std::vector<char> shared; // [mesh point]: also on another rank

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm_, nullptr, &point_end));
  PetscCall(DMPlexGetHeightStratum(dm_, 1, &face_begin, &face_end));
  PetscCall(find_shared_points(dm_, point_end, shared));
  PetscCall(DMGetNumLabels(dm_, &n));
  for (PetscInt l = 0; l < n; ++l) {
    const char *name;
    DMLabel label;
    ISHandle values_is;
    const PetscInt *values;
    PetscInt n_values, found[2] = {0, 0};                 // facets, facets inside the volume
    PetscInt range[2] = {-PETSC_MAX_INT, -PETSC_MAX_INT}; // -(least), largest value that has facets
    PetscReal area = 0;

    PetscCall(DMGetLabelName(dm_, l, &name));
    if (is_petsc_label(name)) continue;
    PetscCall(DMGetLabel(dm_, name, &label));
    PetscCall(DMLabelGetValueIS(label, values_is.out()));
    PetscCall(ISGetLocalSize(values_is, &n_values));
    PetscCall(ISGetIndices(values_is, &values));
    for (PetscInt v = 0; v < n_values; ++v) { // a name may be given to a surface and to a volume
      ISHandle points_is;
      const PetscInt *points;
      PetscInt n_points;
      PetscCall(DMLabelGetStratumIS(label, values[v], points_is.out()));
      PetscCall(ISGetLocalSize(points_is, &n_points));
      PetscCall(ISGetIndices(points_is, &points));
      for (PetscInt i = 0; i < n_points; ++i) {
        PetscInt support;
        PetscReal a;
        if (points[i] < face_begin || points[i] >= face_end) continue;
        PetscCall(DMPlexGetSupportSize(dm_, points[i], &support));
        PetscCall(DMPlexComputeCellGeometryFVM(dm_, points[i], &a, nullptr, nullptr));
        range[0] = std::max(range[0], -values[v]);
        range[1] = std::max(range[1], values[v]);
        ++found[0];
        if (support > 1 || shared[points[i]])
          ++found[1];
        else
          area += a;
      }
      PetscCall(ISRestoreIndices(points_is, &points));
    }
    PetscCall(ISRestoreIndices(values_is, &values));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, found, 2, MPIU_INT, MPI_SUM, comm));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, range, 2, MPIU_INT, MPI_MAX, comm));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &area, 1, MPIU_REAL, MPI_SUM, comm));
    if (found[0] == 0) continue;
    PulmoUserCheck(-range[0] == range[1], comm,
                   "the mesh %s gives the name '%s' to several groups of facets; join them into one in gmsh",
                   file_.c_str(), name);
    if (found[1] == 0)
      surfaces_[name] = {label, range[1], area};
    else
      inside_.push_back(name);
  }
  PulmoUserCheck(!surfaces_.empty(), comm,
                 "the mesh %s names no surface; give its boundary physical names such as airway and pleura",
                 file_.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Mesh::surface_names() const
{
  std::string names;
  for (const auto &[name, surface] : surfaces_) names += (names.empty() ? "" : ", ") + name;
  return names;
}

PetscErrorCode Mesh::require_surfaces(const std::vector<std::string> &names, const std::string &option) const
{
  PetscFunctionBeginUser;
  for (const std::string &name : names) {
    PulmoUserCheck(std::find(inside_.begin(), inside_.end(), name) == inside_.end(),
                   PetscObjectComm((PetscObject)(DM)dm_),
                   "facets of '%s', which %s asks for, lie inside the volume of mesh %s; name its boundary only",
                   name.c_str(), option.c_str(), file_.c_str());
    PulmoUserCheck(surfaces_.count(name), PetscObjectComm((PetscObject)(DM)dm_),
                   "the mesh %s has no surface '%s', which %s asks for; it has %s: name one of these", file_.c_str(),
                   name.c_str(), option.c_str(), surface_names().c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::facets(const std::string &name, std::vector<PetscInt> &points) const
{
  const Surface &named = surface(name);
  ISHandle stratum;
  PetscInt begin, end, n;
  const PetscInt *all;

  PetscFunctionBeginUser;
  points.clear();
  PetscCall(DMPlexGetHeightStratum(dm_, 1, &begin, &end));
  PetscCall(DMLabelGetStratumIS(named.label, named.value, stratum.out()));
  if (!stratum) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(ISGetLocalSize(stratum, &n));
  PetscCall(ISGetIndices(stratum, &all));
  std::copy_if(all, all + n, std::back_inserter(points), [&](PetscInt p) { return p >= begin && p < end; });
  PetscCall(ISRestoreIndices(stratum, &all));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
