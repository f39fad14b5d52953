// Consolidation at finite strain with an exact solution; see README.md beside this file.
//
//        sides on rollers, sealed
//      +---------------------------+
//   |> |                           | <--  T = -1 kPa (dead load)
//   |> |   CM4, k = c J / W''(J)   | <--  p = 0 (drained)
//      +---------------------------+
//     X = 0, sealed              X = L = 1 mm
#include "verification/support/column.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

struct Result {
  double J0, p0, V;
};

constexpr double T = -1, t_end = 0.1;

void run_column(int steps, Result &result)
{
  Registry registry = Registry::standard();
  registry.permeability_law<column::DiffusivePermeability>();
  pulmo::Run run(registry);
  bool finished = false;
  PULMO_OK(prepare(run, column::options("-airflow_permeability_law diffusive -airflow_diffusivity 1 -traction "
                                        "-traction_surfaces x1 -traction_value -1,0,0 -ts_max_time 0.1 -ts_dt " +
                                        column::number(t_end / steps))));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(run.simulation().rows().size(), static_cast<std::size_t>(steps + 1));
  column::Ends ends;
  PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), ends));
  result = {ends.J0, ends.p0, 1000 * run.simulation().rows().back().volume};
}

} // namespace

TEST(TransientFiniteStrain, ClosedFormGivesTheNumbersOfTheModel)
{
  const double Jb = column::J_of_stress(T), J0 = Jb + (1 - Jb) * column::remainder(0, t_end);
  EXPECT_NEAR(Jb, 0.903516299, 1e-9);
  EXPECT_NEAR(J0, 0.99510879, 1e-8);
  EXPECT_NEAR(column::W1(J0) - T, 0.95528478, 1e-8);
}

TEST(TransientFiniteStrain, MatchesTheSeries)
{
  const double Jb = column::J_of_stress(T), area = 0.01;
  const auto J = [&](int steps) { return Jb + (1 - Jb) * column::remainder(0, t_end, steps); };
  const auto V = [&](int steps) { return area * (Jb - 1) * (1 - column::mean_remainder(t_end, steps)); };
  const int steps[3] = {10, 20, 40};
  Result r[3];
  std::printf("  steps   J(0)-BE exact   p(0)-BE exact   V/V_BE-1 | J(0)-exact   p(0)-exact   V/V_exact-1\n");
  for (int i = 0; i < 3; ++i) {
    ASSERT_NO_FATAL_FAILURE(run_column(steps[i], r[i]));
    const double J_be = J(steps[i]), p_be = column::W1(J_be) - T;
    std::printf("  %5d   %13.3e   %13.3e   %8.1e | %10.3e   %10.3e   %11.3e\n", steps[i], r[i].J0 - J_be,
                r[i].p0 - p_be, r[i].V / V(steps[i]) - 1, r[i].J0 - J(0), r[i].p0 - column::W1(J(0)) + T,
                r[i].V / V(0) - 1);
    // space error alone: backward Euler is solved in closed form too
    EXPECT_NEAR(r[i].J0, J_be, 1e-4);
    EXPECT_NEAR(r[i].p0, p_be, 1e-3);
    EXPECT_NEAR(r[i].V / V(steps[i]), 1, 1e-3);
  }
  const auto rate = [&](double Result::*v) { return std::log2((r[0].*v - r[1].*v) / (r[1].*v - r[2].*v)); };
  const auto limit = [&](double Result::*v) { return 2 * r[2].*v - r[1].*v; }; // Richardson, order 1
  std::printf("  order in dt: J(0) %.3f  p(0) %.3f  V %.3f\n", rate(&Result::J0), rate(&Result::p0), rate(&Result::V));
  std::printf("  dt -> 0: J(0) %.8f  p(0) %.8f  V %.8f (exact %.8f)\n", limit(&Result::J0), limit(&Result::p0),
              limit(&Result::V), V(0));
  for (double Result::*v : {&Result::J0, &Result::p0, &Result::V}) EXPECT_NEAR(rate(v), 1, 0.2);
  EXPECT_NEAR(limit(&Result::J0), 0.99510879, 2e-4);
  EXPECT_NEAR(limit(&Result::p0), 0.95528478, 2e-3);
  EXPECT_NEAR(limit(&Result::V), V(0), 2e-3 * std::abs(V(0)));
}
