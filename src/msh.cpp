#include "pulmo/msh.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <map>
#include <numeric>
#include <optional>
#include <set>
#include <string_view>
#include <vector>

namespace pulmo {

namespace {

/// What PETSc's reader has room for: letters of a physical name, tags of an element.
constexpr std::size_t longest_name = 120;
constexpr long max_tags = 100;
/// A table of all node tags up to the largest is made; so many may be unused beyond 100 per node.
constexpr long spare_tags = 1000000;

/// Ends the reading; what msh_fault() returns.
struct Fault {
  std::string text;
};

bool is_space(char c)
{
  return c == ' ' || ('\t' <= c && c <= '\r');
}

/// The bytes of a file and a place in them.
class Input {
public:
  explicit Input(const std::string &content)
      : begin_(content.data()), at_(begin_), end_(content.data() + content.size())
  {}

  void format(bool binary, std::size_t size_bytes)
  {
    binary_ = binary;
    size_bytes_ = size_bytes;
  }
  bool binary() const { return binary_; }
  long left() const { return end_ - at_; }

  /// The next word. The one white space after it is taken, too: binary data begin there.
  std::string_view word()
  {
    while (at_ < end_ && is_space(*at_)) ++at_;
    const char *from = at_;
    while (at_ < end_ && !is_space(*at_)) ++at_;
    const std::string_view found(from, static_cast<std::size_t>(at_ - from));
    if (at_ < end_) ++at_;
    return found;
  }

  /// What follows the last word on its line.
  std::string_view rest_of_line()
  {
    if (at_ > begin_ && at_[-1] == '\n') return {};
    const char *from = at_;
    at_ = std::find(at_, end_, '\n');
    const std::string_view found(from, static_cast<std::size_t>(at_ - from));
    if (at_ < end_) ++at_;
    return found;
  }

  /// A number in letters.
  template <class T>
  T written(const char *what)
  {
    std::string_view text = word();
    T value = 0;
    const bool plus = !text.empty() && text[0] == '+';
    const auto result = std::from_chars(text.data() + plus, text.data() + text.size(), value);
    if (text.empty() || text.size() > 40 || result.ec != std::errc() || result.ptr != text.data() + text.size())
      unreadable(std::string("no number for ") + what);
    return value;
  }

  long whole(const char *what) { return fitting(binary_ ? raw<std::int32_t>(what) : written<long>(what), what); }
  /// size_t of the format.
  long size(const char *what)
  {
    if (!binary_) return fitting(written<long>(what), what);
    return fitting(size_bytes_ == 4 ? raw<std::int32_t>(what) : raw<std::int64_t>(what), what);
  }
  double real(const char *what)
  {
    const double value = binary_ ? raw<double>(what) : written<double>(what);
    if (!std::isfinite(value)) unreadable(std::string("no finite number for ") + what);
    return value;
  }
  /// A count of things that each take a byte at least.
  long count(long n, const char *what)
  {
    if (n < 0 || n > left()) unreadable("more " + std::string(what) + " announced than the file holds");
    return n;
  }

  [[noreturn]] void unreadable(const std::string &why) const
  {
    const std::string where = binary_ ? "byte " + std::to_string(at_ - begin_)
                                      : "line " + std::to_string(std::count(begin_, at_ - (at_ > begin_), '\n') + 1);
    throw Fault{"is not a readable mesh (" + where + ": " + why +
                "); pulmo reads gmsh's MSH 2.2 and 4.1 (ASCII or binary)"};
  }

private:
  template <class T>
  T raw(const char *what)
  {
    T value;
    if (left() < static_cast<long>(sizeof(T))) unreadable(std::string("the file ends before ") + what);
    std::memcpy(&value, at_, sizeof(T));
    at_ += sizeof(T);
    return value;
  }
  /// PETSc's whole numbers have 32 bits.
  long fitting(long value, const char *what) const
  {
    if (value < -INT_MAX || value > INT_MAX) unreadable(std::string("too large a number for ") + what);
    return value;
  }

  const char *begin_, *at_, *end_;
  bool binary_ = false;
  std::size_t size_bytes_ = 8;
};

using Triangle = std::array<int, 3>; ///< nodes in ascending order

Triangle sorted(int a, int b, int c)
{
  Triangle t{a, b, c};
  std::sort(t.begin(), t.end());
  return t;
}

/// Reads the sections that PETSc reads, in its order.
class Scan {
public:
  explicit Scan(const std::string &content) : in_(content) {}

  void run()
  {
    format();
    std::string_view next = section();
    if (next == "$PhysicalNames") {
      names();
      next = section();
    }
    if (version_ == 41) {
      expect(next, "$Entities");
      entities();
      close("$EndEntities");
      next = section();
    }
    expect(next, "$Nodes");
    version_ == 41 ? nodes_41() : nodes_22();
    close("$EndNodes");
    expect(section(), "$Elements");
    version_ == 41 ? elements_41() : elements_22();
    close("$EndElements");
    check_elements();
    check_faces();
  }

private:
  struct Facet {
    Triangle nodes;
    long id, physical;
  };

  // ------------------------------------------------------------------------------------------------------- sections

  void expect(std::string_view found, const char *name) const
  {
    if (found != name) in_.unreadable(std::string("no ") + name);
  }
  void close(const char *name) { expect(in_.word(), name); }

  /// The name of the next section; comments are passed over.
  std::string_view section()
  {
    for (;;) {
      const std::string_view name = in_.word();
      if (name != "$Comments") return name;
      for (std::string_view word = in_.word(); word != "$EndComments"; word = in_.word())
        if (word.empty()) in_.unreadable("$Comments without $EndComments");
    }
  }

  void format()
  {
    expect(section(), "$MeshFormat");
    const double version = in_.written<double>("the version");
    const long type = in_.written<long>("the file type"), bytes = in_.written<long>("the data size");
    if (version != 2.2 && version != 4.1) {
      char text[32];
      std::snprintf(text, sizeof(text), "%.4g", version);
      throw Fault{"is MSH " + std::string(text) + "; save it as 2.2 or 4.1 (gmsh -format msh41)"};
    }
    version_ = version == 2.2 ? 22 : 41;
    if ((type != 0 && type != 1) || (bytes != 8 && (bytes != 4 || version_ == 22)))
      in_.unreadable("neither ASCII nor binary");
    in_.format(type == 1, static_cast<std::size_t>(bytes));
    if (type == 1 && in_.whole("the byte order") != 1) in_.unreadable("the byte order of another machine");
    close("$EndMeshFormat");
  }

  void names()
  {
    std::set<std::pair<long, long>> named; // dimension and tag of a group
    for (long i = in_.count(in_.written<long>("the number of names"), "names"); i > 0; --i) {
      const long dimension = in_.written<long>("the dimension of a name"), tag = in_.written<long>("the tag of a name");
      const std::string_view line = in_.rest_of_line();
      const auto first = line.find('"'), last = line.rfind('"');
      if (first == last || line.find_first_not_of(" \t") != first || line.find_last_not_of(" \t\r") != last ||
          dimension < 0 || dimension > 3 || std::abs(tag) > INT_MAX)
        in_.unreadable("no line of a dimension from 0 to 3, a tag and a name in quotes");
      const std::string name(line.substr(first + 1, last - first - 1));
      const auto odd = [](unsigned char c) { return c < 32 || c == '"' || c == ':' || c == 127; };
      if (name.empty() || name.size() > longest_name || std::any_of(name.begin(), name.end(), odd))
        in_.unreadable("a physical name has 1 to 120 letters without quotes and colons");
      if (is_petsc_label(name))
        throw Fault{"names a group '" + name + "', which PETSc keeps for itself; give it another name"};
      if (!named.insert({dimension, tag}).second) in_.unreadable("two names for one group");
      if (dimension == 2) surface_names_[tag] = name;
    }
    close("$EndPhysicalNames");
  }

  void entities()
  {
    std::array<long, 4> counts;
    for (long &n : counts) n = in_.count(in_.size("the number of entities"), "entities");
    for (int dimension = 0; dimension < 4; ++dimension)
      for (long i = 0; i < counts[dimension]; ++i) {
        const long tag = in_.whole("the tag of an entity");
        for (int k = 0; k < (dimension == 0 ? 3 : 6); ++k) in_.real("the box of an entity");
        const long n = in_.count(in_.size("the number of physical tags"), "physical tags");
        long physical = 0;
        for (long k = 0; k < n; ++k) {
          const long value = in_.whole("a physical tag");
          if (k == 0) physical = value;
        }
        if (n > 1 && dimension > 1)
          throw Fault{"puts " + std::string(dimension == 2 ? "surface " : "volume ") + std::to_string(tag) +
                      " into several physical groups, of which MSH 4.1 would give only the first; save it as MSH 2.2 "
                      "(gmsh -format msh22)"};
        if (n > 4) in_.unreadable("an entity in more than 4 physical groups");
        if (!physical_.insert({{dimension, tag}, physical}).second) in_.unreadable("an entity given twice");
        if (dimension == 0) continue;
        for (long k = in_.count(in_.size("the number of bounding entities"), "bounding entities"); k > 0; --k)
          in_.whole("a bounding entity");
      }
  }

  // ---------------------------------------------------------------------------------------------------------- nodes

  void node(long tag, const std::array<double, 3> &x)
  {
    if (tag <= 0) in_.unreadable("a node's tag that is not positive");
    tags_.push_back(tag);
    x_.push_back(x);
  }

  std::array<double, 3> place()
  {
    std::array<double, 3> x;
    for (double &component : x) component = in_.real("a coordinate");
    return x;
  }

  void nodes_22()
  {
    const long n = in_.count(in_.written<long>("the number of nodes"), "nodes");
    for (long i = 0; i < n; ++i) {
      const long tag = in_.whole("the tag of a node");
      node(tag, place());
    }
    index_nodes();
  }

  void nodes_41()
  {
    const long blocks = in_.count(in_.size("the number of blocks"), "blocks");
    const long n = in_.count(in_.size("the number of nodes"), "nodes");
    const long least = in_.size("the least tag"), largest = in_.size("the largest tag");
    for (long b = 0; b < blocks; ++b) {
      (void)block_entity();
      if (in_.whole("parametric") != 0)
        throw Fault{"holds parametric coordinates; save it without (gmsh -setnumber Mesh.SaveParametric 0)"};
      const long in_block = in_.count(in_.size("the nodes of a block"), "nodes");
      std::vector<long> tags(static_cast<std::size_t>(in_block));
      for (long &tag : tags) tag = in_.size("the tag of a node");
      for (const long tag : tags) node(tag, place());
    }
    if (static_cast<long>(tags_.size()) != n) in_.unreadable("another number of nodes than announced");
    index_nodes();
    const long last = first_ + static_cast<long>(index_.size()) - 1;
    if (n > 0 && (least > first_ || largest < last || largest - least > last - first_ + spare_tags))
      in_.unreadable("other least and largest node tags than announced");
  }

  /// Which node has which tag.
  void index_nodes()
  {
    if (tags_.empty()) return;
    const auto [least, largest] = std::minmax_element(tags_.begin(), tags_.end());
    first_ = *least;
    const long range = *largest - *least + 1;
    if (range > 100 * static_cast<long>(tags_.size()) + spare_tags)
      throw Fault{"numbers its nodes with too many gaps; renumber them (gmsh: RenumberMeshNodes)"};
    index_.assign(static_cast<std::size_t>(range), -1);
    for (std::size_t i = 0; i < tags_.size(); ++i) {
      int &index = index_[tags_[i] - first_];
      if (index >= 0) throw Fault{"gives the tag " + std::to_string(tags_[i]) + " to two nodes; save it anew in gmsh"};
      index = static_cast<int>(i);
    }
    in_cell_.assign(tags_.size(), 0);
  }

  int node_index(long tag) const
  {
    const long i = tag - first_;
    if (i < 0 || i >= static_cast<long>(index_.size()) || index_[i] < 0)
      throw Fault{"has an element of node " + std::to_string(tag) + ", which it does not hold; save it anew in gmsh"};
    return index_[i];
  }

  // ------------------------------------------------------------------------------------------------------- elements

  /// Dimension and tag of an entity that a block of nodes or elements belongs to.
  std::pair<int, long> block_entity()
  {
    const long dimension = in_.whole("the dimension of a block"), tag = in_.whole("the entity of a block");
    const std::pair<int, long> entity{static_cast<int>(dimension), tag};
    if (dimension < 0 || dimension > 3 || !physical_.count(entity)) in_.unreadable("a block of an unknown entity");
    return entity;
  }

  /// Dimension and number of nodes of gmsh's element types 1 to 7 and 15.
  std::array<int, 2> shape(long type) const
  {
    static constexpr std::array<std::array<int, 2>, 8> linear{
        {{0, 0}, {1, 2}, {2, 3}, {2, 4}, {3, 4}, {3, 8}, {3, 6}, {3, 5}}};
    if (type == 15) return {0, 1};
    if ((type >= 8 && type <= 31) || type == 92 || type == 93)
      throw Fault{"holds elements of higher order; save it with straight ones (gmsh -order 1)"};
    if (type < 1 || type > 7) in_.unreadable("an unknown type of element");
    return linear[type];
  }

  void elements_22()
  {
    const long n = in_.count(in_.written<long>("the number of elements"), "elements");
    for (long i = 0; i < n;) {
      long id = 0, type, in_block = 1;
      if (!in_.binary()) id = in_.whole("the tag of an element");
      type = in_.whole("the type of an element");
      if (in_.binary()) in_block = in_.whole("the elements of a block");
      const long tags = in_.whole("the number of tags");
      if (tags < 0 || tags > max_tags) in_.unreadable("no such number of tags");
      if (in_block < 1 || in_block > n - i) in_.unreadable("more elements than announced");
      for (long k = 0; k < in_block; ++k, ++i) {
        long physical = 0;
        if (in_.binary()) id = in_.whole("the tag of an element");
        for (long t = 0; t < tags; ++t) {
          const long value = in_.whole("a tag");
          if (t == 0) physical = value;
        }
        element(id, type, physical);
      }
    }
  }

  void elements_41()
  {
    const long blocks = in_.count(in_.size("the number of blocks"), "blocks");
    const long n = in_.count(in_.size("the number of elements"), "elements");
    long read = 0;
    for (int k = 0; k < 2; ++k) in_.size("the least and the largest tag");
    for (long b = 0; b < blocks; ++b) {
      const std::pair<int, long> entity = block_entity();
      const long type = in_.whole("the type of an element");
      const long in_block = in_.count(in_.size("the elements of a block"), "elements");
      if (shape(type)[0] != entity.first) in_.unreadable("elements of another dimension than their block's");
      for (long i = 0; i < in_block; ++i, ++read) {
        const long id = in_.size("the tag of an element");
        element(id, type, physical_.at(entity));
      }
    }
    if (read != n) in_.unreadable("another number of elements than announced");
  }

  void element(long id, long type, long physical)
  {
    const auto [dimension, n] = shape(type);
    std::array<int, 8> nodes{};
    for (int i = 0; i < n; ++i)
      nodes[i] = node_index(version_ == 41 ? in_.size("the node of an element") : in_.whole("the node of an element"));
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < i; ++j)
        if (nodes[i] == nodes[j])
          throw Fault{"has element " + std::to_string(id) + ", which uses a node twice; mesh anew"};
    if (type == 4) {
      cells_.push_back({nodes[0], nodes[1], nodes[2], nodes[3]});
      for (int i = 0; i < 4; ++i) in_cell_[nodes[i]] = 1;
    } else if (dimension == 3) {
      ++foreign_;
    } else if (type == 2) {
      facets_.push_back({sorted(nodes[0], nodes[1], nodes[2]), id, physical});
    } else if (dimension == 2) {
      quadrilateral_ = id;
    } else {
      for (int i = 0; i < n; ++i) low_.push_back({id, nodes[i]});
    }
  }

  // --------------------------------------------------------------------------------------------------------- checks

  std::string at(const std::vector<int> &nodes) const
  {
    std::array<double, 3> centre{};
    char text[100];
    for (const int i : nodes)
      for (int d = 0; d < 3; ++d) centre[d] += x_[i][d] / static_cast<double>(nodes.size());
    std::snprintf(text, sizeof(text), "(%.6g, %.6g, %.6g)", centre[0], centre[1], centre[2]);
    return text;
  }

  [[noreturn]] void stray_facet(long id, long physical) const
  {
    const auto name = surface_names_.find(physical);
    throw Fault{"has facet " + std::to_string(id) + (name == surface_names_.end() ? "" : " of '" + name->second + "'") +
                ", which is no face of a tetrahedron; mesh surface and volume together"};
  }

  void check_elements() const
  {
    if (foreign_ > 0)
      throw Fault{"holds " + std::to_string(foreign_) + " cells that are not tetrahedra; mesh with tetrahedra only"};
    if (cells_.empty()) throw Fault{"holds no volume elements; mesh the volume"};
    if (quadrilateral_) stray_facet(*quadrilateral_, 0);
    for (const auto &[id, node] : low_) // PETSc would take the node for a cell
      if (!in_cell_[node])
        throw Fault{"has element " + std::to_string(id) + " on node " + std::to_string(tags_[node]) +
                    ", which belongs to no tetrahedron; save the volume and its surfaces only"};
  }

  void check_faces()
  {
    std::vector<Triangle> faces;
    faces.reserve(4 * cells_.size());
    for (const auto &c : cells_)
      for (int left_out = 0; left_out < 4; ++left_out)
        faces.push_back(sorted(c[left_out == 0], c[1 + (left_out <= 1)], c[2 + (left_out <= 2)]));
    std::sort(faces.begin(), faces.end());
    std::sort(facets_.begin(), facets_.end(), [](const Facet &a, const Facet &b) { return a.nodes < b.nodes; });
    for (const Facet &facet : facets_)
      if (!std::binary_search(faces.begin(), faces.end(), facet.nodes)) stray_facet(facet.id, facet.physical);

    std::vector<Triangle> outer;
    for (std::size_t i = 0, j; i < faces.size(); i = j) {
      for (j = i + 1; j < faces.size() && faces[j] == faces[i];) ++j;
      if (j - i > 2)
        throw Fault{"has cells that overlap: more than two share a face at " + at({faces[i].begin(), faces[i].end()}) +
                    "; mesh anew"};
      if (j - i == 1) outer.push_back(faces[i]);
    }
    check_tears(outer);
  }

  /// Faces that lie on one another without being joined: nodes are there twice. A surface named on both sides is meant.
  void check_tears(const std::vector<Triangle> &outer) const
  {
    std::vector<int> order(x_.size()), place(x_.size());
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](int a, int b) { return x_[a] < x_[b]; });
    bool twice = false;
    for (std::size_t i = 0; i < order.size(); ++i) {
      const bool same = i > 0 && x_[order[i]] == x_[order[i - 1]];
      place[order[i]] = same ? place[order[i - 1]] : order[i];
      twice = twice || same;
    }
    if (!twice) return;
    std::map<Triangle, bool> named_at; // place of an outer face: whether it has a name
    for (const Triangle &face : outer) {
      const auto facet = std::lower_bound(facets_.begin(), facets_.end(), face,
                                          [](const Facet &f, const Triangle &t) { return f.nodes < t; });
      const bool named = facet != facets_.end() && facet->nodes == face && surface_names_.count(facet->physical);
      const auto [other, first] = named_at.insert({sorted(place[face[0]], place[face[1]], place[face[2]]), named});
      if (!first && !(named && other->second))
        throw Fault{"is torn: its nodes are there twice on the face at " + at({face.begin(), face.end()}) +
                    "; join them (gmsh: Coherence Mesh), or name both sides of what is meant to be a slit"};
    }
  }

  Input in_;
  int version_ = 0;
  std::map<long, std::string> surface_names_;     // by tag
  std::map<std::pair<int, long>, long> physical_; // first physical tag of an entity
  std::vector<long> tags_;                        // of the nodes, as the next two
  std::vector<std::array<double, 3>> x_;          // unscaled
  std::vector<char> in_cell_;                     // belongs to a tetrahedron
  long first_ = 0;                                // least tag of a node
  std::vector<int> index_;                        // node of each tag from first_ on, -1 for none
  std::vector<std::array<int, 4>> cells_;
  std::vector<Facet> facets_;
  std::vector<std::pair<long, int>> low_; // nodes of lines and points: element, node
  std::optional<long> quadrilateral_;
  long foreign_ = 0;
};

} // namespace

std::string msh_fault(const std::string &content)
{
  try {
    Scan(content).run();
  } catch (const Fault &fault) {
    return fault.text;
  }
  return "";
}

bool is_petsc_label(const std::string &name)
{
  static constexpr const char *own[] = {"celltype", "depth",     "ghost",       "marker",
                                        "vtk",      "Cell Sets", "Vertex Sets", "Face Sets"};
  return std::find(std::begin(own), std::end(own), name) != std::end(own);
}

} // namespace pulmo
