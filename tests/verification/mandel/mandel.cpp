// Mandel's slab between rigid plates; see README.md beside this file.
//
//             F, uniform u_z                 plane strain (y0, y1 on rollers), quarter of the slab
//      ==========================  z1        plates smooth, sealed
//   |> |                        |
//   |> |        CM4             |  x1: free, p = 0
//   |> |                        |
//      ==========================  z0 on rollers
//     x0                      x = a = 1 mm
#include "verification/support/history.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/refinement.hpp"
#include "verification/support/scene_parts.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double height = 0.25, stress = 1e-4, t_end = 0.5; ///< half of it, mm; F/a, kPa; c_v t/a^2

/// The series, for the mean stress -1 of the plates. Transform of e = div u: A cos(y x), D A = -1/s.
struct Series {
  explicit Series(const SmallStrain &k)
      : M(k.confined()), mu(k.shear()), modes([this](Complex y) { return 2 * M * std::cos(y) - 2 * mu * sinc(y); })
  {}
  Series(const Series &) = delete;
  Modes::Transform pressure(double x) const ///< p = M (e(x) - e(1)), kPa
  {
    return [this, x](Complex y) { return -M * (std::cos(y * x) - std::cos(y)); };
  }
  Modes::Transform plate() const ///< u_z/z = M e(1)/(2 mu)
  {
    return [this](Complex y) { return -M / (2 * mu) * std::cos(y); };
  }
  Modes::Transform side() const ///< u_x(1) = mean of e - u_z/z, mm
  {
    return [this](Complex y) { return -sinc(y) + M / (2 * mu) * std::cos(y); };
  }
  const double M, mu;
  const Modes modes;
};

constexpr double x_middle = 0.5;
enum { centre, middle, plate_u, side_u };

/// Runs with the plate at @p plate(step) mm.
void press(const SmallStrain &k, const LatticeFile &mesh, int steps, const std::function<double(int)> &plate,
           std::unique_ptr<History> &history)
{
  const double dt = t_end / steps;
  Registry registry = Registry::standard();
  add_essential(
      registry, displacement, "z1",
      [&](PetscReal t, const PetscReal[3], PetscScalar u[3]) { u[2] = plate(static_cast<int>(std::lround(t / dt))); },
      "z");
  pulmo::Run run(registry);
  bool finished = false;
  PULMO_OK(prepare(run, consolidation(k, mesh.path(), "x1", dt, t_end) +
                            " -support -support_surfaces x0,y0,y1,z0 -support_components_x0 x -support_components_y0 y"
                            " -support_components_y1 y -support_components_z0 z"));
  const auto at = [](int d, double x) { return [=](const Sample &s) { return std::abs(s.x[d] - x) < 1e-9; }; };
  const auto p = [](const Sample &s) { return s.p / stress; };
  history = std::make_unique<History>(
      run.model(),
      std::vector<History::Quantity>{{at(0, 0), p},
                                     {at(0, x_middle), p},
                                     {at(2, height), [](const Sample &s) { return s.u[2] / height / stress; }},
                                     {at(0, 1), [](const Sample &s) { return s.u[0] / stress; }}},
      "prescribed on z1");
  run.simulation().add(*history);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(history->times.size(), static_cast<std::size_t>(steps + 1));
}

/// The slab with n cells across under a constant force, for the stress 1 of the plates.
void slab(const SmallStrain &k, const Series &series, int n, int steps, std::vector<Signal> &signals)
{
  const LatticeFile mesh(Lattice::box({n, 1, n / 4}, {1, 1.0 / n, height}));
  const double force = -stress / n; // on the depth of one cell
  // a plate moved at once and held: its force is the response of which every other one is made
  const double moved = -1e-5 * height;
  std::unique_ptr<History> h;
  ASSERT_NO_FATAL_FAILURE(press(
      k, mesh, steps, [&](int) { return moved; }, h));
  std::vector<double> plate{0};
  for (int i = 1; i <= steps; ++i) {
    double known = 0;
    for (int j = 1; j < i; ++j) known += h->force[i - j + 1][2] * (plate[j] - plate[j - 1]);
    plate.push_back(plate.back() + (force * moved - known) / h->force[1][2]);
  }
  // so it moves under the force
  ASSERT_NO_FATAL_FAILURE(press(
      k, mesh, steps, [&](int i) { return plate[i]; }, h));
  for (int i = 1; i <= steps; ++i)
    EXPECT_NEAR(h->force[i][2] / force, 1, 1e-4) << "the plate does not carry the load in step " << i;
  const double undrained = 1 / (4 * k.shear()); // strain
  signals = {{"p(0)", h->means[centre], series.pressure(0), 0.5},
             {"p(a/2)", h->means[middle], series.pressure(x_middle), 0.5},
             {"u_z", h->means[plate_u], series.plate(), undrained},
             {"u_x(a)", h->means[side_u], series.side(), undrained}};
}

} // namespace

// The series against its numerical Laplace inversion, the undrained and the drained slab.
TEST(Mandel, SeriesIsTheSolution)
{
  for (const SmallStrain &k : {soft, lung}) {
    const Series s(k);
    const double nu = k.poisson(), mu = k.shear();
    for (const double t : {0.01, 0.05, 0.2, 0.5})
      for (const auto &N : {s.pressure(0), s.pressure(x_middle), s.plate(), s.side()})
        EXPECT_NEAR(s.modes.value(N, t), s.modes.inverted(N, t), 1e-8);
    // p0 = F/2a, and the rise at first
    EXPECT_NEAR(s.modes.value(s.pressure(0), 1e-3), 0.5 * (1 + std::sqrt(1e-3 / M_PI) * (1 - 2 * nu) / (1 - nu)), 2e-4);
    EXPECT_NEAR(s.modes.value(s.pressure(0), 20), 0, 1e-12);
    EXPECT_NEAR(s.modes.value(s.plate(), 20), -(1 - nu) / (2 * mu), 1e-12); // plane strain
    EXPECT_NEAR(s.modes.value(s.side(), 20), nu / (2 * mu), 1e-12);
    // the characteristic equation as published: tan y / y = (1 - nu)/(nu_u - nu), nu_u = 1/2
    EXPECT_NEAR(std::tan(s.modes.root(0)) / s.modes.root(0) * (0.5 - nu) / (1 - nu), 1, 1e-9);
  }
}

// Order 2 in h: that of the pressure, which loads the momentum balance.
TEST(Mandel, ConvergesInSpace)
{
  converge_in_space_for_both<Series>(slab, 50, t_end, 1.6e-3, 6e-3);
}

// Backward Euler has order 1; the limit is the series itself, whose pressure rises above its first value.
TEST(Mandel, ConvergesInTime)
{
  const Series series(soft);
  double peak = 0, exact = 0;
  const auto solve = [&](int n, int steps, std::vector<Signal> &signals) {
    slab(soft, series, n, steps, signals);
    if (!signals.empty()) peak = *std::max_element(signals[0].found.begin(), signals[0].found.end());
  };
  converge_in_time(series.modes, solve, 8, 50, t_end, {0.1, 0.5}, 6e-3);
  for (double t = 0.005; t < 0.2; t += 0.001) exact = std::max(exact, series.modes.value(series.pressure(0), t));
  std::printf("  largest p(0): %.5f of the first (series %.5f)\n", peak / 0.5, exact / 0.5);
  EXPECT_GT(exact / 0.5, 1.1);
  EXPECT_NEAR(peak / 0.5, exact / 0.5, 0.01);
}
