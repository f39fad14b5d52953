// What every effect must keep, whichever it is: taken from the registry, alone and with each other one. An effect that
// is registered is checked here without a line; what only it knows (a closed form) stands in tests/verification.
#include "unit/scenes.hpp"

#include "pulmo/observers/energy.hpp"

namespace pulmo::test {
namespace {

const std::string lung = "-dm_plex_filename " + source("meshes/cube_lung.msh") + " -mesh_scale 1 -pc_type lu ";
const std::string breath = "-ventilator pcv -ventilator_pip 2 -ventilator_inspiration 0.2 -ventilator_expiration 0.2 "
                           "-ventilator_ramp 0.1 -ts_dt 0.1 -ts_max_time 0.3 -airflow -airflow_permeability 300 "
                           "-lumen_pressure off -ventilator_settle off ";
/// Something holds the lung in every scene.
const std::string springs = "-chest_wall ";

std::vector<std::string> laws()
{
  std::vector<std::string> names;
  for (const auto &law : Registry::standard().make_tissue_laws()) names.emplace_back(law->name());
  return names;
}

struct Scene {
  std::string text, options;
};

/// Each effect alone, each pair, and some triples (drawn, the same ones each time).
std::vector<Scene> scenes()
{
  const auto effects = Registry::standard().make_effects();
  const std::vector<std::string> law = laws();
  std::vector<Scene> list;
  const auto add = [&](const std::vector<std::size_t> &which) {
    Scene s;
    s.options = lung + breath + springs + "-tissue " + law[list.size() % law.size()] + " ";
    for (const std::size_t i : which) {
      s.text += std::string(effects[i]->name()) + " ";
      s.options += effects[i]->example() + " ";
    }
    list.push_back(s);
  };
  for (std::size_t i = 0; i < effects.size(); ++i) {
    add({i});
    for (std::size_t j = 0; j < i; ++j) add({i, j});
  }
  Random random(31);
  for (int n = 0; n < 6; ++n) {
    std::vector<std::size_t> which;
    while (which.size() < 3) {
      const auto i = static_cast<std::size_t>(random(0, static_cast<double>(effects.size()) - 1e-9));
      if (std::find(which.begin(), which.end(), i) == which.end()) which.push_back(i);
    }
    add(which);
  }
  return list;
}

/// Stages of backward Euler and of BDF2.
std::vector<Stage> stages(PetscReal dt)
{
  return {Stage(dt), Stage(dt, 1.5 / dt, true, -2 / dt, 0.5 / dt)};
}

TEST(Harness, JacobiansAreThoseOfTheResiduals)
{
  unsigned seed = 90;
  for (const Scene &scene : scenes()) {
    SCOPED_TRACE(scene.text);
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    State s;
    MatHandle A;
    VecHandle d, product, forward, backward;
    PULMO_OK(prepare(run, scene.options));
    PULMO_OK(random_state(run, ++seed, s));
    run.model().airway().hold(false);
    PULMO_OK(run.model().create_matrix(A.out()));
    PULMO_OK(DMCreateGlobalVector(run.model().dm(), d.out()));
    for (VecHandle *v : {&product, &forward, &backward}) PULMO_OK(VecDuplicate(d, v->out()));
    PetscRandom numbers;
    PULMO_OK(PetscRandomCreate(PETSC_COMM_WORLD, &numbers));
    PULMO_OK(PetscRandomSetInterval(numbers, -1, 1));
    PULMO_OK(VecSetRandom(d, numbers));
    PULMO_OK(PetscRandomDestroy(&numbers));
    for (const Stage &stage : stages(s.dt)) {
      SCOPED_TRACE(stage.multistep ? "BDF2" : "backward Euler");
      constexpr PetscReal h = 1e-5;
      PetscReal scale, difference;
      PULMO_OK(run.model().set_step(stage, s.airway_pressure));
      PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, stage.slope, A));
      PULMO_OK(MatMult(A, d, product));
      PULMO_OK(residual_at(run, s, d, h, stage.slope, forward));
      PULMO_OK(residual_at(run, s, d, -h, stage.slope, backward));
      PULMO_OK(VecAXPY(forward, -1, backward));
      PULMO_OK(VecScale(forward, 0.5 / h));
      PULMO_OK(VecNorm(forward, NORM_2, &scale));
      PULMO_OK(VecAXPY(forward, -1, product));
      PULMO_OK(VecNorm(forward, NORM_2, &difference));
      EXPECT_GT(scale, 0);
      EXPECT_LT(difference, 1e-7 * scale);
    }
  }
}

/// Residual and Jacobian of a state with a free airway, as numbers; @p terms of effect @p of.
void assemble(const std::string &options, std::vector<double> &residual, std::vector<double> &entries,
              const std::string &of = "", long *terms = nullptr)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  State s;
  VecHandle F;
  MatHandle A;
  PULMO_OK(prepare(run, options));
  const auto &all = run.model().composition().terms();
  if (terms) *terms = std::count_if(all.begin(), all.end(), [&](const Term &t) { return t.effect == of; });
  run.model().airway().hold(false);
  PULMO_OK(random_state(run, 77, s));
  PULMO_OK(DMCreateGlobalVector(run.model().dm(), F.out()));
  PULMO_OK(residual_at(run, s, nullptr, 0, 1 / s.dt, F));
  PULMO_OK(run.model().create_matrix(A.out()));
  PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
  PetscInt n;
  PULMO_OK(VecGetLocalSize(F, &n));
  const ReadArray f(F);
  residual.assign(f.data(), f.data() + n);
  entries.clear();
  for (PetscInt row = 0; row < n; ++row) {
    PetscInt width;
    const PetscInt *columns;
    const PetscScalar *values;
    PULMO_OK(MatGetRow(A, row, &width, &columns, &values));
    for (PetscInt i = 0; i < width; ++i) {
      entries.push_back(columns[i]);
      entries.push_back(values[i]);
    }
    PULMO_OK(MatRestoreRow(A, row, &width, &columns, &values));
  }
}

TEST(Harness, AnEffectThatIsOffLeavesNoTrace)
{
  const std::string base = lung + breath + "-tissue " + laws().front() + " ";
  std::vector<double> residual, entries, other_residual, other_entries;
  ASSERT_NO_FATAL_FAILURE(assemble(base, residual, entries));
  for (const auto &effect : Registry::standard().make_effects()) {
    SCOPED_TRACE(effect->name());
    ASSERT_NO_FATAL_FAILURE(assemble(base + "-" + effect->name() + " off", other_residual, other_entries));
    EXPECT_TRUE(residual == other_residual);
    EXPECT_TRUE(entries == other_entries);
    long terms = 0;
    ASSERT_NO_FATAL_FAILURE(assemble(base + effect->example(), other_residual, other_entries, effect->name(), &terms));
    EXPECT_TRUE(terms == 0 || residual != other_residual || entries != other_entries) << "its terms change nothing";
  }
}

/// Whether the scene of @p options has an effect of that name.
void expect_active(const std::string &options, const std::string &name)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, options));
  const auto active = run.scene().active();
  EXPECT_TRUE(std::any_of(active.begin(), active.end(), [&](const Effect *e) { return e->name() == name; })) << options;
}

TEST(Harness, AnEffectIsThereWhereItsExampleSaysSo)
{
  for (const auto &effect : Registry::standard().make_effects())
    expect_active(lung + breath + springs + effect->example(), effect->name());
}

TEST(Harness, BothIntegratorsOfPetscFE)
{
  for (const auto &effect : Registry::standard().make_effects()) {
    SCOPED_TRACE(effect->name());
    const std::string options = lung + breath + springs + "-tissue " + laws().front() + " " + effect->example() + " ";
    {
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      PULMO_OK(prepare(run, options));
      if (run.model().memory()) continue; // needs pulmo's own, and says so
    }
    std::vector<double> residual, entries, other_residual, other_entries;
    ASSERT_NO_FATAL_FAILURE(assemble(options, residual, entries));
    ASSERT_NO_FATAL_FAILURE(assemble(options + "-petscfe_type basic", other_residual, other_entries));
    ASSERT_EQ(residual.size(), other_residual.size());
    ASSERT_EQ(entries.size(), other_entries.size());
    double scale = 0, entry_scale = 0;
    for (const double f : residual) scale = std::max(scale, std::abs(f));
    for (std::size_t i = 1; i < entries.size(); i += 2) entry_scale = std::max(entry_scale, std::abs(entries[i]));
    for (std::size_t i = 0; i < residual.size(); ++i) ASSERT_NEAR(residual[i], other_residual[i], 1e-12 * scale);
    for (std::size_t i = 0; i < entries.size(); ++i) ASSERT_NEAR(entries[i], other_entries[i], 1e-12 * entry_scale);
  }
}

TEST(Harness, EnergyOfARunCloses)
{
  for (const Scene &scene : scenes()) {
    SCOPED_TRACE(scene.text);
    SceneRun run{Registry::standard()};
    Sampling sampling;
    EnergyAudit audit(run.scene(), run.model(), sampling);
    bool finished = false;
    PULMO_OK(prepare(run, scene.options + "-snes_rtol 1e-13 -snes_atol 1e-12 -snes_stol 0 -snes_max_it 40"));
    PULMO_OK(sampling.setup(run.model()));
    PULMO_OK(audit.setup());
    run.simulation().add(audit);
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    EXPECT_LT(audit.worst_share(), 1e-8);
  }
}

} // namespace
} // namespace pulmo::test
