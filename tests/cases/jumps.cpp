// Permeability and stiffness that jump by 10^6 at a plane of a column, in series with closed forms. pulmo's laws have
// one set of parameters; the jump comes from a test effect that adds to the upper half what it lacks. Each demand is
// also printed as a line `demand {...}` for tools/hard_cases.
#include "verification/support/column.hpp"
#include "verification/support/scene_parts.hpp"

#include <nlohmann/json.hpp>

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double middle = 0.5; ///< mm, where the coefficients jump: half of the column

/// Adds k Grad p to the flux and a neo-Hookean stress mu (F - cof F / J) where X > 1/2.
struct Jump {
  struct Parameters {
    static constexpr const char *owner = "test_jump";
    PetscScalar permeability; ///< mm^2/(kPa s)
    PetscScalar mu;           ///< kPa
    PetscScalar place;        ///< mm
  };

  /// Darcy's Q with the added permeability; strains are small, so F = I in it.
  static void flux(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    if (point.x[0] < k.place) return;
    for (int i = 0; i < 3; ++i) f1[i] += k.permeability * point.grad_p[i];
  }
  static void flux_by_pressure(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    if (point.x[0] < k.place) return;
    for (int i = 0; i < 3; ++i) g3[4 * i] += k.permeability;
  }
  /// Stress mu (Grad u + Grad u^T): linear elasticity without lateral contraction.
  static void stress(const Point &point, const Parameters &k, PetscScalar f1[])
  {
    if (point.x[0] < k.place) return;
    const PetscScalar *H = point.state.H;
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) f1[3 * i + J] += k.mu * (H[3 * i + J] + H[3 * J + i]);
  }
  static void stress_by_displacement(const Point &point, const Parameters &k, PetscScalar g3[])
  {
    if (point.x[0] < k.place) return;
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) {
        g3[27 * i + 9 * i + 3 * J + J] += k.mu;
        g3[27 * i + 9 * J + 3 * J + i] += k.mu;
      }
  }
};

class JumpEffect final : public TestEffect {
public:
  JumpEffect(double permeability, double mu) : parameters_{permeability, mu, middle} {}
  const char *name() const override { return "test_jump"; }
  const char *about() const override { return "coefficients that jump (test)"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using P = Jump::Parameters;
    c.parameters(parameters_);
    c.residual("flux beyond", pressure, f1(volume_residual<P, Jump::flux>));
    c.jacobian("flux beyond", pressure, pressure, g3(volume_jacobian<P, Jump::flux_by_pressure>));
    c.residual("stress beyond", displacement, f1(volume_residual<P, Jump::stress>));
    c.jacobian("stress beyond", displacement, displacement, g3(volume_jacobian<P, Jump::stress_by_displacement>));
    return PETSC_SUCCESS;
  }

private:
  Jump::Parameters parameters_;
};

/// A demand: asserted, and printed for the gallery.
void demand(const std::string &what, double measured, const std::string &asked, bool met)
{
  char text[40];
  std::snprintf(text, sizeof(text), "%.6g", measured);
  std::printf("demand %s\n",
              nlohmann::json{{"what", what}, {"measured", text}, {"asked", asked}, {"met", met}}.dump().c_str());
  EXPECT_TRUE(met) << what << ": " << measured << " for " << asked;
}

void demand_near(const std::string &what, double measured, double expected, double within)
{
  char asked[80];
  std::snprintf(asked, sizeof(asked), "%.6g ± %.3g %%", expected, 100 * within);
  demand(what, measured, asked, std::abs(measured - expected) <= within * std::abs(expected));
}

void demand_below(const std::string &what, double measured, double limit)
{
  char asked[40];
  std::snprintf(asked, sizeof(asked), "< %.3g", limit);
  demand(what, measured, asked, measured < limit);
}

/// Newton to a tolerance that coefficients 10^6 apart leave within rounding; gives up at the first cut.
std::string solver(bool iterative, double dt)
{
  const std::string file = iterative ? "iterative" : "direct", time = column::number(dt);
  return " -options_file " + source("petsc_options/solvers/" + file + ".opts") + " -ts_dt " + time + " -ts_max_time " +
         time + " -ts_adapt_dt_min " + time;
}

} // namespace

/// Gas flows from x0 at p = 1e-4 kPa to x1 at 0 through two resistances in series: the half with 10^6 times the
/// permeability takes a millionth of the pressure drop.
TEST(Jumps, PermeabilityInSeries)
{
  constexpr double p_in = 1e-4, k = 1, ratio = 1e6;
  for (const bool iterative : {false, true}) {
    Registry registry = Registry::standard();
    add_essential(registry, pressure, "x0", [](PetscReal, const PetscReal[3], PetscScalar v[3]) { v[0] = p_in; });
    registry.effect([] { return std::make_unique<JumpEffect>((ratio - 1) * k, 0); });
    pulmo::Run run(registry);
    bool finished = false;
    PULMO_OK(prepare(run, column::options("-airflow_permeability " + column::number(k)) + solver(iterative, 1e6)));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    // cells that the plane cuts carry more than their share of each half: within h/L, 5 % of the length, on either side
    const double out = -1000 * run.simulation().rows().back().flow / 0.01;
    const double series = p_in / (middle / k + (1 - middle) / (ratio * k));
    double open_p = 0;
    int n = 0;
    PULMO_OK(sample_corners(run.model().dm(), run.simulation().local_state(), [&](const Sample &s) {
      if (s.x[0] < middle + 0.1 || s.x[0] > 0.9) return;
      open_p = std::max(open_p, std::abs(s.p / p_in));
      ++n;
    }));
    ASSERT_GT(n, 0);
    const std::string name = "k jumps by 10⁶" + std::string(iterative ? ", iterative" : ", direct");
    demand_near(name + ": flux through two halves in series (mm/s)", out, series, 0.1);
    demand_below(name + ": largest |p|/p0 in the open half", open_p, 1e-5);
  }
}

/// A column in tension: the half that is 10^6 times as stiff does not stretch, the soft half does as alone.
TEST(Jumps, StiffnessInSeries)
{
  constexpr double load = 1e-3; ///< kPa
  for (const bool iterative : {false, true}) {
    Registry registry = Registry::standard();
    const double mu = 1e6 * column::W2(1) / 2;
    registry.effect([=] { return std::make_unique<JumpEffect>(0, mu); });
    pulmo::Run run(registry);
    bool finished = false;
    PULMO_OK(prepare(run, column::options("-airflow_permeability 1 -traction -traction_surfaces x1 -traction_value " +
                                          column::number(load) + ",0,0") +
                              solver(iterative, 1e4)));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    column::Ends ends;
    PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), ends));
    const std::string name = "stiffness jumps by 10⁶" + std::string(iterative ? ", iterative" : ", direct");
    demand_near(name + ": stretch of the column, mm", ends.u1, load / column::W2(1) * (middle + (1 - middle) / 1e6),
                0.1);
    EXPECT_GT(run.simulation().min_J(), 0);
  }
}
