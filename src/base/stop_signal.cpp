#include "pulmo/base/stop_signal.hpp"

#include "pulmo/base/run_lock.hpp"

#include <array>
#include <csignal>
#include <ctime>

namespace pulmo {

namespace {

constexpr std::array<int, 3> watched{SIGTERM, SIGINT, SIGUSR1};

/// Launchers and batch systems may both pass on what was sent once: so much later it is a second signal, s.
constexpr std::time_t again_after = 2;

// a signal handler reaches nothing else
volatile std::sig_atomic_t received = 0;
volatile std::time_t received_at = 0;
std::array<struct sigaction, watched.size()> former;

void note(int signal)
{
  const std::time_t now = std::time(nullptr);
  if (received == 0) {
    received = signal;
    received_at = now;
  } else if (now - received_at >= again_after) {
    RunLock::abandon();
    std::signal(signal, SIG_DFL);
    std::raise(signal);
  }
}

} // namespace

StopSignal::StopSignal(MPI_Comm comm) : comm_(comm)
{
  struct sigaction action {};
  action.sa_handler = note;
  action.sa_flags = SA_RESTART; // a write at hand goes on
  sigemptyset(&action.sa_mask);
  received = 0;
  for (std::size_t i = 0; i < watched.size(); ++i) sigaction(watched[i], &action, &former[i]);
}

StopSignal::~StopSignal()
{
  for (std::size_t i = 0; i < watched.size(); ++i) sigaction(watched[i], &former[i], nullptr);
}

PetscErrorCode StopSignal::asked(bool &stop)
{
  PetscFunctionBeginUser;
  if (signal_ == 0) {
    signal_ = received;
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &signal_, 1, MPI_INT, MPI_MAX, comm_));
  }
  stop = signal_ != 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

const char *StopSignal::name() const
{
  switch (signal_) {
  case SIGTERM:
    return "SIGTERM";
  case SIGINT:
    return "SIGINT";
  default:
    return "SIGUSR1";
  }
}

} // namespace pulmo
