// pulmo: whole-lung poromechanics.
//
//        ventilator p(t)                 momentum  int (P' - J p F^-T) : Grad eta + springs = 0
//             |                          mass      int dJ/dt q - int Q . Grad q              = 0
//   ~~~~~~~ airway ~~~~~~~               Q = -k J F^-1 F^-T Grad p
//  (   tissue u, air p    )  pleura with springs K_s
//
// mpiexec -n N pulmo -dm_plex_filename LUNG.msh -options_file SCENE.opts -options_file SOLVER.opts ...
#include "pulmo/input/command_line.hpp"
#include "pulmo/program/usage.hpp"
#include "pulmo/pulmo.hpp"

#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <string>
#include <unistd.h>

namespace {

/// Ends all ranks at once: this one met what no other may know of.
[[noreturn]] void give_up()
{
  (void)MPI_Abort(MPI_COMM_WORLD, PULMO_COULD_NOT_GO_ON);
  std::_Exit(PULMO_COULD_NOT_GO_ON);
}

/// An error that MPI finds; its own handler would end the program with a code of its own.
void on_mpi_error(MPI_Comm *, int *error, ...)
{
  char text[MPI_MAX_ERROR_STRING] = "";
  int length = 0;
  (void)MPI_Error_string(*error, text, &length);
  std::fprintf(stderr, "pulmo: error: MPI: %s\n", text);
  give_up();
}

/// What no one caught: no memory left, say.
void on_exception()
{
  const char *what = "unknown";
  try {
    if (const std::exception_ptr thrown = std::current_exception()) std::rethrow_exception(thrown);
  } catch (const std::bad_alloc &) {
    what = "the memory is used up; take more ranks on more machines, or a coarser mesh";
  } catch (const std::exception &e) {
    what = e.what();
  } catch (...) {
  }
  std::fprintf(stderr, "pulmo: error: %s\n", what);
  give_up();
}

/// A library called abort().
void on_abort(int signal)
{
  std::signal(signal, SIG_DFL);
  std::fprintf(stderr, "pulmo: error: signal %d: a library gave up, see above\n", signal);
  give_up();
}

int exit_code(PetscErrorCode code, bool finished)
{
  switch (static_cast<int>(code)) {
  case 0:
    return finished ? PULMO_FINISHED : PULMO_COULD_NOT_GO_ON;
  case static_cast<int>(PETSC_ERR_USER_INPUT):
    return PULMO_WRONG_INPUT;
  case static_cast<int>(PULMO_ERR_COULD_NOT_GO_ON):
    return PULMO_COULD_NOT_GO_ON;
  case static_cast<int>(PULMO_ERR_STOPPED):
    return PULMO_STOPPED;
  default: // PETSc's trace told it, maybe not on all ranks
    give_up();
  }
}

/// What can be chosen: one line for each law and effect, what it is and its names first; then options that bring an
/// effect into a scene, for tools that go through all of them.
void print_list(const pulmo::Registry &registry)
{
  const auto print = [](const char *kind, const std::string &names, const char *about) {
    std::printf("%-12s %-16s %s\n", kind, names.c_str(), about);
  };

  for (const auto &law : registry.make_tissue_laws()) {
    const std::string alias = law->alias();
    print("tissue", law->name() + (alias.empty() ? "" : "|" + alias), law->source());
  }
  for (const auto &law : registry.make_permeability_laws()) print("permeability", law->name(), law->about());
  const pulmo::Scene scene(registry);
  for (const auto &effect : scene.effects()) print("effect", effect->name(), effect->about());
  for (const auto &effect : registry.make_effects()) print("example", effect->name(), effect->example().c_str());
}

/// Says what was asked for, or what is wrong.
void answer(const pulmo::GivenOptions &given, const char *called)
{
  if (given.question == "version")
    std::printf("pulmo %s (PETSc %d.%d.%d)\n", pulmo::version(), PETSC_VERSION_MAJOR, PETSC_VERSION_MINOR,
                PETSC_VERSION_SUBMINOR);
  else if (given.question == "list")
    print_list(pulmo::Registry::standard());
  else if (given.question == "usage")
    std::fputs(pulmo::usage(called).c_str(), stderr);
  else
    std::fprintf(stderr, "pulmo: error: %s\n", given.fault.c_str());
}

/// Makes what rank 0 has known to all ranks.
void share(std::string &text)
{
  unsigned long size = text.size();
  MPI_Bcast(&size, 1, MPI_UNSIGNED_LONG, 0, MPI_COMM_WORLD);
  text.resize(size);
  MPI_Bcast(text.data(), static_cast<int>(size), MPI_CHAR, 0, MPI_COMM_WORLD);
}

/// Puts what was given into PETSc's database, which may be done before PETSc starts. @p sources: where each is from.
PetscErrorCode hand_over(const pulmo::GivenOptions &given, pulmo::OptionList &sources)
{
  bool monitor = false;

  for (const pulmo::GivenOption &o : given.list) monitor = monitor || o.name == "-options_monitor";
  for (const pulmo::GivenOption &o : given.list) {
    if (o.name == "-options_monitor" || o.name == "-options_monitor_cancel" || o.name == "-skip_petscrc") continue;
    const PetscErrorCode code =
        PetscOptionsSetValue(nullptr, o.name.c_str(), o.value.empty() ? nullptr : o.value.c_str());
    if (code != 0) return code;
    sources.emplace_back(o.name, o.source);
  }
  int rank;
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  if (monitor && rank == 0)
    for (const pulmo::GivenOption &o : given.list)
      std::printf("%s %s (%s)\n", o.name.c_str(), o.value.c_str(), o.source.c_str());
  return PETSC_SUCCESS;
}

/// Starts PETSc, which would read again what pulmo has read.
PetscErrorCode start_petsc(char *program)
{
  static char skip[] = "-skip_petscrc"; // PETSc keeps its arguments
  static char *words[] = {program, skip, nullptr};
  char **argv = words;
  int argc = 2;

  unsetenv("PETSC_OPTIONS");
  unsetenv("PETSC_OPTIONS_YAML");
  const PetscErrorCode code = PetscInitialize(&argc, &argv, nullptr, "pulmo: whole-lung poromechanics\n");
  return code == 0 ? PetscOptionsClearValue(nullptr, skip) : code;
}

} // namespace

int main(int argc, char **argv)
{
  MPI_Errhandler mpi_errors;
  bool finished = false;
  int rank;

  std::set_terminate(on_exception);
  if (MPI_Init(&argc, &argv) != MPI_SUCCESS) return PULMO_COULD_NOT_GO_ON;
  MPI_Comm_create_errhandler(on_mpi_error, &mpi_errors);
  MPI_Comm_set_errhandler(MPI_COMM_WORLD, mpi_errors); // inherited by all that are made of it
  MPI_Errhandler_free(&mpi_errors);
  std::signal(SIGABRT, on_abort);
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  std::string packed; // read by rank 0: option files may be on its disk alone
  if (rank == 0) packed = pulmo::read_options({argv + 1, argv + argc}, pulmo::Surroundings::of_process()).packed();
  share(packed);
  const pulmo::GivenOptions given = pulmo::GivenOptions::unpacked(packed);
  if (!given.question.empty() || !given.fault.empty()) {
    if (rank == 0) answer(given, argv[0]);
    MPI_Finalize();
    return given.question == "version" || given.question == "list" ? PULMO_FINISHED : PULMO_WRONG_INPUT;
  }
  // options of a run that failed name files from where it ran; if that is gone the files are missed by name
  if (!given.directory.empty() && chdir(given.directory.c_str()) != 0 && rank == 0)
    std::printf("pulmo: note: -replay: the run worked in %s, which is not there any more\n", given.directory.c_str());
  pulmo::OptionList sources;
  PetscErrorCode code = hand_over(given, sources);
  if (code == 0) code = start_petsc(argv[0]);
  if (code == 0) code = pulmo::initialize();
  for (const std::string &source : given.unasked)
    if (code == 0)
      code = PetscPrintf(PETSC_COMM_WORLD, "pulmo: note: options were also read from %s\n", source.c_str());
  if (code == 0) code = pulmo::run(pulmo::Registry::standard(), finished, sources);
  int ends_with = exit_code(code, finished);
  (void)pulmo::compat::leave_unused_options_to_pulmo();
  if (PetscFinalize() != 0 && ends_with == PULMO_FINISHED) ends_with = PULMO_COULD_NOT_GO_ON;
  MPI_Finalize();
  return ends_with;
}
