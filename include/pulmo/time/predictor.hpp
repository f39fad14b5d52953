/// @file
/// The first guess of a time step, from the increments of the steps before it.
#pragma once

#include "pulmo/fem/archive.hpp"

#include <functional>
#include <vector>

namespace pulmo {

/// Starts Newton at X + sum a_i d_i: d_i are the last accepted increments, a_i minimise the residual that the secants
/// F(X + d_i) - F(X) foresee. Steps of the same length have left their secants behind: each took the residual that it
/// began with to nothing. Where none has, they are evaluated. A guess that does not lower the residual is dropped, so
/// that a kink in time (a new phase, a reached limit) costs some residuals and no more.
class Predictor {
public:
  /// Declares -predictor_increments.
  PetscErrorCode declare(Options &options);
  PetscErrorCode setup(Vec like);
  bool in_use() const { return increments_ > 0; }

  /// Begins a run at state @p X.
  PetscErrorCode begin(Vec X);
  /// Writes or reads the increments that led to state @p X and their secants; reads as many as are in use.
  PetscErrorCode persist(Archive &archive, Vec X);
  /// Takes note of an accepted state.
  PetscErrorCode accept(Vec X);
  /// Improves @p X, the state that a step starts from with the prescribed values of its end in place, and hands its
  /// residual to @p snes. @p hold zeroes the prescribed values in an increment. @p norm: of the residual at the start.
  /// @p slope: how the step makes rates of states (Stage), 1/s; 0: secants of other steps are of no use. @p trusted: if
  /// not, X remains as it is.
  PetscErrorCode improve(SNES snes, const std::function<PetscErrorCode(Vec)> &hold, PetscReal slope, bool trusted,
                         Vec X, PetscReal &norm);

private:
  PetscInt increments_ = 0, known_ = 0; ///< how many to use; how many there are
  VecHandle last_;                      ///< the last accepted state
  VecHandle start_, residual_, foreseen_;
  std::vector<VecHandle> increment_, change_; ///< the last one first; what each changed the residual of its step by
  std::vector<PetscReal> slope_;              ///< of these steps, 1/s; 0: the change is of no use
  PetscReal tried_ = 0;                       ///< that of the step at hand
  std::vector<VecHandle> direction_, secant_; ///< secants orthonormal
};

} // namespace pulmo
