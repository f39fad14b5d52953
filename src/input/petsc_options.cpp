// Values of PETSc's own options, looked at before PETSc reads them.
#include "pulmo/input/options.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Ends of the names of PETSc's options that print or write, maybe to a file of the run itself.
constexpr const char *viewer_ends[] = {"_view", "_view_pre", "_monitor", "_converged_reason"};

/// A number among PETSc's options.
struct Number {
  const char *name, *unit;
  Range range;
  bool whole;
};

/// Steps shorter than this are lost in the rounding of the clock, s.
constexpr double least_step = 1e-7;
constexpr double infinity = std::numeric_limits<double>::infinity();

const std::vector<Number> &numbers()
{
  static const Range share = Range::between(0, 0.99), count = Range::between(1, 1e9), lag = Range::between(-2, 1e9);
  static const std::vector<Number> list{
      {"-ts_dt", "s", Range::between(least_step, infinity), false},
      {"-ts_max_time", "s", Range::positive(), false},
      {"-ts_adapt_dt_min", "s", Range::not_negative(), false},
      {"-ts_adapt_scale_solve_failed", "-", {0, 1, true}, false},
      {"-dm_refine", "-", Range::between(0, 8), true},
      {"-snes_rtol", "-", share, false},
      {"-snes_atol", "-", Range::not_negative(), false},
      {"-snes_stol", "-", Range::not_negative(), false},
      {"-snes_max_it", "-", count, true},
      {"-snes_lag_jacobian", "-", lag, true},
      {"-snes_lag_preconditioner", "-", lag, true},
      {"-ksp_rtol", "-", share, false},
      {"-ksp_atol", "-", Range::not_negative(), false},
      {"-ksp_max_it", "-", count, true},
      {"-ksp_gmres_restart", "-", count, true},
      {"-mat_mumps_icntl_14", "%", Range::between(0, 1e6), true},
  };
  return list;
}

/// A list of types: the options that end so, and what PETSc has.
struct Types {
  const char *ending;
  PetscFunctionList list;
};

/// Whether @p option is `-<ending>` or `-<some prefix>_<ending>`.
bool ends_with(const std::string &option, const std::string &ending)
{
  if (option.size() <= ending.size()) return false;
  const char before = option[option.size() - ending.size() - 1];
  return (before == '-' || before == '_') && option.compare(option.size() - ending.size(), ending.size(), ending) == 0;
}

} // namespace

const std::vector<std::string> &petsc_names()
{
  static const std::vector<std::string> names = [] {
    std::vector<std::string> all{"-dm_plex_filename",
                                 "-dm_view",
                                 "-help",
                                 "-info",
                                 "-ksp_converged_reason",
                                 "-ksp_monitor",
                                 "-ksp_type",
                                 "-ksp_view",
                                 "-log_view",
                                 "-options_file",
                                 "-options_left",
                                 "-pc_factor_mat_solver_type",
                                 "-pc_fieldsplit_type",
                                 "-pc_type",
                                 "-petscfe_type",
                                 "-petscpartitioner_type",
                                 "-snes_converged_reason",
                                 "-snes_linesearch_type",
                                 "-snes_monitor",
                                 "-snes_type",
                                 "-snes_view",
                                 "-ts_monitor",
                                 "-ts_type",
                                 "-ts_view"};
    for (const Number &number : numbers()) all.emplace_back(number.name);
    return all;
  }();
  return names;
}

PetscErrorCode Options::check_petsc() const
{
  std::vector<std::pair<std::string, std::string>> given;

  PetscFunctionBeginUser;
  PetscCall(TSInitializePackage());
  PetscCall(SNESInitializePackage());
  PetscCall(KSPInitializePackage());
  PetscCall(PCInitializePackage());
  PetscCall(MatInitializePackage());
  const Types types[] = {{"pc_type", PCList}, {"ksp_type", KSPList}, {"snes_type", SNESList}, {"ts_type", TSList}};
  PetscCall(all_given(given));
  for (const auto &[option, value] : given) {
    const std::string &name = option;
    const auto is_own = [&](const Declared &d) { return d.name == name; };
    if (std::any_of(declared_.begin(), declared_.end(), is_own)) continue;
    for (const char *no_number : {"nan", "-nan", "inf", "-inf"}) {
      PetscBool same;
      PetscCall(PetscStrcasecmp(value.c_str(), no_number, &same));
      PulmoUserCheck(!same, comm_, "option %s takes a finite number, not '%s'", option.c_str(), value.c_str());
    }
    for (const Number &number : numbers()) {
      double parsed;
      if (option != number.name) continue;
      PetscCall(parse_number(option, value, number.unit, number.range, parsed));
      PulmoUserCheck(!number.whole || parsed == std::floor(parsed), comm_, "option %s takes a whole number, not '%s'",
                     option.c_str(), value.c_str());
      PulmoUserCheck((parsed != 0 && parsed != -1) || number.range.low >= 0, comm_,
                     "option %s %s is out of range; take 1 or more, or -2 for once", option.c_str(), value.c_str());
    }
    for (const Types &type : types) {
      void (*found)(void) = nullptr;
      if (!ends_with(option, type.ending)) continue;
      PetscCall(PetscFunctionListFind(type.list, value.c_str(), &found));
      PulmoUserCheck(found, comm_,
                     "option %s knows no '%s' in this PETSc; check its spelling (pulmo -help -dm_plex_filename MESH "
                     "lists what there is)",
                     option.c_str(), value.c_str());
    }
    if (ends_with(option, "pc_factor_mat_solver_type")) {
      PetscBool found_solver, found_matrix;
      PetscCall(MatSolverTypeGet(value.c_str(), MATAIJ, MAT_FACTOR_LU, &found_solver, &found_matrix, nullptr));
      PulmoUserCheck(found_solver, comm_, "option %s knows no '%s' in this PETSc; take mumps or petsc", option.c_str(),
                     value.c_str());
    }
  }
  PetscCall(check_refused(given));
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool prints(const std::string &option)
{
  const auto ends = [&](const std::string &end) {
    return option.size() > end.size() && option.compare(option.size() - end.size(), end.size(), end) == 0;
  };
  return std::any_of(std::begin(viewer_ends), std::end(viewer_ends), ends) ||
         option.find("_monitor_") != std::string::npos;
}

} // namespace pulmo
