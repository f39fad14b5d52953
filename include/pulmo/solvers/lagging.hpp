/// @file
/// Jacobians and preconditioners kept over Newton steps: when an old one no longer serves.
#pragma once

#include "pulmo/input/options.hpp"

namespace pulmo {

/// Completes PETSc's `-snes_lag_jacobian N` and `-snes_lag_preconditioner N`, which make new ones after N Newton steps:
/// a Newton step that left too much of the residual brings new ones at once, and a step in time that failed with old
/// ones is tried again, as long as it was, with new ones in every Newton step. Does nothing unless an N is above 1.
class Lagging {
public:
  /// Declares -newton_refresh.
  PetscErrorCode declare(Options &options);
  PetscErrorCode setup(SNES snes);
  bool in_use() const { return jacobian_ > 1 || preconditioner_ > 1; }

  /// After Newton step @p it (0: before the first one) with residual norm @p norm.
  void judge(SNES snes, PetscInt it, PetscReal norm);
  /// An attempt failed. @p again: the same step is to be tried once more; nothing lags then until settle().
  PetscErrorCode retry(SNES snes, bool &again);
  /// A step was accepted.
  PetscErrorCode settle(SNES snes);
  /// Whether a step may begin with a Jacobian or a preconditioner of an earlier one.
  bool outlasts_steps(SNES snes) const;
  /// The next solve begins with new ones.
  void renew(SNES snes) const;
  /// Whether nothing lags in the attempt at hand; and makes it so.
  bool always_new() const { return always_new_; }
  PetscErrorCode stop_lagging(SNES snes);

private:
  PetscReal refresh_ = 0.1;
  PetscInt jacobian_ = 1, preconditioner_ = 1; ///< as the options have them
  PetscReal before_ = 0;                       ///< residual norm before the last Newton step
  bool always_new_ = false;                    ///< in the attempt at hand nothing lags
};

} // namespace pulmo
