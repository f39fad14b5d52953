#include "pulmo/clinical.hpp"

#include "pulmo/units.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// First and last row of each breath; a breath starts at the last row before it.
std::vector<std::pair<std::size_t, std::size_t>> breaths(const std::vector<SignalRow> &rows)
{
  std::vector<std::pair<std::size_t, std::size_t>> list;
  for (std::size_t i = 1; i < rows.size(); ++i) {
    if (rows[i].breath < 1) continue;
    if (list.empty() || rows[i].breath != rows[i - 1].breath || rows[i - 1].dt == 0) list.emplace_back(i - 1, i);
    list.back().second = i;
  }
  return list;
}

} // namespace

void fit_single_compartment(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep,
                            ClinicalNumbers &numbers)
{
  const double start = rows[first].volume;
  double VV = 0, VQ = 0, QQ = 0, PV = 0, PQ = 0; // normal equations
  for (std::size_t i = first + 1; i <= last; ++i) {
    const SignalRow &r = rows[i];
    const double P = r.pressure - peep, V = r.volume - start, Q = r.flow, w = r.dt;
    VV += w * V * V;
    VQ += w * V * Q;
    QQ += w * Q * Q;
    PV += w * P * V;
    PQ += w * P * Q;
  }
  const double determinant = VV * QQ - VQ * VQ;
  if (!(determinant > 1e-12 * VV * QQ)) return;
  const double E = (PV * QQ - PQ * VQ) / determinant, R = (PQ * VV - PV * VQ) / determinant;
  if (!(E > 0)) return;
  numbers.compliance = 1 / E;
  numbers.resistance = R * 1000;
  numbers.time_constant = R / E;
}

ClinicalNumbers clinical_numbers(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep)
{
  ClinicalNumbers n;
  const SignalRow &start = rows[first];
  double work = 0; // cmH2O ml

  n.peak_pressure = start.pressure;
  for (std::size_t i = first + 1; i <= last; ++i) {
    const SignalRow &r = rows[i], &before = rows[i - 1];
    n.peak_pressure = std::max(n.peak_pressure, r.pressure);
    n.tidal_volume = std::max(n.tidal_volume, r.volume - start.volume);
    n.peak_flow = std::max(n.peak_flow, r.flow);
    if (r.phase == "pause") n.plateau_pressure = r.pressure;
    work += ((r.pressure + before.pressure) / 2 - peep) * (r.volume - before.volume);
  }
  n.trapped_volume = rows[last].volume - start.volume;
  n.driving_pressure = n.plateau_pressure.value_or(n.peak_pressure) - peep;
  n.work = work * units::kPa_per_cmH2O * 1e-3; // kPa ml = 1e-3 J
  const double duration = rows[last].time - start.time;
  n.mechanical_power = duration > 0 ? n.work * 60 / duration : 0;
  fit_single_compartment(rows, first, last, peep, n);
  return n;
}

std::vector<ClinicalNumbers> breath_numbers(const std::vector<SignalRow> &rows, double peep)
{
  std::vector<ClinicalNumbers> list;
  for (const auto &[first, last] : breaths(rows)) list.push_back(clinical_numbers(rows, first, last, peep));
  return list;
}

ClinicalNumbers overall_numbers(const std::vector<SignalRow> &rows, double peep)
{
  const auto list = breaths(rows);
  if (list.empty()) return {};
  ClinicalNumbers n = clinical_numbers(rows, list.back().first, list.back().second, peep);
  n.compliance.reset();
  n.resistance.reset();
  n.time_constant.reset();
  fit_single_compartment(rows, list.front().first, list.back().second, peep, n);
  return n;
}

} // namespace pulmo
