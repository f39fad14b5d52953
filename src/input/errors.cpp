#include "pulmo/input/errors.hpp"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <sstream>
#include <thread>

namespace pulmo {

namespace {

/// Ranks that fail alike come together within this time, s.
constexpr double patience = 10;

/// Whether a code is one of pulmo's own, of an error told in a sentence.
bool is_own(PetscErrorCode code)
{
  return code == PETSC_ERR_USER_INPUT || code == PULMO_ERR_COULD_NOT_GO_ON || code == PULMO_ERR_STOPPED;
}

bool ends_with(const std::string &text, const std::string &ending)
{
  return text.size() >= ending.size() && text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

/// Whether the function at hand is pulmo's: PETSc is written in C.
bool is_pulmo(const std::string &file)
{
  return ends_with(file, ".cpp") || ends_with(file, ".hpp");
}

/// Whether a function of PETSc's belongs to its solvers.
bool is_solver(const std::string &function)
{
  for (const char *part :
       {"KSPSolve", "KSPSetUp", "PCSetUp", "PCApply", "SNESSolve", "SNESSetUp", "SNESSetFromOptions",
        "KSPSetFromOptions", "PCSetFromOptions", "TSSetFromOptions", "MatGetFactor", "MatSetFromOptions", "MatSetType"})
    if (function.rfind(part, 0) == 0) return true;
  return false;
}

void tell(const std::string &sentence)
{
  std::fflush(stdout);
  std::fprintf(stderr, "pulmo: error: %s\n", sentence.c_str());
}

/// What PETSc says, in one line and without its references.
std::string in_one_line(const std::string &message)
{
  std::istringstream lines(message);
  std::string text;
  for (std::string line; std::getline(lines, line);)
    if (!line.empty() && line.rfind("See http", 0) != 0) text += (text.empty() ? "" : "; ") + line;
  return text;
}

/// Types and flags among the options of the solvers.
std::string solver_options()
{
  OptionList given;
  std::string text;

  (void)Options(PETSC_COMM_WORLD).all_given(given);
  for (const auto &[name, value] : given) {
    bool solver = false;
    for (const char *begin :
         {"-snes_", "-ksp_", "-pc_", "-mat_", "-dm_mat_", "-dm_vec_", "-fieldsplit_", "-npc_", "-sub_", "-ts_"})
      solver = solver || name.rfind(begin, 0) == 0;
    const bool flag = value.empty() || value == "true" || value == "on" || value == "yes" || value == "1";
    if (solver && (flag || ends_with(name, "_type") || name.rfind("-ts_adapt", 0) == 0))
      text += (text.empty() ? "" : " ") + name + (value.empty() ? "" : " ") + value;
  }
  return text;
}

/// What a user is told of an error that PETSc found in an option's value; empty for every other error.
std::string option_error(PetscErrorCode code, const std::string &message, const std::string &function)
{
  const std::string first_line = message.substr(0, message.find('\n')), no_number = "Input string ";
  if (code == PETSC_ERR_ARG_UNKNOWN_TYPE) // -pc_type lemon
    return first_line + ": a PETSc option names a type that this PETSc does not have; check its spelling";
  if (message.rfind(no_number, 0) != 0) // -pc_fieldsplit_type lemon
    return function.rfind("PetscOptions", 0) == 0
               ? first_line + ": correct that option of PETSc's (-help lists its values)"
               : "";
  // -ts_dt short: PETSc names the word only
  const std::string word = message.substr(no_number.size(), message.find(' ', no_number.size()) - no_number.size());
  OptionList given;
  std::string option = "an option";
  (void)Options(PETSC_COMM_WORLD).all_given(given);
  for (const auto &[name, value] : given)
    if (value == word) option = "option " + name;
  return option + " takes a number, not '" + word + "'";
}

} // namespace

PetscErrorCode ErrorHandler::setup()
{
  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_dup(PETSC_COMM_WORLD, &comm_)); // as long as the program
  PetscCall(PetscPushErrorHandler(handle, this));
  PetscFunctionReturn(PETSC_SUCCESS);
}

ErrorHandler::~ErrorHandler()
{
  for (const Frame &frame : trace_) // of an error while PETSc ended
    (void)std::fprintf(stderr, "pulmo: error: %s %s\n", frame.function.c_str(), frame.message.c_str());
}

bool ErrorHandler::all_meet() const
{
  MPI_Request request;
  int met = 0;

  if (MPI_Ibarrier(comm_, &request) != MPI_SUCCESS) return false;
  const auto until = std::chrono::steady_clock::now() + std::chrono::duration<double>(patience);
  do {
    (void)MPI_Test(&request, &met, MPI_STATUS_IGNORE);
    if (!met) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  } while (!met && std::chrono::steady_clock::now() < until);
  return met != 0;
}

PetscErrorCode ErrorHandler::solver_error() const
{
  const Frame &origin = trace_.front();
  const std::string sentence = "PETSc's solver stopped in " + origin.function + ": " + in_one_line(origin.message) +
                               "; the options that chose it: " + solver_options() +
                               "; change these, or take a file of petsc_options/solvers";
  PetscMPIInt rank = 0;

  (void)MPI_Comm_rank(PETSC_COMM_WORLD, &rank);
  if (all_meet()) {
    if (rank == 0) tell(sentence);
    return PETSC_ERR_USER_INPUT;
  }
  tell(sentence); // the others wait for this rank
  (void)MPI_Abort(PETSC_COMM_WORLD, PULMO_WRONG_INPUT);
  return PETSC_ERR_USER_INPUT;
}

PetscErrorCode ErrorHandler::handle(MPI_Comm comm, int line, const char *function, const char *file,
                                    PetscErrorCode code, PetscErrorType type, const char *message, void *handler)
{
  auto &self = *static_cast<ErrorHandler *>(handler);
  const std::string text = message ? message : "", where = function ? function : "";

  if (!is_own(code) && type == PETSC_ERROR_INITIAL) {
    const std::string sentence = option_error(code, text, where);
    if (!sentence.empty())
      return handle(comm, line, function, file, PETSC_ERR_USER_INPUT, type, sentence.c_str(), handler);
  }
  if (is_own(code)) {
    PetscMPIInt rank = 0; // options are the same on all ranks, so all ranks are here
    (void)MPI_Comm_rank(PETSC_COMM_WORLD, &rank);
    if (type == PETSC_ERROR_INITIAL && rank == 0) tell(text);
    return code; // callers get what the handler returns
  }
  const bool within = !is_pulmo(file ? file : ""), first = type == PETSC_ERROR_INITIAL;
  if (first) self.trace_.clear();
  if (within && (first || !self.trace_.empty()) && code != PETSC_ERR_SIG) {
    self.trace_.push_back({comm, line, where, file ? file : "", code, type, text});
    return code;
  }
  const auto solver = [](const Frame &frame) { return is_solver(frame.function); };
  if (std::any_of(self.trace_.begin(), self.trace_.end(), solver)) {
    const PetscErrorCode told = self.solver_error();
    self.trace_.clear();
    return told;
  }
  for (const Frame &frame : self.trace_)
    (void)PetscTraceBackErrorHandler(frame.comm, frame.line, frame.function.c_str(), frame.file.c_str(), frame.code,
                                     frame.type, frame.message.c_str(), nullptr);
  self.trace_.clear();
  return PetscTraceBackErrorHandler(comm, line, function, file, code, type, message, nullptr);
}

} // namespace pulmo
