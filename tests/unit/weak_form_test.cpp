// The assembled equations: virtual work of affine states in closed form, Jacobians against differences of residuals,
// pulmo's integrator against PETSc's.
#include "unit/scenes.hpp"

#include "pulmo/physics/effects/airflow.hpp"
#include "verification/support/lattice.hpp"

namespace pulmo::test {
namespace {

// ------------------------------------------------------------------------------ virtual work of affine states

/// Gauss points on [0, 1].
constexpr double gauss[3] = {0.5 - 0.3872983346207417, 0.5, 0.5 + 0.3872983346207417},
                 weight[3] = {5. / 18, 8. / 18, 5. / 18};

/// Integral over a face of the unit cube (x0 ... z1) of a polynomial of degree 5 in each coordinate.
double over_face(const std::string &face, const std::function<double(const double[3], const double[3])> &f)
{
  const int d = face[0] - 'x';
  double sum = 0, N[3] = {0, 0, 0};
  N[d] = face[1] == '1' ? 1 : -1;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      double X[3];
      X[d] = face[1] == '1' ? 1 : 0;
      X[(d + 1) % 3] = gauss[i];
      X[(d + 2) % 3] = gauss[j];
      sum += weight[i] * weight[j] * f(X, N);
    }
  return sum;
}

std::array<double, 3> affine(const Tensor &A, const std::array<double, 3> &a, const double X[3])
{
  return {a[0] + A[0] * X[0] + A[1] * X[1] + A[2] * X[2], a[1] + A[3] * X[0] + A[4] * X[1] + A[5] * X[2],
          a[2] + A[6] * X[0] + A[7] * X[1] + A[8] * X[2]};
}

double dot3(const double *a, const double *b)
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/// u, p, test displacement and test pressure affine in X: the residual's virtual work in closed form. CM4.
void expect_virtual_work(const SceneSpec &scene, unsigned seed)
{
  SCOPED_TRACE(scene.text());
  constexpr double c = 1.298, beta = 0.75, k = 0.7, dt = 0.08, gas = 0.35;
  Random random(seed);
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, scene.options()));
  Model &model = run.model();

  const Tensor G = random.tensor(0.3), G0 = random.tensor(0.3), B = random.tensor(1);
  const std::array<double, 3> a{random(), random(), random()}, b{random(), random(), random()};
  const std::array<double, 3> g{random(), random(), random()}, e{random(), random(), random()};
  const double p0 = random(), q0 = random();
  VecHandle x, x_t, before, eta, F;
  PULMO_OK(DMCreateLocalVector(model.dm(), x.out()));
  for (VecHandle *v : {&x_t, &before, &eta, &F}) PULMO_OK(VecDuplicate(x, v->out()));
  const auto pressure_of = [&](const double X[3]) { return p0 + dot3(g.data(), X); };
  const auto q_of = [&](const double X[3]) { return q0 + dot3(e.data(), X); };
  PULMO_OK(interpolate(
      run, x, [&](const double X[3]) { return affine(G, a, X); }, pressure_of));
  PULMO_OK(interpolate(
      run, before, [&](const double X[3]) { return affine(G0, b, X); }, pressure_of));
  PULMO_OK(interpolate(
      run, eta, [&](const double X[3]) { return affine(B, b, X); }, q_of));
  PULMO_OK(VecWAXPY(x_t, -1, before, x));
  PULMO_OK(VecScale(x_t, 1 / dt));
  PULMO_OK(model.set_step(dt, gas));
  PULMO_OK(model.residual(0, x, x_t, F));

  // rows are dimensionless: momentum / (modulus length^2), mass dt / length^3
  const double length = std::cbrt(1. / 24), modulus = 4 * c * (1 + beta);
  EXPECT_NEAR(model.row_scale(displacement) * modulus * length * length, 1, 1e-12);
  if (scene.airflow) {
    EXPECT_NEAR(model.row_scale(pressure) * length * length * length / dt, 1, 1e-12);
  }
  double work[2] = {0, 0};
  {
    const ReadArray f(F), t(eta);
    PULMO_OK(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt, const PetscReal *) {
      work[field] += f[dof] * t[dof] / model.row_scale(field);
    }));
  }

  const Tensor Fd = identity + G, F_inverse = inverse(Fd);
  const double J = det(Fd), J0 = det(identity + G0), centre[3] = {0.5, 0.5, 0.5};
  const Tensor cof = J * transposed(F_inverse), P = 2 * c * (Fd - std::pow(J, -2 * beta - 1) * cof);
  double expected = dot(P, B);
  if (scene.airflow)
    expected -= pressure_of(centre) * dot(cof, B);
  else if (scene.ventilator)
    expected -= gas * dot(cof, B);
  const auto u = [&](const double X[3]) { return affine(G, a, X); };
  const auto test = [&](const double X[3]) { return affine(B, b, X); };
  if (!scene.chest_wall.empty())
    for (const auto &[face, stiffness] : {std::pair<std::string, double>("x0", 0.08), {"z1", 0.21}})
      expected +=
          stiffness * over_face(face, [&](const double X[3], const double N[3]) {
            const auto v = u(X), w = test(X);
            return scene.chest_wall == "full" ? dot3(v.data(), w.data()) : dot3(v.data(), N) * dot3(w.data(), N);
          });
  if (scene.lumen_pressure)
    for (const char *face : {"x1", "z1"})
      expected += over_face(face, [&](const double X[3], const double N[3]) {
        const auto cof_N = affine(cof, {0, 0, 0}, N), w = test(X);
        return (scene.airflow ? pressure_of(X) : gas) * dot3(cof_N.data(), w.data());
      });
  if (scene.traction)
    for (const auto &[face, T] :
         {std::pair<std::string, std::array<double, 3>>("y0", {0.03, 0.3, 0.02}), {"x0", {0.1, -0.2, 0.05}}}) {
      const std::array<double, 3> load = T;
      expected -= over_face(face, [&](const double X[3], const double *) { return dot3(load.data(), test(X).data()); });
    }
  EXPECT_NEAR(work[displacement], expected, 1e-12 * (1 + std::abs(expected)));

  if (scene.airflow) {
    const auto C_inverse_g = affine(F_inverse * transposed(F_inverse), {0, 0, 0}, g.data());
    const double mass = (J - J0) / dt * q_of(centre) + k * J * dot3(C_inverse_g.data(), e.data());
    EXPECT_NEAR(work[pressure], mass, 1e-12 * (1 + std::abs(J - J0) / dt));
  }
}

TEST(WeakForm, VirtualWorkOfAffineStatesForEveryCombinationOfEffects)
{
  unsigned seed = 700;
  for (SceneSpec scene : all_scenes()) {
    scene.law = "yoshihara";
    expect_virtual_work(scene, ++seed);
    if (HasFatalFailure()) return;
  }
}

TEST(WeakForm, LumenPressureOfAQuadraticDeformation)
{
  // u quadratic, p and the test displacement affine: the rule of the faces is exact
  for (bool airflow : {false, true}) {
    SCOPED_TRACE(airflow);
    Random random(61);
    const double gas = 0.35, p0 = random();
    const Tensor G = random.tensor(0.3), Q = random.tensor(0.2), B = random.tensor(1);
    const std::array<double, 3> b{random(), random(), random()}, g{random(), random(), random()};
    const auto u = [&](const double X[3]) { // G X + Q (X_0^2, X_1 X_2, X_2^2)
      const double s[3] = {X[0] * X[0], X[1] * X[2], X[2] * X[2]};
      const auto linear = affine(G, {}, X), square = affine(Q, {}, s);
      return std::array<double, 3>{linear[0] + square[0], linear[1] + square[1], linear[2] + square[2]};
    };
    const auto p = [&](const double X[3]) { return p0 + dot3(g.data(), X); };
    double work[2] = {0, 0};
    for (int lumen = 0; lumen < 2; ++lumen) {
      SceneSpec scene;
      scene.airflow = airflow;
      scene.ventilator = true;
      scene.lumen_pressure = lumen;
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      VecHandle x, x_t, F;
      PULMO_OK(prepare(run, scene.options()));
      PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
      for (VecHandle *v : {&x_t, &F}) PULMO_OK(VecDuplicate(x, v->out()));
      PULMO_OK(interpolate(run, x, u, p));
      PULMO_OK(run.model().set_step(0.1, gas));
      PULMO_OK(run.model().residual(0, x, x_t, F));
      const ReadArray f(F);
      PULMO_OK(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt component, const PetscReal X[3]) {
        if (field == displacement)
          work[lumen] += f[dof] * affine(B, b, X)[component] / run.model().row_scale(displacement);
      }));
    }
    double expected = 0;
    for (const char *face : {"x1", "z1"})
      expected += over_face(face, [&](const double X[3], const double N[3]) {
        const Tensor S{2 * X[0], 0, 0, 0, X[2], X[1], 0, 0, 2 * X[2]}, F = identity + G + Q * S;
        const auto cof_N = affine(det(F) * transposed(inverse(F)), {}, N);
        return (airflow ? p(X) : gas) * dot3(cof_N.data(), affine(B, b, X).data());
      });
    EXPECT_NEAR(work[1] - work[0], expected, 1e-12 * (1 + std::abs(work[0])));
  }
}

TEST(WeakForm, FlowAndReactionOfAnAffineState)
{
  // cube_coarse has all its vertices on the boundary: with p prescribed there the consistent flux is dV/dt exactly
  const std::string all = "x0,x1,y0,y1,z0,z1";
  SceneSpec scene;
  scene.traction = true;
  scene.more = "-airflow -airflow_surfaces " + all + " -support -support_surfaces " + all;
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x, x_t, F;
  PULMO_OK(prepare(run, scene.options()));
  Random random(5);
  const Tensor G = random.tensor(0.2), G0 = random.tensor(0.2);
  const double dt = 0.05;
  PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
  for (VecHandle *v : {&x_t, &F}) PULMO_OK(VecDuplicate(x, v->out()));
  PULMO_OK(interpolate(
      run, x, [&](const double X[3]) { return affine(G, {}, X); }, [](const double *) { return 0.3; }));
  PULMO_OK(interpolate(
      run, x_t, [&](const double X[3]) { return affine((1 / dt) * (G - G0), {}, X); },
      [](const double *) { return 0; }));
  PULMO_OK(run.model().set_step(dt, 0));
  PULMO_OK(run.model().residual(0, x, x_t, F));
  double force[3] = {0, 0, 0};
  std::vector<std::array<PetscReal, 3>> held;
  std::vector<PetscReal> flow;
  PULMO_OK(run.model().airway().flows(F, run.model().row_scale(pressure), flow));
  PULMO_OK(run.model().reactions(F, held));
  for (const auto &one : held)
    for (int i = 0; i < 3; ++i) force[i] += one[i];
  EXPECT_NEAR(flow.at(0), (det(identity + G) - det(identity + G0)) / dt, 1e-12 * 20);
  // the supports hold the dead loads of y0 and x0
  const double load[3] = {0.13, 0.1, 0.07};
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(force[i], -load[i], 1e-13);
}

// ------------------------------------------------------------------------------- Jacobian against differences

/// Largest entry of each block (test field, trial field).
struct BlockNorm {
  double block[2][2] = {{0, 0}, {0, 0}};
  void add(PetscInt f, PetscInt g, double value) { block[f][g] = std::max(block[f][g], std::abs(value)); }
};

/// Compares every column of the Jacobian with central differences of the residual, block by block.
void expect_jacobian(Run &run, State &s, PetscReal shift, double tolerance)
{
  constexpr double h = 5e-6;
  MatHandle A;
  VecHandle d, up, down;
  std::vector<PetscInt> fields, points;
  PetscInt n;
  BlockNorm size, error;

  run.model().airway().hold(false); // every row and column as the weak form has it
  PULMO_OK(DMCreateMatrix(run.model().dm(), A.out()));
  PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, shift, A));
  PULMO_OK(DMCreateGlobalVector(run.model().dm(), d.out()));
  PULMO_OK(VecDuplicate(d, up.out()));
  PULMO_OK(VecDuplicate(d, down.out()));
  PULMO_OK(VecGetLocalSize(d, &n));
  PULMO_OK(places_of_dofs(run, fields, points));
  MatHandle dense;
  PULMO_OK(MatConvert(A, MATDENSE, MAT_INITIAL_MATRIX, dense.out()));
  for (PetscInt j = 0; j < n; ++j) {
    const PetscScalar *column;
    PULMO_OK(VecZeroEntries(d));
    PULMO_OK(VecSetValue(d, j, 1, INSERT_VALUES));
    PULMO_OK(VecAssemblyBegin(d));
    PULMO_OK(VecAssemblyEnd(d));
    PULMO_OK(residual_at(run, s, d, h, shift, up));
    PULMO_OK(residual_at(run, s, d, -h, shift, down));
    PULMO_OK(MatDenseGetArrayRead(dense, &column));
    {
      const ReadArray a(up), b(down);
      for (PetscInt i = 0; i < n; ++i) {
        const double entry = column[j * n + i];
        size.add(fields[i], fields[j], entry);
        error.add(fields[i], fields[j], entry - (a[i] - b[i]) / (2 * h));
      }
    }
    PULMO_OK(MatDenseRestoreArrayRead(dense, &column));
  }
  const int n_fields = static_cast<int>(run.model().composition().fields().size());
  for (int f = 0; f < n_fields; ++f)
    for (int g = 0; g < n_fields; ++g) {
      EXPECT_GT(size.block[f][g], 0) << "block " << f << g << " is empty";
      EXPECT_LT(error.block[f][g], tolerance * size.block[f][g]) << "block " << f << g;
    }
}

TEST(WeakForm, EveryColumnOfTheJacobianForEveryCombinationOfEffects)
{
  unsigned seed = 100;
  for (const SceneSpec &scene : all_scenes()) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    State s;
    PULMO_OK(prepare(run, scene.options()));
    PULMO_OK(random_state(run, ++seed, s));
    expect_jacobian(run, s, 1 / s.dt, 3e-8);
    if (HasFatalFailure()) return;
  }
}

TEST(WeakForm, EveryColumnOfTheJacobianForEveryLawAndAnyShift)
{
  unsigned seed = 300;
  for (const std::string &law : law_names())
    for (bool airflow : {false, true}) {
      const SceneSpec scene = full_scene(airflow, law);
      SCOPED_TRACE(scene.text());
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      State s;
      PULMO_OK(prepare(run, scene.options()));
      PULMO_OK(random_state(run, ++seed, s));
      expect_jacobian(run, s, 2.3, 3e-8);
      if (HasFatalFailure()) return;
    }
}

/// Everything at once on a box of two halves; law, springs, permeability and a surface have values of their own.
SceneSpec two_halves(bool airflow, const LatticeFile &mesh)
{
  SceneSpec scene = full_scene(airflow);
  scene.chest_wall = "full";
  scene.more = "-dm_plex_filename " + mesh.path() +
               " -tissue_c 0.3567,right=1.9 -tissue_beta 1.075,left=0.6,right=2 -tissue_c1 0.2782,left=0"
               " -chest_wall_stiffness 0.08,x0=0.02,right=0.31 -chest_wall_stiffness_z1 0.21,right=0";
  if (airflow) scene.more += " -airflow_permeability 0.7,left=23";
  return scene;
}

Lattice halves()
{
  Lattice box = Lattice::box({2, 1, 2}, {1, 1, 1});
  box.part = [](const Lattice::Place &x) { return x[0] < 0.5 ? "left" : "right"; };
  return box;
}

TEST(WeakForm, EveryColumnOfTheJacobianWithRegions)
{
  const LatticeFile mesh(halves());
  for (bool airflow : {false, true})
    for (const char *type : {"pulmo", "basic"}) {
      SCOPED_TRACE(type);
      SceneSpec scene = two_halves(airflow, mesh);
      scene.more += std::string(" -petscfe_type ") + type;
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      State s;
      PULMO_OK(prepare(run, scene.options()));
      ASSERT_NE(run.model().composition().varying(), nullptr);
      PULMO_OK(random_state(run, 320, s));
      expect_jacobian(run, s, 2.3, 3e-8);
      if (HasFatalFailure()) return;
    }
}

TEST(WeakForm, EveryColumnOfTheJacobianWithDampedPressure)
{
  SceneSpec scene = full_scene(true);
  scene.more = "-pressure_damping -pressure_damping_length 0.4 -pressure_damping_modulus 0.1";
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  State s;
  PULMO_OK(prepare(run, scene.options()));
  PULMO_OK(random_state(run, 350, s));
  expect_jacobian(run, s, 2.3, 3e-8);
}

/// k(J) = k J^3: exercises dk/dJ in the assembled system.
struct CubicPermeability {
  static constexpr const char *name = "cubic", *about = "k = 0.5 J^3";
  struct Parameters {
    static constexpr const char *owner = "permeability";
    PetscScalar k = 0.5;
  };
  static PetscErrorCode declare(Options &, Parameters &) { return PETSC_SUCCESS; }
  static PermeabilityValue permeability(PetscScalar J, const Parameters &p)
  {
    return {p.k * J * J * J, 3 * p.k * J * J};
  }
};

TEST(WeakForm, JacobianWithAPermeabilityLawOfTheTest)
{
  SceneSpec scene = full_scene(true);
  scene.more = "-airflow_permeability_law cubic";
  std::string options = scene.options();
  const std::string constant = "-airflow_permeability 0.7";
  options.erase(options.find(constant), constant.size());
  Registry registry = Registry::standard();
  registry.permeability_law<CubicPermeability>();
  SceneRun run(registry);
  State s;
  PULMO_OK(prepare(run, options));
  PULMO_OK(random_state(run, 77, s));
  expect_jacobian(run, s, 1 / s.dt, 3e-8);
}

TEST(WeakForm, TaylorRemainderIsOfSecondOrder)
{
  unsigned seed = 500;
  for (const SceneSpec &scene : all_scenes()) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    State s;
    MatHandle A;
    VecHandle d, F, F0, Ad;
    PULMO_OK(prepare(run, scene.options()));
    PULMO_OK(random_state(run, ++seed, s));
    PULMO_OK(DMCreateMatrix(run.model().dm(), A.out()));
    run.model().airway().hold(false);
    PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
    PULMO_OK(DMCreateGlobalVector(run.model().dm(), d.out()));
    for (VecHandle *v : {&F, &F0, &Ad}) PULMO_OK(VecDuplicate(d, v->out()));
    Random random(seed);
    {
      PetscInt n;
      PULMO_OK(VecGetLocalSize(d, &n));
      WriteArray values(d);
      for (PetscInt i = 0; i < n; ++i) values[i] = random();
    }
    PULMO_OK(MatMult(A, d, Ad));
    PULMO_OK(residual_at(run, s, nullptr, 0, 0, F0));
    double remainder[3], size;
    PULMO_OK(VecNorm(Ad, NORM_2, &size));
    for (int k = 0; k < 3; ++k) {
      const double h = 1e-3 / std::pow(2, k);
      PULMO_OK(residual_at(run, s, d, h, 1 / s.dt, F));
      PULMO_OK(VecAXPY(F, -1, F0));
      PULMO_OK(VecAXPY(F, -h, Ad));
      PULMO_OK(VecNorm(F, NORM_2, &remainder[k]));
    }
    EXPECT_LT(remainder[2], 0.02 * size * 2.5e-4);
    EXPECT_NEAR(std::log2(remainder[0] / remainder[1]), 2, 0.1);
    EXPECT_NEAR(std::log2(remainder[1] / remainder[2]), 2, 0.1);
  }
}

// ---------------------------------------------------------------------- pulmo's integrator against PETSc's own

/// Residual (local vector, constrained rows included) and Jacobian by both integrators.
void expect_same_integration(const SceneSpec &scene, unsigned seed, double tolerance)
{
  SCOPED_TRACE(scene.text());
  const Registry registry = Registry::standard();
  SceneRun fast(registry), stock(registry);
  State s, t;
  MatHandle A, B;
  double size, error;

  PULMO_OK(prepare(fast, scene.options() + " -petscfe_type pulmo"));
  PULMO_OK(prepare(stock, scene.options() + " -petscfe_type basic"));
  ASSERT_TRUE(fast.model().own_integration());
  ASSERT_FALSE(stock.model().own_integration());
  PULMO_OK(random_state(fast, seed, s));
  PULMO_OK(random_state(stock, seed, t));
  PULMO_OK(fast.model().residual(s.t, s.x, s.x_t, s.residual));
  PULMO_OK(stock.model().residual(t.t, t.x, t.x_t, t.residual));
  for (PetscInt f = 0; f < static_cast<PetscInt>(fast.model().composition().fields().size()); ++f) {
    const ReadArray a(s.residual), b(t.residual);
    size = error = 0;
    PULMO_OK(for_each_dof(fast, [&](PetscInt dof, PetscInt field, PetscInt, const PetscReal *) {
      if (field != f) return;
      size = std::max(size, std::abs(b[dof]));
      error = std::max(error, std::abs(a[dof] - b[dof]));
    }));
    EXPECT_GT(size, 0);
    EXPECT_LT(error, tolerance * size) << "residual of field " << f;
  }

  PULMO_OK(DMCreateMatrix(fast.model().dm(), A.out()));
  PULMO_OK(DMCreateMatrix(stock.model().dm(), B.out()));
  for (int twice = 0; twice < 2; ++twice) {
    PULMO_OK(fast.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
    PULMO_OK(stock.model().jacobian(t.t, t.x, t.x_t, 1 / s.dt, B));
  }
  std::vector<PetscInt> fields, points;
  BlockNorm sizes, errors;
  MatHandle D, E;
  const PetscScalar *a, *b;
  PULMO_OK(places_of_dofs(fast, fields, points));
  PULMO_OK(MatConvert(A, MATDENSE, MAT_INITIAL_MATRIX, D.out()));
  PULMO_OK(MatConvert(B, MATDENSE, MAT_INITIAL_MATRIX, E.out()));
  PULMO_OK(MatDenseGetArrayRead(D, &a));
  PULMO_OK(MatDenseGetArrayRead(E, &b));
  const std::size_t n = fields.size();
  for (std::size_t j = 0; j < n; ++j)
    for (std::size_t i = 0; i < n; ++i) {
      sizes.add(fields[i], fields[j], b[j * n + i]);
      errors.add(fields[i], fields[j], a[j * n + i] - b[j * n + i]);
    }
  PULMO_OK(MatDenseRestoreArrayRead(D, &a));
  PULMO_OK(MatDenseRestoreArrayRead(E, &b));
  const int n_fields = static_cast<int>(fast.model().composition().fields().size());
  for (int f = 0; f < n_fields; ++f)
    for (int g = 0; g < n_fields; ++g) {
      EXPECT_GT(sizes.block[f][g], 0);
      EXPECT_LT(errors.block[f][g], tolerance * sizes.block[f][g]) << "Jacobian block " << f << g;
    }
}

TEST(Integration, AgreesWithPetscForEveryCombinationOfEffects)
{
  unsigned seed = 900;
  for (const SceneSpec &scene : all_scenes()) {
    expect_same_integration(scene, ++seed, 1e-12);
    if (HasFatalFailure()) return;
  }
}

TEST(Integration, AgreesWithPetscForEveryLaw)
{
  for (const std::string &law : law_names())
    for (bool airflow : {false, true}) expect_same_integration(full_scene(airflow, law), 40, 1e-12);
}

TEST(Integration, AgreesWithPetscForDampedPressure)
{
  SceneSpec scene = full_scene(true);
  scene.more = "-pressure_damping -pressure_damping_length 0.4 -pressure_damping_modulus 0.1";
  expect_same_integration(scene, 60, 1e-12);
}

TEST(Integration, AgreesWithPetscForOtherElements)
{
  for (const char *pair : {"P1-P1 -quadrature_degree 2", "P3-P2"})
    for (bool airflow : {false, true}) {
      SceneSpec scene = full_scene(airflow);
      scene.more = std::string("-elements ") + pair;
      expect_same_integration(scene, 70, 1e-12);
    }
}

TEST(Integration, AgreesWithPetscForRegions)
{
  const LatticeFile mesh(halves());
  for (bool airflow : {false, true}) expect_same_integration(two_halves(airflow, mesh), 51, 1e-12);
}

TEST(Integration, AgreesWithPetscForOtherDegreesOfQuadrature)
{
  for (const char *degree : {"2", "4", "6"})
    for (bool airflow : {false, true}) {
      SceneSpec scene = full_scene(airflow);
      scene.more = std::string("-quadrature_degree ") + degree;
      expect_same_integration(scene, 50, 1e-12);
    }
}

} // namespace
} // namespace pulmo::test
