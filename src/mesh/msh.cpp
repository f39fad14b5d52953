#include "pulmo/mesh/msh.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <map>
#include <optional>
#include <set>
#include <string_view>
#include <vector>

namespace pulmo {

namespace {

/// Letters of a physical name, tags of an element.
constexpr std::size_t longest_name = 120;
constexpr long max_tags = 1000;
/// A table of all node tags up to the largest is made; so many may be unused beyond 100 per node.
constexpr long spare_tags = 1000000;

/// Ends the reading; what read_msh() returns.
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

  /// Goes on after the next @p text; false if there is none.
  bool skip_to(const std::string &text)
  {
    const char *found = std::search(at_, end_, text.begin(), text.end());
    if (found == end_) return false;
    at_ = found + text.size();
    return true;
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

/// Reads what a mesh of tetrahedra needs: other sections are passed over.
class Scan {
public:
  Scan(const std::string &content, MeshFile &mesh) : in_(content), mesh_(mesh) {}

  void run()
  {
    mesh_ = MeshFile();
    format();
    std::set<std::string> read;
    for (std::string name(section()); !name.empty(); name = section()) {
      const bool needed = name == "$PhysicalNames" || name == "$Entities" || name == "$PartitionedEntities" ||
                          name == "$Nodes" || name == "$Elements";
      if (name[0] != '$' && read.count("$Elements")) break; // what follows is no part of the mesh
      if (name[0] != '$') in_.unreadable("a word outside of the sections");
      const std::string end = "$End" + name.substr(1);
      if (!needed) {
        if (in_.skip_to(end)) continue;
        if (read.count("$Elements")) break;
        in_.unreadable(name + " without " + end);
      }
      if (!read.insert(name).second) in_.unreadable("a second " + name);
      if (name == "$PhysicalNames") names();
      if (name == "$Entities") entities();
      if (name == "$PartitionedEntities") partitioned_entities();
      if (name == "$Nodes") version_ == 41 ? nodes_41() : nodes_22();
      if (name == "$Elements") {
        if (version_ == 41 && !read.count("$Entities")) in_.unreadable("no $Entities");
        if (!read.count("$Nodes")) in_.unreadable("no $Nodes");
        version_ == 41 ? elements_41() : elements_22();
      }
      if (in_.word() != end) in_.unreadable("no " + end);
    }
    for (const char *name : {"$Nodes", "$Elements"})
      if (!read.count(name)) in_.unreadable(std::string("no ") + name);
    check_elements();
  }

private:
  // ------------------------------------------------------------------------------------------------------- sections

  /// The name of the next section; comments are passed over.
  std::string_view section()
  {
    for (;;) {
      const std::string_view name = in_.word();
      if (name != "$Comments") return name;
      if (!in_.skip_to("$EndComments")) in_.unreadable("$Comments without $EndComments");
    }
  }

  void format()
  {
    if (section() != "$MeshFormat") in_.unreadable("no $MeshFormat");
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
    if (in_.word() != "$EndMeshFormat") in_.unreadable("no $EndMeshFormat");
  }

  void names()
  {
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
      if (dimension >= 2 && is_petsc_label(name))
        throw Fault{"names a group '" + name + "', which PETSc keeps for itself; give it another name"};
      if (tag == 0) in_.unreadable("a name for group 0, which is none");
      std::string &known = mesh_.groups[group(static_cast<int>(dimension), tag)].name;
      if (!known.empty()) in_.unreadable("two names for one group");
      known = name;
    }
  }

  /// Index of a physical group, -1 for tag 0. The sign of a tag is the orientation of what belongs to the group.
  int group(int dimension, long tag)
  {
    if (tag == 0) return -1;
    const auto [found, added] = group_.insert({{dimension, std::abs(tag)}, static_cast<int>(mesh_.groups.size())});
    if (added) mesh_.groups.push_back({dimension, std::abs(tag), ""});
    return found->second;
  }

  /// The numbers of points, curves, surfaces and volumes.
  std::array<long, 4> entity_counts()
  {
    std::array<long, 4> counts;
    for (long &n : counts) n = in_.count(in_.size("the number of entities"), "entities");
    return counts;
  }

  void entities()
  {
    const std::array<long, 4> counts = entity_counts();
    for (int dimension = 0; dimension < 4; ++dimension)
      for (long i = 0; i < counts[dimension]; ++i) {
        const long tag = in_.whole("the tag of an entity");
        entity(dimension, tag, true);
      }
  }

  /// The pieces of entities that gmsh's partitions make; their elements belong to the groups of the piece.
  void partitioned_entities()
  {
    in_.size("the number of partitions");
    for (long k = in_.count(in_.size("the number of ghost entities"), "ghost entities"); k > 0; --k)
      for (int i = 0; i < 2; ++i) in_.whole("a ghost entity");
    const std::array<long, 4> counts = entity_counts();
    for (int dimension = 0; dimension < 4; ++dimension)
      for (long i = 0; i < counts[dimension]; ++i) {
        const long tag = in_.whole("the tag of an entity"), parent = in_.whole("the dimension of a parent");
        in_.whole("the tag of a parent");
        for (long k = in_.count(in_.size("the partitions of an entity"), "partitions"); k > 0; --k)
          in_.whole("a partition");
        // where partitions meet within a volume, the surface between them carries the numbers of the volume's groups
        entity(dimension, tag, parent == dimension);
      }
  }

  /// What follows the tag of an entity.
  void entity(int dimension, long tag, bool in_groups)
  {
    for (int k = 0; k < (dimension == 0 ? 3 : 6); ++k) in_.real("the box of an entity");
    std::vector<int> groups;
    for (long k = in_.count(in_.size("the number of physical tags"), "physical tags"); k > 0; --k) {
      const long physical = in_.whole("a physical tag");
      const int index = in_groups ? group(dimension, physical) : -1;
      if (index >= 0 && std::find(groups.begin(), groups.end(), index) == groups.end()) groups.push_back(index);
    }
    if (groups.empty()) groups.push_back(-1);
    if (!groups_of_.insert({{dimension, tag}, groups}).second) in_.unreadable("an entity given twice");
    if (dimension == 0) return;
    for (long k = in_.count(in_.size("the number of bounding entities"), "bounding entities"); k > 0; --k)
      in_.whole("a bounding entity");
  }

  // ---------------------------------------------------------------------------------------------------------- nodes

  void node(long tag, const std::array<double, 3> &x)
  {
    if (tag <= 0) in_.unreadable("a node's tag that is not positive");
    tags_.push_back(tag);
    mesh_.nodes.push_back(x);
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
    mesh_.node_tags = tags_;
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
    if (dimension < 0 || dimension > 3) in_.unreadable("a block of no dimension from 0 to 3");
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
          if (t == 0) physical = value; // then the entity and the partitions
        }
        element(id, type, {group(shape(type)[0], physical)});
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
      const auto known = groups_of_.find(entity);
      if (known == groups_of_.end() && entity.first >= 2)
        throw Fault{
            std::string("has elements on ") + (entity.first == 2 ? "surface " : "volume ") +
            std::to_string(entity.second) +
            ", whose groups it does not tell ($Entities leaves it out); save it as MSH 2.2 (gmsh -format msh22, "
            "meshio's gmsh22)"};
      const std::vector<int> groups = known == groups_of_.end() ? std::vector<int>{-1} : known->second;
      for (long i = 0; i < in_block; ++i, ++read) {
        const long id = in_.size("the tag of an element");
        element(id, type, groups);
      }
    }
    if (read != n) in_.unreadable("another number of elements than announced");
  }

  /// Elements of curves and points are of no use; their groups neither.
  void element(long id, long type, const std::vector<int> &groups)
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
      for (const int group : groups) mesh_.cells.push_back({id, group, {nodes[0], nodes[1], nodes[2], nodes[3]}});
    } else if (dimension == 3) {
      ++foreign_;
    } else if (type == 2) {
      for (const int group : groups) mesh_.facets.push_back({id, group, {nodes[0], nodes[1], nodes[2]}});
    } else if (dimension == 2) {
      quadrilateral_ = id;
    }
  }

  void check_elements() const
  {
    if (foreign_ > 0)
      throw Fault{"holds " + std::to_string(foreign_) + " cells that are not tetrahedra; mesh with tetrahedra only"};
    if (quadrilateral_ && !mesh_.cells.empty())
      throw Fault{"has facet " + std::to_string(*quadrilateral_) +
                  ", which is no face of a tetrahedron; mesh surface and volume together"};
  }

  Input in_;
  MeshFile &mesh_;
  int version_ = 0;
  std::map<std::pair<int, long>, int> group_;                  // index of each group, by dimension and tag
  std::map<std::pair<int, long>, std::vector<int>> groups_of_; // each entity, -1 if it is in none
  std::vector<long> tags_;                                     // of the nodes
  long first_ = 0;                                             // least tag of a node
  std::vector<int> index_;                                     // node of each tag from first_ on, -1 for none
  std::optional<long> quadrilateral_;
  long foreign_ = 0;
};

} // namespace

std::string read_msh(const std::string &content, MeshFile &mesh)
{
  try {
    Scan(content, mesh).run();
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
