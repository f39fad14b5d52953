// The energy balance of whole runs: it closes at any step size, its rows are what closed forms say, and what backward
// Euler loses falls with the step.
#include "unit/scenes.hpp"

#include "pulmo/observers/energy.hpp"

#include <set>

namespace pulmo::test {
namespace {

/// A run of options with its audit.
struct Audited {
  SceneRun run{Registry::standard()};
  Sampling sampling;
  EnergyAudit audit{run.scene(), run.model(), sampling};
  bool finished = false;

  PetscErrorCode go(const std::string &options)
  {
    PetscFunctionBeginUser;
    PetscCall(prepare(run, "-pc_type lu -snes_rtol 1e-14 -snes_atol 1e-12 -snes_stol 0 -snes_max_it 40 " + options));
    PetscCall(sampling.setup(run.model()));
    PetscCall(audit.setup());
    run.simulation().add(audit);
    PetscCall(run.simulation().run(finished));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const std::vector<SignalRow> &signals() { return run.simulation().rows(); }
  const EnergyBalance &end() const { return audit.rows().back(); }
  /// A row of the balance, J.
  double operator()(const std::string &name, const EnergyBalance &balance) const
  {
    for (std::size_t i = 0; i < audit.accounts().size(); ++i)
      if (audit.accounts()[i].name == name) return balance.accounts[i];
    ADD_FAILURE() << "no row " << name;
    return std::nan("");
  }
  double operator()(const std::string &name) const { return (*this)(name, end()); }
};

const std::string lung = "-dm_plex_filename " + source("meshes/cube_lung.msh") + " -mesh_scale 1 -lumen_pressure off ";
const std::string breath = "-ventilator pcv -ventilator_pip 8 -ventilator_inspiration 0.2 -ventilator_expiration 0.2 "
                           "-ventilator_ramp 0.1 ";
const std::string gas = "-airflow -airflow_permeability 300 ";
const std::string springs = "-chest_wall ";

struct Case {
  std::string name, options;
};

/// Scenes that together use every effect, and every law.
std::vector<Case> cases()
{
  std::vector<Case> list;
  for (const std::string &law : law_names())
    list.push_back({"airflow, springs, " + law, breath + gas + springs + "-lumen_pressure -tissue " + law + " "});
  list.push_back({"paper's traction", breath + gas + springs});
  list.push_back(
      {"normal springs", breath + gas + springs + "-chest_wall_direction normal -chest_wall_surfaces pleura "});
  list.push_back(
      {"springs that turn, stiffen and pull", breath + gas + springs +
                                                  "-chest_wall_direction current_normal -chest_wall_surfaces "
                                                  "pleura -chest_wall_stiffening 2 -chest_wall_offset 3 "});
  list.push_back({"springs that stiffen", breath + gas + springs + "-chest_wall_stiffening 2 "});
  list.push_back({"no springs", breath + gas + "-support -support_rigid "});
  list.push_back({"damped pressure", breath + gas + springs + "-pressure_damping "});
  list.push_back({"no airflow", breath + springs});
  list.push_back(
      {"no airflow, normal springs, wall pressure", breath + springs +
                                                        "-lumen_pressure -tissue ma "
                                                        "-chest_wall_direction normal -chest_wall_surfaces pleura "});
  list.push_back(
      {"everything", breath + gas + springs +
                         "-lumen_pressure -lumen_pressure_surfaces airway,pleura "
                         "-ventilator_peep 2 -chest_wall_stiffness_pleura 0.2 -traction -traction_surfaces airway "
                         "-traction_value 0.1,-0.05,0.2 "});
  list.push_back(
      {"springs that differ by surface", breath + gas + "-chest_wall -chest_wall_stiffness 0.08,airway=0.5 "});
  list.push_back({"loads only", "-ts_max_time 0.4 " + gas + springs +
                                    "-traction -traction_surfaces airway "
                                    "-traction_value 0.1,-0.05,0.2 "});
  list.push_back({"loads only, no airflow", "-ts_max_time 0.2 " + springs +
                                                "-traction -traction_surfaces airway "
                                                "-traction_value 0.1,-0.05,0.2 "});
  return list;
}

TEST(EnergyBalance, ClosesWhateverTheStepAndTheScene)
{
  for (const Case &c : cases())
    for (double dt : {0.1, 0.05, 0.025}) {
      Audited a;
      PULMO_OK(a.go(lung + c.options + "-ts_dt " + std::to_string(dt)));
      ASSERT_TRUE(a.finished) << c.name;
      ASSERT_EQ(a.audit.rows().size(), a.signals().size());
      ASSERT_GT(a.end().exchanged, 0) << c.name;
      const double scale = a.end().exchanged;
      double before = 0, largest = 0;
      for (const EnergyBalance &row : a.audit.rows()) {
        largest = std::max(largest, std::abs(row.residual - before)); // of one step
        before = row.residual;
      }
      EXPECT_LT(a.end().relative_residual(), 1e-9) << c.name << ", dt " << dt;
      EXPECT_LT(largest, 1e-9 * scale) << c.name << ", dt " << dt;
      if (c.options.find("-ventilator") != std::string::npos) {
        EXPECT_GT(a.end().ventilator_work, 0) << c.name;
        EXPECT_LT(std::abs(a.end().residual), 1e-6 * a.end().ventilator_work) << c.name;
      }
      // every row that the scene has is there, and no other
      const auto has = [&](const char *word) { return c.options.find(word) != std::string::npos; };
      EXPECT_EQ(a("resistive") > 1e-6 * scale, has("-airflow")) << c.name;
      const std::size_t middle = a.audit.rows().size() / 2;
      EXPECT_GT(a("elastic_tissue", a.audit.rows()[middle]), 0) << c.name;
      EXPECT_EQ(a("elastic_springs", a.audit.rows()[middle]) > 0, has("-chest_wall")) << c.name;
      EXPECT_EQ(a("external") != 0, has("-lumen_pressure") || has("-traction") || has("_offset")) << c.name;
      EXPECT_GT(a("numerical_dissipation"), 1e-4 * scale) << c.name;
      EXPECT_EQ(a("resistive_tube"), 0);
    }
}

TEST(EnergyBalance, NumericalRowFallsWithTheFirstOrderOfTheStep)
{
  // ramps that the steps resolve; a pressure that jumps excites every mode of the gas and falls more slowly
  const std::string slow = "-ventilator pcv -ventilator_pip 6 -ventilator_inspiration 0.4 -ventilator_expiration 0.4 "
                           "-ventilator_ramp 0.4 -ventilator_ramp_down 0.4 -chest_wall ";
  for (const std::string &scene : {slow + gas, slow, slow + gas + "-tissue ma -lumen_pressure "}) {
    std::vector<double> lost;
    for (double dt : {0.1, 0.05, 0.025, 0.0125}) {
      Audited a;
      PULMO_OK(a.go(lung + scene + "-ts_dt " + std::to_string(dt)));
      ASSERT_TRUE(a.finished);
      lost.push_back(a("numerical_dissipation"));
      EXPECT_GT(lost.back(), 0.01 * a.end().exchanged);
    }
    for (std::size_t i = 0; i + 1 < lost.size(); ++i) EXPECT_NEAR(lost[i] / lost[i + 1], 2, 0.1) << scene << " " << i;
  }
}

TEST(EnergyBalance, FreeInflationStoresTheIntegralOfPressure)
{
  // J uniform: W(J) is the integral of p(J) = 2 c J^-1/3 - 2 c J^(-2 beta - 1), by parts from the closed form
  Audited a;
  const double c = 1.298, beta = 0.75, V0 = 1000; // mm^3
  PULMO_OK(a.go(lung + "-ventilator pcv -ventilator_pip 6 -ventilator_ramp 1 -ventilator_expiration 0.5 -ts_dt 0.1 "
                       "-tissue yoshihara -support -support_rigid"));
  ASSERT_TRUE(a.finished);
  double work = 0, lost = 0;
  const auto W = [&](double J) { return 3 * c * (std::pow(J, 2. / 3) - 1) + c / beta * (std::pow(J, -2 * beta) - 1); };
  for (std::size_t i = 1; i < a.signals().size(); ++i) {
    const SignalRow &row = a.signals()[i], &before = a.signals()[i - 1];
    const double J = 1 + row.volume * 1000 / V0, J0 = 1 + before.volume * 1000 / V0, p = row.pressure * 0.0980665;
    EXPECT_NEAR(p, 2 * c * std::pow(J, -1. / 3) - 2 * c * std::pow(J, -2 * beta - 1), 1e-9); // it is free inflation
    work += p * (J - J0) * V0 * 1e-6;
    lost += (p * (J - J0) - W(J) + W(J0)) * V0 * 1e-6;
    EXPECT_NEAR(a.audit.rows()[i].ventilator_work, work, 1e-12);
    EXPECT_NEAR(a("elastic_tissue", a.audit.rows()[i]), W(J) * V0 * 1e-6, 1e-12);
    EXPECT_NEAR(a("numerical_dissipation", a.audit.rows()[i]), lost, 1e-12);
  }
  EXPECT_GT(work, 1e-6);
  EXPECT_EQ(a("resistive"), 0);
}

TEST(EnergyBalance, CountsTheWorkOfSupportsThatMove)
{
  // the face x1 is displaced by 0.1 in one step, the others are free or held: all work comes from the support
  Audited a;
  PULMO_OK(a.go("-dm_plex_filename " + source("meshes/cube_coarse.msh") +
                " -mesh_scale 1 -ts_dt 0.1 -ts_max_time 0.3 -tissue yoshihara -airflow -airflow_surfaces y0 "
                "-airflow_permeability 0.7 -support -support_surfaces x0,x1 -support_displacement_x1 0.1,0.02,0"));
  ASSERT_TRUE(a.finished);
  EXPECT_GT(a("external"), 0);
  EXPECT_GT(a("elastic_tissue"), 0);
  EXPECT_LT(a.end().relative_residual(), 1e-10);
  EXPECT_EQ(a("external"), a("external", a.audit.rows()[1])); // held from the first step on
}

TEST(EnergyBalance, OnlyActiveEffectsDeclareTerms)
{
  for (const SceneSpec &spec : all_scenes()) {
    SceneRun run(Registry::standard());
    PULMO_OK(prepare(run, spec.options()));
    std::set<std::string> expected{"tissue"}, found;
    if (spec.airflow) expected.insert("airflow");
    if (spec.ventilator && !spec.airflow) expected.insert("ventilator"); // the uniform gas
    if (!spec.chest_wall.empty()) expected.insert("chest_wall");
    if (spec.lumen_pressure) expected.insert("lumen_pressure");
    if (spec.traction) expected.insert("traction");
    for (const EnergyTerm &term : run.model().composition().energies()) found.insert(term.effect);
    EXPECT_EQ(found, expected) << spec.text();
  }
}

TEST(EnergyBalance, DifferenceOfRowsIsThatOfThePartBetween)
{
  EnergyBalance a, b;
  a.ventilator_work = 5, a.exchanged = 7, a.accounts = {1, 2}, a.residual = 0.5;
  b.ventilator_work = 3, b.exchanged = 3, b.accounts = {4, 1}, b.residual = 0.1;
  const EnergyBalance d = a - b;
  EXPECT_EQ(d.ventilator_work, 2);
  EXPECT_EQ(d.accounts, (std::vector<double>{-3, 1}));
  EXPECT_NEAR(d.relative_residual(), 0.1, 1e-15);
  EXPECT_EQ(EnergyBalance().relative_residual(), 0);
}

} // namespace
} // namespace pulmo::test
