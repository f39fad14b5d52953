// Mass of the tissue: a bar that swings, and one that falls; see README.md beside this file.
#include "verification/support/column.hpp"
#include "verification/support/history.hpp"
#include "verification/support/integrators.hpp"
#include "verification/support/lattice.hpp"

#include "pulmo/observers/energy.hpp"

#include <algorithm>
#include <complex>

using namespace pulmo;
using namespace pulmo::test;

namespace {

// a bar of lung, SI units
constexpr double length = 0.1, porosity = 0.75, tissue = 1050, air = 1.2; // m, -, kg/m^3
constexpr double density = (1 - porosity) * tissue + porosity * air;
constexpr double area = length * length / 100; // m^2
const double modulus = 1000 * column::W2(1);   // Pa
constexpr double load = 1e-4;                  // kPa, 1e-5 of the modulus
constexpr int modes = 4000;

double frequency(int m)
{
  return std::sqrt(modulus / density) * (2 * m + 1) * M_PI / 2 / length;
}
/// Displacement of the end per unit of a mode's modal displacement that a unit of load holds at rest, m/Pa.
double share(int m)
{
  const double k = (2 * m + 1) * M_PI / 2 / length;
  return 2 / (length * modulus * k * k);
}

/// The column in 16 bricks, with column.msh's names.
const LatticeFile &bar()
{
  static const LatticeFile file = [] {
    Lattice bricks = Lattice::box({16, 1, 1}, {1, 0.1, 0.1});
    bricks.name = [](const Lattice::Place &x) {
      const std::string face = Lattice::face_of_box(x);
      return face[0] == 'x' ? face : std::string("sides_") + face[0];
    };
    return LatticeFile(bricks);
  }();
  return file;
}

const std::string swinging =
    " -airflow off -mesh_scale 100 -tissue_porosity 0.75 -inertia -inertia_tissue_density 1050 -inertia_air_density 1.2"
    " -traction -traction_surfaces x1 ";

/// y_n of y' = i omega y, y_0 = 1, as @p integrator makes it with steps of @p h.
std::vector<std::complex<double>> swing(const Integrator &integrator, double omega, double h, int steps)
{
  using complex = std::complex<double>;
  const complex z(0, omega * h);
  std::vector<complex> y{1};
  if (integrator.order == 1) {
    for (int n = 1; n <= steps; ++n) y.push_back(y.back() / (1. - z));
    return y;
  }
  const complex middle = 1. / (1. - z / 2.); // BDF2 begins with half a step of backward Euler
  y.push_back((2. * middle - 0.5) / (1.5 - z / 2.));
  for (int n = 2; n <= steps; ++n) y.push_back((2. * y[n - 1] - 0.5 * y[n - 2]) / (1.5 - z));
  return y;
}

/// A run with its change of volume (m^3) and energy at each row.
struct Swing {
  std::vector<double> displacement, kinetic; ///< of the end, m; J
  double unbalanced = 0;                     ///< share of the work

  void run(const std::string &options)
  {
    const Registry registry = Registry::standard();
    pulmo::Run run(registry);
    Sampling sampling;
    EnergyAudit energy(run.scene(), run.model(), sampling);
    bool finished = false;
    PULMO_OK(prepare(run, column::options(swinging + options) + " -dm_plex_filename " + bar().path()));
    PULMO_OK(sampling.setup(run.model()));
    PULMO_OK(energy.setup());
    run.simulation().add(energy);
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    std::size_t account = 0;
    while (energy.accounts()[account].name != "kinetic") ++account;
    for (const SignalRow &row : run.simulation().rows()) displacement.push_back(1e-6 * row.volume / area);
    for (const EnergyBalance &row : energy.rows()) kinetic.push_back(row.accounts[account]);
    unbalanced = energy.worst_residual() / std::abs(energy.rows().back().exchanged);
  }
};

std::string step_options(double end, int steps)
{
  return " -ts_max_time " + column::number(end) + " -ts_dt " + column::number(end / steps);
}

} // namespace

TEST(Inertia, SwingsAndFadesAsEachSchemeMust)
{
  constexpr int steps = 50;
  const double end = 2 * M_PI / frequency(0), h = end / steps; // a period
  ASSERT_NEAR(frequency(0) / (2 * M_PI), 14.7, 0.1);
  for (const Integrator &integrator : integrators) {
    std::vector<double> expected(steps + 1, 0), kinetic(steps + 1, 0);
    for (int m = 0; m < modes; ++m) {
      const auto y = swing(integrator, frequency(m), h, steps);
      const double amplitude = 1000 * load * share(m);
      for (int n = 0; n <= steps; ++n) {
        expected[n] += amplitude * (1 - y[n].real());
        const double velocity = amplitude * frequency(m) * y[n].imag(); // at the end; int sin^2 = L / 2
        kinetic[n] += density * area * length / 4 * velocity * velocity;
      }
    }
    Swing got;
    ASSERT_NO_FATAL_FAILURE(
        got.run("-traction_value " + column::number(load) + ",0,0" + step_options(end, steps) + integrator.options));
    ASSERT_EQ(got.displacement.size(), expected.size());
    const double still = 1000 * load * length / modulus, stored = 1000 * load * area * still / 2;
    double apart = 0, energy_apart = 0;
    for (int n = 0; n <= steps; ++n) {
      apart = std::max(apart, std::abs(got.displacement[n] - expected[n]) / still);
      energy_apart = std::max(energy_apart, std::abs(got.kinetic[n] - kinetic[n]) / stored);
    }
    std::printf("  %s: u apart by %.2e, kinetic energy by %.2e; u after a period %.4f\n", integrator.name, apart,
                energy_apart, expected.back() / still);
    EXPECT_LT(apart, 1e-3) << integrator.name;
    if (integrator.order == 1) { // kinetic energy is followed with backward Euler alone
      EXPECT_LT(energy_apart, 1e-3);
    }
  }
}

TEST(Inertia, KeepsAccountsAtLargeStrain)
{
  constexpr int steps = 30;
  Swing far; // 1 kPa: 11 % at rest, some 20 % at the turn
  ASSERT_NO_FATAL_FAILURE(far.run("-traction_value 1,0,0" + step_options(2 * M_PI / frequency(0), steps)));
  EXPECT_GT(*std::max_element(far.kinetic.begin(), far.kinetic.end()), 1e-3 * area * length * modulus);
  EXPECT_LT(far.unbalanced, 1e-10);
}

TEST(Inertia, OrderInTime)
{
  const double end = 2 * M_PI / frequency(0), W = 1.5 * frequency(0); // rad/s
  double expected = 0;
  for (int m = 0; m < modes; ++m) {
    const double w = frequency(m);
    expected += 1000 * load / 2 * share(m) *
                (1 - std::cos(w * end) - w * w / (w * w - W * W) * (std::cos(W * end) - std::cos(w * end)));
  }
  const std::string pull =
      "-traction_value \"" + column::number(load / 2) + "*(1-cos(" + column::number(W) + "*t)),0,0\"";
  const double still = 1000 * load * length / modulus;
  for (const Integrator &integrator : integrators) {
    double error[2];
    for (int k = 0; k < 2; ++k) {
      Swing got;
      ASSERT_NO_FATAL_FAILURE(got.run(pull + step_options(end, 30 << k) + integrator.options));
      ASSERT_EQ(got.displacement.size(), static_cast<std::size_t>(1 + (30 << k)));
      error[k] = (got.displacement.back() - expected) / still;
      std::printf("  %s, %d steps: error %.3e of %.4f\n", integrator.name, 30 << k, error[k], expected / still);
    }
    EXPECT_NEAR(std::log2(error[0] / error[1]), integrator.order, 0.15 * integrator.order) << integrator.name;
  }
}

TEST(Inertia, FallsAsItsWeightSays)
{
  constexpr double g = 0.5, dt = 0.4, pull = 2; // mm/s^2, s, kPa
  constexpr int steps = 50;
  const std::string fall =
      "-options_file " + source("petsc_options/solvers/tight.opts") + " -snes_atol 1e-10 -dm_plex_filename " +
      bar().path() +
      " -tissue yoshihara -airflow off -support -support_surfaces sides_y,sides_z -support_components_sides_y y"
      " -support_components_sides_z z -tissue_porosity 0.5 -inertia -inertia_tissue_density 1e9"
      " -inertia_air_density 1e9 -gravity -gravity_direction 1,0,0 -gravity_acceleration 0.0005"
      " -gravity_tissue_density 1e9 -gravity_air_density 1e9 -traction -traction_surfaces x0,x1"
      " -traction_value_x0 -2,0,0 -traction_value_x1 2,0,0" +
      step_options(dt * steps, steps);
  for (const Integrator &integrator : integrators) {
    const Registry registry = Registry::standard();
    pulmo::Run run(registry);
    bool finished = false;
    PULMO_OK(prepare(run, fall + integrator.options));
    History history(run.model(),
                    {{[](const Sample &s) { return s.x[0] < 1e-9; }, [](const Sample &s) { return s.u[0]; }},
                     {[](const Sample &s) { return s.x[0] > 1 - 1e-9; }, [](const Sample &s) { return s.u[0]; }}});
    run.simulation().add(history);
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    const auto &u0 = history.means[0], &u1 = history.means[1];
    ASSERT_EQ(u0.size(), static_cast<std::size_t>(steps + 1));
    // the waves of the pull have faded: J is that of the pull, and all falls with g
    EXPECT_NEAR(1 + u1.back() - u0.back(), column::J_of_stress(pull), 1e-6) << integrator.name;
    for (int n = steps - 3; n <= steps; ++n)
      EXPECT_NEAR((u0[n] - 2 * u0[n - 1] + u0[n - 2]) / (dt * dt), g, 1e-4 * g) << integrator.name;
  }
}

TEST(Inertia, NothingRestsOnMass)
{
  const std::string cube = "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
                           " -mesh_scale 1 -pc_type lu -airflow off -tissue yoshihara -inertia -lumen_pressure off";
  const auto refused = [&](const std::string &more) {
    const Registry registry = Registry::standard();
    pulmo::Run run(registry);
    PetscErrorCode code = prepare(run, cube + more);
    if (code == 0) code = check_held(PETSC_COMM_WORLD, run.scene(), run.model().composition());
    return static_cast<int>(code);
  };
  EXPECT_EQ(refused(""), static_cast<int>(PETSC_ERR_USER_INPUT));
  EXPECT_EQ(refused(" -support -support_rigid"), 0);
  EXPECT_EQ(refused(" -support -support_rigid -gravity"), 0);
  EXPECT_EQ(refused(" -support -support_rigid -gravity -gravity_tissue_density 1000"),
            static_cast<int>(PETSC_ERR_USER_INPUT));
  const Registry registry = Registry::standard();
  pulmo::Run run(registry);
  PULMO_OK(prepare(run, cube + " -support -support_rigid"));
  EXPECT_TRUE(run.model().composition().bearing_surfaces().empty());
}
