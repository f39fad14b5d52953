// The program as a library: initialisation, a scene made ready (Run), a whole run with its files (run()).
#include "pulmo/pulmo.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/free_boundary.hpp"
#include "pulmo/fem/held.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/observers/checkpoint.hpp"
#include "pulmo/physics/effects/pressure_damping.hpp"
#include "pulmo/physics/parameter_fields.hpp"
#include "pulmo/program/error_estimate.hpp"

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
  modulus = stiffness(nullptr);
  if (!composition.varying()) PetscFunctionReturn(PETSC_SUCCESS);
  std::vector<PetscScalar> constants = composition.constants(Step());
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
  // the start is no loss, and at the end nothing is left to run
  if (simulation.rows().size() < 2 || simulation.at_end()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(checkpoint.write(complaint));
  text = complaint.empty() ? " With another solver go on from there: -restart " + checkpoint.path() + "."
                           : " No checkpoint: " + complaint + ".";
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says so before the run if it will have no numbers of a breath.
PetscErrorCode note_no_breath(MPI_Comm comm, const Scene &scene)
{
  PetscFunctionBeginUser;
  if (!scene.facts().ventilator || scene.facts().ventilator->breathes()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(comm,
                        "pulmo: note: %s. The numbers of breaths will be null; the static curve has the end of each "
                        "pause (a phase named 'pause', or of 'hold')\n",
                        why_no_numbers(scene, {}).c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says when the run first left the range of the model: below J = 1 - Phi0 the porosity is negative, and no tissue law
/// but berger keeps J from it.
PetscErrorCode warn_of_no_air(MPI_Comm comm, const Options &options, const Scene &scene, const Simulation &simulation,
                              const RegionAudit &regions)
{
  PetscFunctionBeginUser;
  if (!scene.facts().airflow) PetscFunctionReturn(PETSC_SUCCESS);
  const std::vector<double> porosity = regions.least_porosity(simulation.rows());
  const auto first = std::find_if(porosity.begin(), porosity.end(), [](double least) { return least < 0; });
  if (first == porosity.end()) PetscFunctionReturn(PETSC_SUCCESS);
  std::string given;
  for (const auto &[name, value] : options.own_used())
    if (name == "-tissue_porosity") given = value;
  PetscCall(
      PetscPrintf(comm,
                  "pulmo: warning: at t = %g s the porosity falls below zero: J is less than 1 - Phi0 (least J %g, "
                  "-tissue_porosity %s), so that there would be less than no air; from there on the numbers mean "
                  "nothing. What to try: less suction, -tissue berger, a larger -tissue_porosity\n",
                  (double)simulation.rows()[first - porosity.begin()].time,
                  (double)simulation.rows()[first - porosity.begin()].min_J, given.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says where the volume of a ventilated lung is no animal's: a shrew's has 0.05 ml, an elephant's a hundred litres.
PetscErrorCode warn_of_size(MPI_Comm comm, const Scene &scene)
{
  constexpr PetscReal least = 0.02, largest = 2e5; // ml
  const PetscReal volume = scene.mesh().volume() / units::mm3_per_ml;

  PetscFunctionBeginUser;
  if (scene.facts().ventilator && (volume < least || volume > largest))
    PetscCall(
        PetscPrintf(comm,
                    "pulmo: warning: the lung has %.3g ml, %s than any animal's: coordinates times -mesh_scale "
                    "have to be mm; give the -mesh_scale that makes them so (an adult's lung has 2000 to 6000 ml, a "
                    "mouse's 0.2 ml)\n",
                    (double)volume, volume < least ? "less" : "more"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A lung at rest has 0.2 to 0.3 g/ml, where the default porosity (the paper's, for which weight is nothing) gives
/// 0.012.
PetscErrorCode note_weightless(MPI_Comm comm, const Scene &scene, const GravityAudit &gravity)
{
  constexpr double light = 0.1, real = 0.26, tissue = 1.05; // g/ml
  const double volume = scene.mesh().volume() / units::mm3_per_ml;

  PetscFunctionBeginUser;
  if (gravity.weight() < light * volume)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: with -tissue_porosity %g a lung of %.4g ml weighs %.3g g, so that gravity does "
                          "almost nothing; a real one of that size weighs about %.3g g: give -tissue_porosity %.2f\n",
                          (double)scene.tissue().porosity().reference, volume, gravity.weight(), real * volume,
                          1 - real / tissue));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Elements of equal order are not stable where the tissue is undrained: in steps @p dt (s) in which pressure spreads
/// by less than half a cell, k M dt < (h/2)^2. Says so, once.
PetscErrorCode warn_of_equal_order(MPI_Comm comm, const Scene &scene, const Model &model, PetscReal dt, bool &warned)
{
  const SceneFacts &facts = scene.facts();
  const Elements &elements = facts.elements;
  const PetscReal half_edge = scene.mesh().edge() / 2;

  PetscFunctionBeginUser;
  if (warned || !facts.airflow || facts.pressure_damping || elements.displacement > elements.pressure)
    PetscFunctionReturn(PETSC_SUCCESS);
  warned = scene.airflow().permeability_at_rest() * model.modulus() * dt < half_edge * half_edge;
  if (warned)
    PetscCall(
        PetscPrintf(comm,
                    "pulmo: warning: in a step of %g s pressure spreads by less than half a cell, where "
                    "-elements %s is not stable: look for a pressure that oscillates, or give -pressure_damping\n",
                    (double)dt, elements.name()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Pressures and times of a programme that no lung sees, or that its steps do not resolve: told, as each may be meant.
PetscErrorCode note_programme(MPI_Comm comm, const Scene &scene, PetscReal asked_dt)
{
  constexpr PetscReal least = 1, largest = 60, // cmH2O
      shortest = 1e-3,                         // s
      same_time = 1e-6;
  PetscReal low = PETSC_MAX_REAL, high = PETSC_MIN_REAL, extreme = 0; // of breaths; of all
  bool told_short = false, told_step = false, flows = false;

  PetscFunctionBeginUser;
  if (!scene.facts().ventilator) PetscFunctionReturn(PETSC_SUCCESS);
  for (const Phase &phase : scene.facts().ventilator->phases()) {
    const PetscReal duration = phase.end - phase.begin, dt = phase.dt.value_or(asked_dt),
                    part = phase.ramp > 0 ? std::min(phase.ramp, duration) : duration;
    if (phase.control == Control::pressure) {
      for (const PetscReal kPa : {phase.from.value_or(phase.to), phase.to}) {
        const PetscReal P = kPa / units::kPa_per_cmH2O;
        if (phase.breath > 0) {
          low = std::min(low, P);
          high = std::max(high, P);
        }
        if (std::abs(P) > std::abs(extreme)) extreme = P;
      }
    } else {
      flows = flows || phase.to != 0;
    }
    if (!told_short && duration < shortest) {
      told_short = true;
      PetscCall(PetscPrintf(comm,
                            "pulmo: warning: phase '%s' lasts %g s: durations are in seconds, and no breath has a "
                            "phase as short; what comes of it is the numbers' answer to a jump, not a lung's\n",
                            phase.name.c_str(), (double)duration));
    } else if (!told_step && dt > part * (1 + same_time)) {
      told_step = true;
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: a step of %g s is longer than %s of phase '%s' (%g s), which a single step "
                            "takes then: volumes and fits hang on the step; give a smaller -ts_dt, or see how they "
                            "change with it (-error_estimate)\n",
                            (double)dt, phase.ramp > 0 ? "the ramp" : "the whole", phase.name.c_str(), (double)part));
    }
  }
  if (std::abs(extreme) > largest)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: the ventilator gives %.4g cmH2O: a lung sees about %g to %g cmH2O, and "
                          "pressures are in cmH2O (1 cmH2O = 98.07 Pa = 0.09807 kPa); give -ventilator_pip, or the "
                          "programme's pressures, in that unit\n",
                          (double)extreme, (double)least, (double)largest));
  else if (!flows && extreme != 0 && std::abs(extreme) < least)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: the ventilator gives no more than %.4g cmH2O: a lung sees about %g to %g "
                          "cmH2O, and pressures are in cmH2O (0.1 kPa = 1.02 cmH2O); give -ventilator_pip, or the "
                          "programme's pressures, in that unit\n",
                          (double)extreme, (double)least, (double)largest));
  if (!flows && high == low)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: the ventilator's pressure is %.4g cmH2O throughout (-ventilator_pip "
                          "equals -ventilator_peep): no breath\n",
                          (double)high));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says where springs act on a surface that a support holds: they are never strained.
PetscErrorCode note_idle_springs(MPI_Comm comm, const Composition &composition)
{
  const std::vector<std::string> springs = composition.surfaces_of("chest_wall");

  PetscFunctionBeginUser;
  for (const Constraint &c : composition.constraints()) {
    const bool whole = c.effect == "support" && c.component[0] && c.component[1] && c.component[2];
    if (whole && !c.surface.empty() && std::find(springs.begin(), springs.end(), c.surface) != springs.end())
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: the springs of -chest_wall on surface '%s' do nothing: -support_surfaces "
                            "holds it; leave the surface out of one of the two (-chest_wall_surfaces)\n",
                            c.surface.c_str()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Damping is in proportion to h^2 / M with the edge h of a cell and the stiffness M of the tissue; where options make
/// it far larger it is no longer a perturbation of the mesh's own size.
PetscErrorCode check_damping(MPI_Comm comm, const Scene &scene, const Model &model)
{
  constexpr PetscReal told = 10, refused = 1000;

  PetscFunctionBeginUser;
  if (!scene.facts().pressure_damping) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal h = scene.mesh().edge(), c = scene.facts().elements.displacement == 1 ? 4 : 6,
                  beta = constants::get<PressureDampingKernels::Parameters>(model.constants_at(0)).beta,
                  share = beta / (h * h / (c * model.modulus()));
  char fix[256];
  PetscCall(PetscSNPrintf(fix, sizeof(fix),
                          "the pressure is damped %.3g times as much as this mesh asks for (cells of %.3g mm, tissue "
                          "of %.3g kPa); leave -pressure_damping_length and -pressure_damping_modulus out, or give "
                          "these values",
                          (double)share, (double)h, (double)model.modulus()));
  PulmoUserCheck(share <= refused, comm, "-pressure_damping: %s", fix);
  if (share > told) PetscCall(PetscPrintf(comm, "pulmo: warning: -pressure_damping: %s: resistance is too low\n", fix));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Where gas crosses a cell in this share of a step the flow is lost in rounding: no tolerance solves the step.
PetscErrorCode check_permeability(MPI_Comm comm, const Scene &scene, const Model &model, PetscReal dt)
{
  constexpr PetscReal most = 1e12;
  const PetscReal L = scene.mesh().length();

  PetscFunctionBeginUser;
  if (!scene.facts().airflow) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal k = scene.airflow().permeability_at_rest(), bound = most * L * L / (model.modulus() * dt);
  PulmoUserCheck(k <= bound, comm,
                 "-airflow_permeability %g mm^2/(kPa s) is so large that the flow is lost in rounding; give less than "
                 "%.1g: far below that there is no resistance left to speak of (or -airflow off)",
                 (double)k, (double)bound);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A passive lung takes gas in where the pressure rises.
PetscErrorCode warn_of_shrinking(MPI_Comm comm, const Simulation &simulation, const RegionAudit &regions)
{
  const std::vector<SignalRow> rows = regions.complete(simulation.rows());
  const auto found = shrinks_under_pressure(rows);

  PetscFunctionBeginUser;
  if (found)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: at t = %g s the lung has %.4g ml less than at the start of the breath, "
                          "though the pressure has risen by %.4g cmH2O: unless a load or a support pushes it, tissue "
                          "or springs are not stable there, and the numbers are no lung's; look at -tissue and its "
                          "parameters\n",
                          rows[*found].time, rows[breath_rows(rows).front().first].volume - rows[*found].volume,
                          rows[*found].machine_pressure() - rows[breath_rows(rows).front().first].machine_pressure()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Tells of options that nothing used as soon as all had their turn: after the first step.
class UnusedOptions final : public Observer {
public:
  UnusedOptions(Options &options, const Scene &scene) : options_(options), scene_(scene) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    PetscFunctionBeginUser;
    if (!done_ && step.row.dt > 0) PetscCall(options_.warn_unused(scene_.facts().airflow, false));
    done_ = step.row.dt > 0;
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
  PetscCall(model_.build(std::move(composition), modulus));
  PetscCall(check_stable_at_rest(options_, scene_, model_)); // before any load is looked at
  PetscCall(settle_under_loads(scene_, model_, settle_note_));
  PetscCall(simulation_.setup());
  PetscCall(PetscTime(&end));
  simulation_.setup_took(end - start);
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
  Checkpoint checkpoint(options, output, scene, run.model(), simulation);
  bool view_effects = false, audit_energy = true, asked_to_stop = false;
  PetscBool help, has_mesh;

  PetscFunctionBeginUser;
  finished = false;
  options.came_from(sources);
  PetscCall(run.declare());
  PetscCall(output.declare(options));
  PetscCall(checkpoint.declare(options));
  PetscCall(error_estimate.declare(options));
  options.group("effects", "ledger");
  PetscCall(options.flag("view", "print effects, fields, terms, blocks and seconds at the end", view_effects));
  options.group("energy", "energy balance");
  PetscCall(
      options.flag("audit", "follow the energy balance over the steps (energy.csv; backward Euler)", audit_energy));
  PetscCall(PetscOptionsHasHelp(nullptr, &help));
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-dm_plex_filename", &has_mesh));
  if (help) PetscCall(options.print_help());
  if (!help || has_mesh) PetscCall(run.setup()); // with -help PETSc lists what it reads for this scene
  if (help) {
    if (has_mesh) PetscCall(options.print_settled());
    finished = true;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(check_held(comm, scene, run.model().composition()));
  PetscCall(note_free_boundary(run.model().composition(), scene.facts().airflow));
  PetscCall(warn_of_size(comm, scene));
  PetscCall(note_idle_springs(comm, run.model().composition()));
  PetscCall(check_damping(comm, scene, run.model()));
  PetscCall(check_permeability(comm, scene, run.model(), simulation.wanted_dt()));
  PetscCall(note_programme(comm, scene, simulation.wanted_dt()));
  if (!run.settle_note().empty()) PetscCall(PetscPrintf(comm, "pulmo: note: %s\n", run.settle_note().c_str()));
  PetscCall(note_no_breath(comm, scene));
  PetscCall(error_estimate.check(options, scene));
  const Elements &elements = scene.facts().elements;
  PulmoUserCheck(!output.error_indicator() || (elements.displacement == 2 && elements.pressure == 1), comm,
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
  simulation.add(signals);
  simulation.add(fields);
  if (output.progress()) simulation.add(progress);
  simulation.add(checkpoint);
  bool warned_of_elements = false;
  PetscCall(warn_of_equal_order(comm, scene, run.model(), simulation.wanted_dt(), warned_of_elements));
  const bool restarts = !checkpoint.restart().empty();
  if (restarts) PetscCall(checkpoint.restore());
  PetscCall(error_estimate.check_sessions(options, checkpoint.numerics_changed()));
  PetscCall(output.prepare(options, checkpoint.restart(), fields.files()));
  if (restarts) PetscCall(fields.carry_over(checkpoint.restart_directory()));
  {
    StopSignal signal(comm);
    simulation.heed(signal);
    PetscCall(simulation.run(finished));
    if (simulation.stopped()) PetscCall(stop(checkpoint, simulation, signal.name()));
    PetscCall(signal.asked(asked_to_stop)); // in the last step
  }
  if (finished && audit_energy) PetscCall(hold_energy(comm, energy, run.model(), simulation, finished));
  PetscCall(options.warn_unused(scene.facts().airflow, true));
  PetscCall(warn_of_no_air(comm, options, scene, simulation, regions));
  if (!scene.facts().settling.off || run.settle_note().empty()) // else loads that act at rest are told already
    PetscCall(warn_of_shrinking(comm, simulation, regions));
  PetscCall(simulation.pins().warn(run.model()));
  for (const SignalRow &row : simulation.rows()) // steps that were cut
    if (row.dt > 0) PetscCall(warn_of_equal_order(comm, scene, run.model(), row.dt, warned_of_elements));
  if (view_effects) PetscCall(print_ledger(comm, scene, run.model(), simulation.seconds()));
  if (audit_energy) PetscCall(write_energy(comm, output, simulation, energy));
  if (!finished) {
    std::string kept;
    PetscCall(keep_last_state(checkpoint, simulation, kept));
    PetscCall(fields.snapshot(simulation.time(), simulation.local_state()));
    PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, false));
    PulmoFailure(comm, "%s The last good state and the signals so far are in %s.%s", simulation.failure_text().c_str(),
                 output.directory().c_str(), kept.c_str());
  }
  PetscCall(signals.finish());
  PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, true));
  PetscCall(print_numbers(comm, output, scene, simulation, audits));
  const std::vector<SignalRow> rows = regions.complete(simulation.rows());
  if (error_estimate.in_use() && (asked_to_stop || complete_breaths(rows).empty())) {
    PetscCall(PetscPrintf(comm, "pulmo: warning: no error estimate: %s\n",
                          asked_to_stop ? "the run was asked to stop" : why_no_numbers(scene, rows).c_str()));
  } else if (error_estimate.in_use()) {
    ErrorReport report;
    PetscCall(error_estimate.make(options, output, scene, simulation, regions.numbers(simulation.rows()), report));
    audits.errors = &report;
    PetscCall(write_summary(options, output, scene, run.model(), simulation, audits, true));
    PetscCall(print_error_bars(comm, report));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
