#include "pulmo/fem/archive.hpp"

#include "pulmo/base/hdf5_image.hpp"

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <sstream>

namespace pulmo {

namespace {

/// Marks a file of pulmo, and tells how to read it. Raise it when a name or a meaning changes.
constexpr const char *marker = "pulmo_checkpoint";
// 2: the names of the mesh, the step sizes of phases; 3: what the solver left of its equations; 4: when the
// breath at hand is to end; 5: the secants of the first guess
constexpr int format = 5;

/// @p data is resized to what is there; @p type as in memory.
template <class T>
bool read_dataset(hid_t file, const std::string &name, hid_t type, std::vector<hsize_t> &shape, std::vector<T> &data)
{
  const Hdf5Id set(H5Dopen2(file, name.c_str(), H5P_DEFAULT), H5Dclose);
  if (set < 0) return false;
  const Hdf5Id space(H5Dget_space(set), H5Sclose), stored(H5Dget_type(set), H5Tclose);
  const int rank = H5Sget_simple_extent_ndims(space);
  if (rank < 1 || H5Tget_class(stored) != H5Tget_class(type)) return false;
  shape.resize(static_cast<std::size_t>(rank));
  const hssize_t n = H5Sget_simple_extent_npoints(space);
  if (n < 0 || H5Sget_simple_extent_dims(space, shape.data(), nullptr) < 0) return false;
  // a damaged header must not ask for all memory there is
  if (n > 0 && H5Dget_storage_size(set) < static_cast<hsize_t>(n) * H5Tget_size(stored)) return false;
  data.resize(static_cast<std::size_t>(n));
  return H5Dread(set, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, data.data()) >= 0;
}

/// With checksums: a damaged disk is found out when it is read.
bool write_dataset(hid_t file, const std::string &name, hid_t type, const std::vector<hsize_t> &shape, const void *data)
{
  return write_hdf5(file, name, type, shape, data, true);
}

bool write_text(hid_t file, const std::string &name, const std::string &text)
{
  return write_dataset(file, name, H5T_NATIVE_UCHAR, {text.size()}, text.data());
}

bool read_text(hid_t file, const std::string &name, std::string &text)
{
  std::vector<hsize_t> shape;
  std::vector<unsigned char> data;
  if (!read_dataset(file, name, H5T_NATIVE_UCHAR, shape, data)) return false;
  text.assign(data.begin(), data.end());
  return true;
}

/// What to do about a file that cannot be used, which @p option named.
std::string instead(const std::string &option, const char *otherwise)
{
  return option == "-replay" ? "run the scene again" : otherwise;
}

constexpr const char *take_another = "take another checkpoint (checkpoint_previous.h5)";
constexpr const char *give_one = "give a checkpoint.h5 that pulmo wrote";

/// Opens a file for reading, which @p option named. @p complaint: what is wrong with it and how to fix it.
hid_t open_file(const std::string &option, const std::string &name, std::string &complaint)
{
  std::error_code error;
  int found = -1;

  if (!std::filesystem::is_regular_file(name, error)) {
    complaint = "there is no such file; check its name";
    return -1;
  }
  std::FILE *f = std::fopen(name.c_str(), "rb");
  if (!f) {
    complaint = "the file cannot be read; check its permissions";
    return -1;
  }
  std::fclose(f);
  if (H5Fis_hdf5(name.c_str()) <= 0) {
    complaint = "this is no HDF5 file; " + instead(option, give_one);
    return -1;
  }
  hid_t file = H5Fopen(name.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT);
  if (file < 0) {
    complaint = "the file is truncated or damaged; " + instead(option, take_another);
    return -1;
  }
  {
    const Hdf5Id mark(H5Aopen(file, marker, H5P_DEFAULT), H5Aclose);
    if (mark < 0)
      complaint = "this HDF5 file is no checkpoint of pulmo; " + instead(option, give_one);
    else if (H5Aread(mark, H5T_NATIVE_INT, &found) < 0 || found != format)
      complaint = "the checkpoint has format " + std::to_string(found) + ", this pulmo reads format " +
                  std::to_string(format) + "; go on with the pulmo that wrote it";
  }
  if (!complaint.empty()) {
    H5Fclose(file);
    file = -1;
  }
  return file;
}

} // namespace

Archive::Archive(const Model &model, const NodeOrder &order, bool reading)
    : model_(model), order_(order), comm_(PetscObjectComm((PetscObject)model.dm())), reading_(reading)
{
  PetscMPIInt rank = 0;
  (void)MPI_Comm_rank(comm_, &rank);
  root_ = rank == 0;
}

Archive::~Archive()
{
  const QuietHdf5 quiet;
  if (file_ >= 0) H5Fclose(file_);
}

PetscErrorCode Archive::create(const Model &model, const NodeOrder &order, std::unique_ptr<Archive> &archive)
{
  PetscFunctionBeginUser;
  archive.reset(new Archive(model, order, false));
  if (archive->root_) {
    const Hdf5Id space(H5Screate(H5S_SCALAR), H5Sclose);
    archive->file_ = create_hdf5_image();
    const Hdf5Id mark(H5Acreate2(archive->file_, marker, H5T_NATIVE_INT, space, H5P_DEFAULT, H5P_DEFAULT), H5Aclose);
    archive->good_ = archive->file_ >= 0 && mark >= 0 && H5Awrite(mark, H5T_NATIVE_INT, &format) >= 0;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::open(const Model &model, const NodeOrder &order, const std::string &option,
                             const std::string &file, std::unique_ptr<Archive> &archive)
{
  std::string complaint, names;
  std::vector<double> values;
  std::size_t n = 0;

  PetscFunctionBeginUser;
  archive.reset(new Archive(model, order, true));
  archive->option_ = option;
  archive->path_ = file;
  if (archive->root_) {
    const QuietHdf5 quiet;
    archive->file_ = open_file(option, file, complaint);
  }
  PetscCall(from_root(archive->comm_, complaint));
  PulmoUserCheck(complaint.empty(), archive->comm_, "%s %s: %s", option.c_str(), file.c_str(), complaint.c_str());
  PetscCall(archive->text("scalar_names", names));
  PetscCall(archive->numbers("scalars", n, values));
  std::istringstream lines(names);
  for (std::string name; std::getline(lines, name) && archive->scalars_.size() < values.size();)
    archive->scalars_.emplace(name, values[archive->scalars_.size()]);
  PetscCall(archive->check(archive->scalars_.size() == values.size(), "scalars"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::finish(std::vector<char> &image)
{
  std::string names;
  std::vector<double> values;
  std::size_t n;

  PetscFunctionBeginUser;
  for (const auto &[name, number] : scalars_) {
    names += name + "\n";
    values.push_back(number);
  }
  n = values.size();
  PetscCall(text("scalar_names", names));
  PetscCall(numbers("scalars", n, values));
  if (root_ && good_) good_ = take_hdf5_image(file_, image);
  PetscCall(from_root(comm_, good_));
  PetscCheck(good_, comm_, PETSC_ERR_LIB, "HDF5 failed to make a file in memory");
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::check(bool good, const std::string &name) const
{
  PetscFunctionBeginUser;
  PulmoUserCheck(good, comm_, "%s %s: '%s' is damaged or missing in the file; %s", option_.c_str(), path_.c_str(),
                 name.c_str(), instead(option_, take_another).c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::check_root(bool good, const std::string &name) const
{
  PetscFunctionBeginUser;
  PetscCall(from_root(comm_, good));
  PetscCall(check(good, name));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::scalar(const std::string &name, double &number)
{
  PetscFunctionBeginUser;
  if (reading_) {
    const auto found = scalars_.find(name);
    PetscCall(check(found != scalars_.end(), name));
    number = found->second;
  } else {
    const bool is_new = scalars_.emplace(name, number).second;
    PetscCheck(is_new, comm_, PETSC_ERR_PLIB, "two numbers of the checkpoint are called %s", name.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::text(const std::string &name, std::string &text)
{
  PetscFunctionBeginUser;
  if (!reading_) {
    if (root_) good_ = good_ && write_text(file_, name, text);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  bool good = true;
  if (root_) {
    const QuietHdf5 quiet;
    good = read_text(file_, name, text);
  }
  PetscCall(check_root(good, name));
  PetscCall(from_root(comm_, text));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::numbers(const std::string &name, std::size_t &n, std::vector<double> &values)
{
  PetscFunctionBeginUser;
  if (!reading_) {
    if (root_)
      good_ = good_ && write_dataset(file_, name, H5T_NATIVE_DOUBLE, {n, n > 0 ? values.size() / n : 0}, values.data());
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  bool good = true;
  std::uint64_t sizes[2] = {0, 0};
  if (root_) {
    const QuietHdf5 quiet;
    std::vector<hsize_t> shape;
    good = read_dataset(file_, name, H5T_NATIVE_DOUBLE, shape, values) && shape.size() == 2;
    if (good) {
      sizes[0] = shape[0];
      sizes[1] = values.size();
    }
  }
  PetscCall(check_root(good, name));
  PetscCallMPI(MPI_Bcast(sizes, 2, MPI_UINT64_T, 0, comm_));
  n = sizes[0];
  values.resize(sizes[1]);
  PetscCallMPI(MPI_Bcast(values.data(), static_cast<PetscMPIInt>(values.size()), MPI_DOUBLE, 0, comm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::rows_on_root(const std::string &name, std::size_t width, std::vector<double> &values)
{
  bool good = true;

  PetscFunctionBeginUser;
  if (!reading_) {
    if (root_)
      good_ = good_ && write_dataset(file_, name, H5T_NATIVE_DOUBLE, {values.size() / width, width}, values.data());
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (root_) {
    const QuietHdf5 quiet;
    std::vector<hsize_t> shape;
    good = read_dataset(file_, name, H5T_NATIVE_DOUBLE, shape, values) && shape.size() == 2 && shape[1] == width;
  }
  PetscCall(check_root(good, name));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::local(const std::string &name, Vec x)
{
  const auto &fields = model_.composition().fields();

  PetscFunctionBeginUser;
  for (std::size_t f = 0; f < fields.size(); ++f) {
    const auto field = static_cast<PetscInt>(f);
    const std::string dataset = name + "/" + fields[f].name;
    std::vector<double> values;
    bool good;
    if (!reading_) PetscCall(order_.gather(field, x, values));
    PetscCall(rows_on_root(dataset, static_cast<std::size_t>(fields[f].components), values));
    if (!reading_) continue;
    PetscCall(order_.scatter(field, values, x, good));
    PetscCall(check(good, dataset));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::cells(const std::string &name, std::size_t width, std::vector<double> &values)
{
  PetscFunctionBeginUser;
  if (!cell_order_.ready()) PetscCall(cell_order_.setup(model_.dm()));
  PetscCall(ordered(name, cell_order_, width, values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::facets(const std::string &name, const std::string &surface, const std::vector<PetscInt> &facets,
                               std::size_t width, std::vector<double> &values)
{
  PetscFunctionBeginUser;
  CellOrder &order = facet_orders_[surface];
  if (!order.ready()) PetscCall(order.setup(model_.dm(), facets));
  PetscCall(ordered(name, order, width, values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::ordered(const std::string &name, const CellOrder &order, std::size_t width,
                                std::vector<double> &values)
{
  std::vector<double> all;
  bool good;

  PetscFunctionBeginUser;
  if (!reading_) PetscCall(order.gather(width, values, all));
  PetscCall(rows_on_root(name, width, all));
  if (!reading_) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(order.scatter(width, all, values, good));
  PetscCall(check(good, name));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Archive::global(const std::string &name, Vec X)
{
  const DM dm = model_.dm();
  Vec x;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalVector(dm, &x));
  PetscCall(VecZeroEntries(x));
  if (!reading_) PetscCall(DMGlobalToLocal(dm, X, INSERT_VALUES, x));
  PetscCall(local(name, x));
  if (reading_) {
    PetscCall(VecZeroEntries(X));
    PetscCall(DMLocalToGlobal(dm, x, INSERT_VALUES, X));
  }
  if (model_.composition().common_gas_pressure() || model_.composition().n_scalars() > 0) { // they have no node
    std::vector<PetscReal> scalars;
    if (!reading_) PetscCall(model_.airway().scalars(X, scalars));
    PetscCall(table(name + "/scalars", scalars, PetscReal(0), [](PetscReal &row, TableCells &cells) { cells(row); }));
    PetscCall(check(scalars.size() == 1 + model_.composition().n_scalars(), name + "/scalars"));
    if (reading_) PetscCall(model_.airway().set_scalars(X, scalars));
  }
  PetscCall(DMRestoreLocalVector(dm, &x));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
