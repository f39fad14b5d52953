#include "pulmo/mesh/named_parts.hpp"

#include "pulmo/mesh/node_order.hpp"

#include <algorithm>
#include <sstream>

namespace pulmo {

namespace {

const char *kind(const NamedPart &part)
{
  return part.surface ? "surface" : "volume";
}

std::string described(const NamedPart &part)
{
  return std::string(kind(part)) + " '" + part.name + "'";
}

std::string counted(const NamedPart &part)
{
  return std::to_string(part.count) + (part.surface ? " facet" : " cell") + (part.count == 1 ? "" : "s");
}

bool same_place(const NamedPart &a, const NamedPart &b)
{
  return a.surface == b.surface && a.count == b.count && a.hash == b.hash;
}

/// The part in @p list that has the kind and the name of @p part; null without.
const NamedPart *namesake(const std::vector<NamedPart> &list, const NamedPart &part)
{
  const auto found = std::find_if(list.begin(), list.end(), [&](const NamedPart &other) {
    return other.surface == part.surface && other.name == part.name;
  });
  return found == list.end() ? nullptr : &*found;
}

/// Counts and hashes @p points, which are on no other rank.
PetscErrorCode measure(DM dm, const std::vector<PetscInt> &points, NamedPart &part)
{
  std::uint64_t sums[2] = {points.size(), 0}; // a sum does not depend on the order

  PetscFunctionBeginUser;
  for (const PetscInt point : points) {
    std::uint64_t corners;
    PetscCall(hash_corners(dm, point, corners));
    sums[1] += corners;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums, 2, MPI_UINT64_T, MPI_SUM, PetscObjectComm((PetscObject)dm)));
  part.count = sums[0];
  part.hash = sums[1];
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode find_named_parts(const Mesh &mesh, std::vector<NamedPart> &parts)
{
  const DM dm = mesh.dm();
  std::vector<Mesh::Region> regions;
  std::vector<PetscInt> points;
  PetscInt first_cell;

  PetscFunctionBeginUser;
  parts.clear();
  for (const auto &[name, surface] : mesh.surfaces()) {
    PetscCall(mesh.facets(name, points));
    parts.push_back({true, name, 0, 0});
    PetscCall(measure(dm, points, parts.back()));
  }
  PetscCall(DMPlexGetHeightStratum(dm, 0, &first_cell, nullptr));
  PetscCall(mesh.regions(regions));
  for (const Mesh::Region &region : regions) {
    points.clear();
    for (const PetscInt cell : region.cells) points.push_back(first_cell + cell);
    parts.push_back({false, region.name, 0, 0});
    PetscCall(measure(dm, points, parts.back()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string text_of(const std::vector<NamedPart> &parts)
{
  std::ostringstream text;
  for (const NamedPart &part : parts) // the name comes last: it may hold blanks
    text << kind(part) << ' ' << std::dec << part.count << ' ' << std::hex << part.hash << ' ' << part.name << '\n';
  return text.str();
}

bool read_named_parts(const std::string &text, std::vector<NamedPart> &parts)
{
  std::istringstream lines(text);
  parts.clear();
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string what;
    NamedPart part;
    words >> what >> std::dec >> part.count >> std::hex >> part.hash;
    part.surface = what == "surface";
    if (!words || (!part.surface && what != "volume") || words.get() != ' ' || !std::getline(words, part.name))
      return false;
    parts.push_back(part);
  }
  return true;
}

std::string difference(const std::vector<NamedPart> &there, const std::vector<NamedPart> &here)
{
  for (const NamedPart &part : there) {
    const NamedPart *other = namesake(here, part);
    if (other && same_place(part, *other)) continue;
    if (other)
      return "there the " + described(part) + " has " + counted(part) + ", here " +
             (other->count == part.count ? "as many, but others" : std::to_string(other->count));
    const auto renamed = std::find_if(here.begin(), here.end(), [&](const NamedPart &candidate) {
      return same_place(part, candidate) && !namesake(there, candidate);
    });
    return "there the " + described(part) + " has " + counted(part) + ", here " +
           (renamed == here.end() ? "there is none of that name" : "they are called '" + renamed->name + "'");
  }
  for (const NamedPart &part : here)
    if (!namesake(there, part))
      return "here there is a " + described(part) + " of " + counted(part) + ", there there is none of that name";
  return "";
}

} // namespace pulmo
