#include "pulmo/program/dry_run.hpp"

#include "pulmo/input/errors.hpp"
#include "pulmo/program/other_run.hpp"
#include "pulmo/pulmo.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sys/resource.h>

namespace pulmo {

namespace {

/// The elements of the rehearsal: their Newton steps cost a tenth of those of P2-P1.
constexpr const char *cheapest = "P1-P1";

/// Where a rehearsal follows, so many first steps tell what an iteration costs, or those of this share of the seconds.
constexpr std::size_t first_steps = 3;
constexpr double share_of_first_steps = 0.4;

/// What is foreseen is as wrong as this, found on scenes and meshes of docs/running.md.
constexpr double uncertainty = 0.3;

/// What some steps took.
struct Work {
  double steps = 0, newton = 0, krylov = 0;
};

/// Of the first @p steps of a run.
Work work_of(const std::vector<SignalRow> &rows, std::size_t steps)
{
  Work work;
  for (std::size_t i = 1; i < rows.size() && i <= steps; ++i) {
    work.steps += 1;
    work.newton += (double)rows[i].newton;
    work.krylov += (double)rows[i].krylov;
  }
  return work;
}

/// Ends a run after some seconds or steps, but not before a step had something to solve.
class Budget final : public StopRequest {
public:
  Budget(MPI_Comm comm, const Simulation &simulation, double seconds,
         std::size_t steps = std::numeric_limits<std::size_t>::max())
      : comm_(comm), simulation_(simulation), seconds_(seconds), steps_(steps)
  {
    (void)PetscTime(&start_);
  }
  double spent() const
  {
    PetscLogDouble now = start_;
    (void)PetscTime(&now);
    return now - start_;
  }
  PetscErrorCode asked(bool &stop) override
  {
    const std::vector<SignalRow> &rows = simulation_.rows();
    int over = (spent() > seconds_ || rows.size() > steps_) && work_of(rows, rows.size()).newton > 0;

    PetscFunctionBeginUser;
    PetscCallMPI(MPI_Bcast(&over, 1, MPI_INT, 0, comm_));
    stop = over != 0;
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  MPI_Comm comm_;
  const Simulation &simulation_;
  double seconds_;
  std::size_t steps_;
  PetscLogDouble start_ = 0;
};

/// Peak memory of all ranks so far, GB.
PetscErrorCode peak_memory(MPI_Comm comm, double &gigabytes)
{
  struct rusage usage {};

  PetscFunctionBeginUser;
  getrusage(RUSAGE_SELF, &usage);
  gigabytes = (double)usage.ru_maxrss * 1024 / 1e9; // Linux counts kB
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &gigabytes, 1, MPI_DOUBLE, MPI_SUM, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Steps of a scene after time @p t if none is cut and no phase ends early.
double steps_after(PetscReal t, const Simulation &simulation, const Scene &scene)
{
  const auto number = [&](PetscReal begin, PetscReal end, PetscReal dt) {
    const PetscReal left = end - std::max(begin, t);
    return left > 1e-9 * dt ? std::ceil((double)(left / dt) - 1e-6) : 0;
  };
  double steps = 0;

  if (scene.facts().ventilator)
    for (const Phase &phase : scene.facts().ventilator->phases()) {
      const PetscReal dt = phase.dt.value_or(simulation.wanted_dt()), end = std::min(phase.end, simulation.end());
      const PetscReal kink = std::min(phase.begin + phase.ramp, end);
      steps += number(phase.begin, kink, dt) + number(kink, end, dt);
    }
  else
    steps = number(0, simulation.end(), simulation.wanted_dt());
  return steps;
}

/// @p work of the steps up to the end of @p simulation, taken to go on as it went.
Work to_the_end(const Work &work, const Simulation &simulation, const Scene &scene)
{
  const double left = simulation.at_end() ? 0 : steps_after(simulation.time(), simulation, scene),
               factor = work.steps > 0 ? 1 + left / work.steps : 1;
  return {factor * work.steps, factor * work.newton, factor * work.krylov};
}

PetscErrorCode print_work(MPI_Comm comm, const char *what, const Simulation &simulation, double seconds)
{
  const Work work = work_of(simulation.rows(), simulation.rows().size());

  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(
      comm, "  %s: %.0f steps with %.0f Newton steps and %.0f Krylov iterations, in %.3g s; least J %.3g.\n", what,
      work.steps, work.newton, work.krylov, seconds, (double)simulation.min_J()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Runs the scene with the cheapest elements for some @p seconds. @p begun: the first steps of the run itself; @p
/// whole: what it takes to the end, by both.
PetscErrorCode rehearse_run(const Registry &registry, const Options &options, double seconds, const Work &begun,
                            Work &whole)
{
  const MPI_Comm comm = options.comm();
  OptionList list;
  OptionsInForce in_force;
  bool through;

  PetscFunctionBeginUser;
  PetscCall(options_of_other_run(options, {{"-elements", cheapest}}, list));
  PetscCall(in_force.put(list));
  PetscCall(PetscPrintf(comm, "  rehearsing the run with %s elements ...\n", cheapest));
  Run other(registry);
  PetscCall(other.declare());
  PetscCall(other.setup());
  Simulation &rehearsal = other.simulation();
  Budget budget(comm, rehearsal, seconds);
  rehearsal.heed(budget);
  PetscCall(rehearsal.run(through));
  PetscCall(print_work(comm, through ? "The whole run with these" : "The run with these as far as it went", rehearsal,
                       budget.spent()));
  if (!through && !rehearsal.stopped())
    PetscCall(PetscPrintf(comm, "  It could not go on there, and the run itself may not go through: %s\n",
                          rehearsal.failure_text().c_str()));
  const Work same_steps = work_of(rehearsal.rows(), static_cast<std::size_t>(begun.steps));
  if (same_steps.newton == 0 || same_steps.krylov == 0) PetscFunctionReturn(PETSC_SUCCESS);
  whole = to_the_end(work_of(rehearsal.rows(), rehearsal.rows().size()), rehearsal, other.scene());
  whole.newton *= begun.newton / same_steps.newton;
  whole.krylov *= begun.krylov / same_steps.krylov;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode DryRun::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("dry_run", "what a run will take");
  PetscCall(options.flag("",
                         "tell the scene in words, solve its first steps, rehearse the rest with P1-P1 elements, and "
                         "say what memory and time the run will take; writes no file",
                         in_use_));
  PetscCall(options.real("seconds", "s", Range::positive(),
                         "how long that may take; what is not rehearsed by then is taken to go on as it went",
                         seconds_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode DryRun::check(const Options &options, const std::string &restart) const
{
  PetscFunctionBeginUser;
  PulmoUserCheck(!in_use_ || restart.empty(), options.comm(),
                 "-dry_run foresees a run from its start: leave out -restart %s", restart.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode DryRun::make(const Options &options, const Scene &scene, Simulation &simulation) const
{
  const MPI_Comm comm = options.comm();
  const bool rehearse = std::string(scene.facts().elements.name()) != cheapest;
  PetscInt dofs;
  PetscMPIInt ranks;
  double gigabytes;
  bool finished;

  PetscFunctionBeginUser;
  PetscCall(VecGetSize(simulation.state(), &dofs));
  PetscCallMPI(MPI_Comm_size(comm, &ranks));
  PetscCall(PetscPrintf(comm, "Dry run\n  solving the first steps ...\n"));
  Budget first = rehearse ? Budget(comm, simulation, share_of_first_steps * seconds_, first_steps)
                          : Budget(comm, simulation, seconds_);
  simulation.heed(first);
  PetscCall(simulation.run(finished));
  const double first_took = first.spent(), setup = simulation.seconds().setup;
  PulmoFailureCheck(finished || simulation.stopped(), comm, "%s", simulation.failure_text().c_str());
  PetscCall(peak_memory(comm, gigabytes));
  const Work begun = work_of(simulation.rows(), simulation.rows().size());
  PetscCall(print_work(comm, finished ? "The whole run" : "The first steps", simulation, first_took));
  PetscCall(PetscPrintf(comm, "  %d unknowns, %d tetrahedra, %d rank%s: %.3g GB of memory in all.\n", (int)dofs,
                        (int)scene.mesh().cells(), ranks, ranks > 1 ? "s" : "", gigabytes));
  Work whole = to_the_end(begun, simulation, scene);
  if (rehearse && !finished) PetscCall(rehearse_run(registry_, options, seconds_ - first_took, begun, whole));
  const StageSeconds &s = simulation.seconds();
  const double of_newton = begun.newton > 0 ? (s.residual + s.jacobian) / begun.newton : 0,
               of_krylov = begun.krylov > 0 ? s.solve / begun.krylov : 0,
               of_step = begun.steps > 0 ? s.output / begun.steps : 0,
               total = setup + whole.newton * of_newton + whole.krylov * of_krylov + whole.steps * of_step;
  if (finished)
    PetscCall(PetscPrintf(comm, "  The run will take about %.3g s, as it just did.\n", total));
  else
    PetscCall(PetscPrintf(comm,
                          "  The run has about %.0f steps with %.0f Newton steps and %.0f Krylov iterations. It will "
                          "take about %.3g s (%.3g to %.3g s).\n",
                          whole.steps, whole.newton, whole.krylov, total, (1 - uncertainty) * total,
                          (1 + uncertainty) * total));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
