// The laws and effects of docs/extending.md, as readers copy them from the page.
#include "registered.hpp"
#include "unit/harness.hpp"
#include "unit/scenes.hpp"

#include "pulmo/observers/energy.hpp"

namespace pulmo::test {
namespace {

const std::string lung = "-dm_plex_filename " + source("meshes/cube_lung.msh") + " -mesh_scale 1 -pc_type lu ";
const std::string breath =
    "-ventilator pcv -ventilator_pip 2 -ventilator_inspiration 0.2 -ventilator_expiration 0.2 "
    "-ventilator_ramp 0.1 -ts_dt 0.1 -ts_max_time 0.3 -airflow -airflow_permeability_law opening "
    "-airflow_permeability 300 -lumen_pressure off -ventilator_settle off "
    "-chest_wall -tissue simple ";

/// What the page adds, by name.
template <class T>
std::vector<std::unique_ptr<T>> added(std::vector<std::unique_ptr<T>> page,
                                      const std::vector<std::unique_ptr<T>> &standard)
{
  page.erase(page.begin(), page.begin() + static_cast<std::ptrdiff_t>(standard.size()));
  return page;
}

TEST(Extending, LawsAreThoseOfTheirEnergy)
{
  const auto laws = added(registry_of_the_page().make_tissue_laws(), Registry::standard().make_tissue_laws());
  ASSERT_EQ(laws.size(), 3u); // the same law in three ways
  Random random(11);
  for (double J : {0.5, 0.9, 1.0, 1.4, 2.5})
    for (int n = 0; n < 5; ++n) {
      const Tensor F = random_deformation(random, J);
      Tensor P[3];
      std::array<double, 81> A[3];
      for (int i = 0; i < 3; ++i) {
        laws[i]->stress(state_of_F(F), P[i].data());
        laws[i]->tangent(state_of_F(F), A[i].data());
      }
      const double scale = largest(P[0]) + 1;
      for (int l : {1, 2}) {
        EXPECT_NEAR(laws[l]->energy(state_of_F(F)), laws[0]->energy(state_of_F(F)), 1e-14 * scale);
        EXPECT_LT(largest(P[0] - P[l]), 1e-14 * scale);
        for (std::size_t i = 0; i < 81; ++i) EXPECT_NEAR(A[0][i], A[l][i], 1e-14 * scale);
      }
      for (int c = 0; c < 9; ++c) {
        const auto moved = [&](double step) {
          Tensor G = F;
          G[c] += step;
          return state_of_F(G);
        };
        EXPECT_NEAR(P[0][c], derivative([&](double step) { return laws[0]->energy(moved(step)); }, 2e-4), 1e-9 * scale);
        for (int i = 0; i < 9; ++i) {
          const double dP = derivative(
              [&](double step) {
                Tensor Q;
                laws[0]->stress(moved(step), Q.data());
                return Q[i];
              },
              2e-4);
          EXPECT_NEAR(A[0][27 * (i / 3) + 9 * (c / 3) + 3 * (i % 3) + c % 3], dP, 1e-9 * scale);
        }
      }
    }
  Tensor rest;
  laws[0]->stress(state_of_F(identity), rest.data());
  EXPECT_LT(largest(rest), 1e-15);
}

/// One of them remembers on surfaces.
TEST(Extending, TheSweepGoesThroughEffects)
{
  const Registry registry = registry_of_the_page();
  for (const auto &effect : added(registry.make_effects(), Registry::standard().make_effects())) {
    Findings refused;
    for (const Subject &subject : alone(registry, {effect->name()}, refused)) {
      SCOPED_TRACE(subject.text());
      for (const std::string &finding : find({"adjoint", check_adjoint, false}, subject)) ADD_FAILURE() << finding;
    }
  }
}

TEST(Extending, JacobiansAreThoseOfTheResiduals)
{
  unsigned seed = 500;
  for (const auto &effect : added(registry_of_the_page().make_effects(), Registry::standard().make_effects())) {
    SCOPED_TRACE(effect->name());
    const Registry registry = registry_of_the_page();
    SceneRun run(registry);
    State s;
    VecHandle d;
    PULMO_OK(prepare(run, lung + breath + effect->example()));
    PULMO_OK(random_state(run, ++seed, s));
    PULMO_OK(random_direction(run, d));
    run.model().airway().hold(false);
    for (const Stage &stage : {Stage(s.dt), Stage(s.dt, 1.5 / s.dt, true, -2 / s.dt, 0.5 / s.dt)}) {
      PetscReal difference = 1, size = 0;
      const auto residual = [&](PetscReal h, Vec F) { return residual_at(run, s, d, h, stage.slope, F); };
      PULMO_OK(compare_jacobian(run, s, stage, d, residual, difference, size));
      EXPECT_GT(size, 0);
      EXPECT_LT(difference, 1e-7 * size);
    }
  }
}

TEST(Extending, EnergyOfARunCloses)
{
  std::string all;
  for (const auto &effect : added(registry_of_the_page().make_effects(), Registry::standard().make_effects()))
    all += effect->example() + " ";
  for (const std::string &more : {all, all + "-drag_viscosity 0.02,airway=0 -drag_surfaces pleura,airway "}) {
    const Registry registry = registry_of_the_page();
    SceneRun run(registry);
    Sampling sampling;
    EnergyAudit audit(run.scene(), run.model(), sampling);
    bool finished = false;
    PULMO_OK(prepare(run, lung + breath + more + "-snes_rtol 1e-13 -snes_atol 1e-12 -snes_stol 0 -snes_max_it 40"));
    PULMO_OK(sampling.setup(run.model()));
    PULMO_OK(audit.setup());
    run.simulation().add(audit);
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished) << run.simulation().failure_text();
    EXPECT_LT(audit.worst_share(), 1e-8);
    for (const std::string account : {"viscous_tethers", "resistive_film", "resistive_bronchus", "elastic_bronchus"}) {
      const auto found = std::find_if(audit.accounts().begin(), audit.accounts().end(),
                                      [&](const EnergyAccount &a) { return a.name == account; });
      ASSERT_NE(found, audit.accounts().end()) << account;
      EXPECT_GT(audit.rows().back().accounts[static_cast<std::size_t>(found - audit.accounts().begin())], 0);
    }
  }
}

} // namespace
} // namespace pulmo::test
