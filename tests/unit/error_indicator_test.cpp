// The indicators of the error in space against the true errors of interpolated fields.
#include "pulmo/observers/error_indicator.hpp"

#include "unit/scenes.hpp"
#include "verification/support/error_norms.hpp"

#include <algorithm>
#include <array>
#include <cmath>

using namespace pulmo;
using namespace pulmo::test;

namespace {

/// A displacement and a pressure with their gradients.
struct Field {
  VectorFunction u;
  std::function<std::array<double, 9>(const double[3])> grad_u;
  ScalarFunction p;
  VectorFunction grad_p;
};

Field affine()
{
  const std::array<double, 9> G{0.2, 0.1, -0.05, 0.03, 0.15, 0.08, -0.1, 0.02, 0.3};
  const std::array<double, 3> g{0.3, -0.2, 0.5};
  return {[G](const double x[3]) {
            std::array<double, 3> u{0.1, 0, -0.2};
            for (int i = 0; i < 9; ++i) u[i / 3] += G[i] * x[i % 3];
            return u;
          },
          [G](const double[3]) { return G; },
          [g](const double x[3]) { return 0.4 + g[0] * x[0] + g[1] * x[1] + g[2] * x[2]; },
          [g](const double[3]) { return g; }};
}

Field waves()
{
  return {[](const double x[3]) {
            return std::array<double, 3>{0.1 * x[0] + 0.04 * std::sin(2 * x[0] + x[1]),
                                         0.1 * x[1] + 0.03 * std::cos(x[0] - 2 * x[2]),
                                         0.1 * x[2] + 0.05 * std::exp(x[2] - x[1])};
          },
          [](const double x[3]) {
            const double a = 0.04 * std::cos(2 * x[0] + x[1]), b = -0.03 * std::sin(x[0] - 2 * x[2]),
                         c = 0.05 * std::exp(x[2] - x[1]);
            return std::array<double, 9>{0.1 + 2 * a, a, 0, b, 0.1, -2 * b, 0, -c, 0.1 + c};
          },
          [](const double x[3]) { return 0.4 + std::sin(2 * x[0]) * std::exp(x[1]) + x[2] * x[2]; },
          [](const double x[3]) {
            return std::array<double, 3>{2 * std::cos(2 * x[0]) * std::exp(x[1]), std::sin(2 * x[0]) * std::exp(x[1]),
                                         2 * x[2]};
          }};
}

/// A field that is smooth but for the neighbourhood of a corner.
Field peak()
{
  const auto bump = [](const double x[3]) { return std::exp(-20 * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2])); };
  return {[bump](const double x[3]) {
            return std::array<double, 3>{0.05 * bump(x), 0.02 * x[1], 0.02 * x[2]};
          },
          [bump](const double x[3]) {
            const double b = -2 * bump(x);
            return std::array<double, 9>{b * x[0], b * x[1], b * x[2], 0, 0.02, 0, 0, 0, 0.02};
          },
          [bump](const double x[3]) { return 0.3 + bump(x); },
          [bump](const double x[3]) {
            const double b = -40 * bump(x);
            return std::array<double, 3>{b * x[0], b * x[1], b * x[2]};
          }};
}

double total(const std::vector<PetscScalar> &cells)
{
  double sum = 0;
  for (double v : cells) sum += v;
  return std::sqrt(sum);
}

/// The share of the cells' sum that the fiftieth of the cells with the largest @p by has.
double share_of_largest(const std::vector<PetscScalar> &cells, const std::vector<PetscScalar> &by)
{
  std::vector<std::size_t> order(cells.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return by[a] > by[b]; });
  double sum = 0;
  for (std::size_t i = 0; i < order.size() / 50; ++i) sum += cells[order[i]];
  return sum / std::pow(total(cells), 2);
}

/// The interpolant of @p field on the cube of 24 cells, refined @p levels times: what is estimated and what is true.
PetscErrorCode compare(const Field &field, int levels, CellErrors &estimate, CellErrors &truth)
{
  constexpr double k = 0.7; // of SceneSpec
  SceneSpec spec;
  SceneRun run{Registry::standard()};
  VecHandle local;

  PetscFunctionBeginUser;
  spec.airflow = true;
  spec.support = "rigid";
  spec.more = "-dm_refine " + std::to_string(levels);
  PetscCall(prepare(run, spec.options()));
  PetscCall(DMCreateLocalVector(run.model().dm(), local.out()));
  PetscCall(interpolate(run, local, field.u, field.p));
  ErrorIndicator indicator(run.scene(), run.model());
  PetscCall(indicator.setup());
  PetscCall(indicator.estimate(local, estimate));

  const TissueLaw &law = run.scene().tissue().law();
  const auto n_cells = static_cast<std::size_t>(run.model().assembly().cells());
  std::size_t visits = 0, points = 0;
  const auto each_point = [&](const std::function<void(std::size_t, const test::Sample &)> &visit) {
    visits = 0;
    return sample_rule(run.model().dm(), local, 4, [&](const test::Sample &s) {
      if (points > 0) visit(visits / points, s);
      ++visits;
    });
  };
  PetscCall(each_point({}));
  points = visits / n_cells;
  truth.tissue.assign(n_cells, 0);
  truth.flow.assign(n_cells, 0);
  truth.stress = truth.dissipation = 0;
  PetscCall(each_point([&](std::size_t c, const test::Sample &s) {
    const ErrorDensity e =
        error_density(law, run.model().modulus(), k, s, field.grad_u(s.x).data(), field.grad_p(s.x).data());
    truth.tissue[c] += s.weight * e.tissue;
    truth.flow[c] += s.weight * e.flow;
    truth.stress += s.weight * e.stress;
    truth.dissipation += s.weight * e.dissipation;
  }));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

TEST(ErrorIndicator, UniformDeformationAndFlowHaveNone)
{
  for (int levels : {0, 1}) {
    CellErrors estimate, truth;
    PULMO_OK(compare(affine(), levels, estimate, truth));
    ASSERT_EQ(estimate.tissue.size(), static_cast<std::size_t>(levels ? 192 : 24));
    EXPECT_GT(truth.stress, 1e-9);
    EXPECT_GT(truth.dissipation, 1e-9);
    EXPECT_NEAR(estimate.stress, truth.stress, 1e-10 * truth.stress);
    EXPECT_NEAR(estimate.dissipation, truth.dissipation, 1e-10 * truth.dissipation);
    EXPECT_LT(total(estimate.tissue), 1e-11 * std::sqrt(truth.stress));
    EXPECT_LT(total(estimate.flow), 1e-11 * std::sqrt(truth.dissipation));
  }
}

// Grad u of P2 has order 2, Grad p of P1 order 1; the indicators follow the true errors.
TEST(ErrorIndicator, SmoothFields)
{
  double before[2][2] = {};
  for (int levels = 0; levels <= 3; ++levels) {
    CellErrors estimate, truth;
    PULMO_OK(compare(waves(), levels, estimate, truth));
    for (int flow = 0; flow < 2; ++flow) {
      const double e = total(flow ? truth.flow : truth.tissue), eta = total(flow ? estimate.flow : estimate.tissue);
      const double order[2] = {std::log2(before[flow][0] / e), std::log2(before[flow][1] / eta)};
      std::printf("  %-6s h 1/%-2d  true %.3e  estimated %.3e  effectivity %.3f  orders %.2f %.2f\n",
                  flow ? "flow" : "tissue", 1 << (levels + 1), e, eta, eta / e, order[0], order[1]);
      before[flow][0] = e;
      before[flow][1] = eta;
      if (levels < 2) continue;
      EXPECT_GT(eta, 0.85 * e);
      EXPECT_LT(eta, 1.1 * e);
      if (levels < 3) continue;
      for (double measured : order) EXPECT_NEAR(measured, flow ? 1 : 2, 0.1);
    }
  }
}

TEST(ErrorIndicator, LargeWhereTheErrorIs)
{
  CellErrors estimate, truth;
  PULMO_OK(compare(peak(), 3, estimate, truth));
  for (int flow = 0; flow < 2; ++flow) {
    const auto &e = flow ? truth.flow : truth.tissue, &eta = flow ? estimate.flow : estimate.tissue;
    const double chosen = share_of_largest(e, eta), best = share_of_largest(e, e);
    std::printf(
        "  %-6s error in a fiftieth of the cells: %.3f chosen by the indicator, %.3f at most; effectivity %.3f\n",
        flow ? "flow" : "tissue", chosen, best, total(eta) / total(e));
    EXPECT_GT(best, 0.5) << "no peak: nothing tested";
    EXPECT_GT(chosen, 0.9 * best);
    EXPECT_GT(total(eta), 0.8 * total(e));
    EXPECT_LT(total(eta), 1.4 * total(e));
  }
}
