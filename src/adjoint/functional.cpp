#include "pulmo/adjoint/functional.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/observers/clinical.hpp"
#include "pulmo/observers/regions.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

namespace pulmo {

namespace {

using Rows = std::vector<SignalRow>;

/// A number below this share of what it is made of is what a solver leaves of nothing.
constexpr double rounding = 1e-6;

/// What all numbers of a run are made of: its last complete breath, and the row at which the first one began.
struct Breath {
  const Rows &rows;
  std::size_t rest, first, last;
  ClinicalNumbers numbers;
  const std::vector<double> &kinks; ///< s
};

/// The row of (first, last] with the largest @p value.
std::size_t largest(const Breath &b, const std::function<double(const SignalRow &)> &value)
{
  std::size_t most = b.first + 1;
  for (std::size_t i = most; i <= b.last; ++i)
    if (value(b.rows[i]) > value(b.rows[most])) most = i;
  return most;
}

/// The first row of each stretch without a kink, up to the last row of all.
std::vector<std::size_t> stretches(const Rows &rows, const std::vector<double> &kinks)
{
  std::vector<std::size_t> list = {0};
  for (std::size_t i = 1; i + 1 < rows.size(); ++i) {
    const double near = rows[i].dt / 1000;
    if (rows[i + 1].phase != rows[i].phase ||
        std::any_of(kinks.begin(), kinks.end(), [&](double t) { return std::abs(t - rows[i].time) < near; }))
      list.push_back(i);
  }
  list.push_back(rows.size() - 1);
  return list;
}

/// Every other row of each stretch, its ends included.
Rows every_other(const Rows &rows, const std::vector<double> &kinks)
{
  const std::vector<std::size_t> ends = stretches(rows, kinks);
  Rows list = {rows.front()};
  for (std::size_t s = 0; s + 1 < ends.size(); ++s)
    for (std::size_t i = ends[s] + 1; i <= ends[s + 1]; ++i) {
      if ((i - ends[s]) % 2 != 0 && i != ends[s + 1]) continue;
      list.push_back(rows[i]);
      list.back().dt = rows[i].time - list[list.size() - 2].time;
    }
  return list;
}

/// What sums over more rows on the same curves would tend to, by Richardson's extrapolation of @p value, which is
/// @p coarse with every other row. Of order 1: after a kink the flow bends faster than rows follow.
double extrapolated(double value, const std::optional<double> &coarse)
{
  return coarse ? 2 * value - *coarse : value;
}

/// By how much the parabola through row @p i, where @p value is largest, and its neighbours rises above it.
double rise_between(const Breath &b, std::size_t i, const std::function<double(const SignalRow &)> &value)
{
  const std::vector<std::size_t> ends = stretches(b.rows, b.kinks);
  if (i <= b.first || i >= b.last || std::find(ends.begin(), ends.end(), i) != ends.end()) return 0;
  const double most = value(b.rows[i]), plain = rounding * std::abs(most);
  if (most - value(b.rows[i - 1]) <= plain || most - value(b.rows[i + 1]) <= plain) return 0; // prescribed, and stays
  const double s = b.rows[i].time - b.rows[i - 1].time, t = b.rows[i + 1].time - b.rows[i].time, y = value(b.rows[i]),
               before = (y - value(b.rows[i - 1])) / s, after = (value(b.rows[i + 1]) - y) / t,
               curvature = (after - before) / (s + t), slope = before + curvature * s;
  return curvature < 0 ? -slope * slope / (4 * curvature) : 0;
}

/// Whether the largest @p value, in row @p i, is one of a curve: not that of a phase's first step alone.
bool is_resolved(const Breath &b, std::size_t i, const std::function<double(const SignalRow &)> &value)
{
  constexpr double plain = 0.02; // what is prescribed stays
  const bool first = i == b.first + 1 || b.rows[i - 1].phase != b.rows[i].phase;
  return !first || i == b.last || value(b.rows[i + 1]) > (1 - plain) * value(b.rows[i]);
}

/// Whether the flow moves the way the pressure does at each jump of it: a multistep rate through one may not, and what
/// its rows add to a fit is then no curve that more rows would follow.
bool follows_jumps(const Breath &b)
{
  constexpr double counts = 0.1; // of the breath's range of pressures
  double most = b.rows[b.first].machine_pressure(), least = most, fastest = 0;
  for (std::size_t i = b.first; i <= b.last; ++i) {
    most = std::max(most, b.rows[i].machine_pressure());
    least = std::min(least, b.rows[i].machine_pressure());
    fastest = std::max(fastest, std::abs(b.rows[i].flow));
  }
  const std::vector<std::size_t> ends = stretches(b.rows, b.kinks);
  for (const std::size_t i : ends) {
    if (i < b.first || i + 2 > b.last) continue;
    const double jump = b.rows[i + 1].machine_pressure() - b.rows[i].machine_pressure(),
                 next = b.rows[i + 2].machine_pressure() - b.rows[i + 1].machine_pressure(),
                 change = b.rows[i + 1].flow - b.rows[i].flow;
    if (std::abs(jump) > counts * (most - least) && std::abs(next) < std::abs(jump) / 2 &&
        std::copysign(1, jump) * change < -rounding * fastest)
      return false;
  }
  return true;
}

/// The largest size of @p value in all rows.
double size(const Breath &b, double SignalRow::*value)
{
  double most = 0;
  for (const SignalRow &r : b.rows) most = std::max(most, std::abs(r.*value));
  return most;
}

bool tidal_volume(const Breath &b, Functional &f)
{
  if (!b.numbers.takes_in || !(b.numbers.tidal_volume > rounding * size(b, &SignalRow::volume))) return false;
  const auto volume = [](const SignalRow &r) { return r.volume; };
  f.value = b.numbers.tidal_volume;
  f.better_value = f.value + rise_between(b, largest(b, volume), volume);
  f.by_volume[largest(b, volume)] += 1;
  f.by_volume[b.first] -= 1;
  return true;
}

bool peak_pressure(const Breath &b, Functional &f)
{
  f.value = b.numbers.peak_pressure;
  const std::size_t i = largest(b, [](const SignalRow &r) { return r.machine_pressure(); });
  f.better_value = f.value;
  f.by_pressure[b.rows[i].machine_pressure() > b.rows[b.first].machine_pressure() ? i : b.first] = 1;
  return true;
}

bool plateau_pressure(const Breath &b, Functional &f)
{
  if (!b.numbers.plateau_pressure) return false;
  f.value = f.better_value = *b.numbers.plateau_pressure;
  f.by_pressure[end_of_inspiration(b.rows, b.first, b.last)] = 1;
  return true;
}

bool peak_flow(const Breath &b, Functional &f)
{
  if (!(b.numbers.peak_flow > rounding * size(b, &SignalRow::flow))) return false;
  const auto flow = [](const SignalRow &r) { return r.flow; };
  f.value = b.numbers.peak_flow;
  f.better_value = f.value + rise_between(b, largest(b, flow), flow);
  f.resolved = is_resolved(b, largest(b, flow), flow);
  f.by_flow[largest(b, flow)] = 1;
  return true;
}

bool peak_expiratory_flow(const Breath &b, Functional &f)
{
  if (!(b.numbers.peak_expiratory_flow > rounding * size(b, &SignalRow::flow))) return false;
  const auto outward = [](const SignalRow &r) { return -r.flow; };
  f.value = b.numbers.peak_expiratory_flow;
  f.better_value = f.value + rise_between(b, largest(b, outward), outward);
  f.resolved = is_resolved(b, largest(b, outward), outward);
  f.by_flow[largest(b, outward)] = -1;
  return true;
}

/// Derivatives of E and R of the fit P = E V + R Q (eq. 52) times @p by_E (cmH2O/ml) and @p by_R (cmH2O s/ml).
///
/// The normal equations sum w V r = 0 and sum w Q r = 0 with r = P - E V - R Q are differentiated as they stand.
void add_fit(const Breath &b, double by_E, double by_R, Functional &f)
{
  const double P_rest = b.rows[b.rest].machine_pressure(), V_rest = b.rows[b.rest].volume,
               E = 1 / b.numbers.compliance.value(), R = b.numbers.resistance.value_or(0) / 1000;
  double VV = 0, VQ = 0, QQ = 0;
  for (std::size_t i = b.first + 1; i <= b.last; ++i) {
    const SignalRow &r = b.rows[i];
    const double V = r.volume - V_rest;
    VV += r.dt * V * V;
    VQ += r.dt * V * r.flow;
    QQ += r.dt * r.flow * r.flow;
  }
  const double determinant = VV * QQ - VQ * VQ, y_V = (by_E * QQ - by_R * VQ) / determinant,
               y_Q = (by_R * VV - by_E * VQ) / determinant;
  for (std::size_t i = b.first + 1; i <= b.last; ++i) {
    const SignalRow &r = b.rows[i];
    const double V = r.volume - V_rest, Q = r.flow, P = r.machine_pressure() - P_rest, left = P - E * V - R * Q,
                 along = r.dt * (y_V * V + y_Q * Q), by_V = r.dt * y_V * left - E * along;
    f.by_volume[i] += by_V;
    f.by_volume[b.rest] -= by_V;
    f.by_pressure[i] += along;
    f.by_pressure[b.rest] -= along;
    f.by_flow[i] += r.dt * y_Q * left - R * along;
  }
  f.from_rest = true;
}

bool compliance(const Breath &b, Functional &f)
{
  if (!b.numbers.compliance || !b.numbers.resistance) return false; // a fit without flow is another one
  f.value = *b.numbers.compliance;
  f.better_value = extrapolated(f.value, overall_numbers(every_other(b.rows, b.kinks)).compliance);
  f.resolved = follows_jumps(b);
  add_fit(b, -f.value * f.value, 0, f);
  return true;
}

bool resistance(const Breath &b, Functional &f)
{
  if (!b.numbers.compliance || !b.numbers.resistance) return false;
  f.value = *b.numbers.resistance;
  f.better_value = extrapolated(f.value, overall_numbers(every_other(b.rows, b.kinks)).resistance);
  f.resolved = follows_jumps(b);
  add_fit(b, 0, 1000, f);
  return true;
}

/// The closed integral of (P - PEEP) dV by trapezoids.
bool work(const Breath &b, Functional &f)
{
  const double peep = b.rows[b.first].machine_pressure(), j = units::kPa_per_cmH2O * 1e-3;
  double gross = 0;
  f.value = b.numbers.work;
  f.better_value = extrapolated(f.value, overall_numbers(every_other(b.rows, b.kinks)).work);
  for (std::size_t i = b.first + 1; i <= b.last; ++i) {
    const SignalRow &r = b.rows[i], &before = b.rows[i - 1];
    const double mean = (r.machine_pressure() + before.machine_pressure()) / 2 - peep, dV = r.volume - before.volume;
    gross += std::abs(j * mean * dV);
    f.by_volume[i] += j * mean;
    f.by_volume[i - 1] -= j * mean;
    f.by_pressure[i] += j * dV / 2;
    f.by_pressure[i - 1] += j * dV / 2;
    f.by_pressure[b.first] -= j * dV;
  }
  return std::abs(f.value) > rounding * gross;
}

/// A number, and how it is made; false where the run does not define it.
struct Known {
  const char *key, *name, *unit;
  bool (*make)(const Breath &, Functional &);
};

constexpr Known known[] = {
    {"tidal_volume_ml", "V_T", "ml", tidal_volume},
    {"compliance_ml_per_cmH2O", "C_rs", "ml/cmH2O", compliance},
    {"resistance_cmH2O_s_per_l", "R", "cmH2O s/l", resistance},
    {"peak_inspiratory_pressure_cmH2O", "PIP", "cmH2O", peak_pressure},
    {"plateau_pressure_cmH2O", "P_plat", "cmH2O", plateau_pressure},
    {"peak_flow_ml_per_s", "Q_peak", "ml/s", peak_flow},
    {"peak_expiratory_flow_ml_per_s", "Q_exp", "ml/s", peak_expiratory_flow},
    {"work_j", "work", "J", work},
};

/// Of the air that a part of the lung takes in: "V_T:" and the name of a region.
constexpr char of_a_part[] = "V_T:";

/// The region that @p name is about; empty: the whole lung.
std::string region_of(const std::string &name)
{
  return name.rfind(of_a_part, 0) == 0 ? name.substr(sizeof(of_a_part) - 1) : "";
}

/// RegionAudit::ventilation() of a region.
bool ventilation(const Breath &b, const RegionAudit &regions, const std::string &region, Functional &f)
{
  const auto &all = regions.regions();
  const auto found = std::find_if(all.begin(), all.end(), [&](const Mesh::Region &r) { return r.name == region; });
  const auto index = static_cast<std::size_t>(found - all.begin());
  if (found == all.end() || !b.numbers.takes_in) return false;
  f.part = {region, {}};
  for (std::size_t i = 0; i < b.rows.size(); ++i) f.part->volume.push_back(regions.state(i, index).volume_change);
  const std::size_t fullest = end_of_inspiration(b.rows, b.first, b.last);
  f.key = "ventilation_ml_" + region;
  f.name = of_a_part + region;
  f.unit = "ml";
  f.value = f.better_value = f.part->volume[fullest] - f.part->volume[b.first];
  f.by_volume[fullest] += 1;
  f.by_volume[b.first] -= 1;
  return std::abs(f.value) > rounding * size(b, &SignalRow::volume);
}

} // namespace

std::vector<std::string> functional_names()
{
  std::vector<std::string> names;
  for (const Known &k : known) names.emplace_back(k.name);
  return names;
}

std::string functional_list()
{
  std::string list;
  for (const Known &k : known) list += (list.empty() ? "" : ", ") + std::string(k.name);
  return list + ", and " + of_a_part + "REGION for the air that a region takes in";
}

PetscErrorCode check_functional_names(const Mesh &mesh, const char *option, const std::vector<std::string> &names)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  std::vector<Mesh::Region> regions;
  std::string list;

  PetscFunctionBeginUser;
  PetscCall(mesh.regions(regions));
  for (const Mesh::Region &r : regions) list += (list.empty() ? "" : ", ") + r.name;
  for (const std::string &name : names) {
    const std::string region = region_of(name);
    if (!region.empty()) {
      PulmoUserCheck(
          std::any_of(regions.begin(), regions.end(), [&](const Mesh::Region &r) { return r.name == region; }), comm,
          "%s %s: the mesh has no region '%s'; %s", option, name.c_str(), region.c_str(),
          list.empty() ? "it is one body without names" : ("it has " + list).c_str());
      continue;
    }
    PulmoUserCheck(std::any_of(std::begin(known), std::end(known), [&](const Known &k) { return name == k.name; }),
                   comm, "%s knows no number '%s'; give some of %s", option, name.c_str(), functional_list().c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::optional<Functional> functional(const std::string &name, const Rows &rows, const std::vector<double> &kinks,
                                     const RegionAudit *regions)
{
  const auto breaths = complete_breaths(rows);
  const Known *k = std::find_if(std::begin(known), std::end(known), [&](const Known &one) { return name == one.name; });
  const std::string region = region_of(name);
  if (breaths.empty() || (region.empty() ? k == std::end(known) : !regions)) return {};
  Functional f;
  for (auto *gradient : {&f.by_volume, &f.by_pressure, &f.by_flow}) gradient->assign(rows.size(), 0);
  const Breath breath{rows, breaths.front().first, breaths.back().first, breaths.back().last, overall_numbers(rows),
                      kinks};
  if (!region.empty()) {
    if (!ventilation(breath, *regions, region, f)) return {};
    return f;
  }
  f.key = k->key;
  f.name = k->name;
  f.unit = k->unit;
  if (!k->make(breath, f)) return {};
  return f;
}

} // namespace pulmo
