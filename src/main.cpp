// pulmo: whole-lung poromechanics.
//
//        ventilator p(t)                 momentum  int (P' - J p F^-T) : Grad eta + springs = 0
//             |                          mass      int dJ/dt q - int Q . Grad q              = 0
//   ~~~~~~~ airway ~~~~~~~               Q = -k J F^-1 F^-T Grad p
//  (   tissue u, air p    )  pleura with springs K_s
//
// mpiexec -n N pulmo -dm_plex_filename LUNG.msh -options_file SCENE.opts -options_file SOLVER.opts ...
#include "pulmo/command_line.hpp"
#include "pulmo/pulmo.hpp"

#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>

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
  int faulty = 0;
  if (rank == 0) { // option files may be on its disk alone: PETSc reads them there, too
    const std::string fault = pulmo::command_line_fault({argv + 1, argv + argc});
    faulty = !fault.empty();
    if (faulty) std::fprintf(stderr, "pulmo: error: %s\n", fault.c_str());
  }
  MPI_Bcast(&faulty, 1, MPI_INT, 0, MPI_COMM_WORLD);
  if (faulty) {
    MPI_Finalize();
    return PULMO_WRONG_INPUT;
  }
  PetscErrorCode code = PetscInitialize(&argc, &argv, nullptr, "pulmo: whole-lung poromechanics\n");
  if (code == 0) code = pulmo::initialize();
  if (code == 0) code = pulmo::run(pulmo::Registry::standard(), finished);
  int ends_with = exit_code(code, finished);
  (void)pulmo::compat::leave_unused_options_to_pulmo();
  if (PetscFinalize() != 0 && ends_with == PULMO_FINISHED) ends_with = PULMO_COULD_NOT_GO_ON;
  MPI_Finalize();
  return ends_with;
}
