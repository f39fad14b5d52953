// Rates of what is conserved: exact for the polynomials of the scheme's order, and for the gas in a deformed cell.
#include "unit/scenes.hpp"

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/time/time_scheme.hpp"

#include <petsc/private/tsimpl.h>

namespace pulmo::test {
namespace {

double quadratic(double t)
{
  return 3 + 2 * t - 5 * t * t;
}

TEST(TimeScheme, BackwardEulerIsExactForLines)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, SceneSpec().options()));
  TimeScheme scheme;
  PULMO_OK(scheme.begin(run.model(), {1, 7, nullptr}));
  PULMO_OK(scheme.begin_stage(1.25, 0.25));
  EXPECT_DOUBLE_EQ(scheme.slope(), 4);
  EXPECT_DOUBLE_EQ(scheme.flow(9), 8);
}

TEST(TimeScheme, Bdf2IsExactForParabolasAndGas)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  SceneSpec spec;
  spec.airflow = true;
  TS ts;
  VecHandle x, residual;
  PULMO_OK(prepare(run, spec.options()));
  Model &model = run.model();
  PULMO_OK(DMCreateLocalVector(model.dm(), x.out()));
  PULMO_OK(VecDuplicate(x, residual.out()));
  PULMO_OK(TSCreate(PETSC_COMM_WORLD, &ts));
  PULMO_OK(TSSetDM(ts, model.dm()));
  PULMO_OK(TSSetType(ts, TSBDF));
  TimeScheme scheme;
  PULMO_OK(scheme.setup(ts, x));
  EXPECT_TRUE(scheme.multistep());

  // gas of a state: int (J - 1) q summed over q is the volume
  const auto inflate = [&](double stretch) {
    PetscSection section;
    PetscInt begin, end;
    PULMO_OK(DMGetLocalSection(model.dm(), &section));
    PULMO_OK(PetscSectionGetChart(section, &begin, &end));
    WriteArray a(x);
    for (PetscInt p = begin; p < end; ++p) {
      PetscInt n, offset;
      PetscReal at[3];
      PULMO_OK(PetscSectionGetFieldDof(section, p, displacement, &n));
      PULMO_OK(PetscSectionGetFieldOffset(section, p, displacement, &offset));
      if (n == 0) continue;
      PULMO_OK(node_coordinates(model.dm(), p, at));
      for (PetscInt d = 0; d < 3; ++d) a[offset + d] = stretch * at[d];
    }
  };
  const auto volume = [&](double &V) {
    Measures measures;
    PULMO_OK(model.measure(x, measures));
    V = measures.volume_change;
  };
  const auto past = [&](double &flow) {
    PetscScalar sum;
    PULMO_OK(model.set_step(scheme.stage(), 0));
    PULMO_OK(VecZeroEntries(residual));
    PULMO_OK(scheme.add_past(model, residual));
    PULMO_OK(VecSum(residual, &sum));
    flow = sum / model.row_scale(pressure);
  };

  // first step after a restart: half of it with backward Euler, then the three points of the step
  inflate(0.1);
  double V0 = 0, V1 = 0, flow = 0;
  volume(V0);
  PULMO_OK(scheme.begin(model, {1, V0, x}));
  PULMO_OK(TSRestartStep(ts));
  PULMO_OK(scheme.begin_stage(1.05, 0.1));
  EXPECT_NEAR(scheme.slope(), 20, 1e-12);
  past(flow);
  EXPECT_NEAR(flow, -20 * V0, 1e-9 * V0);
  inflate(0.13);
  volume(V1);
  PULMO_OK(scheme.accept_stage(model, {1.05, V1, x}));
  PULMO_OK(scheme.begin_stage(1.1, 0.1));
  EXPECT_NEAR(scheme.slope(), 30, 1e-11);
  EXPECT_NEAR(scheme.past_flow(), 10 * V0 - 40 * V1, 1e-9 * V0);
  past(flow);
  EXPECT_NEAR(flow, scheme.past_flow(), 1e-9 * V0);

  // steps of any size: exact for parabolas
  PULMO_OK(VecZeroEntries(x));
  PULMO_OK(scheme.begin(model, {2, quadratic(2), x}));
  PULMO_OK(TSRestartStep(ts));
  PULMO_OK(scheme.begin_stage(2.05, 0.1));
  PULMO_OK(scheme.accept_stage(model, {2.05, quadratic(2.05), x}));
  PULMO_OK(scheme.begin_stage(2.1, 0.1));
  EXPECT_NEAR(scheme.flow(quadratic(2.1)), 2 - 10 * 2.1, 1e-11);
  PULMO_OK(scheme.accept(model, {2.1, quadratic(2.1), x}));
  ts->steprestart = PETSC_FALSE;
  double t = 2.1;
  for (double dt : {0.04, 0.1, 0.01}) {
    t += dt;
    PULMO_OK(scheme.begin_stage(t, dt));
    EXPECT_NEAR(scheme.flow(quadratic(t)), 2 - 10 * t, 1e-10);
    PULMO_OK(scheme.accept(model, {t, quadratic(t), x}));
  }
  PULMO_OK(TSDestroy(&ts));
}

} // namespace
} // namespace pulmo::test
