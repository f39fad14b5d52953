/// @file
/// HDF5 files made in memory: what can go wrong with a disk is then found out in one place (pulmo/base/whole_file.hpp).
#pragma once

#include <hdf5.h>
#include <string>
#include <vector>

namespace pulmo {

/// HDF5 says nothing while this lives; pulmo does.
class QuietHdf5 {
public:
  QuietHdf5()
  {
    H5Eget_auto2(H5E_DEFAULT, &print_, &data_);
    H5Eset_auto2(H5E_DEFAULT, nullptr, nullptr);
  }
  ~QuietHdf5() { H5Eset_auto2(H5E_DEFAULT, print_, data_); }
  QuietHdf5(const QuietHdf5 &) = delete;
  QuietHdf5 &operator=(const QuietHdf5 &) = delete;

private:
  H5E_auto2_t print_ = nullptr;
  void *data_ = nullptr;
};

/// An HDF5 handle that is closed at the end of its life.
class Hdf5Id {
public:
  Hdf5Id(hid_t id, herr_t (*close)(hid_t)) : id_(id), close_(close) {}
  ~Hdf5Id()
  {
    if (id_ >= 0) close_(id_);
  }
  Hdf5Id(const Hdf5Id &) = delete;
  Hdf5Id &operator=(const Hdf5Id &) = delete;
  operator hid_t() const { return id_; }

private:
  hid_t id_;
  herr_t (*close_)(hid_t);
};

/// An empty file in memory; negative if there is none.
hid_t create_hdf5_image();

/// Writes @p data of @p type as a new dataset, with checksums if @p checked. Whether it worked.
bool write_hdf5(hid_t file, const std::string &name, hid_t type, const std::vector<hsize_t> &shape, const void *data,
                bool checked);

/// The bytes of a file in memory. Whether it worked.
bool take_hdf5_image(hid_t file, std::vector<char> &image);

} // namespace pulmo
