// Terzaghi's consolidation (small load) and the undrained first step; see README.md beside this file.
#include "verification/support/column.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double load = 1e-4; ///< kPa; strains of 1e-5, so that the linear theory holds to 1e-5

struct Result {
  double p[4], s[4]; ///< base pressure over load, settlement over final settlement, at T = 0.1, 0.2, 0.5, 1
};
constexpr double times[4] = {0.1, 0.2, 0.5, 1};

/// Keeps the ends of the column after every step.
class EndsObserver final : public Observer {
public:
  explicit EndsObserver(DM dm) : dm_(dm) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    column::Ends e;
    PetscFunctionBeginUser;
    PetscCall(column::read_ends(dm_, step.local, e));
    times.push_back(step.row.time);
    ends.push_back(e);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  std::vector<double> times;
  std::vector<column::Ends> ends;

private:
  DM dm_;
};

std::string scene(double k, double dt, double t_end)
{
  return column::options("-traction -traction_surfaces x1 -traction_value " + column::number(-load) +
                         ",0,0 -airflow_permeability " + column::number(k) + " -ts_dt " + column::number(dt) +
                         " -ts_max_time " + column::number(t_end));
}

void consolidate(int steps, Result &result)
{
  // k such that c_v = k W''(1) = 1 mm^2/s: then T = t
  pulmo::Run run(Registry::standard());
  bool finished = false;
  PULMO_OK(prepare(run, scene(1 / column::W2(1), 1.0 / steps, 1)));
  EndsObserver observer(run.model().dm());
  run.simulation().add(observer);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(observer.times.size(), static_cast<std::size_t>(steps + 1));
  const double final_settlement = load / column::W2(1);
  for (int i = 0; i < 4; ++i) {
    const auto n = static_cast<std::size_t>(std::lround(times[i] * steps));
    ASSERT_NEAR(observer.times[n], times[i], 1e-9);
    result.p[i] = observer.ends[n].p0 / load;
    result.s[i] = -observer.ends[n].u1 / final_settlement;
  }
}

} // namespace

TEST(Terzaghi, SeriesGivesTheNumbersOfTheModel)
{
  const double numbers[4] = {0.94930536, 0.77231161, 0.37077743, 0.10797704};
  for (int i = 0; i < 4; ++i) EXPECT_NEAR(column::remainder(0, times[i]), numbers[i], 1e-8);
}

TEST(Terzaghi, MatchesTheSeries)
{
  const double numbers[4] = {0.94930536, 0.77231161, 0.37077743, 0.10797704};
  const int steps[3] = {20, 40, 80};
  Result r[3];
  for (int k = 0; k < 3; ++k) {
    ASSERT_NO_FATAL_FAILURE(consolidate(steps[k], r[k]));
    for (int i = 0; i < 4; ++i) {
      const int n = static_cast<int>(std::lround(times[i] * steps[k]));
      const double p = column::remainder(0, times[i], n), s = 1 - column::mean_remainder(times[i], n);
      std::printf("  dT %.4f T %.1f  p/p0 %.8f (backward Euler exact %.8f, series %.8f)  s/s_inf %.8f (%.8f, %.8f)\n",
                  1.0 / steps[k], times[i], r[k].p[i], p, numbers[i], r[k].s[i], s,
                  1 - column::mean_remainder(times[i]));
      EXPECT_NEAR(r[k].p[i], p, 1e-3);
      EXPECT_NEAR(r[k].s[i], s, 5e-4);
    }
  }
  for (int i = 0; i < 4; ++i) {
    const double order_p = std::log2((r[0].p[i] - r[1].p[i]) / (r[1].p[i] - r[2].p[i]));
    const double order_s = std::log2((r[0].s[i] - r[1].s[i]) / (r[1].s[i] - r[2].s[i]));
    const double p = 2 * r[2].p[i] - r[1].p[i], s = 2 * r[2].s[i] - r[1].s[i];
    std::printf("  T %.1f  order in dt: p %.3f s %.3f; dt -> 0: p/p0 %.6f (%.6f)  s/s_inf %.6f (%.6f)\n", times[i],
                order_p, order_s, p, numbers[i], s, 1 - column::mean_remainder(times[i]));
    EXPECT_NEAR(p, numbers[i], 3e-3);
    EXPECT_NEAR(s, 1 - column::mean_remainder(times[i]), 1e-3);
    if (times[i] >= 0.5) {
      EXPECT_NEAR(order_p, 1, 0.2);
      EXPECT_NEAR(order_s, 1, 0.2);
    }
  }
}

// The first step with dt far below h^2/(6 c_v): the layer that drains is thinner than a cell. The exact pressure of
// that step is monotone between 0 and the load; P2-P1 oscillates beside the drained end but stays bounded, however
// small the step, and does not reach the base.
TEST(Terzaghi, UndrainedFirstStepStaysBounded)
{
  const double h = 0.045, limit = h * h / 6; // c_v = 1
  for (const double share : {1e-1, 1e-2, 1e-4, 1e-6}) {
    pulmo::Run run(Registry::standard());
    bool finished = false;
    PULMO_OK(prepare(run, scene(1 / column::W2(1) * share, limit, limit)));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished);
    column::Ends e;
    double inside = 0; // largest deviation from the load further than four cells from the drained end
    PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), e));
    PULMO_OK(sample_corners(run.model().dm(), run.simulation().local_state(), [&](const Sample &s) {
      if (s.x[0] < 1 - 4 * h) inside = std::max(inside, std::abs(s.p / load - 1));
    }));
    std::printf(
        "  dt / (h^2/(6 c_v)) = %.0e: largest p/p0 %.6f, smallest %.6f, base %.9f, |p/p0 - 1| beyond 4 h %.2e\n", share,
        e.max_p / load, e.min_p / load, e.p0 / load, inside);
    EXPECT_LT(inside, 0.01);
    EXPECT_LT(e.max_p / load, 1.6);
    EXPECT_GT(e.min_p / load, -1e-9);
    EXPECT_NEAR(e.p0 / load, 1, 1e-6);
  }
}
