// A rate in the momentum balance, in each time scheme; see README.md beside this file.
#include "support/scene.hpp"
#include "verification/support/integrators.hpp"
#include "verification/support/scene_parts.hpp"

#include <array>
#include <cmath>

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double eta = 0.9, T0 = 0.6, t_end = 0.8; // kPa s, kPa, s

double load(double t)
{
  const double s = std::sin(M_PI * t / 2);
  return T0 * s * s;
}

struct DashpotKernels {
  struct Parameters {
    static constexpr const char *owner = "test_dashpot";
    PetscScalar eta;
  };
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    for (int i = 0; i < 9; ++i) f1[i] += k.eta * point.state.H_rate[i];
  }
  static void stress_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) g3[27 * i + 9 * i + 3 * J + J] += k.eta * point.shift;
  }
  static void pull(const Point &point, const Parameters &, PetscScalar f0[])
  {
    for (int i = 0; i < 3; ++i) f0[i] -= load(point.t) * point.normal[i];
  }
  /// Heat in a step: P : dF.
  static PetscScalar heat(const Point &now, const Point &before, const Parameters &k)
  {
    PetscScalar sum = 0;
    for (int i = 0; i < 9; ++i) sum += k.eta * now.state.H_rate[i] * (now.state.H[i] - before.state.H[i]);
    return sum;
  }
};

class Dashpot final : public TestEffect {
public:
  const char *name() const override { return "test_dashpot"; }
  const char *about() const override { return "dashpot beside the tissue, and a pull (verification)"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = DashpotKernels;
    using P = K::Parameters;
    c.parameters(parameters_);
    c.residual("eta Grad u_t : Grad w", displacement, f1(volume_residual<P, K::stress>));
    c.jacobian("dashpot", displacement, displacement, g3(volume_jacobian<P, K::stress_by_displacement>));
    c.surface_residual("-T . w", "x1", displacement, f0(surface_residual<P, K::pull>));
    c.energy(Energy::dissipated, "dashpot", "", energy_density<P, K::heat>);
    return PETSC_SUCCESS;
  }

private:
  DashpotKernels::Parameters parameters_{eta};
};

Registry registry()
{
  Registry r = Registry::standard();
  r.effect<Dashpot>();
  return r;
}

std::string options(const std::string &more)
{
  return "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
         " -mesh_scale 1 -pc_type lu -tissue yoshihara -airflow off -snes_atol 1e-12 -snes_rtol 1e-12 -support"
         " -support_surfaces x0,y0,z0 -support_components_x0 x -support_components_y0 y -support_components_z0 z"
         " -ts_max_time 0.8 " +
         more;
}

/// Stretches a, b at the end by Runge-Kutta, with the stress of @p law.
std::array<double, 2> exact(const TissueLaw &law)
{
  const auto rate = [&](double t, const std::array<double, 2> &y) {
    const PetscScalar H[9] = {y[0] - 1, 0, 0, 0, y[1] - 1, 0, 0, 0, y[1] - 1};
    PointState s;
    PetscScalar P[9];
    make_point_state(H, nullptr, s);
    law.stress(s, P);
    return std::array<double, 2>{(load(t) - P[0]) / eta, -P[4] / eta};
  };
  std::array<double, 2> y{1, 1};
  constexpr int steps = 800;
  constexpr double h = t_end / steps;
  const auto moved = [&](double f, const std::array<double, 2> &k) {
    return std::array<double, 2>{y[0] + f * k[0], y[1] + f * k[1]};
  };
  for (int n = 0; n < steps; ++n) {
    const double t = n * h;
    const auto k1 = rate(t, y), k2 = rate(t + h / 2, moved(h / 2, k1)), k3 = rate(t + h / 2, moved(h / 2, k2)),
               k4 = rate(t + h, moved(h, k3));
    for (int i = 0; i < 2; ++i) y[i] += h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
  }
  return y;
}

/// The change of volume of the unit cube (mm^3) at the end, with @p steps steps.
void pull(const std::string &more, int steps, double &volume)
{
  const Registry r = registry();
  pulmo::Run run(r);
  bool finished = false;
  PULMO_OK(prepare(run, options("-ts_dt " + std::to_string(t_end / steps) + " " + more)));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  const auto &rows = run.simulation().rows();
  ASSERT_EQ(rows.size(), static_cast<std::size_t>(steps + 1));
  volume = 1000 * rows.back().volume;
  for (std::size_t n = 1; n < rows.size(); ++n) EXPECT_LE(rows[n].newton, 2 * 5) << "step " << n;
}

} // namespace

TEST(KelvinVoigt, OrderOfEachIntegrator)
{
  const Registry r = registry();
  pulmo::Run run(r);
  PULMO_OK(prepare(run, options("-ts_dt 0.1")));
  const auto y = exact(run.scene().tissue().law());
  const double expected = y[0] * y[1] * y[1] - 1;
  ASSERT_GT(expected, 0.02);
  for (const Integrator &integrator : integrators) {
    double error[4];
    for (int i = 0; i < 4; ++i) {
      double volume = 0;
      ASSERT_NO_FATAL_FAILURE(pull(integrator.options, 8 << i, volume));
      error[i] = volume - expected;
      std::printf("  %s, %d steps: %.8f, error %.2e\n", integrator.name, 8 << i, volume, error[i]);
    }
    const double order = std::log2(error[2] / error[3]);
    EXPECT_NEAR(order, integrator.order, 0.1 * integrator.order) << integrator.name;
    EXPECT_LT(std::abs(error[3]), 0.02 * expected) << integrator.name;
  }
}

TEST(KelvinVoigt, BothIntegratorsOfPetscFE)
{
  for (const Integrator &integrator : integrators) {
    double own = 0, basic = 0;
    ASSERT_NO_FATAL_FAILURE(pull(integrator.options, 8, own));
    ASSERT_NO_FATAL_FAILURE(pull(std::string(integrator.options) + " -petscfe_type basic", 8, basic));
    EXPECT_NEAR(own, basic, 1e-12) << integrator.name;
  }
}
