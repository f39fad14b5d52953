#include "pulmo/mesh/saved_mesh.hpp"

#include "pulmo/base/hdf5_image.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>

namespace pulmo {

namespace {

using Json = nlohmann::ordered_json;

/// Marks a file of pulmo, and tells how to read it. Raise it when a name or a meaning changes.
constexpr const char *marker = "pulmo_mesh";
constexpr int format = 1;
constexpr const char *check_of_about = "checksum_of_about";
constexpr std::size_t image_growth = 1 << 20; // bytes
constexpr std::size_t place_of_flags = 11;    // in a file of HDF5's

constexpr const char *save_anew = "save it anew with -mesh_save";
constexpr std::size_t longest_about = std::size_t(1) << 28; // bytes

/// Scrambles 64 bits (splitmix64).
std::uint64_t scramble(std::uint64_t h)
{
  h += 0x9e3779b97f4a7c15U;
  h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9U;
  h = (h ^ (h >> 27)) * 0x94d049bb133111ebU;
  return h ^ (h >> 31);
}

std::uint64_t bits_of(double value)
{
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof(bits));
  return bits;
}
std::uint64_t bits_of(int value)
{
  return static_cast<std::uint32_t>(value);
}

/// A sum over the numbers of a dataset from the @p first one on. The ranks' sums together are that of the whole.
template <class T>
std::uint64_t checksum(const T *values, std::size_t n, std::uint64_t first)
{
  std::uint64_t sum = 0;
  for (std::size_t i = 0; i < n; ++i) sum += scramble(scramble(first + i) ^ bits_of(values[i]));
  return sum;
}

std::uint64_t text_checksum(const std::string &text)
{
  return checksum(std::vector<int>(text.begin(), text.end()).data(), text.size(), 0);
}

/// Whether HDF5 reads an image.
bool opens(std::vector<char> &image)
{
  const Hdf5Id access(H5Pcreate(H5P_FILE_ACCESS), H5Pclose);
  if (H5Pset_fapl_core(access, image_growth, 0) < 0 || H5Pset_file_image(access, image.data(), image.size()) < 0)
    return false;
  const Hdf5Id file(H5Fopen("image to read", H5F_ACC_RDONLY, access), H5Fclose);
  return file >= 0;
}

/// The datasets of a file: what one row has, and the checksums of all.
struct Dataset {
  const char *name;
  hsize_t width;
  bool real;
  bool of_nodes;
};
enum : std::size_t { cells_set, facets_set, volumes_set, places_set, nodes_set, sets };
constexpr std::array<Dataset, sets> datasets{{{"cells", 4, false, false},
                                              {"facets", 4, false, false},
                                              {"volumes", 1, false, false},
                                              {"places", 1, false, false},
                                              {"nodes", 3, true, true}}};
using Checksums = std::array<std::uint64_t, sets>;

std::vector<hsize_t> shape_of(const Dataset &set, hsize_t rows)
{
  return set.width == 1 ? std::vector<hsize_t>{rows} : std::vector<hsize_t>{rows, set.width};
}

/// Shows @p visit each dataset of a slice: its number, its values, their count, the number of the first of them.
template <class Slice, class Visit>
void each_dataset(Slice &slice, Visit visit)
{
  const auto cell = static_cast<std::uint64_t>(slice.first_cell), node = static_cast<std::uint64_t>(slice.first_node);
  visit(cells_set, reinterpret_cast<int *>(slice.cells.data()), 4 * slice.cells.size(), 4 * cell);
  visit(facets_set, reinterpret_cast<int *>(slice.facets.data()), 4 * slice.facets.size(), 4 * cell);
  visit(volumes_set, slice.volumes.data(), slice.volumes.size(), cell);
  visit(places_set, slice.places.data(), slice.places.size(), cell);
  visit(nodes_set, reinterpret_cast<double *>(slice.nodes.data()), 3 * slice.nodes.size(), 3 * node);
}

Checksums checksums_of(SavedMesh::Slice &slice)
{
  Checksums sums{};
  each_dataset(slice, [&](std::size_t set, auto *values, std::size_t n, std::uint64_t first) {
    sums[set] = checksum(values, n, first);
  });
  return sums;
}

// ------------------------------------------------------------------------------------------------- what is said of it

// Names of meshes may be of any encoding, JSON is of one: each byte is taken for a letter of its own.

std::string as_letters(const std::string &bytes)
{
  std::string letters;
  for (const char byte : bytes) {
    const auto code = static_cast<unsigned char>(byte);
    if (code >= 0x80) letters += static_cast<char>(0xc0 | (code >> 6));
    letters += static_cast<char>(code >= 0x80 ? 0x80 | (code & 0x3f) : code);
  }
  return letters;
}

std::string as_bytes(const std::string &letters)
{
  std::string bytes;
  for (std::size_t i = 0; i < letters.size(); ++i) {
    auto code = static_cast<unsigned char>(letters[i]);
    if (code >= 0x80 && i + 1 < letters.size())
      code = static_cast<unsigned char>((code << 6) | (static_cast<unsigned char>(letters[++i]) & 0x3f));
    bytes += static_cast<char>(code);
  }
  return bytes;
}

Json as_letters(const std::vector<std::string> &list)
{
  Json letters = Json::array();
  for (const std::string &bytes : list) letters.push_back(as_letters(bytes));
  return letters;
}

std::string about_text(const SavedMesh &mesh, const Checksums &sums)
{
  Json parts = Json::array();
  for (const SavedMesh::Part &p : mesh.parts)
    parts.push_back({{"name", as_letters(p.name)},
                     {"dimension", p.dimension},
                     {"elements", p.elements},
                     {"measure", p.measure},
                     {"inside", p.inside}});
  const Json json = {{"cells", mesh.cells},
                     {"nodes", mesh.nodes},
                     {"tetrahedra", mesh.tetrahedra},
                     {"volume", mesh.volume},
                     {"scale", mesh.scale},
                     {"scale_given", mesh.scale_given},
                     {"prefer", as_letters(mesh.prefer)},
                     {"notes", as_letters(mesh.notes)},
                     {"parts", parts},
                     {"volumes", mesh.volumes},
                     {"checksums", sums},
                     {"version", PULMO_VERSION}};
  return json.dump(1);
}

/// False if @p text does not say all, or not what can be.
bool read_about(const std::string &text, SavedMesh &mesh, Checksums &sums)
{
  try {
    const Json json = Json::parse(text);
    json.at("cells").get_to(mesh.cells);
    json.at("nodes").get_to(mesh.nodes);
    json.at("tetrahedra").get_to(mesh.tetrahedra);
    json.at("volume").get_to(mesh.volume);
    json.at("scale").get_to(mesh.scale);
    json.at("scale_given").get_to(mesh.scale_given);
    for (const std::string letters : json.at("prefer")) mesh.prefer.push_back(as_bytes(letters));
    for (const std::string letters : json.at("notes")) mesh.notes.push_back(as_bytes(letters));
    json.at("volumes").get_to(mesh.volumes);
    json.at("checksums").get_to(sums);
    for (const Json &p : json.at("parts"))
      mesh.parts.push_back(
          {as_bytes(p.at("name")), p.at("dimension"), p.at("elements"), p.at("measure"), p.at("inside")});
  } catch (const nlohmann::json::exception &) {
    return false;
  }
  const auto n_parts = static_cast<int>(mesh.parts.size());
  const bool parts_good = std::all_of(mesh.parts.begin(), mesh.parts.end(), [&](const SavedMesh::Part &p) {
    return !p.name.empty() && (p.dimension == 2 || p.dimension == 3) && p.elements > 0 && p.measure > 0;
  });
  const bool volumes_good = std::all_of(mesh.volumes.begin(), mesh.volumes.end(), [&](const std::vector<int> &list) {
    return std::all_of(list.begin(), list.end(),
                       [&](int i) { return i >= 0 && i < n_parts && mesh.parts[i].dimension == 3; });
  });
  return mesh.cells > 0 && mesh.cells <= PETSC_MAX_INT && mesh.nodes > 3 && mesh.nodes <= PETSC_MAX_INT &&
         mesh.tetrahedra >= mesh.cells && mesh.tetrahedra <= PETSC_MAX_INT && mesh.scale > 0 && mesh.volume > 0 &&
         parts_good && volumes_good;
}

// ------------------------------------------------------------------------------------------------------------ reading

/// Opens a file of which @p fault says nothing yet; negative with a fault.
hid_t open_marked(const std::string &file, std::string &fault)
{
  const hid_t opened = H5Fopen(file.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT);
  if (opened < 0)
    fault =
        std::string("cannot be opened: it is incomplete or damaged, or another program is writing it; ") + save_anew;
  return opened;
}

/// Rank 0 reads what is said of the whole.
std::string read_header(const std::string &file, std::string &about)
{
  std::string fault;
  const Hdf5Id opened(open_marked(file, fault), H5Fclose);
  if (opened < 0) return fault;
  int found = -1;
  const Hdf5Id mark(H5Aopen(opened, marker, H5P_DEFAULT), H5Aclose);
  if (mark < 0 || H5Aread(mark, H5T_NATIVE_INT, &found) < 0)
    return std::string("is damaged: its mark is gone; ") + save_anew;
  if (found != format)
    return "is a mesh of format " + std::to_string(found) + ", and this pulmo reads format " + std::to_string(format) +
           "; " + save_anew + " of this pulmo";
  const Hdf5Id set(H5Dopen2(opened, "about", H5P_DEFAULT), H5Dclose);
  const Hdf5Id space(set < 0 ? -1 : H5Dget_space(set), H5Sclose);
  const hssize_t n = space < 0 ? -1 : H5Sget_simple_extent_npoints(space);
  if (n <= 0 || static_cast<std::size_t>(n) > longest_about)
    return std::string("is damaged: what it says of the mesh is gone; ") + save_anew;
  about.resize(static_cast<std::size_t>(n));
  if (H5Dread(set, H5T_NATIVE_UCHAR, H5S_ALL, H5S_ALL, H5P_DEFAULT, about.data()) < 0)
    return std::string("is damaged: what it says of the mesh cannot be read; ") + save_anew;
  std::uint64_t said = 0;
  const Hdf5Id check(H5Aopen(opened, check_of_about, H5P_DEFAULT), H5Aclose);
  if (check < 0 || H5Aread(check, H5T_NATIVE_UINT64, &said) < 0 || said != text_checksum(about))
    return std::string("is damaged: what it says of the mesh is not what was written; ") + save_anew;
  return "";
}

/// Reads @p rows rows of a dataset that has @p all of them.
bool read_rows(hid_t file, const Dataset &set, hsize_t all, hsize_t first, hsize_t rows, void *values)
{
  const Hdf5Id data(H5Dopen2(file, set.name, H5P_DEFAULT), H5Dclose);
  if (data < 0) return false;
  const Hdf5Id space(H5Dget_space(data), H5Sclose), stored(H5Dget_type(data), H5Tclose);
  const std::vector<hsize_t> shape = shape_of(set, all);
  std::vector<hsize_t> found(shape.size());
  if (H5Sget_simple_extent_ndims(space) != static_cast<int>(shape.size()) ||
      H5Sget_simple_extent_dims(space, found.data(), nullptr) < 0 || found != shape ||
      H5Tget_class(stored) != (set.real ? H5T_FLOAT : H5T_INTEGER))
    return false;
  if (rows == 0) return true;
  std::vector<hsize_t> start(shape.size(), 0), count = shape;
  start[0] = first;
  count[0] = rows;
  const Hdf5Id memory(H5Screate_simple(static_cast<int>(count.size()), count.data(), nullptr), H5Sclose);
  return H5Sselect_hyperslab(space, H5S_SELECT_SET, start.data(), nullptr, count.data(), nullptr) >= 0 &&
         H5Dread(data, set.real ? H5T_NATIVE_DOUBLE : H5T_NATIVE_INT, memory, space, H5P_DEFAULT, values) >= 0;
}

/// Whether all that a slice names is there.
bool is_sound(const SavedMesh &mesh, const SavedMesh::Slice &slice)
{
  const auto n_nodes = mesh.nodes;
  for (std::size_t c = 0; c < slice.cells.size(); ++c) {
    for (int i = 0; i < 4; ++i) {
      const int node = slice.cells[c][i], part = slice.facets[c][i];
      if (node < 0 || node >= n_nodes || part < -1 || part >= static_cast<int>(mesh.parts.size())) return false;
      if (part >= 0 && mesh.parts[part].dimension != 2) return false;
    }
    if (slice.volumes[c] < 0 || slice.volumes[c] >= static_cast<int>(mesh.volumes.size()) || slice.places[c] < 0 ||
        slice.places[c] >= mesh.tetrahedra)
      return false;
  }
  return std::all_of(slice.nodes.begin(), slice.nodes.end(), [](const std::array<double, 3> &x) {
    return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]);
  });
}

/// Reads this rank's part of the file.
std::string read_slice(const std::string &file, const SavedMesh &mesh, int rank, int size, SavedMesh::Slice &slice)
{
  std::string fault;
  const auto begin = [&](std::int64_t n, int r) { return n / size * r + std::min<std::int64_t>(n % size, r); };
  slice.first_cell = begin(mesh.cells, rank);
  slice.first_node = begin(mesh.nodes, rank);
  const auto n_cells = static_cast<std::size_t>(begin(mesh.cells, rank + 1) - slice.first_cell),
             n_nodes = static_cast<std::size_t>(begin(mesh.nodes, rank + 1) - slice.first_node);
  const Hdf5Id opened(open_marked(file, fault), H5Fclose);
  if (opened < 0) return fault;
  slice.cells.resize(n_cells);
  slice.facets.resize(n_cells);
  slice.volumes.resize(n_cells);
  slice.places.resize(n_cells);
  slice.nodes.resize(n_nodes);
  each_dataset(slice, [&](std::size_t set, auto *values, std::size_t, std::uint64_t) {
    const Dataset &data = datasets[set];
    const std::int64_t all = data.of_nodes ? mesh.nodes : mesh.cells,
                       first = data.of_nodes ? slice.first_node : slice.first_cell;
    if (!read_rows(opened, data, static_cast<hsize_t>(all), static_cast<hsize_t>(first),
                   data.of_nodes ? n_nodes : n_cells, values) &&
        fault.empty())
      fault = "is damaged: its " + std::string(data.name) + " cannot be read; " + save_anew;
  });
  return fault;
}

} // namespace

SavedMesh SavedMesh::of(const NamedMesh &mesh)
{
  SavedMesh saved;
  saved.cells = static_cast<std::int64_t>(mesh.cells.size());
  saved.nodes = static_cast<std::int64_t>(mesh.nodes.size());
  saved.tetrahedra = mesh.tetrahedra;
  saved.volume = mesh.volume;
  saved.notes = mesh.notes;
  for (const NamedMesh::Part &p : mesh.parts)
    saved.parts.push_back({p.name, p.dimension, static_cast<std::int64_t>(p.elements.size()), p.measure, p.inside});
  return saved;
}

std::vector<char> image_of(const SavedMesh &about, const NamedMesh &mesh, const std::vector<int> &order)
{
  const QuietHdf5 quiet;
  SavedMesh saved = about;
  SavedMesh::Slice whole;
  std::vector<char> image;

  // nodes are numbered as the cells come to them
  std::vector<int> number(mesh.nodes.size(), -1);
  std::vector<std::vector<int>> lists(mesh.cells.size());
  std::map<std::array<int, 3>, int> named;
  for (std::size_t p = 0; p < mesh.parts.size(); ++p)
    for (const int element : mesh.parts[p].elements) {
      if (mesh.parts[p].dimension == 3) {
        lists[element].push_back(static_cast<int>(p));
        continue;
      }
      std::array<int, 3> facet = mesh.facets[element];
      std::sort(facet.begin(), facet.end());
      named[facet] = static_cast<int>(p);
    }
  std::map<std::vector<int>, int> known;
  for (const int c : order) {
    std::array<int, 4> corners{}, facets{};
    for (int i = 0; i < 4; ++i) {
      int &node = number[mesh.cells[c][i]];
      if (node < 0) {
        node = static_cast<int>(whole.nodes.size());
        whole.nodes.push_back(mesh.nodes[mesh.cells[c][i]]);
      }
      corners[i] = node;
      std::array<int, 3> facet{};
      for (int k = 0, n = 0; k < 4; ++k)
        if (k != i) facet[n++] = mesh.cells[c][k];
      std::sort(facet.begin(), facet.end());
      const auto found = named.find(facet);
      facets[i] = found == named.end() ? -1 : found->second;
    }
    const auto [list, added] = known.insert({lists[c], static_cast<int>(known.size())});
    if (added) saved.volumes.push_back(lists[c]);
    whole.cells.push_back(corners);
    whole.facets.push_back(facets);
    whole.volumes.push_back(list->second);
    whole.places.push_back(mesh.place[c]);
  }

  const std::string text = about_text(saved, checksums_of(whole));
  // in this version of HDF5's format what it says of itself has checksums: damage there would crash the library
  const Hdf5Id access(H5Pcreate(H5P_FILE_ACCESS), H5Pclose);
  if (H5Pset_fapl_core(access, image_growth, 0) < 0 ||
      H5Pset_libver_bounds(access, H5F_LIBVER_V18, H5F_LIBVER_V110) < 0)
    return image;
  const Hdf5Id file(H5Fcreate("image", H5F_ACC_TRUNC, H5P_DEFAULT, access), H5Fclose);
  if (file < 0) return image;
  const std::uint64_t sum = text_checksum(text);
  const Hdf5Id scalar(H5Screate(H5S_SCALAR), H5Sclose);
  const Hdf5Id mark(H5Acreate2(file, marker, H5T_NATIVE_INT, scalar, H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
  const Hdf5Id check(H5Acreate2(file, check_of_about, H5T_NATIVE_UINT64, scalar, H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
  bool good = mark >= 0 && check >= 0 && H5Awrite(mark, H5T_NATIVE_INT, &format) >= 0 &&
              H5Awrite(check, H5T_NATIVE_UINT64, &sum) >= 0 &&
              write_hdf5(file, "about", H5T_NATIVE_UCHAR, {text.size()}, text.data(), false);
  each_dataset(whole, [&](std::size_t set, auto *values, std::size_t n, std::uint64_t) {
    const Dataset &data = datasets[set];
    good = good && write_hdf5(file, data.name, data.real ? H5T_NATIVE_DOUBLE : H5T_NATIVE_INT,
                              shape_of(data, n / data.width), values, false);
  });
  if (!good || !take_hdf5_image(file, image)) image.clear();
  // HDF5 1.10 takes the mark of an open file off the image, but not out of the checksum
  if (!image.empty() && !opens(image)) {
    image[place_of_flags] = 1;
    if (!opens(image)) image.clear();
  }
  return image;
}

bool is_saved_mesh(const std::string &file)
{
  const QuietHdf5 quiet;
  std::error_code ignored;
  if (!std::filesystem::is_regular_file(file, ignored) || H5Fis_hdf5(file.c_str()) <= 0) return false;
  const Hdf5Id opened(H5Fopen(file.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT), H5Fclose);
  return opened >= 0 && H5Aexists(opened, marker) > 0;
}

PetscErrorCode read_saved_mesh(MPI_Comm comm, const std::string &file, SavedMesh &mesh, SavedMesh::Slice &slice,
                               std::string &fault)
{
  const QuietHdf5 quiet;
  PetscMPIInt rank, size;
  std::string about;
  Checksums said{};

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  mesh = SavedMesh();
  slice = SavedMesh::Slice();
  fault.clear();
  if (rank == 0) fault = read_header(file, about);
  PetscCall(from_root(comm, fault));
  if (!fault.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(from_root(comm, about));
  if (!read_about(about, mesh, said)) { // on all ranks alike
    fault = std::string("is damaged: it says of the mesh what cannot be; ") + save_anew;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  fault = read_slice(file, mesh, rank, size, slice);
  PetscCall(from_first(comm, fault));
  if (!fault.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  Checksums sums = checksums_of(slice);
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<int>(sums.size()), MPI_UINT64_T, MPI_SUM, comm));
  for (std::size_t set = 0; set < sums.size(); ++set)
    if (fault.empty() && sums[set] != said[set])
      fault = "is damaged: its " + std::string(datasets[set].name) + " are not those that were written; " + save_anew;
  if (fault.empty() && !is_sound(mesh, slice))
    fault = std::string("is damaged: its cells name what it does not hold; ") + save_anew;
  PetscCall(from_first(comm, fault));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
