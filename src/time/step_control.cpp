#include "pulmo/time/step_control.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

namespace pulmo {

namespace {

/// Values that the estimates look back on, at most.
constexpr std::size_t memory = 3;

/// Share of the step that would just meet the tolerance.
constexpr double safety = 0.9;

} // namespace

PetscErrorCode StepControl::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("step",
                "steps chosen by their error in time; -ts_dt is then the size of the first steps of a phase and "
                "-ts_adapt_dt_max the largest");
  PetscCall(options.real("volume_tolerance", "ml", Range::not_negative(),
                         "error in the volume that a step may make (0: the volume does not choose steps)",
                         volume_tolerance_));
  PetscCall(options.real("pressure_tolerance", "cmH2O", Range::not_negative(),
                         "error in the airway pressure that a step may make (0: the pressure does not choose steps)",
                         pressure_tolerance_));
  PetscCall(options.real("J_change", "-", Range::not_negative(),
                         "largest |ln(J / J before the step)| of any quadrature point in a step; one with more is cut, "
                         "and those after it stay short enough (0: no bound)",
                         bounds_[0].most));
  PetscCall(options.real("p_change", "cmH2O", Range::not_negative(),
                         "largest change of the alveolar pressure p at any node in a step (with -airflow off: of the "
                         "gas pressure); one with more is cut, and those after it stay short enough (0: no bound)",
                         bounds_[1].most));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode StepControl::persist(Archive &archive)
{
  PetscFunctionBeginUser;
  PetscCall(archive.table("step_control", past_, Value(),
                          [](Value &v, TableCells &cells) { cells(v.time, v.volume, v.pressure); }));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void StepControl::accept(const Value &value)
{
  past_.insert(past_.begin(), value);
  past_.resize(std::min(past_.size(), memory));
}

std::optional<double> StepControl::error(int order, const Value &value, Free free) const
{
  const auto n = static_cast<std::size_t>(order) + 1; // past values that the divided difference takes
  if (past_.size() < n) return {};
  const double dt = value.time - past_[0].time, before = past_[0].time - past_[1].time, w = dt / before;
  const double factor = order == 1 ? dt * dt : (1 + w) * (1 + w) / (w * (1 + 2 * w)) * dt * dt * dt;
  const auto share = [&](double Value::*what, double tolerance) {
    std::vector<double> t{value.time}, difference{value.*what};
    for (std::size_t i = 0; i < n; ++i) {
      t.push_back(past_[i].time);
      difference.push_back(past_[i].*what);
    }
    for (std::size_t k = 1; k <= n; ++k)
      for (std::size_t i = 0; i + k <= n; ++i) difference[i] = (difference[i] - difference[i + 1]) / (t[i] - t[i + k]);
    return std::abs(factor * difference[0]) / tolerance;
  };
  double largest = 0;
  if (free.volume && volume_tolerance_ > 0) largest = std::max(largest, share(&Value::volume, volume_tolerance_));
  if (free.pressure && pressure_tolerance_ > 0)
    largest = std::max(largest, share(&Value::pressure, pressure_tolerance_));
  return largest;
}

PetscReal StepBound::length_within() const
{
  return in_use() && change > 0 ? safety * most / change : std::numeric_limits<PetscReal>::infinity();
}

std::string StepBound::complaint() const
{
  std::ostringstream text;
  text << option << ": " << symbol << " changed by " << change << unit << ", " << most << unit << " at most";
  return text.str();
}

const StepBound &StepControl::tightest() const
{
  return *std::min_element(bounds_.begin(), bounds_.end(), [](const StepBound &a, const StepBound &b) {
    return a.length_within() < b.length_within();
  });
}

double StepControl::growth(int order, double error)
{
  return std::clamp(safety * std::pow(std::max(error, 1e-12), -1.0 / (order + 1)), 0.2, 2.0);
}

} // namespace pulmo
