// Unconfined compression of a cylinder between rigid, smooth, sealed plates; see README.md beside this file.
#include "verification/support/history.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/refinement.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double strain = -1e-5, t_end = 0.3; ///< axial, at once and held; c_v t/a^2

/// The series for a unit axial strain. Transform of e = div u: mu J0(y r) / (s D).
struct Series {
  explicit Series(const SmallStrain &k) : M(k.confined()), mu(k.shear()), modes([this](Complex y) { return D(y); }) {}
  Series(const Series &) = delete;
  Complex D(Complex y) const { return M * bessel(0, y) - 2 * mu * bessel(1, y); }
  Modes::Transform pressure(double r) const ///< p = M (e(r) - e(1)), kPa
  {
    return [this, r](Complex y) { return mu * M * (bessel(0, y * r) - bessel(0, y)); };
  }
  Modes::Transform dilation() const ///< mean of e
  {
    return [this](Complex y) { return mu * 2. * bessel(1, y); };
  }
  Modes::Transform side() const ///< u_r(1) = (mean of e - 1)/2, mm; 1 is D/D
  {
    return [this](Complex y) { return (dilation()(y) - D(y)) / 2.; };
  }
  Modes::Transform stress() const ///< mean axial stress mu (3 - mean of e), kPa
  {
    return [this](Complex y) { return mu * (3. * D(y) - dilation()(y)); };
  }
  const double M, mu;
  const Modes modes;
};

enum { centre, middle, side };

/// n cells along the radius, signals for the axial strain 1.
void cylinder(const SmallStrain &k, const Series &series, int n, int steps, std::vector<Signal> &signals)
{
  const double height = 1.0 / n;
  const LatticeFile mesh(Lattice::quarter_cylinder(n, 1, height));
  pulmo::Run run(Registry::standard());
  bool finished = false;
  PULMO_OK(prepare(run, consolidation(k, mesh.path(), "side", t_end / steps, t_end) +
                            " -support -support_surfaces x0,y0,z0,z1 -support_components_x0 x -support_components_y0 y"
                            " -support_components_z0 z -support_components_z1 z -support_displacement_z1 0,0," +
                            column::number(strain * height)));
  const auto at = [](double r) {
    return [r](const Sample &s) { return std::abs(std::hypot(s.x[0], s.x[1]) - r) < 1e-9; };
  };
  const double larger = Lattice::quarter_cylinder(n, 1, height).map({1, 0, 0})[0];
  const auto p = [](const Sample &s) { return s.p / strain; };
  History h(
      run.model(),
      {{at(0), p},
       {at(larger / 2), p},
       {at(larger),
        [](const Sample &s) { return (s.u[0] * s.x[0] + s.u[1] * s.x[1]) / std::hypot(s.x[0], s.x[1]) / strain; }}},
      "u on z1");
  run.simulation().add(h);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  ASSERT_EQ(h.times.size(), static_cast<std::size_t>(steps + 1));
  std::vector<double> force;
  for (const auto &f : h.force) force.push_back(f[2] / strain / (M_PI / 4));
  signals = {{"p(0)", h.means[centre], series.pressure(0), series.mu},
             {"p(a/2)", h.means[middle], series.pressure(larger / 2), series.mu},
             {"u_r(a)", h.means[side], series.side(), 0.5},
             {"force", force, series.stress(), 3 * series.mu}};
}

} // namespace

TEST(Armstrong, SeriesIsTheSolution)
{
  for (const SmallStrain &k : {soft, lung}) {
    const Series s(k);
    const double nu = k.poisson();
    for (const double t : {0.01, 0.05, 0.2})
      for (const auto &N : {s.pressure(0), s.pressure(0.5), s.side(), s.stress()})
        EXPECT_NEAR(s.modes.value(N, t), s.modes.inverted(N, t), 1e-8 * s.mu);
    EXPECT_NEAR(s.modes.value(s.side(), 20), -nu, 1e-12);
    EXPECT_NEAR(s.modes.value(s.stress(), 20) / k.young(), 1, 1e-12);
    EXPECT_NEAR(s.modes.value(s.dilation(), 1e-5), 0, 0.01);          // undrained: no change of volume,
    EXPECT_NEAR(s.modes.value(s.pressure(0), 1e-4) / s.mu, -1, 0.02); // p = mu strain
    // the characteristic equation as published: J1(y) = (1 - nu)/(1 - 2 nu) y J0(y)
    const double y = s.modes.root(0);
    EXPECT_NEAR(std::cyl_bessel_j(1, y), (1 - nu) / (1 - 2 * nu) * y * std::cyl_bessel_j(0, y), 1e-9);
    for (const double z : {3.0, 11.9, 12.1, 40.0}) {
      EXPECT_NEAR(bessel(0, z).real(), std::cyl_bessel_j(0, z), 1e-9);
      EXPECT_NEAR(bessel(1, z).real() * z, std::cyl_bessel_j(1, z), 1e-9);
    }
  }
}

// Order 2 in h: that of the flat facets and of the pressure.
TEST(Armstrong, ConvergesInSpace)
{
  converge_in_space_for_both<Series>(cylinder, 40, t_end, 4e-3, 1.3e-2);
}

TEST(Armstrong, ConvergesInTime)
{
  const Series series(soft);
  const auto solve = [&](int n, int steps, std::vector<Signal> &signals) { cylinder(soft, series, n, steps, signals); };
  converge_in_time(series.modes, solve, 8, 60, t_end, {0.1, 0.3}, 1e-2);
}
