// Order in time of a finite strain that starts smoothly from rest; see README.md beside this file.
#include "verification/support/column.hpp"
#include "verification/support/integrators.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/scene_parts.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double swing = 0.2, omega = M_PI, t_end = 0.8, area = 1. / 256;

/// J at the open end: 1 + swing (1 - cos omega t).
double J_open(double t)
{
  return 1 + swing * (1 - std::cos(omega * t));
}

/// J_t = J_XX, J = 1 at first, J_X(0) = 0, J(1) = J_open, mode by mode: J = J_open + sum q_m cos((2m+1) pi X/2) with
/// q_m' = -lambda_m q_m - b_m J_open', the modes of a constant being b_m = (4/pi) (-1)^m/(2m+1).
struct Exact {
  double J0 = 0, mean = 0; ///< J at X = 0, mean of J - 1
  explicit Exact(double t) : J0(J_open(t)), mean(J_open(t) - 1)
  {
    for (int m = 0; m < 2000; ++m) {
      const double root = (2 * m + 1) * M_PI / 2, lambda = root * root, sign = m % 2 ? -1 : 1;
      const double q = -2 * sign / root * swing * omega *
                       (lambda * std::sin(omega * t) - omega * std::cos(omega * t) + omega * std::exp(-lambda * t)) /
                       (lambda * lambda + omega * omega);
      J0 += q;
      mean += q * sign / root;
    }
  }
};

/// J(0) and p(0) at the sealed end, change of volume over the volume.
struct Result {
  double value[3];
};
constexpr const char *names[3] = {"J(0)", "p(0)", "V"};

void breathe(const Integrator &integrator, const LatticeFile &mesh, int steps, Result &result)
{
  Registry registry = Registry::standard();
  registry.permeability_law<column::DiffusivePermeability>();
  add_essential(registry, pressure, "x1",
                [](PetscReal t, const PetscReal[3], PetscScalar v[3]) { v[0] = column::W1(J_open(t)); });
  pulmo::Run run(registry);
  bool finished = false;
  PULMO_OK(
      prepare(run, column::options("-airflow_permeability_law diffusive -airflow_diffusivity 1 -dm_plex_filename " +
                                   mesh.path() + " -ts_max_time " + column::number(t_end) + " -ts_dt " +
                                   column::number(t_end / steps) + integrator.options)));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  ASSERT_EQ(run.simulation().rows().size(), static_cast<std::size_t>(steps + 1)); // no step was cut
  column::Ends ends;
  PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), ends));
  result = {{ends.J0, ends.p0, 1000 * run.simulation().rows().back().volume / area}};
}

} // namespace

TEST(TimeOrder, ClosedFormSolvesTheProblem)
{
  EXPECT_NEAR(Exact(1e-9).J0, 1, 1e-6);
  // against Crank-Nicolson with second-order differences (Thomas' elimination)
  constexpr int cells = 200, steps = 8000;
  std::vector<double> J(cells + 1, 1), d(cells + 1), r(cells + 1);
  const double h = 1.0 / cells, k = t_end / steps / 2 / (h * h);
  for (int n = 1; n <= steps; ++n) {
    for (int i = 0; i < cells; ++i) {
      const double left = i == 0 ? J[1] : J[i - 1];
      r[i] = J[i] + k * (left - 2 * J[i] + J[i + 1]);
    }
    r[cells] = J_open(n * t_end / steps);
    d[0] = 1 + 2 * k;
    double upper = -2 * k;
    for (int i = 1; i < cells; ++i) {
      const double f = -k / d[i - 1];
      d[i] = 1 + 2 * k - f * upper;
      r[i] -= f * r[i - 1];
      upper = -k;
    }
    J[cells] = r[cells];
    for (int i = cells - 1; i >= 0; --i) J[i] = (r[i] + (i == 0 ? 2 : 1) * k * J[i + 1]) / d[i];
  }
  double mean = -1;
  for (int i = 0; i <= cells; ++i) mean += h * J[i] * (i == 0 || i == cells ? 0.5 : 1);
  EXPECT_NEAR(Exact(t_end).J0, J[0], 2e-5);
  EXPECT_NEAR(Exact(t_end).mean, mean, 2e-5);
}

TEST(TimeOrder, OfEachIntegrator)
{
  Lattice column_of_bricks = Lattice::box({16, 1, 1}, {1, 1. / 16, 1. / 16});
  column_of_bricks.name = [](const Lattice::Place &x) {
    const std::string face = Lattice::face_of_box(x);
    return face[0] == 'x' ? face : "sides_" + face.substr(0, 1);
  };
  const LatticeFile mesh(column_of_bricks);
  const Exact exact(t_end);
  const double expected[3] = {exact.J0, column::W1(exact.J0), exact.mean};
  for (const Integrator &integrator : integrators) {
    const int steps[5] = {8, 16, 32, 64, 128};
    Result r[5];
    for (int i = 0; i < 5; ++i) ASSERT_NO_FATAL_FAILURE(breathe(integrator, mesh, steps[i], r[i]));
    for (int q = 0; q < 3; ++q) {
      std::printf("  %s, %-4s exact %.8f, error", integrator.name, names[q], expected[q]);
      double order = 0;
      for (int i = 0; i < 5; ++i) {
        std::printf(" %.2e", r[i].value[q] - expected[q]);
        if (i < 2) continue;
        order = std::log2((r[i - 2].value[q] - r[i - 1].value[q]) / (r[i - 1].value[q] - r[i].value[q]));
        std::printf(" (%.3f)", order);
      }
      const double weight = 1 / (std::pow(2, integrator.order) - 1);
      const double limit = r[4].value[q] + weight * (r[4].value[q] - r[3].value[q]);
      std::printf(", dt -> 0 %.2e\n", limit - expected[q]);
      EXPECT_NEAR(order, integrator.order, 0.05 * integrator.order);
      EXPECT_NEAR(limit, expected[q], 1e-3 * std::abs(expected[q]));
    }
  }
}
