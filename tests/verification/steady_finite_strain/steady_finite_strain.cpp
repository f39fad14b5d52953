// Steady flow through a column that swells on the upstream side; see README.md beside this file.
#include "verification/support/column.hpp"
#include "verification/support/scene_parts.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double p_in = 0.5, length = 1, area = 0.01;

/// G(J) = int (k/J) W'' dJ with k = 1: linear in X.
double G(double J)
{
  using namespace column;
  return 2 * c * (std::log(J) - (2 * beta + 1) / (2 * beta + 2) * std::pow(J, -2 * beta - 2));
}
double J0()
{
  return column::J_of_stress(p_in);
}
double flux()
{
  return (G(J0()) - G(1)) / length;
}
double J_at(double X)
{
  const double target = G(J0()) - flux() * X;
  double J = 1;
  for (int i = 0; i < 60; ++i) J -= (G(J) - target) * J / column::W2(J);
  return J;
}
/// u(X) = int_0^X (J - 1), Simpson with 64 intervals.
double u_at(double X)
{
  const int n = 64;
  double s = 0;
  for (int i = 0; i <= n; ++i) s += (i == 0 || i == n ? 1 : i % 2 ? 4 : 2) * (J_at(X * i / n) - 1);
  return s * X / n / 3;
}

} // namespace

TEST(SteadyFiniteStrain, ClosedFormGivesTheNumbersOfTheModel)
{
  EXPECT_NEAR(J0(), 1.0590286044, 1e-10);
  EXPECT_NEAR(flux(), 0.4861222626, 1e-10);
  EXPECT_NEAR(u_at(length), 0.02854783, 1e-8);
}

TEST(SteadyFiniteStrain, MatchesTheClosedForm)
{
  Registry registry = Registry::standard();
  add_essential(registry, pressure, "x0", [](PetscReal, const PetscReal[3], PetscScalar v[3]) { v[0] = p_in; });
  pulmo::Run run(registry);
  bool finished = false;
  // one step, so long that what the tissue still takes up is 1e-9 of the flux
  PULMO_OK(prepare(run, column::options("-airflow_permeability 1 -ts_dt 1e8 -ts_max_time 1e8")));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(run.simulation().rows().size(), 2u);

  const double out = -1000 * run.simulation().rows().back().flow / area; // leaves at x1
  double worst_u = 0, worst_p = 0, worst_J = 0, lateral = 0;
  PULMO_OK(sample_corners(run.model().dm(), run.simulation().local_state(), [&](const Sample &s) {
    const double J = J_at(s.x[0]);
    worst_u = std::max(worst_u, std::abs(s.u[0] - u_at(s.x[0])));
    worst_p = std::max(worst_p, std::abs(s.p - column::W1(J)));
    worst_J = std::max(worst_J, std::abs(s.J() - J));
    lateral = std::max({lateral, std::abs(s.u[1]), std::abs(s.u[2])});
  }));
  column::Ends ends;
  PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), ends));
  const double V = 1000 * run.simulation().rows().back().volume;
  std::printf("  Q %.10f (exact %.10f)  u(L) %.8f (%.8f)  J(0) %.8f (%.8f)\n", out, flux(), ends.u1, u_at(1), ends.J0,
              J0());
  std::printf("  largest error at any vertex: u %.2e mm  p %.2e kPa  J %.2e  lateral u %.2e mm\n", worst_u, worst_p,
              worst_J, lateral);
  EXPECT_NEAR(out, 0.4861222626, 1e-5);
  EXPECT_NEAR(ends.u1, 0.02854783, 1e-6);
  EXPECT_NEAR(ends.J0, 1.0590286044, 1e-4);
  EXPECT_NEAR(V, area * u_at(1), 1e-4 * area * u_at(1));
  EXPECT_LT(worst_u, 1e-5);
  EXPECT_LT(worst_p, 1e-3);
  EXPECT_LT(worst_J, 1e-3);
  EXPECT_LT(lateral, 1e-4);
}
