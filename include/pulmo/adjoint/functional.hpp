/// @file
/// Clinical numbers as functions of the signals, with their derivatives: where a backward sweep begins.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/physics/signal_row.hpp"

#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// A clinical number of a run (docs/clinical.md) and its derivative by each row of the signals. A largest value is that
/// of the row that has it now.
struct Functional {
  std::string key, name, unit; ///< key: in summary.json; name: short
  double value = 0;
  /// [row], in the number's unit per ml, per cmH2O of the pressure at the machine, and per ml/s.
  std::vector<double> by_volume, by_pressure, by_flow;
};

/// Short names of the numbers that have derivatives.
std::vector<std::string> functional_names();

/// The number with the short name @p name of a run with these signals, as overall_numbers() has it; empty if the run
/// does not define it.
std::optional<Functional> functional(const std::string &name, const std::vector<SignalRow> &rows);

} // namespace pulmo
