/// @file
/// Parameters of laws and effects that differ from place to place: `-tissue_c1 0.36,right=0.7`.
///
/// Kernels know nothing of it: before a cell or a facet is integrated, its own values take their place among the
/// constants of PetscDS. A region has sharp ends: no value is interpolated or smeared over an interface.
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <map>
#include <string>
#include <vector>

namespace pulmo {

class ParameterFields {
public:
  /// Finds where among the constants of @p composition the parameters are that Options::varying() lists, and the cells
  /// and surfaces that they name. User errors: a number that is no parameter of a kernel, a name that the mesh has not,
  /// two names that share cells, a surface on which nothing reads the parameter, a dataset of another length.
  /// Collective. Notes in @p options what datasets say, whatever the order of cells and their numbers.
  PetscErrorCode setup(Options &options, const Composition &composition);

  bool empty() const { return entries_.empty(); }
  /// How many constants differ from place to place.
  PetscInt size() const { return static_cast<PetscInt>(entries_.size()); }
  /// Their places among the constants of PetscDS.
  const std::vector<PetscInt> &offsets() const { return offsets_; }
  /// Adds the values of a cell (of this rank, counted from 0) to @p row; of a facet of @p surface with that cell behind
  /// it, if @p surface is not empty.
  void append(PetscInt cell, const std::string &surface, std::vector<PetscReal> &row) const;
  /// Puts these values into @p constants.
  void patch(PetscInt cell, const std::string &surface, std::vector<PetscScalar> &constants) const;

  /// Takes the size of each value of the one with number @p which into @p least, zeros aside, and @p most. Collective.
  PetscErrorCode add_sizes(MPI_Comm comm, std::size_t which, PetscReal &least, PetscReal &most) const;

private:
  struct Entry {
    PetscReal everywhere = 0;
    std::vector<PetscReal> of_cell; ///< where a region has a value of its own; empty if none has
    std::map<std::string, PetscReal> of_surface;
  };

  PetscErrorCode name_parts(MPI_Comm comm, const Composition &composition, const char *owner,
                            const Options::Varying &varying, const std::vector<Mesh::Region> &regions, Entry &entry);
  /// Adds a parameter that follows from those before it.
  PetscErrorCode derive(MPI_Comm comm, const Composition &composition, const DerivedParameter &parameter);
  /// Holds all cells against what parameters must be to each other.
  PetscErrorCode check_relations(MPI_Comm comm, const Composition &composition) const;
  PetscErrorCode take_dataset(Options &options, const Mesh &mesh, const Options::Varying &varying, Entry &entry);
  PetscReal value(const Entry &entry, PetscInt cell, const std::string &surface) const;

  std::vector<Entry> entries_;
  std::vector<PetscInt> offsets_;
};

} // namespace pulmo
