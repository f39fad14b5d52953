#include "pulmo/observers/error_bars.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Factors of safety of an extrapolation whose order is as it should be, or not (Oberkampf & Roy 2010).
constexpr double factor_of_safety = 1.25, doubtful_factor = 3;

/// What of the error in space richer elements see, where its order is 1 in h/p^2.
constexpr double seen_by_richer = 0.75;

/// Of the bar of a sweep: over its parts, of the corrected value over that, and the largest part that is one.
constexpr double swept_factor = 1.5, corrected_share = 1. / 3, largest_part = 0.1;

/// Where some number is off by more than so many times its own size no estimate of first order is worth anything; but a
/// share below the second of a number that is prescribed stays rounding.
constexpr double worthless = 3, plain = 1e-6;

struct Reason {
  const char *key, *words;
};

/// In the order of Unresolved.
constexpr Reason reasons[] = {{"phase_ended_early", "phases ended by a trigger or by cycling"},
                              {"few_steps_in_a_phase", "steps too long for its phases"},
                              {"steps_too_long", "steps too long"},
                              {"cells_too_large", "cells too large"}};

} // namespace

const char *key_of(Unresolved reason)
{
  return reasons[static_cast<int>(reason)].key;
}

const char *words_of(Unresolved reason)
{
  return reasons[static_cast<int>(reason)].words;
}

double space_share(const ClinicalEntry &entry, const LackingParts &parts)
{
  const double space = (std::abs(parts.flow_in_space) + std::abs(parts.tissue_in_space)) / seen_by_richer;
  return space == 0 ? 0 : space / std::abs(*entry.value);
}

ErrorBar lacking_bar(const ClinicalEntry &entry, const LackingParts &parts, double largest_share,
                     std::optional<Unresolved> trouble_in_time)
{
  const double value = *entry.value, time = std::abs(parts.steps) + std::abs(parts.rows),
               space = space_share(entry, parts);
  ErrorBar bar;

  bar.entry = entry;
  bar.lacks = parts;
  bar.solver = std::abs(parts.solver);
  if (trouble_in_time)
    bar.unresolved.push_back(*trouble_in_time);
  else if (!(time <= largest_part * std::abs(value)))
    bar.unresolved.push_back(Unresolved::steps_too_long);
  else
    bar.time = swept_factor * time;
  if (space <= largest_part && (largest_share <= worthless || space < plain))
    bar.space = swept_factor * (1 + std::min(1., largest_share)) * space * std::abs(value);
  else
    bar.unresolved.push_back(Unresolved::cells_too_large);
  if (!bar.total()) return bar;
  bar.corrected =
      value + parts.steps + parts.rows + parts.solver + (parts.flow_in_space + parts.tissue_in_space) / seen_by_richer;
  bar.corrected_error = corrected_share * *bar.total();
  return bar;
}

TimeError time_error(double fine, double twice, double four_times, int order)
{
  const double near = fine - twice, far = twice - four_times;
  if (near == 0 || !(far / near > 0)) return {factor_of_safety * std::max(std::abs(near), std::abs(far)), {}};
  const double observed = std::log2(far / near);
  const bool as_it_should = std::abs(observed - order) <= 0.1 * order;
  const double used = as_it_should ? order : std::clamp(observed, 0.5, double(order)),
               safety = as_it_should ? factor_of_safety : doubtful_factor;
  return {safety * std::abs(near) / (std::exp2(used) - 1), observed};
}

double space_error(double difference, double ratio)
{
  return factor_of_safety * std::abs(difference / (1 - ratio));
}

std::optional<double> ErrorBar::total() const
{
  return time && space && solver ? std::optional<double>(*time + *space + *solver) : std::nullopt;
}

std::string ErrorBar::unresolved_words() const
{
  std::string all;
  for (Unresolved reason : unresolved) all += (all.empty() ? "" : ", ") + std::string(words_of(reason));
  return all;
}

double ErrorReport::extra_seconds() const
{
  double sum = sweep_seconds;
  for (std::size_t i = 1; i < levels.size(); ++i) sum += levels[i].seconds;
  return sum;
}

} // namespace pulmo
