// One mesh written in many ways: nodes, elements, entities and groups numbered and ordered anew, cells turned, groups
// split, joined and laid over one another, in each flavour of MSH. The mesh that is read is always the same, with the
// areas and volumes of the names, or the file is refused. PULMO_FUZZ=N writes N times as many files.
#include "support/scene.hpp"

#include "pulmo/mesh/msh.hpp"

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <numeric>
#include <random>
#include <set>
#include <sstream>
#include <unistd.h>

namespace pulmo::test {
namespace {

using Point = std::array<double, 3>;

/// A mesh as gmsh sees it: elements lie on entities, and entities belong to groups.
struct Draft {
  struct Entity {
    int dimension;
    int tag;
    std::vector<int> groups;                ///< physical tags, negative: the other orientation
    std::vector<std::vector<int>> elements; ///< nodes, counted from 0
  };
  std::vector<Point> nodes;
  std::vector<int> node_tags;
  std::vector<Entity> entities;
  std::map<std::pair<int, int>, std::string> names; ///< of dimension and physical tag
};

/// Writes a draft as MSH.
class Writer {
public:
  Writer(bool new_format, bool binary) : new_(new_format), binary_(binary) {}

  std::string of(const Draft &draft)
  {
    text("$MeshFormat\n" + std::string(new_ ? "4.1 " : "2.2 ") + (binary_ ? "1" : "0") + " 8\n");
    if (binary_) raw(std::int32_t(1)), text("\n");
    text("$EndMeshFormat\n$PhysicalNames\n" + std::to_string(draft.names.size()) + "\n");
    for (const auto &[group, name] : draft.names)
      text(std::to_string(group.first) + " " + std::to_string(group.second) + " \"" + name + "\"\n");
    text("$EndPhysicalNames\n");
    new_ ? write_41(draft) : write_22(draft);
    return out_.str();
  }

private:
  void text(const std::string &s) { out_ << s; }
  template <class T>
  void raw(T value)
  {
    out_.write(reinterpret_cast<const char *>(&value), sizeof(value));
  }
  void whole(int value) { binary_ ? raw(std::int32_t(value)) : text(std::to_string(value) + " "); }
  void size(std::size_t value) { binary_ ? raw(std::uint64_t(value)) : text(std::to_string(value) + " "); }
  void real(double value)
  {
    char letters[40];
    std::snprintf(letters, sizeof(letters), "%.16g ", value); // as gmsh does
    binary_ ? raw(value) : text(letters);
  }
  void line()
  {
    if (!binary_) text("\n");
  }
  void close(const char *name) { text((binary_ ? "\n$End" : "$End") + std::string(name) + "\n"); }

  static int type(int dimension) { return dimension == 2 ? 2 : 4; }

  void write_22(const Draft &draft)
  {
    text("$Nodes\n" + std::to_string(draft.nodes.size()) + "\n");
    for (std::size_t i = 0; i < draft.nodes.size(); ++i) {
      whole(draft.node_tags[i]);
      for (const double x : draft.nodes[i]) real(x);
      line();
    }
    close("Nodes");
    std::size_t n = 0;
    for (const auto &e : draft.entities) n += e.elements.size() * std::max<std::size_t>(e.groups.size(), 1);
    text("$Elements\n" + std::to_string(n) + "\n");
    int id = 0;
    for (const auto &e : draft.entities)
      for (const auto &element : e.elements)
        for (const int group : e.groups.empty() ? std::vector<int>{0} : e.groups) {
          if (!binary_) whole(++id);
          whole(type(e.dimension));
          if (binary_) whole(1);
          whole(2);
          if (binary_) whole(++id);
          whole(group);
          whole(e.tag);
          for (const int node : element) whole(draft.node_tags[node]);
          line();
        }
    close("Elements");
  }

  void write_41(const Draft &draft)
  {
    text("$Entities\n");
    for (int dimension = 0; dimension < 4; ++dimension)
      size(std::count_if(draft.entities.begin(), draft.entities.end(),
                         [&](const auto &e) { return e.dimension == dimension; }));
    line();
    for (int dimension = 2; dimension < 4; ++dimension)
      for (const auto &e : draft.entities) {
        if (e.dimension != dimension) continue;
        whole(e.tag);
        for (int i = 0; i < 6; ++i) real(i < 3 ? 0 : 1);
        size(e.groups.size());
        for (const int group : e.groups) whole(group);
        size(0);
        line();
      }
    close("Entities");
    const auto [least, largest] = std::minmax_element(draft.node_tags.begin(), draft.node_tags.end());
    text("$Nodes\n");
    for (const std::size_t n : {std::size_t(1), draft.nodes.size(), std::size_t(*least), std::size_t(*largest)})
      size(n);
    line();
    for (const int n : {3, 1, 0}) whole(n);
    size(draft.nodes.size());
    line();
    for (const int tag : draft.node_tags) size(tag), line();
    for (const Point &x : draft.nodes) {
      for (const double component : x) real(component);
      line();
    }
    close("Nodes");
    std::size_t n = 0, id = 0;
    for (const auto &e : draft.entities) n += e.elements.size();
    text("$Elements\n");
    for (const std::size_t count : {draft.entities.size(), n, std::size_t(1), n}) size(count);
    line();
    for (const auto &e : draft.entities) {
      for (const int value : {e.dimension, e.tag, type(e.dimension)}) whole(value);
      size(e.elements.size());
      line();
      for (const auto &element : e.elements) {
        size(++id);
        for (const int node : element) size(draft.node_tags[node]);
        line();
      }
    }
    close("Elements");
  }

  bool new_, binary_;
  std::ostringstream out_;
};

/// What the names of a draft must measure, and whether facets carry several names. Names by dimension.
struct Expected {
  std::map<std::pair<int, std::string>, double> measures;
  bool facets_shared = false;
};

double measure(const std::vector<Point> &x, const std::vector<int> &e)
{
  const auto from = [&](int i) {
    return Point{x[e[i]][0] - x[e[0]][0], x[e[i]][1] - x[e[0]][1], x[e[i]][2] - x[e[0]][2]};
  };
  const Point a = from(1), b = from(2);
  const Point n{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
  if (e.size() == 3) return std::hypot(n[0], n[1], n[2]) / 2;
  const Point c = from(3);
  return std::abs(n[0] * c[0] + n[1] * c[1] + n[2] * c[2]) / 6;
}

Expected expected(const Draft &draft, const std::vector<std::string> &prefer)
{
  Expected result;
  for (const auto &e : draft.entities) {
    std::set<std::string> names;
    for (const int group : e.groups) {
      const auto found = draft.names.find({e.dimension, std::abs(group)});
      names.insert(found == draft.names.end() ? std::to_string(std::abs(group)) : found->second);
    }
    if (e.dimension == 2 && names.size() > 1) {
      const auto winner =
          std::find_if(prefer.begin(), prefer.end(), [&](const auto &name) { return names.count(name); });
      if (winner == prefer.end())
        result.facets_shared = true;
      else
        names = {*winner};
    }
    for (const auto &element : e.elements)
      for (const std::string &name : names) result.measures[{e.dimension, name}] += measure(draft.nodes, element);
  }
  return result;
}

/// The cube of the reader's tests: two surfaces and a volume.
Draft cube()
{
  std::ifstream in(source("meshes/cube_msh41_binary.msh"), std::ios::binary);
  std::ostringstream content;
  content << in.rdbuf();
  MeshFile file;
  EXPECT_EQ(read_msh(content.str(), file), "");
  Draft draft;
  draft.nodes = file.nodes;
  draft.node_tags.resize(file.nodes.size());
  std::iota(draft.node_tags.begin(), draft.node_tags.end(), 1);
  draft.entities = {{2, 1, {1}, {}}, {2, 2, {2}, {}}, {3, 1, {3}, {}}};
  for (const auto &facet : file.facets)
    draft.entities[file.groups[facet.group].name == "pleura"].elements.push_back(
        {facet.nodes[0], facet.nodes[1], facet.nodes[2]});
  for (const auto &cell : file.cells)
    draft.entities[2].elements.push_back({cell.nodes[0], cell.nodes[1], cell.nodes[2], cell.nodes[3]});
  draft.names = {{{2, 1}, "airway"}, {{2, 2}, "pleura"}, {{3, 3}, "lung"}};
  return draft;
}

/// Writes the same cells and names in another way.
class Rewriting {
public:
  explicit Rewriting(unsigned seed) : random_(seed) {}

  Draft of(Draft draft)
  {
    if (one_in(2)) split(draft);
    if (one_in(3)) group_differently(draft);
    if (one_in(4)) lay_over(draft);
    if (one_in(3)) draft.names.erase(draft.names.begin()); // a group without a name
    renumber_groups(draft);
    renumber_entities(draft);
    renumber_nodes(draft);
    std::shuffle(draft.entities.begin(), draft.entities.end(), random_);
    for (auto &e : draft.entities) {
      std::shuffle(e.elements.begin(), e.elements.end(), random_);
      for (auto &element : e.elements)
        if (one_in(2)) std::shuffle(element.begin(), element.end(), random_);
      for (int &group : e.groups)
        if (one_in(3)) group = -group;
    }
    return draft;
  }

private:
  bool one_in(unsigned n) { return random_() % n == 0; }
  int below(std::size_t n) { return static_cast<int>(random_() % n); }
  int unused(const std::set<int> &used)
  {
    int tag;
    do tag = 1 + below(30);
    while (used.count(tag));
    return tag;
  }

  /// An entity becomes two in the same groups.
  void split(Draft &draft)
  {
    auto &e = draft.entities[below(draft.entities.size())];
    if (e.elements.size() < 2) return;
    const auto half = e.elements.begin() + 1 + below(e.elements.size() - 1);
    Draft::Entity rest{e.dimension, 0, e.groups, {half, e.elements.end()}};
    e.elements.erase(half, e.elements.end());
    draft.entities.push_back(rest);
  }

  /// A part of an entity gets a group of its own: of a new name, or of the old one.
  void group_differently(Draft &draft)
  {
    split(draft);
    auto &e = draft.entities.back();
    const std::string name = one_in(2) ? "part" : draft.names.at({e.dimension, e.groups[0]});
    e.groups = {20};
    draft.names[{e.dimension, 20}] = name;
  }

  /// A further group that holds some entities, too.
  void lay_over(Draft &draft)
  {
    for (auto &e : draft.entities)
      if (one_in(2)) e.groups.push_back(21);
    draft.names[{2, 21}] = draft.names[{3, 21}] = "all";
  }

  /// Numbers of groups are those of other groups and entities, in each dimension.
  void renumber_groups(Draft &draft)
  {
    std::map<std::pair<int, int>, int> tag_of;
    std::map<int, std::set<int>> used;
    const auto renamed = [&](int dimension, int tag) {
      const auto [found, added] = tag_of.insert({{dimension, tag}, 0});
      if (added) used[dimension].insert(found->second = unused(used[dimension]));
      return found->second;
    };
    std::map<std::pair<int, int>, std::string> names;
    for (const auto &[group, name] : draft.names) names[{group.first, renamed(group.first, group.second)}] = name;
    for (auto &e : draft.entities)
      for (int &group : e.groups) group = renamed(e.dimension, group);
    draft.names = names;
  }

  void renumber_entities(Draft &draft)
  {
    std::map<int, std::set<int>> used;
    for (auto &e : draft.entities) used[e.dimension].insert(e.tag = unused(used[e.dimension]));
  }

  /// Nodes in another order, their tags in another one, with gaps; one that nothing uses.
  void renumber_nodes(Draft &draft)
  {
    const std::vector<Point> old = draft.nodes;
    std::vector<int> order(old.size());
    std::iota(order.begin(), order.end(), 0);
    std::shuffle(order.begin(), order.end(), random_);
    for (std::size_t i = 0; i < order.size(); ++i) draft.nodes[order[i]] = old[i];
    for (auto &e : draft.entities)
      for (auto &element : e.elements)
        for (int &node : element) node = order[node];
    if (one_in(2)) draft.nodes.push_back({3, 4, 5});
    draft.node_tags.resize(2 * draft.nodes.size());
    std::iota(draft.node_tags.begin(), draft.node_tags.end(), 1);
    std::shuffle(draft.node_tags.begin(), draft.node_tags.end(), random_);
    draft.node_tags.resize(draft.nodes.size());
  }

  std::mt19937 random_;
};

/// Areas and volumes of the names as a scene finds them.
PetscErrorCode read_measures(const std::string &content, const std::string &more,
                             std::map<std::pair<int, std::string>, double> &measures)
{
  const std::string path =
      (std::filesystem::temp_directory_path() / ("pulmo_fuzz_meshes_" + std::to_string(getpid()) + ".msh")).string();
  Mesh mesh;
  Options options(PETSC_COMM_WORLD);

  PetscFunctionBeginUser;
  std::ofstream(path, std::ios::binary) << content;
  PetscCall(set_options("-dm_plex_filename " + path + " " + more));
  PetscCall(mesh.declare(options));
  PetscCall(mesh.read(options, false));
  std::remove(path.c_str());
  measures.clear();
  for (const Mesh::Part &part : mesh.parts()) {
    std::vector<PetscInt> points;
    PetscCall(mesh.elements(part, points));
    double &sum = measures[{static_cast<int>(part.dimension), part.name}];
    for (const PetscInt p : points) {
      PetscReal measure;
      PetscCall(DMPlexComputeCellGeometryFVM(mesh.dm(), p, &measure, nullptr, nullptr));
      sum += measure;
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void expect_equal(const std::map<std::pair<int, std::string>, double> &found, const Expected &right,
                  const std::string &text)
{
  ASSERT_EQ(found.size(), right.measures.size()) << text;
  for (const auto &[name, size] : right.measures) {
    ASSERT_TRUE(found.count(name)) << name.second << " of\n" << text;
    EXPECT_NEAR(found.at(name), size, 1e-12) << name.second << " of\n" << text;
  }
}

TEST(FuzzMeshes, EqualOrRefused)
{
  const Draft seed = cube();
  MeshFile file;
  NamedMesh reference;
  ASSERT_EQ(read_msh(Writer(false, true).of(seed), file), "");
  ASSERT_EQ(make_named_mesh(file, {}, 1, reference), "");
  ASSERT_EQ(reference.cells.size(), 24u);

  const char *times = std::getenv("PULMO_FUZZ");
  const int n = 400 * (times ? std::max(1, std::atoi(times)) : 1);
  int refused = 0, preferred = 0, turned = 0;
  for (int i = 0; i < n; ++i) {
    const Draft draft = Rewriting(static_cast<unsigned>(i)).of(seed);
    const std::vector<std::string> prefer = i % 2 ? std::vector<std::string>{"all"} : std::vector<std::string>{};
    const bool has_all = std::any_of(draft.entities.begin(), draft.entities.end(),
                                     [&](const auto &e) { return e.dimension == 2 && e.groups.size() > 1; });
    const Expected right = expected(draft, has_all ? prefer : std::vector<std::string>{});
    for (int flavour = 0; flavour < 4; ++flavour) {
      const std::string text = Writer(flavour / 2, flavour % 2).of(draft), what = Writer(false, false).of(draft);
      NamedMesh mesh;
      ASSERT_EQ(read_msh(text, file), "") << what;
      const std::string fault = make_named_mesh(file, has_all ? prefer : std::vector<std::string>{}, 1, mesh);
      ASSERT_EQ(fault.empty(), !right.facets_shared) << fault << " for\n" << what;
      if (!fault.empty()) {
        EXPECT_NE(fault.find("in two groups"), std::string::npos) << fault;
        ++refused;
        continue;
      }
      preferred += has_all;
      turned += std::any_of(mesh.notes.begin(), mesh.notes.end(),
                            [](const std::string &note) { return note.find("left-handed") != std::string::npos; });
      ASSERT_EQ(mesh.nodes, reference.nodes) << what;
      ASSERT_EQ(mesh.cells, reference.cells) << what;
      std::map<std::pair<int, std::string>, double> found;
      for (const auto &part : mesh.parts) found[{part.dimension, part.name}] = part.measure;
      expect_equal(found, right, what);
      if (i % 10 != 0 && !(has_all && i % 4 == 1)) continue;
      ASSERT_EQ(static_cast<int>(read_measures(text, has_all && i % 2 ? "-mesh_prefer all" : "", found)), 0) << what;
      expect_equal(found, right, what);
    }
  }
  EXPECT_GT(refused, n / 10);
  EXPECT_GT(preferred, n / 10);
  EXPECT_GT(turned, n);
}

} // namespace
} // namespace pulmo::test
