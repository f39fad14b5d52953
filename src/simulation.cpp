#include "pulmo/simulation.hpp"

#include "pulmo/units.hpp"

#include <algorithm>
#include <cmath>
#include <petsc/private/snesimpl.h>
#include <petsc/private/tsimpl.h>
#include <sstream>

namespace pulmo {

namespace {

/// Two times closer than this share of the step are the same.
constexpr PetscReal same_time = 1e-9;

/// A step may be longer by this share to land on a time, so that no sliver of a step is left.
constexpr PetscReal stretch = 0.01;

/// A step cut below this share of the one asked for ends the run (-ts_adapt_dt_min may end it earlier).
constexpr PetscReal least_step = 1e-6;

/// So do as many accepted steps in a row below this share of the step asked for: the run only crawls towards a state
/// that it cannot pass.
constexpr PetscReal crawling_step = 1e-3;
constexpr int crawling_steps = 50;

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

PetscErrorCode ifunction(TS, PetscReal t, Vec X, Vec Xdot, Vec F, void *simulation)
{
  return static_cast<Simulation *>(simulation)->residual(t, X, Xdot, F);
}

PetscErrorCode ijacobian(TS, PetscReal t, Vec X, Vec Xdot, PetscReal shift, Mat A, Mat P, void *simulation)
{
  PetscFunctionBeginUser;
  PetscCall(static_cast<Simulation *>(simulation)->jacobian(t, X, Xdot, shift, P));
  if (A != P) { // -snes_mf_operator
    PetscCall(MatAssemblyBegin(A, MAT_FINAL_ASSEMBLY));
    PetscCall(MatAssemblyEnd(A, MAT_FINAL_ASSEMBLY));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode simulation_of(TS ts, Simulation **simulation)
{
  PetscFunctionBeginUser;
  PetscCall(TSGetApplicationContext(ts, simulation));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode pre_stage(TS ts, PetscReal t)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  PetscCall(simulation->before_stage(t));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode initial_guess(SNES snes, Vec X, void *simulation)
{
  return static_cast<Simulation *>(simulation)->guess(snes, X);
}

PetscErrorCode newton_step(SNESLineSearch search, Vec X, Vec Y, PetscBool *changed, void *simulation)
{
  SNES snes;

  PetscFunctionBeginUser;
  PetscCall(SNESLineSearchGetSNES(search, &snes));
  PetscCall(static_cast<Simulation *>(simulation)->border(snes, X, Y));
  *changed = PETSC_TRUE;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode newton_converged(SNES snes, PetscInt it, PetscReal xnorm, PetscReal ynorm, PetscReal fnorm,
                                SNESConvergedReason *reason, void *simulation)
{
  return static_cast<Simulation *>(simulation)->converged(snes, it, xnorm, ynorm, fnorm, reason);
}

PetscErrorCode post_stage(TS ts, PetscReal, PetscInt, Vec *)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  PetscCall(simulation->after_stage());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode post_step(TS ts)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  PetscCall(simulation->after_step());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode check_stage(TSAdapt, TS ts, PetscReal, Vec X, PetscBool *accept)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  PetscCall(simulation->accept_stage(X, accept));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode choose_step(TSAdapt adapt, TS ts, PetscReal h, PetscInt *next_scheme, PetscReal *next_h,
                           PetscBool *accept, PetscReal *wlte, PetscReal *wltea, PetscReal *wlter)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  *next_scheme = 0;
  *accept = PETSC_TRUE;
  *next_h = simulation->next_step(ts->ptime + h, h, adapt->clip[1]);
  *wlte = *wltea = *wlter = -1; // no error is estimated
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode create_step_control(TSAdapt adapt)
{
  PetscFunctionBeginUser;
  adapt->ops->choose = choose_step;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode register_step_control()
{
  PetscFunctionBeginUser;
  PetscCall(TSAdaptRegister("pulmo", create_step_control));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::declare(Options &options)
{
  PetscFunctionBeginUser;
  PetscCall(predictor_.declare(options));
  PetscCall(lagging_.declare(options));
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
  PetscCall(create_solver());
  phases_ = phases();
  end_ = phases_.back().end;
  dt_ = wanted_dt_;
  for (Phase &phase : phases_) {
    phase_ = &phase;
    // a jump of pressure takes the first step: where that one has to be cut, the jump is cut with it
    if (phase.control == Control::pressure && phase.ramp == 0) phase.ramp = landing(phase.begin);
  }
  phase_ = nullptr;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::create_solver()
{
  const MPI_Comm comm = options_.comm();
  SNES snes;
  KSP ksp;
  PC pc;
  TSAdapt adapt;
  PetscReal max_time;
  PetscInt max_steps;
  PetscBool own_control, is_beuler, has_pc, is_fieldsplit = PETSC_FALSE, is_lu = PETSC_FALSE;
  char pc_type[64] = "";

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(nullptr, nullptr, "-pc_type", pc_type, sizeof(pc_type), &has_pc));
  PulmoUserCheck(
      has_pc, comm,
      "no linear solver: give a solver file, e.g. -options_file petsc_options/solvers/direct.opts (or -pc_type)");
  PetscCall(PetscStrcmp(pc_type, PCFIELDSPLIT, &is_fieldsplit));
  PetscCall(PetscStrcmp(pc_type, PCLU, &is_lu));
  if (!is_lu) PetscCall(attach_rigid_body_modes(model_.dm())); // a factorisation has no use for them

  PetscCall(TSCreate(comm, ts_.out()));
  PetscCall(TSSetDM(ts_, model_.dm()));
  PetscCall(TSSetApplicationContext(ts_, this));
  PetscCall(TSSetIFunction(ts_, nullptr, ifunction, this));
  PetscCall(model_.create_matrix(matrix_.out()));
  PetscCall(TSSetIJacobian(ts_, matrix_, matrix_, ijacobian, this));
  PetscCall(TSSetProblemType(ts_, TS_NONLINEAR));
  PetscCall(TSSetType(ts_, TSBEULER));
  PetscCall(TSSetTimeStep(ts_, wanted_dt_));
  PetscCall(TSSetMaxTime(ts_, PETSC_MAX_REAL));
  PetscCall(TSSetMaxSteps(ts_, PETSC_MAX_INT));
  PetscCall(TSSetExactFinalTime(ts_, TS_EXACTFINALTIME_MATCHSTEP));
  PetscCall(TSSetMaxSNESFailures(ts_, -1));
  PetscCall(TSSetMaxStepRejections(ts_, -1)); // reject() knows when to give up
  PetscCall(TSSetErrorIfStepFails(ts_, PETSC_FALSE));
  PetscCall(TSSetPreStage(ts_, pre_stage));
  PetscCall(TSSetPostStage(ts_, post_stage));
  PetscCall(TSSetPostStep(ts_, post_step));
  PetscCall(TSGetAdapt(ts_, &adapt));
  PetscCall(TSAdaptSetType(adapt, "pulmo"));
  PetscCall(TSAdaptSetClip(adapt, 0.1, 2.0));
  PetscCall(TSAdaptSetCheckStage(adapt, check_stage));
  PetscCall(TSGetSNES(ts_, &snes));
  PetscCall(SNESGetKSP(snes, &ksp));
  if (is_fieldsplit && !scene_.facts().airflow) {
    // one field: what a solver file says of the displacement split preconditions the whole
    PetscCall(KSPGetPC(ksp, &pc));
    PetscCall(PCSetOptionsPrefix(pc, "fieldsplit_displacement_"));
  }
  PetscCall(SNESSetComputeInitialGuess(snes, initial_guess, this));
  PetscCall(TSSetFromOptions(ts_));
  PetscCall(offer_fixed_stress(ksp));
  PetscCall(lagging_.setup(snes));
  if (lagging_.in_use() || predictor_.in_use() ||
      (scene_.facts().ventilator && scene_.facts().ventilator->prescribes_flow()))
    PetscCall(SNESSetConvergenceTest(snes, newton_converged, this, nullptr));
  if (scene_.facts().common_pressure()) {
    SNESLineSearch search;
    PetscBool newton;
    PetscCall(PetscObjectTypeCompare((PetscObject)snes, SNESNEWTONLS, &newton));
    PulmoUserCheck(newton, comm,
                   "-snes_type: an airway pressure that is an unknown of its own needs Newton with line search; use "
                   "-snes_type newtonls");
    for (const char *option : {"-snes_mf", "-snes_mf_operator", "-snes_fd", "-snes_fd_color"}) {
      PetscBool given = PETSC_FALSE;
      PetscCall(PetscOptionsGetBool(nullptr, nullptr, option, &given, nullptr));
      PulmoUserCheck(!given, comm,
                     "%s: an airway pressure that is an unknown of its own needs the assembled Jacobian; "
                     "leave the option out",
                     option);
    }
    PetscCall(SNESGetLineSearch(snes, &search));
    PetscCall(SNESLineSearchSetPreCheck(search, newton_step, this));
    PetscCall(VecDuplicate(state_, border_x_.out()));
    PetscCall(VecDuplicate(state_, border_b_.out()));
    PetscCall(VecDuplicate(state_, border_z_.out()));
    PetscCall(VecDuplicate(local_, border_y_.out()));
  }
  PetscCall(TSGetTimeStep(ts_, &wanted_dt_));
  PulmoUserCheck(wanted_dt_ > 0, comm, "-ts_dt %g s must be positive", (double)wanted_dt_);
  PetscCall(TSGetMaxTime(ts_, &max_time));
  PetscCall(TSGetMaxSteps(ts_, &max_steps));
  PulmoUserCheck(max_steps == PETSC_MAX_INT, comm, "-ts_max_steps would cut a phase short; use -ts_max_time");
  PetscCall(PetscObjectTypeCompare((PetscObject)adapt, "pulmo", &own_control));
  PulmoUserCheck(own_control, comm, "-ts_adapt_type: pulmo cuts, regrows and lands steps itself; leave the option out");
  PulmoUserCheck(max_time > 0, comm, "-ts_max_time %g s leaves nothing to run; it must be positive", (double)max_time);
  PetscCall(PetscObjectTypeCompare((PetscObject)(TS)ts_, TSBEULER, &is_beuler));
  PulmoUserCheck(is_beuler, comm,
                 "-ts_type: the conservative rate of porosity is exact for backward Euler only; use -ts_type beuler");
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Gives `-pc_fieldsplit_schur_precondition user` its matrix.
PetscErrorCode Simulation::offer_fixed_stress(KSP ksp)
{
  PC pc;
  PetscBool fieldsplit;
  PCFieldSplitSchurPreType type;
  Mat none;

  PetscFunctionBeginUser;
  PetscCall(KSPGetPC(ksp, &pc));
  PetscCall(PetscObjectTypeCompare((PetscObject)pc, PCFIELDSPLIT, &fieldsplit));
  if (!fieldsplit || !scene_.facts().airflow) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PCFieldSplitGetSchurPre(pc, &type, &none));
  if (type != PC_FIELDSPLIT_SCHUR_PRE_USER) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(model_.use_fixed_stress());
  PetscCall(PCFieldSplitSetSchurPre(pc, type, model_.fixed_stress()));
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
  return std::abs(t - other) <= same_time * wanted_dt_;
}

PetscReal Simulation::landing(PetscReal t) const
{
  for (const PetscReal stop : {phase_->begin + phase_->ramp, phase_->end})
    if (t < stop && !same(t, stop) && t + (1 + stretch) * dt_ > stop) return stop - t;
  return dt_;
}

PetscReal Simulation::next_step(PetscReal t, PetscReal h, PetscReal growth)
{
  if (cut_)
    dt_ = h; // it took cuts to get here
  else if (h >= dt_ * (1 - same_time))
    dt_ = std::min(wanted_dt_, growth * dt_); // a full step: grow back
  return landing(t);
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
  PetscCall(report(accepted_, measures));
  dt_ = wanted_dt_;
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
    phase_ = &phase;
    if (!within) {
      airway_.begin_phase(phase, accepted_.volume * units::mm3_per_ml);
      next_dt_ = landing(phase.begin);
    }
    PetscCall(TSSetTime(ts_, within ? accepted_.time : phase.begin));
    PetscCall(TSSetMaxTime(ts_, phase.end));
    PetscCall(TSSetTimeStep(ts_, next_dt_));
    PetscCall(TSSolve(ts_, state_));
    PetscCall(TSGetConvergedReason(ts_, &reason));
    if (reason < 0 || stopped_) {
      finished = false;
      break;
    }
  }
  PetscCall(PetscTime(&end));
  seconds_.total = end - begin + seconds_.setup;
  seconds_.solve = end - begin - seconds_.residual - seconds_.jacobian - seconds_.output;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &seconds_, 6, MPI_DOUBLE, MPI_MAX, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::before_stage(PetscReal t)
{
  PetscReal dt;

  PetscFunctionBeginUser;
  PetscCall(TSGetTimeStep(ts_, &dt));
  airway_.begin_step(t, dt);
  extra_newton_ = 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Fills local_ and rate_ from global vectors at time t.
PetscErrorCode Simulation::scatter(PetscReal t, Vec X, Vec Xdot)
{
  PetscReal dt;

  PetscFunctionBeginUser;
  PetscCall(TSGetTimeStep(ts_, &dt));
  PetscCall(airway_.apply(X));
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(DMGlobalToLocal(model_.dm(), Xdot, INSERT_VALUES, rate_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(model_.constrain_rate(local_, before_, dt, rate_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::residual(PetscReal t, Vec X, Vec Xdot, Vec F)
{
  const Stopwatch clock(seconds_.residual);
  Measures measures;

  PetscFunctionBeginUser;
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
  PetscCall(model_.residual(t, local_, rate_, local_residual_));
  PetscCall(VecZeroEntries(F));
  PetscCall(DMLocalToGlobal(model_.dm(), local_residual_, ADD_VALUES, F));
  PetscCall(airway_.close(measures.volume_change, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// With J y = F known, solves J z = dF/dP and steps to the P for which the linearised scalar equation holds.
PetscErrorCode Simulation::border(SNES snes, Vec X, Vec Y)
{
  constexpr PetscReal share = 1e-4; // every term so far is linear in P: the difference quotient is then exact
  Vec F;
  KSP ksp;
  PetscInt iterations;
  PetscReal P, along_y, along_z, here, there;

  PetscFunctionBeginUser;
  if (airway_.mode() != Airway::Mode::common) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(airway_.apply(X));
  PetscCall(airway_.pressure(local_, P));
  const PetscReal dP = share * std::max(model_.modulus(), std::abs(P));
  PetscCall(SNESGetFunction(snes, &F, nullptr, nullptr));
  PetscCall(VecCopy(X, border_x_));
  PetscCall(model_.set_airway_nodes(border_x_, P + dP));
  PetscCall(SNESComputeFunction(snes, border_x_, border_b_));
  PetscCall(model_.carrier_value(F, here));
  PetscCall(model_.carrier_value(border_b_, there));
  PetscCall(VecAXPBY(border_b_, -1 / dP, 1 / dP, F));
  PetscCall(model_.set_airway_nodes(border_b_, 0));
  PetscCall(VecZeroEntries(border_z_));
  PetscCall(SNESGetKSP(snes, &ksp));
  PetscCall(KSPSolve(ksp, border_b_, border_z_));
  PetscCall(KSPGetIterationNumber(ksp, &iterations));
  krylov_ += iterations;

  PetscCall(VecZeroEntries(border_y_)); // constrained values do not change
  PetscCall(DMGlobalToLocal(model_.dm(), Y, INSERT_VALUES, border_y_));
  PetscCall(model_.volume_derivative(local_, border_y_, along_y));
  PetscCall(DMGlobalToLocal(model_.dm(), border_z_, INSERT_VALUES, border_y_));
  PetscCall(model_.volume_derivative(local_, border_y_, along_z));
  const PetscReal change = airway_.change(here, (there - here) / dP, -along_y, -along_z);
  PetscCall(VecAXPY(Y, change, border_z_));
  PetscCall(model_.set_airway_nodes(Y, -change)); // the new state is X - Y
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::guess(SNES snes, Vec X)
{
  PetscFunctionBeginUser;
  PetscCall(airway_.guess(X));
  if (!predictor_.in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  const auto hold = [this](Vec increment) -> PetscErrorCode {
    PetscFunctionBeginUser;
    if (airway_.mode() == Airway::Mode::held) PetscCall(model_.set_airway_nodes(increment, 0));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
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

PetscErrorCode Simulation::jacobian(PetscReal t, Vec X, Vec Xdot, PetscReal shift, Mat A)
{
  const Stopwatch clock(seconds_.jacobian);

  PetscFunctionBeginUser;
  PetscCall(scatter(t, X, Xdot));
  PetscCall(model_.jacobian(t, local_, rate_, shift, A));
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

PetscErrorCode Simulation::accept_stage(Vec X, PetscBool *accept)
{
  Measures measures;
  PetscReal t, dt;

  PetscFunctionBeginUser;
  PetscCall(TSGetTime(ts_, &t));
  PetscCall(TSGetTimeStep(ts_, &dt));
  PetscCall(airway_.apply(X));
  PetscCall(DMGlobalToLocal(model_.dm(), X, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t + dt, local_));
  PetscCall(model_.measure(local_, measures));
  *accept = PetscBool(measures.min_J > 0);
  if (!*accept) PetscCall(fail(dt, "converged to a state with J <= 0", 0, measures, true, true));
  if (*accept) {
    PetscReal pressure;
    PetscCall(airway_.pressure(local_, pressure));
    const PetscReal flow = (measures.volume_change - accepted_.volume * units::mm3_per_ml) / dt;
    if (airway_.limit(flow)) { // the step is taken again, as long as it was: a shorter one would let the flow overshoot
      PetscCall(keep_step(dt));
      *accept = PETSC_FALSE;
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Lets a step that is taken again be as long as it was, where PETSc would cut it.
PetscErrorCode Simulation::keep_step(PetscReal dt)
{
  TSAdapt adapt;

  PetscFunctionBeginUser;
  PetscCall(TSRestartStep(ts_)); // as in reject()
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
    airway_.again();
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
  PetscCall(TSRestartStep(ts_)); // if -ts_theta_initial_guess_extrapolate is on: not from a failed state
  PetscCall(TSGetAdapt(ts_, &adapt));
  const PetscReal next = dt * adapt->scale_solve_failed;
  if (next < std::max(adapt->dt_min, least_step * wanted_dt_))
    PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  PetscCall(heed_signal());
  if (stopped_) PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
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
  crawled_ = row.dt < crawling_step * wanted_dt_ && !landed ? crawled_ + 1 : 0;
  if (crawled_ == 0) failures_.clear();

  // state and consistent flux of the accepted step
  PetscCall(airway_.apply(state_));
  PetscCall(predictor_.accept(state_));
  PetscCall(DMGlobalToLocal(model_.dm(), state_, INSERT_VALUES, local_));
  PetscCall(model_.constrain(t, local_));
  PetscCall(airway_.pressure(local_, pressure));
  PetscCall(VecWAXPY(rate_, -1, before_, local_));
  PetscCall(VecScale(rate_, 1 / row.dt));
  PetscCall(model_.measure(local_, measures));
  row.volume = measures.volume_change / units::mm3_per_ml;
  const bool free = airway_.mode() == Airway::Mode::free, airflow = scene_.facts().airflow,
             supported = model_.composition().supported();
  if ((airflow && !free) || supported) PetscCall(model_.residual(t, local_, rate_, local_residual_));
  if (supported) {
    std::vector<std::array<PetscReal, 3>> forces;
    PetscCall(model_.reactions(local_residual_, forces));
    for (const auto &force : forces)
      for (const PetscReal f : force) worst_reaction_ = std::max(worst_reaction_, std::abs(f));
  }
  if (free) {
    row.flow = airway_.flow() / units::mm3_per_ml;
  } else if (airflow) {
    PetscReal flow;
    PetscCall(model_.airway_flow(local_residual_, flow));
    row.flow = flow / units::mm3_per_ml;
  } else {
    row.flow = (row.volume - accepted_.volume) / row.dt;
  }
  PetscCall(VecCopy(local_, before_));
  airway_.accept(measures.volume_change, row.flow * units::mm3_per_ml);
  row.time = t;
  row.pressure = pressure / units::kPa_per_cmH2O;
  row.ventilator_pressure = airway_.ventilator_pressure(row.flow * units::mm3_per_ml) / units::kPa_per_cmH2O;
  row.phase = phase_->name;
  row.hold = airway_.holds_volume();
  row.breath = static_cast<int>(phase_->breath);
  row.newton = newton_;
  row.krylov = krylov_;
  row.min_J = measures.min_J;
  row.max_J = measures.max_J;
  newton_ = krylov_ = 0;
  delivered_ += row.dt * row.flow * units::mm3_per_ml;
  accepted_ = row;
  PetscCall(report(row, measures));
  if (crawled_ == crawling_steps) PetscCall(TSSetConvergedReason(ts_, TS_DIVERGED_STEP_REJECTED));
  if (!same(t, end_)) PetscCall(heed_signal());
  if (stopped_) PetscCall(TSSetConvergedReason(ts_, TS_CONVERGED_USER));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::heed_signal()
{
  PetscFunctionBeginUser;
  if (stop_signal_) PetscCall(stop_signal_->asked(stopped_));
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
  const StepReport step{rows_, row, measures, balance, before_, end_, phase_ends};
  for (Observer *observer : observers_) PetscCall(observer->observe(step));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Simulation::failure_text() const
{
  std::ostringstream text;
  text.precision(6);
  text << (crawled_ >= crawling_steps ? "steps only crawl at t = " : "no step could be accepted after t = ")
       << accepted_.time << " s (phase " << (phase_ ? phase_->name : "run") << ", airway pressure "
       << accepted_.pressure << " cmH2O, volume " << accepted_.volume << " ml, tissue law "
       << scene_.tissue().law().name() << ", smallest J " << accepted_.min_J << ").";
  const auto inverted = std::find_if(failures_.rbegin(), failures_.rend(), [](const auto &f) { return f.inverted; });
  if (inverted != failures_.rend())
    text << " The tissue turned inside out: J = " << inverted->measures.min_J << " in the cell at ("
         << inverted->measures.where[0] << ", " << inverted->measures.where[1] << ", " << inverted->measures.where[2]
         << ") mm (cell " << inverted->measures.cell << " of rank " << inverted->measures.rank << ").";
  text << " Tried";
  for (const FailedAttempt &f : failures_) {
    text << (&f == &failures_.front() ? " " : ", ") << "dt " << f.dt << " s (" << f.reason;
    if (f.newton > 0) text << " after " << f.newton << " Newton steps" << (f.inverted ? ", J <= 0 on the way" : "");
    text << ")";
  }
  text << ". What to try: ";
  if (inverted != failures_.rend())
    text << "-lumen_pressure if that cell is at the airway, a finer mesh there, a slower rise of pressure or flow, "
            "another -tissue; the law may have no equilibrium at this pressure.";
  else
    text << "another file of petsc_options/solvers, a smaller -ts_dt, a larger -snes_max_it, a slower rise of pressure "
            "or flow; -snes_monitor and -ksp_monitor show where it stalls; the law may have no equilibrium at this "
            "pressure.";
  return text.str();
}

} // namespace pulmo
