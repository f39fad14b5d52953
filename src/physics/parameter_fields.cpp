#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <set>

namespace pulmo {

namespace {

/// The names that an option may use, for a message.
std::string listed(const std::vector<Mesh::Region> &regions, const Mesh &mesh)
{
  std::string text;
  for (const Mesh::Region &r : regions) text += (text.empty() ? "" : ", ") + r.name;
  for (const auto &surface : mesh.surfaces()) text += (text.empty() ? "" : ", ") + surface.first;
  return text;
}

} // namespace

PetscErrorCode ParameterFields::setup(const Options &options, const Composition &composition)
{
  const Mesh &mesh = composition.mesh();
  const MPI_Comm comm = options.comm();
  std::vector<Mesh::Region> regions;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  entries_.clear();
  offsets_.clear();
  if (options.varying().empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(mesh.regions(regions));
  PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
  for (const Options::Varying &v : options.varying()) {
    const char *owner = nullptr;
    const PetscInt offset = composition.constant_at(v.target, &owner);
    PulmoUserCheck(offset >= 0 && *v.target == v.everywhere, comm,
                   "option %s takes one number (%s), not '%s': it is no parameter of a tissue law or a term, and does "
                   "not differ from place to place",
                   v.option.c_str(), v.unit.c_str(), v.text.c_str());
    Entry entry;
    entry.everywhere = v.everywhere;
    std::vector<std::string> taken(static_cast<std::size_t>(end - begin)); // the name that a cell's value is of
    for (const auto &[name, value] : v.by_name) {
      const auto region =
          std::find_if(regions.begin(), regions.end(), [&, n = name](const Mesh::Region &r) { return r.name == n; });
      const bool is_region = region != regions.end(), is_surface = mesh.surfaces().count(name) > 0;
      PulmoUserCheck(is_region || is_surface, comm, "option %s: mesh %s has no volume and no surface '%s'; it has: %s",
                     v.option.c_str(), mesh.file().c_str(), name.c_str(), listed(regions, mesh).c_str());
      const auto readers = composition.surfaces_that_read(owner);
      const bool read_there = v.surfaces && std::find(readers.begin(), readers.end(), name) != readers.end();
      PulmoUserCheck(is_region || read_there, comm,
                     "option %s: nothing reads it on surface '%s'; give the name of a volume, or of a surface that "
                     "this effect acts on",
                     v.option.c_str(), name.c_str());
      if (is_surface) entry.of_surface[name] = value;
      if (!is_region) continue;
      if (entry.of_cell.empty()) entry.of_cell.assign(taken.size(), v.everywhere);
      std::string twice; // another name of the same cell
      for (const PetscInt c : region->cells) {
        if (!taken[c].empty()) twice = taken[c];
        taken[c] = name;
        entry.of_cell[c] = value;
      }
      int overlap = !twice.empty();
      PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &overlap, 1, MPI_INT, MPI_MAX, comm));
      PulmoUserCheck(!overlap, comm,
                     "option %s: volume '%s' shares cells with another one that is named before it; name "
                     "parts that do not overlap",
                     v.option.c_str(), name.c_str());
    }
    entries_.push_back(std::move(entry));
    offsets_.push_back(offset);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscReal ParameterFields::value(const Entry &entry, PetscInt cell, const std::string &surface) const
{
  if (!surface.empty()) {
    const auto found = entry.of_surface.find(surface);
    if (found != entry.of_surface.end()) return found->second;
  }
  return entry.of_cell.empty() ? entry.everywhere : entry.of_cell[static_cast<std::size_t>(cell)];
}

void ParameterFields::append(PetscInt cell, const std::string &surface, std::vector<PetscReal> &row) const
{
  for (const Entry &entry : entries_) row.push_back(value(entry, cell, surface));
}

void ParameterFields::patch(PetscInt cell, const std::string &surface, std::vector<PetscScalar> &constants) const
{
  for (std::size_t k = 0; k < entries_.size(); ++k)
    constants[static_cast<std::size_t>(offsets_[k])] = value(entries_[k], cell, surface);
}

} // namespace pulmo
