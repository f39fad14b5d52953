/// @file
/// Text files that an option names, on all ranks.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <string>

namespace pulmo {

/// Reads @p file on rank 0 for all ranks. User error that names @p option where it cannot be read or is larger than
/// @p most bytes, and so no @p what. Collective.
PetscErrorCode read_user_file(MPI_Comm comm, const std::string &option, const std::string &file, std::size_t most,
                              const std::string &what, std::string &text);

} // namespace pulmo
