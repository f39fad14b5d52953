// A film of surfactant in a cube of prescribed volume; see README.md beside this file.
#include "verification/support/integrators.hpp"
#include "verification/support/uniform.hpp"

#include "pulmo/observers/energy.hpp"

#include <algorithm>
#include <cmath>

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double per_mN_m = 1e-3; // kPa mm

/// The film as the test sees it: S0 in 1/mm, tensions in mN/m.
struct Film {
  double eq = 23, least = 2, most = 70, adsorption = 2, relaxation = 0.1, compression = 120, expansion = 140, area = 30;

  double slope(double gamma, double stretching) const
  {
    const double k = gamma >= eq ? adsorption : relaxation, epsilon = stretching < 0 ? compression : expansion;
    return k * (eq - gamma) + epsilon * stretching;
  }
};

/// gamma by ln A, in many small steps of the classical Runge-Kutta method, held between its bounds: at @p n times.
struct Course {
  std::vector<double> gamma;
  double loop = 0; ///< int gamma d(A/A0), mN/m

  Course(const Film &f, const std::function<double(double)> &J, double t_end, int n)
  {
    constexpr int small = 400;
    const auto log_A = [&](double t) { return 2.0 / 3 * std::log(J(t)); };
    const double h = t_end / n / small;
    double y = f.eq;
    for (int k = 0; k < n * small; ++k) {
      const double t = k * h, before = y;
      const auto rate = [&](double s) { return (log_A(s + h / 100) - log_A(s - h / 100)) / (h / 50); };
      const double a = f.slope(y, rate(t)), b = f.slope(y + h / 2 * a, rate(t + h / 2)),
                   c = f.slope(y + h / 2 * b, rate(t + h / 2)), d = f.slope(y + h * c, rate(t + h));
      y = std::clamp(y + h / 6 * (a + 2 * b + 2 * c + d), f.least, f.most);
      loop += (before + y) / 2 * (std::exp(log_A(t + h)) - std::exp(log_A(t)));
      if ((k + 1) % small == 0) gamma.push_back(y);
    }
  }
};

/// W'(J) of uniform inflation, kPa: from the published formulas.
double inflation(const std::string &law, double J)
{
  const double c = law == "yoshihara" ? 1.298 : 0.3567, beta = law == "yoshihara" ? 0.75 : 1.075,
               c3 = law == "yoshihara" ? 0 : 5.766e-3;
  const double s = std::cbrt(J * J);
  return (2 * c + 4 * c3 * std::pow(s - 1, 5)) / std::cbrt(J) - 2 * c * std::pow(J, -2 * beta - 1);
}

std::array<double, 9> inflated(double J)
{
  const double e = std::cbrt(J) - 1;
  return {e, 0, 0, 0, e, 0, 0, 0, e};
}

struct Result {
  History history;
  std::map<std::string, double> energy; ///< of the whole run, J
  double share = 0;                     ///< of the residual of the energy balance
  std::string printed;
};

void drive(const Motion &motion, const std::string &law, const std::string &more, Result &result)
{
  const Registry r = driven(motion);
  pulmo::Run run(r);
  bool finished = false;
  result = {};
  testing::internal::CaptureStdout();
  const PetscErrorCode ierr =
      prepare(run, "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
                       " -mesh_scale 1 -pc_type lu -airflow off -snes_atol 1e-13 -snes_rtol 1e-12 -ventilator_settle "
                       "off -surfactant -tissue " +
                       law + " " + more);
  result.printed = testing::internal::GetCapturedStdout();
  PULMO_OK(ierr);
  StressObserver stress(run, result.history);
  Sampling sampling;
  PULMO_OK(sampling.setup(run.model()));
  EnergyAudit energy(run.scene(), run.model(), sampling);
  PULMO_OK(energy.setup());
  run.simulation().add(energy);
  run.simulation().add(stress);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  for (std::size_t i = 0; i < energy.accounts().size(); ++i)
    result.energy[energy.accounts()[i].name] = energy.rows().back().accounts[i];
  result.share = energy.worst_share();
}

void breathe(const std::function<double(double)> &J, const std::string &law, const std::string &more, Result &result)
{
  drive([&J](double t) { return inflated(J(t)); }, law, more, result);
}

/// Matrices by rows.
using Matrix = std::array<double, 9>;

Matrix product(const Matrix &a, const Matrix &b)
{
  Matrix c{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) c[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return c;
}

/// By Rodrigues, about an axis askew.
Matrix rotation(double angle)
{
  const double n[3] = {2.0 / 7, 3.0 / 7, 6.0 / 7}, c = std::cos(angle), s = std::sin(angle);
  return {c + n[0] * n[0] * (1 - c),        n[0] * n[1] * (1 - c) - n[2] * s, n[0] * n[2] * (1 - c) + n[1] * s,
          n[1] * n[0] * (1 - c) + n[2] * s, c + n[1] * n[1] * (1 - c),        n[1] * n[2] * (1 - c) - n[0] * s,
          n[2] * n[0] * (1 - c) - n[1] * s, n[2] * n[1] * (1 - c) + n[0] * s, c + n[2] * n[2] * (1 - c)};
}

/// gamma of a row, from the stress beyond the law's: P = (W' + p_gamma - p_rest) J^(2/3), mN/m.
double tension(const Film &f, const std::string &law, double J, double P)
{
  const double s0 = 2.0 / 3 * per_mN_m * f.area;
  return ((P / std::cbrt(J * J) - inflation(law, J)) / s0 + f.eq) * std::cbrt(J);
}

/// Several numbers in a string of options.
std::string steps(double t_end, int n)
{
  char text[80];
  std::snprintf(text, sizeof(text), " -ts_max_time %.17g -ts_dt %.17g", t_end, t_end / n);
  return text;
}

} // namespace

TEST(Surfactant, ComesBackAfterAFastStretchHoweverLargeTheSteps)
{
  // no time to relax: gamma = gamma_eq + eps ln A, A = J^(2/3); half of it if A were taken as J^(1/3), more if as J
  const Film f;
  const auto J = [](double t) { return t < 0.35 ? 1 + t : t < 0.55 ? 1.1 : 1.0; };
  Result r;
  ASSERT_NO_FATAL_FAILURE(
      breathe(J, "yoshihara",
              "-surfactant_adsorption 0 -surfactant_relaxation 0 -surfactant_compression 140" + steps(0.6, 6), r));
  ASSERT_EQ(r.history.t.size(), 6u);
  for (std::size_t n = 0; n < 6; ++n) {
    const double at = J(r.history.t[n]);
    EXPECT_NEAR(tension(f, "yoshihara", at, r.history.P[n][0]), 23 + 140 * 2.0 / 3 * std::log(at), 1e-8) << n;
  }
  EXPECT_LT(r.share, 1e-9);
}

TEST(Surfactant, TurnsWithTheTissue)
{
  // stretch and shear that work the film on all its branches, and the same turned by 3 rad meanwhile: P is that of it,
  // turned
  const auto stretch = [](double t) {
    const double s = std::sin(2 * M_PI * t);
    return Matrix{1 + 0.25 * s, 0.2 * s, 0, 0, 1 + 0.15 * s, -0.1 * s, 0, 0, 1 - 0.05 * s};
  };
  const auto spin = [](double t) { return rotation(3 * t); };
  const auto less_identity = [](Matrix F) {
    for (int i = 0; i < 9; i += 4) F[i] -= 1;
    return F;
  };
  for (const std::string more :
       {"-surfactant_gamma dynamic", "-surfactant_gamma dynamic -ts_type bdf", "-surfactant_gamma constant"}) {
    Result still, turned;
    ASSERT_NO_FATAL_FAILURE(
        drive([&](double t) { return less_identity(stretch(t)); }, "yoshihara", more + steps(1, 40), still));
    ASSERT_NO_FATAL_FAILURE(drive([&](double t) { return less_identity(product(spin(t), stretch(t))); }, "yoshihara",
                                  more + steps(1, 40), turned));
    ASSERT_EQ(still.history.P.size(), 40u);
    ASSERT_EQ(turned.history.P.size(), 40u);
    for (std::size_t n = 0; n < 40; ++n) {
      const Matrix expected = product(spin(turned.history.t[n]), still.history.P[n]);
      for (std::size_t i = 0; i < 9; ++i)
        EXPECT_NEAR(turned.history.P[n][i], expected[i], 1e-9) << more << " row " << n;
    }
  }
}

TEST(Surfactant, OrderInTime)
{
  const Film f;
  constexpr double t_end = 0.6;
  for (const double swing : {0.5, -0.15}) { // above gamma_eq: adsorption; below: relaxation
    const auto J = [swing](double t) {
      const double s = std::sin(M_PI * t / 1.4);
      return 1 + swing * s * s;
    };
    const Course expected(f, J, t_end, 1);
    for (const Integrator &integrator : integrators) {
      double error[3];
      for (int k = 0; k < 3; ++k) {
        Result r;
        ASSERT_NO_FATAL_FAILURE(breathe(J, "yoshihara", steps(t_end, 12 << k) + integrator.options, r));
        error[k] = tension(f, "yoshihara", J(t_end), r.history.P.back()[0]) - expected.gamma.back();
        std::printf("  swing %g, %s, %d steps: error %.3e of %.6f mN/m\n", swing, integrator.name, 12 << k, error[k],
                    expected.gamma.back());
      }
      EXPECT_NEAR(std::log2(error[1] / error[2]), integrator.order, 0.15 * integrator.order) << integrator.name;
      const double gain = std::pow(2, integrator.order); // what the errors tend to, by Richardson
      EXPECT_LT(std::abs((gain * error[2] - error[1]) / (gain - 1)), 0.01) << integrator.name;
    }
  }
}

TEST(Surfactant, LoopsOverTheAreaAsItsEquationSays)
{
  // three breaths of 2 s between J = 0.8 and 1.3: film collapses at gamma_min, adsorbs, all branches
  const Film f;
  constexpr double t_end = 6;
  constexpr int n = 800;
  const auto J = [](double t) { return 1.05 - 0.05 * std::cos(M_PI * t) + 0.2 * std::sin(M_PI * t); };
  const Course expected(f, J, t_end, n);
  ASSERT_EQ(*std::min_element(expected.gamma.begin(), expected.gamma.end()), f.least);
  ASSERT_GT(*std::max_element(expected.gamma.begin(), expected.gamma.end()), f.eq + 5);
  double worst[2], dissipated[2];
  for (int k = 0; k < 2; ++k) { // backward Euler, n/2 and n steps
    Result r;
    ASSERT_NO_FATAL_FAILURE(breathe(J, "yoshihara", steps(t_end, n / 2 << k), r));
    ASSERT_EQ(r.history.t.size(), static_cast<std::size_t>(n / 2 << k));
    double least = 100;
    worst[k] = 0;
    for (std::size_t i = 0; i < r.history.t.size(); ++i) {
      const double gamma = tension(f, "yoshihara", J(r.history.t[i]), r.history.P[i][0]);
      worst[k] = std::max(worst[k], std::abs(gamma - expected.gamma[(i + 1) * (2 >> k) - 1]));
      least = std::min(least, gamma);
    }
    EXPECT_NEAR(least, f.least, 1e-9);
    EXPECT_NEAR(r.energy["elastic_surface"] * 1e6, 0, 1e-9);
    EXPECT_LT(r.share, 1e-9);
    dissipated[k] = r.energy["viscous_surface"] * 1e6; // kPa mm^3, of 1 mm^3
  }
  std::printf("  worst gamma %.3e, %.3e mN/m\n", worst[0], worst[1]);
  EXPECT_NEAR(worst[0] / worst[1], 2, 0.3);
  // a film of constant tension has no loop: what is dissipated tends to the loop of gamma over A, S0 int gamma d(A/A0)
  const double loop = f.area * per_mN_m * expected.loop;
  EXPECT_GT(loop, 0);
  EXPECT_NEAR((dissipated[0] - loop) / (dissipated[1] - loop), 2, 0.3);
  EXPECT_NEAR(2 * dissipated[1] - dissipated[0], loop, 2e-3 * loop);
}

TEST(Surfactant, ConstantTensionSoftensTheLung)
{
  const double p_rest = 2.0 / 3 * per_mN_m * 30 * 23;
  const auto J = [](double t) { return 1 + t; }; // to 4
  Result with;
  ASSERT_NO_FATAL_FAILURE(breathe(J, "birzle", "-surfactant_gamma constant" + steps(3, 12), with));
  std::vector<double> p;
  for (std::size_t n = 0; n < with.history.t.size(); ++n) {
    const double at = J(with.history.t[n]);
    p.push_back(with.history.P[n][0] / std::cbrt(at * at));
    EXPECT_NEAR(p.back(), inflation("birzle", at) + p_rest * (1 / std::cbrt(at) - 1), 1e-10) << at;
  }
  // CM3 alone rises all the way; with the film its pressure turns, and pulmo says so with the place
  for (double x = 1; x < 2; x += 0.01) EXPECT_GT(inflation("birzle", x + 0.01), inflation("birzle", x));
  double top = 0, turn = 1;
  for (double x = 1; x < 4; x += 1e-4) {
    const double value = inflation("birzle", x) + p_rest * (1 / std::cbrt(x) - 1);
    if (value < top) break;
    top = value;
    turn = x;
  }
  EXPECT_LT(turn, 1.9);
  char place[80];
  std::snprintf(place, sizeof(place), "rises to %.3g cmH2O at J = %.3g and falls beyond", top / 0.0980665, turn);
  EXPECT_NE(with.printed.find(place), std::string::npos) << place << "\n" << with.printed;
  EXPECT_LT(with.share, 1e-9);
  Result stiff;
  ASSERT_NO_FATAL_FAILURE(breathe(J, "rausch", "-surfactant_gamma constant" + steps(0.2, 1), stiff));
  EXPECT_EQ(stiff.printed.find("-surfactant"), std::string::npos) << stiff.printed;
}

TEST(Surfactant, RestIsRest)
{
  // tissue at rest bears the pull of the film: taken whole, 4.7 cmH2O would fold the cube (no J > 0.5 has W' =
  // -p_gamma)
  for (const std::string gamma : {"dynamic", "constant"}) {
    Result r;
    ASSERT_NO_FATAL_FAILURE(
        breathe([](double) { return 1.0; }, "yoshihara", "-surfactant_gamma " + gamma + steps(1, 4), r));
    for (const auto &P : r.history.P)
      for (double component : P) EXPECT_NEAR(component, 0, 1e-13);
  }
}
