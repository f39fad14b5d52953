/// @file
/// What a run will take: `-dry_run`.
#pragma once

#include "pulmo/time/simulation.hpp"

namespace pulmo {

/// Solves the first steps of the run, and rehearses all of it with the cheapest elements, whose Newton steps are about
/// as many; from that it foresees memory and time. Writes no file.
class DryRun {
public:
  explicit DryRun(const Registry &registry) : registry_(registry) {}

  /// Declares -dry_run and -dry_run_seconds.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return in_use_; }
  /// Refuses a run that does not begin at its start.
  PetscErrorCode check(const Options &options, const std::string &restart) const;
  /// Prints what it finds. @p simulation, with the observers of the run, is used up.
  PetscErrorCode make(const Options &options, const Scene &scene, Simulation &simulation) const;

private:
  const Registry &registry_;
  bool in_use_ = false;
  PetscReal seconds_ = 20;
};

} // namespace pulmo
