// The nonlinear system of a step: residual, Jacobian, Newton's step and first guess.
#include "pulmo/time/simulation.hpp"

#include "pulmo/base/stopwatch.hpp"

#include <algorithm>
#include <cstring>
#include <petsc/private/snesimpl.h>

namespace pulmo {

namespace {

/// Newton steps that a prescribed volume may ask for beyond PETSc's tests (rounding may keep it from being met).
constexpr int max_extra_newton = 3;

} // namespace

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
  evaluated_.known = false;
  PetscCall(model_.residual(t, local_, rate_, local_residual_));
  PetscCall(scheme_.add_past(model_, local_residual_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether local_ at time @p t is what residual() was asked for last; Newton's last state mostly is. Collective.
PetscErrorCode Simulation::is_evaluated(PetscReal t, bool &evaluated) const
{
  PetscBool same = PETSC_FALSE;

  PetscFunctionBeginUser;
  evaluated = evaluated_.known && evaluated_.t == t && std::memcmp(&evaluated_.step, &model_.step(), sizeof(Step)) == 0;
  if (!evaluated) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(VecEqual(local_, evaluated_.local, &same)); // each rank's own
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &same, 1, MPI_INT, MPI_LAND, options_.comm()));
  evaluated = same;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What the state in local_ at time @p t measures.
PetscErrorCode Simulation::measure(PetscReal t, Measures &measures) const
{
  bool evaluated;

  PetscFunctionBeginUser;
  PetscCall(is_evaluated(t, evaluated));
  if (evaluated)
    measures = evaluated_.measures;
  else
    PetscCall(model_.measure(local_, measures));
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
  if (!(measures.min_J_points > 0 && measures.min_air_points > 0)) {
    SNES snes;
    inverted_ = true;
    inverted_measures_ = measures;
    PetscCall(TSGetSNES(ts_, &snes));
    PetscCall(SNESSetFunctionDomainError(snes));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(local_residual(t));
  PetscCall(VecCopy(local_, evaluated_.local));
  evaluated_.t = t;
  evaluated_.step = model_.step();
  evaluated_.measures = measures;
  evaluated_.known = true;
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
  // with an opening pressure among the unknowns steps move more than the vector of them says
  const PetscReal slope = airway_.mode() == Airway::Mode::solved ? 0 : scheme_.slope();
  // past increments may have led the attempt before this one to where Newton found no way out
  const bool trusted = failures_.empty() && !lagging_.always_new();
  PetscCall(predictor_.improve(snes, hold, slope, trusted, X, start_norm_));
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

} // namespace pulmo
