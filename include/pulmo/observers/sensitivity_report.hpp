/// @file
/// How clinical numbers follow the parameters of a scene, as it is told.
#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace pulmo {

/// What `-sensitivities` found (pulmo/adjoint/sensitivities.hpp).
struct SensitivityReport {
  /// A clinical number.
  struct Number {
    std::string key, name, unit; ///< key: in summary.json; name: short
    double value = 0;
  };
  /// A parameter, and the derivatives of the numbers by it.
  struct Parameter {
    std::string option, unit;
    double value = 0;               ///< where parts of the lung have values of their own: that of all others
    bool varies = false;            ///< parts of the lung have values of their own
    std::vector<double> derivative; ///< [number], in its unit per that of the parameter, if it changes alike everywhere
    std::vector<std::pair<std::string, std::vector<double>>> by_region; ///< the same if it changes in that region alone
    std::vector<std::vector<double>>
        by_cell; ///< [number][cell of this rank]: in that cell alone; empty: no cell reads it
  };

  /// A parameter without derivatives.
  struct LeftOut {
    std::string option, why; ///< why: a sentence without its full stop
    bool zero = false;
  };

  std::vector<Number> numbers;
  std::vector<Parameter> parameters;
  std::vector<LeftOut> left_out;
  std::vector<std::string> undefined; ///< names of numbers asked for that the run does not define
  std::string failure;                ///< why there is no result; empty if there is one
  double seconds = 0;                 ///< wall, of the sweep
  int solves = 0, krylov = 0;

  /// By how many percent number @p k changes where parameter @p p grows by one; empty if it is zero, or if parts of the
  /// lung have values of their own: of one value in many one percent says nothing.
  std::optional<double> percent(const Parameter &p, std::size_t k) const
  {
    if (p.varies || numbers[k].value == 0) return {};
    return p.derivative[k] * p.value / numbers[k].value;
  }
};

} // namespace pulmo
