/// @file
/// What watches a run: told of each accepted step, it reads and never steers.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/fem/assembly.hpp"
#include "pulmo/physics/signal_row.hpp"

#include <vector>

namespace pulmo {

/// What an observer sees after each accepted step (and once at the start).
struct StepReport {
  const std::vector<SignalRow> &rows; ///< of the whole run so far, this one last
  SignalRow row;
  Measures measures;
  PetscReal mass_balance_error; ///< int (J - 1) less what flowed in, by the time scheme, mm^3
  Vec local;                    ///< state with constrained values in place
  Vec residual;                 ///< local, rows scaled; not of the row at the start
  PetscReal end;                ///< when the run ends, s
  PetscReal breath_end;         ///< when the breath at hand is to end as things are now, s
  bool phase_ends;              ///< this row is the last of its phase
  bool end_cuts_next;           ///< the next step would be another one if the run did not end at -ts_max_time
};

/// Watches a run and never steers it.
class Observer {
public:
  virtual ~Observer() = default;
  virtual PetscErrorCode observe(const StepReport &) = 0;
  /// Writes or reads what it remembers of the run so far. @p local: the state of the last row, as in StepReport.
  virtual PetscErrorCode persist(Archive &, [[maybe_unused]] Vec local) { return PETSC_SUCCESS; }
};

} // namespace pulmo
