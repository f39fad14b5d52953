/// @file
/// What the program says when it is called with nothing at all: how it is called, and one example that runs as it
/// stands.
#pragma once

#include <string>

namespace pulmo {

/// @p called: the program's name as it was called.
std::string usage(const std::string &called);

} // namespace pulmo
