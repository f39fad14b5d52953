// Manufactured solutions, four ways: discretisation error, residual, Jacobian by Taylor order, Jacobian by finite
// differences; and the order in time. See README.md beside this file.
//
//   unit cube, faces           u          p      natural terms
//     x0                   essential     flux    Q.N
//     x1                     spring    essential P N + K u   (pulmo's chest_wall carries -K u)
//     y0                   essential     flux    Q.N
//     y1               pressurised wall  flux    P N + p cof F N, Q.N  (pulmo's lumen_pressure carries -p cof F N)
//     z0                    traction   essential P N
//     z1             z essential, else   flux    P N, Q.N
//                           traction
#include "pulmo/observers/error_indicator.hpp"
#include "support/scene.hpp"
#include "verification/mms/sources.hpp"
#include "verification/support/error_norms.hpp"
#include "verification/support/integrators.hpp"
#include "verification/support/scene_parts.hpp"

#include <cmath>
#include <string>
#include <vector>

using namespace pulmo;
using namespace pulmo::test;

namespace {

template <class Law, class Solution>
class ManufacturedLoads final : public TestEffect {
public:
  explicit ManufacturedLoads(bool weak) : weak_(weak) {}
  const char *name() const override { return "manufactured"; }
  const char *about() const override { return "loads of a manufactured solution (verification)"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using S = mms::Sources<Law, Solution>;
    using P = NoParameters;
    using Wall = typename S::Wall;
    if (weak_) {
      c.residual("exact stress", displacement, f1(volume_residual<P, S::stress>));
      c.residual("exact rate and flux", pressure, f0(volume_residual<P, S::rate>), f1(volume_residual<P, S::flux>));
      return PETSC_SUCCESS;
    }
    c.residual("body force", displacement, f0(volume_residual<P, S::body_force>));
    c.residual("mass source", pressure, f0(volume_residual<P, S::mass_source>));
    c.surface_residual("traction", "x1", displacement, f0(surface_residual<P, S::template traction<Wall::sprung>>));
    c.surface_residual("traction", "y1", displacement,
                       f0(surface_residual<P, S::template traction<Wall::pressurised>>));
    for (const char *face : {"z0", "z1"})
      c.surface_residual("traction", face, displacement, f0(surface_residual<P, S::template traction<Wall::plain>>));
    for (const char *face : {"x0", "y0", "y1", "z1"})
      c.surface_residual("outflow", face, pressure, f0(surface_residual<P, S::outflow>));
    return PETSC_SUCCESS;
  }

private:
  bool weak_;
};

template <class Law, class Solution>
Registry manufactured(bool weak)
{
  Registry r = Registry::standard();
  r.permeability_law<mms::RationalPermeability>();
  r.effect([weak] { return std::make_unique<ManufacturedLoads<Law, Solution>>(weak); });
  const auto u = [](PetscReal t, const PetscReal x[3], PetscScalar v[3]) {
    double grad_u[9], p, grad_p[3];
    mms::values<Solution>(t, x, v, grad_u, p, grad_p);
  };
  const auto p = [](PetscReal t, const PetscReal x[3], PetscScalar v[3]) {
    double u_values[3], grad_u[9], grad_p[3];
    mms::values<Solution>(t, x, u_values, grad_u, v[0], grad_p);
  };
  add_essential(r, displacement, "x0", u);
  add_essential(r, displacement, "y0", u);
  add_essential(r, displacement, "z1", u, "z");
  add_essential(r, pressure, "x1", p); // replaces the 0 of -airflow_surfaces
  add_essential(r, pressure, "z0", p);
  return r;
}

std::string options(const char *law, const std::string &mesh, double dt, bool weak)
{
  return "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
         source("meshes/" + mesh + ".msh") + " -tissue " + law +
         " -snes_rtol 1e-11 -snes_atol 1e-11 -airflow -airflow_surfaces x1 -airflow_permeability_law rational "
         "-ts_max_time 1 -ts_dt " +
         std::to_string(dt) +
         (weak ? ""
               : " -lumen_pressure -lumen_pressure_surfaces y1 -chest_wall -chest_wall_surfaces x1 "
                 "-chest_wall_stiffness " +
                     std::to_string(mms::spring));
}

struct Errors {
  double u = 0, grad_u = 0, p = 0, grad_p = 0; ///< L2 over the reference volume
  double tissue = 0, flow = 0;                 ///< in the norms of the error indicators, their estimates
  double estimated_tissue = 0, estimated_flow = 0;
};

template <class Solution>
PetscErrorCode errors(pulmo::Run &run, Vec local, double t, Errors &e)
{
  const DM dm = run.model().dm();
  const TissueLaw &law = run.scene().tissue().law();
  ErrorIndicator indicator(run.scene(), run.model());
  CellErrors estimate;

  PetscFunctionBeginUser;
  e = Errors();
  PetscCall(sample_rule(dm, local, 6, [&](const pulmo::test::Sample &s) {
    double u[3], grad_u[9], p, grad_p[3];
    mms::values<Solution>(t, s.x, u, grad_u, p, grad_p);
    const auto square = [](double v) { return v * v; };
    for (int i = 0; i < 3; ++i) e.u += s.weight * square(s.u[i] - u[i]);
    for (int i = 0; i < 9; ++i) e.grad_u += s.weight * square(s.grad_u[i] - grad_u[i]);
    e.p += s.weight * square(s.p - p);
    for (int i = 0; i < 3; ++i) e.grad_p += s.weight * square(s.grad_p[i] - grad_p[i]);
    const double k = mms::RationalPermeability::permeability(s.J(), {}).k;
    const ErrorDensity in_norms = error_density(law, run.model().modulus(), k, s, grad_u, grad_p);
    e.tissue += s.weight * in_norms.tissue;
    e.flow += s.weight * in_norms.flow;
  }));
  PetscCall(indicator.setup());
  PetscCall(indicator.estimate(local, estimate));
  for (double v : estimate.tissue) e.estimated_tissue += v;
  for (double v : estimate.flow) e.estimated_flow += v;
  for (double *v : {&e.u, &e.grad_u, &e.p, &e.grad_p, &e.tissue, &e.flow, &e.estimated_tissue, &e.estimated_flow})
    *v = std::sqrt(*v);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A problem taken apart: residual and Jacobian at states of one's own, without a solver.
class Bench {
public:
  template <class Law, class Solution>
  PetscErrorCode setup(const std::string &mesh, double dt, double t)
  {
    PetscFunctionBeginUser;
    dt_ = dt;
    t_ = t;
    run_ = std::make_unique<pulmo::Run>(manufactured<Law, Solution>(false));
    PetscCall(prepare(*run_, options(Law::name, mesh, dt, false)));
    PetscCall(DMCreateLocalVector(dm(), x_.out()));
    PetscCall(DMCreateLocalVector(dm(), before_.out()));
    PetscCall(DMCreateLocalVector(dm(), rate_.out()));
    PetscCall(DMCreateLocalVector(dm(), local_.out()));
    PetscCall(interpolate<Solution>(t, x_));
    PetscCall(interpolate<Solution>(t - dt, before_));
    PetscCall(model().set_step(dt, 0));
    PetscCall(DMCreateGlobalVector(dm(), field_.out()));
    PetscCall(VecZeroEntries(local_));
    PetscCall(for_each_dof([this](PetscInt, PetscInt field, PetscInt first, PetscInt n) {
      WriteArray a(local_);
      for (PetscInt i = 0; i < n; ++i) a[first + i] = field;
      return PetscErrorCode(PETSC_SUCCESS);
    }));
    PetscCall(DMLocalToGlobal(dm(), local_, INSERT_VALUES, field_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  DM dm() { return run_->model().dm(); }
  Model &model() { return run_->model(); }
  Vec field() { return field_; } ///< 0 or 1: the field of each entry of a global vector
  PetscErrorCode exact(Vec X)    ///< the interpolant
  {
    return DMLocalToGlobal(dm(), x_, INSERT_VALUES, X);
  }
  /// Dimensionless residual of a global vector; the rate is that of a step from the interpolant at t - dt.
  PetscErrorCode residual(Vec X, Vec F)
  {
    PetscFunctionBeginUser;
    PetscCall(spread(X));
    PetscCall(model().residual(t_, x_, rate_, local_));
    PetscCall(VecZeroEntries(F));
    PetscCall(DMLocalToGlobal(dm(), local_, ADD_VALUES, F));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscErrorCode jacobian(Vec X, Mat A)
  {
    PetscFunctionBeginUser;
    PetscCall(spread(X));
    PetscCall(model().jacobian(t_, x_, rate_, 1 / dt_, A));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// Norms of the entries of each field.
  PetscErrorCode norms(Vec F, double norm[2])
  {
    PetscInt n;
    PetscFunctionBeginUser;
    PetscCall(VecGetLocalSize(F, &n));
    const ReadArray f(F), which(field_);
    norm[0] = norm[1] = 0;
    for (PetscInt i = 0; i < n; ++i) norm[which[i] > 0.5] += f[i] * f[i];
    for (int i = 0; i < 2; ++i) norm[i] = std::sqrt(norm[i]);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  template <class F>
  PetscErrorCode for_each_dof(F f)
  {
    PetscSection section;
    PetscInt begin, end;
    PetscFunctionBeginUser;
    PetscCall(DMGetLocalSection(dm(), &section));
    PetscCall(PetscSectionGetChart(section, &begin, &end));
    for (PetscInt p = begin; p < end; ++p)
      for (PetscInt field = 0; field < 2; ++field) {
        PetscInt n, first;
        PetscCall(PetscSectionGetFieldDof(section, p, field, &n));
        PetscCall(PetscSectionGetFieldOffset(section, p, field, &first));
        if (n > 0) PetscCall(f(p, field, first, n));
      }
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  template <class Solution>
  PetscErrorCode interpolate(double t, Vec local)
  {
    PetscFunctionBeginUser;
    PetscCall(for_each_dof([&](PetscInt point, PetscInt field, PetscInt first, PetscInt n) {
      PetscReal x[3];
      double u[3], grad_u[9], p, grad_p[3];
      PetscFunctionBeginUser;
      PetscCall(run_->scene().mesh().node_coordinates(point, x));
      mms::values<Solution>(t, x, u, grad_u, p, grad_p);
      WriteArray a(local);
      for (PetscInt i = 0; i < n; ++i) a[first + i] = field == displacement ? u[i] : p;
      PetscFunctionReturn(PETSC_SUCCESS);
    }));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscErrorCode spread(Vec X)
  {
    PetscFunctionBeginUser;
    PetscCall(DMGlobalToLocal(dm(), X, INSERT_VALUES, x_)); // constrained values stay
    PetscCall(VecWAXPY(rate_, -1, before_, x_));
    PetscCall(VecScale(rate_, 1 / dt_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::unique_ptr<pulmo::Run> run_;
  VecHandle x_, before_, rate_, local_, field_;
  double dt_ = 1, t_ = 1;
};

double order(double coarse, double fine)
{
  return std::log2(coarse / fine);
}

/// Entries between -1 and 1 that look random and are the same everywhere.
PetscErrorCode scatter_values(Vec v, double scale)
{
  PetscInt n;
  PetscFunctionBeginUser;
  PetscCall(VecGetLocalSize(v, &n));
  WriteArray a(v);
  for (PetscInt i = 0; i < n; ++i) {
    const double s = std::sin(12.9898 * (i + 1)) * 43758.5453;
    a[i] = scale * (2 * (s - std::floor(s)) - 1);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

template <class L>
class Manufactured : public ::testing::Test {};
using Laws = ::testing::Types<mms::Yoshihara, mms::Birzle, mms::Berger, mms::Ma, mms::Rausch, mms::Patte>;
/// Runs from rest. Not rausch: its shear modulus vanishes at F = I, and Newton ends in another equilibrium of the same
/// discrete equations (README.md).
template <class L>
class ManufacturedRun : public ::testing::Test {};
using LawsWithShearModulus = ::testing::Types<mms::Yoshihara, mms::Birzle, mms::Berger, mms::Ma, mms::Patte>;
class LawNames {
public:
  template <class L>
  static std::string GetName(int)
  {
    return L::name;
  }
};
template <class L>
struct Names;
template <class... L>
struct Names<::testing::Types<L...>> {
  static bool has(const std::string &law) { return ((law == L::name) || ...); }
};
TEST(ManufacturedLaws, EveryLawHasOne)
{
  std::string without;
  for (const auto &law : pulmo::Registry::standard().make_tissue_laws())
    if (!Names<Laws>::has(law->name())) without += std::string(" ") + law->name();
  if (!without.empty())
    GTEST_SKIP() << "manufactured.hpp has no template of" << without << ": no manufactured solution";
}

TYPED_TEST_SUITE(Manufactured, Laws, LawNames);
TYPED_TEST_SUITE(ManufacturedRun, LawsWithShearModulus, LawNames);

/// Laws that get all three meshes; the others two.
template <class L>
constexpr bool three_meshes = std::is_same_v<L, mms::Yoshihara> || std::is_same_v<L, mms::Birzle>;

/// Errors on @p meshes, h halved each time; four steps of 0.25 s.
template <class Law, class Solution>
void convergence(const std::vector<std::string> &meshes, const std::string &more, std::vector<Errors> &e)
{
  for (const std::string &mesh : meshes) {
    pulmo::Run run(manufactured<Law, Solution>(false));
    bool finished = false;
    PULMO_OK(prepare(run, options(Law::name, mesh, 0.25, false) + " " + more));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    ASSERT_NEAR(run.simulation().time(), 1, 1e-9);
    e.emplace_back();
    PULMO_OK(errors<Solution>(run, run.simulation().local_state(), 1, e.back()));
    std::printf("  %-9s %-11s J %.2f..%.2f  u %.3e  Grad u %.3e  p %.3e  Grad p %.3e", Law::name, mesh.c_str(),
                run.simulation().rows().back().min_J, run.simulation().rows().back().max_J, e.back().u, e.back().grad_u,
                e.back().p, e.back().grad_p);
    if (e.size() > 1) {
      const Errors &c = e[e.size() - 2], &f = e.back();
      std::printf("  orders %.2f %.2f %.2f %.2f", order(c.u, f.u), order(c.grad_u, f.grad_u), order(c.p, f.p),
                  order(c.grad_p, f.grad_p));
    }
    if (more.empty()) // the indicators are those of P2-P1
      std::printf("  effectivity of the indicators %.3f %.3f", e.back().estimated_tissue / e.back().tissue,
                  e.back().estimated_flow / e.back().flow);
    std::printf("\n");
  }
  EXPECT_GT(e.back().u, 1e-8) << "an error of nothing means that nothing was tested";
  EXPECT_GT(e.back().p, 1e-8);
}

/// P2-P1 on cube_coarse, cube and (three meshes) cube_fine, with the error indicators.
template <class Law, class Solution>
void convergence(std::vector<Errors> &e)
{
  std::vector<std::string> meshes{"cube_coarse", "cube"};
  if (three_meshes<Law>) meshes.push_back("cube_fine");
  ASSERT_NO_FATAL_FAILURE((convergence<Law, Solution>(meshes, "", e)));
  // stress: what the error of p makes of u is smooth and partly missed
  EXPECT_GT(e.back().estimated_tissue, 0.6 * e.back().tissue);
  EXPECT_LT(e.back().estimated_tissue, 1.1 * e.back().tissue);
  EXPECT_GT(e.back().estimated_flow, 0.75 * e.back().flow);
  EXPECT_LT(e.back().estimated_flow, 1.9 * e.back().flow);
}

// (a) Neither field is in its space: Grad u and p have order 2, Grad p has order 1. In L2 u has order 2 too: the error
// of p, which no weaker norm makes smaller for P1, loads the momentum balance.
TYPED_TEST(ManufacturedRun, DiscretisationError)
{
  std::vector<Errors> e;
  ASSERT_NO_FATAL_FAILURE((convergence<TypeParam, mms::Waves<TypeParam>>(e)));
  const Errors &c = e[e.size() - 2], &f = e.back();
  EXPECT_GT(order(c.u, f.u), 1.7);
  EXPECT_GT(order(c.grad_u, f.grad_u), 1.7);
  EXPECT_GT(order(c.p, f.p), 1.8);
  EXPECT_GT(order(c.grad_p, f.grad_p), 0.85);
}

// (a) p is in its space: u has its own order 3 in L2.
TYPED_TEST(ManufacturedRun, DiscretisationErrorOfDisplacement)
{
  std::vector<Errors> e;
  ASSERT_NO_FATAL_FAILURE((convergence<TypeParam, mms::WavesLinearPressure<TypeParam>>(e)));
  const Errors &c = e[e.size() - 2], &f = e.back();
  EXPECT_GT(order(c.u, f.u), 2.7);
  EXPECT_GT(order(c.grad_u, f.grad_u), 1.8);
  EXPECT_GT(order(c.p, f.p), 1.8);
}

/// Orders that an element pair should show: u and p not in their spaces; u where p is in its own.
struct PairOrders {
  const char *options;
  std::vector<std::string> meshes;
  double u, grad_u, p, grad_p, u_alone;
};
class ManufacturedElements : public ::testing::TestWithParam<PairOrders> {};

TEST_P(ManufacturedElements, DiscretisationError)
{
  using Law = mms::Yoshihara;
  const PairOrders &orders = GetParam();
  std::vector<Errors> e;
  ASSERT_NO_FATAL_FAILURE((convergence<Law, mms::Waves<Law>>(orders.meshes, orders.options, e)));
  const Errors &c = e[e.size() - 2], &f = e.back();
  EXPECT_GT(order(c.u, f.u), orders.u);
  EXPECT_GT(order(c.grad_u, f.grad_u), orders.grad_u);
  EXPECT_GT(order(c.p, f.p), orders.p);
  EXPECT_GT(order(c.grad_p, f.grad_p), orders.grad_p);
}

TEST_P(ManufacturedElements, DiscretisationErrorOfDisplacement)
{
  using Law = mms::Yoshihara;
  const PairOrders &orders = GetParam();
  std::vector<Errors> e;
  ASSERT_NO_FATAL_FAILURE((convergence<Law, mms::WavesLinearPressure<Law>>(orders.meshes, orders.options, e)));
  EXPECT_GT(order(e[e.size() - 2].u, e.back().u), orders.u_alone);
}

INSTANTIATE_TEST_SUITE_P(
    Pairs, ManufacturedElements,
    ::testing::Values(PairOrders{"-elements P1-P1", {"cube_coarse", "cube", "cube_fine"}, 1.7, 0.85, 1.7, 0.85, 1.7},
                      PairOrders{"-elements P3-P2", {"cube_coarse", "cube"}, 2.7, 2.7, 2.7, 1.8, 3.7}),
    [](const auto &pair) { return pair.index == 0 ? "P1P1" : "P3P2"; });

// (b) The interpolant of the exact solution nearly solves the discrete equations, and better on finer meshes.
TYPED_TEST(Manufactured, ResidualOfTheInterpolant)
{
  using Law = TypeParam;
  double relative[3][2];
  const char *meshes[3] = {"cube_coarse", "cube", "cube_fine"};
  for (int m = 0; m < 3; ++m) {
    Bench bench;
    VecHandle X, F;
    double at_solution[2], at_rest[2];
    PULMO_OK((bench.setup<Law, mms::Waves<Law>>(meshes[m], 1, 1)));
    PULMO_OK(DMCreateGlobalVector(bench.dm(), X.out()));
    PULMO_OK(VecDuplicate(X, F.out()));
    PULMO_OK(bench.exact(X));
    PULMO_OK(bench.residual(X, F));
    PULMO_OK(bench.norms(F, at_solution));
    // the size of the terms that cancel: the same with the free unknowns 10 % too large
    PULMO_OK(VecScale(X, 1.1));
    PULMO_OK(bench.residual(X, F));
    PULMO_OK(bench.norms(F, at_rest));
    for (int f = 0; f < 2; ++f) relative[m][f] = at_solution[f] / at_rest[f];
    std::printf("  %-9s %-11s residual: momentum %.3e (relative %.3e)  mass %.3e (relative %.3e)\n", Law::name,
                meshes[m], at_solution[0], relative[m][0], at_solution[1], relative[m][1]);
    for (int f = 0; f < 2; ++f) EXPECT_GT(relative[m][f], 1e-9) << "a residual that is exactly zero tests nothing";
  }
  for (int f = 0; f < 2; ++f) {
    std::printf("  %-9s order of the relative residual, %s: %.2f %.2f\n", Law::name, f ? "mass" : "momentum",
                order(relative[0][f], relative[1][f]), order(relative[1][f], relative[2][f]));
    EXPECT_LT(relative[2][f], 0.1);
    EXPECT_GT(order(relative[1][f], relative[2][f]), 1.5);
  }
}

// (c) F(x + h d) - F(x) - h J d falls with h^2, in the rows of each field and for directions of each field.
TYPED_TEST(Manufactured, JacobianByTaylorOrder)
{
  using Law = TypeParam;
  Bench bench;
  VecHandle X, Y, D, F0, F, JD;
  MatHandle A;
  PetscInt n;
  PULMO_OK((bench.setup<Law, mms::Waves<Law>>("cube_coarse", 0.3, 1)));
  PULMO_OK(DMCreateGlobalVector(bench.dm(), X.out()));
  for (VecHandle *v : {&Y, &D, &F0, &F, &JD}) PULMO_OK(VecDuplicate(X, v->out()));
  PULMO_OK(DMCreateMatrix(bench.dm(), A.out()));
  PULMO_OK(bench.exact(X));
  PULMO_OK(bench.residual(X, F0));
  PULMO_OK(bench.jacobian(X, A));
  PULMO_OK(VecGetLocalSize(X, &n));
  for (int direction = 0; direction < 2; ++direction) {
    PULMO_OK(scatter_values(D, 0.1));
    {
      WriteArray d(D);
      const ReadArray which(bench.field());
      for (PetscInt i = 0; i < n; ++i)
        if ((which[i] > 0.5) != (direction == 1)) d[i] = 0;
    }
    PULMO_OK(MatMult(A, D, JD));
    const int first = 6;
    std::vector<double> remainder[2];
    for (int k = 0; k < 4; ++k) {
      const double h = std::pow(0.5, k + first);
      double norm[2];
      PULMO_OK(VecWAXPY(Y, h, D, X));
      PULMO_OK(bench.residual(Y, F));
      PULMO_OK(VecAXPY(F, -1, F0));
      PULMO_OK(VecAXPY(F, -h, JD));
      PULMO_OK(bench.norms(F, norm));
      for (int f = 0; f < 2; ++f) remainder[f].push_back(norm[f]);
    }
    double size[2];
    PULMO_OK(bench.norms(JD, size));
    for (int f = 0; f < 2; ++f) {
      const auto &r = remainder[f];
      EXPECT_GT(size[f], 1e-6) << "no derivative here: nothing tested";
      if (direction == pressure) { // both equations are linear in p
        std::printf("  %-9s %-8s by p: remainder %.1e of %.1e\n", Law::name, f ? "mass" : "momentum", r[0],
                    size[f] / (1 << first));
        EXPECT_LT(r[0], 1e-12 * std::max(size[f], 1.0));
        continue;
      }
      std::printf("  %-9s %-8s by u: remainder %.2e ... %.2e, orders %.3f %.3f %.3f\n", Law::name,
                  f ? "mass" : "momentum", r[0], r[3], order(r[0], r[1]), order(r[1], r[2]), order(r[2], r[3]));
      for (int k = 0; k < 3; ++k) EXPECT_NEAR(order(r[k], r[k + 1]), 2, 0.1);
    }
  }
}

// (d) Every entry of the Jacobian, block by block, against central differences of the residual.
TYPED_TEST(Manufactured, JacobianByFiniteDifferences)
{
  using Law = TypeParam;
  Bench bench;
  VecHandle X, Y, Fp, Fm;
  MatHandle A, dense;
  PetscInt n;
  const double h = 1e-5;
  PULMO_OK((bench.setup<Law, mms::Waves<Law>>("cube_coarse", 0.3, 1)));
  PULMO_OK(DMCreateGlobalVector(bench.dm(), X.out()));
  for (VecHandle *v : {&Y, &Fp, &Fm}) PULMO_OK(VecDuplicate(X, v->out()));
  PULMO_OK(DMCreateMatrix(bench.dm(), A.out()));
  PULMO_OK(bench.exact(X));
  PULMO_OK(scatter_values(Y, 0.01)); // away from the interpolant, so that no term is small by chance
  PULMO_OK(VecAXPY(X, 1, Y));
  PULMO_OK(bench.jacobian(X, A));
  PULMO_OK(MatConvert(A, MATDENSE, MAT_INITIAL_MATRIX, dense.out()));
  PULMO_OK(VecGetLocalSize(X, &n));
  const PetscScalar *a;
  PULMO_OK(MatDenseGetArrayRead(dense, &a));
  double worst[2][2] = {{0, 0}, {0, 0}}, largest[2][2] = {{0, 0}, {0, 0}};
  const ReadArray which(bench.field());
  for (PetscInt j = 0; j < n; ++j) {
    for (const double sign : {1.0, -1.0}) {
      PULMO_OK(VecCopy(X, Y));
      {
        WriteArray y(Y);
        y[j] += sign * h;
      }
      PULMO_OK(bench.residual(Y, sign > 0 ? Fp : Fm));
    }
    const ReadArray fp(Fp), fm(Fm);
    for (PetscInt i = 0; i < n; ++i) {
      const int r = which[i] > 0.5, c = which[j] > 0.5;
      worst[r][c] = std::max(worst[r][c], std::abs((fp[i] - fm[i]) / (2 * h) - a[i + n * j]));
      largest[r][c] = std::max(largest[r][c], std::abs(a[i + n * j]));
    }
  }
  PULMO_OK(MatDenseRestoreArrayRead(dense, &a));
  for (int r = 0; r < 2; ++r)
    for (int c = 0; c < 2; ++c) {
      std::printf("  %-9s block (%s, %s): largest entry %.2e, worst difference %.1e of it\n", Law::name, r ? "p" : "u",
                  c ? "p" : "u", largest[r][c], worst[r][c] / largest[r][c]);
      EXPECT_GT(largest[r][c], 1e-6);
      EXPECT_LT(worst[r][c], 1e-7 * largest[r][c]);
    }
}

// The order of each integrator, the solution being held exactly in space.
TYPED_TEST(ManufacturedRun, OrderInTime)
{
  using Law = TypeParam;
  using Solution = mms::Polynomials<Law>;
  for (const Integrator &integrator : integrators) {
    std::vector<Errors> e;
    for (const int steps : {8, 16, 32, 64}) {
      pulmo::Run run(manufactured<Law, Solution>(true));
      bool finished = false;
      PULMO_OK(prepare(run, options(Law::name, "cube_coarse", 1.0 / steps, true) + integrator.options));
      PULMO_OK(run.simulation().run(finished));
      ASSERT_TRUE(finished) << run.simulation().failure_text();
      ASSERT_EQ(run.simulation().rows().size(), static_cast<std::size_t>(steps + 1)); // no step was cut
      e.emplace_back();
      PULMO_OK(errors<Solution>(run, run.simulation().local_state(), 1, e.back()));
      std::printf("  %s, %-9s dt 1/%-3d J %.2f..%.2f  u %.3e  p %.3e", integrator.name, Law::name, steps,
                  run.simulation().rows().back().min_J, run.simulation().rows().back().max_J, e.back().u, e.back().p);
      if (e.size() > 1)
        std::printf("  orders u %.3f p %.3f", order(e[e.size() - 2].u, e.back().u),
                    order(e[e.size() - 2].p, e.back().p));
      std::printf("\n");
    }
    for (const double measured : {order(e[2].u, e[3].u), order(e[2].p, e[3].p)}) { // BDF2 comes from above
      EXPECT_GT(measured, integrator.order - 0.05);
      EXPECT_LT(measured, integrator.order + 0.1);
    }
    EXPECT_GT(e[3].u, 1e-8);
    EXPECT_LT(e[3].u, 1e-2);
  }
}

// The sources themselves: stress by automatic differentiation against the closed forms of free inflation, and all
// divergences and rates against differences of the values.
TEST(ManufacturedSources, StressOfFreeInflation)
{
  const double J = 1.3, s = std::pow(J, 2.0 / 3), l = std::pow(J, 1.0 / 3);
  const double F[9] = {l, 0, 0, 0, l, 0, 0, 0, l};
  const auto stress = [&](auto law) { // dW/dF = dW/dJ cof F, cof F = J^(2/3) I
    double P[9];
    mms::effective_stress<decltype(law)>(F, P);
    EXPECT_NEAR(P[1], 0, 1e-14);
    EXPECT_NEAR(P[4], P[0], 1e-14);
    return P[0] / s;
  };
  const double g = 3 * (3 * 0.43 - 0.6) / 4;
  const auto cm4 = [&](double c, double beta) { return 2 * c * (std::pow(J, -1.0 / 3) - std::pow(J, -2 * beta - 1)); };
  EXPECT_NEAR(stress(mms::Berger()), 0.2808 / l + 0.2106 * J - (0.2808 + 0.2106) / (J - 0.01), 1e-13);
  EXPECT_NEAR(stress(mms::Ma()), 2 * std::exp(g * (s - 1) * (s - 1)) * 2 * g * (s - 1) * 2 / 3 / l, 1e-13);
  EXPECT_NEAR(stress(mms::Birzle()), cm4(0.3567, 1.075) + 4 * 5.766e-3 * std::pow(s - 1, 5) / l, 1e-13);
  EXPECT_NEAR(stress(mms::Yoshihara()), cm4(1.298, 0.75), 1e-13);
  EXPECT_NEAR(stress(mms::Rausch()), 16.5 / 2 * (J - 1 / J), 1e-13);
}

TYPED_TEST(Manufactured, SourcesByDifferences)
{
  using Law = TypeParam;
  const double x[3] = {0.31, 0.62, 0.47}, t = 0.8, h = 1e-4;
  const auto at = [&](int direction, double shift) {
    double y[3] = {x[0], x[1], x[2]}, s = t;
    (direction < 3 ? y[direction] : s) += shift;
    return mms::state<Law, mms::Waves<Law>>(s, y);
  };
  const mms::State s = at(0, 0);
  double B[3] = {0, 0, 0}, div_Q = 0;
  for (int j = 0; j < 4; ++j) { // fourth-order differences
    const mms::State a = at(j, -2 * h), b = at(j, -h), c = at(j, h), d = at(j, 2 * h);
    const auto slope = [&](double va, double vb, double vc, double vd) {
      return (va - 8 * vb + 8 * vc - vd) / (12 * h);
    };
    if (j == 3) {
      EXPECT_NEAR(slope(a.J, b.J, c.J, d.J), s.dJ_dt, 1e-9);
      continue;
    }
    for (int i = 0; i < 3; ++i) {
      const int ij = 3 * i + j;
      B[i] -= slope(a.P[ij], b.P[ij], c.P[ij], d.P[ij]);
      EXPECT_NEAR(slope(a.u[i], b.u[i], c.u[i], d.u[i]), s.grad_u[ij], 1e-9);
    }
    div_Q += slope(a.Q[j], b.Q[j], c.Q[j], d.Q[j]);
    EXPECT_NEAR(slope(a.p, b.p, c.p, d.p), s.grad_p[j], 1e-9);
  }
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(B[i], s.B[i], 1e-8);
  EXPECT_NEAR(div_Q, s.div_Q, 1e-9);
  // the flux by hand: cof F^T Q is -k J F^-1 ... written as F Q = -k J F^-T Grad p
  for (int i = 0; i < 3; ++i) {
    double FQ = s.Q[i], F_T_g = 0;
    for (int j = 0; j < 3; ++j) {
      FQ += s.grad_u[3 * i + j] * s.Q[j];
      F_T_g += s.cof_F[3 * i + j] * s.grad_p[j] / s.J;
    }
    EXPECT_NEAR(FQ, -mms::permeability(s.J) * s.J * F_T_g, 1e-14);
  }
}
