#include "pulmo/observers/error_bars.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Factors of safety of an extrapolation whose order is as it should be, or not (Oberkampf & Roy 2010).
constexpr double factor_of_safety = 1.25, doubtful_factor = 3;

} // namespace

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

double ErrorReport::extra_seconds() const
{
  double sum = 0;
  for (std::size_t i = 1; i < levels.size(); ++i) sum += levels[i].seconds;
  return sum;
}

} // namespace pulmo
