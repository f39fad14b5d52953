// The clinical numbers, from signals made by hand.
#include "unit/scenes.hpp"

#include "pulmo/clinical.hpp"
#include "pulmo/units.hpp"

namespace pulmo::test {
namespace {

// --------------------------------------------------------------------------------------------------------- numbers

/// Signals of a compartment P = PEEP + E (V - V0) + R Q: breaths of sinusoidal flow, uneven steps.
std::vector<SignalRow> compartment(double E, double R, double peep, int breaths, double rest_volume, unsigned seed)
{
  Random random(seed);
  std::vector<SignalRow> rows;
  const double inspiration = 1, expiration = 2, tidal = 400;
  double t0 = 0;
  const auto add = [&](double t, double V, double Q, const char *phase, int breath) {
    SignalRow r;
    r.time = t;
    r.volume = V;
    r.flow = Q;
    r.pressure = peep + E * (V - rest_volume) + R * Q;
    r.phase = phase;
    r.breath = breath;
    r.dt = rows.empty() ? 0 : t - rows.back().time;
    rows.push_back(r);
  };
  add(0, rest_volume, 0, breaths > 0 ? "inspiration" : "settle", 0);
  for (int b = 1; b <= breaths; ++b, t0 += inspiration + expiration)
    for (int part = 0; part < 2; ++part) {
      const double T = part == 0 ? inspiration : expiration, begin = part == 0 ? t0 : t0 + inspiration,
                   sign = part == 0 ? 1 : -1;
      for (double t = 0; t < T;) {
        t = std::min(T, t + random(0.01, 0.09));
        const double a = M_PI * t / T, lung = tidal / 2 * (1 - std::cos(a));
        add(begin + t, rest_volume + (part == 0 ? lung : tidal - lung), sign * tidal / 2 * M_PI / T * std::sin(a),
            part == 0 ? "inspiration" : "expiration", b);
      }
    }
  return rows;
}

TEST(Fit, RecoversElastanceAndResistance)
{
  for (double peep : {0.0, 5.0})
    for (int breaths : {1, 3}) {
      const double E = 0.0125, R = 0.0042; // cmH2O/ml, cmH2O s/ml
      const auto rows = compartment(E, R, peep, breaths, peep > 0 ? 300 : 0, 7);
      ClinicalNumbers n = overall_numbers(rows, peep);
      ASSERT_TRUE(n.compliance && n.resistance && n.time_constant);
      EXPECT_NEAR(*n.compliance, 80, 80 * 1e-10);
      EXPECT_NEAR(*n.resistance, 4.2, 4.2 * 1e-10);
      EXPECT_NEAR(*n.time_constant, 4.2e-3 * 80, 1e-10);
      const auto each = breath_numbers(rows, peep);
      ASSERT_EQ(each.size(), static_cast<std::size_t>(breaths));
      for (const ClinicalNumbers &b : each) {
        ASSERT_TRUE(b.compliance);
        EXPECT_NEAR(*b.compliance, 80, 80 * 1e-8);
        EXPECT_NEAR(*b.resistance, 4.2, 4.2 * 1e-8);
        EXPECT_NEAR(b.tidal_volume, 400, 1e-9);
        EXPECT_NEAR(b.trapped_volume, 0, 1e-9);
        EXPECT_FALSE(b.plateau_pressure);
        EXPECT_NEAR(b.driving_pressure, b.peak_pressure - peep, 1e-12);
      }
    }
}

TEST(Fit, LeavesOutTheRowThatABreathStartsFrom)
{
  // MODEL.md, DESIGN.md: "per breath over its rows"; the start row belongs to the phase before it
  auto rows = compartment(0.0125, 0.0042, 0, 1, 0, 8);
  rows[0].flow = -900;
  rows[0].pressure = 33;
  rows[0].dt = 0.05;
  rows[0].breath = 1; // of a longer run
  ClinicalNumbers n;
  fit_single_compartment(rows, 0, rows.size() - 1, 0, n);
  ASSERT_TRUE(n.compliance);
  EXPECT_NEAR(*n.compliance, 80, 80 * 1e-10);
  EXPECT_NEAR(*n.resistance, 4.2, 4.2 * 1e-10);
}

TEST(Fit, WeighsStepsByTheirLength)
{
  // two kinds of rows that no single E and R fits: the weighted normal equations solved by hand
  std::vector<SignalRow> rows(4);
  const double V[] = {0, 100, 200, 300}, Q[] = {0, 100, 50, -20}, P[] = {0, 2, 3, 3.2}, dt[] = {0, 0.1, 0.3, 0.2};
  double a = 0, b = 0, c = 0, d = 0, e = 0;
  for (int i = 0; i < 4; ++i) {
    rows[i].volume = V[i];
    rows[i].flow = Q[i];
    rows[i].pressure = P[i] + 4;
    rows[i].dt = dt[i];
    a += dt[i] * V[i] * V[i];
    b += dt[i] * V[i] * Q[i];
    c += dt[i] * Q[i] * Q[i];
    d += dt[i] * P[i] * V[i];
    e += dt[i] * P[i] * Q[i];
  }
  // a E + b R = d, b E + c R = e
  const double R = (e - b / a * d) / (c - b / a * b), E = (d - b * R) / a;
  ClinicalNumbers n;
  fit_single_compartment(rows, 0, 3, 4, n);
  ASSERT_TRUE(n.compliance);
  EXPECT_NEAR(*n.compliance, 1 / E, 1e-10 / E);
  EXPECT_NEAR(*n.resistance, 1000 * R, 1e-9);
}

TEST(Fit, StaysEmptyWhereTheRowsDefineNothing)
{
  ClinicalNumbers n;
  std::vector<SignalRow> rows(5);
  fit_single_compartment(rows, 0, 4, 0, n); // nothing moves
  EXPECT_FALSE(n.compliance || n.resistance || n.time_constant);
  for (std::size_t i = 0; i < 5; ++i) { // volume but no flow
    rows[i].dt = 0.1;
    rows[i].volume = 10. * static_cast<double>(i);
    rows[i].pressure = static_cast<double>(i);
  }
  fit_single_compartment(rows, 0, 4, 0, n);
  EXPECT_FALSE(n.compliance || n.resistance);
  for (SignalRow &r : rows) r.flow = 3 * r.volume; // flow proportional to volume
  fit_single_compartment(rows, 0, 4, 0, n);
  EXPECT_FALSE(n.compliance || n.resistance);
  for (std::size_t i = 0; i < 5; ++i) { // pressure falls with volume: no compliance
    rows[i].flow = i % 2 ? 5 : -5;
    rows[i].pressure = -rows[i].volume;
  }
  fit_single_compartment(rows, 0, 4, 0, n);
  EXPECT_FALSE(n.compliance);
  rows[2].pressure = std::nan("");
  fit_single_compartment(rows, 0, 4, 0, n);
  EXPECT_FALSE(n.compliance);
  fit_single_compartment(rows, 1, 1, 0, n);
  EXPECT_FALSE(n.compliance);

  EXPECT_TRUE(breath_numbers({}, 0).empty());
  EXPECT_FALSE(overall_numbers({}, 0).compliance);
  EXPECT_TRUE(breath_numbers(std::vector<SignalRow>(3), 0).empty()); // nothing but settling
  EXPECT_EQ(clinical_numbers(std::vector<SignalRow>(1), 0, 0, 0).mechanical_power, 0);
}

/// Rows of a breath: PEEP 5, constant flow 500 ml/s for 1 s, pause, passive expiration in two steps.
std::vector<SignalRow> breath_with_pause()
{
  struct {
    double t, P, Q, V;
    const char *phase;
    int breath;
  } const data[] = {{0, 0, 0, 0, "settle", 0},
                    {1, 5, 100, 100, "settle", 0},
                    {1.5, 15, 500, 350, "inspiration", 1},
                    {2, 20, 500, 600, "inspiration", 1},
                    {2.25, 17, 0, 600, "pause", 1},
                    {2.5, 16, 0, 600, "pause", 1},
                    {3.5, 5, -400, 200, "expiration", 1},
                    {4.5, 5, -70, 130, "expiration", 1}};
  std::vector<SignalRow> rows;
  for (const auto &d : data) {
    SignalRow r;
    r.time = d.t;
    r.pressure = d.P;
    r.flow = d.Q;
    r.volume = d.V;
    r.phase = d.phase;
    r.breath = d.breath;
    r.dt = rows.empty() ? 0 : d.t - rows.back().time;
    rows.push_back(r);
  }
  return rows;
}

TEST(Numbers, OfABreathWithAPause)
{
  const auto rows = breath_with_pause();
  const auto list = breath_numbers(rows, 5);
  ASSERT_EQ(list.size(), 1u);
  const ClinicalNumbers &n = list[0];
  EXPECT_DOUBLE_EQ(n.peak_pressure, 20);
  ASSERT_TRUE(n.plateau_pressure);
  EXPECT_DOUBLE_EQ(*n.plateau_pressure, 16); // the pause's last row
  EXPECT_DOUBLE_EQ(n.driving_pressure, 11);
  EXPECT_DOUBLE_EQ(n.tidal_volume, 500); // 600 - 100 at the breath's start
  EXPECT_DOUBLE_EQ(n.trapped_volume, 30);
  EXPECT_DOUBLE_EQ(n.peak_flow, 500);
  // trapezoids of (P - PEEP) dV: 250 (0 + 10)/2 + 250 (10 + 15)/2 + 0 + 0 - 400 (11 + 0)/2 - 0
  const double work = (1250 + 3125 - 2200) * 0.0980665e-3;
  EXPECT_NEAR(n.work, work, 1e-14);
  EXPECT_NEAR(n.mechanical_power, work * 60 / 3.5, 1e-12);
  const ClinicalNumbers overall = overall_numbers(rows, 5);
  EXPECT_DOUBLE_EQ(overall.tidal_volume, 500);
  EXPECT_DOUBLE_EQ(overall.work, n.work);
}

TEST(Numbers, WorkOfAResistiveLoop)
{
  // P = R Q + E V with sinusoidal flow: the loop's area is R times the integral of Q^2 dt
  const double E = 0.0125, R = 0.0042;
  std::vector<SignalRow> rows;
  const int n = 4000;
  for (int i = 0; i <= n; ++i) {
    SignalRow r;
    r.time = 2.0 * i / n;
    r.volume = 250 * (1 - std::cos(M_PI * r.time));
    r.flow = 250 * M_PI * std::sin(M_PI * r.time);
    r.pressure = 8 + E * r.volume + R * r.flow;
    r.dt = i ? 2.0 / n : 0;
    r.breath = 1;
    rows.push_back(r);
  }
  const ClinicalNumbers numbers = clinical_numbers(rows, 0, n, 8);
  const double exact = R * 250 * 250 * M_PI * M_PI * 0.0980665e-3; // J
  EXPECT_NEAR(numbers.work, exact, 1e-6 * exact);
  EXPECT_NEAR(numbers.mechanical_power, 30 * exact, 3e-5 * exact);
}

TEST(Numbers, OverallFitsAllBreathsAndTakesTheRestFromTheLast)
{
  auto rows = compartment(0.0125, 0.0042, 0, 2, 0, 9);
  for (SignalRow &r : rows)
    if (r.breath == 2) r.pressure *= 2; // the second breath is stiffer
  const ClinicalNumbers overall = overall_numbers(rows, 0);
  const auto each = breath_numbers(rows, 0);
  EXPECT_NEAR(*each[0].compliance, 80, 1e-6);
  EXPECT_NEAR(*each[1].compliance, 40, 40 * 0.01); // its start row is of the first
  EXPECT_LT(*overall.compliance, 79);
  EXPECT_GT(*overall.compliance, 41);
  EXPECT_DOUBLE_EQ(overall.peak_pressure, each[1].peak_pressure);
  EXPECT_DOUBLE_EQ(overall.work, each[1].work);
}

} // namespace
} // namespace pulmo::test
