#include "pulmo/solvers/lagging.hpp"

#include <petsc/private/snesimpl.h>

namespace pulmo {

PetscErrorCode Lagging::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("newton", "Newton steps");
  PetscCall(
      options.real("refresh", "-", Range::positive(),
                   "where -snes_lag_jacobian or -snes_lag_preconditioner keep old ones: a Newton step that leaves "
                   "more than this share of the residual brings new ones",
                   refresh_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Lagging::setup(SNES snes)
{
  PetscFunctionBeginUser;
  PetscCall(SNESGetLagJacobian(snes, &jacobian_));
  PetscCall(SNESGetLagPreconditioner(snes, &preconditioner_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Lagging::judge(SNES snes, PetscInt it, PetscReal norm)
{
  // PETSc makes new ones when the steps of this solve plus these counts are a multiple of the lag
  if (it == 0 && !snes->lagjac_persist) snes->jac_iter = 0;
  if (it == 0 && !snes->lagpre_persist) snes->pre_iter = 0;
  if (in_use() && it > 0 && norm > refresh_ * before_) snes->jac_iter = snes->pre_iter = -it;
  before_ = norm;
}

PetscErrorCode Lagging::retry(SNES snes, bool &again)
{
  PetscFunctionBeginUser;
  again = in_use() && !always_new_;
  if (again) PetscCall(stop_lagging(snes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Lagging::stop_lagging(SNES snes)
{
  PetscFunctionBeginUser;
  always_new_ = true;
  PetscCall(SNESSetLagJacobian(snes, 1));
  PetscCall(SNESSetLagPreconditioner(snes, 1));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Lagging::settle(SNES snes)
{
  PetscFunctionBeginUser;
  if (!always_new_) PetscFunctionReturn(PETSC_SUCCESS);
  always_new_ = false;
  PetscCall(SNESSetLagJacobian(snes, jacobian_));
  PetscCall(SNESSetLagPreconditioner(snes, preconditioner_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Lagging::outlasts_steps(SNES snes) const
{
  return (jacobian_ != 1 && snes->lagjac_persist) || (preconditioner_ != 1 && snes->lagpre_persist);
}

void Lagging::renew(SNES snes) const
{
  snes->jac_iter = snes->pre_iter = 0;
}

} // namespace pulmo
