// PETSc's options that do not go with pulmo, and those that loosen what a step is solved to.
#include "pulmo/input/options.hpp"

#include <algorithm>
#include <cstdlib>
#include <sstream>

namespace pulmo {

namespace {

/// An option of PETSc's that would move the state somewhere else, do nothing without a word, or end in a trace.
struct Refusal {
  const char *option;
  bool any_prefix;     ///< also with a prefix of a block
  const char *allowed; ///< values that are fine, separated by commas
  const char *why;     ///< and what to do instead
};

constexpr const char *off = "off,no,false,0";

const Refusal refusals[] = {
    // TS: the clock, the size of the steps, the scheme
    {"-ts_adapt_always_accept", false, off, "pulmo judges each step itself"},
    {"-ts_adapt_max_ignore", false, "",
     "the errors of steps follow -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_adapt_reject_safety", false, "",
     "the errors of steps follow -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_adapt_safety", false, "", "the errors of steps follow -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_adapt_time_step_increase_delay", false, "0", "steps grow back at once; leave the option out"},
    {"-ts_adapt_type", false, "pulmo", "pulmo cuts, regrows and lands steps itself; leave the option out"},
    {"-ts_adapt_wnormtype", false, "",
     "the errors of steps follow -step_volume_tolerance and -step_pressure_tolerance; leave the option out"},
    {"-ts_atol", false, "",
     "PETSc's error of a step is not used; give -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_convergence_estimate", false, off, "it needs an exact solution; use -error_estimate"},
    {"-ts_convergence_temporal", false, off, "it needs an exact solution; use -error_estimate"},
    {"-ts_error_if_step_fails", false, off, "a step that fails is taken again, shorter; leave the option out"},
    {"-ts_exact_final_time", false, "matchstep",
     "a phase of the ventilator ends with a step; leave the option out and give -ts_max_time"},
    {"-ts_fd_color", false, off, "the Jacobian is assembled; to check it use -snes_test_jacobian"},
    {"-ts_final_time", false, "", "it is PETSc's old name; use -ts_max_time"},
    {"-ts_init_time", false, "0,0.0,0.", "a run begins at 0 s; to go on from a state use -restart"},
    {"-ts_max_reject", false, "", "pulmo decides how often a step is taken again; use -ts_adapt_dt_min"},
    {"-ts_max_snes_failures", false, "-1", "pulmo decides how often a step is taken again; use -ts_adapt_dt_min"},
    {"-ts_max_step_rejections", false, "", "pulmo decides how often a step is taken again; use -ts_adapt_dt_min"},
    {"-ts_max_steps", false, "", "it would cut a phase short; use -ts_max_time"},
    {"-ts_rtol", false, "",
     "PETSc's error of a step is not used; give -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_run_steps", false, "", "it would cut a phase short; use -ts_max_time"},
    {"-ts_save_trajectory", false, off, "states are written by -output_fields_every and -checkpoint_every"},
    {"-ts_theta_adapt", false, off, "the errors of steps follow -step_volume_tolerance and -step_pressure_tolerance"},
    {"-ts_theta_endpoint", false, off, "gas is conserved by backward Euler and BDF2 only; leave the option out"},
    {"-ts_theta_initial_guess_extrapolate", false, off,
     "a guess that is not held against the residual can lead to another state; use -predictor_increments"},
    {"-ts_theta_theta", false, "1,1.0,1.", "gas is conserved by backward Euler and BDF2 only; leave the option out"},
    {"-ts_time_span", false, "",
     "the programme of the ventilator says when a run ends; use -ts_max_time, and -output_fields_every for output"},
    {"-ts_eval_times", false, "",
     "the programme of the ventilator says when a run ends; use -ts_max_time, and -output_fields_every for output"},
    {"-ts_use_splitrhsfunction", false, off, "the equations have no such part; leave the option out"},
    // SNES
    {"-snes_convergence_test", false, "default",
     "a step would pass for solved that is not; leave the option out and set -snes_rtol and -snes_atol"},
    {"-snes_grid_sequence", false, "0", "a run has one mesh; use -dm_refine"},
    {"-snes_error_if_not_converged", true, off, "a step that fails is taken again, shorter; leave the option out"},
    {"-ksp_error_if_not_converged", true, off, "a step that fails is taken again, shorter; leave the option out"},
    // PC
    {"-pc_fieldsplit_0_fields", false, "",
     "the blocks are displacement and pressure, in this order; leave the option out"},
    {"-pc_fieldsplit_1_fields", false, "",
     "the blocks are displacement and pressure, in this order; leave the option out"},
    // DM
    {"-petscpartitioner_type", false,
     "metis,simple,ptscotch"
#if defined(PETSC_HAVE_PARMETIS)
     ",parmetis"
#endif
     ,
     "parts of the mesh are made by metis, simple or ptscotch; take one of them"},
    // Mat and Vec
    {"-mat_type", false, "aij,seqaij,mpiaij,baij,seqbaij,mpibaij",
     "the matrix is assembled row by row; leave the option out"},
    {"-dm_mat_type", false, "aij,seqaij,mpiaij,baij,seqbaij,mpibaij",
     "the matrix is assembled row by row; leave the option out"},
    {"-vec_type", false, "standard,seq,mpi", "pulmo computes on the processor; leave the option out"},
    {"-dm_vec_type", false, "standard,seq,mpi", "pulmo computes on the processor; leave the option out"},
};

/// An option that lets a solver pass for done when it is not, where its value is above (or, for counts, below) a bound.
struct Loosening {
  const char *option;
  enum class If { above, below, given } when;
  double bound;
  const char *usual = ""; ///< a value that loosens nothing
};

const Loosening loosenings[] = {
    {"-snes_rtol", Loosening::If::above, 1e-6},
    {"-snes_atol", Loosening::If::above, 1e-8},
    {"-snes_stol", Loosening::If::above, 1e-8},
    {"-snes_max_it", Loosening::If::below, 5},
    {"-snes_force_iteration", Loosening::If::given, 0},
    {"-snes_type", Loosening::If::given, 0, "newtonls"},
    {"-snes_linesearch_damping", Loosening::If::given, 0},
    {"-snes_linesearch_type", Loosening::If::given, 0, "bt"},
    {"-snes_lag_jacobian", Loosening::If::given, 0},
    {"-snes_max_linear_solve_fail", Loosening::If::given, 0},
    {"-npc_snes_type", Loosening::If::given, 0},
    {"-ksp_rtol", Loosening::If::above, 0.1},
    {"-ksp_atol", Loosening::If::above, 1e-8},
    {"-ksp_max_it", Loosening::If::below, 10},
    {"-ksp_norm_type", Loosening::If::given, 0},
    {"-ksp_convergence_test", Loosening::If::given, 0},
};

/// Newton's method in the forms that solve a step, and methods that do with Newton's as their preconditioner.
const char *const newtons[] = {"newtonls", "newtontr", "newtontrdc", "vinewtonrsls", "vinewtonssls"};
const char *const accelerators[] = {"anderson", "ngmres", "nrichardson", "ncg", "qn"};
const char *const linear[] = {"ksponly", "ksptransposeonly"};

/// Preconditioners that solve the system by themselves.
const char *const exact[] = {"lu", "cholesky", "qr", "svd", "redundant", "telescope", "ksp"};

template <class List>
bool holds(const List &list, const std::string &value)
{
  return std::any_of(std::begin(list), std::end(list), [&](const char *one) { return value == one; });
}

bool is_allowed(const Refusal &refusal, const std::string &value)
{
  std::istringstream list(refusal.allowed);
  for (std::string one; std::getline(list, one, ',');)
    if (one == value) return true;
  return false;
}

/// Whether @p option is @p name, or with @p any_prefix ends so.
bool is_named(const std::string &option, const std::string &name, bool any_prefix)
{
  if (option == name) return true;
  const std::string tail = "_" + name.substr(1);
  return any_prefix && option.size() > tail.size() &&
         option.compare(option.size() - tail.size(), tail.size(), tail) == 0;
}

std::string value_of(const OptionList &list, const std::string &option, const std::string &otherwise)
{
  for (const auto &[name, value] : list)
    if (name == option) return value;
  return otherwise;
}

/// Two factors, the least and the largest from one step to the next.
PetscErrorCode check_clip(MPI_Comm comm, const std::string &value)
{
  char *end = nullptr;
  const double least = std::strtod(value.c_str(), &end);
  const bool two = end != value.c_str() && *end == ',';
  const char *second = two ? end + 1 : end;
  const double most = std::strtod(second, &end);

  PetscFunctionBeginUser;
  PulmoUserCheck(two && end != second && *end == '\0' && least > 0 && least <= 1 && most >= 1, comm,
                 "option -ts_adapt_clip %s: it takes the least and the largest factor from one step to the next, the "
                 "first above 0 and up to 1, the second 1 or more; leave it out, or give 0.1,2",
                 value.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Options::check_refused(const OptionList &given) const
{
  PetscFunctionBeginUser;
  for (const auto &[option, value] : given)
    for (const Refusal &refusal : refusals)
      PulmoUserCheck(!is_named(option, refusal.option, refusal.any_prefix) || is_allowed(refusal, value), comm_,
                     "option %s%s%s does not go with pulmo: %s", option.c_str(), value.empty() ? "" : " ",
                     value.c_str(), refusal.why);
  PetscCall(check_clip(comm_, value_of(given, "-ts_adapt_clip", "0.1,2")));
  const std::string newton = value_of(given, "-snes_type", "newtonls"),
                    inner = value_of(given, "-npc_snes_type", "none"), krylov = value_of(given, "-ksp_type", "gmres"),
                    pc = value_of(given, "-pc_type", "lu");
  PulmoUserCheck(!holds(linear, newton) && !holds(linear, inner), comm_,
                 "option -snes_type %s solves one linear system and never looks whether the step is solved; use "
                 "-snes_type newtonls",
                 holds(linear, newton) ? newton.c_str() : inner.c_str());
  PulmoUserCheck(!holds(accelerators, newton) || inner == "newtonls" || inner == "newtontr", comm_,
                 "option -snes_type %s cannot solve these equations without Newton's method as its preconditioner; use "
                 "-snes_type newtonls, or add -npc_snes_type newtonls",
                 newton.c_str());
  PulmoUserCheck(holds(newtons, newton) || holds(accelerators, newton), comm_,
                 "option -snes_type %s cannot work here: it needs parts of the problem that pulmo does not hand to it; "
                 "use -snes_type newtonls",
                 newton.c_str());
  PulmoUserCheck(krylov != "preonly" || holds(exact, pc), comm_,
                 "option -ksp_type preonly applies -pc_type %s once, which solves no linear system; use -ksp_type "
                 "fgmres, or -pc_type lu",
                 pc.c_str());
  const std::string guess = value_of(given, "-ksp_initial_guess_nonzero", "off");
  PulmoUserCheck(krylov != "preonly" || is_allowed({"", false, off, ""}, guess), comm_,
                 "option -ksp_initial_guess_nonzero does not go with -ksp_type preonly, which starts from nothing; "
                 "leave it out, or use -ksp_type fgmres");
  const std::string matrix_free = value_of(given, "-snes_mf", "off");
  PulmoUserCheck(krylov != "preonly" || matrix_free == "off" || matrix_free == "false" || matrix_free == "0", comm_,
                 "option -snes_mf leaves no matrix to factorise; use -snes_mf_operator, or a Krylov method (-ksp_type "
                 "fgmres)");
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::loosened(std::string &text) const
{
  OptionList given;

  PetscFunctionBeginUser;
  text.clear();
  PetscCall(all_given(given));
  for (const auto &[option, value] : given)
    for (const Loosening &l : loosenings) {
      const double number = std::strtod(value.c_str(), nullptr);
      if (option != l.option || value == l.usual) continue;
      if (l.when == Loosening::If::given || (l.when == Loosening::If::above ? number > l.bound : number < l.bound))
        text += (text.empty() ? "" : " ") + option + (value.empty() ? "" : " " + value);
    }
  text = text.empty()
             ? "Tighten -snes_rtol and -snes_atol, or take a file of petsc_options/solvers"
             : "Options given that loosen it: " + text + ": leave them out, or take a file of petsc_options/solvers";
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
