/// @file
/// Who has a past or a say in a step beside the equations: a ventilator's limit, a threshold, an active set.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <string>
#include <vector>

namespace pulmo {

/// A solved attempt at a step, or at a stage of it.
struct Attempt {
  PetscReal time = 0;     ///< where it ends, s
  PetscReal dt = 0;       ///< size of the step, s
  PetscReal volume = 0;   ///< int (J - 1), mm^3
  PetscReal pressure = 0; ///< at the airway opening, kPa
  PetscReal flow = 0;     ///< through the airway opening into the lung, mm^3/s
  Vec local = nullptr;    ///< the fields, constrained values in place
};

/// What a partner says of an attempt; the last of several counts.
enum class Verdict {
  accept,
  kink,   ///< accept; the time derivatives jump at its end
  again,  ///< the same step once more, under other conditions
  shorter ///< a shorter step
};

/// Names what must be known after a restart, for writing and for reading.
class Past {
public:
  virtual ~Past() = default;
  virtual PetscErrorCode visit(const std::string &name, PetscReal &value) = 0;
  virtual PetscErrorCode visit(const std::string &name, bool &value) = 0;
  virtual PetscErrorCode visit(const std::string &name, std::vector<PetscReal> &values) = 0;
};

/// Takes part in every step. All functions are called on all ranks alike, and must decide alike.
class Partner {
public:
  virtual ~Partner() = default;
  /// Its name in a checkpoint.
  virtual const char *name() const = 0;
  /// An attempt at a stage that ends at @p t begins, of a step that ends at @p step_end, s.
  virtual void begin(PetscReal, PetscReal) {}
  virtual Verdict judge(const Attempt &) { return Verdict::accept; }
  /// Why it asked for a shorter step; half a sentence.
  virtual std::string why() const { return ""; }
  /// Asked when equations were solved, or could not be: a sentence, without its full stop, on why the run must end
  /// here, the same on all ranks; or nothing.
  virtual PetscErrorCode give_up(std::string &) { return PETSC_SUCCESS; }
  /// The attempt at hand is not accepted, for whatever reason: @p how, again or shorter.
  virtual void reject(Verdict) {}
  virtual void accept(const Attempt &) {}
  virtual PetscErrorCode past(Past &) { return PETSC_SUCCESS; }
};

} // namespace pulmo
