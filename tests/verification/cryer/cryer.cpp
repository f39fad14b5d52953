// Cryer's ball: pressed from all sides at once, drained at its surface; see README.md beside this file.
#include "pulmo/base/units.hpp"
#include "verification/support/history.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/refinement.hpp"
#include "verification/support/scene_parts.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double load = 1e-4, t_end = 0.2; ///< kPa; c_v t/a^2

/// A pressure on surface `side` that keeps the direction of the reference normal: at these strains as good as any.
class PressedSurface final : public TestEffect {
public:
  const char *name() const override { return "pressed_surface"; }
  const char *about() const override { return "normal load (verification)"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    c.surface_residual("load N", "side", displacement, f0(surface_residual<NoParameters, press>));
    return PETSC_SUCCESS;
  }

private:
  static void press(const Point &point, const NoParameters &, PetscScalar f0[])
  {
    for (int i = 0; i < 3; ++i) f0[i] += load * point.normal[i];
  }
};

/// The series for the load 1. Transform of e = div u: -sinc(y r) / (s D).
struct Series {
  explicit Series(const SmallStrain &k)
      : M(k.confined()), mu(k.shear()), modes([this](Complex y) { return M * sinc(y) - 4 * mu / 3 * mean_sinc(y); })
  {}
  Series(const Series &) = delete;
  Modes::Transform pressure(double r) const ///< p = M (e(r) - e(1))
  {
    return [this, r](Complex y) { return -M * (sinc(y * r) - sinc(y)); };
  }
  Modes::Transform dilation() const ///< mean of e
  {
    return [](Complex y) { return -mean_sinc(y); };
  }
  const double M, mu;
  const Modes modes;
};

enum class Load { surface, gas };

/// n cells along the radius, signals for the load 1. The load acts on the surface, or its opposite on the gas there.
void ball(Load kind, const SmallStrain &k, const Series &series, int n, int steps, std::vector<Signal> &signals)
{
  const Lattice lattice = Lattice::octant_of_ball(n);
  const LatticeFile mesh(lattice);
  Registry registry = Registry::standard();
  if (kind == Load::surface) registry.effect<PressedSurface>();
  pulmo::Run run(registry);
  bool finished = false;
  const std::string gas = " -lumen_pressure off -ventilator pcv -ventilator_ramp 0 -ventilator_inspiration 1 "
                          "-mesh_scale 1 -ventilator_pip " +
                          column::number(load / units::kPa_per_cmH2O);
  PULMO_OK(prepare(run, consolidation(k, mesh.path(), "side", t_end / steps, t_end) +
                            " -support -support_surfaces x0,y0,z0 -support_components_x0 x -support_components_y0 y"
                            " -support_components_z0 z" +
                            (kind == Load::gas ? gas : "")));
  // gas at +load on a free surface is the ball under -load seen from a pressure that is higher by load everywhere
  const double sign = kind == Load::gas ? -1 : 1, shift = kind == Load::gas ? load : 0;
  const double larger = lattice.map({1, 0, 0})[0];
  const auto at = [](double r) {
    return [r](const Sample &s) { return std::abs(std::hypot(s.x[0], s.x[1], s.x[2]) - r) < 1e-9; };
  };
  const auto p = [=](const Sample &s) { return sign * (s.p - shift) / load; };
  History h(run.model(), {{at(0), p}, {at(larger / 2), p}});
  run.simulation().add(h);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(h.times.size(), static_cast<std::size_t>(steps + 1));
  for (double &V : h.volume) V *= sign / load / (M_PI / 6);
  signals = {{"p(0)", h.means[0], series.pressure(0), 1, 1.3},
             {"p(a/2)", h.means[1], series.pressure(larger / 2), 1},
             {"volume", h.volume, series.dilation(), 1 / (series.M - 4 * series.mu / 3)}};
}

} // namespace

TEST(Cryer, SeriesIsTheSolution)
{
  for (const SmallStrain &k : {soft, lung}) {
    const Series s(k);
    const double nu = k.poisson(), y = s.modes.root(0), bulk = s.M - 4 * s.mu / 3;
    for (const double t : {0.005, 0.05, 0.2})
      for (const auto &N : {s.pressure(0), s.pressure(0.5), s.dilation()})
        EXPECT_NEAR(s.modes.value(N, t), s.modes.inverted(N, t), 1e-8);
    EXPECT_NEAR(s.modes.value(s.pressure(0), 1e-4), 1 + 8 * s.mu / s.M * std::sqrt(1e-4 / M_PI), 1e-3);
    EXPECT_NEAR(s.modes.value(s.dilation(), 20) * bulk, -1, 1e-12);
    // the characteristic equation as published: tan y = y / (1 - (1 - nu) y^2 / (2 (1 - 2 nu)))
    EXPECT_NEAR(std::tan(y) * (1 - (1 - nu) / (2 * (1 - 2 * nu)) * y * y) / y, 1, 1e-9);
  }
}

// Order 2 in h: that of the flat facets and of the pressure. Less at the centre, where the cells meet in a point.
TEST(Cryer, ConvergesInSpace)
{
  const auto solve = [](const SmallStrain &k, const Series &series, int n, int steps, std::vector<Signal> &signals) {
    ball(Load::surface, k, series, n, steps, signals);
  };
  converge_in_space_for_both<Series>(solve, 20, t_end, 1e-2, 2e-2);
}

// The limit is the series itself, whose pressure rises above the load.
TEST(Cryer, ConvergesInTime)
{
  const Series series(soft);
  double peak = 0, exact = 0;
  const auto solve = [&](int n, int steps, std::vector<Signal> &signals) {
    ball(Load::surface, soft, series, n, steps, signals);
    if (!signals.empty()) peak = *std::max_element(signals[0].found.begin(), signals[0].found.end());
  };
  converge_in_time(series.modes, solve, 12, 40, t_end, {0.05, 0.2}, 1.5e-2);
  for (double t = 0.005; t < 0.2; t += 0.001) exact = std::max(exact, series.modes.value(series.pressure(0), t));
  std::printf("  largest p(0): %.5f of the load (series %.5f)\n", peak, exact);
  EXPECT_GT(exact, 1.2);
  EXPECT_NEAR(peak, exact, 0.02);
}

// The same ball with the pressure of the gas at its surface held by the ventilator.
TEST(Cryer, GasAtTheSurfaceIsALoad)
{
  const Series series(soft);
  std::vector<Signal> loaded, ventilated;
  ASSERT_NO_FATAL_FAILURE(ball(Load::surface, soft, series, 4, 10, loaded));
  ASSERT_NO_FATAL_FAILURE(ball(Load::gas, soft, series, 4, 10, ventilated));
  for (std::size_t q = 0; q < loaded.size(); ++q)
    for (std::size_t i = 1; i < loaded[q].found.size(); ++i)
      EXPECT_NEAR(ventilated[q].found[i] / loaded[q].scale, loaded[q].found[i] / loaded[q].scale, 2e-4)
          << loaded[q].name << " after step " << i;
}
