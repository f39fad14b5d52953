// A closed surface of triangles: read, joined, checked.
#include "pulmo/mesh/closed_surface.hpp"

#include "pulmo/base/text_file.hpp"
#include "pulmo/base/words.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/read_mesh.hpp"
#include "pulmo/mesh/shared_points.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <sstream>

namespace pulmo {

namespace {

using Place = ClosedSurface::Place;
using Corners = ClosedSurface::Corners;

constexpr std::size_t largest_stl = std::size_t(1) << 30; // bytes
constexpr std::size_t stl_head = 84, stl_triangle = 50;   // bytes of the binary format

std::string text_of(const Place &x)
{
  char text[80];
  std::snprintf(text, sizeof(text), "(%.6g, %.6g, %.6g)", x[0], x[1], x[2]);
  return text;
}

/// Six times the volume of the tetrahedron from the origin.
double volume(const Place &a, const Place &b, const Place &c)
{
  return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
}

/// Words of a text.
class Words {
public:
  explicit Words(const std::string &text) : in_(text) {}
  /// Leaves out what is left of the line, unless @p word is in it.
  void skip_line_without(const char *word)
  {
    const auto place = in_.tellg();
    std::string line;
    if (!std::getline(in_, line) || lower(line).find(word) == std::string::npos) return;
    in_.clear();
    in_.seekg(place);
  }
  bool next(std::string &word)
  {
    if (!(in_ >> word)) return false;
    word = lower(word);
    return true;
  }
  bool number(double &value)
  {
    std::string word;
    char *end = nullptr;
    if (!(in_ >> word)) return false;
    value = std::strtod(word.c_str(), &end);
    return *end == '\0' && std::isfinite(value);
  }

private:
  std::istringstream in_;
};

/// Whether a text begins as an ASCII file does. @p begin: where, behind blanks and the mark of UTF-8.
bool begins_as_ascii_stl(const std::string &content, std::size_t &begin)
{
  constexpr const char *word = "solid", *mark = "\xef\xbb\xbf";
  begin = content.compare(0, 3, mark) == 0 ? 3 : 0;
  while (begin < content.size() && std::isspace(static_cast<unsigned char>(content[begin]))) ++begin;
  return lower(content.substr(begin, 5)) == word;
}

/// Behind "solid" and "endsolid" the body has a name, of any words.
std::string read_ascii_stl(const std::string &content, std::vector<Corners> &list)
{
  Words words(content);
  std::string word;
  Corners corners{};
  std::size_t n = 0;
  bool within = false; // a facet

  while (words.next(word)) {
    if (word == "solid" || word == "endsolid") words.skip_line_without("normal"); // all may stand in one line
    if (word == "facet") {
      n = 0;
      within = true;
    }
    if (word == "vertex" && within) {
      if (n == 3) return "has a facet of more than three vertices";
      for (double &x : corners[n])
        if (!words.number(x))
          return "has a vertex without three numbers (facet " + std::to_string(list.size() + 1) + ")";
      if (++n == 3) list.push_back(corners);
    }
    if (word == "endfacet" && n != 3) return "has a facet of fewer than three vertices";
    if (word == "endfacet") within = false;
  }
  return list.empty() ? "holds no facets" : "";
}

std::string read_binary_stl(const std::string &content, std::vector<Corners> &list)
{
  for (std::size_t at = stl_head; at + stl_triangle <= content.size(); at += stl_triangle) {
    float x[9]; // after the normal
    std::memcpy(x, content.data() + at + 3 * sizeof(float), sizeof(x));
    Corners corners;
    for (int i = 0; i < 9; ++i) {
      if (!std::isfinite(x[i])) return "has a vertex that is no number";
      corners[i / 3][i % 3] = x[i];
    }
    list.push_back(corners);
  }
  return list.empty() ? "holds no facets" : "";
}

/// The triangles of a mesh file: its faces, or the boundary of its cells where it has any.
void take_triangles(const MeshFile &mesh, std::vector<Corners> &list)
{
  std::map<std::array<int, 3>, std::pair<std::array<int, 3>, int>> faces; // by sorted nodes: as it turns, how often
  const auto add = [&](std::array<int, 3> face) {
    std::array<int, 3> key = face;
    std::sort(key.begin(), key.end());
    ++faces.insert({key, {face, 0}}).first->second.second;
  };
  std::vector<std::array<int, 4>> cells;
  for (const auto &cell : mesh.cells) {
    cells.push_back(cell.nodes);
    std::sort(cells.back().begin(), cells.back().end());
  }
  std::sort(cells.begin(), cells.end());
  cells.erase(std::unique(cells.begin(), cells.end()), cells.end()); // one in two groups is there twice
  for (const auto &c : cells) {
    Place edge[3];
    for (int e = 0; e < 3; ++e)
      for (int d = 0; d < 3; ++d) edge[e][d] = mesh.nodes[c[e + 1]][d] - mesh.nodes[c[0]][d];
    const bool right = volume(edge[0], edge[1], edge[2]) > 0;
    for (const auto &f :
         {std::array<int, 3>{c[0], c[2], c[1]}, {c[0], c[1], c[3]}, {c[1], c[2], c[3]}, {c[0], c[3], c[2]}})
      add(right ? f : std::array<int, 3>{f[0], f[2], f[1]});
  }
  if (cells.empty()) {
    for (const auto &facet : mesh.facets) add(facet.nodes);
    for (auto &[key, face] : faces) face.second = 1; // one in two groups is there twice
  }
  for (const auto &[key, face] : faces)
    if (face.second == 1)
      list.push_back({mesh.nodes[face.first[0]], mesh.nodes[face.first[1]], mesh.nodes[face.first[2]]});
}

/// The solid angle of a triangle seen from @p x (Van Oosterom & Strackee 1983).
double solid_angle(const Place &x, const Place &a, const Place &b, const Place &c)
{
  Place r[3] = {a, b, c};
  double length[3], dot[3];
  for (int i = 0; i < 3; ++i) {
    for (int d = 0; d < 3; ++d) r[i][d] -= x[d];
    length[i] = std::hypot(r[i][0], r[i][1], r[i][2]);
  }
  for (int i = 0; i < 3; ++i) {
    const Place &p = r[(i + 1) % 3], &q = r[(i + 2) % 3];
    dot[i] = p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
  }
  return 2 * std::atan2(volume(r[0], r[1], r[2]), length[0] * length[1] * length[2] + dot[0] * length[0] +
                                                      dot[1] * length[1] + dot[2] * length[2]);
}

/// Bodies are triangles that are joined along edges. Each is turned by itself: outwards, or as a hole where it lies in
/// an odd number of others. Returns what is wrong, as join_triangles().
std::string turn_bodies(ClosedSurface &surface)
{
  struct Body {
    std::vector<std::size_t> triangles;
    double six_volumes = 0;
    Place low, high;
  };
  constexpr double half_sphere = 2 * PETSC_PI;
  constexpr std::size_t looks = 16;                 // at places of a body
  std::map<std::pair<int, int>, std::size_t> edges; // the triangle that runs along it
  std::vector<char> taken(surface.triangles.size(), 0);
  std::vector<Body> bodies;
  const auto corner = [&](std::size_t t, int i) -> const Place & { return surface.nodes[surface.triangles[t][i]]; };

  for (std::size_t t = 0; t < surface.triangles.size(); ++t)
    for (int i = 0; i < 3; ++i) edges[{surface.triangles[t][i], surface.triangles[t][(i + 1) % 3]}] = t;
  for (std::size_t first = 0; first < taken.size(); ++first) {
    if (taken[first]) continue;
    Body body;
    body.triangles = {first};
    body.low = body.high = corner(first, 0);
    taken[first] = 1;
    for (std::size_t k = 0; k < body.triangles.size(); ++k) {
      const std::size_t t = body.triangles[k];
      body.six_volumes += volume(corner(t, 0), corner(t, 1), corner(t, 2));
      for (int i = 0; i < 3; ++i) {
        for (int d = 0; d < 3; ++d) {
          body.low[d] = std::min(body.low[d], corner(t, i)[d]);
          body.high[d] = std::max(body.high[d], corner(t, i)[d]);
        }
        const std::size_t next = edges[{surface.triangles[t][(i + 1) % 3], surface.triangles[t][i]}];
        if (taken[next]) continue;
        taken[next] = 1;
        body.triangles.push_back(next);
      }
    }
    bodies.push_back(std::move(body));
  }
  if (std::all_of(bodies.begin(), bodies.end(), [](const Body &body) { return body.six_volumes == 0; }))
    return "encloses no volume";
  const auto within = [&](const Body &body, const Body &other) { // bodies that cut each other are not
    for (int d = 0; d < 3; ++d)
      if (body.low[d] <= other.low[d] || body.high[d] >= other.high[d]) return false;
    const std::size_t step = (body.triangles.size() + looks - 1) / looks;
    for (std::size_t k = 0; k < body.triangles.size(); k += step) {
      Place middle{0, 0, 0};
      double angle = 0;
      for (int i = 0; i < 3; ++i)
        for (int d = 0; d < 3; ++d) middle[d] += corner(body.triangles[k], i)[d] / 3;
      for (const std::size_t t : other.triangles)
        angle += solid_angle(middle, corner(t, 0), corner(t, 1), corner(t, 2));
      if (std::abs(angle) < half_sphere) return false;
    }
    return true;
  };
  for (const Body &body : bodies) {
    bool hole = false;
    for (const Body &other : bodies)
      if (&other != &body && within(body, other)) hole = !hole;
    if ((body.six_volumes > 0) == hole)
      for (const std::size_t t : body.triangles) std::swap(surface.triangles[t][1], surface.triangles[t][2]);
  }
  return "";
}

PetscErrorCode read_on_root(const std::string &file, PetscReal scale, ClosedSurface &surface, std::string &fault)
{
  std::vector<Corners> list;
  const std::string ending = lower(file.substr(std::min(file.size(), file.find_last_of('.'))));

  PetscFunctionBeginUser;
  if (ending == ".stl") {
    std::string content;
    if (!read_text(file, largest_stl, content) || content.empty())
      fault = "cannot be read: there is no such file, or it is empty; check its name";
    else
      fault = read_stl(content, list);
  } else {
    MeshFile mesh;
    PetscCall(read_mesh_file(file, mesh, fault));
    if (fault.empty()) take_triangles(mesh, list);
  }
  for (Corners &corners : list)
    for (Place &x : corners)
      for (double &component : x) component *= scale;
  if (fault.empty()) {
    fault = join_triangles(std::move(list), surface);
    if (!fault.empty()) fault = "is no closed surface: it " + fault;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

template <class T>
PetscErrorCode share(MPI_Comm comm, std::vector<T> &values)
{
  std::uint64_t n = values.size();

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, 0, comm));
  values.resize(n);
  PetscCallMPI(MPI_Bcast(values.data(), static_cast<PetscMPIInt>(n * sizeof(T)), MPI_BYTE, 0, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

Place ClosedSurface::lowest() const
{
  Place low{std::numeric_limits<double>::max(), std::numeric_limits<double>::max(), std::numeric_limits<double>::max()};
  for (const Place &x : nodes)
    for (int d = 0; d < 3; ++d) low[d] = std::min(low[d], x[d]);
  return low;
}

Place ClosedSurface::highest() const
{
  Place high{std::numeric_limits<double>::lowest(), std::numeric_limits<double>::lowest(),
             std::numeric_limits<double>::lowest()};
  for (const Place &x : nodes)
    for (int d = 0; d < 3; ++d) high[d] = std::max(high[d], x[d]);
  return high;
}

double ClosedSurface::size() const
{
  const Place low = lowest(), high = highest();
  return std::hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
}

std::string ClosedSurface::hash() const
{
  std::uint64_t h = 0xcbf29ce484222325U; // FNV-1a
  const auto add = [&h](const void *data, std::size_t bytes) {
    const auto *byte = static_cast<const unsigned char *>(data);
    for (std::size_t i = 0; i < bytes; ++i) h = (h ^ byte[i]) * 0x100000001b3U;
  };
  add(nodes.data(), nodes.size() * sizeof(nodes[0]));
  add(triangles.data(), triangles.size() * sizeof(triangles[0]));
  char text[32];
  std::snprintf(text, sizeof(text), "hash %016llx", static_cast<unsigned long long>(h));
  return text;
}

std::string join_triangles(std::vector<Corners> list, ClosedSurface &surface)
{
  std::map<Place, int> number;
  std::map<std::pair<int, int>, int> edges; // how many triangles run along it

  surface = {};
  for (Corners &corners : list) {
    for (Place &x : corners)
      for (double &component : x) component += 0.0; // no -0
    std::rotate(corners.begin(), std::min_element(corners.begin(), corners.end()), corners.end());
  }
  std::sort(list.begin(), list.end());
  for (const Corners &corners : list)
    for (const Place &x : corners) number.insert({x, 0});
  for (auto &[x, n] : number) {
    n = static_cast<int>(surface.nodes.size());
    surface.nodes.push_back(x);
  }
  for (const Corners &corners : list) {
    const std::array<int, 3> t{number[corners[0]], number[corners[1]], number[corners[2]]};
    if (t[0] == t[1] || t[1] == t[2] || t[2] == t[0]) continue; // no more than an edge, as some programs write
    surface.triangles.push_back(t);
    for (int i = 0; i < 3; ++i) ++edges[{t[i], t[(i + 1) % 3]}];
  }
  if (surface.triangles.empty()) return "has no triangles";
  std::size_t open = 0, turned = 0;
  const Place *where = nullptr, *where_turned = nullptr;
  for (const auto &[edge, n] : edges) {
    const auto other = edges.find({edge.second, edge.first});
    if (n > 1) {
      if (turned++ == 0) where_turned = &surface.nodes[edge.first];
    } else if (other == edges.end()) {
      if (open++ == 0) where = &surface.nodes[edge.first];
    }
  }
  if (turned > 0)
    return "has " + std::to_string(turned) + " edges along which triangles run the same way (one is at " +
           text_of(*where_turned) +
           "): some are turned inside out, or are there twice, or more than two meet; orient and "
           "clean the surface";
  if (open > 0)
    return "has " + std::to_string(open) + " edges of one triangle alone (one is at " + text_of(*where) +
           "): close its holes, and join corners that are the same";
  return turn_bodies(surface);
}

std::string read_stl(const std::string &content, std::vector<Corners> &list)
{
  std::uint32_t n = 0;
  std::size_t begin;

  list.clear();
  if (content.size() >= stl_head) std::memcpy(&n, content.data() + stl_head - sizeof(n), sizeof(n));
  const std::size_t whole = stl_head + stl_triangle * n;
  // some programs leave a few bytes behind the last facet; in a text these four are letters, and n far too large
  if (content.size() >= whole && content.size() < whole + stl_triangle) return read_binary_stl(content, list);
  if (begins_as_ascii_stl(content, begin)) return read_ascii_stl(content.substr(begin), list);
  return "is no readable STL file: it neither begins with 'solid' (ASCII) nor has the length that its number of facets "
         "asks for (binary)";
}

PetscErrorCode read_closed_surface(MPI_Comm comm, const std::string &option, const std::string &file, PetscReal scale,
                                   ClosedSurface &surface)
{
  PetscMPIInt rank;
  std::string fault;

  PetscFunctionBeginUser;
  surface = {};
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) PetscCall(read_on_root(file, scale, surface, fault));
  PetscCall(from_root(comm, fault));
  PulmoUserCheck(fault.empty(), comm, "%s %s %s", option.c_str(), file.c_str(), fault.c_str());
  PetscCall(share(comm, surface.nodes));
  PetscCall(share(comm, surface.triangles));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode boundary_of(const Mesh &mesh, const std::string &option, ClosedSurface &surface)
{
  const DM dm = mesh.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  std::vector<PetscInt> facets;
  std::vector<Corners> own;
  PetscInt vertex_begin, vertex_end;
  PetscMPIInt ranks;

  PetscFunctionBeginUser;
  PetscCall(outer_facets(dm, facets));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  for (const PetscInt facet : facets) {
    const PetscInt *cell;
    PetscInt *closure = nullptr, n, k = 0;
    PetscReal measure, inside[3];
    Corners corners;
    PetscCall(DMPlexGetTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i)
      if (closure[2 * i] >= vertex_begin && closure[2 * i] < vertex_end)
        PetscCall(mesh.node_coordinates(closure[2 * i], corners[k++].data()));
    PetscCall(DMPlexRestoreTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
    PetscCall(DMPlexGetSupport(dm, facet, &cell));
    PetscCall(DMPlexComputeCellGeometryFVM(dm, cell[0], &measure, inside, nullptr));
    Corners seen = corners; // from the middle of the cell
    for (Place &x : seen)
      for (int d = 0; d < 3; ++d) x[d] -= inside[d];
    if (volume(seen[0], seen[1], seen[2]) < 0) std::swap(corners[1], corners[2]);
    own.push_back(corners);
  }
  PetscCallMPI(MPI_Comm_size(comm, &ranks));
  int count = static_cast<int>(9 * own.size());
  std::vector<int> counts(static_cast<std::size_t>(ranks)), offsets(static_cast<std::size_t>(ranks), 0);
  PetscCallMPI(MPI_Allgather(&count, 1, MPI_INT, counts.data(), 1, MPI_INT, comm));
  for (int r = 1; r < ranks; ++r) offsets[r] = offsets[r - 1] + counts[r - 1];
  std::vector<Corners> all(static_cast<std::size_t>(offsets.back() + counts.back()) / 9);
  PetscCallMPI(
      MPI_Allgatherv(own.data(), count, MPI_DOUBLE, all.data(), counts.data(), offsets.data(), MPI_DOUBLE, comm));
  const std::string fault = join_triangles(std::move(all), surface);
  PulmoUserCheck(fault.empty(), comm, "%s: the boundary of the mesh is no closed surface: it %s", option.c_str(),
                 fault.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
