/// @file
/// Clinical numbers as functions of the signals, with their derivatives: where a backward sweep begins.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/signal_row.hpp"

#include <optional>
#include <string>
#include <vector>

namespace pulmo {

class RegionAudit;

/// A clinical number of a run (docs/clinical.md) and its derivative by each row of the signals. A largest value is that
/// of the row that has it now.
struct Functional {
  std::string key, name, unit; ///< key: in summary.json; name: short
  double value = 0;
  /// What more rows on the same curves would make of it: sums extrapolated from those over every other row, and largest
  /// values by a parabola through three rows.
  double better_value = 0;
  /// False: the largest value is that of the first step of its phase, and may have no limit as steps get shorter; or a
  /// fit has rows whose flow goes the wrong way after a jump of pressure.
  bool resolved = true;
  /// Its volumes and pressures count from those with which the first breath begins, whatever breath it is of.
  bool from_rest = false;
  /// [row], in the number's unit per ml, per cmH2O of the pressure at the machine, and per ml/s.
  std::vector<double> by_volume, by_pressure, by_flow;
  /// A part of the lung.
  struct Part {
    std::string region;
    std::vector<double> volume; ///< [row], ml
  };
  std::optional<Part> part; ///< whose volume by_volume is about; empty: the whole lung
};

/// Short names of the numbers that have derivatives; and the same as a list for a reader.
std::vector<std::string> functional_names();
std::string functional_list();
/// Refuses a name among @p names, the value of @p option, that is none of these, or of a part that @p mesh has not.
PetscErrorCode check_functional_names(const Mesh &mesh, const char *option, const std::vector<std::string> &names);

/// The number with the short name @p name of a run with these signals, as overall_numbers() has it; empty if the run
/// does not define it. @p kinks: times within phases at which curves may have one, s. @p regions: for numbers of parts.
std::optional<Functional> functional(const std::string &name, const std::vector<SignalRow> &rows,
                                     const std::vector<double> &kinks = {}, const RegionAudit *regions = nullptr);

} // namespace pulmo
