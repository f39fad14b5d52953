#include "pulmo/input/cell_values.hpp"

#include "pulmo/base/hdf5_image.hpp"

#include <filesystem>

namespace pulmo {

namespace {

/// The datasets at the top of a file, for a message.
std::string listed(hid_t file)
{
  std::string list;
  const auto note = [](hid_t group, const char *name, const H5L_info_t *, void *data) -> herr_t {
    auto &text = *static_cast<std::string *>(data);
    const Hdf5Id object(H5Oopen(group, name, H5P_DEFAULT), H5Oclose);
    if (object >= 0 && H5Iget_type(object) == H5I_DATASET) text += (text.empty() ? "" : ", ") + std::string(name);
    return 0;
  };
  H5Literate(file, H5_INDEX_NAME, H5_ITER_NATIVE, nullptr, note, &list);
  return list;
}

} // namespace

std::string read_cell_values(const std::string &file, const std::string &name, std::vector<double> &values)
{
  const QuietHdf5 quiet;
  std::error_code ignored;

  if (!std::filesystem::exists(file, ignored)) return ": there is no such file; give FILE.h5:dataset";
  if (H5Fis_hdf5(file.c_str()) <= 0) return ": the file is not HDF5; give FILE.h5:dataset";
  const Hdf5Id opened(H5Fopen(file.c_str(), H5F_ACC_RDONLY, H5P_DEFAULT), H5Fclose);
  if (opened < 0) return ": the file cannot be read; is another program writing it?";
  const Hdf5Id set(H5Dopen2(opened, name.c_str(), H5P_DEFAULT), H5Dclose);
  if (set < 0) {
    const std::string list = listed(opened);
    return ": the file has no such dataset; " + (list.empty() ? "it has none at its top" : "it has " + list);
  }
  const Hdf5Id space(H5Dget_space(set), H5Sclose), type(H5Dget_type(set), H5Tclose);
  const H5T_class_t kind = H5Tget_class(type);
  if (kind != H5T_FLOAT && kind != H5T_INTEGER) return ": the dataset holds no numbers";
  if (H5Sget_simple_extent_ndims(space) != 1)
    return ": the dataset has " + std::to_string(H5Sget_simple_extent_ndims(space)) +
           " dimensions; give one number for each tetrahedron, in one dimension";
  const hssize_t n = H5Sget_simple_extent_npoints(space);
  if (n <= 0) return ": the dataset is empty";
  // announced, never written
  if (H5Dget_storage_size(set) == 0) return ": the dataset holds no values";
  values.resize(static_cast<std::size_t>(n));
  if (H5Dread(set, H5T_NATIVE_DOUBLE, H5S_ALL, H5S_ALL, H5P_DEFAULT, values.data()) < 0)
    return ": the dataset cannot be read; write it anew";
  return "";
}

} // namespace pulmo
