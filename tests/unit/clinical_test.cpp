// The clinical numbers, from signals made by hand.
#include "unit/scenes.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/observers/clinical.hpp"

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
      ClinicalNumbers n = overall_numbers(rows);
      ASSERT_TRUE(n.compliance && n.resistance && n.time_constant);
      EXPECT_NEAR(*n.compliance, 80, 80 * 1e-10);
      EXPECT_NEAR(*n.resistance, 4.2, 4.2 * 1e-10);
      EXPECT_NEAR(*n.time_constant, 4.2e-3 * 80, 1e-10);
      const auto each = breath_numbers(rows);
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

/// Against Cramer's rule on the normal equations of [E, R, P_0], each row counted once.
TEST(Fit, WithInterceptCountsEveryRowOnce)
{
  auto rows = compartment(0.0125, 0.0042, 5, 2, 300, 7);
  ClinicalNumbers exact;
  for (SignalRow &r : rows) r.pressure += 1.5; // not at PEEP where the breath starts
  fit_with_intercept(rows, 0, rows.size() - 1, exact);
  ASSERT_TRUE(exact.equal_weight_compliance && exact.equal_weight_resistance);
  EXPECT_NEAR(*exact.equal_weight_compliance, 80, 80 * 1e-9);
  EXPECT_NEAR(*exact.equal_weight_resistance, 4.2, 4.2 * 1e-9);

  double A[3][3] = {}, b[3] = {};
  for (std::size_t i = 1; i < rows.size(); ++i) {
    SignalRow &r = rows[i];
    r.pressure += 0.3 * std::sin(3.0 * static_cast<double>(i)) + 1e-5 * r.volume * r.volume; // no compartment
    const double x[3] = {r.volume, r.flow, 1};
    for (int j = 0; j < 3; ++j) {
      b[j] += x[j] * r.pressure;
      for (int k = 0; k < 3; ++k) A[j][k] += x[j] * x[k];
    }
  }
  const auto determinant = [](const double M[3][3]) {
    return M[0][0] * (M[1][1] * M[2][2] - M[1][2] * M[2][1]) - M[0][1] * (M[1][0] * M[2][2] - M[1][2] * M[2][0]) +
           M[0][2] * (M[1][0] * M[2][1] - M[1][1] * M[2][0]);
  };
  const auto unknown = [&](int column) {
    double M[3][3];
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) M[j][k] = k == column ? b[j] : A[j][k];
    return determinant(M) / determinant(A);
  };
  ClinicalNumbers n;
  fit_with_intercept(rows, 0, rows.size() - 1, n);
  fit_single_compartment(rows, 0, rows.size() - 1, 5, n);
  ASSERT_TRUE(n.equal_weight_compliance && n.compliance);
  EXPECT_NEAR(*n.equal_weight_compliance, 1 / unknown(0), 1e-6 / unknown(0));
  EXPECT_NEAR(*n.equal_weight_resistance, 1000 * unknown(1), 1e-6 * 1000 * unknown(1));
  EXPECT_GT(std::abs(*n.equal_weight_compliance / *n.compliance - 1), 0.01)
      << "the other fit weighs by dt, without intercept";
  for (SignalRow &r : rows) r.flow = 0;
  ClinicalNumbers none;
  fit_with_intercept(rows, 0, rows.size() - 1, none);
  EXPECT_FALSE(none.equal_weight_compliance || none.equal_weight_resistance);
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

  EXPECT_TRUE(breath_numbers({}).empty());
  EXPECT_FALSE(overall_numbers({}).compliance);
  EXPECT_TRUE(breath_numbers(std::vector<SignalRow>(3)).empty()); // nothing but settling
  EXPECT_EQ(clinical_numbers(std::vector<SignalRow>(1), 0, 0).mechanical_power, 0);
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
  const auto list = breath_numbers(rows);
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
  const ClinicalNumbers overall = overall_numbers(rows);
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
  const ClinicalNumbers numbers = clinical_numbers(rows, 0, n);
  const double exact = R * 250 * 250 * M_PI * M_PI * 0.0980665e-3; // J
  EXPECT_NEAR(numbers.work, exact, 1e-6 * exact);
  EXPECT_NEAR(numbers.mechanical_power, 30 * exact, 3e-5 * exact);
}

TEST(Numbers, OverallAreThoseOfTheLastBreath)
{
  auto rows = compartment(0.0125, 0.0042, 0, 2, 0, 9);
  for (SignalRow &r : rows)
    if (r.breath == 2) r.pressure *= 2; // the second breath is stiffer
  const ClinicalNumbers overall = overall_numbers(rows);
  const auto each = breath_numbers(rows);
  EXPECT_NEAR(*each[0].compliance, 80, 1e-6);
  EXPECT_NEAR(*overall.compliance, 40, 1e-6);
  EXPECT_NEAR(*overall.resistance, 8.4, 1e-7);
  EXPECT_DOUBLE_EQ(overall.peak_pressure, each[1].peak_pressure);
  EXPECT_DOUBLE_EQ(overall.work, each[1].work);
}

TEST(PeepTrial, TakesTheLastBreathOfEachLevel)
{
  // C_rs of each breath: the first of a level is another's
  const std::vector<std::pair<double, double>> breaths{{8, 30}, {8, 40}, {6, 70}, {6, 55}, {4, 50}, {2, 45}};
  std::vector<SignalRow> rows(1);
  int number = 0;
  double time = 0;
  rows[0].phase = "settle";
  for (const auto &[peep, C] : breaths) {
    // the change to the new level belongs to the breath before it, and gas flows in it
    const double from = rows.back().volume;
    for (int i = 1; i <= 5; ++i) {
      SignalRow r;
      r.time = time += 0.1;
      r.dt = 0.1;
      r.phase = "expiration";
      r.breath = number;
      r.pressure = peep;
      r.volume = from - 10 * i;
      r.flow = (r.volume - rows.back().volume) / r.dt;
      rows.push_back(r);
    }
    ++number;
    const double start = rows.back().volume;
    for (int i = 1; i <= 22; ++i) { // the last two at rest
      SignalRow r;
      r.time = time += 0.1;
      r.dt = 0.1;
      r.breath = number;
      r.phase = i <= 10 ? "inspiration" : "expiration";
      r.volume = start + (i < 20 ? 400 * std::sin(M_PI * i / 20) : 0);
      r.flow = (r.volume - rows.back().volume) / r.dt;
      r.pressure = peep + (r.volume - start) / C + 0.01 * r.flow;
      rows.push_back(r);
    }
  }
  const auto levels = peep_levels(rows);
  ASSERT_EQ(levels.size(), 4u);
  const double peep[] = {8, 6, 4, 2}, compliance[] = {40, 55, 50, 45};
  for (int i = 0; i < 4; ++i) {
    EXPECT_NEAR(levels[i].peep, peep[i], 1e-12);
    EXPECT_NEAR(*levels[i].compliance, compliance[i], 1e-6);
    EXPECT_NEAR(rows[levels[i].last].pressure, peep[i], 1e-12);
  }
  EXPECT_EQ(best_compliance(levels), &levels[1]);
  rows.resize(1 + 4 * 27); // two levels are no trial
  EXPECT_TRUE(peep_levels(rows).empty());
  EXPECT_EQ(best_compliance({}), nullptr);
}

// ------------------------------------------------------------------------- the end of inspiration, cut breaths

/// Rows of one breath by volume and phase.
std::vector<SignalRow> breath_of(const std::vector<std::pair<const char *, double>> &data)
{
  std::vector<SignalRow> rows(1);
  rows[0].phase = "settle";
  for (const auto &[phase, volume] : data) {
    SignalRow r;
    r.time = static_cast<double>(rows.size());
    r.dt = 1;
    r.phase = phase;
    r.volume = volume;
    r.hold = std::string(phase) == "hold";
    r.breath = 1;
    rows.push_back(r);
  }
  return rows;
}

std::size_t end_of_inspiration(const std::vector<std::pair<const char *, double>> &data)
{
  const auto rows = breath_of(data);
  EXPECT_EQ(breath_rows(rows)[0].fullest, end_of_inspiration(rows, 0, rows.size() - 1));
  return breath_rows(rows)[0].fullest;
}

TEST(EndOfInspiration, IsTheEndOfThePauseWhateverRoundingSays)
{
  for (int noisy = 1; noisy <= 5; ++noisy) { // rounding makes each of the rows in turn the fullest
    std::vector<std::pair<const char *, double>> data{{"in", 250},    {"in", 500},    {"pause", 500},
                                                      {"pause", 500}, {"pause", 500}, {"out", 100}};
    data[noisy - 1].second *= 1 + 1e-13;
    EXPECT_EQ(end_of_inspiration(data), 5u) << noisy;
    data[2].first = data[3].first = data[4].first = "hold";
    EXPECT_EQ(end_of_inspiration(data), 5u) << noisy;
  }
  // gas still flows into the lung in the pause
  EXPECT_EQ(end_of_inspiration({{"in", 300}, {"pause", 400}, {"pause", 420}, {"out", 50}}), 3u);
  // the highest of several pauses; of equal ones the last
  EXPECT_EQ(end_of_inspiration({{"up", 100}, {"hold", 100}, {"up", 200}, {"hold", 200}, {"down", 100}, {"hold", 100}}),
            4u);
  EXPECT_EQ(end_of_inspiration({{"up", 200}, {"hold", 200}, {"wait", 200 - 1e-9}, {"hold", 200}, {"down", 100}}), 4u);
}

TEST(EndOfInspiration, WithoutAPauseAtTheTopIsTheFullestRow)
{
  EXPECT_EQ(end_of_inspiration({{"in", 300}, {"in", 400}, {"out", 200}, {"out", 50}}), 2u);
  EXPECT_EQ(end_of_inspiration({{"in", 300}, {"in", 400}, {"in", 350}, {"out", 50}}), 2u);
  // a plateau within rounding ends with its phase, not in the next one
  EXPECT_EQ(end_of_inspiration({{"in", 400}, {"in", 400 + 1e-10}, {"in", 400}, {"out", 400}, {"out", 50}}), 3u);
  // a hold at the end of expiration is no end of inspiration
  EXPECT_EQ(end_of_inspiration({{"in", 300}, {"in", 400}, {"out", 50}, {"hold", 50}}), 2u);
  EXPECT_EQ(end_of_inspiration({{"out", -100}, {"out", -200}}), 0u); // nothing flows in
}

TEST(EndOfInspiration, APlateauNeedsAPauseThere)
{
  const auto rows = breath_of({{"in", 300}, {"in", 400}, {"out", 50}, {"hold", 50}});
  EXPECT_FALSE(breath_numbers(rows)[0].plateau_pressure) << "the hold after the expiration shows auto-PEEP";
}

TEST(CutBreath, HasNoNumbersAndGivesNone)
{
  auto rows = compartment(0.0125, 0.0042, 0, 3, 0, 11);
  const auto whole = overall_numbers(rows);
  while (rows.back().phase != "inspiration" || rows.back().breath != 3) rows.pop_back();
  rows.back().cut = rows.back().time + 1;
  const auto all = breath_rows(rows);
  ASSERT_EQ(all.size(), 3u);
  EXPECT_TRUE(all[0].complete && all[1].complete);
  EXPECT_FALSE(all[2].complete);
  EXPECT_EQ(complete_breaths(rows).size(), 2u);
  EXPECT_EQ(breath_numbers(rows).size(), 2u);
  EXPECT_EQ(last_breath(rows).last, all[1].last);
  EXPECT_NEAR(overall_numbers(rows).tidal_volume, whole.tidal_volume, 1e-9);
  EXPECT_NEAR(overall_numbers(rows).trapped_volume, 0, 1e-9); // the cut one holds 400 ml at its end
  rows.resize(all[0].last);                                   // within the first
  rows.back().cut = rows.back().time + 1;
  EXPECT_EQ(last_breath(rows).first, 0u);
  EXPECT_EQ(last_breath(rows).fullest, rows.size() - 1);
  for (const ClinicalEntry &e : overall_entries(rows, 1000)) EXPECT_FALSE(e.value) << e.key;
  EXPECT_FALSE(unsteadiness(rows));
}

TEST(Resistance, IsNotGivenWhereNothingResists)
{
  // P = V/80 + (V/1000)^2 at each instant: the fit finds an R all the same
  auto rows = compartment(0.0125, 0, 0, 1, 0, 12);
  for (SignalRow &r : rows) r.pressure += r.volume * r.volume * 1e-6;
  rows[3].phase = rows[4].phase = "pause";
  const ClinicalNumbers fitted = overall_numbers(rows);
  ASSERT_TRUE(fitted.compliance && fitted.resistance && fitted.time_constant);
  for (SignalRow &r : rows) r.flow_resistance = false;
  const ClinicalNumbers n = overall_numbers(rows);
  EXPECT_FALSE(n.resistance || n.time_constant || n.pause_resistance);
  EXPECT_EQ(n.compliance, fitted.compliance);
}

// ------------------------------------------------- exact solutions of a single compartment P = PEEP + E V + R V'

/// A compartment that a ventilator drives; V is its volume above the one that it has at the first PEEP. Rows are exact.
struct Compartment {
  static constexpr double soon = 1e-6; ///< s: a phase's first row, so that the trapezoid sees its jump
  double E = 0.0125, R = 0.0042, peep; ///< cmH2O/ml, cmH2O s/ml, cmH2O
  double tube = 0;                     ///< resistance between machine and airway, cmH2O s/ml
  double t = 0, V = 0;
  std::vector<SignalRow> rows;

  explicit Compartment(double from = 5) : peep(from) { add(0, 0, peep, "settle", 0); }
  double tau() const { return R / E; }
  void add(double dt, double Q, double P, const char *phase, int breath, bool hold = false)
  {
    SignalRow r;
    t += dt;
    r.time = t;
    r.dt = dt;
    r.volume = V;
    r.flow = Q;
    r.pressure = P;
    if (tube > 0) r.ventilator_pressure = P + tube * Q;
    r.alveolar_pressure = peep + E * V;
    r.phase = phase;
    r.breath = breath;
    r.hold = hold;
    rows.push_back(r);
  }
  /// Calls row(time since the start of the phase, step) for T seconds in n + 1 rows.
  template <class Row>
  void phase_of(double T, int n, Row &&row)
  {
    row(soon, soon);
    for (int i = 1; i <= n; ++i) row(T * i / n, i == 1 ? T / n - soon : T / n);
  }
  /// Flow Q for T seconds.
  void flow(double Q, double T, int n, const char *phase, int breath)
  {
    const double start = V;
    phase_of(T, n, [&](double since, double dt) {
      V = start + Q * since;
      add(dt, Q, peep + E * V + R * Q, phase, breath, Q == 0);
    });
  }
  /// Airway pressure P for T seconds: V -> (P - PEEP)/E.
  void pressure(double P, double T, int n, const char *phase, int breath)
  {
    const double start = V, target = (P - peep) / E;
    phase_of(T, n, [&](double since, double dt) {
      const double decay = std::exp(-since / tau());
      V = target + (start - target) * decay;
      add(dt, (target - start) / tau() * decay, P, phase, breath);
    });
  }
};

TEST(ExactCompartment, VolumeControlWithPause)
{
  Compartment lung;
  const double Q = 500, T = 1, expiration = 0.8;
  for (int breath = 1; breath <= 3; ++breath) {
    lung.flow(Q, T, 8, "inspiration", breath);
    lung.flow(0, 0.25, 2, "pause", breath);
    lung.pressure(lung.peep, expiration, 400, "expiration", breath);
  }
  const auto list = breath_numbers(lung.rows);
  ASSERT_EQ(list.size(), 3u);
  double start = 0; // volume that earlier breaths left behind
  for (const ClinicalNumbers &n : list) {
    const double full = start + Q * T, end = full * std::exp(-expiration / lung.tau());
    EXPECT_NEAR(n.peep, 5, 1e-12);
    EXPECT_NEAR(n.tidal_volume, Q * T, 1e-9);
    EXPECT_NEAR(n.trapped_volume, end - start, 1e-9);
    EXPECT_NEAR(n.peak_pressure, 5 + lung.E * full + lung.R * Q, 1e-9);
    ASSERT_TRUE(n.plateau_pressure && n.pause_resistance && n.static_compliance && n.auto_peep && n.total_peep);
    EXPECT_NEAR(*n.plateau_pressure, 5 + lung.E * full, 1e-9);
    EXPECT_NEAR(n.driving_pressure, lung.E * full, 1e-9);
    EXPECT_NEAR(*n.pause_resistance, 4.2, 1e-9);
    EXPECT_NEAR(*n.static_compliance, 80, 1e-8); // whatever the trapped volume
    EXPECT_NEAR(*n.dynamic_compliance, Q * T / (lung.E * full + lung.R * Q), 1e-9);
    EXPECT_NEAR(*n.auto_peep, lung.E * end, 1e-9);
    EXPECT_NEAR(*n.total_peep, 5 + lung.E * end, 1e-9);
    EXPECT_NEAR(n.peak_flow, Q, 1e-12);
    EXPECT_NEAR(n.peak_expiratory_flow, full / lung.tau(), 1e-4 * full);
    EXPECT_FALSE(n.static_curve_compliance); // one point is no curve
    // inspiration: E V dV + R Q dV; expiration: none
    const double work = (lung.E * (full * full - start * start) / 2 + lung.R * Q * Q * T) * 0.0980665e-3;
    EXPECT_NEAR(n.work, work, 1e-4 * work);
    EXPECT_NEAR(n.mechanical_power, n.work * 60 / (T + 0.25 + expiration), 1e-9);
    start = end;
  }
  ASSERT_TRUE(list[0].compliance);
  EXPECT_NEAR(*list[0].compliance, 80, 1e-6);
  EXPECT_NEAR(*list[0].resistance, 4.2, 1e-7);
  const ClinicalNumbers overall = overall_numbers(lung.rows);
  EXPECT_NEAR(*overall.compliance, 80, 1e-6); // volume above the first breath's start
  EXPECT_NEAR(*overall.time_constant, lung.tau(), 1e-9);
  EXPECT_NEAR(*overall.auto_peep, lung.E * start, 1e-9);

  const auto points = static_points(lung.rows, 0, lung.rows.size() - 1);
  ASSERT_EQ(points.size(), 3u);
  for (const StaticPoint &p : points) {
    EXPECT_EQ(p.phase, "inspiration");
    EXPECT_EQ(lung.rows[p.row].phase, "pause");
    EXPECT_EQ(lung.rows[p.row + 1].phase, "expiration");
  }
}

TEST(ExactCompartment, PressureControl)
{
  Compartment lung;
  const double pip = 15, inspiration = 0.7, pause = 0.3, expiration = 0.9;
  lung.pressure(pip, inspiration, 50, "inspiration", 1);
  lung.pressure(pip, pause, 20, "pause", 1); // the machine keeps pressing: gas still flows
  lung.pressure(lung.peep, expiration, 60, "expiration", 1);
  const ClinicalNumbers n = overall_numbers(lung.rows);
  const double full = 800 * (1 - std::exp(-(inspiration + pause) / lung.tau()));
  EXPECT_NEAR(n.tidal_volume, full, 1e-9);
  EXPECT_NEAR(n.peak_pressure, pip, 1e-12);
  EXPECT_NEAR(*n.plateau_pressure, pip, 1e-12);
  EXPECT_NEAR(n.driving_pressure, 10, 1e-12);
  EXPECT_NEAR(n.peak_flow, 10 / lung.R, 1e-5 * 10 / lung.R);
  EXPECT_NEAR(n.peak_expiratory_flow, full / lung.tau(), 1e-5 * full / lung.tau());
  EXPECT_NEAR(*n.dynamic_compliance, full / 10, 1e-9);
  EXPECT_NEAR(*n.compliance, 80, 1e-8);
  EXPECT_NEAR(*n.resistance, 4.2, 1e-9);
  EXPECT_FALSE(n.pause_resistance) << "no resistance from a pause in which gas flows";
  EXPECT_NEAR(*n.auto_peep, lung.E * full * std::exp(-expiration / lung.tau()), 1e-9);
}

TEST(ExactCompartment, AutoPeepCountsFromThePeepOfTheBreathsEnd)
{
  Compartment lung;
  const double expiration = 0.9, next = lung.peep - 2;
  lung.pressure(15, 1, 60, "inspiration", 1);
  const double full = lung.rows.back().volume;
  lung.pressure(next, expiration, 60, "expiration", 1); // the next, lower level
  const ClinicalNumbers n = overall_numbers(lung.rows);
  EXPECT_NEAR(n.peep, lung.peep, 1e-12);
  const double left = (full + 2 / lung.E) * std::exp(-expiration / lung.tau()); // above the volume of the new level
  EXPECT_NEAR(*n.auto_peep, lung.E * left, 1e-9);
  EXPECT_NEAR(*n.total_peep, next + lung.E * left, 1e-9);
}

TEST(ExactCompartment, ReadsTheMachinesSideOfATube)
{
  Compartment lung;
  lung.tube = 0.003;
  lung.flow(400, 1, 10, "inspiration", 1);
  lung.flow(0, 0.3, 3, "pause", 1);
  lung.pressure(lung.peep, 2, 100, "expiration", 1);
  const ClinicalNumbers n = overall_numbers(lung.rows);
  EXPECT_NEAR(n.peak_pressure, 5 + lung.E * 400 + (lung.R + lung.tube) * 400, 1e-9);
  EXPECT_NEAR(*n.plateau_pressure, 5 + lung.E * 400, 1e-9);
  EXPECT_NEAR(*n.pause_resistance, 7.2, 1e-9);
  EXPECT_NEAR(*n.resistance, 7.2, 1e-6);
  EXPECT_NEAR(*n.static_compliance, 80, 1e-8);
}

TEST(ExactCompartment, SupersyringeGivesTheStaticCurve)
{
  Compartment lung(0);
  const int steps = 5;
  for (int k = 0; k < steps; ++k) {
    lung.flow(300, 0.3, 4, "inflation", 1);
    lung.flow(0, 2, 3, "pause", 1);
  }
  for (int k = 0; k < steps; ++k) {
    lung.flow(-300, 0.3, 4, "deflation", 1);
    lung.flow(0, 2, 3, "pause", 1);
  }
  const auto points = static_points(lung.rows, 0, lung.rows.size() - 1);
  ASSERT_EQ(points.size(), 2u * steps);
  for (int k = 0; k < 2 * steps; ++k) {
    const SignalRow &r = lung.rows[points[k].row];
    EXPECT_EQ(points[k].phase, k < steps ? "inflation" : "deflation");
    EXPECT_NEAR(r.time, 2.3 * (k + 1), 1e-9);
    EXPECT_NEAR(r.volume, 90 * (k < steps ? k + 1 : 2 * steps - 1 - k), 1e-9);
    EXPECT_NEAR(r.pressure, lung.E * r.volume, 1e-9);
  }
  const ClinicalNumbers n = overall_numbers(lung.rows);
  EXPECT_NEAR(*n.static_curve_compliance, 80, 1e-8);
  EXPECT_NEAR(*n.static_compliance, 80, 1e-8);
  EXPECT_NEAR(*n.plateau_pressure, lung.E * 450, 1e-9); // the fullest pause, not the last
  EXPECT_NEAR(*n.pause_resistance, 4.2, 1e-9);
}

TEST(ExactCompartment, StaticCurveOfACurvedLung)
{
  // P = E V + V^2 / 1e6 at the pauses: the slope of pressure on volume by the sums of a textbook, inflation limb only
  Compartment lung;
  double x = 0, y = 0, xx = 0, xy = 0;
  for (int k = 1; k <= 4; ++k) {
    lung.flow(200, 0.5, 2, "filling", 1);
    lung.V = 100. * k;
    const double P = lung.E * lung.V + lung.V * lung.V * 1e-6;
    lung.add(1, 0, P, "wait", 1, true); // a hold by any name
    x += lung.V, y += P, xx += lung.V * lung.V, xy += lung.V * P;
  }
  for (int k = 3; k >= 1; --k) {
    lung.flow(-200, 0.5, 2, "emptying", 1);
    lung.add(1, 0, 100, "wait", 1, true); // nonsense that must not enter
  }
  const ClinicalNumbers n = overall_numbers(lung.rows);
  ASSERT_TRUE(n.static_curve_compliance);
  EXPECT_NEAR(*n.static_curve_compliance, (4 * xx - x * x) / (4 * xy - x * y), 1e-9);
  const auto points = static_points(lung.rows, 0, lung.rows.size() - 1);
  ASSERT_EQ(points.size(), 7u);
  EXPECT_EQ(points[6].phase, "emptying");
}

/// Volume control of @p breaths breaths with @p expiration s to breathe out.
std::vector<SignalRow> volume_control(int breaths, double expiration)
{
  Compartment lung;
  for (int breath = 1; breath <= breaths; ++breath) {
    lung.flow(500, 1, 8, "inspiration", breath);
    lung.flow(0, 0.25, 2, "pause", breath);
    lung.pressure(lung.peep, expiration, 400, "expiration", breath);
  }
  return lung.rows;
}

TEST(Steadiness, IsToldByTrappedVolumeAndTheBreathBefore)
{
  const double tau = 0.0042 / 0.0125;
  // a first breath that empties is steady, one that traps is not
  EXPECT_TRUE(unsteadiness(volume_control(1, 2))->steady());
  const auto first = unsteadiness(volume_control(1, 0.8));
  EXPECT_FALSE(first->steady());
  EXPECT_NEAR(first->change, std::exp(-0.8 / tau), 1e-9); // of the tidal volume
  // from breath to breath the trapped volume grows by exp(-T/tau) of what it grew before
  const double q = std::exp(-0.5 / tau);
  for (int breaths = 1; breaths <= 8; ++breaths) {
    const auto found = unsteadiness(volume_control(breaths, 0.5));
    if (breaths <= 2 || breaths >= 6) { // between them the fits settle, which the start shifts more than the volume
      EXPECT_EQ(found->steady(), breaths >= 6) << breaths;
    }
    EXPECT_GE(found->change, std::pow(q, breaths) * (1 - 1e-9)) << breaths;
  }
}

TEST(Steadiness, OverallNumbersOfALinearLungAreItsOwnHoweverMuchIsTrapped)
{
  const auto rows = volume_control(8, 0.5);
  const ClinicalNumbers overall = overall_numbers(rows);
  EXPECT_NEAR(*overall.compliance, 80, 1e-6);
  EXPECT_NEAR(*overall.resistance, 4.2, 1e-7);
  EXPECT_LT(*breath_numbers(rows).back().compliance, 70)
      << "the breath's own fit takes PEEP for the pressure of its start";
}

TEST(Settling, WhatIsStillToComeIsTheTailOfTheFlow)
{
  // backward Euler steps of a compartment that fills to 100 ml with time constant 0.4 s
  for (const double T : {0.5, 2.0, 6.0}) {
    std::vector<SignalRow> rows(1);
    const double dt = 0.05, tau = 0.4;
    for (int i = 1; i <= std::lround(T / dt) + 1; ++i) {
      SignalRow r;
      r.time = i * dt;
      r.dt = dt;
      r.volume = (rows.back().volume + dt / tau * 100) / (1 + dt / tau);
      r.flow = (r.volume - rows.back().volume) / dt;
      r.phase = i * dt <= T + 1e-9 ? "settle" : "inspiration";
      r.breath = i * dt <= T + 1e-9 ? 0 : 1;
      rows.push_back(r);
    }
    const double left = 100 - rows[rows.size() - 2].volume;
    ASSERT_TRUE(unsettled_volume(rows));
    EXPECT_NEAR(*unsettled_volume(rows), left, 1e-9 * 100) << T;
    SignalRow &end = *std::find_if(rows.rbegin(), rows.rend(), [](const SignalRow &r) { return r.breath == 0; });
    for (SignalRow &r : rows) r.rest_volume = 1000;
    (&end)[-1].flow = 1.0000001e-9; // rounding, which fades as it likes
    end.flow = 1e-9;
    EXPECT_EQ(*unsettled_volume(rows), 0) << T;
    for (SignalRow &r : rows) r.flow_resistance = false;
    EXPECT_FALSE(unsettled_volume(rows)) << "without resistance each state is at rest";
  }
  EXPECT_FALSE(unsettled_volume(compartment(0.0125, 0.0042, 0, 1, 0, 3))) << "a run that starts with its breath";
}

TEST(Numbers, AreEmptyWhereABreathDoesNotDefineThem)
{
  Compartment lung; // no pause
  lung.pressure(12, 1, 20, "inspiration", 1);
  lung.pressure(5, 2, 20, "expiration", 1);
  for (SignalRow &r : lung.rows) r.alveolar_pressure.reset(); // as without airflow
  const ClinicalNumbers n = overall_numbers(lung.rows);
  EXPECT_FALSE(n.plateau_pressure || n.pause_resistance || n.static_compliance || n.static_curve_compliance);
  EXPECT_FALSE(n.auto_peep || n.total_peep);
  EXPECT_TRUE(n.dynamic_compliance);
  EXPECT_TRUE(static_points(lung.rows, 0, lung.rows.size() - 1).empty());

  Compartment still; // a breath in which nothing happens
  still.flow(0, 1, 3, "pause", 1);
  const ClinicalNumbers m = overall_numbers(still.rows);
  EXPECT_FALSE(m.dynamic_compliance || m.static_compliance || m.pause_resistance || m.compliance);
  EXPECT_EQ(m.tidal_volume, 0);
}

// ------------------------------------------------------------------------------------- breaths that are none

/// A compartment of 80 ml/cmH2O and 4.2 cmH2O s/l whose volume follows @p V, of unit duration; lung of 2 l.
std::vector<SignalRow> follows(const std::function<double(double)> &V, double R = 4.2e-3)
{
  std::vector<SignalRow> rows;
  for (int i = 0; i <= 50; ++i) {
    SignalRow r;
    r.time = i / 50.;
    r.volume = V(r.time);
    r.dt = i == 0 ? 0 : 1 / 50.;
    r.flow = i == 0 ? 0 : (r.volume - rows.back().volume) / r.dt;
    r.pressure = r.volume / 80 + R * r.flow;
    r.phase = r.time <= 0.5 ? "inspiration" : "expiration";
    r.breath = 1;
    r.rest_volume = 2000;
    rows.push_back(r);
  }
  return rows;
}

std::optional<double> listed(const ClinicalNumbers &n, const std::string &key)
{
  for (const ClinicalEntry &e : clinical_entries(n, 1000))
    if (e.key == key) return e.value;
  ADD_FAILURE() << key;
  return {};
}

TEST(NoBreath, WhatFallsBelowItsStartHasNoTidalVolume)
{
  const auto wave = [](double size) { return [=](double t) { return size * std::sin(M_PI * t); }; };
  const ClinicalNumbers in = overall_numbers(follows(wave(400))), out = overall_numbers(follows(wave(-400)));
  EXPECT_TRUE(in.takes_in && in.moves);
  EXPECT_NEAR(*listed(in, "tidal_volume_ml"), 400, 1e-9);
  EXPECT_FALSE(out.takes_in);
  EXPECT_NEAR(out.fall, 400, 1e-9);
  for (const char *key : {"tidal_volume_ml", "strain", "dynamic_compliance_ml_per_cmH2O"}) {
    EXPECT_TRUE(listed(in, key)) << key;
    EXPECT_FALSE(listed(out, key)) << key;
  }
  EXPECT_NEAR(*out.compliance, 80, 1e-9); // the fit does not mind
  EXPECT_NEAR(*out.resistance, 4.2, 1e-9);
  EXPECT_TRUE(unsteadiness(follows(wave(400))));
  EXPECT_FALSE(unsteadiness(follows(wave(-400))));
}

TEST(NoBreath, NoResistanceIsNegative)
{
  const auto rows = follows([](double t) { return 400 * std::sin(M_PI * t); }, -4.2e-3);
  const ClinicalNumbers n = overall_numbers(rows);
  EXPECT_TRUE(n.compliance && n.equal_weight_compliance);
  EXPECT_FALSE(n.resistance || n.time_constant || n.equal_weight_resistance);
}

TEST(NoBreath, RoundingIsNotFitted)
{
  const auto wave = [](double size) { return follows([=](double t) { return size * std::sin(M_PI * t); }); };
  for (double size : {1e-13, 1e-7}) { // ml, of 2 l
    const ClinicalNumbers n = overall_numbers(wave(size));
    EXPECT_FALSE(n.moves) << size;
    EXPECT_FALSE(n.compliance || n.equal_weight_compliance || n.resistance || n.equal_weight_resistance ||
                 n.time_constant || n.dynamic_compliance)
        << size;
  }
  const ClinicalNumbers n = overall_numbers(wave(1e-4));
  EXPECT_NEAR(*n.compliance, 80, 1e-6);
  EXPECT_NEAR(*n.equal_weight_resistance, 4.2, 1e-6);
}

TEST(NoBreath, ALungThatShrinksUnderPressureIsFound)
{
  const auto wave = [](double size) { return [=](double t) { return size * std::sin(M_PI * t); }; };
  EXPECT_FALSE(shrinks_under_pressure(follows(wave(400))));
  EXPECT_FALSE(shrinks_under_pressure(follows(wave(-400)))); // sucked out
  auto rows = follows(wave(-400));
  for (SignalRow &r : rows) r.pressure = -r.pressure; // pressed, and shrinks
  ASSERT_TRUE(shrinks_under_pressure(rows));
  EXPECT_EQ(*shrinks_under_pressure(rows), 1U);
  for (SignalRow &r : rows) r.volume *= 1e-9; // rounding
  EXPECT_FALSE(shrinks_under_pressure(rows));
}

} // namespace
} // namespace pulmo::test
