#include "pulmo/time/simulation.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <petsc/private/snesimpl.h>
#include <petsc/private/tsimpl.h>

namespace pulmo {

namespace {

/// Two times closer than this share of the step are the same.
constexpr PetscReal same_time = 1e-9;

/// A pressure is above a limit if it is so by more than this, cmH2O.
constexpr PetscReal same_pressure = 1e-6;

/// A step may be longer by this share to land on a time, so that no sliver of a step is left.
constexpr PetscReal stretch = 0.01;

/// A step cut below this share of the one asked for ends the run (-ts_adapt_dt_min may end it earlier).
constexpr PetscReal least_step = 1e-5;

/// So do as many accepted steps in a row below this share of the step asked for: the run only crawls towards a state
/// that it cannot pass.
constexpr PetscReal crawling_step = 1e-3;
constexpr int crawling_steps = 20;

/// No load leaves a residual as small as this, but rounding does.
constexpr PetscReal rounding = 1e-13;

/// Steps in which pressure spreads over so many cells' squares leave gas that is large beside what moves.
constexpr PetscReal fast_gas = 1e4;

/// Newton steps that a prescribed volume may ask for beyond PETSc's tests (rounding may keep it from being met).
constexpr int max_extra_newton = 3;

/// Failed attempts that are remembered.
constexpr std::size_t max_failures = 12;

class Stopwatch {
public:
  explicit Stopwatch(double &seconds) : seconds_(seconds) { (void)PetscTime(&start_); }
  ~Stopwatch()
  {
    PetscLogDouble end;
    (void)PetscTime(&end);
    seconds_ += end - start_;
  }
  Stopwatch(const Stopwatch &) = delete;
  Stopwatch &operator=(const Stopwatch &) = delete;

private:
  double &seconds_;
  PetscLogDouble start_ = 0;
};

} // namespace

PetscErrorCode Simulation::declare(Options &options)
{
  PetscFunctionBeginUser;
  PetscCall(predictor_.declare(options));
  PetscCall(lagging_.declare(options));
  PetscCall(step_control_.declare(options));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::setup()
{
  const DM dm = model_.dm();

  PetscFunctionBeginUser;
  PetscCall(DMCreateGlobalVector(dm, state_.out()));
  PetscCall(DMCreateLocalVector(dm, local_.out()));
  PetscCall(VecDuplicate(local_, rate_.out()));
  PetscCall(VecDuplicate(local_, local_residual_.out()));
  PetscCall(VecDuplicate(local_, before_.out()));
  PetscCall(predictor_.setup(state_));
  balance_.setup(scene_.mesh().volume(), model_.modulus());
  PetscCall(create_solver());
  partners_ = {&airway_};
  for (const Effect *effect : scene_.active())
    for (auto &partner : effect->partners(scene_.facts())) {
      partners_.push_back(partner.get());
      effect_partners_.push_back(std::move(partner));
    }
  phases_ = phases();
  end_ = phases_.back().end;
  whole_end_ = scene_.facts().ventilator ? scene_.facts().ventilator->phases()[phases_.size() - 1].end : PETSC_MAX_REAL;
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<Phase> Simulation::phases() const
{
  PetscReal max_time = PETSC_MAX_REAL;
  std::vector<Phase> list;

  (void)TSGetMaxTime(ts_, &max_time);
  if (scene_.facts().ventilator)
    list = scene_.facts().ventilator->phases();
  else {
    Phase run;
    run.name = "run";
    run.end = max_time < PETSC_MAX_REAL ? max_time : 1;
    list.push_back(run);
  }
  while (list.size() > 1 && list.back().begin >= max_time) list.pop_back();
  list.back().end = std::min(list.back().end, max_time);
  return list;
}

bool Simulation::same(PetscReal t, PetscReal other) const
{
  return std::abs(t - other) <= same_time * asked_dt();
}

/// The size of the step from time t within a phase that ends at @p end, where steps of @p dt are wanted.
PetscReal Simulation::landing(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const
{
  for (const PetscReal stop : {phase.begin + phase.ramp, end})
    if (t < stop && !same(t, stop) && t + (1 + stretch) * dt > stop) return stop - t;
  return dt;
}

PetscReal Simulation::landing(PetscReal t) const
{
  return landing(*phase_, phase_->end, dt_, t);
}

PetscReal Simulation::goes_on_with(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const
{
  const PetscReal h = landing(phase, end, dt, t), left = end - t;
  TSAdapt adapt;
  (void)TSGetAdapt(ts_, &adapt);
  if (h >= left || h * (1 + adapt->matchstepfac[0]) > left) return left;
  return h * adapt->matchstepfac[1] > left ? left / 2 : h;
}

bool Simulation::end_cuts_next() const
{
  const PetscReal t = accepted_.time;
  const Phase &last = phases_.back(), *next = phase_ ? phase_ : &phases_.front();
  if (same(end_, whole_end_) || same(t, end_)) return false;
  const bool begins = !phase_ || same(t, phase_->end);
  if (phase_ && begins) ++next; // the run goes on, so there is one
  if (next != &last) return false;
  const PetscReal asked = last.dt.value_or(wanted_dt_); // what run() begins a phase with
  const PetscReal dt = begins && (step_control_.in_use() || asked != asked_dt()) ? asked : dt_;
  const PetscReal now = begins ? landing(last, end_, dt, t) : goes_on_with(last, end_, dt, t),
                  whole = begins ? landing(last, whole_end_, dt, t) : goes_on_with(last, whole_end_, dt, t);
  return !same(now, whole);
}

PetscReal Simulation::next_step(PetscReal t, PetscReal h, TSAdapt adapt, PetscBool &accept)
{
  accept = PETSC_TRUE;
  if (!step_control_.in_use()) {
    if (cut_)
      dt_ = h; // it took cuts to get here
    else if (h >= dt_ * (1 - same_time))
      dt_ = std::min(asked_dt(), adapt->clip[1] * dt_); // a full step: grow back
    return landing(t + h);
  }
  const int order = scheme_.order();
  const auto error = step_control_.error(order, candidate_, airway_.free_values());
  const PetscReal growth = error ? StepControl::growth(order, *error) : 1,
                  least = std::max(adapt->dt_min, least_step * asked_dt());
  if (error && *error > 1 && growth * h > least) {
    accept = PETSC_FALSE;
    ++rejected_;
    dt_ = growth * h;
    return landing(t);
  }
  // a step that was shortened to land says little of longer ones
  dt_ = std::min(adapt->dt_max, cut_ ? h : std::max(growth * h, h < dt_ && growth > 1 ? dt_ : 0));
  return landing(t + h);
}

void Simulation::begin_smooth_stretch()
{
  step_control_.restart({accepted_.time, accepted_.volume, accepted_.pressure});
  if (step_control_.in_use()) dt_ = asked_dt();
}

PetscErrorCode Simulation::start()
{
  Measures measures;

  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(state_));
  PetscCall(predictor_.begin(state_));
  PetscCall(DMGlobalToLocal(model_.dm(), state_, INSERT_VALUES, before_));
  PetscCall(model_.measure(before_, measures));
  accepted_ = SignalRow();
  accepted_.phase = phases_.front().name;
  accepted_.breath = static_cast<int>(phases_.front().breath);
  if (phases_.front().control == Control::pressure) // a run begins with all at rest, or with a pressure of its own
    accepted_.pressure = phases_.front().from.value_or(0) / units::kPa_per_cmH2O;
  accepted_.ventilator_pressure = accepted_.pressure;
  airway_.start();
  accepted_.scalars.assign(model_.composition().n_scalars(), 0);
  accepted_.scalar_flows = accepted_.scalars;
  PetscCall(scheme_.begin(model_, moment(0, measures.volume_change, before_)));
  PetscCall(warn_of_low_limits());
  dt_ = asked_dt();
  PetscCall(report(accepted_, measures));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::run(bool &finished)
{
  const MPI_Comm comm = options_.comm();
  PetscLogDouble begin, end;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&begin));
  if (!resumed_) PetscCall(start());
  finished = true;
  for (const Phase &phase : phases_) {
    TSConvergedReason reason;
    const bool within = resumed_ && &phase == phase_;
    if (resumed_ && &phase < phase_) continue;
    resumed_ = false;
    if (within && same(accepted_.time, phase.end)) continue;
    const PetscReal asked_before = asked_dt();
    phase_ = &phase;
    if (!within) {
      if (asked_dt() != asked_before) dt_ = asked_dt();
      PetscCall(warn_of_low_limit(phase, accepted_.machine_pressure()));
      airway_.begin_phase(phase, accepted_.volume * units::mm3_per_ml, std::min(asked_dt(), phase.end - phase.begin));
      begin_smooth_stretch();
      next_dt_ = landing(phase.begin);
    }
    PetscCall(TSSetTime(ts_, within ? accepted_.time : phase.begin));
    PetscCall(TSSetMaxTime(ts_, phase.end));
    PetscCall(TSSetTimeStep(ts_, next_dt_));
    PetscCall(scheme_.begin_solve(static_cast<PetscInt>(rows_.size()) - 1));
    PetscCall(TSSolve(ts_, state_));
    PetscCall(TSGetConvergedReason(ts_, &reason));
    if (reason < 0 || stopped_) {
      finished = false;
      break;
    }
  }
  if (finished) {
    bool alone;
    PetscCall(airway_alone(alone));
    finished = balance_.judge_run(alone ? worst_balance_ : 0);
    if (!finished)
      PetscCall(end_unsolved("the run was not solved", balance_.complaint()));
    else if (balance_.worst() > Balance::warning)
      PetscCall(PetscPrintf(comm, "pulmo: warning: the steps are hardly solved: the worst leaves %s\n",
                            balance_.complaint().c_str()));
  }
  if (!finished && !stopped_ && unsolved_.empty())
    PetscCall(diagnose(scene_, model_, failure_facts(), before_, diagnosis_));
  PetscCall(PetscTime(&end));
  seconds_.total = end - begin + seconds_.setup;
  seconds_.solve = end - begin - seconds_.residual - seconds_.jacobian - seconds_.output;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &seconds_, 6, MPI_DOUBLE, MPI_MAX, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether gas gets in and out by the airway and nowhere else: no source, and no other node of prescribed pressure.
PetscErrorCode Simulation::airway_alone(bool &alone)
{
  PetscReal force, gas = 0;

  PetscFunctionBeginUser;
  if (scene_.facts().airflow) PetscCall(model_.loads(accepted_.time, before_, local_residual_, force, gas));
  alone = scene_.facts().airflow && gas == 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::warn_of_low_limits()
{
  PetscReal pressure = accepted_.machine_pressure();
  bool known = true;

  PetscFunctionBeginUser;
  for (const Phase &phase : phases_) {
    if (known) PetscCall(warn_of_low_limit(phase, pressure));
    known = phase.control == Control::pressure;
    pressure = phase.to / units::kPa_per_cmH2O;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::warn_of_low_limit(const Phase &phase, PetscReal pressure)
{
  PetscFunctionBeginUser;
  if (!phase.limit) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal limit = *phase.limit / units::kPa_per_cmH2O;
  if (pressure <= limit + same_pressure || !low_limits_.insert(phase.where).second) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(options_.comm(),
                        "pulmo: warning: %s: phase '%s' begins at %.4g cmH2O, above its own limit of %.4g cmH2O: the "
                        "limit is held from its first step on, and gas flows out; raise 'limit', or lower the pressure "
                        "before the phase\n",
                        phase.where.c_str(), phase.name.c_str(), (double)pressure, (double)limit));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::before_stage(PetscReal t)
{
  PetscReal begin, dt;

  PetscFunctionBeginUser;
  PetscCall(TSGetTime(ts_, &begin));
  PetscCall(TSGetTimeStep(ts_, &dt));
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

/// Fills rate_ from local_.
PetscErrorCode Simulation::make_rate()
{
  PetscFunctionBeginUser;
  if (scheme_.multistep()) {
    PetscCall(scheme_.rate(local_, rate_));
  } else {
    PetscCall(VecWAXPY(rate_, -1, before_, local_));
    PetscCall(VecScale(rate_, scheme_.slope()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Fills local_residual_ from local_ and rate_ at time t.
PetscErrorCode Simulation::local_residual(PetscReal t)
{
  PetscFunctionBeginUser;
  PetscCall(model_.residual(t, local_, rate_, local_residual_));
  PetscCall(scheme_.add_past(model_, local_residual_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Fills local_ and rate_ from global vectors at time t.
PetscErrorCode Simulation::scatter(PetscReal t, Vec X, Vec Xdot)
{
  PetscFunctionBeginUser;
  PetscCall(airway_.apply(X));
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  if (scheme_.multistep()) {
    PetscCall(make_rate());
  } else {
    PetscReal dt;
    PetscCall(TSGetTimeStep(ts_, &dt));
    PetscCall(DMGlobalToLocal(model_.dm(), Xdot, INSERT_VALUES, rate_));
    PetscCall(model_.constrain_rate(local_, before_, dt, rate_));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::residual(PetscReal t, Vec X, Vec Xdot, Vec F)
{
  const Stopwatch clock(seconds_.residual);
  Measures measures;

  PetscFunctionBeginUser;
  bordered_ = {};
  PetscCall(scatter(t, X, Xdot));
  PetscCall(model_.measure(local_, measures));
  if (!(measures.min_J_points > 0)) {
    SNES snes;
    inverted_ = true;
    inverted_measures_ = measures;
    PetscCall(TSGetSNES(ts_, &snes));
    PetscCall(SNESSetFunctionDomainError(snes));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(local_residual(t));
  PetscCall(VecZeroEntries(F));
  PetscCall(DMLocalToGlobal(model_.dm(), local_residual_, ADD_VALUES, F));
  PetscCall(airway_.close(measures.volume_change, local_residual_, X, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::border(SNES snes, Vec X, Vec Y)
{
  Vec F;

  PetscFunctionBeginUser;
  if (airway_.mode() != Airway::Mode::solved) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(airway_.apply(X));
  PetscCall(airway_.complete(snes, matrix_, X, Y, local_, krylov_));
  PetscCall(SNESGetFunction(snes, &F, nullptr, nullptr));
  bordered_ = {Y, F};
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::product(Vec x, Vec y)
{
  PetscFunctionBeginUser;
  if (bordered_.step && x == bordered_.step)
    PetscCall(VecCopy(bordered_.product, y));
  else
    PetscCall(reinterpret_cast<PetscErrorCode (*)(Mat, Vec, Vec)>(multiply_)(matrix_, x, y));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::guess(SNES snes, Vec X)
{
  PetscFunctionBeginUser;
  if (scheme_.multistep()) PetscCall(VecCopy(state_, X)); // PETSc extrapolates: tolerances would tighten as dt falls
  PetscCall(airway_.guess(X));
  if (!predictor_.in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  const auto hold = [this](Vec increment) { return airway_.hold(increment); };
  PetscCall(predictor_.improve(snes, hold, X, start_norm_));
  inverted_ = false; // a guess was tried, no more
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::converged(SNES snes, PetscInt it, PetscReal xnorm, PetscReal ynorm, PetscReal fnorm,
                                     SNESConvergedReason *reason)
{
  PetscFunctionBeginUser;
  PetscCall(SNESConvergedDefault(snes, it, xnorm, ynorm, fnorm, reason, nullptr));
  if (it == 0 && predictor_.in_use()) { // tolerances are relative to the start of the step, however good the guess
    snes->ttol = std::max(snes->ttol, snes->rtol * start_norm_);
    snes->rnorm0 = std::max(snes->rnorm0, start_norm_);
  }
  lagging_.judge(snes, it, fnorm);
  if (*reason > 0 && !airway_.satisfied() && extra_newton_++ < max_extra_newton) *reason = SNES_CONVERGED_ITERATING;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::jacobian(PetscReal t, Vec X, Vec Xdot, Mat A)
{
  const Stopwatch clock(seconds_.jacobian);

  PetscFunctionBeginUser;
  PetscCall(scatter(t, X, Xdot));
  PetscCall(model_.jacobian(t, local_, rate_, scheme_.slope(), A));
  airway_.scalars().freeze(tests_jacobian_); // PETSc's test follows, then border()
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
  if (reason < 0)
    PetscFunctionReturn(PETSC_SUCCESS); // newer PETSc asks here before it looks; after_stage() dealt with it
  PetscCall(TSGetTimeStep(ts_, &dt));
  PetscCall(airway_.apply(X));
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(model_.measure(local_, measures));
  *accept = PetscBool(measures.min_J > 0);
  if (!*accept) PetscCall(fail(dt, "converged to a state with J <= 0", 0, measures, true, true));
  if (!*accept) PetscFunctionReturn(PETSC_SUCCESS);
  Attempt attempt{t, dt, measures.volume_change, 0, 0, local_};
  PetscCall(airway_.pressure(local_, attempt.pressure));
  attempt.flow = airway_.opening_flow(scheme_.flow(measures.volume_change));
  PetscCall(ask_partners(attempt, accept));
  if (!*accept) PetscFunctionReturn(PETSC_SUCCESS);
  bool solved;
  candidate_ = {t, measures.volume_change / units::mm3_per_ml, attempt.pressure / units::kPa_per_cmH2O};
  PetscCall(judge(t, measures.volume_change, attempt.pressure, solved));
  *accept = PetscBool(solved);
  if (!solved) {
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED)); // a shorter step would be solved no better
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (model_.memory() && scheme_.half_step()) {
    PetscCall(model_.memory()->compute(t, local_, rate_));
    model_.memory()->keep_middle();
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
    for (Partner *partner : partners_) partner->reject(verdict);
    PetscCall(keep_step(attempt.dt));
  }
  if (verdict == Verdict::shorter) PetscCall(reject(attempt.dt, why, 0, Measures(), false));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Holds what the state in local_ leaves of its equations against what they balance. Fills rate_ and local_residual_.
PetscErrorCode Simulation::judge(PetscReal t, PetscReal volume, PetscReal pressure, bool &solved)
{
  Vec F;
  Model::ResidualSums sums;
  Balance::Errors errors;

  PetscFunctionBeginUser;
  PetscCall(make_rate());
  PetscCall(local_residual(t));
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
  if (!solved) PetscCall(end_unsolved("the step to t = " + text.str() + " s was not solved", balance_.complaint()));
  if (solved && balance_.warns())
    PetscCall(PetscPrintf(options_.comm(),
                          "pulmo: warning: the step to t = %g s is hardly solved: the solver leaves %s\n", (double)t,
                          balance_.complaint().c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::end_unsolved(const std::string &what, const std::string &left)
{
  std::string cause;

  PetscFunctionBeginUser;
  PetscCall(options_.loosened(cause));
  const SceneFacts &facts = scene_.facts();
  const PetscReal L = scene_.mesh().length(), spread = facts.airflow ? scene_.airflow().permeability_at_rest() *
                                                                           model_.modulus() * wanted_dt_ / (L * L)
                                                                     : 0;
  if (spread > fast_gas) {
    std::ostringstream text;
    text.precision(3);
    text << "With the permeability of " << scene_.airflow().permeability_at_rest()
         << " mm^2/(kPa s) gas crosses a cell in " << 1 / spread
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
  PetscCall(heed_signal(TS_DIVERGED_STEP_REJECTED));
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
  if (again) {
    for (Partner *partner : partners_) partner->reject(Verdict::again);
    PetscCall(keep_step(dt));
  } else {
    PetscCall(reject(dt, reason, newton, measures, inverted));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::reject(PetscReal dt, const std::string &reason, PetscInt newton, const Measures &measures,
                                  bool inverted)
{
  TSAdapt adapt;

  PetscFunctionBeginUser;
  if (failures_.size() == max_failures) failures_.erase(failures_.begin());
  failures_.push_back({accepted_.time, dt, reason, newton, measures, inverted});
  cut_ = true;
  ++rejected_;
  for (Partner *partner : partners_) partner->reject(Verdict::shorter);
  PetscCall(TSRestartStep(ts_)); // BDF and -ts_theta_initial_guess_extrapolate must not look at a failed state
  PetscCall(TSGetAdapt(ts_, &adapt));
  const PetscReal next = dt * adapt->scale_solve_failed;
  if (next < std::max(adapt->dt_min, least_step * asked_dt()))
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  PetscCall(heed_signal(TS_DIVERGED_STEP_REJECTED));
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
  const bool landed = same(t, phase_->end) || same(t, phase_->begin + phase_->ramp);
  crawled_ = row.dt < crawling_step * asked_dt() && !landed && !failures_.empty() ? crawled_ + 1 : 0;
  if (crawled_ == 0) failures_.clear();

  // state and consistent flux of the accepted step
  PetscCall(airway_.apply(state_));
  PetscCall(predictor_.accept(state_));
  PetscCall(DMGlobalToLocal(model_.dm(), state_, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(airway_.pressure(local_, pressure));
  PetscCall(model_.measure(local_, measures));
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
  const bool phase_goes_on = !same(t, phase_ == &phases_.back() ? whole_end_ : phase_->end); // perhaps after a restart
  const bool kink = (same(t, phase_->begin + phase_->ramp) || kink_) && phase_goes_on;
  const PetscReal opening_flow = airway_.opening_flow(row.flow * units::mm3_per_ml);
  const Attempt accepted{t, row.dt, measures.volume_change, pressure, opening_flow, local_};
  for (Partner *partner : partners_) partner->accept(accepted);
  row.time = t;
  row.pressure = pressure / units::kPa_per_cmH2O;
  row.ventilator_pressure = airway_.ventilator_pressure(opening_flow) / units::kPa_per_cmH2O;
  list_scalars(row);
  row.phase = phase_->name;
  row.hold = airway_.holds_volume();
  row.breath = static_cast<int>(phase_->breath);
  row.newton = newton_;
  row.krylov = krylov_;
  row.min_J = measures.min_J;
  row.max_J = measures.max_J;
  newton_ = krylov_ = 0;
  const PetscReal lost = scheme_.flow(measures.volume_change) - row.flow * units::mm3_per_ml;
  delivered_ += (row.volume - accepted_.volume) * units::mm3_per_ml - lost / scheme_.slope();
  if (model_.memory()) {
    PetscCall(model_.memory()->compute(t, local_, rate_));
    model_.memory()->accept();
  }
  PetscCall(scheme_.accept(model_, moment(t, measures.volume_change, local_)));
  step_control_.accept({t, row.volume, row.pressure});
  balance_.accept();
  accepted_ = row;
  if (kink) {
    begin_smooth_stretch();
    PetscCall(TSRestartStep(ts_));
    if (step_control_.in_use()) PetscCall(TSSetTimeStep(ts_, landing(t)));
    PetscCall(TSGetTimeStep(ts_, &next_dt_));
  }
  PetscCall(report(row, measures));
  if (crawled_ == crawling_steps) PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  if (!same(t, end_)) PetscCall(heed_signal(TS_CONVERGED_USER));
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

PetscErrorCode Simulation::heed_signal(TSConvergedReason reason)
{
  PetscFunctionBeginUser;
  if (stop_signal_) PetscCall(stop_signal_->asked(stopped_));
  if (stopped_) PetscCall(TSSetConvergedReason(ts_, reason));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::report(const SignalRow &row, const Measures &measures)
{
  const Stopwatch clock(seconds_.output);
  const PetscReal balance = measures.volume_change - delivered_;

  PetscFunctionBeginUser;
  rows_.push_back(row);
  worst_balance_ = std::max(worst_balance_, std::abs(balance));
  min_J_ = std::min(min_J_, measures.min_J);
  const bool phase_ends = phase_ && same(row.time, phase_->end);
  const StepReport step{rows_, row, measures, balance, before_, local_residual_, end_, phase_ends, end_cuts_next()};
  for (Observer *observer : observers_) PetscCall(observer->observe(step));
  PetscFunctionReturn(PETSC_SUCCESS);
}

FailureFacts Simulation::failure_facts() const
{
  FailureFacts facts;
  facts.attempts = failures_;
  facts.rows = rows_;
  facts.crawled = crawled_ >= crawling_steps;
  facts.free_flow = airway_.mode() == Airway::Mode::free;
  facts.prescribes_pressure = phase_ && phase_->control == Control::pressure;
  if (phase_) facts.phase = phase_->name;
  return facts;
}

std::string Simulation::failure_text() const
{
  return unsolved_.empty() ? pulmo::failure_text(scene_, failure_facts(), diagnosis_) : unsolved_;
}

} // namespace pulmo
