#include "pulmo/observers/clinical.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Volumes closer than this share of the tidal volume are the same.
constexpr double same_volume = 1e-6;

/// So are volumes closer than this share of the volumes themselves.
constexpr double rounding = 1e-10;

/// Flow below this share of the peak is no flow.
constexpr double no_flow = 1e-3;

/// a / b where b is positive.
std::optional<double> ratio(double a, double b)
{
  return b > 0 ? std::optional<double>(a / b) : std::nullopt;
}

/// By how much the volume of rows first ... last changes, ml; 0 where that is what a solver leaves of nothing.
double movement(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last)
{
  double low = rows[first].volume, high = low;
  for (std::size_t i = first + 1; i <= last; ++i) {
    low = std::min(low, rows[i].volume);
    high = std::max(high, rows[i].volume);
  }
  return high - low > least_movement * rows[first].rest_volume ? high - low : 0;
}

/// The last row before the pause that ends at row @p end, not before row @p first.
std::size_t before_pause(const std::vector<SignalRow> &rows, std::size_t first, std::size_t end)
{
  std::size_t i = end;
  while (i > first && rows[i].phase == rows[end].phase && rows[i].breath == rows[end].breath && rows[i].pause()) --i;
  return i;
}

/// Plateau, resistance from the pause and slope of the static curve.
void add_pauses(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, ClinicalNumbers &n)
{
  const auto points = static_points(rows, first, last);
  if (points.empty()) return;
  std::size_t fullest = 0;
  for (std::size_t k = 1; k < points.size(); ++k)
    if (rows[points[k].row].volume >= rows[points[fullest].row].volume - same_volume * n.tidal_volume) fullest = k;

  if (points[fullest].row == end_of_inspiration(rows, first, last)) {
    const SignalRow &end = rows[points[fullest].row], &before = rows[before_pause(rows, first, points[fullest].row)];
    n.plateau_pressure = end.machine_pressure();
    if (end.flow_resistance && std::abs(end.volume - before.volume) <= same_volume * n.tidal_volume &&
        before.flow > no_flow * n.peak_flow)
      n.pause_resistance = (before.machine_pressure() - end.machine_pressure()) / before.flow * 1000;
  }

  // regression of pressure on volume: volumes are given, pressures are the answer (as in eq. 52)
  double P = 0, V = 0, PV = 0, VV = 0;
  const auto count = static_cast<double>(fullest + 1);
  for (std::size_t k = 0; k <= fullest; ++k) {
    P += rows[points[k].row].machine_pressure() / count;
    V += rows[points[k].row].volume / count;
  }
  for (std::size_t k = 0; k <= fullest; ++k) {
    const double dV = rows[points[k].row].volume - V;
    PV += (rows[points[k].row].machine_pressure() - P) * dV;
    VV += dV * dV;
  }
  if (std::sqrt(VV / count) > same_volume * n.tidal_volume) n.static_curve_compliance = ratio(VV, PV);
}

} // namespace

std::vector<ClinicalEntry> clinical_entries(const ClinicalNumbers &n, const std::optional<double> &frc)
{
  const auto tidal = n.takes_in ? std::optional<double>(n.tidal_volume) : std::nullopt,
             strain = frc && tidal ? std::optional<double>(*tidal / *frc) : std::nullopt;
  return {
      {"peak_inspiratory_pressure_cmH2O", "peak inspiratory pressure", "cmH2O", n.peak_pressure},
      {"plateau_pressure_cmH2O", "plateau pressure", "cmH2O", n.plateau_pressure},
      {"peep_cmH2O", "PEEP", "cmH2O", n.peep},
      {"auto_peep_cmH2O", "auto-PEEP", "cmH2O", n.auto_peep},
      {"total_peep_cmH2O", "total PEEP", "cmH2O", n.total_peep},
      {"driving_pressure_cmH2O", "driving pressure", "cmH2O", n.driving_pressure},
      {"tidal_volume_ml", "tidal volume", "ml", tidal},
      {"trapped_volume_ml", "trapped volume", "ml", n.trapped_volume},
      {"peak_flow_ml_per_s", "peak inspiratory flow", "ml/s", n.peak_flow},
      {"peak_expiratory_flow_ml_per_s", "peak expiratory flow", "ml/s", n.peak_expiratory_flow},
      {"compliance_ml_per_cmH2O", "compliance C_rs (fit)", "ml/cmH2O", n.compliance},
      {"resistance_cmH2O_s_per_l", "resistance R (fit)", "cmH2O s/l", n.resistance},
      {"time_constant_s", "time constant R C_rs", "s", n.time_constant},
      {"compliance_equal_weights_ml_per_cmH2O", "C_rs, equal weights, intercept", "ml/cmH2O",
       n.equal_weight_compliance},
      {"resistance_equal_weights_cmH2O_s_per_l", "R, equal weights, intercept", "cmH2O s/l", n.equal_weight_resistance},
      {"static_compliance_ml_per_cmH2O", "static compliance", "ml/cmH2O", n.static_compliance},
      {"dynamic_compliance_ml_per_cmH2O", "dynamic compliance", "ml/cmH2O", n.dynamic_compliance},
      {"static_curve_compliance_ml_per_cmH2O", "slope of the static curve", "ml/cmH2O", n.static_curve_compliance},
      {"pause_resistance_cmH2O_s_per_l", "resistance from the pause", "cmH2O s/l", n.pause_resistance},
      {"work_j", "work of (P - PEEP)", "J", n.work},
      {"mechanical_power_j_per_min", "mechanical power", "J/min", n.mechanical_power},
      {"strain", "strain V_T/FRC", "", strain},
  };
}

std::size_t end_of_inspiration(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last)
{
  const double start = rows[first].volume;
  double top = start, size = std::abs(start);
  for (std::size_t i = first + 1; i <= last; ++i) {
    top = std::max(top, rows[i].volume);
    size = std::max(size, std::abs(rows[i].volume));
  }
  const double least = top - same_volume * (top - start) - rounding * size;
  const auto points = static_points(rows, first, last);
  const auto pause = std::find_if(points.rbegin(), points.rend(),
                                  [&](const StaticPoint &point) { return rows[point.row].volume >= least; });
  if (pause != points.rend()) return pause->row;
  if (start >= least) return first;
  std::size_t i = first + 1;
  while (rows[i].volume < least) ++i;
  while (i < last && rows[i + 1].phase == rows[i].phase && rows[i + 1].volume >= least) ++i;
  return i;
}

std::vector<BreathRows> breath_rows(const std::vector<SignalRow> &rows)
{
  std::vector<BreathRows> list;
  for (std::size_t i = 1; i < rows.size(); ++i) {
    if (rows[i].breath < 1) continue;
    if (list.empty() || rows[i].breath != rows[i - 1].breath || rows[i - 1].dt == 0) list.push_back({i - 1, i, i - 1});
    list.back().last = i;
  }
  for (BreathRows &b : list) {
    b.fullest = end_of_inspiration(rows, b.first, b.last);
    b.complete = !rows[b.last].cut;
  }
  return list;
}

std::vector<BreathRows> complete_breaths(const std::vector<SignalRow> &rows)
{
  auto list = breath_rows(rows);
  list.erase(std::remove_if(list.begin(), list.end(), [](const BreathRows &b) { return !b.complete; }), list.end());
  return list;
}

BreathRows last_breath(const std::vector<SignalRow> &rows)
{
  const auto breaths = complete_breaths(rows);
  return breaths.empty() ? BreathRows{0, rows.size() - 1, rows.size() - 1} : breaths.back();
}

std::vector<StaticPoint> static_points(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last)
{
  std::vector<StaticPoint> points;
  for (std::size_t i = first + 1; i <= last && i < rows.size(); ++i) {
    if (!rows[i].pause()) continue;
    if (i < last && rows[i + 1].phase == rows[i].phase && rows[i + 1].breath == rows[i].breath) continue;
    points.push_back({i, rows[before_pause(rows, first, i)].phase});
  }
  return points;
}

void fit_single_compartment(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep,
                            ClinicalNumbers &numbers, std::optional<double> start)
{
  if (!movement(rows, first, last)) return;
  const double V_start = start.value_or(rows[first].volume);
  double VV = 0, VQ = 0, QQ = 0, PV = 0, PQ = 0; // normal equations
  for (std::size_t i = first + 1; i <= last; ++i) {
    const SignalRow &r = rows[i];
    const double P = r.machine_pressure() - peep, V = r.volume - V_start, Q = r.flow, w = r.dt;
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
  if (!rows[last].flow_resistance || !(R > 0)) return; // R would be what the curve of P over V leaves of a line
  numbers.resistance = R * 1000;
  numbers.time_constant = R / E;
}

void fit_with_intercept(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last,
                        ClinicalNumbers &numbers)
{
  if (!movement(rows, first, last)) return;
  const auto count = static_cast<double>(last - first);
  double V = 0, Q = 0, P = 0; // means
  for (std::size_t i = first + 1; i <= last; ++i) {
    V += rows[i].volume / count;
    Q += rows[i].flow / count;
    P += rows[i].machine_pressure() / count;
  }
  double VV = 0, VQ = 0, QQ = 0, PV = 0, PQ = 0;
  for (std::size_t i = first + 1; i <= last; ++i) {
    const double v = rows[i].volume - V, q = rows[i].flow - Q, p = rows[i].machine_pressure() - P;
    VV += v * v;
    VQ += v * q;
    QQ += q * q;
    PV += p * v;
    PQ += p * q;
  }
  const double determinant = VV * QQ - VQ * VQ;
  if (!(determinant > 1e-12 * VV * QQ)) return;
  const double E = (PV * QQ - PQ * VQ) / determinant, R = (PQ * VV - PV * VQ) / determinant;
  if (!(E > 0)) return;
  numbers.equal_weight_compliance = 1 / E;
  if (!rows[last].flow_resistance || !(R > 0)) return; // as above
  numbers.equal_weight_resistance = R * 1000;
}

namespace {

/// PEEP at the end of a breath: the pressure that the machine holds there, else that at its start, cmH2O.
double peep_at_end(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last)
{
  constexpr double same = 1e-9; // cmH2O: a pressure that is set is met to rounding
  const double start = rows[first].machine_pressure(), end = rows[last].machine_pressure();
  const bool held = last > first + 1 && !rows[last].pause() && std::abs(end - rows[last - 1].machine_pressure()) < same;
  return held ? end : start;
}

} // namespace

ClinicalNumbers clinical_numbers(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last)
{
  ClinicalNumbers n;
  const SignalRow &start = rows[first], &end = rows[last];
  double work = 0; // cmH2O ml

  n.peak_pressure = n.peep = start.machine_pressure();
  for (std::size_t i = first + 1; i <= last; ++i) {
    const SignalRow &r = rows[i], &before = rows[i - 1];
    n.peak_pressure = std::max(n.peak_pressure, r.machine_pressure());
    n.tidal_volume = std::max(n.tidal_volume, r.volume - start.volume);
    n.fall = std::max(n.fall, start.volume - r.volume);
    n.peak_flow = std::max(n.peak_flow, r.flow);
    n.peak_expiratory_flow = std::max(n.peak_expiratory_flow, -r.flow);
    work += ((r.machine_pressure() + before.machine_pressure()) / 2 - n.peep) * (r.volume - before.volume);
  }
  n.moves = movement(rows, first, last) > 0;
  n.takes_in = !n.moves || n.tidal_volume > n.fall;
  add_pauses(rows, first, last, n);
  n.trapped_volume = end.volume - start.volume;
  n.driving_pressure = n.plateau_pressure.value_or(n.peak_pressure) - n.peep;
  n.dynamic_compliance = ratio(n.tidal_volume, n.peak_pressure - n.peep);
  if (!n.moves || !n.takes_in) { // ratios of V_T, and of what is left of it
    n.dynamic_compliance.reset();
    n.pause_resistance.reset();
    if (!n.moves) n.static_curve_compliance.reset();
  } else if (n.plateau_pressure)
    n.static_compliance = ratio(n.tidal_volume, *n.plateau_pressure - start.alveolar_pressure.value_or(n.peep));
  if (end.alveolar_pressure) {
    n.total_peep = *end.alveolar_pressure;
    n.auto_peep = *end.alveolar_pressure - peep_at_end(rows, first, last);
  }
  n.work = work * units::kPa_per_cmH2O * 1e-3; // kPa ml = 1e-3 J
  const double duration = end.time - start.time;
  n.mechanical_power = duration > 0 ? n.work * 60 / duration : 0;
  fit_single_compartment(rows, first, last, n.peep, n);
  fit_with_intercept(rows, first, last, n);
  return n;
}

std::vector<ClinicalNumbers> breath_numbers(const std::vector<SignalRow> &rows)
{
  std::vector<ClinicalNumbers> list;
  for (const BreathRows &b : complete_breaths(rows)) list.push_back(clinical_numbers(rows, b.first, b.last));
  return list;
}

std::vector<PeepLevel> peep_levels(const std::vector<SignalRow> &rows)
{
  constexpr double same_level = 0.1; // cmH2O: less than a ventilator sets
  std::vector<PeepLevel> levels;
  for (const BreathRows &b : complete_breaths(rows)) {
    const double peep = clinical_numbers(rows, b.first, b.last).peep;
    std::size_t last = b.last; // a change to the next level belongs to the breath before it, and to no level
    while (last > b.fullest && std::abs(rows[last].machine_pressure() - peep) >= same_level) --last;
    if (last == b.fullest) last = b.last;
    const PeepLevel level{peep, last, clinical_numbers(rows, b.first, last).compliance};
    if (!levels.empty() && std::abs(levels.back().peep - peep) < same_level)
      levels.back() = level;
    else
      levels.push_back(level);
  }
  if (levels.size() < 3) levels.clear();
  return levels;
}

const PeepLevel *best_compliance(const std::vector<PeepLevel> &levels)
{
  const PeepLevel *best = nullptr;
  for (const PeepLevel &level : levels)
    if (level.compliance && (!best || *level.compliance > *best->compliance)) best = &level;
  return best;
}

ClinicalNumbers overall_numbers(const std::vector<SignalRow> &rows)
{
  const auto list = complete_breaths(rows);
  if (list.empty()) return {};
  ClinicalNumbers n = clinical_numbers(rows, list.back().first, list.back().last);
  const SignalRow &rest = rows[list.front().first];
  n.compliance.reset();
  n.resistance.reset();
  n.time_constant.reset();
  fit_single_compartment(rows, list.back().first, list.back().last, rest.machine_pressure(), n, rest.volume);
  return n;
}

std::vector<ClinicalEntry> overall_entries(const std::vector<SignalRow> &rows, const std::optional<double> &frc)
{
  auto entries = clinical_entries(overall_numbers(rows), frc);
  if (complete_breaths(rows).empty())
    for (ClinicalEntry &e : entries) e.value.reset();
  return entries;
}

std::optional<Unsteadiness> unsteadiness(const std::vector<SignalRow> &rows)
{
  const auto breaths = complete_breaths(rows);
  if (breaths.empty()) return {};
  Unsteadiness largest;
  const ClinicalNumbers n = clinical_numbers(rows, breaths.back().first, breaths.back().last);
  const auto look_at = [&](const char *what, std::optional<double> difference, std::optional<double> whole) {
    if (!difference || !whole || *whole == 0 || std::abs(*difference / *whole) <= largest.change) return;
    largest = {std::abs(*difference / *whole), what};
  };
  if (!n.moves || !n.takes_in) return {};
  look_at("trapped volume over the tidal volume", n.trapped_volume, n.tidal_volume);
  if (breaths.size() > 1 && breaths[breaths.size() - 2].last == breaths.back().first) {
    const BreathRows &b = breaths[breaths.size() - 2];
    const ClinicalNumbers before = clinical_numbers(rows, b.first, b.last);
    const auto change = [&](const char *what, std::optional<double> now, std::optional<double> then) {
      if (now && then) look_at(what, *now - *then, now);
    };
    change("change of the tidal volume from the breath before", n.tidal_volume, before.tidal_volume);
    change("change of C_rs from the breath before", n.compliance, before.compliance);
    change("change of R from the breath before", n.resistance, before.resistance);
  }
  return largest;
}

std::optional<std::size_t> shrinks_under_pressure(const std::vector<SignalRow> &rows)
{
  constexpr double same_pressure = 1e-6; // cmH2O
  const auto breaths = breath_rows(rows);
  if (breaths.empty()) return {};
  const SignalRow &start = rows[breaths.front().first];
  const double least = same_volume * start.rest_volume + 2 * unsettled_volume(rows).value_or(0);
  for (std::size_t i = breaths.front().first + 1; i <= breaths.front().last; ++i) {
    if (rows[i].machine_pressure() < start.machine_pressure() - same_pressure) return {};
    if (rows[i].volume < start.volume - least) return i;
  }
  return {};
}

std::optional<double> unsettled_volume(const std::vector<SignalRow> &rows)
{
  const auto breaths = breath_rows(rows);
  if (breaths.empty() || breaths.front().first == 0) return {};
  const std::size_t last = breaths.front().first;
  const SignalRow &end = rows[last], &before = rows[last - 1];
  if (!end.flow_resistance) return {};
  if (std::abs(end.flow) * end.dt <= least_movement * end.rest_volume) return 0; // what fades there is rounding
  const double fading = last > 1 ? (before.flow / end.flow - 1) / end.dt : 0;    // 1/s, of a step of backward Euler
  return std::abs(end.flow) * (fading > 0 ? 1 / fading : end.time);
}

} // namespace pulmo
