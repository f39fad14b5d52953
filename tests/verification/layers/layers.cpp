// Columns of two layers, whose parameters jump at a plane of facets; see README.md beside this file.
//
//        sides on rollers, sealed
//      +----------------+----------------+
//   |> |     bottom     |      top       |  x1
//      +----------------+----------------+
//     X = 0            1/2               1 mm
#include "verification/support/column.hpp"
#include "verification/support/lattice.hpp"
#include "verification/support/scene_parts.hpp"

#include <limits>

using namespace pulmo;
using namespace pulmo::test;

namespace {

constexpr double middle = 0.5, side = 0.1, area = side * side; // mm, mm, mm^2

/// Yoshihara's law in uniaxial strain, W' = 2 c (J - J^(-2 beta - 1)), and a permeability.
struct Layer {
  double c = 1.298, beta = 0.75, k = 1; // kPa, -, mm^2/(kPa s)

  double stress(double J) const { return 2 * c * (J - std::pow(J, -2 * beta - 1)); }
  double slope(double J) const { return 2 * c * (1 + (2 * beta + 1) * std::pow(J, -2 * beta - 2)); }
  /// int (k/J) W'' dJ: what the flux is the gradient of.
  double potential(double J) const
  {
    return 2 * c * k * (std::log(J) - (2 * beta + 1) / (2 * beta + 2) * std::pow(J, -2 * beta - 2));
  }
  double J_of_stress(double s) const
  {
    return newton([this](double J) { return stress(J); }, [this](double J) { return slope(J); }, s);
  }
  double J_of_potential(double g) const
  {
    return newton([this](double J) { return potential(J); }, [this](double J) { return k / J * slope(J); }, g);
  }
  double modulus() const { return slope(1); }

private:
  /// @p f rises with J > 0.
  template <class F, class D>
  static double newton(F f, D d, double value)
  {
    double J = 1;
    for (int i = 0; i < 100; ++i) {
      const double next = std::max(J - (f(J) - value) / d(J), J / 2);
      if (std::abs(next - J) < 1e-15) break;
      J = next;
    }
    return J;
  }
};
using Layers = std::array<Layer, 2>;

std::string of_layers(const char *option, double a, double b)
{
  return " " + std::string(option) + " " + column::number(a) + ",top=" + column::number(b);
}

/// @p n bricks along X, an even number.
Lattice layered(int n)
{
  Lattice l = Lattice::box({n, 1, 1}, {1, side, side});
  l.part = [](const Lattice::Place &x) { return x[0] < middle ? "bottom" : "top"; };
  return l;
}

std::string options(const LatticeFile &mesh, const Layers &layers, const std::string &more, bool airflow = true)
{
  std::string s = "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " + mesh.path() +
                  " -mesh_scale 1 -tissue yoshihara -support -support_surfaces x0,y0,y1,z0,z1 -support_components_x0 x"
                  " -support_components_y0 y -support_components_y1 y -support_components_z0 z"
                  " -support_components_z1 z";
  s += of_layers("-tissue_c", layers[0].c, layers[1].c) + of_layers("-tissue_beta", layers[0].beta, layers[1].beta);
  if (airflow) s += " -airflow -airflow_surfaces x1" + of_layers("-airflow_permeability", layers[0].k, layers[1].k);
  return s + " " + more;
}

// --------------------------------------------------------------------------------------------------- static

/// Both layers bear the same stress: u is linear in each, and P2 has it to rounding.
void expect_uniaxial(const Layers &layers, double stress, const std::string &load)
{
  const LatticeFile mesh(layered(4));
  pulmo::Run run(Registry::standard());
  bool finished = false;
  PULMO_OK(prepare(run, options(mesh, layers, load, false)));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  const double J[2] = {layers[0].J_of_stress(stress), layers[1].J_of_stress(stress)};
  double worst_u = 0, worst_J = 0, worst_stress = 0;
  PULMO_OK(sample_rule(run.model().dm(), run.simulation().local_state(), 4, [&](const Sample &s) {
    const int top = s.x[0] > middle;
    const double u = (J[0] - 1) * std::min(s.x[0], middle) + (J[1] - 1) * std::max(s.x[0] - middle, 0.);
    worst_u = std::max(worst_u, std::abs(s.u[0] - u));
    worst_J = std::max(worst_J, std::abs(s.J() - J[top]));
    worst_stress = std::max(worst_stress, std::abs(layers[top].stress(s.J()) / stress - 1));
  }));
  const double V = area * middle * (J[0] + J[1] - 2);
  std::printf("  stress %6.3g kPa  J %.10f %.10f  errors: u %.1e mm  J %.1e  stress, relative %.1e\n", stress, J[0],
              J[1], worst_u, worst_J, worst_stress);
  EXPECT_LT(worst_u, 1e-11);
  EXPECT_LT(worst_J, 1e-10);
  EXPECT_NEAR(1000 * run.simulation().rows().back().volume, V, 1e-11 * area);
}

// --------------------------------------------------------------------------------------------------- steady flow

/// Gas at p_in at X = 0, nothing at X = 1, no load: p = W' in each layer, and q the same in both.
struct Steady {
  Layers layers;
  double p_in, p_middle, q;

  Steady(const Layers &both, double pressure) : layers(both), p_in(pressure)
  {
    double low = 0, high = p_in;
    for (int i = 0; i < 100; ++i) {
      p_middle = (low + high) / 2;
      (flux(0) > flux(1) ? low : high) = p_middle;
    }
    // the layer that resists tells it to more digits
    q = p_in - p_middle > p_middle ? flux(0) : flux(1);
  }
  /// Through a layer between the pressures at its ends, mm/s.
  double flux(int i) const
  {
    const Layer &l = layers[i];
    const double from = i == 0 ? p_in : p_middle, to = i == 0 ? p_middle : 0;
    return (l.potential(l.J_of_stress(from)) - l.potential(l.J_of_stress(to))) / middle;
  }
  double J(int i, double X) const
  {
    const Layer &l = layers[i];
    return i == 0 ? l.J_of_potential(l.potential(l.J_of_stress(p_in)) - q * X)
                  : l.J_of_potential(l.potential(l.J_of_stress(0)) + q * (1 - X));
  }
  double J(double X) const { return J(X > middle, X); }
  double p(double X) const { return layers[X > middle].stress(J(X)); }
  /// Simpson in each layer: J is smooth there.
  double u(double X) const
  {
    const auto part = [&](int i, double a, double b) {
      const int n = 8;
      double s = 0;
      for (int j = 0; j <= n; ++j) s += (j == 0 || j == n ? 1 : j % 2 ? 4 : 2) * (J(i, a + (b - a) * j / n) - 1);
      return s * (b - a) / n / 3;
    };
    return part(0, 0, std::min(X, middle)) + (X > middle ? part(1, middle, X) : 0);
  }
};

/// Over their scales: of the flux that leaves, and in L2 of the fields.
struct Errors {
  double q = 0, u = 0, p = 0, J = 0, traction = 0, flux = 0;
};

void steady(const Steady &exact, int n, Errors &e)
{
  const LatticeFile mesh(layered(n));
  Registry registry = Registry::standard();
  add_essential(registry, pressure, "x0",
                [p = exact.p_in](PetscReal, const PetscReal[3], PetscScalar v[3]) { v[0] = p; });
  pulmo::Run run(registry);
  bool finished = false;
  // one step, so long that what the tissue still takes up is nothing; Newton to what coefficients 1e6 apart leave to
  // rounding
  const std::string dt = column::number(1e6 / std::min(exact.layers[0].k, exact.layers[1].k));
  PULMO_OK(prepare(run, options(mesh, exact.layers,
                                "-ts_dt " + dt + " -ts_max_time " + dt + " -ts_adapt_dt_min " + dt +
                                    " -snes_rtol 1e-11 -snes_atol 1e-10")));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  e = Errors();
  e.q = std::abs(-1000 * run.simulation().rows().back().flow / area / exact.q - 1);
  double scale_u = 1e-300, scale_J = 1e-300, squares[5] = {0, 0, 0, 0, 0};
  PULMO_OK(sample_rule(run.model().dm(), run.simulation().local_state(), 4, [&](const Sample &s) {
    const double X = s.x[0], J = exact.J(X);
    const Layer &layer = exact.layers[X > middle];
    const double flux = layer.k / s.J() * s.grad_p[0]; // of uniaxial strain
    const double u = exact.u(X), p = layer.stress(J);
    scale_u = std::max(scale_u, std::abs(u));
    scale_J = std::max(scale_J, std::abs(J - 1));
    const double error[] = {s.u[0] - u, (s.p - p) / exact.p_in, s.J() - J, (layer.stress(s.J()) - s.p) / exact.p_in,
                            flux / exact.q + 1};
    for (int i = 0; i < 5; ++i) squares[i] += s.weight / area * error[i] * error[i];
  }));
  e.u = std::sqrt(squares[0]) / scale_u;
  e.p = std::sqrt(squares[1]);
  e.J = std::sqrt(squares[2]) / scale_J;
  e.traction = std::sqrt(squares[3]);
  e.flux = std::sqrt(squares[4]);
}

double order(double coarse, double fine)
{
  return std::log2(coarse / fine);
}

// --------------------------------------------------------------------------------------------------- in time

/// Consolidation of the two layers under a load at X = 1, where gas leaves: dJ/dt = d/dX (k/J dp/dX), p = W'(J) - T, by
/// finite volumes of @p n cells and backward Euler. Shares nothing with pulmo but the equation.
class Volumes {
public:
  Volumes(const Layers &layers, double load, int n) : layers_(layers), load_(load), n_(n), J_(n, 1.0) {}

  void step(double dt)
  {
    const std::vector<double> before = J_;
    const double h = 1. / n_;
    for (int iteration = 0; iteration < 60; ++iteration) {
      std::vector<double> below(n_), diagonal(n_), above(n_), right(n_);
      for (int i = 0; i < n_; ++i) {
        diagonal[i] = h / dt;
        right[i] = -(J_[i] - before[i]) * h / dt;
      }
      for (int face = 1; face <= n_; ++face) {
        // two halves of cells in series; the last one ends at p = 0
        const int a = face - 1, b = face;
        const double half_a = h / 2 * J_[a] / of(a).k, half_b = b < n_ ? h / 2 * J_[b] / of(b).k : 0;
        const double p_a = p(a), p_b = b < n_ ? p(b) : 0, conductance = 1 / (half_a + half_b);
        const double flux = conductance * (p_a - p_b), bend = -conductance * flux * h / 2;
        const double by_a = conductance * of(a).slope(J_[a]) + bend / of(a).k;
        const double by_b = b < n_ ? -conductance * of(b).slope(J_[b]) + bend / of(b).k : 0;
        right[a] -= flux;
        diagonal[a] += by_a;
        if (b == n_) continue;
        above[a] += by_b;
        right[b] += flux;
        diagonal[b] -= by_b;
        below[b] -= by_a;
      }
      for (int i = 1; i < n_; ++i) {
        const double f = below[i] / diagonal[i - 1];
        diagonal[i] -= f * above[i - 1];
        right[i] -= f * right[i - 1];
      }
      double largest = 0;
      for (int i = n_ - 1; i >= 0; --i) {
        right[i] = (right[i] - (i + 1 < n_ ? above[i] * right[i + 1] : 0)) / diagonal[i];
        largest = std::max(largest, std::abs(right[i]));
      }
      for (int i = 0; i < n_; ++i) J_[i] += right[i];
      if (largest < 1e-14) return;
    }
    ADD_FAILURE() << "finite volumes: Newton's method does not converge";
  }
  /// Extrapolated to the sealed end, where the slope is zero.
  double p_at_end() const { return (9 * p(0) - p(1)) / 8; }
  double volume() const
  {
    double sum = 0;
    for (const double J : J_) sum += J - 1;
    return area * sum / n_;
  }

private:
  const Layer &of(int i) const { return layers_[i >= n_ / 2]; }
  double p(int i) const { return of(i).stress(J_[i]) - load_; }

  Layers layers_;
  double load_;
  int n_;
  std::vector<double> J_;
};

/// The same at small strain, in modes: p = sum a_m phi_m (1 + lambda_m dt)^-steps, phi = cos or sin in each layer.
struct Modes {
  std::vector<double> rate, amplitude, at_end, taken; ///< taken: int phi / M, what the mode still has to give

  explicit Modes(const Layers &l, double p0, int count)
  {
    const double M[2] = {l[0].modulus(), l[1].modulus()};
    const auto wave = [&](int i, double root) { return root / std::sqrt(l[i].k * M[i]); };
    // k phi' of both layers is the same at the interface, and so is phi
    const auto mismatch = [&](double root) {
      const double a = wave(0, root), b = wave(1, root);
      return l[0].k * a * std::sin(a * middle) * std::sin(b * middle) -
             l[1].k * b * std::cos(a * middle) * std::cos(b * middle);
    };
    const double travel = middle / std::sqrt(l[0].k * M[0]) + middle / std::sqrt(l[1].k * M[1]);
    for (double step = 1e-2 / travel, root = step / 2; static_cast<int>(rate.size()) < count; root += step) {
      double low = root, high = root + step;
      if (mismatch(low) * mismatch(high) > 0) continue;
      for (int i = 0; i < 200; ++i) {
        const double half = (low + high) / 2;
        (mismatch(low) * mismatch(half) > 0 ? low : high) = half;
      }
      const double a = wave(0, low), b = wave(1, low);
      const double B = std::cos(a * middle) / std::sin(b * middle); // of sin(b (1 - X)) beside cos(a X)
      const double mean = std::sin(a * middle) / a / M[0] + B * (1 - std::cos(b * middle)) / b / M[1];
      const double square = (middle / 2 + std::sin(2 * a * middle) / (4 * a)) / M[0] +
                            B * B * (middle / 2 - std::sin(2 * b * middle) / (4 * b)) / M[1];
      rate.push_back(low * low);
      amplitude.push_back(p0 * mean / square);
      at_end.push_back(1);
      taken.push_back(mean);
    }
  }
  double decay(std::size_t m, double t, int steps) const
  {
    return steps == 0 ? std::exp(-rate[m] * t) : std::pow(1 + rate[m] * t / steps, -steps);
  }
  double p_at_end(double t, int steps) const
  {
    double sum = 0;
    for (std::size_t m = 0; m < rate.size(); ++m) sum += amplitude[m] * decay(m, t, steps);
    return sum;
  }
  /// Of int (J - 1): (p - p0) / M.
  double volume(const Layers &l, double p0, double t, int steps) const
  {
    double sum = -p0 * middle * (1 / l[0].modulus() + 1 / l[1].modulus());
    for (std::size_t m = 0; m < rate.size(); ++m) sum += amplitude[m] * taken[m] * decay(m, t, steps);
    return area * sum;
  }
};

struct Consolidated {
  double p, V;
};

void consolidate(const Layers &layers, double load, double t, int steps, int n, Consolidated &result)
{
  const LatticeFile mesh(layered(n));
  pulmo::Run run(Registry::standard());
  bool finished = false;
  PULMO_OK(
      prepare(run, options(mesh, layers,
                           "-traction -traction_surfaces x1 -traction_value " + column::number(load) +
                               ",0,0 -ts_max_time " + column::number(t) + " -ts_dt " + column::number(t / steps))));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  ASSERT_EQ(run.simulation().rows().size(), static_cast<std::size_t>(steps + 1));
  column::Ends ends;
  PULMO_OK(column::read_ends(run.model().dm(), run.simulation().local_state(), ends));
  result = {ends.p0, 1000 * run.simulation().rows().back().volume};
}

/// The bottom layer drains through the top one, which is stiffer and tighter.
const Layers drained{Layer{1.298, 0.75, 0.4}, Layer{5, 1.2, 0.05}};

/// The drained layers under @p load after @p steps steps to time @p t, on finer and finer meshes, against p at the
/// sealed end (kPa) and the change of volume (mm^3).
void expect_convergence(double load, double t, int steps, double p, double V)
{
  Consolidated r[3];
  for (int i = 0; i < 3; ++i) {
    ASSERT_NO_FATAL_FAILURE(consolidate(drained, load, t, steps, 8 << i, r[i]));
    std::printf("  h 1/%-3d p(0)/exact - 1 %9.2e  V/exact - 1 %9.2e\n", 8 << i, r[i].p / p - 1, r[i].V / V - 1);
  }
  EXPECT_NEAR(r[2].p / p, 1, 1e-3);
  EXPECT_NEAR(r[2].V / V, 1, 1e-3);
  EXPECT_GT(order(std::abs(r[1].V / V - 1), std::abs(r[2].V / V - 1)), 1.7);
}

} // namespace

TEST(Layers, StaticStrainUnderTraction)
{
  const Layers mild{Layer{1.298, 0.75, 1}, Layer{2.6, 1.5, 1}};
  for (const double T : {-2., -0.5, 1.5})
    expect_uniaxial(mild, T, "-traction -traction_surfaces x1 -traction_value " + column::number(T) + ",0,0");
  for (const double ratio : {1e3, 1e6})
    for (const bool stiff_top : {false, true}) {
      Layers l{Layer{}, Layer{}};
      l[stiff_top].c *= ratio;
      // rows have the scale of the softer layer: what rounding leaves in a layer 1e6 times as stiff is 1e-10
      expect_uniaxial(l, 1.5, "-traction -traction_surfaces x1 -traction_value 1.5,0,0 -snes_atol 1e-8");
    }
}

TEST(Layers, StaticStrainUnderGasPressure)
{
  const Layers layers{Layer{1.298, 0.75, 1}, Layer{0.8, 0.5, 1}};
  const double pip = 8; // cmH2O; no wall takes it up, so that the tissue's stress is the pressure
  expect_uniaxial(
      layers, pip * 0.0980665,
      "-lumen_pressure off -ventilator pcv -ventilator_pip 8 -ventilator_inspiration 1 -ventilator_ramp 0.1 "
      "-ventilator_expiration 1 -ts_max_time 1 -ts_dt 0.5");
}

TEST(Layers, SteadyFlowAtSmallStrainIsThatOfResistancesInSeries)
{
  constexpr double p_in = 1e-6;
  for (const double k_ratio : {10., 1e3, 1e6})
    for (const bool open_top : {false, true}) {
      Layers l{Layer{}, Layer{}};
      l[open_top].k *= k_ratio;
      const double series = p_in / (middle / l[0].k + middle / l[1].k);
      const Steady exact(l, p_in);
      Errors e;
      EXPECT_NEAR(exact.q / series, 1, 1e-5); // the closed form itself
      ASSERT_NO_FATAL_FAILURE(steady(exact, 4, e));
      std::printf("  k %-7g %-7g  q/q_series - 1 %.1e  p %.1e  flux %.1e\n", l[0].k, l[1].k,
                  std::abs(exact.q * (1 + e.q) / series - 1), e.p, e.flux);
      EXPECT_LT(e.q, 1e-5);
      EXPECT_LT(e.p, 1e-6); // linear in each layer: P1 has it
      EXPECT_LT(e.flux, 1e-5);
    }
}

TEST(Layers, SteadyFlowAtFiniteStrain)
{
  struct {
    const char *name;
    Layers layers;
  } columns[] = {{"c 2, beta, k 0.1", {Layer{1.298, 0.75, 1}, Layer{2.6, 1.5, 0.1}}},
                 {"k 1e6 below", {Layer{1.298, 0.75, 1e6}, Layer{}}},
                 {"k 1e6 above", {Layer{}, Layer{1.298, 0.75, 1e6}}},
                 {"c 1e3 above", {Layer{}, Layer{1298, 0.75, 1}}},
                 {"c 1e6 above", {Layer{}, Layer{1298e3, 0.75, 1}}},
                 {"c 1e6 below", {Layer{1298e3, 0.75, 1}, Layer{}}},
                 {"c 1e3, k 1e-6 above", {Layer{}, Layer{1298, 0.75, 1e-6}}}};
  for (const auto &c : columns) {
    const Steady exact(c.layers, 0.5);
    EXPECT_NEAR(exact.flux(0) / exact.q, 1, 1e-6);
    EXPECT_NEAR(exact.p(middle - 1e-12) - exact.p(middle + 1e-12), 0, 1e-6);
    Errors e[3];
    std::printf("  %s: q %.8g mm/s, J at the interface %.6f %.6f\n", c.name, exact.q, exact.J(0, middle),
                exact.J(1, middle));
    for (int i = 0; i < 3; ++i) {
      ASSERT_NO_FATAL_FAILURE(steady(exact, 8 << i, e[i]));
      std::printf("    h 1/%-3d q %.2e  u %.2e  p %.2e  J %.2e  traction %.2e  flux %.2e\n", 8 << i, e[i].q, e[i].u,
                  e[i].p, e[i].J, e[i].traction, e[i].flux);
    }
    const auto expect_order = [&](const char *what, double Errors::*v, double least) {
      const double o = order(e[1].*v, e[2].*v);
      std::printf("    order of %s %.2f\n", what, o);
      if (e[2].*v > 1e-9) { // below that it is rounding
        EXPECT_GT(o, least) << what;
      }
    };
    expect_order("u", &Errors::u, 1.8);
    expect_order("p", &Errors::p, 1.8);
    expect_order("J", &Errors::J, 1.8);
    expect_order("traction", &Errors::traction, 1.8);
    expect_order("flux", &Errors::flux, 0.9);
    EXPECT_LT(e[2].q, 1e-6); // the consistent flux: exact but for what the tissue still takes up
    EXPECT_LT(e[2].u, 1e-3);
    EXPECT_LT(e[2].p, 1e-3);
    EXPECT_LT(e[2].J, 1e-2);
  }
}

TEST(Layers, ConsolidationAtSmallStrainIsThatOfTheModes)
{
  constexpr double load = -1e-5, t = 0.2;
  constexpr int steps = 10;
  const Modes modes(drained, -load, 400);
  const double p = modes.p_at_end(t, steps), V = modes.volume(drained, -load, t, steps);
  { // the solver of the next test against the same modes
    Volumes fine(drained, load, 800);
    for (int i = 0; i < steps; ++i) fine.step(t / steps);
    EXPECT_NEAR(fine.p_at_end() / p, 1, 5e-5);
    EXPECT_NEAR(fine.volume() / V, 1, 5e-5);
  }
  expect_convergence(load, t, steps, p, V);
}

TEST(Layers, ConsolidationAtFiniteStrainIsThatOfFiniteVolumes)
{
  constexpr double load = -1, t = 0.2;
  constexpr int steps = 10;
  Consolidated fv[2];
  for (int i = 0; i < 2; ++i) {
    Volumes solver(drained, load, 500 << i);
    for (int s = 0; s < steps; ++s) solver.step(t / steps);
    fv[i] = {solver.p_at_end(), solver.volume()};
  }
  // order 2: extrapolated
  const double p = (4 * fv[1].p - fv[0].p) / 3, V = (4 * fv[1].V - fv[0].V) / 3;
  std::printf("  finite volumes: p(0) %.9f kPa (500 cells %.1e off)  V %.9g mm^3 (%.1e)\n", p, fv[0].p / p - 1, V,
              fv[0].V / V - 1);
  expect_convergence(load, t, steps, p, V);
}
