// The backward sweep: derivatives of clinical numbers against differences of whole runs.
#include "unit/scenes.hpp"

#include "pulmo/adjoint/sensitivities.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/fem/scalar_unknowns.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/observers/clinical.hpp"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <numeric>

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
/// come from matrices of the Jacobian with and without its rates, where the sweep has the derivative of the volume; the
/// equations of scalars are differences, where it has what an effect says of them; what is remembered follows along the
/// change of the state, where the sweep goes point by point through all that a kernel reads.
class Tangent {
public:
  Tangent(SceneRun &run, const Trajectory &trajectory, PetscInt constant, PetscReal change)
      : model_(run.model()), rows_(run.simulation().rows()), trajectory_(trajectory), constant_(constant),
        change_(change), tube_(run.scene().facts().tube)
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

  /// The change of a stage: of its state (local), its volume, its scalars and the pressure at the ventilator.
  struct Change {
    VecHandle state;
    PetscReal volume = 0, ventilator = 0;
    std::vector<PetscReal> scalars;
  };
  /// Adds minus what the states before move in the equations, while the airway is free. Kernels see the rate at the
  /// state of the stage; of multistep rates, which act by the gas alone here, the scheme knows that at the state
  /// before.
  PetscErrorCode add_past(const StageRecord &r, Vec right)
  {
    PetscFunctionBeginUser;
    for (int i = 0; i < 2; ++i) {
      if (r.past[i] < 0) continue;
      const PetscReal weight = r.weight[i] / r.stage.slope;
      Mat with = A_, without = A0_;
      if (r.stage.multistep) {
        PetscCall(trajectory_.state(r.past[i], past_));
        PetscCall(model_.jacobian(r.time, past_, zero_, r.stage.slope, B_));
        PetscCall(model_.jacobian(r.time, past_, zero_, 0, B0_));
        with = B_;
        without = B0_;
      }
      PetscCall(VecZeroEntries(last_));
      PetscCall(DMLocalToGlobal(model_.dm(), of_[static_cast<std::size_t>(r.past[i])].state, INSERT_VALUES, last_));
      PetscCall(MatMult(with, last_, other_));
      PetscCall(VecAXPY(right, -weight, other_));
      PetscCall(MatMult(without, last_, other_));
      PetscCall(VecAXPY(right, weight, other_));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  std::vector<PetscReal> values(const StageRecord &r) const
  {
    return r.airway.scalars.empty() ? std::vector<PetscReal>{r.airway.pressure} : r.airway.scalars;
  }
  /// By scalar @p scalar of a held airway, or by the flow prescribed on a free one.
  PetscErrorCode by_scalar(const StageRecord &r, std::size_t scalar, Vec column)
  {
    const bool free = r.airway.mode == Airway::Mode::free;
    const PetscReal L = model_.composition().mesh().length(), slope = r.stage.slope,
                    step =
                        free ? slope * L * L * L : model_.modulus() * (model_.composition().memory_acts() ? 1e-4 : 1);
    PetscFunctionBeginUser;
    PetscCall(VecZeroEntries(column));
    for (const auto &[times, weight] : four_points) {
      const PetscReal change = times * step, held = free || scalar > 0 ? 0 : change;
      PetscCall(VecCopy(x_, moved_));
      PetscCall(VecCopy(x_t_, moved_t_));
      if (!free) {
        std::vector<PetscReal> now = values(r), rates(now.size(), 0);
        now[scalar] += change;
        rates[scalar] = change * slope;
        PetscCall(model_.airway().fill(moved_, now));
        PetscCall(VecZeroEntries(past_));
        PetscCall(model_.airway().fill(past_, rates));
        PetscCall(VecAXPY(moved_t_, 1, past_));
      }
      PetscCall(residual(r, moved_, moved_t_, r.airway.pressure + held, r.airway.flow + (free ? change : 0), other_));
      PetscCall(VecAXPY(column, weight / step, other_));
    }
    PetscCall(model_.set_step(r.stage, r.airway.pressure, r.airway.flow));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// Rate by the time scheme of what @p of says of the change of a stage; @p now: of the stage at hand.
  template <class Of>
  PetscReal rate(const StageRecord &r, PetscReal now, Of &&of) const
  {
    PetscReal sum = r.stage.slope * now;
    for (int i = 0; i < 2; ++i)
      if (r.past[i] >= 0) sum += r.weight[i] * of(of_[static_cast<std::size_t>(r.past[i])]);
    return sum;
  }
  PetscReal stored(const std::vector<PetscReal> &scalars) const
  {
    PetscReal sum = 0;
    for (const ScalarGroup &group : model_.composition().scalar_groups())
      for (std::size_t j = 0; j < group.scalars.size(); ++j)
        sum += group.scalars[j].storage * scalars[1 + group.offset + j];
    return sum;
  }
  /// Flow of gas through the opening in a stage, mm^3/s, and its change with @p now's.
  PetscReal opening_flow(const StageRecord &r, std::size_t n) const
  {
    const auto gas_of = [&](std::size_t stage) {
      const StageRecord &one = trajectory_.stages()[stage];
      return volumes_[stage] + (one.airway.scalars.empty() ? 0 : stored(one.airway.scalars));
    };
    PetscReal sum = r.stage.slope * gas_of(n);
    for (int i = 0; i < 2; ++i)
      if (r.past[i] >= 0) sum += r.weight[i] * gas_of(static_cast<std::size_t>(r.past[i]));
    return sum;
  }
  PetscReal opening_flow_change(const StageRecord &r, const Change &now) const
  {
    return rate(r, now.volume + stored(now.scalars), [&](const Change &c) { return c.volume + stored(c.scalars); });
  }
  /// What is left of the linearised equations of the scalars with the changes @p now and @p flows into the lung; the
  /// target is to change by @p target. Those of effects by differences.
  std::vector<PetscReal> scalar_equations(const StageRecord &r, std::size_t n, const Change &now,
                                          const std::vector<PetscReal> &flows, PetscReal target) const
  {
    std::vector<PetscReal> left(now.scalars.size(), 0);
    if (r.airway.control == Control::flow)
      left[0] = now.volume + stored(now.scalars) - target;
    else
      left[0] = now.scalars[0] - target + (tube_ ? tube_->slope(opening_flow(r, n)) * opening_flow_change(r, now) : 0);
    for (const ScalarGroup &group : model_.composition().scalar_groups()) {
      ScalarState s, change;
      s.opening = r.airway.scalars[0];
      change.opening = now.scalars[0];
      for (std::size_t j = 0; j < group.scalars.size(); ++j) {
        const std::size_t at = 1 + group.offset + j;
        PetscReal recorded = r.stage.slope * r.airway.scalars[at];
        for (int i = 0; i < 2; ++i)
          if (r.past[i] >= 0)
            recorded += r.weight[i] * trajectory_.stages()[static_cast<std::size_t>(r.past[i])].airway.scalars[at];
        s.value.push_back(r.airway.scalars[at]);
        s.rate.push_back(recorded);
        s.flow.push_back(r.airway.flows[at]);
        change.value.push_back(now.scalars[at]);
        change.rate.push_back(rate(r, now.scalars[at], [&](const Change &c) { return c.scalars[at]; }));
        change.flow.push_back(flows[at]);
      }
      const auto add = [&](PetscReal &input, PetscReal by) {
        const PetscReal here = input, move = 1e-3 * (input != 0 ? std::abs(input) : 1);
        for (const auto &[times, weight] : four_points) {
          ScalarRows rows(group.scalars.size());
          input = here + times * move;
          group.equations(s, rows);
          for (std::size_t j = 0; j < rows.size(); ++j)
            left[1 + group.offset + j] += by * weight / move * rows.value[j];
        }
        input = here;
      };
      add(s.opening, change.opening);
      for (std::size_t j = 0; j < group.scalars.size(); ++j) {
        add(s.value[j], change.value[j]);
        add(s.rate[j], change.rate[j]);
        add(s.flow[j], change.flow[j]);
      }
    }
    return left;
  }
  /// Adds the change of what is remembered in stage @p n with that of its state.
  PetscErrorCode remember(const StageRecord &r, std::size_t n)
  {
    Values &change = changes_[n], moved_values;
    const Vec direction = of_[n].state;
    PetscReal size, changed, small = 0;
    PetscFunctionBeginUser;
    const auto with = [&](PetscReal by, Values &values) -> PetscErrorCode {
      PetscFunctionBeginUser;
      PetscCall(show_past(r, by));
      PetscCall(VecWAXPY(moved_, by, direction, x_));
      PetscCall(VecWAXPY(moved_t_, -1, of_[static_cast<std::size_t>(r.past[0])].state, direction));
      PetscCall(VecAYPX(moved_t_, by * r.stage.slope, x_t_));
      PetscCall(model_.memory()->evaluate(r.time, moved_, moved_t_, false, values));
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    PetscCall(VecNorm(x_, NORM_INFINITY, &size));
    PetscCall(VecNorm(direction, NORM_INFINITY, &changed));
    PetscCall(small_step(size, changed, small));
    PetscCall(show_past(r, 0));
    PetscCall(remembered_by_parameter(
        r.time, x_, x_t_, false, [&] { return model_.set_step(r.stage, r.airway.pressure, r.airway.flow); }, change));
    for (const auto &[times, weight] : four_points) {
      PetscCall(with(times * small, moved_values));
      for (std::size_t i = 0; i < change.size(); ++i) change[i] += weight / small * moved_values[i];
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// Fills @p by_past with the change of the residual by what is remembered of the stage before.
  PetscErrorCode by_memory(const StageRecord &r, Vec by_past)
  {
    Values values;
    PetscReal step = 0;
    PetscFunctionBeginUser;
    PetscCall(trajectory_.remembered(r.past[0], values));
    PetscCall(small_step(largest(values), largest(changes_[static_cast<std::size_t>(r.past[0])]), step));
    for (const auto &[times, weight] : four_points) {
      PetscCall(show_past(r, times * step));
      PetscCall(residual(r, x_, x_t_, r.airway.pressure, r.airway.flow, other_));
      PetscCall(VecAXPY(by_past, weight / step, other_));
    }
    PetscCall(show_past(r, 0));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscErrorCode setup();
  PetscErrorCode step(std::size_t n, PetscReal &flow);

  Model &model_;
  const std::vector<SignalRow> &rows_;
  const Trajectory &trajectory_;
  PetscInt constant_;
  PetscReal change_;
  std::optional<AirwayResistance> tube_;
  VecHandle local_F_, x_, x_t_, past_, moved_, moved_t_, zero_; ///< local
  VecHandle last_, by_parameter_, by_past_, F_, right_, other_; ///< global
  MatHandle A_, A0_, B_, B0_, closed_;
  std::vector<Values> changes_;    ///< [stage]: of what is remembered; empty where nothing is
  std::vector<Change> of_;         ///< [stage]
  std::vector<PetscReal> volumes_; ///< [stage], mm^3
};

PetscErrorCode Tangent::setup()
{
  const DM dm = model_.dm();
  const std::size_t stages = trajectory_.stages().size();

  PetscFunctionBeginUser;
  for (VecHandle *v : {&local_F_, &x_, &x_t_, &past_, &moved_, &moved_t_, &zero_}) {
    PetscCall(DMCreateLocalVector(dm, v->out()));
    PetscCall(VecZeroEntries(*v));
  }
  for (VecHandle *v : {&last_, &by_parameter_, &by_past_, &F_, &right_, &other_})
    PetscCall(DMCreateGlobalVector(dm, v->out()));
  for (MatHandle *matrix : {&A_, &A0_, &B_, &B0_}) PetscCall(model_.create_matrix(matrix->out()));
  changes_.assign(stages, {});
  of_.resize(stages);
  for (std::size_t n = 0; n < stages; ++n) {
    Measures measures;
    PetscCall(VecDuplicate(zero_, of_[n].state.out()));
    PetscCall(VecZeroEntries(of_[n].state));
    of_[n].scalars.assign(1 + model_.composition().n_scalars(), 0);
    PetscCall(trajectory_.state(static_cast<PetscInt>(n), x_));
    PetscCall(model_.measure(x_, measures));
    volumes_.push_back(measures.volume_change);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Solves for the change of stage @p n.
PetscErrorCode Tangent::step(std::size_t n, PetscReal &flow)
{
  const StageRecord &r = trajectory_.stages()[n];
  const Airway::Condition &airway = r.airway;
  const bool free = airway.mode == Airway::Mode::free, solved = airway.mode == Airway::Mode::solved;
  const std::size_t scalars = 1 + model_.composition().n_scalars();
  const PetscReal slope = r.stage.slope;
  const std::vector<std::size_t> acting = scalars > 1 ? model_.airway().acting() : std::vector<std::size_t>{0};
  KSP ksp;
  PC pc;

  PetscFunctionBeginUser;
  PetscCall(trajectory_.state(static_cast<PetscInt>(n), x_));
  PetscCall(VecAXPBY(x_t_, slope, 0, x_));
  for (int i = 0; i < 2; ++i) {
    if (r.past[i] < 0) continue;
    PetscCall(trajectory_.state(r.past[i], past_));
    PetscCall(VecAXPY(x_t_, r.weight[i], past_));
  }
  model_.set_load(r.load);
  PetscCall(VecZeroEntries(by_past_));
  if (model_.composition().memory_acts()) PetscCall(by_memory(r, by_past_));
  PetscCall(residual(r, x_, x_t_, airway.pressure, airway.flow, F_));
  model_.change_parameter({constant_}, change_);
  PetscCall(residual(r, x_, x_t_, airway.pressure, airway.flow, by_parameter_));
  model_.change_parameter({}, 0);
  PetscCall(VecAXPBY(by_parameter_, -1 / change_, 1 / change_, F_));
  std::vector<VecHandle> column(acting.size()), response(acting.size());
  for (std::size_t a = 0; a < acting.size(); ++a) {
    PetscCall(VecDuplicate(right_, column[a].out()));
    PetscCall(VecDuplicate(right_, response[a].out()));
    PetscCall(by_scalar(r, acting[a], column[a]));
  }
  // rows and columns of the airway as they are
  PetscCall(model_.set_step(r.stage, airway.pressure, airway.flow));
  model_.airway().hold(false);
  PetscCall(model_.jacobian(r.time, x_, x_t_, slope, A_));
  PetscCall(model_.jacobian(r.time, x_, x_t_, 0, A0_));
  PetscCall(VecZeroEntries(right_));
  PetscCall(add_past(r, right_));
  model_.airway().hold(!free);
  PetscCall(VecAXPY(right_, -1, by_parameter_));
  PetscCall(VecAXPY(right_, -1, by_past_));
  PetscCall(MatDuplicate(A_, MAT_COPY_VALUES, closed_.out()));
  PetscCall(model_.airway().close_rows(closed_, false));
  PetscCall(KSPCreate(PetscObjectComm((PetscObject)model_.dm()), &ksp));
  PetscCall(KSPSetType(ksp, KSPPREONLY));
  PetscCall(KSPGetPC(ksp, &pc));
  PetscCall(PCSetType(pc, PCLU));
  PetscCall(PCFactorSetMatSolverType(pc, MATSOLVERMUMPS));
  PetscCall(KSPSetOperators(ksp, closed_, closed_));
  const auto solve = [&](Vec b, PetscReal factor, Vec y) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(VecAXPBY(other_, factor, 0, b));
    if (!free) PetscCall(model_.airway().set(other_, 0));
    PetscCall(KSPSolve(ksp, other_, y));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  // the change of the fields with those of the scalars, and what goes with it; @p fixed: 1 with what is given
  const auto change_with = [&](PetscReal fixed, const std::vector<PetscReal> &by, Change &now,
                               std::vector<PetscReal> &flows) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(VecAXPBY(F_, fixed, 0, last_));
    for (std::size_t a = 0; a < acting.size(); ++a) PetscCall(VecAXPY(F_, by[acting[a]], response[a]));
    PetscCall(MatMult(A_, F_, other_));
    PetscCall(VecAXPY(other_, -fixed, right_));
    for (std::size_t a = 0; a < acting.size(); ++a) PetscCall(VecAXPY(other_, by[acting[a]], column[a]));
    PetscCall(VecZeroEntries(local_F_)); // each row once, by its owner
    PetscCall(DMGlobalToLocal(model_.dm(), F_, INSERT_VALUES, local_F_));
    PetscCall(VecCopy(local_F_, now.state));
    if (!free) PetscCall(model_.airway().fill(now.state, by));
    PetscCall(model_.volume_derivative(x_, now.state, now.volume));
    now.scalars = by;
    flows.assign(scalars, 0);
    for (std::size_t j = 0; j < scalars && !free; ++j) { // the rows of a held airway
      std::vector<PetscReal> unit(scalars, 0);
      unit[j] = 1 / model_.row_scale(pressure);
      PetscCall(VecZeroEntries(F_));
      PetscCall(model_.airway().fill_global(F_, unit));
      PetscCall(VecDot(F_, other_, &flows[j]));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(solve(right_, 1, last_));
  for (std::size_t a = 0; a < acting.size(); ++a) PetscCall(solve(column[a], -1, response[a]));
  // what is prescribed changes with the volume or pressure at the start of the phase
  const Change &start = of_[static_cast<std::size_t>(r.phase_start)];
  const PetscReal target =
      airway.by_start * (airway.control == Control::flow ? start.volume + stored(start.scalars) : start.ventilator);
  std::vector<PetscReal> by(scalars, 0), flows;
  if (free) {
    by[0] = rate(r, target, [&](const Change &c) { return c.volume; });
  } else if (!solved) {
    by[0] = target;
  } else {
    std::vector<PetscReal> system(scalars * scalars);
    const StageRecord &again = r;
    Change trial;
    PetscCall(VecDuplicate(x_, trial.state.out()));
    const auto left = [&](PetscReal fixed, const std::vector<PetscReal> &scalars_by,
                          std::vector<PetscReal> &result) -> PetscErrorCode {
      PetscFunctionBeginUser;
      PetscCall(change_with(fixed, scalars_by, trial, flows));
      result = scalar_equations(again, n, trial, flows, target);
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    std::vector<PetscReal> base, one;
    PetscCall(left(1, by, base));
    for (std::size_t j = 0; j < scalars; ++j) {
      std::vector<PetscReal> unit(scalars, 0);
      unit[j] = 1;
      PetscCall(left(1, unit, one));
      for (std::size_t i = 0; i < scalars; ++i) system[i * scalars + j] = one[i] - base[i];
    }
    for (std::size_t i = 0; i < scalars; ++i) by[i] = -base[i];
    solve_dense(system, by);
  }
  PetscCall(change_with(1, by, of_[n], flows));
  PetscCall(KSPDestroy(&ksp));
  flow = by[0];
  if (free)
    PetscCall(model_.airway().mean_pressure(of_[n].state, of_[n].ventilator));
  else {
    const PetscReal beside = rate(r, stored(by), [&](const Change &c) { return stored(c.scalars); });
    flow = std::accumulate(flows.begin(), flows.end(), PetscReal(0));
    of_[n].ventilator = by[0] + (tube_ ? tube_->slope(opening_flow(r, n)) * (flow + beside) : 0);
  }
  if (model_.composition().memory_acts()) PetscCall(remember(r, n));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Tangent::run(std::vector<PetscReal> &volume, std::vector<PetscReal> &pressure_,
                            std::vector<PetscReal> &flow)
{
  PetscFunctionBeginUser;
  PetscCall(setup());
  volume.assign(rows_.size(), 0);
  pressure_ = flow = volume;
  if (model_.composition().memory_acts())
    PetscCall(remembered_by_parameter(
        0, nullptr, nullptr, true, [&] { return model_.set_step(1, 0); }, changes_[0]));
  for (std::size_t n = 1; n < trajectory_.stages().size(); ++n) {
    const PetscInt number = trajectory_.stages()[n].row;
    PetscReal of_stage;
    PetscCall(step(n, of_stage));
    if (number < 0) continue; // half a step
    const auto row = static_cast<std::size_t>(number);
    volume[row] = of_[n].volume;
    pressure_[row] = of_[n].ventilator;
    flow[row] = of_stage;
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
  /// All options of @p breath, with files in place of the words that stand for them. Collective.
  static PetscErrorCode options_of(const Breath &breath, std::string &options)
  {
    const std::pair<std::string, std::string> files[] = {
        {"TABLE", "name,parent,length_mm,diameter_mm,resistance_cmH2O_s_per_l,compliance_ml_per_cmH2O,surface\n"
                  "trunk,,1,0.05,,1e-7,\nright,trunk,0.5,0.03,,2e-7,y0\nleft,trunk,,,2e7,,y1\n"},
        {"LIMITED", "inspiration 0.5 flow 3e-5 ramp 0.1 limit 3\nexpiration 0.4 pressure 0.5 ramp 0.2\n"}};
    PetscMPIInt rank;
    PetscFunctionBeginUser;
    PetscCallMPI(MPI_Comm_rank(PETSC_COMM_WORLD, &rank));
    options = base() + breath.options;
    for (const auto &[word, text] : files) {
      const std::string file = testing::TempDir() + "adjoint_" + breath.name + "_" + word;
      const std::size_t at = options.find(word);
      if (at == std::string::npos) continue;
      options.replace(at, word.size(), file);
      if (rank == 0) std::ofstream(file) << text;
    }
    PetscCallMPI(MPI_Barrier(PETSC_COMM_WORLD));
    PetscFunctionReturn(PETSC_SUCCESS);
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

/// A trunk and two branches to opposite faces of the cube: one with sizes, one with a resistance; walls that store gas.
#define TREE                                                                                                           \
  "-airflow -airflow_permeability 1 -airflow_surfaces y0,y1 -lumen_pressure_surfaces y0,y1 -airway_tree TABLE "        \
  "-airway_tree_density 3e7 "
#define TUBE "-tube -tube_k1 1e7 -tube_k2 1e14 "

TEST_P(Adjoint, IsTheDerivativeOfTheRun)
{
  std::string options;
  PULMO_OK(options_of(GetParam(), options));
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
  std::string failure, options;
  PULMO_OK(options_of(GetParam(), options));
  PULMO_OK(set_options("-options_file " + source("petsc_options/solvers/tight.opts") + " " + options));
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
    // the same quotient on both sides, however good: so large that rounding of the residual does not count
    const PetscReal change = 1e-2 * std::abs(*option.target);
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
      Breath{"tube", GAS PCV TUBE "-ventilator_peep 1", 2e-4, false, true},
      Breath{"volume_control_through_a_tube", GAS VCV TUBE "-ts_type bdf", 2e-4, false, true},
      Breath{"pressure_control_without_airflow", "-airflow off " PCV},
      Breath{"volume_control_without_airflow", "-airflow off " VCV "-ventilator_tidal_volume 3e-5"},
      Breath{"two_breaths_with_peep", GAS VCV "-ventilator_peep 2 -ventilator_breaths 2", 2e-4, false, true},
      Breath{"bdf", GAS PCV "-ts_type bdf", 2e-4, false, true},
      Breath{"bdf_volume_control", GAS VCV "-ts_type bdf", 2e-4, false, true},
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
      Breath{"tree", TREE PCV, 2e-4, false, true},
      Breath{"tree_volume_control", TREE VCV, 2e-4, false, true},
      Breath{"tree_bdf", TREE PCV "-ts_type bdf", 2e-4, false, true},
      Breath{"tree_bdf_volume_control_through_a_tube", TREE VCV TUBE "-ts_type bdf -ventilator_breaths 2", 2e-4, false,
             true},
      Breath{"tree_through_a_tube", TREE PCV TUBE, 2e-4, false, true},
      Breath{"tree_limited", TREE "-ventilator programme -ventilator_programme LIMITED ", 1e-5, false, true},
      Breath{"tree_cut_steps", TREE PCV "-ventilator_pip 3 -snes_max_it 6", 1e-5, true, true},
      Breath{"tree_viscoelastic", TREE PCV VISCOELASTIC, 2e-4, false, true},
      Breath{"tree_recruitment_bdf", TREE PCV RECRUITMENT "-ts_type bdf", 1e-5},
      Breath{
          "star",
          "-airflow -airflow_permeability 1 -airflow_surfaces y0,y1 -airway_tree star -airway_tree_resistance 1e7 " PCV
          "-ventilator_ramp 0 -ts_dt 0.05 -ts_type bdf"},
      Breath{"effort", GAS PCV "-breathing_effort -breathing_effort_surfaces x0 -breathing_effort_pressure 1 "
                               "-breathing_effort_rise 0.2 -breathing_effort_hold 0.05 -breathing_effort_fall 0.1 "
                               "-breathing_effort_period 0.6 -breathing_effort_delay 0.07"},
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
