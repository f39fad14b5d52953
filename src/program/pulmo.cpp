// The program as a library: initialisation, a scene made ready (Run), a whole run with its files (run()).
#include "pulmo/pulmo.hpp"

#include "pulmo/adjoint/recording.hpp"
#include "pulmo/adjoint/sensitivities.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/fem/held.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/observers/checkpoint.hpp"
#include "pulmo/observers/ledger.hpp"
#include "pulmo/observers/replay.hpp"
#include "pulmo/physics/parameter_fields.hpp"
#include "pulmo/program/dry_run.hpp"
#include "pulmo/program/error_estimate.hpp"
#include "pulmo/program/notes.hpp"
#include "pulmo/program/scene_view.hpp"
#include "pulmo/program/unloading.hpp"
#include "pulmo/solvers/p_multigrid.hpp"

#include <algorithm>
#include <csignal>
#include <cstring>
#include <sstream>
#include <unistd.h>

namespace pulmo {

namespace {

/// A crash, or a signal before the run heeds any: no lock is left, and the exit code is not PETSc's 59.
PetscErrorCode handle_signal(int signal, void *)
{
  RunLock::abandon();
  // what follows may wait for ever for a lock that the interrupted code holds
  (void)std::signal(SIGALRM, [](int) { _exit(PULMO_COULD_NOT_GO_ON); });
  (void)alarm(10); // s
  if (signal == SIGTERM || signal == SIGHUP || signal == SIGQUIT)
    (void)std::fprintf(stderr, "pulmo: error: stopped by signal %d (%s) while nothing was at hand that could be kept\n",
                       signal, strsignal(signal));
  else
    (void)PetscError(PETSC_COMM_SELF, 0, nullptr, nullptr, PETSC_ERR_SIG, PETSC_ERROR_INITIAL,
                     "pulmo crashed: signal %d (%s); please report it with the options and the mesh", signal,
                     strsignal(signal));
  (void)MPI_Abort(PETSC_COMM_WORLD, PULMO_COULD_NOT_GO_ON);
  return PETSC_ERR_SIG;
}

/// Tissue stiffness that scales the equations: the largest diagonal entry of dP'/dF at F = I, kPa. Where parameters
/// differ from place to place that of the softest place, or the solver's tolerances would say nothing of it.
/// Collective.
PetscErrorCode reference_modulus(const TissueLaw &law, const Composition &composition, PetscReal &modulus)
{
  const PetscScalar zero[9] = {0};
  const DM dm = composition.mesh().dm();
  PointState state;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  make_point_state(zero, nullptr, state);
  const auto stiffness = [&](const PetscScalar *constants) {
    PetscScalar A[81];
    PetscReal largest = 0;
    law.tangent(state, constants, A);
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J) largest = std::max(largest, std::abs(A[27 * i + 9 * i + 4 * J]));
    return largest > 0 ? largest : 1;
  };
  std::vector<PetscScalar> constants = composition.constants(Step());
  modulus = stiffness(constants.data());
  if (!composition.varying()) PetscFunctionReturn(PETSC_SUCCESS);
  modulus = PETSC_MAX_REAL;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = 0; c < end - begin; ++c) {
    composition.varying()->patch(c, "", constants);
    modulus = std::min(modulus, stiffness(constants.data()));
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &modulus, 1, MPIU_REAL, MPI_MIN, PetscObjectComm((PetscObject)dm)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Ends a run that a signal asked to stop: a checkpoint, and how to go on.
PetscErrorCode stop(Checkpoint &checkpoint, const Simulation &simulation, const char *signal)
{
  const MPI_Comm comm = PETSC_COMM_WORLD;
  std::string complaint;

  PetscFunctionBeginUser;
  PulmoFailureCheck(simulation.rows().size() > 1, comm,
                    "stopped by %s before the first step; nothing is lost: start the run again", signal);
  PetscCall(checkpoint.write(complaint));
  PulmoFailureCheck(complaint.empty(), comm, "stopped by %s after t = %.6g s, and %s", signal,
                    (double)simulation.time(), complaint.c_str());
  PulmoStopped(comm, "stopped by %s after t = %.6g s; to go on, give the same options and -restart %s", signal,
               (double)simulation.time(), checkpoint.path().c_str());
}

/// A checkpoint of the last state of a run that failed. @p text: where it is, or why there is none.
PetscErrorCode keep_last_state(Checkpoint &checkpoint, const Simulation &simulation, std::string &text)
{
  std::string complaint;

  PetscFunctionBeginUser;
  // the start is no loss, and at the end nothing is left to run; what a load does a restart has to keep
  if (simulation.given_up() || simulation.rows().size() < 2 || simulation.at_end()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(checkpoint.write(complaint));
  text = complaint.empty() ? " With another solver go on from there: -restart " + checkpoint.path() + "."
                           : " No checkpoint: " + complaint + ".";
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Tells of options that nothing used as soon as all had their turn: after the first step with something to solve.
class UnusedOptions final : public Observer {
public:
  UnusedOptions(Options &options, const Scene &scene) : options_(options), scene_(scene) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    PetscFunctionBeginUser;
    if (done_ || step.row.krylov == 0) PetscFunctionReturn(PETSC_SUCCESS);
    PetscCall(options_.warn_unused(scene_.facts().airflow, false));
    done_ = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  Options &options_;
  const Scene &scene_;
  bool done_ = false;
};

/// Holds the energy that the steps of a run lost or made against the work that was given, which counts as what strains
/// the lung by Balance::least at least.
PetscErrorCode hold_energy(MPI_Comm comm, const EnergyAudit &energy, const Model &model, Simulation &simulation,
                           bool &finished)
{
  const double least = Balance::least * Balance::least * model.modulus() * model.composition().mesh().volume() *
                       units::j_per_kPa_mm3,
               share = std::min<double>(energy.worst_share(), energy.worst_residual() / least);
  std::ostringstream text;

  PetscFunctionBeginUser;
  text.precision(2);
  text << energy.worst_residual() << " J without account, " << share << " of the work";
  finished = share <= Balance::failure;
  if (!finished)
    PetscCall(simulation.end_unsolved("the run was not solved", text.str()));
  else if (share > Balance::warning)
    PetscCall(
        PetscPrintf(comm, "pulmo: warning: the run is hardly solved: the solver leaves %s\n", text.str().c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode check_held(MPI_Comm comm, const Scene &scene, const Composition &composition)
{
  const std::vector<std::string> walls = composition.surfaces_of("lumen_pressure"),
                                 bearing = composition.bearing_surfaces();

  PetscReal modulus;

  PetscFunctionBeginUser;
  PetscCall(reference_modulus(scene.tissue().law(), composition, modulus));
  PetscCall(check_held(comm, composition, modulus));
  if (!walls.empty() && std::find(bearing.begin(), bearing.end(), "") == bearing.end())
    PetscCall(check_wall_load(scene.mesh(), walls, bearing));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode initialize()
{
  PetscBool no_handler = PETSC_FALSE;

  PetscFunctionBeginUser;
  static ErrorHandler errors; // PETSc keeps a pointer to it to the end
  PetscCall(errors.setup());
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, "-no_signal_handler", &no_handler, nullptr));
  if (!no_handler) PetscCall(PetscPushSignalHandler(handle_signal, nullptr));
  (void)std::signal(SIGXFSZ, SIG_IGN); // a file that may not grow any more: the write fails, and is told
  PetscCall(register_fe_type());
  PetscCall(register_metis_partitioner());
  PetscCall(register_p_multigrid());
  PetscCall(register_step_control());
  PetscFunctionReturn(PETSC_SUCCESS);
}

Run::Run(const Registry &registry) : options_(PETSC_COMM_WORLD), scene_(registry), simulation_(options_, scene_, model_)
{}

PetscErrorCode Run::declare()
{
  PetscFunctionBeginUser;
  PetscCall(compat::settle_option_names(PETSC_COMM_WORLD));
  PetscCall(scene_.declare(options_));
  PetscCall(model_.declare(options_, scene_.facts().elements));
  PetscCall(simulation_.declare(options_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Run::setup()
{
  PetscLogDouble start, end;
  PetscReal modulus;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&start));
  PetscCall(options_.check_unknown());
  PetscCall(options_.check_petsc());
  PetscCall(scene_.prepare(options_));
  Composition composition(scene_.mesh(), scene_.facts().elements);
  PetscCall(scene_.compose(composition));
  auto fields = std::make_shared<ParameterFields>();
  PetscCall(fields->setup(options_, composition));
  if (!fields->empty()) composition.vary(fields);
  PetscCall(check_prescribed_once(composition));
  PetscCall(pin_free_motions(composition));
  PetscCall(reference_modulus(scene_.tissue().law(), composition, modulus));
  PetscCall(solve_unloaded_shape(options_, scene_, model_, composition, modulus));
  PetscCall(model_.build(std::move(composition), modulus));
  PetscCall(check_stable_at_rest(options_, scene_, model_)); // before any load is looked at
  PetscCall(settle_under_loads(scene_, model_, settle_note_));
  PetscCall(simulation_.setup());
  PetscCall(PetscTime(&end));
  simulation_.setup_took(end - start);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Run::save_mesh(bool overwrite)
{
  PetscFunctionBeginUser;
  PetscCall(options_.check_unknown());
  PetscCall(options_.check_petsc());
  PetscCall(scene_.save_mesh(options_, overwrite));
  PetscFunctionReturn(PETSC_SUCCESS);
}

const char *version()
{
  return PULMO_VERSION;
}

PetscErrorCode run(const Registry &registry, bool &finished, const OptionList &sources)
{
  const MPI_Comm comm = PETSC_COMM_WORLD;
  Run run(registry);
  Options &options = run.options();
  const Scene &scene = run.scene();
  Simulation &simulation = run.simulation();
  Output output;
  ErrorEstimate error_estimate(registry);
  DryRun dry_run(registry);
  Sensitivities sensitivities;
  Recording recording;
  Checkpoint checkpoint(options, output, scene, run.model(), simulation);
  Replay replay(options, output, simulation, checkpoint);
  SceneWords words;
  bool view_effects = false, view_scene = false, only_scene = false, audit_energy = true, asked_to_stop = false;
  PetscBool help, has_mesh;

  PetscFunctionBeginUser;
  finished = false;
  options.came_from(sources);
  PetscCall(run.declare());
  PetscCall(output.declare(options));
  PetscCall(checkpoint.declare(options));
  PetscCall(replay.declare(options));
  PetscCall(error_estimate.declare(options));
  PetscCall(dry_run.declare(options));
  PetscCall(sensitivities.declare(options));
  PetscCall(recording.declare(options, sensitivities.in_use() || error_estimate.sweeps()));
  options.group("scene", "the scene in words");
  PetscCall(options.flag("view", "print before the run what is in the scene, what is not, and how far its tissue goes",
                         view_scene));
  PetscCall(options.flag("view_only", "print that and stop", only_scene));
  options.group("effects", "ledger");
  PetscCall(options.flag("view", "print effects, fields, terms, blocks and seconds at the end", view_effects));
  options.group("energy", "energy balance");
  PetscCall(
      options.flag("audit", "follow the energy balance over the steps (energy.csv; backward Euler)", audit_energy));
  PetscCall(PetscOptionsHasHelp(nullptr, &help));
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-dm_plex_filename", &has_mesh));
  if (help) PetscCall(options.print_help());
  if (scene.mesh().saves() && !help) {
    PulmoUserCheck(!replay.in_use() && checkpoint.restart().empty(), comm,
                   "-mesh_save writes a mesh and stops: leave it or %s out", replay.in_use() ? "-replay" : "-restart");
    PetscCall(run.save_mesh(output.overwrite()));
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (replay.in_use() && !help) PetscCall(replay.check());
  if (!help || has_mesh) PetscCall(run.setup()); // with -help PETSc lists what it reads for this scene
  if (help) {
    if (has_mesh) PetscCall(options.print_settled());
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (replay.in_use()) {
    PetscCall(replay.make(finished));
    PulmoFailureCheck(finished, comm, "%s", simulation.failure_text().c_str());
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(check_held(comm, scene, run.model().composition()));
  PetscCall(describe_scene(options, scene, run.model(), simulation, words));
  if (view_scene || only_scene || dry_run.in_use()) PetscCall(print_scene(comm, words));
  PetscCall(look_ahead(comm, scene, run.model(), simulation, run.settle_note()));
  PetscCall(error_estimate.check(options, scene, run.model(), !checkpoint.restart().empty()));
  PetscCall(dry_run.check(options, checkpoint.restart()));
  PetscCall(sensitivities.check(options, scene, run.model(), simulation.step_control(), !checkpoint.restart().empty()));
  if (only_scene) {
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const Elements &elements = scene.facts().elements;
  PulmoUserCheck(!output.error_indicator() || (elements.displacement_degree == 2 && elements.pressure_degree == 1),
                 comm,
                 "-output_fields_error_indicator recovers the stress of -elements P2-P1; leave one of the two out");

  SignalWriter signals(comm, output, scene.facts(), run.model().composition());
  ProgressPrinter progress(comm, scene.facts());
  FieldWriter fields(output, scene, run.model());
  Sampling sampling;
  RegionAudit regions(scene, run.model(), sampling);
  EnergyAudit energy(scene, run.model(), sampling);
  if (simulation.scheme().multistep()) {
    PetscBool given;
    PetscCall(PetscOptionsHasName(nullptr, nullptr, "-energy_audit", &given));
    PulmoUserCheck(!given || !audit_energy, comm,
                   "-energy_audit: the balance is that of backward Euler; leave the option out with -ts_type bdf");
    audit_energy = false;
  }
  GravityAudit gravity(scene, run.model(), sampling);
  const bool heavy = scene.facts().gravity.has_value();
  Audits audits{regions, audit_energy ? &energy : nullptr, heavy ? &gravity : nullptr};
  PetscCall(fields.setup());
  PetscCall(sampling.setup(run.model()));
  PetscCall(regions.setup());
  simulation.add(regions);
  if (audit_energy) {
    PetscCall(energy.setup());
    simulation.add(energy);
  }
  if (heavy) {
    PetscCall(gravity.setup());
    PetscCall(note_weightless(comm, scene, gravity));
    simulation.add(gravity);
  }
  UnusedOptions unused(options, scene);
  simulation.add(unused);
  if (dry_run.in_use()) {
    PetscCall(dry_run.make(options, scene, simulation));
    for (const auto &[sweeps, option] :
         {std::pair(sensitivities.in_use(), "-sensitivities"), std::pair(error_estimate.sweeps(), "-error_estimate")})
      if (sweeps)
        PetscCall(PetscPrintf(comm,
                              "  The sweep of %s comes on top: from half as long as the run (one number) to two or "
                              "three times as long (all eight).\n",
                              option));
    if (error_estimate.in_use() && !error_estimate.sweeps())
      PetscCall(
          PetscPrintf(comm, "  The four more runs of -error_estimate come on top, one of them with another mesh.\n"));
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  simulation.add(signals);
  simulation.add(fields);
  if (output.progress()) simulation.add(progress);
  simulation.add(checkpoint);
  simulation.add(replay);
  bool warned_of_elements = false;
  PetscCall(warn_of_equal_order(comm, scene, run.model(), simulation.wanted_dt(), warned_of_elements));
  const bool restarts = !checkpoint.restart().empty();
  if (restarts) PetscCall(checkpoint.restore());
  PetscCall(error_estimate.check_sessions(options, checkpoint.numerics_changed()));
  PetscCall(output.prepare(options, checkpoint.restart(), fields.files()));
  PetscCall(write_scene(options, words, output.path("scene.json")));
  if (restarts) PetscCall(fields.carry_over(checkpoint.restart_directory()));
  if (sensitivities.in_use() || error_estimate.sweeps()) PetscCall(recording.attach(simulation, output.directory()));
  {
    StopSignal signal(comm);
    simulation.heed(signal);
    PetscCall(simulation.run(finished));
    if (simulation.stopped()) PetscCall(stop(checkpoint, simulation, signal.name()));
    PetscCall(signal.asked(asked_to_stop)); // in the last step
  }
  if (finished && audit_energy) PetscCall(hold_energy(comm, energy, run.model(), simulation, finished));
  PetscCall(options.warn_unused(scene.facts().airflow, true));
  PetscCall(look_back(comm, options, scene, run.model(), simulation, regions, !run.settle_note().empty(),
                      warned_of_elements));
  if (view_effects) PetscCall(print_ledger(comm, scene, run.model(), simulation.seconds()));
  if (audit_energy) PetscCall(write_energy(comm, output, simulation, energy));
  if (!finished) {
    const std::string failure = simulation.failure_text();
    std::string kept, repeats;
    PetscCall(replay.write(failure, repeats));
    PetscCall(keep_last_state(checkpoint, simulation, kept));
    PetscCall(fields.snapshot(simulation.time(), simulation.local_state()));
    PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, false));
    PulmoFailure(comm, "%s The last good state and the signals so far are in %s.%s%s", failure.c_str(),
                 output.directory().c_str(), kept.c_str(), repeats.c_str());
  }
  PetscCall(signals.finish());
  PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, true));
  PetscCall(print_numbers(comm, output, scene, simulation, audits));
  const std::vector<SignalRow> rows = regions.complete(simulation.rows());
  SensitivityReport sensitivity_report;
  if (sensitivities.in_use()) {
    if (asked_to_stop)
      sensitivity_report.failure = "the run was asked to stop";
    else if (complete_breaths(rows).empty())
      sensitivity_report.failure = why_no_numbers(scene, rows);
    else
      PetscCall(
          sensitivities.make(options, scene, run.model(), simulation, recording, rows, &regions, sensitivity_report));
    const auto by_cell = sensitivities.fields(sensitivity_report);
    if (!by_cell.empty()) PetscCall(fields.write_cells("sensitivities", by_cell));
    audits.sensitivities = &sensitivity_report;
    PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, true));
    PetscCall(print_sensitivities(comm, sensitivity_report, simulation.seconds().total));
  }
  if (error_estimate.in_use() && (asked_to_stop || complete_breaths(rows).empty())) {
    PetscCall(PetscPrintf(comm, "pulmo: warning: no error estimate: %s\n",
                          asked_to_stop ? "the run was asked to stop" : why_no_numbers(scene, rows).c_str()));
  } else if (error_estimate.in_use()) {
    ErrorReport report;
    if (error_estimate.sweeps())
      PetscCall(
          error_estimate.make_by_sweep(options, scene, run.model(), simulation, recording, regions, fields, report));
    else
      PetscCall(error_estimate.make(options, output, scene, simulation, regions.numbers(simulation.rows()), report));
    audits.errors = &report;
    PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, true));
    PetscCall(print_error_bars(comm, report));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
