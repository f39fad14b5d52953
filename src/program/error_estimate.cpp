#include "pulmo/program/error_estimate.hpp"

#include "pulmo/adjoint/error_parts.hpp"
#include "pulmo/base/units.hpp"
#include "pulmo/mesh/read_mesh.hpp"
#include "pulmo/observers/output.hpp"
#include "pulmo/observers/regions.hpp"
#include "pulmo/program/other_run.hpp"
#include "pulmo/pulmo.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

namespace pulmo {

namespace {

/// A mesh whose cells are nearer in size than this tells nothing of the error in space.
constexpr double least_ratio = 1.2;

/// Volumes at rest of two meshes of one lung differ by less than this share.
constexpr double same_lung = 0.1;

/// Steps that are less longer than this, of those asked to be twice as long, tell nothing of the error in time: they
/// land on the ends of phases.
constexpr double least_coarsening = 1.2;

/// Solver tolerances are tightened by this factor, but not to rounding.
constexpr PetscReal tighter = 0.01, tightest = 1e-12;

/// The runs that are compared, in this order: what is wrong with the other mesh is said before the rest is run.
enum { fine, other, twice, four_times, tight, n_levels };

/// What each step leaves undone may add up, and the solver is judged by runs of so many times fewer steps.
constexpr double steps_saved = 4;

std::string text_of(double v)
{
  std::ostringstream s;
  s.precision(15);
  s << v;
  return s.str();
}

/// How many times larger the cells of @p other are than those of @p level.
double cell_size_ratio(const ErrorLevel &level, const ErrorLevel &other)
{
  return std::cbrt(other.volume / static_cast<double>(other.cells) / (level.volume / static_cast<double>(level.cells)));
}

/// The values of number @p i on both levels, if both have it.
std::optional<std::pair<double, double>> both(const ErrorLevel &a, const ErrorLevel &b, std::size_t i)
{
  if (i >= a.numbers.size() || i >= b.numbers.size() || !a.numbers[i].value || !b.numbers[i].value) return {};
  return {{*a.numbers[i].value, *b.numbers[i].value}};
}

/// Ends the estimate unless @p other is another mesh of the same lung.
PetscErrorCode check_other_mesh(MPI_Comm comm, const ErrorLevel &run, const ErrorLevel &other)
{
  const double ratio = cell_size_ratio(run, other);

  PetscFunctionBeginUser;
  PulmoUserCheck(std::abs(other.volume / run.volume - 1) < same_lung, comm,
                 "-error_estimate: the %s holds %.4g ml at rest and the scene's %.4g ml: that is another lung",
                 other.name.c_str(), other.volume, run.volume);
  PulmoUserCheck(
      std::max(ratio, 1 / ratio) >= least_ratio, comm,
      "-error_estimate: the cells of the %s are %.3g times as large as the scene's; give one whose cells are "
      "at least %.2g times larger or smaller",
      other.name.c_str(), ratio, least_ratio);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Options that make steps @p factor times as long.
PetscErrorCode coarser_steps(const Scene &scene, const Simulation &simulation, int factor, OptionList &changes)
{
  const auto &phases = scene.facts().ventilator->phases();
  PetscReal scale = 1;
  const StepControl &control = simulation.step_control();
  const double looser = std::pow(factor, simulation.scheme().order() + 1); // a step's error is of order dt^(order + 1)
  TSAdapt adapt;
  PetscReal longest;

  PetscFunctionBeginUser;
  changes.emplace_back("-ts_dt", text_of(factor * simulation.wanted_dt()));
  if (std::any_of(phases.begin(), phases.end(), [](const Phase &p) { return p.dt.has_value(); })) {
    PetscCall(PetscOptionsGetReal(nullptr, nullptr, "-ventilator_dt_scale", &scale, nullptr));
    changes.emplace_back("-ventilator_dt_scale", text_of(factor * scale));
  }
  if (!control.in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  changes.emplace_back("-step_volume_tolerance", text_of(looser * control.volume_tolerance()));
  changes.emplace_back("-step_pressure_tolerance", text_of(looser * control.pressure_tolerance()));
  PetscCall(TSGetAdapt(simulation.ts(), &adapt));
  PetscCall(TSAdaptGetStepLimits(adapt, nullptr, &longest));
  changes.emplace_back("-ts_adapt_dt_max", text_of(factor * longest));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Options that leave the solver a hundredth of its error.
PetscErrorCode tighter_solver(const Simulation &simulation, OptionList &changes)
{
  SNES snes;
  PetscReal absolute, relative, step;

  PetscFunctionBeginUser;
  PetscCall(TSGetSNES(simulation.ts(), &snes));
  PetscCall(SNESGetTolerances(snes, &absolute, &relative, &step, nullptr, nullptr));
  const auto tighten = [&](const char *option, PetscReal tolerance) {
    if (tolerance > tightest) changes.emplace_back(option, text_of(std::max(tightest, tighter * tolerance)));
  };
  tighten("-snes_rtol", relative);
  tighten("-snes_atol", absolute);
  tighten("-snes_stol", step);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The error bar of number @p i. @p order: of the time scheme, or 0 if the steps of the levels tell nothing.
ErrorBar error_bar(const std::vector<ErrorLevel> &levels, std::size_t i, int order)
{
  const auto short_steps = both(levels[fine], levels[twice], i),
             long_steps = both(levels[twice], levels[four_times], i),
             solver = both(levels[four_times], levels[tight], i), space = both(levels[four_times], levels[other], i);
  ErrorBar bar;

  bar.entry = levels[fine].numbers[i];
  if (order > 0 && short_steps && long_steps) {
    const TimeError time = time_error(short_steps->first, short_steps->second, long_steps->second, order);
    bar.time = time.error;
    bar.time_order = time.order;
  }
  if (solver) bar.solver = steps_saved * std::abs(solver->first - solver->second);
  if (space) bar.space = space_error(space->first - space->second, cell_size_ratio(levels[fine], levels[other]));
  return bar;
}

} // namespace

bool ErrorEstimate::ended_early(const Scene &scene, const std::vector<SignalRow> &rows)
{
  const Programme &programme = *scene.facts().ventilator;
  return programme.may_end_early() && rows.back().time < programme.phases().back().end - rows.back().dt / 1000;
}

PetscErrorCode ErrorEstimate::describe(const Simulation &simulation, const Scene &scene, ErrorLevel &level)
{
  PetscFunctionBeginUser;
  level.dt = simulation.wanted_dt();
  level.cells = scene.mesh().cells();
  level.volume = scene.mesh().volume() / units::mm3_per_ml;
  level.steps = static_cast<PetscInt>(simulation.rows().size()) - 1;
  PetscCall(VecGetSize(simulation.state(), &level.dofs));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::declare(Options &options)
{
  PetscFunctionBeginUser;
  method_ = "sweep";
  options.group("error_estimate", "numerical error bars");
  PetscCall(
      options.flag("",
                   "after the run, give each clinical number with its error in time, space and solver: by a sweep back "
                   "over the run, or by runs with steps 2 and 4 times as long, tighter tolerances and another mesh",
                   in_use_));
  PetscCall(options.text(
      "mesh",
      "with more runs, the other mesh: a coarser or finer one of the same lung; without it this one refined once "
      "(with -dm_refine: once less), which takes several times the memory",
      mesh_));
  PetscCall(options.choice("method", {"sweep", "runs"},
                           "one sweep back over the run, or more runs; where it is not given sweep, if the scene has "
                           "nothing that keeps a sweep from it",
                           method_));
  PetscCall(options.names("numbers",
                          "of a sweep: " + functional_list() + "; all that the run has where it is not given", names_));
  sweeps_ = method_ == "sweep" && mesh_.empty();
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::choose_method(const Options &options, const Scene &scene, const Model &model,
                                            bool restarts)
{
  std::string obstacle = ErrorParts::obstacle(scene, model);
  PetscBool given;

  PetscFunctionBeginUser;
  PetscCall(check_functional_names(scene.mesh(), "-error_estimate_numbers", names_));
  if (method_ != "sweep") {
    PulmoUserCheck(names_.empty(), options.comm(),
                   "-error_estimate_numbers is for -error_estimate_method sweep; more runs have all numbers");
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (obstacle.empty() && restarts) obstacle = "needs the states before the restart, too";
  if (obstacle.empty() && !mesh_.empty()) obstacle = "takes no other mesh (-error_estimate_mesh)";
  sweeps_ = obstacle.empty();
  if (sweeps_) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscOptionsHasName(nullptr, nullptr, "-error_estimate_method", &given));
  PulmoUserCheck(!given, options.comm(),
                 "-error_estimate_method sweep %s; give -error_estimate_method runs, which makes more runs",
                 obstacle.c_str());
  method_ = "runs";
  if (mesh_.empty())
    PetscCall(PetscPrintf(options.comm(), "pulmo: note: -error_estimate makes four more runs%s: a sweep %s\n",
                          names_.empty() ? "" : " and gives all numbers", obstacle.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::check(const Options &options, const Scene &scene, const Model &model, bool restarts)
{
  PetscFunctionBeginUser;
  if (!in_use_) {
    PulmoUserCheck(mesh_.empty(), options.comm(), "-error_estimate_mesh %s has no effect without -error_estimate",
                   mesh_.c_str());
    PulmoUserCheck(names_.empty(), options.comm(), "-error_estimate_numbers has no effect without -error_estimate");
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PulmoUserCheck(scene.facts().ventilator, options.comm(),
                 "-error_estimate gives the errors of clinical numbers: it needs -ventilator");
  PetscCall(choose_method(options, scene, model, restarts));
  if (!mesh_.empty()) {
    PetscCall(check_mesh_file(options.comm(), "-error_estimate_mesh", mesh_));
    PetscCall(try_other_mesh(options, scene));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether the scene can be set up on the other mesh: what is wrong with it is said before the run, not after it.
PetscErrorCode ErrorEstimate::try_other_mesh(const Options &options, const Scene &scene) const
{
  const auto level_of = [](const Scene &of) {
    ErrorLevel level;
    level.cells = of.mesh().cells();
    level.volume = of.mesh().volume() / units::mm3_per_ml;
    return level;
  };
  OptionList list, changes;
  std::string name;
  OptionsInForce in_force;
  Options others(options.comm());
  Scene other(registry_);

  PetscFunctionBeginUser;
  PetscCall(other_mesh(changes, name));
  PetscCall(options_of_other_run(options, changes, list));
  PetscCall(in_force.put(list));
  PetscCall(other.declare(others));
  PetscCall(other.prepare(others));
  Composition composition(other.mesh(), other.facts().elements);
  PetscCall(other.compose(composition));
  PetscCall(check_held(options.comm(), other, composition));
  ErrorLevel level = level_of(other);
  level.name = name;
  PetscCall(check_other_mesh(options.comm(), level_of(scene), level));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::check_sessions(const Options &options, const std::string &changed) const
{
  PetscFunctionBeginUser;
  PulmoUserCheck(!in_use_ || changed.empty(), options.comm(),
                 "-error_estimate judges a run by its steps and tolerances, and those of this one changed at a restart "
                 "(%s): leave it out, or run from the start",
                 changed.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::other_mesh(OptionList &changes, std::string &name) const
{
  PetscInt refined = 0;

  PetscFunctionBeginUser;
  if (!mesh_.empty()) {
    changes.emplace_back("-dm_plex_filename", mesh_);
    name = "mesh " + mesh_;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(PetscOptionsGetInt(nullptr, nullptr, "-dm_refine", &refined, nullptr));
  changes.emplace_back("-dm_refine", std::to_string(refined > 0 ? refined - 1 : 1));
  name = refined > 0 ? "mesh refined once less" : "mesh refined once";
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Runs the scene with @p changes to its options.
PetscErrorCode ErrorEstimate::run_level(const Options &options, const Output &output, const OptionList &changes,
                                        ErrorLevel &level) const
{
  const MPI_Comm comm = options.comm();
  OptionList list;
  PetscLogDouble begin, end;
  bool finished;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&begin));
  PetscCall(options_of_other_run(options, changes, list));
  OptionsInForce in_force;
  PetscCall(in_force.put(list));

  Run run(registry_);
  PetscCall(run.declare());
  PetscCall(run.setup());
  PetscCall(check_held(options.comm(), run.scene(), run.model().composition()));
  Simulation &simulation = run.simulation();
  ProgressPrinter progress(comm, run.scene().facts());
  Sampling sampling;
  RegionAudit regions(run.scene(), run.model(), sampling);
  PetscCall(sampling.setup(run.model()));
  PetscCall(regions.setup());
  simulation.add(regions);
  if (output.progress()) simulation.add(progress);
  StopSignal signal(comm);
  simulation.heed(signal);
  PetscCall(simulation.run(finished));
  PulmoFailureCheck(!simulation.stopped(), comm,
                    "stopped by %s while the errors were estimated; the run itself is whole in %s, without error bars",
                    signal.name(), output.directory().c_str());
  PetscCall(PetscTime(&end));
  PetscCall(describe(simulation, run.scene(), level));
  level.seconds = end - begin;
  if (finished)
    level.numbers = regions.numbers(simulation.rows());
  else
    level.failure = simulation.failure_text();
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ErrorEstimate::make(const Options &options, const Output &output, const Scene &scene,
                                   const Simulation &simulation, const std::vector<ClinicalEntry> &numbers,
                                   ErrorReport &report) const
{
  const MPI_Comm comm = options.comm();
  std::array<OptionList, n_levels> changes;
  auto &levels = report.levels;
  PetscInt count = 0;

  PetscFunctionBeginUser;
  levels.assign(n_levels, {});
  PetscCall(describe(simulation, scene, levels[fine]));
  levels[fine].name = "the run itself";
  levels[fine].seconds = simulation.seconds().total;
  levels[fine].numbers = numbers;
  PetscCall(coarser_steps(scene, simulation, 2, changes[twice]));
  PetscCall(coarser_steps(scene, simulation, 4, changes[four_times]));
  changes[tight] = changes[other] = changes[four_times];
  PetscCall(tighter_solver(simulation, changes[tight]));
  PetscCall(other_mesh(changes[other], levels[other].name));
  levels[twice].name = "steps twice as long";
  levels[four_times].name = "steps 4 times as long";
  levels[tight].name = "steps 4 times as long, tighter solver";
  for (int i = other; i < n_levels; ++i) {
    PetscCall(
        PetscPrintf(comm, "\nError estimate, run %d of %d: %s\n", (int)++count, n_levels - 1, levels[i].name.c_str()));
    PetscCall(run_level(options, output, changes[i], levels[i]));
    if (i == other) PetscCall(check_other_mesh(comm, levels[fine], levels[other]));
  }
  // phases may be shorter than the longer steps
  const auto coarser = [&](int a, int b) { return levels[a].steps > least_coarsening * levels[b].steps; };
  const bool early = ended_early(scene, simulation.rows()),
             longer = !early && coarser(fine, twice) && coarser(twice, four_times);
  if (early && levels[twice].failure.empty())
    levels[twice].failure = std::string("no error in time: ") + words_of(Unresolved::phase_ended_early) +
                            " end up to a step late; a run with a smaller -ts_dt tells";
  else if (!longer && levels[twice].failure.empty() && levels[four_times].failure.empty())
    levels[twice].failure = "its steps are hardly longer, as the phases are too short for that: no error in time; a "
                            "run with a smaller -ts_dt tells";
  for (std::size_t i = 0; i < numbers.size(); ++i)
    if (numbers[i].value) report.bars.push_back(error_bar(levels, i, longer ? simulation.scheme().order() : 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
