// The solvers of a simulation: TS, SNES and KSP as the options say, and what they call back.
#include "pulmo/time/simulation.hpp"

#include "pulmo/base/attached.hpp"
#include "pulmo/solvers/displacement_block.hpp"
#include "pulmo/solvers/p_multigrid.hpp"
#include "pulmo/solvers/preconditioning.hpp"
#include "pulmo/solvers/rigid_body_modes.hpp"

#include <petsc/private/tsimpl.h>

namespace pulmo {

namespace {

PetscErrorCode ifunction(TS, PetscReal t, Vec X, Vec Xdot, Vec F, void *simulation)
{
  return static_cast<Simulation *>(simulation)->residual(t, X, Xdot, F);
}

PetscErrorCode ijacobian(TS, PetscReal t, Vec X, Vec Xdot, PetscReal, Mat A, Mat P, void *simulation)
{
  PetscFunctionBeginUser;
  PetscCall(static_cast<Simulation *>(simulation)->jacobian(t, X, Xdot, P));
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

/// The first of some switches that is on; empty if none is.
PetscErrorCode first_on(std::initializer_list<const char *> options, std::string &first)
{
  PetscFunctionBeginUser;
  first.clear();
  for (const char *option : options) {
    PetscBool on = PETSC_FALSE;
    PetscCall(PetscOptionsGetBool(nullptr, nullptr, option, &on, nullptr));
    if (on && first.empty()) first = option;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The option that has PETSc make the Jacobian by differences; empty if none does.
PetscErrorCode by_differences(std::string &option)
{
  return first_on({"-snes_fd", "-snes_fd_color"}, option);
}

constexpr const char *owner = "pulmo_simulation"; ///< of a matrix that is composed with it

PetscErrorCode matrix_product(Mat A, Vec x, Vec y)
{
  Simulation *simulation = nullptr;

  PetscFunctionBeginUser;
  PetscCall(find_attached((PetscObject)A, owner, &simulation));
  PetscCheck(simulation, PetscObjectComm((PetscObject)A), PETSC_ERR_SUP, "a copy of a bordered Jacobian");
  PetscCall(simulation->product(x, y));
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

PetscErrorCode check_stage(TSAdapt, TS ts, PetscReal t, Vec X, PetscBool *accept)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  PetscCall(simulation->accept_stage(t, X, accept));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode choose_step(TSAdapt adapt, TS ts, PetscReal h, PetscInt *next_scheme, PetscReal *next_h,
                           PetscBool *accept, PetscReal *wlte, PetscReal *wltea, PetscReal *wlter)
{
  Simulation *simulation;

  PetscFunctionBeginUser;
  PetscCall(simulation_of(ts, &simulation));
  *next_scheme = 0;
  *next_h = simulation->next_step(ts->ptime, h, adapt, *accept);
  *wlte = *wltea = *wlter = -1; // PETSc is told no error
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

PetscErrorCode Simulation::create_solver()
{
  const MPI_Comm comm = options_.comm();
  SNES snes;
  KSP ksp;
  TSAdapt adapt;
  std::string pc_type;

  PetscFunctionBeginUser;
  PetscCall(wanted_pc(comm, pc_type));
  PulmoUserCheck(
      pc_type != PCCHOLESKY || !scene_.facts().airflow, comm,
      "-pc_type cholesky needs a symmetric matrix, and that of a scene with airflow is not; use -pc_type lu");
  if (pc_type != PCLU) PetscCall(attach_rigid_body_modes(model_.dm())); // a factorisation has no use for them

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
  if (!scene_.facts().airflow) PetscCall(precondition_one_field(ksp));
  PetscCall(SNESSetComputeInitialGuess(snes, initial_guess, this));
  PetscCall(compat::set_from_options(ts_));
  PetscCall(offer_fixed_stress(ksp));
  PetscCall(offer_view(ksp, pc_type));
  PetscCall(lagging_.setup(snes));
  PetscCall(SNESSetConvergenceHistory(snes, nullptr, nullptr, PETSC_DECIDE, PETSC_TRUE));
  PetscBool tests_jacobian;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-snes_test_jacobian", &tests_jacobian));
  tests_jacobian_ = tests_jacobian;
  if (lagging_.in_use() || predictor_.in_use() || scene_.facts().flow_past_limit_points ||
      (scene_.facts().ventilator && scene_.facts().ventilator->prescribes_flow()))
    PetscCall(SNESSetConvergenceTest(snes, newton_converged, this, nullptr));
  if (scene_.facts().unknown_opening_pressure()) {
    PulmoUserCheck(model_.airway().homeless() == 0, comm,
                   "-%s has more branches than the airway has nodes in the mesh (%d too many): refine the "
                   "surfaces of -airflow_surfaces, or join branches that follow one another",
                   scene_.facts().surface_pressures_by.c_str(), (int)model_.airway().homeless());
    SNESLineSearch search;
    PetscBool newton;
    SNESType type;
    const SceneFacts &facts = scene_.facts();
    const bool limits = facts.ventilator->limits_pressure(), split = facts.airflow && !facts.tube && !limits &&
                                                                     !facts.flow_past_limit_points &&
                                                                     facts.surface_pressures_by.empty();
    PetscCall(PetscObjectTypeCompare((PetscObject)snes, SNESNEWTONLS, &newton));
    PetscCall(SNESGetType(snes, &type));
    PulmoUserCheck(
        newton, comm,
        "option -snes_type %s does not go with %s: there the airway pressure is an unknown of its own, which "
        "needs Newton with line search; use -snes_type newtonls%s",
        type,
        !facts.surface_pressures_by.empty() ? ("-" + facts.surface_pressures_by).c_str()
        : facts.tube                        ? "-tube"
        : limits                            ? "a limit of pressure"
        : facts.flow_past_limit_points      ? "-ventilator_on_limit_point flow"
        : split                             ? "-ventilator_flow_split common_pressure"
                                            : "a flow into a lung with -airflow off",
        split ? ", or -ventilator_flow_split uniform" : "");
    std::string other;
    PetscCall(first_on({"-snes_mf", "-snes_mf_operator", "-snes_fd", "-snes_fd_color"}, other));
    PulmoUserCheck(other.empty(), comm,
                   "%s: an airway pressure that is an unknown of its own needs the assembled Jacobian; "
                   "leave the option out",
                   other.c_str());
    PetscCall(SNESGetLineSearch(snes, &search));
    PetscCall(SNESLineSearchSetPreCheck(search, newton_step, this));
    // the search for a smaller residual multiplies by the matrix to know the slope
    PetscCall(attach_pointer((PetscObject)(Mat)matrix_, owner, this));
    PetscCall(MatGetOperation(matrix_, MATOP_MULT, &multiply_));
    PetscCall(MatSetOperation(matrix_, MATOP_MULT, (void (*)())matrix_product));
  }
  PetscCall(TSGetTimeStep(ts_, &wanted_dt_));
  PetscBool limits_steps;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-ts_adapt_dt_max", &limits_steps));
  PulmoUserCheck(!limits_steps || step_control_.in_use(), comm,
                 "-ts_adapt_dt_max: steps do not grow beyond -ts_dt unless their error chooses them; lower -ts_dt, or "
                 "give -step_volume_tolerance and -step_pressure_tolerance");
  for (const StepBound &bound : step_control_.bounds())
    PulmoUserCheck(
        !bound.in_use() || bound.quantity != StepBound::Quantity::pressure || scene_.facts().airflow ||
            scene_.facts().ventilator,
        comm, "%s: this scene has no gas whose pressure could change; add -airflow or a -ventilator, or leave it out",
        bound.option);
  if (adapt->dt_min > wanted_dt_)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: -ts_adapt_dt_min %g s is longer than -ts_dt %g s: no step can be cut, and "
                          "the first one that fails ends the run; lower it\n",
                          (double)adapt->dt_min, (double)wanted_dt_));
  PetscCall(scheme_.setup(ts_, local_));
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
  PetscErrorCode (*has_schur)(void) = nullptr;
  PetscCall(PetscObjectQueryFunction((PetscObject)pc, "PCFieldSplitGetSchurPre_C", &has_schur));
  if (!has_schur) PetscFunctionReturn(PETSC_SUCCESS); // another -pc_fieldsplit_type
  PetscCall(PCFieldSplitGetSchurPre(pc, &type, &none));
  if (type != PC_FIELDSPLIT_SCHUR_PRE_USER) PetscFunctionReturn(PETSC_SUCCESS);
  PulmoUserCheck(model_.own_integration(), options_.comm(),
                 "-pc_fieldsplit_schur_precondition user needs pulmo's own integration; leave -petscfe_type out");
  std::string differences;
  PetscCall(by_differences(differences));
  PulmoUserCheck(
      differences.empty(), options_.comm(),
      "-pc_fieldsplit_schur_precondition user is made of pulmo's own Jacobian, and %s makes another; leave it "
      "out, or take a file such as petsc_options/solvers/direct.opts",
      differences.c_str());
  PetscCall(fixed_stress_.setup(model_.dm(), model_.assembly()));
  model_.also_fill(fixed_stress_);
  PetscCall(PCFieldSplitSetSchurPre(pc, type, fixed_stress_.matrix()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Where the displacement's preconditioner needs no copy of its block, none is made.
PetscErrorCode Simulation::offer_view(KSP ksp, const std::string &pc_type)
{
  PC pc;
  PetscBool fieldsplit, scales;
  bool reads, fits;
  std::string differences;

  PetscFunctionBeginUser;
  if (pc_type != PCFIELDSPLIT) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(reads_in_place("fieldsplit_displacement_", matrix_, reads));
  PetscCall(KSPGetPC(ksp, &pc));
  PetscCall(PetscObjectTypeCompare((PetscObject)pc, PCFIELDSPLIT, &fieldsplit)); // not where there is one field
  // where another Jacobian is made, or this one is changed afterwards, the cells' own matrices say nothing of it
  PetscCall(by_differences(differences));
  PetscCall(KSPGetDiagonalScale(ksp, &scales));
  if (!reads || !fieldsplit || scales || !differences.empty() || !scene_.facts().airflow || !model_.own_integration())
    PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(p1_.setup(model_.dm(), model_.assembly(), fits));
  if (!fits) PetscFunctionReturn(PETSC_SUCCESS);
  model_.also_fill(p1_);
  PetscCall(view_displacement(matrix_, model_.field_rows(displacement), p1_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
