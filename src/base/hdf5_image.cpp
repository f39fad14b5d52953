#include "pulmo/base/hdf5_image.hpp"

#include <algorithm>

namespace pulmo {

namespace {

/// Entries of a dataset that have one checksum.
constexpr hsize_t chunk_rows = 1 << 16;

/// By so many bytes a file in memory grows.
constexpr std::size_t growth = 1 << 20;

} // namespace

hid_t create_hdf5_image()
{
  const Hdf5Id access(H5Pcreate(H5P_FILE_ACCESS), H5Pclose);
  return H5Pset_fapl_core(access, growth, 0) < 0 ? -1 : H5Fcreate("image", H5F_ACC_TRUNC, H5P_DEFAULT, access);
}

bool write_hdf5(hid_t file, const std::string &name, hid_t type, const std::vector<hsize_t> &shape, const void *data,
                bool checked)
{
  const Hdf5Id space(H5Screate_simple(static_cast<int>(shape.size()), shape.data(), nullptr), H5Sclose);
  const Hdf5Id making(H5Pcreate(H5P_DATASET_CREATE), H5Pclose), linking(H5Pcreate(H5P_LINK_CREATE), H5Pclose);
  bool good = H5Pset_create_intermediate_group(linking, 1) >= 0;
  if (checked && std::find(shape.begin(), shape.end(), 0) == shape.end()) {
    std::vector<hsize_t> chunk = shape;
    chunk[0] = std::min(chunk[0], chunk_rows);
    good = good && H5Pset_chunk(making, static_cast<int>(chunk.size()), chunk.data()) >= 0 &&
           H5Pset_fletcher32(making) >= 0;
  }
  const Hdf5Id set(H5Dcreate2(file, name.c_str(), type, space, linking, making, H5P_DEFAULT), H5Dclose);
  return good && set >= 0 && H5Dwrite(set, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, data) >= 0;
}

bool take_hdf5_image(hid_t file, std::vector<char> &image)
{
  if (H5Fflush(file, H5F_SCOPE_GLOBAL) < 0) return false;
  const auto size = H5Fget_file_image(file, nullptr, 0);
  if (size <= 0) return false;
  image.resize(static_cast<std::size_t>(size));
  return H5Fget_file_image(file, image.data(), image.size()) == size;
}

} // namespace pulmo
