// The steps of a simulation: attempts, what is held against them, what an accepted one leaves.
#include "pulmo/time/simulation.hpp"

#include "pulmo/base/stopwatch.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/fem/permeability_range.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <petsc/private/tsimpl.h>
#include <sstream>

namespace pulmo {

namespace {

/// A step cut below this share of the one asked for ends the run (-ts_adapt_dt_min may end it earlier).
constexpr PetscReal least_step = 1e-5;

/// So do some accepted steps in a row below this share of the step asked for (Simulation::max_crawling_steps).
constexpr PetscReal crawling_step = 1e-3;

/// No load leaves a residual as small as this, but rounding does.
constexpr PetscReal rounding = 1e-13;

/// Steps in which pressure spreads over so many cells' squares leave gas that is large beside what moves.
constexpr PetscReal fast_gas = 1e4;

/// A step that changed a bounded quantity by too much is cut to this share of itself at least, and at most.
constexpr PetscReal least_bound_cut = 0.1, largest_bound_cut = 0.9;

/// Failed attempts that are remembered.
constexpr std::size_t max_failures = 12;

} // namespace

PetscReal Simulation::next_step(PetscReal t, PetscReal h, TSAdapt adapt, PetscBool &accept)
{
  // the step after this one must not change a bounded quantity by too much either, if that goes on as it did
  const PetscReal longest = h * step_control_.tightest().length_within();
  accept = PETSC_TRUE;
  if (!step_control_.in_use()) {
    if (cut_)
      dt_ = h; // it took cuts to get here
    else if (h >= dt_ * (1 - same_time))
      dt_ = std::min(asked_dt(), adapt->clip[1] * dt_); // a full step: grow back
    dt_ = std::min(dt_, longest);
    return landing(t + h);
  }
  const int order = scheme_.order();
  const auto error = step_control_.error(order, candidate_, airway_.free_values());
  const PetscReal growth = error ? StepControl::growth(order, *error) : 1,
                  least = std::max(adapt->dt_min, least_step * asked_dt());
  if (error && *error > 1 && growth * h > least) {
    accept = PETSC_FALSE;
    ++rejected_;
    went("error in time");
    dt_ = growth * h;
    return landing(t);
  }
  // a step that was shortened to land says little of longer ones
  dt_ = std::min(adapt->dt_max, cut_ ? h : std::max(growth * h, h < dt_ && growth > 1 ? dt_ : 0));
  dt_ = std::min(dt_, longest);
  return landing(t + h);
}

void Simulation::begin_smooth_stretch()
{
  step_control_.restart({accepted_.time, accepted_.volume, accepted_.pressure});
  if (step_control_.in_use()) dt_ = asked_dt();
}

PetscErrorCode Simulation::before_stage(PetscReal t)
{
  PetscReal begin, dt;

  PetscFunctionBeginUser;
  PetscCall(TSGetTime(ts_, &begin));
  PetscCall(TSGetTimeStep(ts_, &dt));
  if (attempt_begins_) {
    attempts_.emplace_back();
    attempts_.back().begin = next_attempt();
    attempt_begins_ = false;
  }
  evaluated_.known = false; // the past is another one now
  PetscCall(scheme_.begin_stage(t, dt));
  if (model_.memory()) {
    model_.memory()->settle();
    model_.memory()->look_back(scheme_.looks_back_at());
  }
  airway_.scalars().freeze(false);
  for (Partner *partner : partners_) partner->begin(t, begin + dt);
  model_.set_load(std::min<PetscReal>(1, (begin + dt) / std::min(phases_.front().dt.value_or(wanted_dt_), end_)));
  extra_newton_ = 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::after_stage()
{
  SNES snes;
  SNESConvergedReason reason;
  PetscInt newton, krylov;

  PetscFunctionBeginUser;
  PetscCall(TSGetSNES(ts_, &snes));
  PetscCall(SNESGetIterationNumber(snes, &newton));
  PetscCall(SNESGetLinearSolveIterations(snes, &krylov));
  PetscCall(SNESGetConvergedReason(snes, &reason));
  newton_ += newton;
  krylov_ += krylov;
  PetscReal *norms;
  PetscInt n_norms;
  PetscCall(SNESGetConvergenceHistory(snes, &norms, nullptr, &n_norms));
  attempts_.back().norms.insert(attempts_.back().norms.end(), norms, norms + n_norms);
  for (Partner *partner : partners_) {
    std::string why;
    PetscCall(partner->give_up(why));
    if (why.empty() || !unsolved_.empty()) continue;
    unsolved_ = why + ".";
    given_up_ = true;
    went("given up");
  }
  if (!unsolved_.empty()) {
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (rows_.size() == 1 && newton == 0 && reason == SNES_CONVERGED_FNORM_ABS) PetscCall(warn_of_faint_load(snes));
  if (reason < 0) {
    PetscReal dt;
    PetscCall(TSGetTimeStep(ts_, &dt));
    // where the start itself is not defined new Jacobians are no help
    const bool retry = newton > 0 || reason != SNES_DIVERGED_FUNCTION_DOMAIN;
    PetscCall(fail(dt, SNESConvergedReasons[reason], newton, inverted_measures_, inverted_, retry));
  }
  inverted_ = false;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Tolerances are absolute in units of the stiffest tangent: a load that is small beside it is taken for none.
PetscErrorCode Simulation::warn_of_faint_load(SNES snes)
{
  PetscReal norm, tolerance;

  PetscFunctionBeginUser;
  PetscCall(SNESGetFunctionNorm(snes, &norm));
  PetscCall(SNESGetTolerances(snes, &tolerance, nullptr, nullptr, nullptr, nullptr));
  if (norm > rounding)
    PetscCall(
        PetscPrintf(options_.comm(),
                    "pulmo: warning: the first step took no Newton step, as its residual %.2g is below -snes_atol "
                    "%.2g; if this load is to move the lung, lower -snes_atol\n",
                    (double)norm, (double)tolerance));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::accept_stage(PetscReal t, Vec X, PetscBool *accept)
{
  Measures measures;
  PetscReal dt;
  SNES snes;
  SNESConvergedReason reason;

  PetscFunctionBeginUser;
  *accept = PETSC_FALSE;
  PetscCall(TSGetSNES(ts_, &snes));
  PetscCall(SNESGetConvergedReason(snes, &reason));
  if (reason < 0 || !unsolved_.empty())
    PetscFunctionReturn(PETSC_SUCCESS); // newer PETSc asks here before it looks; after_stage() dealt with it
  PetscCall(TSGetTimeStep(ts_, &dt));
  PetscCall(airway_.apply(X));
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(measure(t, measures));
  *accept = PetscBool(measures.min_J > 0 && measures.min_air > 0);
  if (!*accept)
    PetscCall(fail(dt, measures.airless() ? "converged to a state without air" : "converged to a state with J <= 0", 0,
                   measures, true, true));
  if (!*accept) PetscFunctionReturn(PETSC_SUCCESS);
  Attempt attempt{t, dt, measures.volume_change, 0, 0, local_};
  PetscCall(airway_.pressure(local_, attempt.pressure));
  attempt.flow = airway_.opening_flow(scheme_.flow(measures.volume_change));
  PetscCall(ask_partners(attempt, accept));
  if (*accept) PetscCall(judge_changes(attempt, accept));
  if (!*accept) PetscFunctionReturn(PETSC_SUCCESS);
  bool solved;
  candidate_ = {t, measures.volume_change / units::mm3_per_ml, attempt.pressure / units::kPa_per_cmH2O};
  PetscCall(judge(t, measures.volume_change, attempt.pressure, solved));
  *accept = PetscBool(solved);
  if (!solved) {
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED)); // a shorter step would be solved no better
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (scheme_.half_step()) {
    if (model_.memory()) PetscCall(model_.memory()->compute(t, local_, rate_));
    PetscCall(record_stage(t, -1, local_));
    if (model_.memory()) model_.memory()->keep_middle();
  }
  PetscCall(scheme_.accept_stage(model_, moment(t, measures.volume_change, local_)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Asks the partners of @p attempt; where one of them does not accept it the step is taken again, or a shorter one.
PetscErrorCode Simulation::ask_partners(const Attempt &attempt, PetscBool *accept)
{
  Verdict verdict = Verdict::accept;
  std::string why;

  PetscFunctionBeginUser;
  for (Partner *partner : partners_) {
    const Verdict own = partner->judge(attempt);
    if (own > verdict) why = partner->why();
    verdict = std::max(verdict, own);
  }
  *accept = PetscBool(verdict <= Verdict::kink);
  kink_ = verdict == Verdict::kink;
  if (verdict == Verdict::again) {
    went("again, " + why);
    for (Partner *partner : partners_) partner->reject(verdict);
    PetscCall(keep_step(attempt.dt));
  }
  if (verdict == Verdict::shorter) PetscCall(reject(attempt.dt, why, 0, Measures(), false));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::measure_change(const Attempt &attempt, StepBound::Quantity quantity, PetscReal &change) const
{
  PetscFunctionBeginUser;
  if (quantity == StepBound::Quantity::log_J)
    PetscCall(model_.largest_J_change(before_, attempt.local, change));
  else {
    if (scene_.facts().airflow)
      PetscCall(model_.largest_pressure_change(before_, attempt.local, change));
    else
      change = std::abs(attempt.pressure - accepted_.pressure * units::kPa_per_cmH2O);
    change /= units::kPa_per_cmH2O;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::judge_changes(const Attempt &attempt, PetscBool *accept)
{
  PetscFunctionBeginUser;
  for (StepBound &bound : step_control_.bounds())
    if (bound.in_use()) PetscCall(measure_change(attempt, bound.quantity, bound.change));
  const StepBound &tightest = step_control_.tightest();
  if (tightest.met()) PetscFunctionReturn(PETSC_SUCCESS);
  *accept = PETSC_FALSE;
  const PetscReal share = std::clamp<PetscReal>(tightest.length_within(), least_bound_cut, largest_bound_cut);
  PetscCall(reject(attempt.dt, tightest.complaint(), 0, Measures(), false, share));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Simulation::went(const std::string &outcome)
{
  attempts_.back().outcome = outcome;
  attempt_begins_ = true;
}

AttemptBegin Simulation::next_attempt() const
{
  AttemptBegin begin;
  (void)TSGetTimeStep(ts_, &begin.dt);
  begin.wanted_dt = dt_;
  begin.asked_dt = wanted_dt_;
  begin.cut = cut_;
  begin.always_new = lagging_.always_new();
  begin.looks_back = scheme_.looks_back();
  begin.limited = airway_.retakes();
  begin.past_limit = airway_.past_limit();
  begin.crawled = crawled_;
  begin.failures = failures_;
  return begin;
}

std::size_t Simulation::first_repeatable() const
{
  SNES snes;
  (void)TSGetSNES(ts_, &snes);
  if (crawls() || !lagging_.outlasts_steps(snes)) return 0;
  const auto fresh =
      std::find_if(attempts_.begin(), attempts_.end(), [](const AttemptRecord &a) { return a.begin.always_new; });
  return fresh == attempts_.end() ? 0 : static_cast<std::size_t>(fresh - attempts_.begin());
}

/// Holds what the state in local_ leaves of its equations against what they balance. Fills rate_ and local_residual_.
PetscErrorCode Simulation::judge(PetscReal t, PetscReal volume, PetscReal pressure, bool &solved)
{
  Vec F;
  Model::ResidualSums sums;
  Balance::Errors errors;
  bool evaluated;

  PetscFunctionBeginUser;
  PetscCall(make_rate());
  PetscCall(is_evaluated(t, evaluated));
  if (!evaluated) PetscCall(local_residual(t));
  PetscCall(DMGetGlobalVector(model_.dm(), &F));
  PetscCall(VecZeroEntries(F));
  PetscCall(DMLocalToGlobal(model_.dm(), local_residual_, ADD_VALUES, F));
  if (airway_.mode() != Airway::Mode::free) PetscCall(model_.airway().set(F, 0)); // the flux that enters there
  PetscCall(model_.residual_sums(F, sums));
  PetscCall(DMRestoreGlobalVector(model_.dm(), &F));
  Airway::Unmet unmet;
  PetscCall(airway_.unmet(volume, local_residual_, unmet));
  const bool gas_flows = sums.absolute.size() > pulmo::pressure;
  errors.force = sums.absolute[displacement];
  errors.gas = std::max(unmet.volume, gas_flows ? sums.absolute[pulmo::pressure] / scheme_.slope() : 0);
  if (gas_flows && !scheme_.half_step()) errors.net_gas = sums.net[pulmo::pressure] / scheme_.slope();
  errors.pressure = unmet.pressure;
  const auto load = [&](Balance::Loads &loads) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(model_.loads(t, local_, local_residual_, loads.force, loads.gas));
    loads.gas /= scheme_.slope();
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(balance_.judge(static_cast<int>(phase_->breath), accepted_.volume * units::mm3_per_ml, volume, pressure,
                           errors, load, solved));
  std::ostringstream text;
  text << t;
  if (!solved) went("not solved");
  if (!solved) PetscCall(end_unsolved("the step to t = " + text.str() + " s was not solved", balance_.complaint()));
  if (solved && balance_.warns())
    PetscCall(PetscPrintf(options_.comm(),
                          "pulmo: warning: the step to t = %g s is hardly solved: the solver leaves %s\n", (double)t,
                          balance_.complaint().c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::end_unsolved(const std::string &what, const std::string &left)
{
  const PetscReal L = scene_.mesh().length();
  PermeabilityRange k;
  std::string cause;

  PetscFunctionBeginUser;
  PetscCall(options_.loosened(cause));
  if (scene_.facts().airflow) PetscCall(permeability_at_rest(scene_.facts(), model_, k));
  const PetscReal spread = k.largest * model_.modulus() * wanted_dt_ / (L * L);
  if (spread > fast_gas) {
    std::ostringstream text;
    text.precision(3);
    text << "With the permeability of " << k.largest << " mm^2/(kPa s) gas crosses a cell in " << 1 / spread
         << " of a step, and tolerances are relative to that flow: lower -airflow_permeability, where there is no "
            "resistance left to speak of, or give -snes_rtol 1e-14. ";
    cause = text.str() + cause;
  }
  unsolved_ = what + ": the solver leaves " + left + " (0.01 at most). " + cause + ".";
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// With airflow: the flow that is prescribed, or that goes with the residual in local_residual_, mm^3/s.
PetscErrorCode Simulation::consistent_flow(PetscReal &flow) const
{
  PetscFunctionBeginUser;
  if (airway_.mode() == Airway::Mode::free)
    flow = airway_.flow();
  else {
    std::vector<PetscReal> flows;
    PetscCall(model_.airway().flows(local_residual_, model_.row_scale(pulmo::pressure), flows));
    flow = std::accumulate(flows.begin(), flows.end(), PetscReal(0));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Lets a step that is taken again be as long as it was, where PETSc would cut it.
PetscErrorCode Simulation::keep_step(PetscReal dt)
{
  TSAdapt adapt;

  PetscFunctionBeginUser;
  PetscCall(TSRestartStep(ts_)); // as in reject()
  PetscCall(heed_request(TS_DIVERGED_STEP_REJECTED));
  PetscCall(TSGetAdapt(ts_, &adapt));
  PetscCall(TSSetTimeStep(ts_, dt / adapt->scale_solve_failed));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// An attempt failed: the step is taken again, with new Jacobians throughout if @p retry and there were old ones, else
/// shorter.
PetscErrorCode Simulation::fail(PetscReal dt, const std::string &reason, PetscInt newton, const Measures &measures,
                                bool inverted, bool retry)
{
  SNES snes;
  bool again = false;

  PetscFunctionBeginUser;
  PetscCall(TSGetSNES(ts_, &snes));
  if (retry) PetscCall(lagging_.retry(snes, again));
  went(reason);
  if (again) {
    for (Partner *partner : partners_) partner->reject(Verdict::again);
    PetscCall(keep_step(dt));
  } else {
    PetscCall(reject(dt, reason, newton, measures, inverted));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::reject(PetscReal dt, const std::string &reason, PetscInt newton, const Measures &measures,
                                  bool inverted, std::optional<PetscReal> share)
{
  TSAdapt adapt;

  PetscFunctionBeginUser;
  if (failures_.size() == max_failures) failures_.erase(failures_.begin());
  failures_.push_back({accepted_.time, dt, reason, newton, measures, inverted});
  went(reason);
  cut_ = true;
  ++rejected_;
  for (Partner *partner : partners_) partner->reject(Verdict::shorter);
  PetscCall(TSRestartStep(ts_)); // BDF and -ts_theta_initial_guess_extrapolate must not look at a failed state
  PetscCall(TSGetAdapt(ts_, &adapt));
  const PetscReal next = dt * share.value_or(adapt->scale_solve_failed);
  if (share) PetscCall(TSSetTimeStep(ts_, next / adapt->scale_solve_failed)); // PETSc cuts it
  if (next < std::max(adapt->dt_min, least_step * asked_dt())) {
    bool flows_on;
    PetscCall(flow_on(flows_on));
    if (flows_on) {
      PetscCall(keep_step(landing(accepted_.time)));
      PetscFunctionReturn(PETSC_SUCCESS);
    }
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  }
  PetscCall(heed_request(TS_DIVERGED_STEP_REJECTED));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::flow_on(bool &flows_on)
{
  Measures last;

  PetscFunctionBeginUser;
  flows_on = false;
  if (!scene_.facts().flow_past_limit_points) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(model_.measure(before_, last));
  const auto limit = limit_point(rows_, last);
  flows_on = limit && airway_.flow_on();
  if (!flows_on) PetscFunctionReturn(PETSC_SUCCESS);
  cut_ = false;
  crawled_ = 0;
  failures_.clear();
  dt_ = asked_dt();
  begin_smooth_stretch();
  PetscCall(PetscPrintf(options_.comm(),
                        "pulmo: note: a limit point at t = %.6g s (phase '%s'): at %.6g ml there is no equilibrium %s "
                        "%.6g cmH2O; from there on a flow of %.4g ml/s is prescribed, until the pressure of the phase "
                        "can be held again\n",
                        (double)accepted_.time, phase_->name.c_str(), accepted_.volume,
                        limit->highest ? "above" : "below", limit->pressure,
                        (double)(airway_.flow_past_limit() / units::mm3_per_ml)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::after_step()
{
  Measures measures;
  PetscReal t, pressure;
  SignalRow row;
  TSConvergedReason reason;
  SNES snes;

  PetscFunctionBeginUser;
  PetscCall(TSGetConvergedReason(ts_, &reason));
  if (reason < 0) PetscFunctionReturn(PETSC_SUCCESS); // PETSc calls this after a step that it gave up, too
  PetscCall(TSGetSNES(ts_, &snes));
  PetscCall(lagging_.settle(snes));
  PetscCall(TSGetTime(ts_, &t));
  PetscCall(TSGetTimeStep(ts_, &next_dt_));
  row.dt = t - accepted_.time;
  cut_ = false;
  accepted_attempts_ = std::move(attempts_);
  attempts_.clear();
  attempt_begins_ = true;
  const bool landed = same(t, phase_->end) || same(t, phase_->begin + phase_->ramp);
  crawled_ = row.dt < crawling_step * asked_dt() && !landed && !failures_.empty() ? crawled_ + 1 : 0;
  if (crawled_ == 0) failures_.clear();
  if (crawls_soon()) lagging_.renew(snes); // who is to end for its steps does so with a new Jacobian

  // state and consistent flux of the accepted step
  PetscCall(airway_.apply(state_));
  PetscCall(predictor_.accept(state_));
  PetscCall(DMGlobalToLocal(model_.dm(), state_, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(airway_.pressure(local_, pressure));
  PetscCall(measure(t, measures));
  row.volume = measures.volume_change / units::mm3_per_ml;
  if (model_.composition().supported()) { // judge() left this state's residual
    std::vector<std::array<PetscReal, 3>> forces;
    PetscCall(model_.reactions(local_residual_, forces));
    for (const auto &force : forces)
      for (const PetscReal f : force) worst_reaction_ = std::max(worst_reaction_, std::abs(f));
    if (model_.composition().pinned()) PetscCall(pins_.follow(model_, forces, local_, t, pressure));
  }
  PetscReal flow = scheme_.flow(measures.volume_change);
  if (scene_.facts().airflow) PetscCall(consistent_flow(flow));
  row.flow = flow / units::mm3_per_ml;
  PetscCall(VecCopy(local_, before_));
  if (model_.memory()) PetscCall(model_.memory()->compute(t, local_, rate_));
  PetscCall(record_stage(t, static_cast<PetscInt>(rows_.size()), local_));
  const PetscReal opening_flow = airway_.opening_flow(row.flow * units::mm3_per_ml);
  const Attempt accepted{t, row.dt, measures.volume_change, pressure, opening_flow, local_};
  const bool was_past_limit = airway_.past_limit();
  for (Partner *partner : partners_) partner->accept(accepted);
  // -ts_max_time may end the phase at hand where it ends by itself
  const auto index = static_cast<std::size_t>(phase_ - phases_.data());
  const bool ends_early = airway_.phase_is_over() && !same(t, plan_.phases()[index].end);
  if (ends_early) end_phase(t);
  const bool phase_goes_on = !same(t, phase_ == &phases_.back() ? whole_end_ : phase_->end); // perhaps after a restart
  const bool kink = (same(t, phase_->begin + phase_->ramp) || kink_) && phase_goes_on;
  row.time = t;
  row.pressure = pressure / units::kPa_per_cmH2O;
  row.ventilator_pressure = airway_.ventilator_pressure(opening_flow) / units::kPa_per_cmH2O;
  list_scalars(row);
  row.phase = phase_->name;
  row.hold = airway_.holds_volume();
  row.past_limit = airway_.past_limit();
  row.breath = static_cast<int>(phase_->breath);
  row.newton = newton_;
  row.krylov = krylov_;
  row.min_J = measures.min_J;
  row.max_J = measures.max_J;
  newton_ = krylov_ = 0;
  const PetscReal lost = scheme_.flow(measures.volume_change) - row.flow * units::mm3_per_ml;
  delivered_ += (row.volume - accepted_.volume) * units::mm3_per_ml - lost / scheme_.slope();
  if (model_.memory()) model_.memory()->accept();
  PetscCall(scheme_.accept(model_, moment(t, measures.volume_change, local_)));
  step_control_.accept({t, row.volume, row.pressure});
  balance_.accept();
  if (was_past_limit && !airway_.past_limit())
    PetscCall(PetscPrintf(options_.comm(),
                          "pulmo: note: from t = %.6g s and %.6g ml on (phase '%s') the pressure of the phase is held "
                          "again\n",
                          (double)accepted_.time, accepted_.volume, phase_->name.c_str()));
  accepted_ = row;
  bool flows_on = false;
  if (crawls()) { // at a limit point steps may do so
    rows_.push_back(row);
    PetscCall(flow_on(flows_on));
    rows_.pop_back();
  }
  if (kink || flows_on) {
    begin_smooth_stretch();
    PetscCall(TSRestartStep(ts_));
    if (step_control_.in_use() || flows_on) PetscCall(TSSetTimeStep(ts_, landing(t)));
    PetscCall(TSGetTimeStep(ts_, &next_dt_));
  }
  PetscCall(report(row, measures));
  if (crawls()) PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  if (ends_early) PetscCall(TSSetConvergedReason(ts_, TS_CONVERGED_USER));
  if (!same(t, end_)) PetscCall(heed_request(TS_CONVERGED_USER));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::record_stage(PetscReal t, PetscInt row, Vec local)
{
  PetscFunctionBeginUser;
  if (!trajectory_) PetscFunctionReturn(PETSC_SUCCESS);
  StageRecord record;
  record.time = t;
  record.stage = scheme_.stage();
  record.load = model_.load();
  record.row = row;
  record.phase = phase_ ? static_cast<PetscInt>(phase_ - phases_.data()) : 0;
  record.airway = airway_.condition();
  PointMemory::Values remembered;
  if (model_.composition().memory_acts()) model_.memory()->copy(trajectory_->stages().empty(), remembered);
  PetscCall(trajectory_->keep(record, scheme_, local, remembered));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Writes the scalars of effects into a row of the signals.
void Simulation::list_scalars(SignalRow &row) const
{
  const ScalarUnknowns &scalars = airway_.scalars();
  row.stored_flow = (airway_.opening_flow(0)) / units::mm3_per_ml;
  for (std::size_t i = 1; i < scalars.size(); ++i) {
    row.scalars.push_back(scalars.values()[i] / units::kPa_per_cmH2O);
    row.scalar_flows.push_back(scalars.flows()[i] / units::mm3_per_ml);
  }
}

PetscErrorCode Simulation::heed_request(TSConvergedReason reason)
{
  PetscFunctionBeginUser;
  if (stop_request_) PetscCall(stop_request_->asked(stopped_));
  if (stopped_) PetscCall(TSSetConvergedReason(ts_, reason));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::report(SignalRow row, const Measures &measures)
{
  const Stopwatch clock(seconds_.output);
  const PetscReal balance = measures.volume_change - delivered_;

  PetscFunctionBeginUser;
  if (!model_.composition().integrals().empty()) PetscCall(model_.memory()->integrals(row.integrals));
  rows_.push_back(row);
  worst_balance_ = std::max(worst_balance_, std::abs(balance));
  min_J_ = std::min(min_J_, measures.min_J);
  const bool phase_ends = phase_ && same(row.time, phase_->end);
  const StepReport step{rows_,      row,
                        measures,   balance,
                        before_,    local_residual_,
                        end_,       plan_.end_of_breath(row.breath),
                        phase_ends, end_cuts_next()};
  for (Observer *observer : observers_) PetscCall(observer->observe(step));
  PetscFunctionReturn(PETSC_SUCCESS);
}

FailureFacts Simulation::failure_facts() const
{
  FailureFacts facts;
  facts.attempts = failures_;
  facts.rows = rows_;
  facts.crawled = crawls();
  facts.free_flow = airway_.mode() == Airway::Mode::free;
  facts.prescribes_pressure = phase_ && phase_->control == Control::pressure && !airway_.past_limit();
  facts.past_limit = airway_.past_limit();
  const Programme *ventilator =
      scene_.facts().ventilator.get(); // pcv prescribes no flow, phases of vcv are from no file
  facts.could_flow_on = ventilator && !scene_.facts().flow_past_limit_points &&
                        (!ventilator->prescribes_flow() || (phase_ && !phase_->where.empty()));
  if (phase_) facts.phase = phase_->name;
  return facts;
}

} // namespace pulmo
