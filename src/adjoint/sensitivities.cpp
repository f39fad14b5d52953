#include "pulmo/adjoint/sensitivities.hpp"

#include "pulmo/input/errors.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace pulmo {

namespace {

/// A parameter is moved by this share of its size for the derivative of the residual by it, where it has a part in all
/// of that; by more where its part is small, and at most by the latter.
constexpr PetscReal difference = 1e-7, largest_difference = 1e-2;

/// A change of the residual that is smaller than this share of it is rounding, in the main.
constexpr PetscReal hidden = 1e-13;

/// The same for one of an effect that remembers: what it does in a step is small, and adds up over many, so that
/// rounding would count. It is moved both ways then.
constexpr PetscReal larger_difference = 1e-6;

/// Who reads a parameter of the scene.
enum class Reader { kernels, ventilator, scalars, tube };

/// A parameter of the scene.
struct Parameter {
  Options::RealOption option;
  Reader reader = Reader::ventilator;
  std::vector<PetscInt> places;  ///< among the constants of kernels (constant_at()); none: they read it in place
  bool on_facets = false;        ///< nothing in the volume reads it
  bool varies = false;           ///< it differs from place to place
  PetscReal size = 0;            ///< of its values, wherever they are
  PetscReal share = difference;  ///< of that, by which it is moved
  PetscReal effect = 0;          ///< the largest share of the residual that this changes
  std::vector<Phase> less, more; ///< the ventilator's phases with less and more of it
  bool adds_up = false;          ///< an effect reads it that remembers
  AirwayResistance less_tube, more_tube; ///< the same of the tube
  PetscReal change() const { return share * size; }
};

/// What @p read gives with a setting changed by @p change.
template <class Read>
auto with_changed(const Options::RealOption &option, PetscReal change, Read &&read)
{
  const PetscReal value = *option.target;
  *option.target = value + change;
  auto result = read();
  *option.target = value;
  return result;
}

/// The share of a parameter to move it by: rounding of the residual and the curvature over it then spoil the quotient
/// alike. @p effect: of the residual, that a move by @p share changes.
PetscReal best_share(PetscReal share, PetscReal effect)
{
  if (!std::isfinite(effect)) return difference; // a law's range ends
  const PetscReal of_all = std::max(effect, PETSC_MACHINE_EPSILON) / share;
  return std::clamp(std::sqrt(PETSC_MACHINE_EPSILON / of_all), difference, largest_difference);
}

/// The phases of the ventilator with setting @p option changed by @p change.
std::vector<Phase> phases_with(const SceneFacts &facts, const Options::RealOption &option, PetscReal change)
{
  return with_changed(option, change, [&] {
    auto phases = facts.programme_again(false).phases();
    if (phases.size() < facts.ventilator->phases().size()) phases = facts.programme_again(true).phases();
    return phases;
  });
}

/// Finds out whether the tube reads a parameter, or the equations of scalars.
bool is_of_airways(const SceneFacts &facts, const Composition &composition, Parameter &p)
{
  if (composition.read_by_scalars(p.option.target)) {
    p.reader = Reader::scalars;
    p.share = larger_difference;
  } else if (facts.tube_again) {
    p.less_tube = with_changed(p.option, -p.change(), facts.tube_again);
    p.more_tube = with_changed(p.option, p.change(), facts.tube_again);
    if (p.less_tube.linear != p.more_tube.linear || p.less_tube.quadratic != p.more_tube.quadratic)
      p.reader = Reader::tube;
  }
  return p.reader != Reader::ventilator;
}

/// Whether two lists of phases differ in nothing but in what they prescribe.
bool same_times(const std::vector<Phase> &a, const std::vector<Phase> &b)
{
  return a.size() == b.size() && std::equal(a.begin(), a.end(), b.begin(), [](const Phase &p, const Phase &q) {
           return p.begin == q.begin && p.end == q.end && p.ramp == q.ramp && p.dt == q.dt;
         });
}

bool same_targets(const std::vector<Phase> &a, const std::vector<Phase> &b)
{
  return std::equal(a.begin(), a.end(), b.begin(), [](const Phase &p, const Phase &q) {
    return p.to == q.to && p.from == q.from && p.limit == q.limit;
  });
}

/// What the phase of @p record would prescribe there by @p phases, but for what it began with.
PetscReal target(const StageRecord &record, const std::vector<Phase> &phases)
{
  const Phase &phase = phases[static_cast<std::size_t>(record.phase)];
  if (record.airway.limited) return phase.limit.value_or(0);
  if (record.airway.control == Control::flow) return phase.delivered(record.time);
  return phase.to + (phase.from.value_or(0) - phase.to) * record.airway.share;
}

/// Whether @p option is one of an effect in the scene.
bool of_an_effect(const Scene &scene, const std::string &option)
{
  const auto effects = scene.active();
  return std::any_of(effects.begin(), effects.end(), [&](const Effect *effect) {
    return option.rfind("-" + std::string(effect->name()) + "_", 0) == 0;
  });
}

/// The size of what parameter @p p is at its places: between the smallest, zeros aside, and the largest. Collective.
PetscErrorCode size_of(MPI_Comm comm, const Composition &composition, const Parameter &p, PetscReal &size)
{
  const PetscReal one = std::abs(*p.option.target);
  const ParameterFields *varying = composition.varying();
  PetscReal least = std::numeric_limits<PetscReal>::infinity(), most = 0;

  PetscFunctionBeginUser;
  for (std::size_t i = 0; p.varies && i < varying->offsets().size(); ++i)
    if (std::find(p.places.begin(), p.places.end(), varying->offsets()[i]) != p.places.end())
      PetscCall(varying->add_sizes(comm, i, least, most));
  size = most > 0 ? std::sqrt(least) * std::sqrt(most) : one;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The parameters of a scene. Those that move the ends of phases are left out: steps land there; and those that are
/// zero. Collective.
PetscErrorCode find_parameters(const Options &options, const Scene &scene, const Composition &composition,
                               std::vector<Parameter> &list, std::vector<SensitivityReport::LeftOut> &left_out)
{
  const SceneFacts &facts = scene.facts();
  std::vector<PetscInt> varying;

  PetscFunctionBeginUser;
  if (composition.varying()) varying = composition.varying()->offsets();
  for (const Options::RealOption &option : options.real_options()) {
    const auto leave_out = [&](const char *why, bool zero = false) {
      if (of_an_effect(scene, option.option)) left_out.push_back({option.option, why, zero});
    };
    Parameter p;
    p.option = option;
    p.on_facets = composition.derived().empty();
    std::vector<PetscReal *> targets = option.copies;
    targets.push_back(option.target);
    for (const PetscReal *one : targets) {
      const char *owner = nullptr;
      const PetscInt place = composition.constant_at(one, &owner);
      if (place < 0) continue;
      p.places.push_back(place);
      p.varies = p.varies || std::find(varying.begin(), varying.end(), place) != varying.end();
      p.on_facets = p.on_facets && composition.read_on_surfaces_alone(owner);
      p.adds_up = p.adds_up || composition.remembers(owner);
    }
    const char *const in_place = composition.reader_in_place(option.target);
    if (in_place) { // what else reads it may remember
      p.adds_up = composition.memory_acts();
      p.on_facets = p.on_facets && !p.adds_up && composition.read_on_surfaces_alone(in_place);
    }
    if (in_place || !p.places.empty()) p.reader = Reader::kernels;
    if (p.adds_up) p.share = larger_difference;
    PetscCall(size_of(options.comm(), composition, p, p.size));
    if (p.size == 0) {
      leave_out("it is zero", true);
      continue;
    }
    if (composition.varying() && p.reader == Reader::kernels && !composition.derived().empty()) {
      leave_out("parameters differ from place to place, and -prestress makes others of them");
      continue;
    }
    if (p.reader != Reader::kernels && !is_of_airways(facts, composition, p)) {
      p.less = phases_with(facts, option, -p.change());
      p.more = phases_with(facts, option, p.change());
      if (!same_times(p.less, p.more)) {
        leave_out("ends of phases or steps move with it");
        continue;
      }
      if (same_targets(p.less, p.more)) {
        if (option.option.rfind("-ventilator_", 0) != 0) leave_out("no equation reads it"); // else no phase does
        continue;
      }
    }
    list.push_back(std::move(p));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Adds the derivatives by a parameter of the equations of a stage that no kernel is part of, times their multipliers,
/// by number.
void add_outside_kernels(const Sweep &sweep, const Sweep::Solved &stage, const Parameter &p, std::vector<double> &sums)
{
  const PetscReal Q = sweep.flow(stage.number), change = 2 * p.change();
  std::vector<PetscReal> by, less;
  PetscReal factor = 0;
  switch (p.reader) {
  case Reader::kernels:
    return;
  case Reader::ventilator:
    by = stage.by_target;
    factor = (target(stage.record, p.more) - target(stage.record, p.less)) / change;
    break;
  case Reader::tube:
    by = stage.by_drop;
    factor = (p.more_tube.drop(Q) - p.less_tube.drop(Q)) / change;
    break;
  case Reader::scalars:
    less = with_changed(p.option, -p.change(), [&] { return sweep.weighted_scalars(stage); });
    by = with_changed(p.option, p.change(), [&] { return sweep.weighted_scalars(stage); });
    for (std::size_t k = 0; k < by.size(); ++k) by[k] -= less[k];
    factor = 1 / change;
  }
  for (std::size_t k = 0; k < by.size(); ++k) sums[k] += by[k] * factor;
}

using ByCell = std::vector<std::vector<PetscReal>>; ///< [number][cell of this rank]

PetscErrorCode sum_up(MPI_Comm comm, std::vector<double> &values)
{
  PetscFunctionBeginUser;
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<PetscMPIInt>(values.size()), MPI_DOUBLE, MPI_SUM, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The share of residuals times multipliers that is changed, of the number that has the largest.
PetscErrorCode changed_share(MPI_Comm comm, const ByCell &before, const ByCell &after, PetscReal &share)
{
  const std::size_t count = before.size();
  std::vector<double> sums(2 * count, 0); // what there is of each number, what is changed of it

  PetscFunctionBeginUser;
  share = 0;
  for (std::size_t k = 0; k < count; ++k)
    for (std::size_t c = 0; c < before[k].size(); ++c) {
      sums[k] += std::abs(before[k][c]);
      sums[count + k] += std::abs(after[k][c] - before[k][c]);
    }
  PetscCall(sum_up(comm, sums));
  for (std::size_t k = 0; k < count; ++k)
    if (!(sums[count + k] <= share * sums[k])) share = sums[k] > 0 ? sums[count + k] / sums[k] : 1;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Sensitivities::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("sensitivities", "derivatives of clinical numbers by the parameters of the scene");
  PetscCall(options.names(
      "", "after the run, one sweep back gives the derivatives of these numbers: " + functional_list(), names_));
  PetscCall(options.flag("fields",
                         "write the derivatives by a value that changes in one cell alone to sensitivities.xdmf, a "
                         "field for each number and parameter of the tissue",
                         fields_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sensitivities::check(const Options &options, const Scene &scene, const Model &model,
                                    const StepControl &steps, bool restarts) const
{
  PetscFunctionBeginUser;
  PulmoUserCheck(in_use() || !fields_, options.comm(), "-sensitivities_fields has no effect without -sensitivities");
  if (!in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(check_functional_names(scene.mesh(), "-sensitivities", names_));
  const std::string obstacle = Sweep::obstacle(scene, model);
  PulmoUserCheck(obstacle.empty(), options.comm(), "-sensitivities %s; or leave the option out", obstacle.c_str());
  PulmoUserCheck(scene.facts().ventilator->breathes(), options.comm(),
                 "-sensitivities is about the numbers of a breath, and no phase of the programme begins one: name one "
                 "'inspiration', add the word 'breath' to its line, or leave the option out");
  if (scene.facts().ventilator->may_end_early())
    PetscCall(PetscPrintf(options.comm(),
                          "pulmo: note: -sensitivities: phases that end early by a trigger or by cycling "
                          "are taken to end where they do now, whatever a parameter is\n"));
  if (steps.in_use())
    PetscCall(PetscPrintf(
        options.comm(), "pulmo: note: -sensitivities: steps that are chosen by their error are taken to be as they "
                        "are now, whatever a parameter is: a run that chooses others differs by its error in time\n"));
  PulmoUserCheck(!restarts, options.comm(),
                 "-sensitivities needs the states of the whole run, and a restart has not those before it; run from "
                 "the start, or leave the option out");
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode add_derivatives(const Options &options, const Scene &scene, Model &model, Sweep &sweep,
                               const std::vector<Functional> &functionals, PetscReal tolerance,
                               SensitivityReport &report)
{
  const std::size_t count = functionals.size();
  std::vector<Parameter> parameters;
  std::vector<Mesh::Region> regions;
  ByCell all, on_facets, moved, less; // residuals times multipliers
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(options.comm(), &rank));
  PetscCall(find_parameters(options, scene, model.composition(), parameters, report.left_out));
  for (const Functional &f : functionals) report.numbers.push_back({f.key, f.name, f.unit, f.value});
  for (const Parameter &p : parameters)
    report.parameters.push_back(
        {p.option.option, p.option.unit, *p.option.target, p.varies, std::vector<double>(count, 0), {}, {}});
  std::vector<ByCell> by_cell(
      parameters.size(), ByCell(count, std::vector<PetscReal>(static_cast<std::size_t>(model.assembly().cells()), 0)));
  // by the parameters of kernels; @p residual: what they act in, times the multipliers
  const auto move_parameters = [&](bool adapts, const auto &residual) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(residual(false, all));
    PetscCall(residual(true, on_facets));
    for (std::size_t i = 0; i < parameters.size(); ++i) {
      Parameter &p = parameters[i];
      if (p.reader != Reader::kernels) continue;
      const auto residual_with = [&](PetscReal by, ByCell &sums) -> PetscErrorCode {
        PetscFunctionBeginUser;
        if (!p.places.empty()) model.change_parameter(p.places, by);
        PetscCall(with_changed(p.option, p.places.empty() ? by : 0, [&] { return residual(p.on_facets, sums); }));
        model.change_parameter({}, 0);
        PetscFunctionReturn(PETSC_SUCCESS);
      };
      const ByCell *base = p.on_facets ? &on_facets : &all;
      for (int tries = 1;; ++tries) {
        PetscReal effect;
        PetscCall(residual_with(p.change(), moved));
        if (!adapts) break;
        PetscCall(changed_share(options.comm(), *base, moved, effect));
        const PetscReal best = p.adds_up ? p.share : best_share(p.share, effect); // thresholds are near
        if (tries == 3 || (best < 10 * p.share && p.share < 10 * best)) {
          p.effect = std::max(p.effect, effect);
          break;
        }
        p.share = best; // for the stages before it, too
      }
      PetscReal change = p.change();
      if (p.adds_up) {
        PetscCall(residual_with(-change, less));
        base = &less;
        change *= 2;
      }
      for (std::size_t k = 0; k < count; ++k)
        for (std::size_t c = 0; c < moved[k].size(); ++c) by_cell[i][k][c] += (moved[k][c] - (*base)[k][c]) / change;
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  sweep.ask_targets();
  const auto visit = [&](const Sweep::Solved &stage) -> PetscErrorCode {
    PetscFunctionBeginUser;
    for (std::size_t i = 0; i < parameters.size() && rank == 0; ++i)
      add_outside_kernels(sweep, stage, parameters[i], report.parameters[i].derivative);
    PetscCall(
        move_parameters(true, [&](bool facets, ByCell &sums) { return sweep.weighted_residual(stage, facets, sums); }));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  if (count > 0) PetscCall(sweep.run(functionals, tolerance, visit, report.failure));
  if (sweep.wants_start())
    PetscCall(move_parameters(false, [&](bool facets, ByCell &sums) { return sweep.weighted_start(facets, sums); }));
  PetscCall(scene.mesh().regions(regions));
  for (std::size_t i = 0; i < parameters.size(); ++i) {
    SensitivityReport::Parameter &row = report.parameters[i];
    for (std::size_t k = 0; k < count; ++k)
      for (const PetscReal part : by_cell[i][k]) row.derivative[k] += part;
    PetscCall(sum_up(options.comm(), row.derivative));
    for (const Mesh::Region &region : regions) {
      if (parameters[i].reader != Reader::kernels) break;
      std::vector<double> sums(count, 0);
      for (std::size_t k = 0; k < count; ++k)
        for (const PetscInt c : region.cells) sums[k] += by_cell[i][k][static_cast<std::size_t>(c)];
      PetscCall(sum_up(options.comm(), sums));
      row.by_region.emplace_back(region.name, sums);
    }
    if (parameters[i].reader == Reader::kernels) row.by_cell = std::move(by_cell[i]);
  }
  for (std::size_t i = parameters.size(); i-- > 0;) {
    if (parameters[i].reader != Reader::kernels || parameters[i].effect == 0 || parameters[i].effect >= hidden)
      continue;
    report.left_out.push_back({parameters[i].option.option, "it is so small that rounding hides what it does", false});
    report.parameters.erase(report.parameters.begin() + static_cast<std::ptrdiff_t>(i));
  }
  report.solves = static_cast<int>(sweep.solves());
  report.krylov = static_cast<int>(sweep.krylov());
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<std::pair<std::string, std::vector<double>>> Sensitivities::fields(const SensitivityReport &report) const
{
  std::vector<std::pair<std::string, std::vector<double>>> list;
  if (!fields_ || !report.failure.empty()) return list; // the sums are of some steps only
  for (std::size_t k = 0; k < report.numbers.size(); ++k)
    for (const SensitivityReport::Parameter &p : report.parameters)
      if (!p.by_cell.empty()) list.emplace_back(report.numbers[k].key + "_by_" + p.option.substr(1), p.by_cell[k]);
  return list;
}

PetscErrorCode Sensitivities::make(const Options &options, const Scene &scene, Model &model, Simulation &simulation,
                                   const Recording &recording, const std::vector<SignalRow> &rows,
                                   const RegionAudit *regions, SensitivityReport &report)
{
  const MPI_Comm comm = options.comm();
  Sweep sweep(scene, model, simulation, recording.trajectory());
  std::vector<Functional> functionals;
  PetscLogDouble begin, end;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&begin));
  PetscCall(recording.complaint(comm, report.failure));
  if (!report.failure.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const std::string &name : names_) {
    const auto f = functional(name, rows, {}, regions);
    if (f)
      functionals.push_back(*f);
    else
      report.undefined.push_back(name);
  }
  StopSignal signal(comm);
  sweep.heed(signal);
  PetscCall(PetscPrintf(comm, "\nSensitivities: a sweep back over %d steps\n",
                        static_cast<int>(simulation.rows().size()) - 1));
  PetscCall(add_derivatives(options, scene, model, sweep, functionals, recording.tolerance(), report));
  PulmoFailureCheck(!sweep.stopped(), comm,
                    "stopped by %s during the sweep of -sensitivities; the run itself is whole, without them",
                    signal.name());
  PetscCall(PetscTime(&end));
  report.seconds = end - begin;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
