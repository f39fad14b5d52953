#include "pulmo/mesh/elements.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

struct Pair {
  const char *name;
  Elements degrees;
};
constexpr std::array<Pair, 3> pairs{{{"P2-P1", {2, 1}}, {"P1-P1", {1, 1}}, {"P3-P2", {3, 2}}}};

} // namespace

PetscErrorCode Elements::declare(Options &options)
{
  std::vector<std::string> names;
  std::string wanted = pairs.front().name;

  PetscFunctionBeginUser;
  for (const Pair &pair : pairs) names.emplace_back(pair.name);
  options.group("elements", "finite elements");
  PetscCall(options.choice("", names, "degrees of displacement and pressure (docs/accuracy/elements.md)", wanted));
  const auto chosen = std::find(names.begin(), names.end(), wanted) - names.begin();
  *this = pairs[static_cast<std::size_t>(chosen)].degrees;
  PetscFunctionReturn(PETSC_SUCCESS);
}

const char *Elements::name() const
{
  const auto mine = [this](const Pair &pair) {
    return pair.degrees.displacement_degree == displacement_degree && pair.degrees.pressure_degree == pressure_degree;
  };
  return std::find_if(pairs.begin(), pairs.end(), mine)->name;
}

PetscErrorCode nodes_at(DM dm, PetscInt point, PetscInt n, std::vector<ElementNode> &nodes)
{
  DMPolytopeType type;
  const PetscInt *cone;

  PetscFunctionBeginUser;
  nodes.clear();
  if (n == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMPlexGetCellType(dm, point, &type));
  PetscCall(DMPlexGetCone(dm, point, &cone));
  const bool edge = type == DM_POLYTOPE_SEGMENT;
  PetscCheck(n == 1 || (edge && n == 2), PETSC_COMM_SELF, PETSC_ERR_SUP, "%d nodes at a %s", static_cast<int>(n),
             DMPolytopeTypes[type]);
  if (type == DM_POLYTOPE_POINT) {
    nodes.push_back({1, {point}, {1}});
  } else if (edge) {
    const PetscReal near = n == 1 ? 0.5 : (1 + 1 / std::sqrt(5.)) / 2;
    nodes.push_back({2, {cone[0], cone[1]}, {near, 1 - near}});
    if (n == 2) nodes.push_back({2, {cone[0], cone[1]}, {1 - near, near}});
  } else {
    const PetscInt *ends, *others;
    PetscCheck(type == DM_POLYTOPE_TRIANGLE, PETSC_COMM_SELF, PETSC_ERR_SUP, "nodes inside a %s",
               DMPolytopeTypes[type]);
    PetscCall(DMPlexGetCone(dm, cone[0], &ends));
    PetscCall(DMPlexGetCone(dm, cone[1], &others));
    const PetscInt last = others[0] == ends[0] || others[0] == ends[1] ? others[1] : others[0];
    nodes.push_back({3, {ends[0], ends[1], last}, {1. / 3, 1. / 3, 1. / 3}});
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode node_coordinates(DM dm, PetscInt point, PetscInt n, std::vector<std::array<PetscReal, 3>> &x)
{
  PetscSection section;
  Vec coordinates;
  std::vector<ElementNode> nodes;

  PetscFunctionBeginUser;
  PetscCall(nodes_at(dm, point, n, nodes));
  PetscCall(DMGetCoordinateSection(dm, &section));
  PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
  const ReadArray values(coordinates);
  x.assign(nodes.size(), {0, 0, 0});
  for (std::size_t k = 0; k < nodes.size(); ++k)
    for (PetscInt i = 0; i < nodes[k].n; ++i) {
      PetscInt offset;
      PetscCall(PetscSectionGetOffset(section, nodes[k].vertices[i], &offset));
      for (PetscInt d = 0; d < 3; ++d) x[k][d] += nodes[k].weights[i] * values[offset + d];
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode node_coordinates(DM dm, PetscInt point, PetscReal x[3])
{
  std::vector<std::array<PetscReal, 3>> nodes;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm, 0, &begin, &end));
  if (point >= begin && point < end) {
    PetscSection section;
    Vec coordinates;
    PetscInt offset;
    PetscCall(DMGetCoordinateSection(dm, &section));
    PetscCall(DMGetCoordinatesLocal(dm, &coordinates));
    PetscCall(PetscSectionGetOffset(section, point, &offset));
    const ReadArray values(coordinates);
    std::copy_n(values.data() + offset, 3, x);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(node_coordinates(dm, point, 1, nodes));
  std::copy_n(nodes[0].begin(), 3, x);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
