#include "pulmo/mesh/mesh.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/mesh/node_order.hpp"
#include "pulmo/mesh/read_mesh.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iterator>

namespace pulmo {

namespace {

/// Volume outside which a ventilated lung betrays the wrong unit, mm^3 (a mouse's lung at a tenth of the size of
/// a man's holds 2500 mm^3; the same in metres 2.5e-6 mm^3).
constexpr PetscReal least_lung = 1e-1, largest_lung = 1e9;

/// Options of PETSc's that would change the mesh in a way that pulmo does not allow for.
struct Refused {
  const char *option, *why;
};
constexpr Refused refused[] = {
    {"-dm_plex_scale", "PETSc applies it several times; give -mesh_scale"},
    {"-dm_plex_boundary_label", "surfaces are named in the mesh; leave the option out"},
    {"-dm_plex_boundary_filename", "pulmo reads a mesh of the volume, -dm_plex_filename"},
    {"-dm_plex_interpolate", "pulmo needs faces and edges and makes them; leave the option out"},
    {"-dm_plex_interpolate_pre", "pulmo needs faces and edges and makes them; leave the option out"},
    {"-dm_plex_adj_cone", "pulmo's matrices need PETSc's usual adjacency; leave the option out"},
    {"-dm_plex_adj_closure", "pulmo's matrices need PETSc's usual adjacency; leave the option out"},
    {"-dm_plex_create_fv_ghost_cells", "pulmo has no finite volumes; leave the option out"},
    {"-dm_coord_space", "pulmo's cells are straight; leave the option out"},
    {"-dm_coord_petscspace_degree", "pulmo's cells are straight; leave the option out"},
    {"-dm_extrude", "pulmo solves on the mesh of the file; leave the option out"},
    {"-dm_coarsen", "pulmo solves on the mesh of the file; give it a coarser one"},
    {"-dm_coarsen_hierarchy", "pulmo solves on the mesh of the file; give it a coarser one"},
    {"-dm_refine_uniform_pre", "pulmo refines every cell alike; leave the option out"},
    {"-dm_refine_volume_limit_pre", "pulmo refines every cell alike: give -dm_refine"},
    {"-dm_distribute_overlap", "pulmo works without overlap; leave the option out"},
};

/// The number of a cell in the file is carried by a label for each digit to this base.
constexpr PetscInt place_base = 64;

std::string place_label(PetscInt digit)
{
  return "pulmo place " + std::to_string(digit);
}

PetscErrorCode refuse_options(MPI_Comm comm)
{
  PetscBool given, distribute = PETSC_TRUE;
  PetscMPIInt size;

  PetscFunctionBeginUser;
  for (const auto &[option, why] : refused) {
    PetscCall(PetscOptionsHasName(nullptr, nullptr, option, &given));
    PulmoUserCheck(!given, comm, "%s: %s", option, why);
  }
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, "-dm_distribute", &distribute, nullptr));
  PulmoUserCheck(distribute || size == 1, comm,
                 "-dm_distribute off: one of the %d ranks would have all of the mesh; leave the option out", size);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Makes what rank 0 knows of the parts known to all ranks.
PetscErrorCode share(MPI_Comm comm, const NamedMesh &file, std::vector<Mesh::Part> &parts)
{
  auto n = static_cast<std::uint64_t>(file.parts.size());

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, 0, comm));
  parts.assign(n, {});
  for (std::size_t i = 0; i < n; ++i) {
    Mesh::Part &part = parts[i];
    double numbers[4] = {0, 0, 0, 0};
    if (i < file.parts.size()) {
      const NamedMesh::Part &known = file.parts[i];
      part.name = known.name;
      numbers[0] = known.dimension;
      numbers[1] = static_cast<double>(known.elements.size());
      numbers[2] = known.measure;
      numbers[3] = known.inside;
    }
    PetscCall(from_root(comm, part.name));
    PetscCallMPI(MPI_Bcast(numbers, 4, MPI_DOUBLE, 0, comm));
    part.dimension = static_cast<PetscInt>(numbers[0]);
    part.elements = static_cast<PetscInt>(numbers[1]);
    part.measure = numbers[2];
    part.inside = numbers[3] != 0;
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

PetscErrorCode Mesh::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("mesh", "mesh (read from -dm_plex_filename)");
  PetscCall(options.given("scale", scale_given_));
  PetscCall(
      options.real("scale", "-", Range::between(1e-9, 1e9), "multiplies the coordinates read, to get mm", scale_));
  PetscCall(options.names("prefer", "surfaces in order: a facet in several groups of the file has the first of them",
                          prefer_));
  PetscCall(options.text("save", "write the mesh to this file (.h5), which ranks read together, and stop", save_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

Mesh::OwnOptions::~OwnOptions()
{
  for (const char *option : set_) (void)PetscOptionsClearValue(nullptr, option);
}

PetscErrorCode Mesh::OwnOptions::set(const char *option, const char *value)
{
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, option, &given));
  if (given) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscOptionsSetValue(nullptr, option, value));
  set_.push_back(option);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::print_notes(MPI_Comm comm, const std::vector<std::string> &notes)
{
  PetscFunctionBeginUser;
  for (const std::string &note : notes) PetscCall(PetscPrintf(comm, "pulmo: note: %s\n", note.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::name_file(MPI_Comm comm)
{
  char name[PETSC_MAX_PATH_LEN] = "";
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-dm_plex_filename", name, sizeof(name), &given));
  PulmoUserCheck(given, comm, "no mesh: give -dm_plex_filename FILE.msh (pulmo's own are in meshes/)");
  PetscCall(refuse_options(comm));
  file_ = name;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::read_on_root(MPI_Comm comm, NamedMesh &file, bool *periodic)
{
  std::string fault;
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) {
    MeshFile read;
    PetscCall(read_mesh_file(file_, read, fault));
    if (fault.empty()) fault = make_named_mesh(read, prefer_, scale_, file);
    if (periodic) *periodic = read.periodic;
  }
  PetscCall(from_root(comm, fault));
  PulmoUserCheck(fault.empty(), comm, "-dm_plex_filename %s %s", file_.c_str(), fault.c_str());
  PetscCall(print_notes(PETSC_COMM_SELF, file.notes)); // of rank 0, which has some
  PetscCall(share(comm, file, parts_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::take_file(const Options &options, OwnOptions &own, Whole &whole)
{
  const MPI_Comm comm = options.comm();
  NamedMesh file;

  PetscFunctionBeginUser;
  PetscCall(read_on_root(comm, file));
  double numbers[2] = {static_cast<double>(file.cells.size()), file.volume * scale_ * scale_ * scale_};
  PetscCallMPI(MPI_Bcast(numbers, 2, MPI_DOUBLE, 0, comm));
  whole = {static_cast<PetscInt>(numbers[0]), numbers[1]};
  PetscCall(build(comm, file));
  tetrahedra_ = file.tetrahedra;
  PetscCallMPI(MPI_Bcast(&tetrahedra_, 1, MPIU_INT, 0, comm));
  if (options.varies_by_cell()) PetscCall(label_places(file.place));
  // cells that are neighbours in space become neighbours in memory: mesh generators number them at random, and then
  // assembly, products and smoothers mostly wait for memory
  PetscCall(own.set("-dm_plex_reorder", MATORDERINGRCM));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::read(const Options &options, bool ventilated)
{
  const MPI_Comm comm = options.comm();
  bool saved = false;
  Whole whole;
  PetscMPIInt rank;
  Vec local, global;

  PetscFunctionBeginUser;
  PetscCall(name_file(comm));
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) saved = is_saved_mesh(file_);
  PetscCall(from_root(comm, saved));
  places_.clear();
  {
    OwnOptions own;
    if (saved)
      PetscCall(take_saved(options, own, whole));
    else
      PetscCall(take_file(options, own, whole));
    PetscCall(DMSetFromOptions(dm_)); // reorders, distributes, refines
  }
  if (options.varies_by_cell()) PetscCall(read_places());
  PetscCall(DMViewFromOptions(dm_, nullptr, "-dm_view"));
  for (Part &part : parts_) PetscCall(DMGetLabel(dm_, part.name.c_str(), &part.label));
  PetscCall(DMGetCoordinatesLocal(dm_, &local));
  PetscCall(DMGetCoordinates(dm_, &global)); // made of the local ones, so before these are scaled
  PetscCall(VecScale(local, scale_));
  PetscCall(VecScale(global, scale_));
  for (Part &part : parts_) part.measure *= part.dimension == 2 ? scale_ * scale_ : scale_ * scale_ * scale_;
  PetscCall(check_cells(options));
  PetscCall(check_parts(comm, whole.cells, whole.volume));
  PetscCall(find_surfaces(options));
  if (ventilated && !scale_given_) {
    const char *what_to_do = saved ? "save it anew with" : "give";
    PulmoUserCheck(volume_ >= least_lung, comm,
                   "the mesh %s holds %.3g ml, as if its coordinates were in metres: %s -mesh_scale 1000 "
                   "(or -mesh_scale 1 if that is the size)",
                   file_.c_str(), (double)(volume_ / units::mm3_per_ml), what_to_do);
    PulmoUserCheck(volume_ <= largest_lung, comm,
                   "the mesh %s holds %.3g ml, as if its coordinates were in micrometres: %s -mesh_scale 0.001 "
                   "(or -mesh_scale 1 if that is the size)",
                   file_.c_str(), (double)(volume_ / units::mm3_per_ml), what_to_do);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::build(MPI_Comm comm, const NamedMesh &file)
{
  std::vector<PetscInt> cells;
  std::vector<PetscReal> coordinates;
  const auto n_cells = static_cast<PetscInt>(file.cells.size());

  PetscFunctionBeginUser;
  for (const auto &cell : file.cells) // PETSc counts the corners of a tetrahedron the other way round
    for (const int i : {1, 0, 2, 3}) cells.push_back(cell[i]);
  for (const auto &x : file.nodes) coordinates.insert(coordinates.end(), x.begin(), x.end());
  PetscCall(DMPlexCreateFromCellListPetsc(comm, 3, n_cells, static_cast<PetscInt>(file.nodes.size()), 4, PETSC_TRUE,
                                          cells.data(), 3, coordinates.data(), dm_.out()));
  PetscCall(DMPlexSetRefinementUniform(dm_, PETSC_TRUE));
  PetscCall(create_labels());
  for (std::size_t i = 0; i < file.parts.size(); ++i)
    for (const int element : file.parts[i].elements) {
      PetscInt point = element, vertices[3], n = 1;
      const PetscInt *joined = &point;
      if (parts_[i].dimension == 2) {
        for (int k = 0; k < 3; ++k) vertices[k] = n_cells + file.facets[element][k];
        PetscCall(DMPlexGetFullJoin(dm_, 3, vertices, &n, &joined));
        PetscCheck(n == 1, PETSC_COMM_SELF, PETSC_ERR_PLIB, "%d faces of the same vertices", static_cast<int>(n));
        point = joined[0];
        PetscCall(DMPlexRestoreJoin(dm_, 3, vertices, &n, &joined));
      }
      PetscCall(DMLabelSetValue(parts_[i].label, point, parts_[i].dimension));
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::create_labels()
{
  PetscFunctionBeginUser;
  for (Part &part : parts_) {
    PetscCall(DMCreateLabel(dm_, part.name.c_str()));
    PetscCall(DMGetLabel(dm_, part.name.c_str(), &part.label));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A label for each digit of the number: labels with a value for each cell take PETSc a kilobyte a cell.
PetscErrorCode Mesh::label_places(const std::vector<int> &place)
{
  PetscInt digit = 0;

  PetscFunctionBeginUser;
  for (std::int64_t unit = 1; unit < tetrahedra_; ++digit, unit *= place_base) {
    DMLabel label;
    PetscCall(DMCreateLabel(dm_, place_label(digit).c_str()));
    PetscCall(DMGetLabel(dm_, place_label(digit).c_str(), &label));
    for (std::size_t c = 0; c < place.size(); ++c)
      PetscCall(DMLabelSetValue(label, static_cast<PetscInt>(c), static_cast<PetscInt>(place[c] / unit % place_base)));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::read_places()
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm_, 0, &begin, &end));
  places_.assign(static_cast<std::size_t>(end - begin), 0);
  PetscInt digits = 0, found = 0;
  for (std::int64_t unit = 1; unit < tetrahedra_; ++digits, unit *= place_base) {
    DMLabel label;
    PetscCall(DMGetLabel(dm_, place_label(digits).c_str(), &label));
    PetscCheck(label, PETSC_COMM_SELF, PETSC_ERR_PLIB, "a label is lost");
    for (PetscInt value = 0; value < place_base; ++value) {
      ISHandle points;
      const PetscInt *point;
      PetscInt n;
      PetscCall(DMLabelGetStratumIS(label, value, points.out()));
      if (!points) continue;
      PetscCall(ISGetLocalSize(points, &n));
      PetscCall(ISGetIndices(points, &point));
      for (PetscInt i = 0; i < n; ++i) {
        if (point[i] < begin || point[i] >= end) continue; // refinement marks the faces within a cell, too
        places_[static_cast<std::size_t>(point[i] - begin)] += static_cast<PetscInt>(value * unit);
        ++found;
      }
      PetscCall(ISRestoreIndices(points, &point));
    }
    PetscCall(DMRemoveLabel(dm_, place_label(digits).c_str(), nullptr));
  }
  PetscCheck(found == digits * (end - begin), PETSC_COMM_SELF, PETSC_ERR_PLIB, "%d digits of numbers of %d cells",
             static_cast<int>(found), static_cast<int>(end - begin));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::check_parts(MPI_Comm comm, PetscInt cells_in_file, PetscReal volume_of_file) const
{
  constexpr PetscReal rounding = 1e-8;
  PetscInt point_end;
  std::vector<char> shared; // [mesh point]: also on another rank
  std::vector<PetscInt> owned;
  struct Sums {
    PetscInt elements, inside;
    PetscReal measure;
  };
  std::vector<Sums> found;
  PetscInt facets[2] = {0, 0}; // with a name: on the ranks, in the file

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm_, nullptr, &point_end));
  PetscCall(find_shared_points(dm_, point_end, shared));
  PetscCall(owned_points(dm_, 4, owned)); // of every dimension
  std::vector<char> is_owned(static_cast<std::size_t>(point_end), 0);
  for (const PetscInt p : owned) is_owned[p] = 1;
  for (const Part &part : parts_) {
    Sums sums{0, 0, 0};
    std::vector<PetscInt> points;
    PetscCall(elements(part, points));
    for (const PetscInt p : points) {
      PetscReal measure;
      PetscInt cells;
      if (!is_owned[p]) continue;
      PetscCall(DMPlexComputeCellGeometryFVM(dm_, p, &measure, nullptr, nullptr));
      PetscCall(DMPlexGetSupportSize(dm_, p, &cells));
      sums.measure += measure;
      ++sums.elements;
      if (part.dimension == 2 && (cells > 1 || shared[p])) ++sums.inside;
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &sums.elements, 2, MPIU_INT, MPI_SUM, comm));
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &sums.measure, 1, MPIU_REAL, MPI_SUM, comm));
    found.push_back(sums);
    if (part.dimension != 2) continue;
    facets[0] += sums.elements;
    facets[1] += part.elements;
  }
  const auto same = [&](PetscReal a, PetscReal b) { return std::abs(a - b) <= rounding * std::max(std::abs(b), a); };
  for (std::size_t i = 0; i < parts_.size(); ++i) {
    const Part &part = parts_[i];
    const Sums &sums = found[i];
    const bool surface = part.dimension == 2;
    // each refinement cuts all facets, and all cells, into as many
    const PetscInt pieces = surface ? facets[0] / facets[1] : cells_ / cells_in_file;
    PulmoUserCheck(sums.elements == pieces * part.elements && pieces > 0 && same(sums.measure, part.measure) &&
                       (part.inside || sums.inside == 0),
                   comm,
                   "%s '%s' of mesh %s has %d %s and %.9g mm^%d in the file, but %d and %.9g (%d of them inside) as "
                   "PETSc distributed and refined it; leave out options that begin with -dm_ and -petscpartitioner_",
                   surface ? "surface" : "volume", part.name.c_str(), file_.c_str(), static_cast<int>(part.elements),
                   surface ? "facets" : "cells", (double)part.measure, static_cast<int>(part.dimension),
                   static_cast<int>(sums.elements), (double)sums.measure, static_cast<int>(sums.inside));
  }
  PulmoUserCheck(cells_ % cells_in_file == 0 && same(volume_, volume_of_file), comm,
                 "mesh %s has %d cells and %.9g mm^3 in the file, but %d and %.9g as PETSc distributed and refined it; "
                 "leave out options that begin with -dm_ and -petscpartitioner_",
                 file_.c_str(), static_cast<int>(cells_in_file), (double)volume_of_file, static_cast<int>(cells_),
                 (double)volume_);
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
    if (!(share / 6 > degenerate_share)) ++bad;
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
  PetscFunctionBeginUser;
  surfaces_.clear();
  for (const Part &part : parts_)
    if (part.dimension == 2 && !part.inside) surfaces_[part.name] = {part.label, part.dimension, part.measure};
  PulmoUserCheck(!surfaces_.empty(), options.comm(),
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
    const bool inside = std::any_of(parts_.begin(), parts_.end(), [&](const Part &part) {
      return part.dimension == 2 && part.inside && part.name == name;
    });
    PulmoUserCheck(!inside, PetscObjectComm((PetscObject)(DM)dm_),
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
  const auto part =
      std::find_if(parts_.begin(), parts_.end(), [&](const Part &p) { return p.dimension == 2 && p.name == name; });

  PetscFunctionBeginUser;
  PetscCall(elements(*part, points));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::visit_surface(const std::string &name,
                                   const std::function<void(const PetscReal x[3])> &visit) const
{
  std::vector<PetscInt> points;

  PetscFunctionBeginUser;
  PetscCall(facets(name, points));
  for (const PetscInt facet : points) {
    PetscInt *closure = nullptr, n;
    PetscCall(DMPlexGetTransitiveClosure(dm_, facet, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i) {
      PetscReal x[3];
      PetscCall(node_coordinates(closure[2 * i], x));
      visit(x);
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm_, facet, PETSC_TRUE, &n, &closure));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::elements(const Part &part, std::vector<PetscInt> &points) const
{
  ISHandle stratum;
  PetscInt begin, end, n;
  const PetscInt *all;

  PetscFunctionBeginUser;
  points.clear();
  PetscCall(DMPlexGetDepthStratum(dm_, part.dimension, &begin, &end));
  PetscCall(DMLabelGetStratumIS(part.label, part.dimension, stratum.out()));
  if (!stratum) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(ISGetLocalSize(stratum, &n));
  PetscCall(ISGetIndices(stratum, &all)); // refinement marks what lies within a facet or cell, too
  std::copy_if(all, all + n, std::back_inserter(points), [&](PetscInt p) { return p >= begin && p < end; });
  PetscCall(ISRestoreIndices(stratum, &all));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
