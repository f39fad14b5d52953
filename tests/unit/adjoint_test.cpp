// The backward sweep: derivatives of clinical numbers against differences of whole runs.
#include "unit/scenes.hpp"

#include "pulmo/adjoint/sensitivities.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/observers/clinical.hpp"

#include <cmath>

namespace pulmo::test {
namespace {

const char *const numbers = "V_T,C_rs,R,PIP,P_plat,Q_peak,Q_exp,work";

/// The numbers of a run, and what the sweep says of them.
struct Swept {
  std::vector<SignalRow> rows;
  SensitivityReport report;
  PetscInt rejected = 0;
};

PetscErrorCode run_scene(const std::string &options, bool sweeps, Swept &result)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  Sensitivities sensitivities;
  bool finished = false;

  PetscFunctionBeginUser;
  PetscCall(set_options("-options_file " + source("petsc_options/solvers/tight.opts") + " " + options +
                        (sweeps ? std::string(" -sensitivities_rtol 1e-13 -sensitivities ") + numbers : "")));
  PetscCall(run.declare());
  PetscCall(sensitivities.declare(run.options()));
  PetscCall(run.setup());
  PetscCall(sensitivities.check(run.options(), run.scene(), run.model(), false));
  PetscCall(sensitivities.attach(run.simulation(), testing::TempDir()));
  PetscCall(run.simulation().run(finished));
  PetscCheck(finished, PETSC_COMM_SELF, PETSC_ERR_LIB, "%s", run.simulation().failure_text().c_str());
  result.rows = run.simulation().rows();
  result.rejected = run.simulation().rejected_steps();
  if (sweeps)
    PetscCall(
        sensitivities.make(run.options(), run.scene(), run.model(), run.simulation(), result.rows, result.report));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A breath on the cube of 24 cells.
struct Breath {
  const char *name, *options;
  double share = 1e-3; ///< by which parameters are moved
  bool cut = false;    ///< steps are cut
};

std::ostream &operator<<(std::ostream &out, const Breath &b)
{
  return out << b.name;
}

class Adjoint : public testing::TestWithParam<Breath> {
protected:
  static std::string base()
  {
    return "-dm_plex_filename " + source("meshes/cube_coarse.msh") +
           " -mesh_scale 1 -chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness 0.3 -ts_dt 0.1 "
           "-lumen_pressure -lumen_pressure_surfaces x1 -tissue yoshihara ";
  }
};

#define GAS "-airflow -airflow_permeability 1 -airflow_surfaces x1 "
#define PCV                                                                                                            \
  "-ventilator pcv -ventilator_pip 3 -ventilator_inspiration 0.4 -ventilator_expiration 0.4 -ventilator_ramp 0.1 "
#define VCV                                                                                                            \
  "-ventilator vcv -ventilator_tidal_volume 1e-5 -ventilator_inspiration 0.3 -ventilator_pause 0.2 "                   \
  "-ventilator_expiration 0.3 -ventilator_ramp_down 0.2 "

TEST_P(Adjoint, IsTheDerivativeOfTheRun)
{
  const std::string options = base() + GetParam().options;
  Swept swept;
  PULMO_OK(run_scene(options, true, swept));
  ASSERT_EQ(swept.report.failure, "");
  ASSERT_GE(swept.report.numbers.size(), 4u);
  ASSERT_GE(swept.report.parameters.size(), 3u);
  EXPECT_EQ(swept.rejected > 5, GetParam().cut);
  for (const SensitivityReport::Parameter &parameter : swept.report.parameters) {
    SCOPED_TRACE(parameter.option);
    const double share = GetParam().share;
    std::vector<double> change(swept.report.numbers.size(), 0);
    // differences of fourth order
    for (const auto &[by, weight] : {std::pair<double, double>{-2, 1}, {-1, -8}, {1, 8}, {2, -1}}) {
      Swept moved;
      std::ostringstream text;
      text.precision(17);
      text << options << " " << parameter.option << " " << parameter.value * (1 + by * share);
      PULMO_OK(run_scene(text.str(), false, moved));
      for (std::size_t k = 0; k < change.size(); ++k)
        change[k] += weight * functional(swept.report.numbers[k].name, moved.rows).value().value / (12 * share);
    }
    for (std::size_t k = 0; k < change.size(); ++k) {
      const SensitivityReport::Number &number = swept.report.numbers[k];
      double size = std::abs(number.value);
      if (number.name == "work") { // without airflow it is the small difference of what goes in and comes back
        double V = 0, P = 0;
        for (const SignalRow &r : swept.rows) {
          V = std::max(V, r.volume);
          P = std::max(P, r.machine_pressure());
        }
        size = P * V * units::kPa_per_cmH2O * 1e-3;
      }
      EXPECT_NEAR(parameter.derivative[k] * parameter.value, change[k],
                  1e-6 * std::abs(change[k]) + 1e-11 / share * size)
          << number.name;
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    Breaths, Adjoint,
    testing::Values(Breath{"pressure_control", GAS PCV},
                    Breath{"flow_by_area", GAS VCV "-ventilator_flow_split uniform"},
                    Breath{"common_pressure", GAS VCV "-ventilator_flow_split common_pressure"},
                    Breath{"tube", GAS PCV "-tube -tube_k1 4 -tube_k2 6e3 -ventilator_peep 1"},
                    Breath{"volume_control_through_a_tube", GAS VCV "-tube -tube_k1 4 -tube_k2 6e3"},
                    Breath{"pressure_control_without_airflow", "-airflow off " PCV},
                    Breath{"volume_control_without_airflow", "-airflow off " VCV "-ventilator_tidal_volume 3e-5"},
                    Breath{"two_breaths_with_peep", GAS VCV "-ventilator_peep 2 -ventilator_breaths 2"},
                    Breath{"bdf", GAS PCV "-ts_type bdf"}, Breath{"bdf_volume_control", GAS VCV "-ts_type bdf"},
                    Breath{"jump", GAS PCV "-ventilator_ramp 0 -ts_dt 0.05 -ventilator_pip 2"},
                    Breath{"cut_steps", GAS PCV "-airflow_permeability 10 -snes_max_it 5", 1e-5, true},
                    Breath{"cut_steps_of_bdf", GAS PCV "-airflow_permeability 10 -snes_max_it 5 -ts_type bdf", 1e-5,
                           true}),
    [](const auto &one) { return std::string(one.param.name); });

} // namespace
} // namespace pulmo::test
