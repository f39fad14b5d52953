/// @file
/// Files that are whole or not there.
#pragma once

#include <string>
#include <vector>

namespace pulmo {

/// Writes @p image to @p file, and with @p sync waits until it is on the disk. What could not be written whole is
/// removed. 0, or the error (errno).
int write_image(const std::string &file, const std::vector<char> &image, bool sync);

/// The same under a temporary name first: what has the name @p file is whole at any moment.
int write_whole(const std::string &file, const std::vector<char> &image);

} // namespace pulmo
