/// @file
/// Options of a run within the program's own: the same scene, changed here and there, that leaves no file.
#pragma once

#include "pulmo/input/options.hpp"

namespace pulmo {

/// The options of the run, but of what it prints and leaves behind, with @p changes.
PetscErrorCode options_of_other_run(const Options &options, const OptionList &changes, OptionList &list);

/// Another options database in place of PETSc's default one while it lives.
class OptionsInForce {
public:
  OptionsInForce() = default;
  ~OptionsInForce();
  OptionsInForce(const OptionsInForce &) = delete;
  OptionsInForce &operator=(const OptionsInForce &) = delete;

  PetscErrorCode put(const OptionList &list);

private:
  PetscOptions options_ = nullptr;
  bool pushed_ = false;
};

} // namespace pulmo
