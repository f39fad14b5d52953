// Meshes that ranks read together: how one is saved (-mesh_save), and how one is made of such a file.
#include "pulmo/base/whole_file.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/read_mesh.hpp"

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>

namespace pulmo {

PetscErrorCode Mesh::check_settled(MPI_Comm comm, const SavedMesh &file) const
{
  PetscFunctionBeginUser;
  PulmoUserCheck(!scale_given_ || scale_ == file.scale, comm,
                 "-mesh_scale %.9g: the mesh %s was saved with %.9g, which it keeps; leave the option out, or save the "
                 "mesh anew with the other",
                 (double)scale_, file_.c_str(), file.scale);
  std::string names;
  for (const std::string &name : file.prefer) names += (names.empty() ? "" : ",") + name;
  PulmoUserCheck(prefer_.empty() || prefer_ == file.prefer, comm,
                 "-mesh_prefer: in the mesh %s every facet has one name; it was saved %s%s: leave the option out, or "
                 "save the mesh anew with the other",
                 file_.c_str(), names.empty() ? "without this option" : "with ", names.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::take_saved(const Options &options, OwnOptions &own, Whole &whole)
{
  const MPI_Comm comm = options.comm();
  SavedMesh file;
  SavedMesh::Slice slice;
  std::string fault;
  char partitioner[64] = "";
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-dm_plex_reorder", &given));
  PulmoUserCheck(!given, comm, "-dm_plex_reorder: the cells of %s are in a good order already; leave the option out",
                 file_.c_str());
  // PTScotch (7.0) crashes on graphs that more than four ranks share
  PetscCall(
      PetscOptionsGetString(nullptr, nullptr, "-petscpartitioner_type", partitioner, sizeof(partitioner), &given));
  PulmoUserCheck(!given || std::strcmp(partitioner, "ptscotch") != 0, comm,
                 "-petscpartitioner_type ptscotch crashes on a mesh that ranks read together, such as %s; leave the "
                 "option out (METIS then makes the parts)",
                 file_.c_str());
  PetscCall(own.set("-petscpartitioner_type", "metis"));
  PetscCall(read_saved_mesh(comm, file_, file, slice, fault));
  PulmoUserCheck(fault.empty(), comm, "-dm_plex_filename %s %s", file_.c_str(), fault.c_str());
  PetscCall(check_settled(comm, file));
  PetscCall(print_notes(comm, file.notes));
  scale_ = file.scale;
  scale_given_ = scale_given_ || file.scale_given;
  parts_.clear();
  for (const SavedMesh::Part &p : file.parts)
    parts_.push_back({p.name, p.dimension, static_cast<PetscInt>(p.elements), p.measure, p.inside, nullptr});
  whole = {static_cast<PetscInt>(file.cells), file.volume * scale_ * scale_ * scale_};
  tetrahedra_ = static_cast<PetscInt>(file.tetrahedra);
  PetscCall(build(comm, file, slice));
  if (options.varies_by_cell()) PetscCall(label_places(slice.places));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::build(MPI_Comm comm, const SavedMesh &file, const SavedMesh::Slice &slice)
{
  std::vector<PetscInt> cells;
  std::vector<PetscReal> coordinates;
  const auto n_cells = static_cast<PetscInt>(slice.cells.size());
  PetscInt vertex_begin, vertex_end;
  SFHandle sf; // of vertices; PETSc makes the coordinates with it

  PetscFunctionBeginUser;
  for (const auto &cell : slice.cells) // PETSc counts the corners of a tetrahedron the other way round
    for (const int i : {1, 0, 2, 3}) cells.push_back(cell[i]);
  for (const auto &x : slice.nodes) coordinates.insert(coordinates.end(), x.begin(), x.end());
  PetscCall(DMPlexCreateFromCellListParallelPetsc(comm, 3, n_cells, static_cast<PetscInt>(slice.nodes.size()),
                                                  static_cast<PetscInt>(file.nodes), 4, PETSC_TRUE, cells.data(), 3,
                                                  coordinates.data(), sf.out(), nullptr, dm_.out()));
  PetscCall(DMPlexSetRefinementUniform(dm_, PETSC_TRUE));
  PetscCall(create_labels());
  PetscCall(DMPlexGetDepthStratum(dm_, 0, &vertex_begin, &vertex_end));
  std::vector<PetscInt> numbers = cells; // in the whole mesh, of this rank's vertices: PETSc has them in this order
  std::sort(numbers.begin(), numbers.end());
  numbers.erase(std::unique(numbers.begin(), numbers.end()), numbers.end());
  PetscCheck(static_cast<PetscInt>(numbers.size()) == vertex_end - vertex_begin, PETSC_COMM_SELF, PETSC_ERR_PLIB,
             "%d vertices of %d", static_cast<int>(vertex_end - vertex_begin), static_cast<int>(numbers.size()));
  for (PetscInt c = 0; c < n_cells; ++c) {
    for (const int part : file.volumes[slice.volumes[c]]) PetscCall(DMLabelSetValue(parts_[part].label, c, 3));
    for (int corner = 0; corner < 4; ++corner) {
      const int part = slice.facets[c][corner];
      PetscInt vertices[3], k = 0, n;
      const PetscInt *joined;
      if (part < 0) continue;
      for (int i = 0; i < 4; ++i)
        if (i != corner)
          vertices[k++] =
              vertex_begin + static_cast<PetscInt>(std::lower_bound(numbers.begin(), numbers.end(), slice.cells[c][i]) -
                                                   numbers.begin());
      PetscCall(DMPlexGetFullJoin(dm_, 3, vertices, &n, &joined));
      PetscCheck(n == 1, PETSC_COMM_SELF, PETSC_ERR_PLIB, "%d faces of the same vertices", static_cast<int>(n));
      PetscCall(DMLabelSetValue(parts_[part].label, joined[0], 2));
      PetscCall(DMPlexRestoreJoin(dm_, 3, vertices, &n, &joined));
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Mesh::save(const Options &options, bool overwrite)
{
  const MPI_Comm comm = options.comm();
  namespace fs = std::filesystem;
  NamedMesh file;
  ISHandle order;
  std::string fault;
  bool saved = false, periodic = false;
  int error = 0;
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCall(name_file(comm));
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  for (const char *option : {"-dm_refine", "-dm_refine_pre", "-dm_refine_hierarchy"}) {
    PetscBool given;
    PetscCall(PetscOptionsHasName(nullptr, nullptr, option, &given));
    PulmoUserCheck(!given, comm, "-mesh_save writes the mesh as its file has it: give %s when it is read", option);
  }
  if (rank == 0) {
    std::error_code ignored;
    const fs::path folder = fs::absolute(save_, ignored).parent_path();
    saved = is_saved_mesh(file_);
    if (fs::path(save_).extension() != ".h5")
      fault = "name a file that ends in .h5";
    else if (!fs::is_directory(folder, ignored))
      fault = "there is no folder " + folder.string() + "; make it, or name another";
    else if (fs::is_directory(save_, ignored))
      fault = "this is a folder; name a file";
    else if (fs::exists(save_, ignored) && !overwrite)
      fault = "there is such a file; name another, or give -output_overwrite";
    else if (fs::equivalent(save_, file_, ignored))
      fault = "this is the mesh itself; name another file";
  }
  PetscCall(from_root(comm, fault));
  PulmoUserCheck(fault.empty(), comm, "-mesh_save %s: %s", save_.c_str(), fault.c_str());
  PetscCall(from_root(comm, saved));
  PulmoUserCheck(!saved, comm, "-dm_plex_filename %s is a mesh that -mesh_save wrote; copy it", file_.c_str());
  PetscCall(read_on_root(comm, file, &periodic));
  PetscCall(build(comm, file));
  PetscCall(DMPlexGetOrdering(dm_, MATORDERINGRCM, nullptr, order.out()));
  if (rank == 0) {
    SavedMesh about = SavedMesh::of(file);
    about.scale = scale_;
    about.scale_given = scale_given_;
    about.prefer = prefer_;
    if (periodic) about.notes.insert(about.notes.begin(), periodic_note(file_));
    std::vector<int> cells(file.cells.size());
    const PetscInt *numbers;
    PetscCall(ISGetIndices(order, &numbers));
    for (std::size_t c = 0; c < cells.size(); ++c) cells[numbers[c]] = static_cast<int>(c);
    PetscCall(ISRestoreIndices(order, &numbers));
    const std::vector<char> image = image_of(about, file, cells);
    error = image.empty() ? ENOMEM : write_whole(save_, image);
  }
  PetscCallMPI(MPI_Bcast(&error, 1, MPI_INT, 0, comm));
  PulmoFailureCheck(error == 0, comm, "cannot write %s (%s): free the disk, or name another file", save_.c_str(),
                    std::strerror(error));
  double cells = static_cast<double>(file.cells.size());
  PetscCallMPI(MPI_Bcast(&cells, 1, MPI_DOUBLE, 0, comm));
  PetscCall(PetscPrintf(comm, "saved %s: %.0f cells, %d names; read it with -dm_plex_filename\n", save_.c_str(), cells,
                        static_cast<int>(parts_.size())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
