/// @file
/// The mesh of a scene: reading, scaling, distribution, checks, named surfaces.
#pragma once

#include "pulmo/mesh/elements.hpp"
#include "pulmo/mesh/mesh_file.hpp"
#include "pulmo/mesh/saved_mesh.hpp"

#include <functional>
#include <map>
#include <vector>

namespace pulmo {

/// A tetrahedral DMPlex with named surfaces. Coordinates in mm.
class Mesh {
public:
  /// A named surface: the exterior facets that carry the physical name.
  struct Surface {
    DMLabel label = nullptr; ///< owned by the DM
    PetscInt value = 0;      ///< stratum of the label
    PetscReal area = 0;      ///< mm^2, reference configuration, all ranks
  };
  /// What the file says of a name: the ranks together have all of it and no more (Mesh::read checks that). Surface and
  /// volume of one name are two parts.
  struct Part {
    std::string name;
    PetscInt dimension = 2;  ///< 2: facets, 3: cells; the stratum of the label
    PetscInt elements = 0;   ///< facets or cells of the file
    PetscReal measure = 0;   ///< mm^2 or mm^3, reference configuration, all ranks
    bool inside = false;     ///< has facets within the volume: no boundary
    DMLabel label = nullptr; ///< owned by the DM
  };
  /// A part of the volume: a connected body, or what carries a physical name.
  struct Region {
    std::string name;
    bool body = false;           ///< one connected body and no more
    std::vector<PetscInt> cells; ///< those of this rank, counted from 0
  };
  /// A connected body: cells that are joined by facets. Bodies that share no more than edges and vertices are apart.
  struct Body {
    std::vector<PetscInt> cells;                   ///< those of this rank, counted from 0
    PetscReal centroid[3] = {0, 0, 0}, volume = 0; ///< mm, mm^3
  };
  /// A vertex that two bodies share.
  struct Hinge {
    PetscInt body[2] = {-1, -1}; ///< -1: there is none
    PetscReal x[3] = {0, 0, 0};  ///< mm
  };
  /// A vertex held against rigid motion (Mesh::rigid_pins).
  struct Pin {
    PetscInt vertex = -1; ///< local mesh point, -1 on ranks without it
    bool component[3] = {false, false, false};
    PetscReal x[3] = {0, 0, 0}; ///< mm
  };

  /// Declares -mesh_scale, -mesh_prefer and -mesh_save; the file name is PETSc's -dm_plex_filename.
  PetscErrorCode declare(Options &options);
  /// Reads -dm_plex_filename, renumbers, distributes, scales and checks it. @p ventilated: the scene is a lung, so a
  /// volume outside what any lung has betrays the wrong unit.
  PetscErrorCode read(const Options &options, bool ventilated);

  /// Whether the mesh is to be saved, and no more.
  bool saves() const { return !save_.empty(); }
  /// Reads and checks -dm_plex_filename and writes it to the file of -mesh_save (-mesh_scale and -mesh_prefer with it).
  /// @p overwrite: also where there is a file of that name.
  PetscErrorCode save(const Options &options, bool overwrite);

  /// For each cell of this rank, counted from 0, the number of its tetrahedron in the mesh file; with -dm_refine that
  /// of the tetrahedron it is a piece of. Empty unless the options of read() vary by cell.
  const std::vector<PetscInt> &places_in_file() const { return places_; }
  /// Tetrahedra of the mesh file.
  PetscInt tetrahedra_in_file() const { return tetrahedra_; }

  DM dm() const { return dm_; }
  const std::string &file() const { return file_; }
  PetscReal volume() const { return volume_; }   ///< mm^3, reference configuration
  PetscReal length() const { return length_; }   ///< mean cell size (volume per cell)^(1/3), mm
  PetscReal edge() const { return 2 * length_; } ///< about the mean edge of a cell, mm
  PetscInt cells() const { return cells_; }      ///< on all ranks
  const std::map<std::string, Surface> &surfaces() const { return surfaces_; }
  const Surface &surface(const std::string &name) const { return surfaces_.at(name); }
  /// Every name of the file's, those of facets first.
  const std::vector<Part> &parts() const { return parts_; }
  /// Facets or cells of a part on this rank (mesh points, in order).
  PetscErrorCode elements(const Part &part, std::vector<PetscInt> &points) const;
  /// The facets of a surface on this rank (mesh points).
  PetscErrorCode facets(const std::string &name, std::vector<PetscInt> &points) const;
  /// Shows @p visit the corners, the middles of the edges and the middles of these facets, mm; each facet its own.
  PetscErrorCode visit_surface(const std::string &name, const std::function<void(const PetscReal x[3])> &visit) const;

  /// User error, naming @p option and the surfaces that exist, unless all @p names are surfaces of the mesh.
  PetscErrorCode require_surfaces(const std::vector<std::string> &names, const std::string &option) const;
  /// User error, naming the place and ending with @p complaint, unless every connected body has facets of one of these
  /// surfaces.
  PetscErrorCode require_in_each_body(const std::vector<std::string> &names, const std::string &complaint) const;
  /// The connected bodies, in the order of their places: along x, then y, then z.
  PetscErrorCode bodies(std::vector<Body> &list) const;
  /// body_of[cell of this rank, counted from 0]: which of the list.
  PetscErrorCode body_of_cells(const std::vector<Body> &list, std::vector<PetscInt> &body_of) const;
  /// The vertices of a body that this rank's cells of it have (mesh points, in order).
  PetscErrorCode vertices(const Body &body, std::vector<PetscInt> &points) const;
  /// A vertex where bodies of the list hang together, if there is any.
  PetscErrorCode hinge(const std::vector<Body> &list, Hinge &found) const;
  /// "the body around (x, y, z) mm of mesh FILE"
  std::string body_text(const Body &body) const;
  /// Three vertices of a body and 3, 2, 1 components that remove exactly its six rigid-body modes.
  PetscErrorCode rigid_pins(const Body &body, std::vector<Pin> &pins) const;
  /// Every connected body and every named part of the volume. A body without a name of its own is called body_1, ...,
  /// counted along x.
  PetscErrorCode regions(std::vector<Region> &list) const;
  /// Coordinates of a vertex or of the middle of an edge or face, mm.
  PetscErrorCode node_coordinates(PetscInt point, PetscReal x[3]) const
  {
    return pulmo::node_coordinates(dm_, point, x);
  }

private:
  /// How many cells there are in the file, and their volume, mm^3.
  struct Whole {
    PetscInt cells = 0;
    PetscReal volume = 0;
  };

  /// Options that pulmo sets for PETSc while it reads a mesh: a run may read several, one after the other.
  class OwnOptions {
  public:
    OwnOptions() = default;
    ~OwnOptions();
    OwnOptions(const OwnOptions &) = delete;
    OwnOptions &operator=(const OwnOptions &) = delete;
    /// Sets one, unless the user gave it.
    PetscErrorCode set(const char *option, const char *value);

  private:
    std::vector<const char *> set_;
  };

  static PetscErrorCode print_notes(MPI_Comm comm, const std::vector<std::string> &notes);
  /// Takes the name of the file from the options.
  PetscErrorCode name_file(MPI_Comm comm);
  /// Reads the file on rank 0.
  PetscErrorCode read_on_root(MPI_Comm comm, NamedMesh &file, bool *periodic = nullptr);
  /// The mesh of the file, its labels and parts; all cells on rank 0.
  PetscErrorCode take_file(const Options &options, OwnOptions &own, Whole &whole);
  /// The same of a file of -mesh_save; cells as they follow one another in the file, as many on each rank.
  PetscErrorCode take_saved(const Options &options, OwnOptions &own, Whole &whole);
  /// User error unless -mesh_scale and -mesh_prefer, where they are given, are those that the file was made with.
  PetscErrorCode check_settled(MPI_Comm comm, const SavedMesh &file) const;
  /// Makes the mesh and its labels on rank 0.
  PetscErrorCode build(MPI_Comm comm, const NamedMesh &file);
  /// Makes the mesh and its labels of what each rank has read.
  PetscErrorCode build(MPI_Comm comm, const SavedMesh &file, const SavedMesh::Slice &slice);
  /// Labels for the parts.
  PetscErrorCode create_labels();
  /// User error unless number, area and volume of every part are those of the file.
  PetscErrorCode check_parts(MPI_Comm comm, PetscInt cells_in_file, PetscReal volume_of_file) const;
  PetscErrorCode check_cells(const Options &options);
  PetscErrorCode find_surfaces(const Options &options);
  /// Labels that carry the number of each cell in the file through reordering, distribution and refinement.
  /// @p place: of the cells of this rank.
  PetscErrorCode label_places(const std::vector<int> &place);
  /// Reads these labels and takes them away.
  PetscErrorCode read_places();
  std::string surface_names() const;

  DMHandle dm_;
  std::string file_, save_;
  PetscReal scale_ = 1, volume_ = 0, length_ = 0;
  bool scale_given_ = false;
  PetscInt cells_ = 0, tetrahedra_ = 0;
  std::vector<PetscInt> places_;
  std::map<std::string, Surface> surfaces_;
  std::vector<std::string> prefer_;
  std::vector<Part> parts_;
};

/// Makes `-petscpartitioner_type metis` known to PETSc (METIS k-way, on rank 0).
PetscErrorCode register_metis_partitioner();

} // namespace pulmo
