#include "pulmo/mesh/mesh_file.hpp"

#include "pulmo/base/space.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/mesh/touching_faces.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <map>
#include <numeric>
#include <set>

namespace pulmo {

namespace {

using Point = SpacePoint;
using Facet = std::array<int, 3>; ///< nodes in ascending order
using Cell = std::array<int, 4>;

/// Ends the making; what make_named_mesh() returns.
struct Fault {
  std::string text;
};

template <class... Values>
std::string text_of(const char *format, Values... values)
{
  char text[512];
  std::snprintf(text, sizeof(text), format, values...);
  return text;
}

std::string counted(std::size_t n, const char *thing)
{
  return std::to_string(n) + " " + thing + (n == 1 ? "" : "s");
}

/// Files in letters hold 16 digits of a coordinate, binary files all of it. Both must give the same mesh.
double sixteen_digits(double x)
{
  char text[40];
  const auto end = std::to_chars(text, text + sizeof(text), x, std::chars_format::scientific, 15).ptr;
  std::from_chars(text, end, x);
  return x + 0.0; // no -0
}

template <std::size_t N>
std::array<int, N> sorted(std::array<int, N> nodes)
{
  std::sort(nodes.begin(), nodes.end());
  return nodes;
}

/// The number that a name of digits alone says; -1 for other names.
long number_of(const std::string &name)
{
  long number = -1;
  const auto end = name.data() + name.size();
  const auto result = std::from_chars(name.data(), end, number);
  return result.ec == std::errc() && result.ptr == end ? number : -1;
}

class Maker {
public:
  Maker(const MeshFile &file, const std::vector<std::string> &prefer, double scale, NamedMesh &mesh)
      : file_(file), prefer_(prefer), scale_(scale), mesh_(mesh)
  {}

  void run()
  {
    mesh_ = NamedMesh();
    if (file_.cells.empty()) throw Fault{"holds no volume elements; mesh the volume"};
    number_nodes();
    name_groups();
    take_cells();
    find_faces();
    take_facets();
    check_tears();
    choose_names();
    make_parts();
  }

private:
  /// A face of a cell. side: on which side of its nodes' ascending order the cell lies.
  struct Face {
    Facet nodes;
    int cell, side;
  };
  /// A facet or cell and the names that it carries.
  template <std::size_t N>
  struct Named {
    std::array<int, N> nodes;
    long id;
    int place;              ///< among the elements of the file
    std::vector<int> names; ///< indices into names_, ascending
  };
  struct Name {
    int dimension;
    std::string text;
    bool operator<(const Name &other) const
    {
      return std::tie(dimension, text) < std::tie(other.dimension, other.text);
    }
  };

  template <class Nodes>
  std::string at(const Nodes &nodes) const
  {
    Point centre{};
    for (const int i : nodes)
      for (int d = 0; d < 3; ++d) centre[d] += scale_ * mesh_.nodes[i][d] / static_cast<double>(nodes.size());
    return text_of("(%.6g, %.6g, %.6g) mm", centre[0], centre[1], centre[2]);
  }
  double area(const Facet &f) const
  {
    const auto &x = mesh_.nodes;
    return length(cross(difference(x[f[1]], x[f[0]]), difference(x[f[2]], x[f[0]]))) / 2;
  }
  double signed_volume(const Cell &c) const
  {
    const auto &x = mesh_.nodes;
    return dot(difference(x[c[1]], x[c[0]]), cross(difference(x[c[2]], x[c[0]]), difference(x[c[3]], x[c[0]]))) / 6;
  }
  std::string quoted(int name) const { return "'" + names_[name].text + "'"; }

  // ---------------------------------------------------------------------------------------------------------- nodes

  /// Nodes that cells use, in the order of their coordinates; of those at one place, in the order of the cells around.
  void number_nodes()
  {
    const auto n = static_cast<int>(file_.nodes.size());
    std::vector<char> used(file_.nodes.size(), 0);
    for (const auto &cell : file_.cells)
      for (const int node : cell.nodes) used[node] = 1;
    std::vector<Point> x(file_.nodes.size());
    std::vector<int> order;
    for (int i = 0; i < n; ++i) {
      if (!used[i]) continue;
      for (int d = 0; d < 3; ++d) x[i][d] = sixteen_digits(file_.nodes[i][d]);
      order.push_back(i);
    }
    std::sort(order.begin(), order.end(), [&](int a, int b) { return x[a] < x[b]; });
    std::set<int> tied;
    for (std::size_t i = 1; i < order.size(); ++i)
      if (x[order[i]] == x[order[i - 1]]) tied.insert({order[i - 1], order[i]});
    if (!tied.empty()) {
      std::map<int, std::set<std::array<Point, 4>>> around;
      for (const auto &cell : file_.cells) {
        std::array<Point, 4> corners;
        for (int i = 0; i < 4; ++i) corners[i] = x[cell.nodes[i]];
        std::sort(corners.begin(), corners.end());
        for (const int node : cell.nodes)
          if (tied.count(node)) around[node].insert(corners);
      }
      std::sort(order.begin(), order.end(),
                [&](int a, int b) { return x[a] != x[b] ? x[a] < x[b] : a != b && around[a] < around[b]; });
    }
    number_.assign(file_.nodes.size(), -1);
    for (const int node : order) {
      number_[node] = static_cast<int>(mesh_.nodes.size());
      mesh_.nodes.push_back(x[node]);
    }
  }

  template <int N>
  std::array<int, N> numbered(const MeshFile::Element<N> &element) const
  {
    std::array<int, N> nodes;
    for (int i = 0; i < N; ++i) nodes[i] = number_[element.nodes[i]];
    return nodes;
  }

  // ---------------------------------------------------------------------------------------------------------- names

  /// Groups of one name are one part. A group without a name is called by its number.
  void name_groups()
  {
    std::map<Name, int> known;
    for (const auto &group : file_.groups) {
      const std::string number = std::to_string(group.tag);
      const Name name{group.dimension, group.name.empty() ? number : group.name};
      if (group.dimension >= 2 && number_of(name.text) >= 0 && name.text != number) {
        const auto other = std::find_if(file_.groups.begin(), file_.groups.end(), [&](const MeshFile::Group &g) {
          return g.dimension == group.dimension && g.tag == number_of(name.text);
        });
        const std::string what = group.dimension == 2 ? "surface group " : "volume group ";
        if (other != file_.groups.end())
          throw Fault{"calls " + what + number + " '" + name.text + "', which is the number of another one" +
                      (other->name.empty() ? "" : " ('" + other->name + "')") + "; give it a name that is no number"};
        mesh_.notes.push_back(what + number + " of the mesh has the name '" + name.text +
                              "', not its number: it is known by its name");
      }
      const auto [found, added] = known.insert({name, static_cast<int>(names_.size())});
      if (added) names_.push_back(name);
      name_of_group_.push_back(found->second);
    }
  }

  /// Elements of the same nodes become one, with all their names.
  template <int N>
  std::vector<Named<N>> merged(const std::vector<MeshFile::Element<N>> &elements, bool once)
  {
    std::vector<Named<N>> all;
    int place = -1;
    long last = 0;
    for (const auto &element : elements) {
      if (place < 0 || element.id != last) ++place; // one of several groups is there once for each
      last = element.id;
      Named<N> one{sorted(numbered<N>(element)), element.id, place, {}};
      if (element.group >= 0) one.names.push_back(name_of_group_[element.group]);
      all.push_back(one);
    }
    std::sort(all.begin(), all.end(), [](const Named<N> &a, const Named<N> &b) {
      return std::tie(a.nodes, a.names, a.id) < std::tie(b.nodes, b.names, b.id);
    });
    std::vector<Named<N>> result;
    for (const Named<N> &one : all) {
      if (result.empty() || result.back().nodes != one.nodes) {
        result.push_back(one);
        continue;
      }
      result.back().place = std::min(result.back().place, one.place);
      std::vector<int> &names = result.back().names;
      const bool further = !names.empty() && !one.names.empty() && names.back() != one.names.back();
      if (once && !further)
        throw Fault{"has cells that overlap: elements " + std::to_string(result.back().id) + " and " +
                    std::to_string(one.id) + " have the same nodes, at " + at(one.nodes) + "; remove one"};
      if (!one.names.empty() && (names.empty() || names.back() != one.names.back())) names.push_back(one.names.back());
    }
    return result;
  }

  // ---------------------------------------------------------------------------------------------------------- cells

  void take_cells()
  {
    struct {
      double share = 1;
      Cell cell{};
    } worst;
    std::size_t bad = 0;
    cells_ = merged<4>(file_.cells, true);
    for (const auto &named : cells_) {
      Cell cell = named.nodes;
      double longest = 0;
      for (int i = 0; i < 4; ++i)
        for (int j = 0; j < i; ++j)
          longest = std::max(longest, length(difference(mesh_.nodes[cell[i]], mesh_.nodes[cell[j]])));
      double volume = signed_volume(cell);
      if (volume < 0) std::swap(cell[2], cell[3]);
      volume = std::abs(volume);
      const double share = longest > 0 ? volume / (longest * longest * longest) : 0;
      if (!(share > degenerate_share)) ++bad;
      if (!(share >= worst.share)) worst = {share, cell};
      mesh_.cells.push_back(cell);
      mesh_.place.push_back(named.place);
      mesh_.volume += volume;
    }
    for (std::size_t i = 0; i < file_.cells.size(); ++i)
      mesh_.tetrahedra += i == 0 || file_.cells[i].id != file_.cells[i - 1].id;
    if (bad > 0)
      throw Fault{
          "holds " + counted(bad, "degenerate cell") + ", the worst at " + at(worst.cell) +
          text_of(" with volume / (longest edge)^3 = %.2g; mesh anew or optimise the mesh in gmsh", worst.share)};
    std::set<Cell> turned; // a cell may be there once for each of its groups
    for (const auto &cell : file_.cells)
      if (signed_volume(numbered<4>(cell)) < 0) turned.insert(sorted(numbered<4>(cell)));
    if (!turned.empty())
      mesh_.notes.push_back(std::to_string(turned.size()) + " of " + counted(cells_.size(), "cell") +
                            " of the mesh are left-handed (negative volume): they were turned");
  }

  void find_faces()
  {
    faces_.reserve(4 * mesh_.cells.size());
    for (std::size_t c = 0; c < mesh_.cells.size(); ++c) {
      const Cell ascending = cells_[c].nodes;
      const int sign = ascending == mesh_.cells[c] ? 1 : -1; // of its volume
      for (int out = 0; out < 4; ++out)
        faces_.push_back({{ascending[out == 0], ascending[1 + (out <= 1)], ascending[2 + (out <= 2)]},
                          static_cast<int>(c),
                          out % 2 ? sign : -sign});
    }
    std::sort(faces_.begin(), faces_.end(),
              [](const Face &a, const Face &b) { return std::tie(a.nodes, a.cell) < std::tie(b.nodes, b.cell); });
    std::size_t folded = 0;
    const Face *first = nullptr;
    for (std::size_t i = 0, j; i < faces_.size(); i = j) {
      for (j = i + 1; j < faces_.size() && faces_[j].nodes == faces_[i].nodes;) ++j;
      if (j - i > 2)
        throw Fault{"has cells that overlap: more than two share a face at " + at(faces_[i].nodes) + "; mesh anew"};
      if (j - i == 1) outer_.push_back(faces_[i].nodes);
      if (j - i == 2 && faces_[i].side == faces_[i + 1].side) {
        ++folded;
        if (!first) first = &faces_[i];
      }
    }
    if (folded > 0)
      throw Fault{"is folded: at " + counted(folded, "face") + ", the first at " + at(first->nodes) +
                  ", two cells lie on the same side, one within the other; mesh anew or optimise the mesh in gmsh"};
  }

  // --------------------------------------------------------------------------------------------------------- facets

  void take_facets()
  {
    for (const auto &facet : file_.facets) {
      const Facet nodes = sorted(numbered<3>(facet));
      const auto face = std::lower_bound(faces_.begin(), faces_.end(), nodes,
                                         [](const Face &f, const Facet &n) { return f.nodes < n; });
      if (face == faces_.end() || face->nodes != nodes)
        throw Fault{"has facet " + std::to_string(facet.id) +
                    (facet.group < 0 ? "" : " of " + quoted(name_of_group_[facet.group])) +
                    ", which is no face of a tetrahedron; mesh surface and volume together"};
    }
    facets_ = merged<3>(file_.facets, false);
  }

  bool is_outer(const Facet &facet) const { return std::binary_search(outer_.begin(), outer_.end(), facet); }

  /// What the file calls a node; empty if it gives no numbers.
  std::string tag_of(int node) const
  {
    const auto index = static_cast<std::size_t>(std::find(number_.begin(), number_.end(), node) - number_.begin());
    return index < file_.node_tags.size() ? std::to_string(file_.node_tags[index]) : "";
  }

  /// Names of an outer face, none if it has none.
  std::vector<int> names_of(const Facet &face) const
  {
    const auto facet = std::lower_bound(facets_.begin(), facets_.end(), face,
                                        [](const Named<3> &f, const Facet &n) { return f.nodes < n; });
    return facet != facets_.end() && facet->nodes == face ? facet->names : std::vector<int>();
  }

  /// Faces that lie on one another.
  struct Touching {
    std::size_t n = 0;
    double area = 0, distance = 0; ///< of one side; the largest one between nodes or faces
    const Touch *first = nullptr;
    std::set<int> names;
  };

  /// Faces that lie on one another without being joined: nodes are there twice, or two parts were meshed apart. A
  /// surface named on both sides is meant.
  void check_tears()
  {
    std::vector<BoundaryFace> faces;
    auto next = outer_.begin(); // in the same order
    for (const Face &face : faces_) {
      if (next == outer_.end() || face.nodes != *next) continue;
      ++next;
      BoundaryFace one{face.nodes, 0, face.cell};
      for (const int node : mesh_.cells[face.cell])
        if (std::find(face.nodes.begin(), face.nodes.end(), node) == face.nodes.end()) one.opposite = node;
      faces.push_back(one);
    }
    const std::vector<Touch> touches = touching_faces(mesh_.nodes, faces, gap_share);
    Touching overlapping, twice, apart, slit, gap;
    for (const Touch &touch : touches) {
      const bool torn = touch.share <= torn_share;
      if (touch.overlaps && !torn) continue;
      const std::vector<int> here = names_of(faces[touch.face].nodes), there = names_of(faces[touch.other].nodes);
      const bool meant = !here.empty() && !there.empty();
      if (meant && !torn) continue;
      Touching &sum = touch.overlaps ? overlapping : meant ? slit : !torn ? gap : touch.matches ? twice : apart;
      ++sum.n;
      sum.area += area(faces[touch.face].nodes) / 2; // each side counts its own
      sum.distance = std::max(sum.distance, touch.matches ? touch.twins_distance : touch.distance);
      if (!sum.first) sum.first = &touch;
      for (const auto &names : {here, there}) sum.names.insert(names.begin(), names.end());
    }
    const auto what = [&](const Touching &sum) {
      return counted(sum.n, "face") + text_of(" (%.4g mm^2)", area_mm2(sum.area));
    };
    const auto where = [&](const Touching &sum) { return "the first at " + at(faces[sum.first->face].nodes); };
    if (overlapping.n > 0)
      throw Fault{"has parts that overlap: " + what(overlapping) + ", " + where(overlapping) +
                  ", lie on others whose cells are on the same side; remove what is there twice, or mesh anew"};
    if (twice.n > 0 && twice.area >= apart.area) throw Fault{torn_text(twice, what(twice), where(twice))};
    if (apart.n > 0)
      throw Fault{
          "has parts that meet without being joined: " + what(apart) + ", " + where(apart) +
          ", lie on faces of other nodes; mesh the parts together (gmsh: BooleanFragments, or Coherence, before "
          "it meshes), or name both sides of what is meant to be a slit"};
    if (slit.n > 0) {
      std::string names;
      for (const int name : slit.names) names += (names.empty() ? "" : " and ") + quoted(name);
      mesh_.notes.push_back(what(slit) + " of " + names + ", " + where(slit) +
                            ", lie on one another without being joined: as both sides have a name, that is taken for a "
                            "slit; if it is none, join them (gmsh: Coherence Mesh)");
    }
    if (gap.n > 0)
      mesh_.notes.push_back(what(gap) + ", " + where(gap) + text_of(", are at most %.2g mm", scale_ * gap.distance) +
                            " from others that they are not joined to, and not all have a name: that is taken for a "
                            "gap; if it is none, mesh the parts together");
  }

  std::string torn_text(const Touching &torn, const std::string &what, const std::string &where) const
  {
    const auto [a, b] = torn.first->twins;
    std::string nodes, join = "Coherence Mesh";
    if (!tag_of(a).empty()) {
      const long first = std::min(std::stol(tag_of(a)), std::stol(tag_of(b))),
                 second = std::max(std::stol(tag_of(a)), std::stol(tag_of(b)));
      nodes = ", where nodes " + std::to_string(first) + " and " + std::to_string(second) + " are two instead of one";
    }
    if (torn.distance > 0) {
      Point low = mesh_.nodes.front(), high = low;
      for (const Point &x : mesh_.nodes)
        for (int d = 0; d < 3; ++d) {
          low[d] = std::min(low[d], x[d]);
          high[d] = std::max(high[d], x[d]);
        }
      // gmsh's tolerance is a share of the diagonal of all
      join =
          text_of("Geometry.Tolerance = %.2g, then Coherence Mesh", 2 * torn.distance / length(difference(high, low)));
    }
    return "is torn: " + what + ", " + where + nodes + ", lie on others without being joined to them" +
           (torn.distance > 0 ? text_of(", nodes up to %.2g mm apart", scale_ * torn.distance) : "") +
           "; join them (gmsh: " + join + "), or name both sides of what is meant to be a slit";
  }

  // ------------------------------------------------------------------------------------------------- several names

  /// A facet gets one name: two would give it the springs of both.
  void choose_names()
  {
    std::vector<int> ranking; // names that win, in order
    for (const std::string &text : prefer_) {
      const auto name =
          std::find_if(names_.begin(), names_.end(), [&](const Name &n) { return n.dimension == 2 && n.text == text; });
      if (name == names_.end()) {
        std::string list;
        for (const Name &n : names_)
          if (n.dimension == 2) list += (list.empty() ? "" : ", ") + n.text;
        throw Fault{"has no surface '" + text + "', which -mesh_prefer names; " +
                    (list.empty() ? "it names none" : "it has " + list + ": name some of these")};
      }
      ranking.push_back(static_cast<int>(name - names_.begin()));
    }

    std::map<int, double> whole; // area of each name
    struct Shared {
      std::size_t n = 0;
      double area = 0;
    };
    std::map<std::pair<int, int>, Shared> undecided, decided; // two names; winner and loser
    for (Named<3> &facet : facets_) {
      const double a = area(facet.nodes);
      for (const int name : facet.names) whole[name] += a;
      if (facet.names.size() < 2) continue;
      const auto winner = std::find_if(ranking.begin(), ranking.end(), [&](int name) {
        return std::find(facet.names.begin(), facet.names.end(), name) != facet.names.end();
      });
      if (winner == ranking.end()) {
        for (std::size_t i = 0; i < facet.names.size(); ++i)
          for (std::size_t j = 0; j < i; ++j) add(undecided[{facet.names[j], facet.names[i]}], a);
        continue;
      }
      for (const int name : facet.names)
        if (name != *winner) add(decided[{*winner, name}], a);
      facet.names = {*winner};
    }
    if (!undecided.empty()) {
      const auto &[names, shared] =
          *std::max_element(undecided.begin(), undecided.end(),
                            [](const auto &a, const auto &b) { return a.second.area < b.second.area; });
      const auto [a, b] = names;
      const int part = whole[a] < whole[b] ? a : b; // of the other, as like as not
      throw Fault{"has " + counted(shared.n, "facet") + text_of(" (%.4g mm^2) in two groups, ", area_mm2(shared.area)) +
                  quoted(a) + text_of(" (%.3g %% of its area) and ", 100 * shared.area / whole[a]) + quoted(b) +
                  text_of(" (%.3g %%): ", 100 * shared.area / whole[b]) + "say which name they get with -mesh_prefer " +
                  names_[part].text + " (or " + names_[part == a ? b : a].text +
                  "), or give the groups surfaces of their own in gmsh"};
    }
    for (const auto &[names, shared] : decided)
      mesh_.notes.push_back(
          counted(shared.n, "facet") + text_of(" (%.4g mm^2) in both ", area_mm2(shared.area)) + quoted(names.first) +
          " and " + quoted(names.second) + " are taken as " + quoted(names.first) +
          text_of(" (-mesh_prefer); %.4g mm^2 are left of ", area_mm2(left_of(names.second))) + quoted(names.second));
  }

  template <class Sum>
  static void add(Sum &sum, double area)
  {
    ++sum.n;
    sum.area += area;
  }
  double area_mm2(double area) const { return area * scale_ * scale_; }
  double left_of(int name) const
  {
    double left = 0;
    for (const Named<3> &facet : facets_)
      if (std::find(facet.names.begin(), facet.names.end(), name) != facet.names.end()) left += area(facet.nodes);
    return left;
  }

  void make_parts()
  {
    std::map<Name, NamedMesh::Part> parts; // facets before cells
    const auto part_of = [&](int name) -> NamedMesh::Part & {
      NamedMesh::Part &part = parts[names_[name]];
      part.name = names_[name].text;
      part.dimension = names_[name].dimension;
      return part;
    };
    for (const Named<3> &facet : facets_) {
      if (facet.names.empty()) continue;
      NamedMesh::Part &part = part_of(facet.names.front());
      part.elements.push_back(static_cast<int>(mesh_.facets.size()));
      part.measure += area(facet.nodes);
      part.inside = part.inside || !is_outer(facet.nodes);
      mesh_.facets.push_back(facet.nodes);
    }
    std::set<std::string> overlaps;
    std::size_t shared = 0;
    double shared_volume = 0;
    for (std::size_t c = 0; c < cells_.size(); ++c) {
      const double volume = signed_volume(mesh_.cells[c]);
      const std::vector<int> &names = cells_[c].names;
      for (const int name : names) {
        NamedMesh::Part &part = part_of(name);
        part.elements.push_back(static_cast<int>(c));
        part.measure += volume;
      }
      if (names.size() < 2) continue;
      ++shared;
      shared_volume += volume;
      for (std::size_t i = 0; i < names.size(); ++i)
        for (std::size_t j = 0; j < i; ++j)
          overlaps.insert(std::min(quoted(names[j]), quoted(names[i])) + " and " +
                          std::max(quoted(names[j]), quoted(names[i])));
    }
    if (shared > 0) {
      std::string pairs;
      for (const std::string &pair : overlaps) pairs += (pairs.empty() ? "" : "; ") + pair;
      mesh_.notes.push_back(counted(shared, "cell") +
                            text_of(" (%.4g ml) of the mesh are in several volumes (",
                                    shared_volume * scale_ * scale_ * scale_ / units::mm3_per_ml) +
                            pairs + "): each volume is reported on as a whole");
    }
    for (auto &[name, part] : parts) mesh_.parts.push_back(std::move(part));
  }

  const MeshFile &file_;
  const std::vector<std::string> &prefer_;
  const double scale_;
  NamedMesh &mesh_;
  std::vector<int> number_;        // of a node of the file, -1 if no cell uses it
  std::vector<Name> names_;        // of groups
  std::vector<int> name_of_group_; // index into names_
  std::vector<Named<4>> cells_;    // as mesh_.cells, nodes ascending
  std::vector<Named<3>> facets_;
  std::vector<Face> faces_;  // in the order of their nodes
  std::vector<Facet> outer_; // faces of one cell, in order
};

} // namespace

std::string make_named_mesh(const MeshFile &file, const std::vector<std::string> &prefer, double scale, NamedMesh &mesh)
{
  try {
    Maker(file, prefer, scale, mesh).run();
  } catch (const Fault &fault) {
    return fault.text;
  }
  return "";
}

} // namespace pulmo
