#include "pulmo/physics/parameter_fields.hpp"

#include "pulmo/mesh/node_order.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>

namespace pulmo {

namespace {

/// Values that travel at once.
constexpr std::uint64_t most_at_once = 1 << 20;

/// The names that an option may use, for a message.
std::string listed(const std::vector<Mesh::Region> &regions, const Mesh &mesh)
{
  std::string text;
  for (const Mesh::Region &r : regions) text += (text.empty() ? "" : ", ") + r.name;
  for (const auto &surface : mesh.surfaces()) text += (text.empty() ? "" : ", ") + surface.first;
  return text;
}

} // namespace

PetscErrorCode ParameterFields::setup(Options &options, const Composition &composition)
{
  const Mesh &mesh = composition.mesh();
  const MPI_Comm comm = options.comm();
  std::vector<Mesh::Region> regions;

  PetscFunctionBeginUser;
  entries_.clear();
  offsets_.clear();
  if (options.varying().empty()) {
    PetscCall(check_relations(comm, composition));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(mesh.regions(regions));
  for (const Options::Varying &v : options.varying()) {
    const char *owner = nullptr;
    const PetscInt offset = composition.constant_at(v.target, &owner);
    PulmoUserCheck(offset >= 0 && *v.target == v.everywhere, comm,
                   "option %s takes one number (%s), not '%s': it is no parameter of a tissue law or a term, and does "
                   "not differ from place to place",
                   v.option.c_str(), v.unit.c_str(), v.text.c_str());
    Entry entry;
    entry.everywhere = v.everywhere;
    if (v.by_cell)
      PetscCall(take_dataset(options, mesh, v, entry));
    else
      PetscCall(name_parts(comm, composition, owner, v, regions, entry));
    entries_.push_back(std::move(entry));
    offsets_.push_back(offset);
  }
  PetscCall(check_relations(comm, composition));
  for (const DerivedParameter &parameter : composition.derived()) PetscCall(derive(comm, composition, parameter));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ParameterFields::check_relations(MPI_Comm comm, const Composition &composition) const
{
  std::vector<PetscScalar> constants = composition.constants(Step());
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(composition.mesh().dm(), 0, &begin, &end));
  for (const ParameterRelation &relation : composition.relations()) {
    PetscInt wrong = 0;
    for (PetscInt c = 0; c < (empty() ? std::min<PetscInt>(1, end - begin) : end - begin); ++c) {
      patch(c, "", constants);
      if (!relation.holds(constants.data())) wrong = 1;
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &wrong, 1, MPIU_INT, MPI_MAX, comm));
    PulmoUserCheck(!wrong, comm, "%s", relation.complaint.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ParameterFields::derive(MPI_Comm comm, const Composition &composition, const DerivedParameter &parameter)
{
  const char *owner = nullptr;
  const PetscInt offset = composition.constant_at(parameter.target, &owner);
  std::vector<PetscScalar> constants = composition.constants(Step());
  PetscInt begin, end, wrong = 0;
  Entry entry;

  PetscFunctionBeginUser;
  PetscCheck(offset >= 0, comm, PETSC_ERR_ARG_WRONG, "a derived parameter is in no block that was handed over");
  PetscCall(DMPlexGetHeightStratum(composition.mesh().dm(), 0, &begin, &end));
  entry.everywhere = *parameter.target;
  for (PetscInt c = 0; c < end - begin; ++c) {
    patch(c, "", constants);
    entry.of_cell.push_back(parameter.value(constants));
    if (std::isnan(entry.of_cell.back())) wrong = 1;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &wrong, 1, MPIU_INT, MPI_MAX, comm));
  PulmoUserCheck(!wrong, comm, "%s", parameter.complaint.c_str());
  entries_.push_back(std::move(entry));
  offsets_.push_back(offset);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ParameterFields::name_parts(MPI_Comm comm, const Composition &composition, const char *owner,
                                           const Options::Varying &v, const std::vector<Mesh::Region> &regions,
                                           Entry &entry)
{
  const Mesh &mesh = composition.mesh();
  const std::vector<std::string> readers = composition.surfaces_that_read(owner);
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
  std::vector<int> taken(static_cast<std::size_t>(end - begin), -1); // which name a cell's value is of
  for (std::size_t i = 0; i < v.by_name.size(); ++i) {
    const auto &[name, value] = v.by_name[i];
    const auto region =
        std::find_if(regions.begin(), regions.end(), [&, n = name](const Mesh::Region &r) { return r.name == n; });
    const bool is_region = region != regions.end(), is_surface = mesh.surfaces().count(name) > 0;
    PulmoUserCheck(is_region || is_surface, comm, "option %s: mesh %s has no volume and no surface '%s'; it has: %s",
                   v.option.c_str(), mesh.file().c_str(), name.c_str(), listed(regions, mesh).c_str());
    const bool read_there = v.surfaces && std::find(readers.begin(), readers.end(), name) != readers.end();
    PulmoUserCheck(is_region || read_there, comm,
                   "option %s: nothing reads it on surface '%s'; give the name of a volume, or of a surface that "
                   "this effect acts on",
                   v.option.c_str(), name.c_str());
    if (is_surface) entry.of_surface[name] = value;
    if (!is_region) continue;
    if (entry.of_cell.empty()) entry.of_cell.assign(taken.size(), v.everywhere);
    int before = -1; // the first of the names that share cells with this one
    for (const PetscInt c : region->cells) {
      if (taken[c] >= 0) before = taken[c];
      taken[c] = static_cast<int>(i);
      entry.of_cell[c] = value;
    }
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &before, 1, MPI_INT, MPI_MAX, comm));
    PulmoUserCheck(before < 0, comm,
                   "option %s: volumes '%s' and '%s' share cells, which would have two values; name parts that do not "
                   "overlap",
                   v.option.c_str(), v.by_name[static_cast<std::size_t>(std::max(before, 0))].first.c_str(),
                   name.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ParameterFields::take_dataset(Options &options, const Mesh &mesh, const Options::Varying &v,
                                             Entry &entry)
{
  const MPI_Comm comm = options.comm();
  const std::vector<PetscInt> &places = mesh.places_in_file();
  PetscInt begin, end;
  PetscMPIInt rank;
  std::uint64_t n = v.of_cell->size(), content = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, 0, comm));
  PulmoUserCheck(n == static_cast<std::uint64_t>(mesh.tetrahedra_in_file()), comm,
                 "option %s %s: the dataset has %llu values, but mesh %s has %d tetrahedra; give one for each, in the "
                 "order of the mesh file",
                 v.option.c_str(), v.text.c_str(), static_cast<unsigned long long>(n), mesh.file().c_str(),
                 static_cast<int>(mesh.tetrahedra_in_file()));
  PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, &end));
  entry.of_cell.assign(places.size(), 0);
  std::vector<PetscInt> order(places.size()); // cells as the file has them
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](PetscInt a, PetscInt b) { return places[a] < places[b]; });
  // in pieces: no other rank has room for all values
  std::vector<double> piece;
  std::size_t next = 0;
  for (std::uint64_t first = 0; first < n; first += most_at_once) {
    const auto last = std::min(n, first + most_at_once);
    piece.resize(last - first);
    if (rank == 0) std::copy(v.of_cell->begin() + first, v.of_cell->begin() + last, piece.begin());
    PetscCallMPI(MPI_Bcast(piece.data(), static_cast<PetscMPIInt>(piece.size()), MPI_DOUBLE, 0, comm));
    for (; next < order.size() && static_cast<std::uint64_t>(places[order[next]]) < last; ++next)
      entry.of_cell[order[next]] = piece[places[order[next]] - first];
  }
  // what the cells have, wherever they are and in whatever order
  for (std::size_t c = 0; c < places.size(); ++c) {
    std::uint64_t corners, bits;
    PetscCall(hash_corners(mesh.dm(), begin + static_cast<PetscInt>(c), corners));
    std::memcpy(&bits, &entry.of_cell[c], sizeof(bits));
    std::uint64_t h = corners + bits * 0x9e3779b97f4a7c15U; // splitmix64
    h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9U;
    content += h ^ (h >> 31);
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &content, 1, MPI_UINT64_T, MPI_SUM, comm));
  char text[64];
  std::snprintf(text, sizeof(text), "a dataset, hash %016llx", static_cast<unsigned long long>(content));
  options.note_content(v.option, text);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ParameterFields::add_sizes(MPI_Comm comm, std::size_t which, PetscReal &least, PetscReal &most) const
{
  const Entry &entry = entries_[which];
  std::vector<PetscReal> values = entry.of_cell;

  PetscFunctionBeginUser;
  if (values.empty()) values.push_back(entry.everywhere);
  for (const auto &surface : entry.of_surface) values.push_back(surface.second);
  for (const PetscReal value : values) {
    if (value != 0) least = std::min(least, std::abs(value));
    most = std::max(most, std::abs(value));
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &least, 1, MPIU_REAL, MPI_MIN, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &most, 1, MPIU_REAL, MPI_MAX, comm));
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
