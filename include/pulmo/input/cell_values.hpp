/// @file
/// One number for each cell of a mesh file, from an HDF5 file.
#pragma once

#include <string>
#include <vector>

namespace pulmo {

/// Reads dataset @p name of one dimension on the calling rank. Returns what is wrong with it, as the words that follow
/// "FILE:dataset" in a sentence that says how to fix it; empty if nothing is.
std::string read_cell_values(const std::string &file, const std::string &name, std::vector<double> &values);

} // namespace pulmo
