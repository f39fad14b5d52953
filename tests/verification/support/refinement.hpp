/// @file
/// Consolidation problems over refinements of mesh and step, against their series.
#pragma once

#include "verification/support/column.hpp"
#include "verification/support/modes.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

namespace pulmo::test {

/// Two tissues, nu = 1/12 and 0.3 (the first makes more of the Mandel-Cryer effect).
constexpr SmallStrain soft{column::c, 0.1}, lung{column::c, column::beta};

/// Options of a linear problem with a = 1 mm and c_v = 1 mm^2/s: factors of the first step serve them all.
inline std::string consolidation(const SmallStrain &k, const std::string &mesh, const std::string &drained, double dt,
                                 double t_end)
{
  return "-options_file " + source("petsc_options/solvers/tight.opts") +
         " -snes_lag_jacobian 20 -snes_lag_jacobian_persists -snes_lag_preconditioner 20"
         " -snes_lag_preconditioner_persists -newton_refresh 0.3 -dm_plex_filename " +
         mesh + " -tissue yoshihara -tissue_c " + column::number(k.c) + " -tissue_beta " + column::number(k.beta) +
         " -airflow -airflow_surfaces " + drained + " -airflow_permeability " + column::number(1 / k.confined()) +
         " -ts_dt " + column::number(dt) + " -ts_max_time " + column::number(t_end);
}

/// A quantity of a consolidation problem: what was computed after each step, and its series.
struct Signal {
  std::string name;
  std::vector<double> found;
  Modes::Transform exact;
  double scale;       ///< errors are shares of it
  double order = 1.7; ///< in h, at least

  /// Largest error from step 6 on (a sudden load has no order in time before) against the steps of backward Euler
  /// without error in space: the error in space alone.
  double space_error(const Modes &modes, double dt) const
  {
    double worst = 0;
    for (std::size_t i = 6; i < found.size(); ++i)
      worst = std::max(worst, std::abs(found[i] - modes.value(exact, i * dt, static_cast<int>(i))) / scale);
    return worst;
  }
};

/// Runs a problem with so many cells across its radius and so many steps.
using Solve = std::function<void(int cells, int steps, std::vector<Signal> &)>;

/// Halves h; demands each signal's order between the last two meshes, and errors below @p bound on the last.
inline void converge_in_space(const Modes &modes, const Solve &solve, const std::vector<int> &cells, int steps,
                              double t_end, double bound)
{
  std::vector<double> before;
  for (const int n : cells) {
    std::vector<Signal> signals;
    std::vector<double> errors;
    ASSERT_NO_FATAL_FAILURE(solve(n, steps, signals));
    std::printf("  h = a/%-3d error in space", n);
    for (std::size_t q = 0; q < signals.size(); ++q) {
      errors.push_back(signals[q].space_error(modes, t_end / steps));
      std::printf("  %s %.2e", signals[q].name.c_str(), errors[q]);
      if (before.empty()) continue;
      const double order = std::log2(before[q] / errors[q]);
      std::printf(" (%.2f)", order);
      if (n != cells.back()) continue;
      EXPECT_GT(order, signals[q].order) << signals[q].name;
      EXPECT_LT(errors[q], bound) << signals[q].name;
    }
    std::printf("\n");
    before = errors;
  }
}

/// The same for both tissues, on a third mesh for the first one. Series: of a SmallStrain, with its modes;
/// @p solve(tissue, series, cells, steps, signals) runs the problem.
template <class Series, class SolveFor>
void converge_in_space_for_both(const SolveFor &solve, int steps, double t_end, double soft_bound, double lung_bound)
{
  for (const SmallStrain &k : {soft, lung}) {
    const Series series(k);
    const bool third = k.beta == soft.beta;
    std::printf("  nu %.4f\n", k.poisson());
    converge_in_space(
        series.modes,
        [&](int n, int steps_of_run, std::vector<Signal> &signals) { solve(k, series, n, steps_of_run, signals); },
        third ? std::vector<int>{4, 8, 16} : std::vector<int>{4, 8}, steps, t_end, third ? soft_bound : lung_bound);
  }
}

/// Halves dt twice on one mesh; demands order 1 at the given @p times, and the series within @p bound in the limit.
inline void converge_in_time(const Modes &modes, const Solve &solve, int cells, int steps, double t_end,
                             const std::vector<double> &times, double bound)
{
  std::vector<Signal> signals[3];
  for (int i = 0; i < 3; ++i) ASSERT_NO_FATAL_FAILURE(solve(cells, steps << i, signals[i]));
  for (const double t : times)
    for (std::size_t q = 0; q < signals[0].size(); ++q) {
      double error[3];
      const double scale = signals[0][q].scale, exact = modes.value(signals[0][q].exact, t) / scale;
      for (int i = 0; i < 3; ++i) error[i] = signals[i][q].found[std::lround(t / t_end * (steps << i))] / scale - exact;
      const double order = std::log2((error[0] - error[1]) / (error[1] - error[2])), limit = 2 * error[2] - error[1];
      std::printf("  T %.2f %-6s exact %9.6f, error %9.2e %9.2e %9.2e (dT = %g, /2, /4), order %.3f, dT -> 0 %9.2e\n",
                  t, signals[0][q].name.c_str(), exact, error[0], error[1], error[2], t_end / steps, order, limit);
      EXPECT_NEAR(order, 1, 0.15) << signals[0][q].name << " at " << t;
      EXPECT_NEAR(limit, 0, bound) << signals[0][q].name << " at " << t;
    }
}

} // namespace pulmo::test
