// Tissue that relaxes: closed forms and integrals of the test's own; see README.md beside this file.
#include "verification/support/integrators.hpp"
#include "verification/support/uniform.hpp"

#include <array>
#include <cmath>

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double g[2] = {0.5, 0.3}, tau[2] = {0.08, 0.6}; // two branches, s
const std::string branches = " -viscoelastic -viscoelastic_moduli 0.5,0.3 -viscoelastic_times 0.08,0.6";

std::string options(const std::string &more)
{
  return "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
         " -mesh_scale 1 -pc_type lu -airflow off -snes_atol 1e-13 -snes_rtol 1e-12 -ventilator_settle off" + branches +
         " " + more;
}

void breathe(const Motion &motion, const std::string &more, History &history)
{
  const Registry r = driven(motion);
  pulmo::Run run(r);
  bool finished = false;
  history = {};
  PULMO_OK(prepare(run, options(more)));
  StressObserver stress(run, history);
  run.simulation().add(stress);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
}

/// The law's own stress at Grad u = H.
void elastic(const std::string &law, const std::array<double, 9> &H, std::array<double, 9> &P, std::array<double, 9> &F)
{
  const Registry r = Registry::standard();
  pulmo::Run run(r);
  PULMO_OK(prepare(run, "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
                            " -mesh_scale 1 -pc_type lu -airflow off -tissue " + law));
  PointState s;
  make_point_state(H.data(), nullptr, s);
  run.scene().tissue().law().stress(s, P.data());
  std::copy_n(s.F, 9, F.begin());
}

std::array<double, 9> stretched(double e)
{
  return {e, 0, 0, 0, 0, 0, 0, 0, 0};
}

} // namespace

TEST(Viscoelastic, RelaxesAsEachSchemeMust)
{
  constexpr double strain = 0.15, dt = 0.05;
  const Motion step = [](double t) { return stretched(t > 0 ? strain : 0); };
  for (const std::string law : {"yoshihara", "ma", "birzle"}) {
    History h;
    std::array<double, 9> P, P0, F, I;
    ASSERT_NO_FATAL_FAILURE(breathe(step, "-tissue " + law + " -ts_max_time 0.5 -ts_dt " + std::to_string(dt), h));
    ASSERT_NO_FATAL_FAILURE(elastic(law, stretched(strain), P, F));
    ASSERT_NO_FATAL_FAILURE(elastic(law, stretched(0), P0, I));
    ASSERT_EQ(h.t.size(), 10u);
    const double S = P[0] / F[0], S0 = P0[0]; // the change of S_e drives it
    for (std::size_t n = 0; n < h.t.size(); ++n) {
      double overstress = 0;
      for (int i = 0; i < 2; ++i)
        overstress += g[i] * (S - S0) * std::pow(1 + dt / tau[i], -static_cast<double>(n + 1));
      EXPECT_NEAR(h.P[n][0], P[0] + F[0] * overstress, 1e-10) << law << " row " << n;
    }
  }
}

TEST(Viscoelastic, NothingRelaxesAtRest)
{
  for (const std::string law : {"ma", "birzle"}) {
    History h;
    std::array<double, 9> P, F;
    ASSERT_NO_FATAL_FAILURE(
        breathe([](double) { return stretched(0); }, "-tissue " + law + " -ts_max_time 0.4 -ts_dt 0.1", h));
    ASSERT_NO_FATAL_FAILURE(elastic(law, stretched(0), P, F));
    for (const auto &row : h.P)
      for (int i = 0; i < 9; ++i) EXPECT_NEAR(row[i], P[i], 1e-12) << law;
  }
}

TEST(Viscoelastic, OrderInTime)
{
  constexpr double t_end = 0.6, strain = 0.2;
  const auto e = [](double t) {
    const double s = std::sin(M_PI * t);
    return strain * s * s;
  };
  // h(t_end) = int g exp(-(t_end - s)/tau) dS_e by parts: g (S_e(t) - 1/tau int exp(...) S_e ds), Simpson's rule
  constexpr int n = 4000;
  std::vector<double> S(n + 1);
  std::array<double, 9> P_end{}, F_end{};
  {
    const Registry r = Registry::standard();
    pulmo::Run run(r);
    PULMO_OK(prepare(run, options("-tissue yoshihara -ts_max_time 1")));
    for (int k = 0; k <= n; ++k) {
      PointState s;
      const auto H = stretched(e(t_end * k / n));
      make_point_state(H.data(), nullptr, s);
      run.scene().tissue().law().stress(s, P_end.data());
      std::copy_n(s.F, 9, F_end.begin());
      S[k] = P_end[0] / s.F[0];
    }
  }
  double expected = P_end[0];
  for (int i = 0; i < 2; ++i) {
    double integral = 0;
    for (int k = 0; k <= n; ++k)
      integral += (k == 0 || k == n ? 1 : k % 2 ? 4 : 2) * S[k] * std::exp(-(t_end - t_end * k / n) / tau[i]);
    integral *= t_end / n / 3;
    expected += F_end[0] * g[i] * (S[n] - S[0] * std::exp(-t_end / tau[i]) - integral / tau[i]);
  }
  for (const Integrator &integrator : integrators) {
    double error[3];
    for (int k = 0; k < 3; ++k) {
      History h;
      ASSERT_NO_FATAL_FAILURE(breathe(
          [&](double t) { return stretched(e(t)); },
          "-tissue yoshihara -ts_max_time 0.6 -ts_dt " + std::to_string(t_end / (12 << k)) + integrator.options, h));
      ASSERT_EQ(h.t.size(), static_cast<std::size_t>(12 << k));
      error[k] = h.P.back()[0] - expected;
      std::printf("  %s, %d steps: error %.3e of %.6f\n", integrator.name, 12 << k, error[k], expected);
    }
    EXPECT_NEAR(std::log2(error[1] / error[2]), integrator.order, 0.15 * integrator.order) << integrator.name;
    EXPECT_LT(std::abs(error[2]), 0.02 * expected);
  }
}

TEST(Viscoelastic, TurnsWithTheTissue)
{
  constexpr double t_end = 0.3;
  const auto turn = [](double t) { return 0.6 * t / t_end; }; // rad
  const auto plain = [](double t) -> std::array<double, 9> {
    const double e = 0.3 * t;
    return {e, 0.4 * e, 0, 0, -0.2 * e, 0, 0, 0, 0.1 * e};
  };
  const auto turned = [&](double t) -> std::array<double, 9> {
    const double a = turn(t), c = std::cos(a), s = std::sin(a);
    auto H = plain(t);
    for (int i = 0; i < 9; i += 4) H[i] += 1;
    std::array<double, 9> R{c, -s, 0, s, c, 0, 0, 0, 1}, out{};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        for (int k = 0; k < 3; ++k) out[3 * i + j] += R[3 * i + k] * H[3 * k + j];
        if (i == j) out[3 * i + j] -= 1;
      }
    return out;
  };
  for (const Integrator &integrator : integrators) {
    History a, b;
    const std::string more = std::string("-tissue birzle -ts_max_time 0.3 -ts_dt 0.03") + integrator.options;
    ASSERT_NO_FATAL_FAILURE(breathe(plain, more, a));
    ASSERT_NO_FATAL_FAILURE(breathe(turned, more, b));
    ASSERT_EQ(a.t.size(), b.t.size());
    for (std::size_t n = 0; n < a.t.size(); ++n) {
      const double angle = turn(a.t[n]), c = std::cos(angle), s = std::sin(angle);
      for (int J = 0; J < 3; ++J) {
        EXPECT_NEAR(b.P[n][J], c * a.P[n][J] - s * a.P[n][3 + J], 1e-10);
        EXPECT_NEAR(b.P[n][3 + J], s * a.P[n][J] + c * a.P[n][3 + J], 1e-10);
        EXPECT_NEAR(b.P[n][6 + J], a.P[n][6 + J], 1e-10);
      }
    }
  }
}

TEST(Viscoelastic, LoopsAsTheLossModulusSays)
{
  // small strain along x: S_e = E e with E of the law; after the start has faded the loop repeats itself
  constexpr double e0 = 1e-4, f = 1.0, w = 2 * M_PI * f, cycles = 4, per_cycle = 200;
  History h;
  std::array<double, 9> P, F;
  ASSERT_NO_FATAL_FAILURE(breathe([&](double t) { return stretched(e0 * std::sin(w * t)); },
                                  "-tissue yoshihara -ts_max_time 4 -ts_dt 0.005 -ts_type bdf", h));
  ASSERT_NO_FATAL_FAILURE(elastic("yoshihara", stretched(1e-6), P, F));
  const double E = P[0] / 1e-6;
  double storage = E, loss = 0;
  for (int i = 0; i < 2; ++i) {
    const double x = w * tau[i];
    storage += E * g[i] * x * x / (1 + x * x);
    loss += E * g[i] * x / (1 + x * x);
  }
  double area = 0, in_phase = 0;
  const auto last = static_cast<std::size_t>(cycles * per_cycle), first = last - static_cast<std::size_t>(per_cycle);
  ASSERT_EQ(h.t.size(), last);
  for (std::size_t n = first; n < last; ++n) {
    const double t = h.t[n], dt = 1 / (f * per_cycle);
    area += h.P[n][0] * e0 * w * std::cos(w * t) * dt; // int P de
    in_phase += 2 / (per_cycle * e0) * h.P[n][0] * std::sin(w * t);
  }
  EXPECT_NEAR(area, M_PI * loss * e0 * e0, 0.01 * M_PI * loss * e0 * e0);
  EXPECT_NEAR(in_phase, storage, 0.005 * storage);
}
