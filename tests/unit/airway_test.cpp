// The condition at the airway: modes, prescribed flux, the scalar equation of an unknown pressure and its Newton step.
#include "unit/scenes.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/time/airway.hpp"

namespace pulmo::test {
namespace {

using Mode = Airway::Mode;

/// An airway with the rates of backward Euler, steps of 0.05 s asked for.
class EulerAirway {
public:
  explicit EulerAirway(SceneRun &run) : airway_(run.model(), run.scene().facts(), scheme_), model_(run.model()) {}
  Airway *operator->() { return &airway_; }
  Airway &operator*() { return airway_; }
  void begin_phase(const Phase &phase, PetscReal volume)
  {
    airway_.begin_phase(phase, volume, 0.05);
    PULMO_OK(scheme_.begin(model_, {phase.begin, volume}));
  }
  void begin_step(PetscReal t, PetscReal dt)
  {
    PULMO_OK(scheme_.begin_stage(t, dt));
    airway_.begin(t, t);
    t_ = t;
  }
  void accept(PetscReal volume, PetscReal flow)
  {
    PULMO_OK(scheme_.accept(model_, {t_, volume}));
    airway_.accept({t_, 0, volume, 0, flow});
  }
  /// Whether an attempt with this flow is to be taken again with the limit held.
  bool limit(PetscReal flow)
  {
    const bool again = airway_.judge({t_, 0, 0, 0, flow}) == Verdict::again;
    if (again) airway_.reject(Verdict::again);
    return again;
  }

private:
  TimeScheme scheme_;
  Airway airway_;
  Model &model_;
  PetscReal t_ = 0;
};

/// A scene on the coarse cube, airway at x1.
SceneSpec breathing(const std::string &mode, bool airflow, bool tube = false)
{
  SceneSpec s;
  s.ventilator = true;
  s.mode = mode;
  s.airflow = airflow;
  s.tube = tube;
  s.chest_wall = "full";
  s.law = "yoshihara";
  return s;
}

std::vector<SceneSpec> breathing_scenes()
{
  std::vector<SceneSpec> list;
  for (const char *mode : {"pcv", "vcv", "vcv common_pressure"})
    for (bool airflow : {false, true})
      for (bool tube : {false, true}) list.push_back(breathing(mode, airflow, tube));
  return list;
}

Phase flow_phase(double begin, double end, double flow)
{
  Phase p;
  p.name = "inspiration";
  p.control = Control::flow;
  p.begin = begin;
  p.end = end;
  p.from = 0;
  p.to = flow;
  p.ramp = 0.1;
  return p;
}

Phase pressure_phase(double begin, double end, double value, double ramp = 0)
{
  Phase p;
  p.name = "expiration";
  p.begin = begin;
  p.end = end;
  p.to = value;
  p.ramp = ramp;
  return p;
}

TEST(Airway, ModesFollowControlSplitAndTube)
{
  for (const SceneSpec &scene : breathing_scenes()) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    PULMO_OK(prepare(run, scene.options()));
    EulerAirway airway(run);
    airway.begin_phase(pressure_phase(0, 1, 0.4), 0);
    airway.begin_step(0.1, 0.1);
    EXPECT_EQ(airway->mode(), scene.tube ? Mode::solved : Mode::held);
    if (scene.mode == "pcv") continue;
    airway.begin_phase(flow_phase(1, 2, 300), 0);
    airway.begin_step(1.1, 0.1);
    EXPECT_EQ(airway->mode(), scene.airflow && scene.mode == "vcv" ? Mode::free : Mode::solved);
  }
}

TEST(Airway, AJumpOfPressureIsCutWithTheFirstStep)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle X;
  PetscReal P;
  PULMO_OK(prepare(run, breathing("pcv", true).options()));
  PULMO_OK(DMCreateGlobalVector(run.model().dm(), X.out()));
  EulerAirway airway(run);
  Phase phase = pressure_phase(2, 3, 0.8);
  phase.from = 0.4;
  for (const auto &[dt, expected] : {std::pair(0.05, 0.8), {0.0125, 0.5}, {0.025, 0.6}, {0.5, 0.8}}) {
    airway.begin_phase(phase, 0);
    airway.begin_step(2 + dt, dt);
    PULMO_OK(airway->pressure(X, P));
    EXPECT_NEAR(P, expected, 1e-13) << dt;
  }
}

TEST(Airway, FlowMakesUpForWhatEarlierStepsLeft)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, breathing("vcv", true).options()));
  EulerAirway airway(run);
  const Phase phase = flow_phase(1, 2, 300);
  const double begin = 17;
  double volume = begin, t = 1;
  airway.begin_phase(phase, begin);
  for (double dt : {0.05, 0.1, 0.3, 0.01, 0.54}) {
    t += dt;
    airway.begin_step(t, dt);
    volume += airway->flow() * dt;
    EXPECT_NEAR(volume, begin + phase.delivered(t), 1e-12 * 300);
    volume += 1e-3; // the solver's error
    airway.accept(volume, airway->flow());
  }
}

TEST(Airway, TheGuessAfterAFailedAttemptIsTheLastAcceptedPressure)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle X;
  PULMO_OK(prepare(run, breathing("vcv common_pressure", true).options()));
  PULMO_OK(DMCreateGlobalVector(run.model().dm(), X.out()));
  EulerAirway airway(run);
  airway.begin_phase(flow_phase(0, 1, 300), 0);
  airway.begin_step(0.1, 0.1);
  PULMO_OK(run.model().airway().set(X, 0.25));
  PULMO_OK(airway->apply(X));
  airway.accept(15, 0);
  airway.begin_step(0.2, 0.1);
  PULMO_OK(run.model().airway().set(X, -1e30)); // where Newton went
  PULMO_OK(airway->apply(X));
  airway.begin_step(0.125, 0.025);
  PULMO_OK(airway->guess(X));
  std::vector<PetscReal> P;
  PULMO_OK(run.model().airway().scalars(X, P));
  EXPECT_EQ(P, std::vector<PetscReal>{0.25});
}

TEST(Airway, ALimitIsHeldOnceItIsExceeded)
{
  for (bool tube : {false, true})
    for (bool airflow : {false, true}) {
      const SceneSpec scene = breathing("vcv common_pressure", airflow, tube);
      SCOPED_TRACE(scene.text());
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      VecHandle X;
      PULMO_OK(prepare(run, scene.options()));
      PULMO_OK(DMCreateGlobalVector(run.model().dm(), X.out()));
      const double flow = 300, drop = tube ? 3 * units::kPa_per_cmH2O * flow / 1e6 : 0; // K1 = 3 cmH2O s/l
      Phase phase = flow_phase(0, 1, flow);
      phase.limit = 0.5;
      EulerAirway airway(run);
      airway.begin_phase(phase, 0);
      airway.begin_step(0.1, 0.1);
      PULMO_OK(run.model().airway().set(X, 0.5 - drop * (1 + 1e-9)));
      PULMO_OK(airway->apply(X));
      EXPECT_NEAR(airway->ventilator_pressure(flow), 0.5, 1e-9);
      EXPECT_FALSE(airway.limit(flow));
      EXPECT_EQ(airway->mode(), Mode::solved);
      PULMO_OK(run.model().airway().set(X, 0.5 - drop + 1e-6));
      PULMO_OK(airway->apply(X));
      EXPECT_TRUE(airway.limit(flow));
      airway.begin_step(0.1, 0.1); // an attempt with the limit held; a shorter one after it may stay below the limit
      EXPECT_EQ(airway->mode(), tube ? Mode::solved : Mode::held);
      airway->reject(Verdict::again); // it failed, and is made once more with new Jacobians
      airway.begin_step(0.1, 0.1);
      EXPECT_EQ(airway->mode(), tube ? Mode::solved : Mode::held);
      airway->reject(Verdict::shorter);
      airway.begin_step(0.05, 0.05);
      EXPECT_EQ(airway->mode(), Mode::solved);
      PULMO_OK(airway->apply(X));
      EXPECT_TRUE(airway.limit(flow));
      airway.begin_step(0.05, 0.05);
      EXPECT_EQ(airway->mode(), tube ? Mode::solved : Mode::held);
      airway.accept(10, 200);
      airway.begin_step(0.1, 0.05);
      EXPECT_EQ(airway->mode(), tube ? Mode::solved : Mode::held) << "to the end of the phase";
      PetscReal pressure;
      PULMO_OK(airway->pressure(X, pressure));
      if (!tube) {
        EXPECT_EQ(pressure, 0.5);
      }
      EXPECT_FALSE(airway.limit(1e9)) << "held already";
    }
}

TEST(Airway, DerivativesOfTheEquationOfTheOpening)
{
  for (bool airflow : {false, true})
    for (bool flow : {false, true}) {
      SceneSpec scene = breathing("vcv common_pressure", airflow, true);
      scene.more = "-tube_k2 4e5";
      SCOPED_TRACE(scene.text() + (flow ? "flow" : "pressure"));
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      PULMO_OK(prepare(run, scene.options()));
      EulerAirway airway(run);
      airway.begin_phase(flow ? flow_phase(0, 1, 0.7) : pressure_phase(0, 1, 0.8), 0.02);
      airway.begin_step(0.3, 0.05);
      const auto c = airway->equation();
      // expiration as well: |Q| must not lose its sign
      for (double V : {0.09, -0.03}) {
        const double P = 0.3;
        EXPECT_NEAR(c(P, V).by_pressure, (c(P + 1e-3, V).c - c(P - 1e-3, V).c) / 2e-3, 1e-9);
        EXPECT_NEAR(c(P, V).by_volume, (c(P, V + 1e-4).c - c(P, V - 1e-4).c) / 2e-4,
                    1e-7 * std::abs(c(P, V).by_volume));
        EXPECT_GT(std::abs(c(P, V).c), 1e-3);
        EXPECT_EQ(c(P, V).by_pressure == 0, flow);
      }
    }
}

TEST(Airway, TheWholeNewtonStepConvergesQuadratically)
{
  // one step from rest: a bordered step that misses a derivative would crawl to 1e-12
  for (const SceneSpec &scene : breathing_scenes()) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    bool finished = false;
    PULMO_OK(prepare(
        run, "-options_file " + source("petsc_options/solvers/tight.opts") + " " + scene.options() +
                 (scene.mode == "pcv" ? " -ventilator_ramp 0 -ventilator_pip 3" : " -ventilator_tidal_volume 4e-3") +
                 (scene.tube ? " -tube_k1 1000 -tube_k2 1e5" : "") + " -ts_max_time 0.05"));
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    EXPECT_GT(run.simulation().rows().back().volume, 1e-5);
    EXPECT_LE(run.simulation().rows().back().newton, 6);
    EXPECT_GE(run.simulation().rows().back().newton, 2);
  }
}

// --------------------------------------------------------------------------------------------------- model

TEST(AirwayModel, MeanPressureIsTheSurfaceMean)
{
  SceneSpec scene = breathing("vcv", true);
  scene.more = "-airflow_surfaces x1,z1"; // two faces of the unit cube that share an edge
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  PetscReal mean;
  PULMO_OK(prepare(run, scene.options()));
  PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
  PULMO_OK(interpolate(
      run, x,
      [](const double *) {
        return std::array<double, 3>{0, 0, 0};
      },
      [](const double X[3]) { return 0.2 + 3 * X[0] - 2 * X[1] + 5 * X[2]; }));
  PULMO_OK(run.model().airway().mean_pressure(x, mean));
  const double at_x1 = 0.2 + 3 - 1 + 2.5, at_z1 = 0.2 + 1.5 - 1 + 5; // at the middles of the faces
  EXPECT_NEAR(mean, (at_x1 + at_z1) / 2, 1e-13);
}

TEST(AirwayModel, APrescribedFlowEntersByAreaAtTheAirwayOnly)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  State s;
  VecHandle with;
  PULMO_OK(prepare(run, breathing("vcv", true).options()));
  PULMO_OK(random_state(run, 5, s));
  PULMO_OK(VecDuplicate(s.residual, with.out()));
  run.model().airway().hold(false);
  const double flow = 0.37;
  PULMO_OK(run.model().set_step(s.dt, 0, 0));
  PULMO_OK(run.model().residual(s.t, s.x, s.x_t, s.residual));
  PULMO_OK(run.model().set_step(s.dt, 0, flow));
  PULMO_OK(run.model().residual(s.t, s.x, s.x_t, with));
  PULMO_OK(VecAXPY(with, -1, s.residual));
  // int Q.N q with Q.N = -flow / area: minus the flow in all; with q = y half of it, with q = 1 - x nothing
  double total = 0, by_y = 0, away = 0, momentum = 0;
  {
    const ReadArray d(with);
    PULMO_OK(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt, const PetscReal X[3]) {
      const double value = d[dof] / run.model().row_scale(field);
      if (field == displacement) {
        momentum = std::max(momentum, std::abs(value));
        return;
      }
      total += value;
      by_y += X[1] * value;
      away += (1 - X[0]) * std::abs(value);
    }));
  }
  EXPECT_NEAR(total, -flow, 1e-12);
  EXPECT_NEAR(by_y, -flow / 2, 1e-12);
  EXPECT_LT(away, 1e-12);
  EXPECT_EQ(momentum, 0);
}

TEST(AirwayModel, HeldRowsAndColumnsAreIdentity)
{
  for (const SceneSpec &scene : {breathing("vcv", true), breathing("vcv common_pressure", false)}) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    State s;
    MatHandle A, dense;
    VecHandle rows, X, F;
    PetscInt n;
    PULMO_OK(prepare(run, scene.options()));
    PULMO_OK(random_state(run, 6, s));
    run.model().airway().hold(true);
    PULMO_OK(run.model().create_matrix(A.out()));
    PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
    PULMO_OK(MatConvert(A, MATDENSE, MAT_INITIAL_MATRIX, dense.out()));
    PULMO_OK(DMCreateGlobalVector(run.model().dm(), rows.out()));
    PULMO_OK(VecDuplicate(rows, F.out()));
    PULMO_OK(run.model().airway().set(rows, 1)); // 1 on the nodes of the airway and the carrier
    PULMO_OK(VecSet(F, 3));
    PULMO_OK(VecDuplicate(rows, X.out()));
    PULMO_OK(run.model().set_step(s.dt, 0.5)); // the residual is x - value
    PULMO_OK(run.model().airway().set(X, 0.75));
    PULMO_OK(run.model().airway().close_rows(X, F));
    PULMO_OK(VecGetSize(rows, &n));
    const ReadArray at_airway(rows), closed(F);
    const PetscScalar *a;
    PULMO_OK(MatDenseGetArrayRead(dense, &a));
    PetscInt held = 0;
    for (PetscInt i = 0; i < n; ++i) {
      if (at_airway[i] == 0) continue;
      ++held;
      EXPECT_EQ(closed[i], 0.25);
      for (PetscInt j = 0; j < n; ++j) {
        EXPECT_EQ(a[j * n + i], i == j ? 1 : 0);
        EXPECT_EQ(a[i * n + j], i == j ? 1 : 0);
      }
    }
    PULMO_OK(MatDenseRestoreArrayRead(dense, &a));
    EXPECT_EQ(held, scene.airflow ? 5 : 1); // corners and middle of the face x1; one dof of the gas
  }
}

TEST(AirwayModel, VolumeDerivative)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  State s;
  VecHandle y;
  Random random(9);
  PULMO_OK(prepare(run, breathing("vcv common_pressure", true).options()));
  PULMO_OK(random_state(run, 7, s));
  PULMO_OK(VecDuplicate(s.x, y.out()));
  PULMO_OK(interpolate(
      run, y,
      [&](const double *) {
        return std::array<double, 3>{random(), random(), random()};
      },
      [&](const double *) { return random(); }));
  PetscReal exact;
  PULMO_OK(run.model().volume_derivative(s.x, y, exact));
  const double difference = derivative(
      [&](double h) {
        Measures m;
        EXPECT_EQ(static_cast<int>(VecWAXPY(s.work, h, y, s.x)), 0);
        EXPECT_EQ(static_cast<int>(run.model().measure(s.work, m)), 0);
        return m.volume_change;
      },
      1e-4);
  EXPECT_GT(std::abs(exact), 1e-3);
  EXPECT_NEAR(exact, difference, 1e-10);
}

} // namespace
} // namespace pulmo::test
