/// @file
/// How clinical numbers follow the parameters of a scene, as it is told.
#pragma once

#include <string>
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
    double value = 0;
    std::vector<double> derivative; ///< [number], in its unit per that of the parameter
  };

  std::vector<Number> numbers;
  std::vector<Parameter> parameters;
  std::vector<std::string> undefined; ///< names of numbers asked for that the run does not define
  std::string failure;                ///< why there is no result; empty if there is one
  double seconds = 0;                 ///< wall, of the sweep
  int solves = 0, krylov = 0;

  /// By how many percent number @p k changes where parameter @p p grows by one.
  double percent(const Parameter &p, std::size_t k) const
  {
    return numbers[k].value != 0 ? p.derivative[k] * p.value / numbers[k].value : 0;
  }
};

} // namespace pulmo
