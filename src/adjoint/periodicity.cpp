#include "pulmo/adjoint/periodicity.hpp"

#include "pulmo/observers/clinical.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace pulmo {

namespace {

/// Changes below this share of a number end the series: what a sweep leaves of its systems.
constexpr double least = 1e-6;

/// No limit where what follows the terms at hand is so much in doubt, as a share of the whole; nor where the whole is
/// more than that of the number, which is no small change.
constexpr double in_doubt = 0.05, small = 0.05;

/// Times that differ by less than this share are the same.
constexpr double same_time = 1e-9;

/// What the ventilator does in a breath.
std::vector<Phase> phases_of(const Programme &programme, int breath)
{
  std::vector<Phase> list;
  for (const Phase &phase : programme.phases())
    if (phase.breath == breath) list.push_back(phase);
  return list;
}

bool alike(const std::vector<Phase> &a, const std::vector<Phase> &b)
{
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](const Phase &p, const Phase &q) {
    const PetscReal duration = p.end - p.begin;
    return std::abs(duration - (q.end - q.begin)) <= same_time * q.end && p.control == q.control && p.to == q.to &&
           p.ramp == q.ramp && p.limit == q.limit;
  });
}

/// The sum of @p terms and of those that follow, as a geometric series; empty where the terms do not look like one yet:
/// their ratio rises from breath to breath until the slowest change of the lung is all that is left.
std::optional<double> limit(const std::vector<double> &terms, double least_term)
{
  const std::size_t n = terms.size();
  const double last = terms.back(), sum = std::accumulate(terms.begin(), terms.end(), 0.);
  if (std::abs(last) <= least_term) return sum;
  if (n < 2) return {};
  const double ratio = last / terms[n - 2], before = n > 2 ? terms[n - 2] / terms[n - 3] : 0;
  if (!(std::abs(ratio) < 1)) return {};
  const double whole = sum + last * ratio / (1 - ratio);
  const double doubt = std::abs(last * (ratio - before)) / ((1 - ratio) * (1 - ratio));
  if (!(doubt <= in_doubt * std::abs(whole))) return {};
  return whole;
}

/// Whether other loads than the ventilator's do in the breath @p later s after that of rows (first, last] what they do
/// there.
bool loads_repeat(const Scene &scene, const std::vector<SignalRow> &rows, std::size_t first, std::size_t last,
                  PetscReal later)
{
  for (const auto &course : scene.facts().courses) {
    PetscReal size = 0, difference = 0;
    for (std::size_t i = first; i <= last; ++i) {
      const PetscReal now = course(rows[i].time);
      size = std::max(size, std::abs(now));
      difference = std::max(difference, std::abs(course(rows[i].time + later) - now));
    }
    if (difference > least * size) return false;
  }
  return true;
}

} // namespace

Periodicity::Periodicity(const Scene &scene, const std::vector<SignalRow> &rows, const Trajectory &trajectory)
    : rows_(rows)
{
  const Programme &programme = *scene.facts().ventilator;
  const auto breaths = complete_breaths(rows);
  if (breaths.empty() || programme.may_end_early()) return; // ends that move are no map of states
  const auto stage_of = [&](std::size_t row) {
    const auto &stages = trajectory.stages();
    const auto found = std::find_if(stages.begin(), stages.end(),
                                    [&](const StageRecord &r) { return r.row == static_cast<PetscInt>(row); });
    return static_cast<PetscInt>(found - stages.begin());
  };
  first_ = breaths.back().first;
  last_ = breaths.back().last;
  const PetscInt from = stage_of(first_), to = stage_of(last_);
  const std::vector<Phase> repeated = phases_of(programme, rows[last_].breath);
  if (!loads_repeat(scene, rows, first_, last_, rows[last_].time - rows[first_].time)) return;
  for (std::size_t i = breaths.size(), begin = last_; i-- > 0 && breaths[i].last == begin; begin = breaths[i].first) {
    if (!alike(phases_of(programme, rows[breaths[i].last].breath), repeated)) break;
    if (!loads_repeat(scene, rows, first_, last_, rows[breaths[i].last].time - rows[last_].time)) break;
    shifts_.push_back({stage_of(breaths[i].first), from, to, {}, {}});
  }
  // one that differs from the breath before it is no breath among others
  if (breaths.size() > 1 && shifts_.size() == 1) shifts_.clear();
}

void Periodicity::ask(Sweep &sweep)
{
  for (Sweep::Shift &shift : shifts_) sweep.ask_shift(shift);
}

std::optional<MoreBreaths> Periodicity::change(const Functional &f, std::size_t k) const
{
  if (shifts_.empty()) return {};
  std::vector<double> terms;
  for (const Sweep::Shift &shift : shifts_) terms.push_back(shift.change[k]);
  if (!f.from_rest) { // the number looks at the start itself
    const SignalRow &from = rows_[first_], &to = rows_[last_];
    terms.front() += f.by_volume[first_] * shifts_.front().volume[k] +
                     f.by_pressure[first_] * (to.machine_pressure() - from.machine_pressure()) +
                     f.by_flow[first_] * (to.flow - from.flow);
  }
  MoreBreaths more;
  more.next = terms.front();
  more.periodic = limit(terms, least * std::abs(f.value));
  if (more.periodic && std::abs(*more.periodic) > small * std::abs(f.value)) more.periodic = {};
  return more;
}

} // namespace pulmo
