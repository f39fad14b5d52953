#include "pulmo/program/other_run.hpp"

#include <algorithm>

namespace pulmo {

namespace {

/// Options of what a run leaves behind: the other run writes nothing.
constexpr const char *output_prefixes[] = {"-output",     "-progress",      "-effects",        "-energy",
                                           "-checkpoint", "-restart",       "-error_estimate", "-scene",
                                           "-dry_run",    "-sensitivities", "-sweep"};

bool is_output_option(const std::string &name)
{
  return prints(name) ||
         std::any_of(std::begin(output_prefixes), std::end(output_prefixes), [&](const std::string &prefix) {
           return name.compare(0, prefix.size(), prefix) == 0 &&
                  (name.size() == prefix.size() || name[prefix.size()] == '_');
         });
}

} // namespace

PetscErrorCode options_of_other_run(const Options &options, const OptionList &changes, OptionList &list)
{
  PetscFunctionBeginUser;
  PetscCall(options.all_given(list));
  list.erase(std::remove_if(list.begin(), list.end(), [](const auto &o) { return is_output_option(o.first); }),
             list.end());
  list.insert(list.end(), changes.begin(), changes.end()); // the last one counts
  PetscFunctionReturn(PETSC_SUCCESS);
}

OptionsInForce::~OptionsInForce()
{
  if (pushed_) (void)PetscOptionsPop();
  if (options_) (void)PetscOptionsDestroy(&options_);
}

PetscErrorCode OptionsInForce::put(const OptionList &list)
{
  PetscFunctionBeginUser;
  PetscCall(PetscOptionsCreate(&options_));
  for (const auto &[name, value] : list)
    PetscCall(PetscOptionsSetValue(options_, name.c_str(), value.empty() ? nullptr : value.c_str()));
  PetscCall(PetscOptionsPush(options_));
  pushed_ = true;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
