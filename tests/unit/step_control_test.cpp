// Estimated errors of steps against the defect of the schemes' own formulas, which is exact for polynomials.
#include "support/scene.hpp"

#include "pulmo/time/step_control.hpp"

#include <cmath>
#include <functional>

namespace pulmo::test {
namespace {

using Curve = std::function<double(double)>;

/// Derivative at t[0] of the polynomial through the points t of curve @p y, over the weight of y(t[0]) in it: what the
/// scheme that looks back on these points gets wrong in y is the defect of that derivative, so scaled.
double local_error(const Curve &y, double slope_of_y, const std::vector<double> &t)
{
  double rate = 0, weight = 0;
  for (std::size_t k = 0; k < t.size(); ++k) {
    double d = 0;
    for (std::size_t j = 0; j < t.size(); ++j) {
      if (j == k) continue;
      double product = 1 / (t[k] - t[j]);
      for (std::size_t i = 0; i < t.size(); ++i)
        if (i != j && i != k) product *= (t[0] - t[i]) / (t[k] - t[i]);
      d += product;
    }
    rate += d * y(t[k]);
    if (k == 0) weight = d;
  }
  return std::abs(rate - slope_of_y) / weight;
}

TEST(StepControl, EstimatesAreTheLocalErrors)
{
  const Curve parabola = [](double t) { return 2 - t + 30 * t * t; };
  const Curve cubic = [](double t) { return 1 + 4 * t * t - 70 * t * t * t; };
  const double tolerance = 0.5, times[] = {0.3, 0.37, 0.42, 0.55};
  for (int order : {1, 2}) {
    const Curve &y = order == 1 ? parabola : cubic;
    PULMO_OK(set_options("-step_volume_tolerance 0.5"));
    StepControl control;
    Options options(PETSC_COMM_WORLD);
    PULMO_OK(control.declare(options));
    EXPECT_TRUE(control.in_use());
    const int first = 2 - order, last = 3; // as many points as the estimate needs
    control.restart({times[first], y(times[first]), 0});
    for (int i = first + 1; i < last; ++i) {
      EXPECT_FALSE(control.error(order, {times[i], y(times[i]), 0}, {true, true}));
      control.accept({times[i], y(times[i]), 0});
    }
    const double t = times[last], slope = order == 1 ? -1 + 60 * t : 8 * t - 210 * t * t;
    const std::vector<double> points{t, times[2], times[1]};
    const double expected = local_error(y, slope, order == 1 ? std::vector<double>{t, times[2]} : points);
    const auto error = control.error(order, {t, y(t), 99}, {true, true});
    ASSERT_TRUE(error);
    EXPECT_NEAR(*error, expected / tolerance, 1e-9 * *error);
    EXPECT_EQ(*control.error(order, {t, y(t), 99}, {false, true}), 0) << "a prescribed volume has no error";
    // of the step that the estimate proposes: at the tolerance, with a margin
    const double growth = StepControl::growth(order, 0.4);
    EXPECT_NEAR(std::pow(growth, order + 1) * 0.4, std::pow(0.9, order + 1), 1e-12);
  }
}

} // namespace
} // namespace pulmo::test
