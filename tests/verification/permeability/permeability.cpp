// Steady flow at large strain through a column whose permeability follows the deformation; see README.md beside this
// file.
#include "verification/support/column.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/scene_parts.hpp"

#include "pulmo/observers/energy.hpp"

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double middle = 0.5, side = 0.1, area = side * side; // mm, mm, mm^2

/// A law as its authors write it, over k0; phi0: share of air at rest.
struct Law {
  const char *name, *options;
  std::function<double(double J, double phi0)> k;
};

/// phi^3 / (1 - phi)^2.
double packed(double phi)
{
  return phi * phi * phi / ((1 - phi) * (1 - phi));
}

const std::vector<Law> &all_laws()
{
  static const std::vector<Law> list{
      {"constant", "", [](double, double) { return 1.0; }},
      {"power", "-airflow_permeability_exponent 1.5",
       [](double J, double phi0) { return std::pow(J * (1 - (1 - phi0) / J) / phi0, 1.5); }},
      {"kozeny_carman", "", [](double J, double phi0) { return packed(1 - (1 - phi0) / J) / packed(phi0); }},
      {"holmes_mow", "-airflow_permeability_exponent 0.8 -airflow_permeability_growth 1.1",
       [](double J, double phi0) {
         const double solid = 1 - phi0;
         return std::pow((J - solid) / (1 - solid), 0.8) * std::exp(1.1 / 2 * (J * J - 1));
       }},
      {"exponential", "-airflow_permeability_growth 0.7",
       [](double J, double phi0) { return std::exp(0.7 * (J - 1) / phi0); }}};
  return list;
}

/// Airspaces whose open shares stay as they are: eps + (1 - eps) x of the permeability is left.
struct Closed {
  std::array<double, 2> open{1, 1}; ///< x of the halves
  double left = 1;                  ///< eps

  double share(int half) const { return left + (1 - left) * open[half]; }
  std::string options() const
  {
    if (left == 1) return "";
    return " -recruitment -recruitment_opening_pressure 1000 -recruitment_closing_pressure -1000 -recruitment_start " +
           column::number(open[0]) + ",top=" + column::number(open[1]) + " -recruitment_permeability " +
           column::number(left);
  }
};

/// Gas at p_in at X = 0, none at X = 1, no load: p = W'(J), and Q = -(k/J) W'' dJ/dX the same everywhere. So
/// G(J) = int_1^J (k/J) W'' dJ is linear in X in each half; by quadrature.
struct Steady {
  const Law &law;
  std::array<double, 2> phi0; ///< of the halves
  Closed closed;
  double J_in, J_middle, Q; ///< Q: mm/s

  Steady(const Law &of, std::array<double, 2> porosity, double p_in, const Closed &airspaces)
      : law(of), phi0(porosity), closed(airspaces), J_in(column::J_of_stress(p_in))
  {
    double low = std::min(J_in, 1.0), high = std::max(J_in, 1.0);
    for (int i = 0; i < 60; ++i) { // what enters the second half is what leaves the first
      J_middle = (low + high) / 2;
      const double surplus = G(0, J_in) - G(0, J_middle) - G(1, J_middle);
      (surplus > 0 ? low : high) = J_middle;
    }
    Q = G(1, J_middle) / middle;
  }
  /// Simpson.
  double G(int half, double J) const
  {
    constexpr int n = 80;
    double s = 0;
    for (int i = 0; i <= n; ++i) {
      const double at = 1 + (J - 1) * i / n;
      s += (i == 0 || i == n ? 1 : i % 2 ? 4 : 2) * law.k(at, phi0[half]) / at * column::W2(at);
    }
    return closed.share(half) * s * (J - 1) / n / 3;
  }
  double J_at(double X) const
  {
    const int half = X > middle;
    const double target = half ? Q * (1 - X) : G(0, J_in) - Q * X;
    double low = std::min(J_in, 1.0), high = std::max(J_in, 1.0);
    for (int i = 0; i < 34; ++i) {
      const double J = (low + high) / 2;
      (G(half, J) < target ? low : high) = J;
    }
    return (low + high) / 2;
  }
  /// int (J - 1) dX, Simpson in each half.
  double length() const
  {
    constexpr int n = 40;
    double s = 0;
    for (int half = 0; half < 2; ++half)
      for (int i = 0; i <= n; ++i) // the middle belongs to both, where J has one value
        s += (i == 0 || i == n ? 1 : i % 2 ? 4 : 2) * (J_at(middle * (half + i / double(n))) - 1);
    return s * middle / n / 3;
  }
};

Lattice halves(int bricks)
{
  Lattice l = Lattice::box({bricks, 1, 1}, {1, side, side});
  l.part = [](const Lattice::Place &x) { return x[0] < middle ? "bottom" : "top"; };
  return l;
}

std::string options(const LatticeFile &mesh, const Law &law, std::array<double, 2> phi0)
{
  return "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " + mesh.path() +
         " -mesh_scale 1 -tissue yoshihara -support -support_surfaces x0,y0,y1,z0,z1 -support_components_x0 x"
         " -support_components_y0 y -support_components_y1 y -support_components_z0 z -support_components_z1 z"
         " -airflow -airflow_surfaces x1 -airflow_permeability 1 -airflow_permeability_law " +
         law.name + " " + law.options + " -tissue_porosity " + column::number(phi0[0]) +
         ",top=" + column::number(phi0[1]) +
         " -ts_dt 1e8 -ts_max_time 1e8"; // so long that what the tissue still takes up is nothing
}

Registry held_at(double p_in)
{
  Registry registry = Registry::standard();
  add_essential(registry, pressure, "x0", [p_in](PetscReal, const PetscReal[3], PetscScalar v[3]) { v[0] = p_in; });
  return registry;
}

struct Errors {
  double Q, length, J, heat;
};

/// Relative errors of the flux, the change of length and the heat; the largest of J at points.
PetscErrorCode errors(const Steady &exact, double p_in, int bricks, Errors &e)
{
  const LatticeFile mesh(halves(bricks));
  pulmo::Run run(held_at(p_in));
  Sampling sampling;
  EnergyAudit energy(run.scene(), run.model(), sampling);
  bool finished = false;

  PetscFunctionBeginUser;
  e = {1e9, 1e9, 1e9, 1e9};
  PetscCall(prepare(run, options(mesh, exact.law, exact.phi0) + exact.closed.options()));
  PetscCall(sampling.setup(run.model()));
  PetscCall(energy.setup());
  run.simulation().add(energy);
  PetscCall(run.simulation().run(finished));
  if (!finished) {
    PetscCall(PetscPrintf(PETSC_COMM_WORLD, "%s\n", run.simulation().failure_text().c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const SignalRow &row = run.simulation().rows().back();
  e.Q = std::abs(-1000 * row.flow / area / exact.Q - 1); // leaves at x1
  e.length = std::abs(1000 * row.volume / area / exact.length() - 1);
  e.J = 0;
  PetscCall(sample_rule(run.model().dm(), run.simulation().local_state(), 2,
                        [&](const Sample &s) { e.J = std::max(e.J, std::abs(s.J() - exact.J_at(s.x[0]))); }));
  // in the long step all that the pressure gives becomes heat: Q p_in per area and time, 1e-6 J in a kPa mm^3
  for (std::size_t a = 0; a < energy.accounts().size(); ++a)
    if (energy.accounts()[a].name == "resistive")
      e.heat = std::abs(energy.rows().back().accounts[a] / (1e-6 * 1e8 * exact.Q * p_in * area) - 1);
  PetscFunctionReturn(PETSC_SUCCESS);
}

void expect_steady(const Law &law, std::array<double, 2> phi0, double p_in, const Closed &closed = {})
{
  const Steady exact(law, phi0, p_in, closed);
  Errors coarse, fine;
  PULMO_OK(errors(exact, p_in, 8, coarse));
  PULMO_OK(errors(exact, p_in, 16, fine));
  std::printf(
      "  %-13s Phi0 %.2f %.2f  p %5.2f  J(0) %.4f  Q %10.6f  errors: Q %.1e %.1e  length %.1e %.1e  J %.1e %.1e  "
      "heat %.1e %.1e\n",
      law.name, phi0[0], phi0[1], p_in, exact.J_in, exact.Q, coarse.Q, fine.Q, coarse.length, fine.length, coarse.J,
      fine.J, coarse.heat, fine.heat);
  EXPECT_LT(fine.Q, 2e-5) << law.name;
  EXPECT_LT(fine.heat, 2e-5) << law.name;
  EXPECT_LT(fine.length, 3e-3) << law.name;
  EXPECT_GT(coarse.length, 3.3 * fine.length) << law.name; // order 2 is 4
  EXPECT_LT(fine.J, 5e-3) << law.name;
}

/// Sucked so hard that the law of the tissue leaves no air at X = 0: steps to it are not taken.
PetscErrorCode suck(const char *law, std::array<double, 2> phi0, double p_in, bool &finished, std::string &said)
{
  const LatticeFile mesh(halves(8));
  pulmo::Run run(held_at(p_in));
  const Law any{law, "", {}};

  PetscFunctionBeginUser;
  PetscCall(prepare(run, options(mesh, any, phi0)));
  PetscCall(run.simulation().run(finished));
  said = finished ? "" : run.simulation().failure_text();
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

TEST(PermeabilityLaws, SteadyFlowThroughAColumn)
{
  for (const Law &law : all_laws()) {
    expect_steady(law, {0.75, 0.75}, 3);
    expect_steady(law, {0.4, 0.4}, -3);
    expect_steady(law, {0.99, 0.99}, 0.2); // the Lagrangian porosity is 1 on the way, at J = 1.01
    expect_steady(law, {0.5, 0.8}, 3);
    expect_steady(law, {0.8, 0.4}, -4);
  }
}

TEST(PermeabilityLaws, ClosedAirspacesLeaveAShareOfIt)
{
  for (const Law &law : all_laws()) {
    expect_steady(law, {0.75, 0.75}, 3, {{0, 0}, 0.01});
    expect_steady(law, {0.5, 0.8}, 3, {{0.3, 0.9}, 0.1});
    expect_steady(law, {0.8, 0.4}, -3, {{1, 0}, 0.2});
  }
}

TEST(PermeabilityLaws, AStateWithoutAirIsRefused)
{
  const double J = column::J_of_stress(-4); // 0.71
  for (const Law &law : all_laws()) {
    const bool of_porosity = std::string(law.name) != "constant";
    for (const std::array<double, 2> phi0 : {std::array<double, 2>{0.25, 0.25}, {0.25, 0.9}, {0.9, 0.25}}) {
      SCOPED_TRACE(std::string(law.name) + " " + column::number(phi0[0]) + " " + column::number(phi0[1]));
      const bool airless = J < 1 - phi0[0]; // where the suction is; the other half keeps some
      bool finished = false;
      std::string said;
      PULMO_OK(suck(law.name, phi0, -4, finished, said));
      EXPECT_EQ(finished, !(of_porosity && airless)) << said;
      if (finished) continue;
      EXPECT_NE(said.find("There was no air left: J = "), std::string::npos) << said;
      EXPECT_NE(said.find("1 - Phi0 = 0.75"), std::string::npos) << said;
      EXPECT_NE(said.find("-tissue_porosity"), std::string::npos) << said;
    }
  }
}
