// Free inflation of an unstructured mesh through the whole program: F = J^1/3 I with p = dW/dJ, exact for P2.
#include "unit/scenes.hpp"

#include "pulmo/units.hpp"

namespace pulmo::test {
namespace {

constexpr const char *names[] = {"berger", "ma", "birzle", "yoshihara", "rausch"};

/// Runs to 6 cmH2O and compares J at every point and u at every node with the closed form.
void expect_free_inflation(int law, const std::string &options)
{
  SCOPED_TRACE(names[law - 1]);
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  bool finished = false;

  PULMO_OK(prepare(run, "-options_file " + source("petsc_options/solvers/tight.opts") + " -mesh_scale 1 -tissue " +
                          names[law - 1] + " -support -support_rigid -ventilator pcv -ventilator_pip 6 " + options));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  EXPECT_EQ(run.simulation().rejected_steps(), 0);

  const double p = 6 * units::kPa_per_cmH2O, J = inflation_J(law, p), stretch = std::cbrt(J);
  const Vec x = run.simulation().local_state();
  double worst_J = 0, worst_u = 0, worst_p = 0, pin[3] = {0, 0, 0};
  {
    const ReadArray values(x);
    std::vector<PointState> states;
    for (PetscInt c = 0; c < run.model().assembly().cells(); ++c) {
      run.model().assembly().point_states(c, values.data(), states);
      for (const PointState &s : states) {
        worst_J = std::max(worst_J, std::abs(s.J - J));
        for (int i = 0; i < 9; ++i) worst_J = std::max(worst_J, std::abs(s.F[i] - stretch * identity[i]));
      }
    }
    // the centre of inflation is the vertex whose three components are pinned: the lowest
    std::array<Mesh::Pin, 3> pins;
    PULMO_OK(run.scene().mesh().rigid_pins(pins));
    for (int d = 0; d < 3; ++d) pin[d] = pins[0].x[d];
    PULMO_OK(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt component, const PetscReal X[3]) {
      if (field == displacement)
        worst_u = std::max(worst_u, std::abs(values[dof] - (stretch - 1) * (X[component] - pin[component])));
      else worst_p = std::max(worst_p, std::abs(values[dof] - p));
    }));
  }
  EXPECT_LT(worst_J, 1e-9);
  EXPECT_LT(worst_u, 1e-9);
  EXPECT_LT(worst_p, 1e-9);
  EXPECT_NEAR(run.simulation().rows().back().pressure, 6, 1e-12);
  EXPECT_NEAR(run.simulation().rows().back().volume * 1000 / run.scene().mesh().volume(), J - 1, 1e-9);
  RecordProperty("worst_J", std::to_string(worst_J));
  std::printf("CM%d: J off by %.1e, u by %.1e mm, p by %.1e kPa\n", law, worst_J, worst_u, worst_p);
}

TEST(FreeInflation, WithoutAirflow)
{
  for (int law = 1; law <= 5; ++law)
    expect_free_inflation(law, "-dm_plex_filename " + source("meshes/cube.msh") +
                                 " -ventilator_inspiration 1 -ventilator_ramp 1 -ts_max_time 1 -ts_dt 0.05");
}

TEST(FreeInflation, WithAirflowThroughTheWholeBoundary)
{
  // the pressure settles within (1 mm)^2 / (k W'') = 1e-4 s; the plateau of 0.5 s leaves nothing of the transient
  for (int law = 1; law <= 5; ++law)
    expect_free_inflation(law, "-dm_plex_filename " + source("meshes/cube.msh") +
                                 " -airflow -airflow_permeability 1e4 -airflow_surfaces x0,x1,y0,y1,z0,z1"
                                 " -ventilator_inspiration 1.5 -ventilator_ramp 1 -ts_max_time 1.5 -ts_dt 0.05");
}

} // namespace
} // namespace pulmo::test
