/// @file
/// What each effect of a scene adds to the equations, and the seconds that its terms took (`-effects_view`).
#pragma once

#include "pulmo/time/simulation.hpp"

#include <string>
#include <vector>

namespace pulmo {

struct LedgerEntry {
  std::string effect;
  std::vector<std::string> fields; ///< of its own, e.g. "pressure P1"
  std::vector<std::string> terms;  ///< what it adds: terms with their rows or blocks, what it prescribes and remembers
  std::size_t bytes = 0;           ///< that it remembers on this rank
  double seconds = 0;              ///< in its terms on this rank, estimated from the blocks of cells that are timed
};

/// The active effects in their order.
std::vector<LedgerEntry> ledger(const Scene &scene, const Model &model);

/// Prints it, with the stages of the run that took @p seconds.
PetscErrorCode print_ledger(MPI_Comm comm, const Scene &scene, const Model &model, const StageSeconds &seconds);

} // namespace pulmo
