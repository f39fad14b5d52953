// The backward sweep: derivatives of clinical numbers against differences of whole runs.
#include "unit/scenes.hpp"

#include "pulmo/adjoint/sensitivities.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/observers/clinical.hpp"

#include <algorithm>
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
  Recording recording;
  bool finished = false;

  PetscFunctionBeginUser;
  PetscCall(set_options("-options_file " + source("petsc_options/solvers/tight.opts") + " " + options +
                        (sweeps ? std::string(" -sweep_rtol 1e-13 -sensitivities ") + numbers : "")));
  PetscCall(run.declare());
  PetscCall(sensitivities.declare(run.options()));
  PetscCall(recording.declare(run.options(), sweeps));
  PetscCall(run.setup());
  PetscCall(sensitivities.check(run.options(), run.scene(), run.model(), run.simulation().step_control(), false));
  if (sweeps) PetscCall(recording.attach(run.simulation(), testing::TempDir()));
  PetscCall(run.simulation().run(finished));
  PetscCheck(finished, PETSC_COMM_SELF, PETSC_ERR_LIB, "%s", run.simulation().failure_text().c_str());
  result.rows = run.simulation().rows();
  for (SignalRow &row : result.rows) // as RegionAudit::complete() has it
    row.flow_resistance = run.scene().facts().airflow || run.scene().facts().tube;
  result.rejected = run.simulation().rejected_steps();
  if (sweeps)
    PetscCall(sensitivities.make(run.options(), run.scene(), run.model(), run.simulation(), recording, result.rows,
                                 nullptr, result.report));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A breath on the cube of 24 cells.
struct Breath {
  const char *name, *options;
  double share = 2e-4;  ///< by which parameters are moved
  bool cut = false;     ///< steps are cut
  bool forward = false; ///< Tangent knows it
  double equal = 1e-10; ///< to what share of what is summed up sweep and tangent agree
};

std::ostream &operator<<(std::ostream &out, const Breath &b)
{
  return out << b.name;
}

/// The forward sensitivity of a run to one parameter of its kernels: the linearised steps, one after the other. Pasts
/// come from matrices of the Jacobian with and without its rates, where the sweep has the derivative of the volume;
/// what is remembered follows along the change of the state, where the sweep goes point by point through all that a
/// kernel reads.
class Tangent {
public:
  Tangent(SceneRun &run, const Trajectory &trajectory, PetscInt constant, PetscReal change)
      : model_(run.model()), rows_(run.simulation().rows()), trajectory_(trajectory), constant_(constant),
        change_(change)
  {}

  /// Fills @p volume, @p pressure and @p flow with the derivatives of the rows: mm^3, kPa and mm^3/s for each unit.
  PetscErrorCode run(std::vector<PetscReal> &volume, std::vector<PetscReal> &pressure, std::vector<PetscReal> &flow);

private:
  using Values = PointMemory::Values;
  /// A derivative to the fourth order: where, and with which weight.
  static constexpr PetscReal four_points[][2] = {{-2, 1. / 12}, {-1, -2. / 3}, {1, 2. / 3}, {2, -1. / 12}};

  /// Fills @p change with that of what is remembered by the parameter alone.
  PetscErrorCode remembered_by_parameter(PetscReal t, Vec x, Vec x_t, bool start,
                                         const std::function<PetscErrorCode()> &set_step, Values &change)
  {
    Values moved, here;
    PetscFunctionBeginUser;
    PetscCall(set_step());
    PetscCall(model_.memory()->evaluate(t, x, x_t, start, here));
    model_.change_parameter({constant_}, change_);
    PetscCall(set_step());
    PetscCall(model_.memory()->evaluate(t, x, x_t, start, moved));
    model_.change_parameter({}, 0);
    PetscCall(set_step());
    change.resize(here.size());
    for (std::size_t i = 0; i < here.size(); ++i) change[i] = (moved[i] - here[i]) / change_;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// Shows what is remembered of the stage before, moved by @p by times its change.
  PetscErrorCode show_past(const StageRecord &r, PetscReal by)
  {
    Values last;
    PetscFunctionBeginUser;
    PetscCall(trajectory_.remembered(r.past[0], last));
    const Values &change = changes_[static_cast<std::size_t>(r.past[0])];
    for (std::size_t i = 0; i < last.size(); ++i) last[i] += by * change[i];
    model_.memory()->show(last, {});
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// A step along changes that is small, and not of rounding: @p size: of what moves; @p change: of its change.
  PetscErrorCode small_step(PetscReal size, PetscReal change, PetscReal &step) const
  {
    constexpr PetscReal share = 3e-4;
    PetscReal both[2] = {size, change};
    PetscFunctionBeginUser;
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, both, 2, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)model_.dm())));
    step = both[1] > 0 ? share * both[0] / both[1] : 1;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  static PetscReal largest(const Values &values)
  {
    PetscReal most = 0;
    for (const PetscScalar v : values) most = std::max(most, std::abs(v));
    return most;
  }

  PetscErrorCode residual(const StageRecord &r, Vec x, Vec x_t, PetscReal P, PetscReal Q, Vec F)
  {
    PetscFunctionBeginUser;
    PetscCall(model_.set_step(r.stage, P, Q));
    PetscCall(model_.residual(r.time, x, x_t, local_F_));
    PetscCall(VecZeroEntries(F));
    PetscCall(DMLocalToGlobal(model_.dm(), local_F_, ADD_VALUES, F));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  Model &model_;
  const std::vector<SignalRow> &rows_;
  const Trajectory &trajectory_;
  PetscInt constant_;
  PetscReal change_;
  VecHandle local_F_;
  std::vector<Values> changes_; ///< [stage]: of what is remembered; empty where nothing is
};

PetscErrorCode Tangent::run(std::vector<PetscReal> &volume, std::vector<PetscReal> &pressure_,
                            std::vector<PetscReal> &flow)
{
  const DM dm = model_.dm();
  const PetscReal L = model_.composition().mesh().length();
  const bool remembers = model_.composition().memory_acts();
  VecHandle x, x_t, before, moved, moved_t, direction, before_direction;  // local
  VecHandle now, last, by_parameter, by_scalar, by_past, F, right, other; // global
  MatHandle A, A0;
  std::vector<PetscReal> V(trajectory_.stages().size(), 0), P = V;

  PetscFunctionBeginUser;
  for (VecHandle *v : {&x, &x_t, &before, &moved, &moved_t, &direction, &before_direction, &local_F_})
    PetscCall(DMCreateLocalVector(dm, v->out()));
  for (VecHandle *v : {&now, &last, &by_parameter, &by_scalar, &by_past, &F, &right, &other})
    PetscCall(DMCreateGlobalVector(dm, v->out()));
  PetscCall(model_.create_matrix(A.out()));
  PetscCall(model_.create_matrix(A0.out()));
  volume.assign(rows_.size(), 0);
  pressure_ = flow = volume;
  changes_.assign(trajectory_.stages().size(), {});
  if (remembers)
    PetscCall(remembered_by_parameter(
        0, nullptr, nullptr, true, [&] { return model_.set_step(1, 0); }, changes_[0]));
  for (std::size_t n = 1; n < trajectory_.stages().size(); ++n) {
    const StageRecord &r = trajectory_.stages()[n];
    const Airway::Condition &airway = r.airway;
    const bool free = airway.mode == Airway::Mode::free, solved = airway.mode == Airway::Mode::solved;
    const PetscReal slope = r.stage.slope;
    PetscCall(trajectory_.state(static_cast<PetscInt>(n), x));
    PetscCall(trajectory_.state(r.past[0], before));
    PetscCall(VecWAXPY(x_t, -1, before, x));
    PetscCall(VecScale(x_t, slope));
    model_.set_load(r.load);
    if (remembers) {
      Values values;
      PetscReal step = 0;
      PetscCall(trajectory_.remembered(r.past[0], values));
      PetscCall(small_step(largest(values), largest(changes_[static_cast<std::size_t>(r.past[0])]), step));
      PetscCall(VecZeroEntries(by_past));
      for (const auto &[times, weight] : four_points) {
        PetscCall(show_past(r, times * step));
        PetscCall(residual(r, x, x_t, airway.pressure, airway.flow, F));
        PetscCall(VecAXPY(by_past, weight / step, F));
      }
      PetscCall(show_past(r, 0));
    }
    PetscCall(residual(r, x, x_t, airway.pressure, airway.flow, F));
    // by the parameter
    model_.change_parameter({constant_}, change_);
    PetscCall(residual(r, x, x_t, airway.pressure, airway.flow, by_parameter));
    model_.change_parameter({}, 0);
    PetscCall(VecAXPBY(by_parameter, -1 / change_, 1 / change_, F));
    // by the pressure of a held airway, or the flow prescribed on a free one
    const PetscReal step = free ? slope * L * L * L : model_.modulus() * (remembers ? 1e-4 : 1);
    PetscCall(VecZeroEntries(by_scalar));
    for (const auto &[times, weight] : four_points) {
      const PetscReal change = times * step;
      PetscCall(VecCopy(x, moved));
      PetscCall(VecCopy(x_t, moved_t));
      if (!free) {
        PetscCall(model_.airway().fill(moved, airway.pressure + change));
        PetscCall(VecZeroEntries(direction));
        PetscCall(model_.airway().fill(direction, change * slope));
        PetscCall(VecAXPY(moved_t, 1, direction));
      }
      PetscCall(
          residual(r, moved, moved_t, airway.pressure + (free ? 0 : change), airway.flow + (free ? change : 0), other));
      PetscCall(VecAXPY(by_scalar, weight / step, other));
    }
    PetscCall(model_.set_step(r.stage, airway.pressure, airway.flow));
    // rows and columns of the airway as they are
    model_.airway().hold(false);
    PetscCall(model_.jacobian(r.time, x, x_t, slope, A));
    PetscCall(model_.jacobian(r.time, x, x_t, 0, A0));
    model_.airway().hold(!free);
    PetscCall(MatMult(A, last, right)); // -(dR/dx_n-1) x'_n-1 = (A - A0) x'_n-1
    PetscCall(MatMult(A0, last, other));
    PetscCall(VecAXPY(right, -1, other));
    PetscCall(VecAXPY(right, -1, by_parameter));
    PetscCall(VecAXPY(right, -1, by_past));
    // what is prescribed changes with the volume or pressure at the start of the phase
    const auto start = static_cast<std::size_t>(r.phase_start);
    const PetscReal target = airway.by_start * (airway.control == Control::flow ? V[start] : P[start]);
    PetscReal scalar = 0, V_fixed = 0, V_border = 0;
    KSP ksp;
    PC pc;
    const auto solve = [&](Vec b, Vec y) -> PetscErrorCode {
      PetscFunctionBeginUser;
      if (!free) PetscCall(model_.airway().set(b, 0));
      PetscCall(KSPSolve(ksp, b, y));
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    const auto volume_of = [&](Vec y, PetscReal &value) -> PetscErrorCode {
      PetscFunctionBeginUser;
      PetscCall(VecZeroEntries(direction));
      PetscCall(DMGlobalToLocal(dm, y, INSERT_VALUES, direction));
      PetscCall(model_.volume_derivative(x, direction, value));
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    MatHandle closed;
    PetscCall(MatDuplicate(A, MAT_COPY_VALUES, closed.out()));
    PetscCall(model_.airway().close_rows(closed, false));
    PetscCall(KSPCreate(PetscObjectComm((PetscObject)dm), &ksp));
    PetscCall(KSPSetType(ksp, KSPPREONLY));
    PetscCall(KSPGetPC(ksp, &pc));
    PetscCall(PCSetType(pc, PCLU));
    PetscCall(PCFactorSetMatSolverType(pc, MATSOLVERMUMPS));
    PetscCall(KSPSetOperators(ksp, closed, closed));
    VecHandle kept, border, of_scalar;
    PetscCall(VecDuplicate(right, kept.out()));
    PetscCall(VecDuplicate(right, border.out()));
    PetscCall(VecDuplicate(right, of_scalar.out()));
    PetscCall(VecCopy(right, kept));
    PetscCall(VecCopy(by_scalar, of_scalar));
    PetscCall(VecScale(of_scalar, -1));
    PetscCall(solve(kept, now));
    PetscCall(solve(of_scalar, border));
    PetscCall(volume_of(now, V_fixed));
    PetscCall(volume_of(border, V_border));
    if (free)
      scalar = slope * target - slope * V[static_cast<std::size_t>(r.past[0])];
    else
      scalar = solved ? (target - V_fixed) / V_border : target;
    PetscCall(VecAXPY(now, scalar, border));
    V[n] = V_fixed + scalar * V_border;
    // the rows of a held airway: the flux
    PetscReal flux = scalar;
    if (!free) {
      PetscCall(MatMult(A, now, other));
      PetscCall(VecAXPY(other, -1, right));
      PetscCall(VecAXPY(other, scalar, by_scalar));
      PetscCall(VecZeroEntries(direction));
      PetscCall(VecZeroEntries(F));
      PetscCall(model_.airway().set(F, 1));
      PetscCall(VecDot(F, other, &flux));
      flux /= model_.row_scale(pressure);
      PetscCall(model_.airway().set(now, scalar));
      P[n] = scalar;
    } else {
      PetscCall(VecZeroEntries(direction));
      PetscCall(DMGlobalToLocal(dm, now, INSERT_VALUES, direction));
      PetscCall(model_.airway().mean_pressure(direction, P[n]));
    }
    if (remembers) {
      Values &change = changes_[n], moved_values;
      PetscReal size, changed, small = 0;
      const auto with = [&](PetscReal by, Values &values) -> PetscErrorCode {
        PetscFunctionBeginUser;
        PetscCall(show_past(r, by));
        PetscCall(VecWAXPY(moved, by, direction, x));
        PetscCall(VecWAXPY(moved_t, -1, before_direction, direction));
        PetscCall(VecAYPX(moved_t, by * slope, x_t));
        PetscCall(model_.memory()->evaluate(r.time, moved, moved_t, false, values));
        PetscFunctionReturn(PETSC_SUCCESS);
      };
      PetscCall(VecZeroEntries(direction));
      PetscCall(DMGlobalToLocal(dm, now, INSERT_VALUES, direction));
      if (!free) PetscCall(model_.airway().fill(direction, scalar));
      PetscCall(VecNorm(x, NORM_INFINITY, &size));
      PetscCall(VecNorm(direction, NORM_INFINITY, &changed));
      PetscCall(small_step(size, changed, small));
      PetscCall(show_past(r, 0));
      PetscCall(remembered_by_parameter(
          r.time, x, x_t, false, [&] { return model_.set_step(r.stage, airway.pressure, airway.flow); }, change));
      for (const auto &[times, weight] : four_points) {
        PetscCall(with(times * small, moved_values));
        for (std::size_t i = 0; i < change.size(); ++i) change[i] += weight / small * moved_values[i];
      }
      PetscCall(VecCopy(direction, before_direction));
    }
    PetscCall(VecCopy(now, last));
    PetscCall(KSPDestroy(&ksp));
    const auto row = static_cast<std::size_t>(r.row);
    volume[row] = V[n];
    pressure_[row] = P[n];
    flow[row] = flux;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
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
  "-ventilator pcv -ventilator_pip 1.5 -ventilator_inspiration 0.4 -ventilator_expiration 0.4 -ventilator_ramp 0.1 "
#define VCV                                                                                                            \
  "-ventilator vcv -ventilator_tidal_volume 1e-5 -ventilator_inspiration 0.3 -ventilator_pause 0.2 "                   \
  "-ventilator_expiration 0.3 -ventilator_ramp_down 0.2 "

#define VISCOELASTIC "-viscoelastic -viscoelastic_moduli 0.3,0.2 -viscoelastic_times 0.1,0.7 "
#define RECRUITMENT                                                                                                    \
  "-recruitment -recruitment_opening_pressure 0.4 -recruitment_closing_pressure 0.2 -recruitment_gain 0.2 "            \
  "-recruitment_start 0.3 "
/// At all times, so that nothing has a kink.
#define OPENING                                                                                                        \
  RECRUITMENT "-recruitment_opening_pressure -1 -recruitment_closing_pressure -2 -recruitment_opening_rate 0.2 "
#define SURFACTANT "-surfactant -surfactant_gamma_eq 5 -surfactant_area 10 "

TEST_P(Adjoint, IsTheDerivativeOfTheRun)
{
  const std::string options = base() + GetParam().options;
  Swept swept;
  PULMO_OK(run_scene(options, true, swept));
  ASSERT_EQ(swept.report.failure, "");
  ASSERT_GE(swept.report.numbers.size(), 4u);
  ASSERT_GE(swept.report.parameters.size(), 3u);
  EXPECT_EQ(swept.rejected > 0, GetParam().cut);
  for (const SensitivityReport::Parameter &parameter : swept.report.parameters) {
    SCOPED_TRACE(parameter.option);
    const double share = GetParam().share;
    std::vector<double> change(swept.report.numbers.size(), 0);
    for (const double by : {-1, 1}) {
      Swept moved;
      std::ostringstream text;
      text.precision(17);
      text << options << " " << parameter.option << " " << parameter.value * (1 + by * share);
      PULMO_OK(run_scene(text.str(), false, moved));
      for (std::size_t k = 0; k < change.size(); ++k)
        change[k] += by * functional(swept.report.numbers[k].name, moved.rows).value().value / (2 * share);
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

class AdjointIdentity : public Adjoint {};

TEST_P(AdjointIdentity, SweepAndTangentAgree)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  Trajectory trajectory(std::size_t(1) << 30, testing::TempDir());
  bool finished = false;
  std::string failure;
  PULMO_OK(
      set_options("-options_file " + source("petsc_options/solvers/tight.opts") + " " + base() + GetParam().options));
  PULMO_OK(run.declare());
  PULMO_OK(run.setup());
  run.simulation().record(trajectory);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished);
  const auto &rows = run.simulation().rows();
  std::vector<Functional> list;
  for (const std::string &name : functional_names())
    if (const auto f = functional(name, rows)) list.push_back(*f);
  ASSERT_GE(list.size(), 6u);
  Model &model = run.model();
  int found = 0;
  for (const Options::RealOption &option : run.options().real_options()) {
    const char *owner;
    const PetscInt constant = model.composition().constant_at(option.target, &owner);
    if (constant < 0 || *option.target == 0) continue;
    SCOPED_TRACE(option.option);
    ++found;
    const PetscReal change = 1e-3 * std::abs(*option.target); // the same quotient on both sides, however good
    std::vector<PetscReal> swept(list.size(), 0), volume, pressure, flow;
    Sweep sweep(run.scene(), model, run.simulation(), trajectory);
    std::vector<std::vector<PetscReal>> at, moved;
    const auto move = [&](const auto &residual) -> PetscErrorCode {
      PetscFunctionBeginUser;
      PetscCall(residual(at));
      model.change_parameter({constant}, change);
      PetscCall(residual(moved));
      model.change_parameter({}, 0);
      for (std::size_t k = 0; k < list.size(); ++k)
        for (std::size_t c = 0; c < at[k].size(); ++c) swept[k] += (moved[k][c] - at[k][c]) / change;
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    const auto visit = [&](const Sweep::Solved &stage) {
      return move([&](auto &sums) { return sweep.weighted_residual(stage, false, sums); });
    };
    PULMO_OK(sweep.run(list, 1e-14, visit, failure));
    ASSERT_EQ(failure, "");
    if (sweep.wants_start()) {
      PULMO_OK(move([&](auto &sums) { return sweep.weighted_start(false, sums); }));
    }
    PULMO_OK(MPI_Allreduce(MPI_IN_PLACE, swept.data(), static_cast<int>(swept.size()), MPIU_REAL, MPI_SUM,
                           PETSC_COMM_WORLD));
    Tangent tangent(run, trajectory, constant, change);
    PULMO_OK(tangent.run(volume, pressure, flow));
    for (std::size_t k = 0; k < list.size(); ++k) {
      double forward = 0, size = 0;
      for (std::size_t i = 0; i < rows.size(); ++i)
        for (const double part : {list[k].by_volume[i] * volume[i] / units::mm3_per_ml,
                                  list[k].by_pressure[i] * pressure[i] / units::kPa_per_cmH2O,
                                  list[k].by_flow[i] * flow[i] / units::mm3_per_ml}) {
          forward += part;
          size += std::abs(part);
        }
      EXPECT_NEAR(swept[k], forward, GetParam().equal * (size + 0.01 * std::abs(list[k].value / *option.target)))
          << list[k].name;
    }
  }
  EXPECT_GE(found, 4);
}

/// On several ranks one of them has no room.
TEST(StatesInAFile, ThatCannotBeWrittenEndNoRun)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  Sensitivities sensitivities;
  Recording recording;
  SensitivityReport report;
  bool finished = false;
  PetscMPIInt rank, size;
  PULMO_OK(MPI_Comm_rank(PETSC_COMM_WORLD, &rank));
  PULMO_OK(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  PULMO_OK(set_options("-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
                       source("meshes/cube_coarse.msh") +
                       " -mesh_scale 1 -chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness 0.3 -ts_dt 0.1 "
                       "-tissue yoshihara " GAS PCV "-sensitivities V_T -sweep_memory 0"));
  PULMO_OK(run.declare());
  PULMO_OK(sensitivities.declare(run.options()));
  PULMO_OK(recording.declare(run.options(), true));
  PULMO_OK(run.setup());
  PULMO_OK(recording.attach(run.simulation(), rank == size - 1 ? "/none/of/these" : testing::TempDir()));
  PULMO_OK(run.simulation().run(finished));
  EXPECT_TRUE(finished);
  PULMO_OK(sensitivities.make(run.options(), run.scene(), run.model(), run.simulation(), recording,
                              run.simulation().rows(), nullptr, report));
  EXPECT_NE(report.failure.find("did not fit into /none/of/these"), std::string::npos) << report.failure;
  EXPECT_NE(report.failure.find("-sweep_memory"), std::string::npos) << report.failure;
  EXPECT_TRUE(report.numbers.empty());
}

std::vector<Breath> breaths(bool forward)
{
  constexpr double by_differences = 5e-9; // rounding in the quotients at the points
  std::vector<Breath> list = {
      Breath{"pressure_control", GAS PCV, 2e-4, false, true},
      Breath{"flow_by_area", GAS VCV "-ventilator_flow_split uniform", 2e-4, false, true},
      Breath{"common_pressure", GAS VCV "-ventilator_flow_split common_pressure", 2e-4, false, true},
      Breath{"tube", GAS PCV "-tube -tube_k1 4 -tube_k2 6e3 -ventilator_peep 1"},
      Breath{"volume_control_through_a_tube", GAS VCV "-tube -tube_k1 4 -tube_k2 6e3"},
      Breath{"pressure_control_without_airflow", "-airflow off " PCV},
      Breath{"volume_control_without_airflow", "-airflow off " VCV "-ventilator_tidal_volume 3e-5"},
      Breath{"two_breaths_with_peep", GAS VCV "-ventilator_peep 2 -ventilator_breaths 2", 2e-4, false, true},
      Breath{"bdf", GAS PCV "-ts_type bdf"},
      Breath{"bdf_volume_control", GAS VCV "-ts_type bdf"},
      Breath{"jump", GAS PCV "-ventilator_ramp 0 -ts_dt 0.05"},
      Breath{"cut_steps", GAS PCV "-airflow_permeability 10 -ventilator_pip 3 -snes_max_it 5", 1e-5, true, true},
      Breath{"cut_steps_of_bdf", GAS PCV "-airflow_permeability 10 -ventilator_pip 3 -snes_max_it 5 -ts_type bdf", 1e-5,
             true},
      Breath{"viscoelastic", GAS PCV VISCOELASTIC, 2e-4, false, true},
      Breath{"viscoelastic_bdf_volume_control", GAS VCV VISCOELASTIC "-ts_type bdf"},
      Breath{"viscoelastic_without_airflow", "-airflow off " VCV VISCOELASTIC},
      Breath{"recruitment", GAS PCV RECRUITMENT},
      Breath{"recruitment_bdf", GAS PCV RECRUITMENT "-ts_type bdf", 1e-5},
      Breath{"recruitment_common_pressure", GAS VCV RECRUITMENT "-ventilator_flow_split common_pressure", 1e-5},
      Breath{"opening", GAS PCV OPENING, 2e-4, false, true, by_differences},
      Breath{"relaxing_and_opening",
             GAS VCV VISCOELASTIC OPENING "-recruitment_permeability 0.3 -ventilator_flow_split common_pressure "
                                          "-ventilator_tidal_volume 3e-5 -recruitment_gain 0.05",
             2e-4, false, true, by_differences},
      Breath{"recruitment_without_airflow", "-airflow off " PCV RECRUITMENT, 1e-5},
      Breath{"surfactant", GAS PCV SURFACTANT},
      Breath{"surfactant_bdf", GAS PCV SURFACTANT "-ts_type bdf"},
      Breath{"inertia_bdf", GAS PCV "-inertia -inertia_air_density 30 -ts_type bdf"},
      Breath{"relaxing_recruited", GAS VCV VISCOELASTIC RECRUITMENT "-recruitment_permeability 0.3 -ts_type bdf",
             1e-5}};
  if (forward)
    list.erase(std::remove_if(list.begin(), list.end(), [](const Breath &b) { return !b.forward; }), list.end());
  return list;
}

std::string name_of(const testing::TestParamInfo<Breath> &one)
{
  return one.param.name;
}

INSTANTIATE_TEST_SUITE_P(Breaths, Adjoint, testing::ValuesIn(breaths(false)), name_of);
INSTANTIATE_TEST_SUITE_P(Breaths, AdjointIdentity, testing::ValuesIn(breaths(true)), name_of);

} // namespace
} // namespace pulmo::test
