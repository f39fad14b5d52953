// Field snapshots: HDF5 files, one XDMF index with quadratic tetrahedra, whatever the elements.
#include "pulmo/base/hdf5_image.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/base/whole_file.hpp"
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/mesh/node_order.hpp"
#include "pulmo/observers/error_indicator.hpp"
#include "pulmo/observers/output.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <numeric>
#include <set>
#include <sstream>

namespace pulmo {

namespace {

/// Edges of a quadratic tetrahedron in the order of VTK and XDMF.
constexpr std::array<std::array<int, 2>, 6> edges{{{0, 1}, {1, 2}, {0, 2}, {0, 3}, {1, 3}, {2, 3}}};

/// Names of the fields in the files: with their units, or without one if they have none.
constexpr const char *displacement_name = "displacement_mm", *pressure_name = "alveolar_pressure_cmH2O",
                     *mean_J_name = "J_mean", *least_J_name = "J_min", *hydrostatic_name = "hydrostatic_stress_kPa",
                     *von_mises_name = "von_mises_stress_kPa", *porosity_name = "porosity",
                     *ventilation_name = "ventilation_since_breath_start", *region_name = "region_number",
                     *tissue_error_name = "error_indicator_J", *flow_error_name = "error_indicator_flux_W",
                     *whole_error_name = "error_indicator_J_whole";

/// Marks a snapshot with indicators in a checkpoint.
const std::string error_indicator = "error_indicator";

/// What all ranks have, one after the other, on rank 0.
template <class T>
PetscErrorCode gather(MPI_Comm comm, MPI_Datatype type, const std::vector<T> &mine, std::vector<T> &all)
{
  PetscMPIInt rank, size, n;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  std::vector<PetscMPIInt> counts(rank == 0 ? size : 0), starts(counts.size());
  PetscCall(PetscMPIIntCast(static_cast<PetscInt>(mine.size()), &n));
  PetscCallMPI(MPI_Gather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  std::exclusive_scan(counts.begin(), counts.end(), starts.begin(), 0);
  if (rank == 0) all.resize(static_cast<std::size_t>(starts.back()) + static_cast<std::size_t>(counts.back()));
  PetscCallMPI(MPI_Gatherv(mine.data(), n, type, all.data(), counts.data(), starts.data(), type, 0, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A file of values of all ranks, made in the memory of rank 0 and then written whole: a disk that fails in the middle
/// of a collective write would leave ranks waiting for each other.
class ValueFile {
public:
  explicit ValueFile(MPI_Comm comm) : comm_(comm)
  {
    PetscMPIInt rank = 0;
    (void)MPI_Comm_rank(comm, &rank);
    root_ = rank == 0;
    if (root_) file_ = create_hdf5_image();
  }
  ~ValueFile()
  {
    if (file_ >= 0) H5Fclose(file_);
  }
  ValueFile(const ValueFile &) = delete;
  ValueFile &operator=(const ValueFile &) = delete;

  /// A dataset of @p columns values per entry.
  PetscErrorCode write(const std::string &name, PetscInt columns, const std::vector<PetscScalar> &values)
  {
    return write(name, MPIU_SCALAR, H5T_NATIVE_DOUBLE, columns, values);
  }
  PetscErrorCode write(const std::string &name, PetscInt columns, const std::vector<PetscInt> &values)
  {
    return write(name, MPIU_INT, sizeof(PetscInt) == sizeof(int) ? H5T_NATIVE_INT : H5T_NATIVE_INT64, columns, values);
  }
  /// Writes it all to @p path.
  PetscErrorCode close(const std::string &path)
  {
    int error = 0;

    PetscFunctionBeginUser;
    if (root_) {
      std::vector<char> image;
      good_ = good_ && take_hdf5_image(file_, image);
      if (good_) error = write_whole(path, image);
    }
    PetscCall(from_root(comm_, good_));
    PetscCheck(good_, comm_, PETSC_ERR_LIB, "HDF5 failed to make a file in memory");
    PetscCall(check_written(comm_, error, path));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  template <class T>
  PetscErrorCode write(const std::string &name, MPI_Datatype mpi_type, hid_t type, PetscInt columns,
                       const std::vector<T> &mine)
  {
    std::vector<T> all;

    PetscFunctionBeginUser;
    PetscCall(gather(comm_, mpi_type, mine, all));
    std::vector<hsize_t> shape{all.size() / static_cast<std::size_t>(columns)};
    if (columns > 1) shape.push_back(static_cast<hsize_t>(columns));
    if (root_) good_ = good_ && file_ >= 0 && write_hdf5(file_, name, type, shape, all.data(), false);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  MPI_Comm comm_;
  bool root_ = false, good_ = true;
  hid_t file_ = -1; ///< on rank 0
};

/// A field at a vertex or in the middle of an edge of @p dm, from a local vector; appended to @p values.
PetscErrorCode append_at(DM dm, PetscInt point, PetscInt field, const PetscScalar *x, std::vector<PetscScalar> &values)
{
  PetscSection section;
  PetscInt components, dof, offset, n_ends;
  const PetscInt *ends;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(PetscSectionGetFieldComponents(section, field, &components));
  PetscCall(PetscSectionGetFieldDof(section, point, field, &dof));
  PetscCall(PetscSectionGetFieldOffset(section, point, field, &offset));
  PetscCall(DMPlexGetConeSize(dm, point, &n_ends));
  PetscCall(DMPlexGetCone(dm, point, &ends));
  if (n_ends == 0 || dof == components) { // a node of its own: a vertex, an edge of P2
    values.insert(values.end(), x + offset, x + offset + components);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  // P1; P3 with the nodes of nodes_at()
  const PetscScalar of_end = dof == 0 ? 1. / 2 : -1. / 8, of_inner = 5. / 8;
  const std::size_t first = values.size();
  values.resize(first + static_cast<std::size_t>(components), 0);
  for (PetscInt d = 0; d < dof; ++d) values[first + d % components] += of_inner * x[offset + d];
  for (PetscInt i = 0; i < n_ends; ++i) {
    PetscCall(PetscSectionGetFieldOffset(section, ends[i], field, &offset));
    for (PetscInt d = 0; d < components; ++d) values[first + d] += of_end * x[offset + d];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What a remembered quantity is called in the files: quantity, surface, unit.
std::string remembered_name(const MemorySpec &spec, std::size_t index)
{
  const Quantity &quantity = spec.quantities[index];
  std::string name = quantity.name + (spec.surface.empty() ? "" : "_" + spec.surface);
  if (quantity.unit != "-") name += "_" + quantity.unit;
  for (std::size_t slash; (slash = name.find('/')) != std::string::npos;) name.replace(slash, 1, "_per_");
  std::replace(name.begin(), name.end(), ' ', '_');
  return name;
}

/// @p text as XML wants it: names of a mesh may hold what it keeps for itself.
std::string in_xml(const std::string &text)
{
  std::string safe;
  for (const char c : text) {
    if (c == '&')
      safe += "&amp;";
    else if (c == '<')
      safe += "&lt;";
    else if (c == '>')
      safe += "&gt;";
    else if (c == '"')
      safe += "&quot;";
    else
      safe += c;
  }
  return safe;
}

/// @p wanted, or that with a number behind it if it is one of @p taken, to which it is added.
std::string another_name(const std::string &wanted, std::set<std::string> &taken)
{
  std::string name = wanted;
  for (int n = 2; !taken.insert(name).second; ++n) name = wanted + "_" + std::to_string(n);
  return name;
}

/// The text of an XDMF file of grids of quadratic tetrahedra, whose values are in HDF5 files.
class Xdmf {
public:
  Xdmf(PetscInt cells, PetscInt nodes) : cells_(cells), nodes_(nodes)
  {
    text << "<?xml version=\"1.0\"?>\n<Xdmf Version=\"3.0\">\n<Domain>\n";
    text.precision(15);
  }
  /// A grid on the nodes and cells in @p mesh.
  void begin(const std::string &name, const std::string &mesh, std::optional<PetscReal> time)
  {
    text << " <Grid Name=\"" << in_xml(name) << "\" GridType=\"Uniform\">\n";
    if (time) text << "  <Time Value=\"" << *time << "\"/>\n";
    text << "  <Topology TopologyType=\"Tetrahedron_10\" NumberOfElements=\"" << cells_ << "\">";
    item(mesh, "topology", cells_, 10, "Int");
    text << "</Topology>\n  <Geometry GeometryType=\"XYZ\">";
    item(mesh, "geometry", nodes_, 3, "Float");
    text << "</Geometry>\n";
  }
  void at_nodes(const std::string &name, PetscInt columns, const std::string &h5)
  {
    attribute(name, "Node", nodes_, columns, h5);
  }
  void of_cells(const std::string &name, const std::string &h5) { attribute(name, "Cell", cells_, 1, h5); }
  void end() { text << " </Grid>\n"; }
  PetscErrorCode write(MPI_Comm comm, const std::string &path) const
  {
    PetscFunctionBeginUser;
    PetscCall(write_text(comm, text.str() + "</Domain>\n</Xdmf>\n", path));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::ostringstream text;

private:
  void item(const std::string &h5, const std::string &dataset, PetscInt rows, PetscInt columns, const char *type)
  {
    text << "<DataItem Format=\"HDF\" NumberType=\"" << type << "\" Precision=\""
         << (type[0] == 'I' ? sizeof(PetscInt) : 8) << "\" Dimensions=\"" << rows;
    if (columns > 1) text << " " << columns;
    text << "\">" << in_xml(h5 + ":/" + dataset) << "</DataItem>";
  }
  void attribute(const std::string &name, const char *centre, PetscInt rows, PetscInt columns, const std::string &h5)
  {
    text << "  <Attribute Name=\"" << in_xml(name) << "\" AttributeType=\"" << (columns == 3 ? "Vector" : "Scalar")
         << "\" Center=\"" << centre << "\">";
    item(h5, name, rows, columns, "Float");
    text << "</Attribute>\n";
  }

  PetscInt cells_, nodes_;
};

/// The file of the snapshot @p index, or of what else belongs to it.
std::string snapshot_name(PetscInt index, const char *what = "")
{
  char name[64];
  std::snprintf(name, sizeof(name), "fields_%05d%s.h5", static_cast<int>(index), what);
  return name;
}

} // namespace

FieldWriter::FieldWriter(const Output &output, const Scene &scene, Model &model)
    : output_(output), scene_(scene), model_(model), schedule_(output.fields_every(), true)
{}

FieldWriter::~FieldWriter() = default;

PetscErrorCode FieldWriter::setup()
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  const std::vector<std::string> &wanted = output_.fields_memory();
  std::vector<Remembered> offered;
  std::set<std::string> taken;
  std::string names;

  PetscFunctionBeginUser;
  if (wanted.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const MemorySpec &spec : model_.composition().memories())
    for (std::size_t i = 0; i < spec.quantities.size(); ++i) {
      if (spec.quantities[i].unit.empty()) continue;
      offered.push_back({&spec, i, another_name(remembered_name(spec, i), taken)});
      names += (names.empty() ? "" : ", ") + offered.back().name;
    }
  PulmoUserCheck(!offered.empty(), comm,
                 "option -output_fields_memory: no effect of this scene remembers a quantity that has a unit; leave it "
                 "out");
  if (wanted.size() == 1 && wanted.front() == "all") {
    remembered_ = offered;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  for (const std::string &name : wanted) {
    PulmoUserCheck(name != "all", comm, "option -output_fields_memory: 'all' stands alone; leave out the other names");
    const auto found =
        std::find_if(offered.begin(), offered.end(), [&](const Remembered &r) { return r.name == name; });
    PulmoUserCheck(found != offered.end(), comm,
                   "option -output_fields_memory: no effect of this scene remembers '%s'; there is: all, or %s",
                   name.c_str(), names.c_str());
    remembered_.push_back(*found);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::observe(const StepReport &step)
{
  const bool start = step.row.dt == 0;

  PetscFunctionBeginUser;
  if (scene_.facts().ventilator) PetscCall(follow_breaths(step));
  if (output_.fields_every() > 0 ? schedule_.due(step.row.time) : start || step.phase_ends)
    PetscCall(snapshot(step.row.time, step.local));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A breath starts from the last row before it: that is where the phase before it ends.
PetscErrorCode FieldWriter::follow_breaths(const StepReport &step)
{
  PetscFunctionBeginUser;
  if (!breath_start_) {
    PetscCall(VecDuplicate(step.local, breath_start_.out()));
    PetscCall(VecDuplicate(step.local, phase_end_.out()));
    PetscCall(VecCopy(step.local, breath_start_));
    PetscCall(VecCopy(step.local, phase_end_));
  } else if (step.row.breath != breath_) {
    PetscCall(VecCopy(phase_end_, breath_start_));
  }
  breath_ = step.row.dt > 0 ? step.row.breath : 0;
  if (step.phase_ends) PetscCall(VecCopy(step.local, phase_end_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::persist(Archive &archive, Vec local)
{
  std::string names;

  PetscFunctionBeginUser;
  if (scene_.facts().ventilator) {
    if (!breath_start_) {
      PetscCall(VecDuplicate(local, breath_start_.out()));
      PetscCall(VecDuplicate(local, phase_end_.out()));
      PetscCall(VecCopy(local, breath_start_));
    }
    PetscCall(archive.local("breath_start", breath_start_));
    PetscCall(archive.value("fields/breath", breath_));
    if (archive.reading()) PetscCall(VecCopy(local, phase_end_)); // unless a phase ends here it does not count
  }
  for (const Snapshot &s : snapshots_) {
    names += s.file + " " + s.mesh + (s.error_indicator ? " " + error_indicator : "");
    for (const std::string &remembered : s.remembered) names += " " + remembered;
    names += "\n";
  }
  PetscCall(archive.text("fields/files", names));
  PetscCall(
      archive.table("fields/times_s", snapshots_, Snapshot(), [](Snapshot &s, TableCells &cells) { cells(s.time); }));
  PetscCall(archive.value("fields/count", count_));
  if (archive.reading()) {
    std::istringstream lines(names);
    for (Snapshot &s : snapshots_) {
      std::string line, more;
      std::getline(lines, line);
      std::istringstream words(line);
      words >> s.file >> s.mesh;
      s.error_indicator = false;
      while (words >> more) {
        if (more == error_indicator)
          s.error_indicator = true;
        else
          s.remembered.push_back(more);
      }
      const bool plain = s.file.rfind("fields", 0) == 0 && s.mesh.rfind("fields", 0) == 0 &&
                         (s.file + s.mesh).find('/') == std::string::npos;
      PetscCall(archive.check(plain, "fields/files"));
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<std::string> FieldWriter::files() const
{
  std::vector<std::string> list;
  for (const Snapshot &s : snapshots_) list.insert(list.end(), {s.file, s.mesh});
  return list;
}

PetscErrorCode FieldWriter::carry_over(const std::string &from)
{
  namespace fs = std::filesystem;
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  PetscMPIInt rank;
  std::vector<char> there(snapshots_.size(), 1);
  std::size_t k = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  for (std::size_t i = 0; rank == 0 && i < snapshots_.size(); ++i)
    for (const std::string &name : {snapshots_[i].file, snapshots_[i].mesh}) {
      const fs::path old = fs::path(from) / name, here = output_.path(name);
      std::error_code error;
      if (fs::exists(here, error)) continue;
      fs::create_hard_link(old, here, error); // a snapshot is never changed, only replaced
      if (error) fs::copy_file(old, here, error);
      if (error) there[i] = 0;
    }
  PetscCallMPI(MPI_Bcast(there.data(), static_cast<PetscMPIInt>(there.size()), MPI_CHAR, 0, comm));
  for (std::size_t i = 0; i < there.size(); ++i)
    if (there[i]) snapshots_[k++] = snapshots_[i];
  if (k < snapshots_.size())
    PetscCall(PetscPrintf(comm, "pulmo: warning: %d of %d earlier snapshots are not in %s: fields.xdmf lacks them\n",
                          static_cast<int>(snapshots_.size() - k), static_cast<int>(snapshots_.size()), from.c_str()));
  if (!snapshots_.empty()) schedule_.skip(snapshots_.back().time);
  snapshots_.resize(k);
  if (k == 0) PetscFunctionReturn(PETSC_SUCCESS);
  mesh_ = snapshot_name(count_, "_mesh"); // other ranks number nodes otherwise
  PetscCall(number_nodes());
  PetscCall(write_index());
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Nodes are vertices and edges; each rank numbers those it owns, then tells the others.
PetscErrorCode FieldWriter::number_nodes()
{
  const DM dm = model_.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt begin, end, first = 0, roots;
  PetscSF sf;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, &begin, &end));
  PetscCall(owned_points(dm, 2, nodes_));
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  const auto mine = static_cast<PetscInt>(nodes_.size());
  PetscCallMPI(MPI_Exscan(&mine, &first, 1, MPIU_INT, MPI_SUM, comm));
  PetscMPIInt rank;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) first = 0;
  PetscCallMPI(MPI_Allreduce(&mine, &n_nodes_, 1, MPIU_INT, MPI_SUM, comm));
  node_number_.assign(static_cast<std::size_t>(end), -1);
  for (PetscInt i = 0; i < mine; ++i) node_number_[nodes_[i]] = first + i;
  if (roots >= 0) {
    std::vector<PetscInt> owned = node_number_;
    PetscCall(PetscSFBcastBegin(sf, MPIU_INT, owned.data(), node_number_.data(), MPI_REPLACE));
    PetscCall(PetscSFBcastEnd(sf, MPIU_INT, owned.data(), node_number_.data(), MPI_REPLACE));
  }
  n_cells_ = scene_.mesh().cells();
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::write_mesh()
{
  const DM dm = model_.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt vertex_begin, vertex_end, cell_begin, cell_end, edge_begin, edge_end;
  std::vector<PetscScalar> geometry;
  std::vector<PetscInt> topology;
  ValueFile file(comm);

  PetscFunctionBeginUser;
  if (n_nodes_ < 0) PetscCall(number_nodes());
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  PetscCall(DMPlexGetDepthStratum(dm, 1, &edge_begin, &edge_end));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  for (PetscInt p : nodes_) {
    PetscReal x[3];
    PetscCall(scene_.mesh().node_coordinates(p, x));
    geometry.insert(geometry.end(), x, x + 3);
  }
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n;
    std::vector<PetscInt> corners;
    PetscCall(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i)
      if (closure[2 * i] >= vertex_begin && closure[2 * i] < vertex_end) corners.push_back(closure[2 * i]);
    PetscCall(DMPlexRestoreTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    std::swap(corners[0], corners[1]); // DMPlex counts the base the other way round than VTK
    for (PetscInt v : corners) topology.push_back(node_number_[v]);
    for (const auto &edge : edges) {
      const PetscInt ends[2] = {corners[edge[0]], corners[edge[1]]}, *join = nullptr;
      PetscInt n_join;
      PetscCall(DMPlexGetJoin(dm, 2, ends, &n_join, &join));
      PetscCheck(n_join == 1, PETSC_COMM_SELF, PETSC_ERR_PLIB, "two vertices of a cell do not share one edge");
      topology.push_back(node_number_[join[0]]);
      PetscCall(DMPlexRestoreJoin(dm, 2, ends, &n_join, &join));
    }
  }
  std::vector<PetscScalar> regions;
  PetscCall(region_numbers(regions));
  PetscCall(file.write("geometry", 3, geometry));
  PetscCall(file.write("topology", 10, topology));
  PetscCall(file.write(region_name, 1, regions));
  PetscCall(file.close(output_.path(mesh_)));
  mesh_written_ = true;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::region_numbers(std::vector<PetscScalar> &numbers) const
{
  std::vector<Mesh::Region> regions;

  PetscFunctionBeginUser;
  PetscCall(scene_.mesh().regions(regions));
  std::vector<PetscInt> size;
  for (const Mesh::Region &region : regions) size.push_back(static_cast<PetscInt>(region.cells.size()));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, size.data(), static_cast<PetscMPIInt>(size.size()), MPIU_INT, MPI_SUM,
                             PetscObjectComm((PetscObject)model_.dm())));
  std::vector<std::size_t> smallest(static_cast<std::size_t>(model_.assembly().cells()), regions.size());
  for (std::size_t r = 0; r < regions.size(); ++r)
    for (const PetscInt c : regions[r].cells)
      if (smallest[c] == regions.size() || size[r] < size[smallest[c]]) smallest[c] = r;
  numbers.clear();
  for (const std::size_t r : smallest) numbers.push_back(r < regions.size() ? static_cast<PetscScalar>(r + 1) : 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::snapshot(PetscReal time, Vec local)
{
  const DM dm = model_.dm();
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  const bool gas = scene_.facts().airflow;
  const Assembly &assembly = model_.assembly();
  const TissueLaw &law = scene_.tissue().law();
  std::vector<PetscScalar> u, p, J, least_J, ventilation, porosity, hydrostatic, von_mises;
  CellErrors errors;

  PetscFunctionBeginUser;
  if (!snapshots_.empty() && snapshots_.back().time == time) PetscFunctionReturn(PETSC_SUCCESS);
  if (!mesh_written_) PetscCall(write_mesh());
  const ReadArray x(local);
  for (PetscInt node : nodes_) {
    PetscCall(append_at(dm, node, displacement, x.data(), u));
    if (gas) PetscCall(append_at(dm, node, pressure, x.data(), p));
  }
  for (PetscScalar &value : p) value /= units::kPa_per_cmH2O;
  // cell means over the quadrature points; least J also at the corners, as in the signals
  std::vector<PointState> states;
  const auto &weights = assembly.relative_weights();
  const PointMemory::Room *room = model_.memory() ? model_.memory()->room() : nullptr;
  for (PetscInt c = 0; c < assembly.cells(); ++c) {
    const PetscScalar *constants = model_.constants_at(c);
    assembly.point_states(c, x.data(), states);
    PetscScalar mean_J = 0, mean_h = 0, mean_m = 0;
    for (std::size_t q = 0; q < weights.size(); ++q) {
      const PointState &s = states[q];
      PetscScalar P[9], sigma[9];
      law.stress(s, constants, room ? room->accepted(c, static_cast<PetscInt>(q)) : Memory(), P);
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) // Cauchy: P F^T / J
          sigma[3 * i + j] =
              (P[3 * i] * s.F[3 * j] + P[3 * i + 1] * s.F[3 * j + 1] + P[3 * i + 2] * s.F[3 * j + 2]) / s.J;
      const PetscScalar h = (sigma[0] + sigma[4] + sigma[8]) / 3;
      PetscScalar deviator[9];
      for (int i = 0; i < 9; ++i) deviator[i] = sigma[i] - (i % 4 == 0 ? h : 0);
      mean_J += weights[q] * s.J;
      mean_h += weights[q] * h;
      mean_m += weights[q] * std::sqrt(1.5 * contract(deviator, deviator));
    }
    J.push_back(mean_J);
    least_J.push_back(
        std::min_element(states.begin(), states.end(), [](const auto &a, const auto &b) { return a.J < b.J; })->J);
    hydrostatic.push_back(mean_h);
    von_mises.push_back(mean_m);
    if (gas) porosity.push_back(constants::get<Porosity>(constants).at(mean_J));
  }
  if (breath_start_) {
    const ReadArray start(breath_start_);
    for (PetscInt c = 0; c < assembly.cells(); ++c) {
      PetscScalar mean = 0;
      assembly.point_states(c, start.data(), states);
      for (std::size_t q = 0; q < weights.size(); ++q) mean += weights[q] * states[q].J;
      ventilation.push_back(J[c] - mean);
    }
  }
  if (output_.error_indicator()) {
    if (!indicator_) {
      indicator_ = std::make_unique<ErrorIndicator>(scene_, model_);
      PetscCall(indicator_->setup());
    }
    PetscCall(indicator_->estimate(local, errors));
  }
  const std::string name = snapshot_name(count_);
  ValueFile file(comm);
  PetscCall(file.write(displacement_name, 3, u));
  PetscCall(file.write(mean_J_name, 1, J));
  PetscCall(file.write(least_J_name, 1, least_J));
  PetscCall(file.write(hydrostatic_name, 1, hydrostatic));
  PetscCall(file.write(von_mises_name, 1, von_mises));
  if (breath_start_) PetscCall(file.write(ventilation_name, 1, ventilation));
  if (gas) {
    PetscCall(file.write(pressure_name, 1, p));
    PetscCall(file.write(porosity_name, 1, porosity));
  }
  if (output_.error_indicator()) {
    PetscMPIInt rank;
    std::vector<PetscScalar> whole;
    PetscCallMPI(MPI_Comm_rank(comm, &rank));
    if (rank == 0) whole = {errors.stress, errors.dissipation};
    PetscCall(file.write(tissue_error_name, 1, errors.tissue));
    if (gas) PetscCall(file.write(flow_error_name, 1, errors.flow));
    PetscCall(file.write(whole_error_name, 1, whole));
  }
  std::vector<std::string> remembered;
  for (const Remembered &r : remembered_) {
    std::vector<PetscScalar> means;
    model_.memory()->means(*r.spec, r.index, means);
    PetscCall(file.write(r.name, 1, means));
    remembered.push_back(r.name);
  }
  PetscCall(file.close(output_.path(name)));
  ++count_;
  snapshots_.push_back({time, name, mesh_, output_.error_indicator(), remembered});
  PetscCall(write_index());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::write_index() const
{
  Xdmf f(n_cells_, n_nodes_);

  PetscFunctionBeginUser;
  f.text << "<Grid Name=\"lung\" GridType=\"Collection\" CollectionType=\"Temporal\">\n";
  for (const Snapshot &s : snapshots_) {
    f.begin("step", s.mesh, s.time);
    f.at_nodes(displacement_name, 3, s.file);
    for (const char *name : {mean_J_name, least_J_name, hydrostatic_name, von_mises_name}) f.of_cells(name, s.file);
    f.of_cells(region_name, s.mesh);
    if (scene_.facts().ventilator) f.of_cells(ventilation_name, s.file);
    if (scene_.facts().airflow) {
      f.at_nodes(pressure_name, 1, s.file);
      f.of_cells(porosity_name, s.file);
    }
    if (s.error_indicator) f.of_cells(tissue_error_name, s.file);
    if (s.error_indicator && scene_.facts().airflow) f.of_cells(flow_error_name, s.file);
    for (const std::string &name : s.remembered) f.of_cells(name, s.file);
    f.end();
  }
  f.text << "</Grid>\n";
  PetscCall(f.write(PetscObjectComm((PetscObject)model_.dm()), output_.path("fields.xdmf")));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode FieldWriter::write_cells(const std::string &name,
                                        const std::vector<std::pair<std::string, std::vector<PetscReal>>> &values)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  ValueFile file(comm);
  std::set<std::string> taken;

  PetscFunctionBeginUser;
  if (!mesh_written_) PetscCall(write_mesh());
  Xdmf f(n_cells_, n_nodes_);
  f.begin(name, mesh_, {});
  for (const auto &[given, cells] : values) {
    std::string field = given; // a region's name may hold what a path in the file may not
    std::replace_if(
        field.begin(), field.end(), [](char c) { return c == '/' || c == ':'; }, '_');
    field = another_name(field, taken); // "a/b" and "a_b"
    PetscCall(file.write(field, 1, cells));
    f.of_cells(field, name + ".h5");
  }
  f.end();
  PetscCall(file.close(output_.path(name + ".h5")));
  PetscCall(f.write(comm, output_.path(name + ".xdmf")));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
