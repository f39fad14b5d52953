#include "pulmo/time/predictor.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A secant that is shorter than this share of itself after the others were taken out of it says nothing new.
constexpr PetscReal independent = 1e-6;

/// So many secants are evaluated at most, a residual each; those that steps left behind cost nothing.
constexpr PetscInt most_evaluated = 3;

/// Norm of the residual F(X); infinite where it is not defined (J <= 0, no air).
PetscErrorCode residual_norm(SNES snes, Vec X, Vec F, PetscReal &norm)
{
  PetscFunctionBeginUser;
  PetscCall(SNESComputeFunction(snes, X, F));
  PetscCall(VecNorm(F, NORM_2, &norm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Predictor::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("predictor", "first guess of a time step");
  PetscCall(options.whole("increments", "-", Range::between(0, 10),
                          "past increments that the first guess of a step is made of (0: the last state)",
                          increments_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Predictor::setup(Vec like)
{
  PetscFunctionBeginUser;
  if (increments_ == 0) PetscFunctionReturn(PETSC_SUCCESS);
  for (VecHandle *v : {&start_, &last_, &residual_, &foreseen_}) PetscCall(VecDuplicate(like, v->out()));
  for (std::vector<VecHandle> *list : {&increment_, &change_, &direction_, &secant_}) {
    list->resize(increments_);
    for (VecHandle &v : *list) PetscCall(VecDuplicate(like, v.out()));
  }
  slope_.assign(increments_, 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Predictor::begin(Vec X)
{
  PetscFunctionBeginUser;
  known_ = 0;
  if (in_use()) PetscCall(VecCopy(X, last_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Predictor::persist(Archive &archive, Vec X)
{
  PetscInt known = known_;

  PetscFunctionBeginUser;
  PetscCall(archive.value("predictor/increments", known));
  if (archive.reading()) {
    PetscCall(begin(X));
    known_ = std::min(known, increments_);
  }
  for (PetscInt i = 0; i < known_; ++i) {
    const std::string number = std::to_string(i + 1);
    PetscCall(archive.global("increment_" + number, increment_[i]));
    PetscCall(archive.value("predictor/slope_" + number, slope_[i]));
    if (slope_[i] > 0) PetscCall(archive.global("residual_change_" + number, change_[i]));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Predictor::accept(Vec X)
{
  PetscFunctionBeginUser;
  if (!in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  for (auto *list : {&increment_, &change_}) std::rotate(list->begin(), list->end() - 1, list->end());
  std::rotate(slope_.begin(), slope_.end() - 1, slope_.end());
  PetscCall(VecWAXPY(increment_.front(), -1, last_, X));
  PetscCall(VecAXPBY(change_.front(), -1, 0, residual_)); // the step took the residual that it began with to nothing
  slope_.front() = tried_;
  PetscCall(VecCopy(X, last_));
  known_ = std::min<PetscInt>(known_ + 1, increments_);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Predictor::improve(SNES snes, const std::function<PetscErrorCode(Vec)> &hold, PetscReal slope,
                                  bool trusted, Vec X, PetscReal &norm)
{
  PetscReal guess_norm;
  PetscInt n = 0;

  PetscFunctionBeginUser;
  PetscCall(VecCopy(X, start_));
  PetscCall(residual_norm(snes, X, residual_, norm));
  tried_ = std::isfinite(norm) ? slope : 0;
  PetscCall(VecCopy(residual_, foreseen_));
  PetscInt recorded = 0; // not mixed with what is evaluated: secants of two kinds foresee less well
  while (slope > 0 && recorded < known_ && slope_[recorded] == slope) ++recorded;
  const PetscInt used = !trusted ? 0 : recorded > 0 ? recorded : std::min(known_, most_evaluated);
  for (PetscInt i = 0; i < used && std::isfinite(norm); ++i) {
    const Vec d = direction_[n], s = secant_[n];
    PetscReal before, after;
    PetscScalar along;
    PetscCall(VecCopy(increment_[i], d));
    PetscCall(hold(d));
    if (recorded > 0) {
      PetscCall(VecCopy(change_[i], s));
    } else {
      PetscCall(VecAXPY(d, 1, start_));
      PetscCall(residual_norm(snes, d, s, before));
      if (!std::isfinite(before)) continue;
      PetscCall(VecAXPY(d, -1, start_));
      PetscCall(VecAXPY(s, -1, residual_));
    }
    PetscCall(VecNorm(s, NORM_2, &before));
    for (PetscInt j = 0; j < n; ++j) {
      PetscCall(VecDot(s, secant_[j], &along));
      PetscCall(VecAXPY(s, -along, secant_[j]));
      PetscCall(VecAXPY(d, -along, direction_[j]));
    }
    PetscCall(VecNorm(s, NORM_2, &after));
    if (!(after > independent * before)) continue;
    PetscCall(VecScale(s, 1 / after));
    PetscCall(VecScale(d, 1 / after));
    PetscCall(VecDot(foreseen_, s, &along));
    PetscCall(VecAXPY(X, -along, d));
    PetscCall(VecAXPY(foreseen_, -along, s));
    ++n;
  }
  if (used == 0 && std::isfinite(norm)) PetscCall(SNESSetInitialFunction(snes, residual_));
  if (n == 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(residual_norm(snes, X, foreseen_, guess_norm));
  PetscCall(PetscInfo(snes, "residual %g at the last state, %g at the guess\n", (double)norm, (double)guess_norm));
  if (guess_norm < norm)
    PetscCall(SNESSetInitialFunction(snes, foreseen_));
  else
    PetscCall(VecCopy(start_, X)); // evaluated once more: whoever evaluates may keep what goes with the last state seen
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
