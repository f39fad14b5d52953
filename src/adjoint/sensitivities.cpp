#include "pulmo/adjoint/sensitivities.hpp"

#include "pulmo/input/errors.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A parameter is moved by this share of itself for the derivative of the residual by it: the quotient is off by as
/// much as rounding in the residual then.
constexpr PetscReal difference = 1e-7;

/// A parameter of the scene: of kernels, or of the ventilator.
struct Parameter {
  Options::RealOption option;
  std::vector<PetscInt> places;  ///< among the constants of kernels (Composition::constant_at); none: the ventilator's
  bool on_facets = false;        ///< nothing in the volume reads it
  bool varies = false;           ///< it differs from place to place
  std::vector<Phase> less, more; ///< the ventilator's phases with less and more of it
  PetscReal change() const { return difference * std::abs(*option.target); }
};

/// The phases of the ventilator with setting @p option changed by @p change.
std::vector<Phase> phases_with(const SceneFacts &facts, const Options::RealOption &option, PetscReal change)
{
  const PetscReal value = *option.target;
  const auto laid_out = [&] {
    auto phases = facts.programme_again(false).phases();
    if (phases.size() < facts.ventilator->phases().size()) phases = facts.programme_again(true).phases();
    return phases;
  };
  *option.target = value + change;
  std::vector<Phase> phases = laid_out();
  *option.target = value;
  return phases;
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

/// The parameters of a scene that are not zero and do not differ from place to place. Those that move the ends of
/// phases are left out: steps land there.
std::vector<Parameter> parameters_of(const Options &options, const Scene &scene, const Composition &composition)
{
  const SceneFacts &facts = scene.facts();
  std::vector<PetscInt> varying;
  std::vector<Parameter> list;
  if (composition.varying()) varying = composition.varying()->offsets();
  for (const Options::RealOption &option : options.real_options()) {
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
    }
    if (*option.target == 0 || (composition.varying() && !p.places.empty() && !composition.derived().empty())) continue;
    if (p.places.empty()) {
      p.less = phases_with(facts, option, -p.change());
      p.more = phases_with(facts, option, p.change());
      if (!same_times(p.less, p.more) || same_targets(p.less, p.more)) continue;
    }
    list.push_back(std::move(p));
  }
  return list;
}

using ByCell = std::vector<std::vector<PetscReal>>; ///< [number][cell of this rank]

PetscErrorCode sum_up(MPI_Comm comm, std::vector<double> &values)
{
  PetscFunctionBeginUser;
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, values.data(), static_cast<PetscMPIInt>(values.size()), MPI_DOUBLE, MPI_SUM, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Sensitivities::declare(Options &options)
{
  std::string known;

  PetscFunctionBeginUser;
  for (const std::string &name : functional_names()) known += (known.empty() ? "" : ", ") + name;
  options.group("sensitivities", "derivatives of clinical numbers by the parameters of the scene");
  PetscCall(
      options.names("", "after the run, one sweep back gives the derivatives of these numbers: " + known, names_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sensitivities::check(const Options &options, const Scene &scene, const Model &model, bool restarts) const
{
  const std::vector<std::string> known = functional_names();
  std::string list;

  PetscFunctionBeginUser;
  if (!in_use()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const std::string &name : known) list += (list.empty() ? "" : ", ") + name;
  for (const std::string &name : names_)
    PulmoUserCheck(std::find(known.begin(), known.end(), name) != known.end(), options.comm(),
                   "-sensitivities knows no number '%s'; give some of %s", name.c_str(), list.c_str());
  const std::string obstacle = Sweep::obstacle(scene, model);
  PulmoUserCheck(obstacle.empty(), options.comm(), "-sensitivities %s; or leave the option out", obstacle.c_str());
  if (scene.facts().ventilator->may_end_early())
    PetscCall(PetscPrintf(options.comm(),
                          "pulmo: note: -sensitivities: phases that end early by a trigger or by cycling "
                          "are taken to end where they do now, whatever a parameter is\n"));
  PulmoUserCheck(!restarts, options.comm(),
                 "-sensitivities needs the states of the whole run, and a restart has not those before it; run from "
                 "the start, or leave the option out");
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode add_derivatives(const Options &options, const Scene &scene, Model &model, Sweep &sweep,
                               const std::vector<Functional> &functionals, PetscReal tolerance,
                               SensitivityReport &report)
{
  const std::vector<Parameter> parameters = parameters_of(options, scene, model.composition());
  const std::size_t count = functionals.size();
  std::vector<Mesh::Region> regions;
  ByCell all, on_facets, moved; // residuals times multipliers
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(options.comm(), &rank));
  for (const Functional &f : functionals) report.numbers.push_back({f.key, f.name, f.unit, f.value});
  for (const Parameter &p : parameters)
    report.parameters.push_back(
        {p.option.option, p.option.unit, *p.option.target, p.varies, std::vector<double>(count, 0), {}});
  std::vector<ByCell> by_cell(
      parameters.size(), ByCell(count, std::vector<PetscReal>(static_cast<std::size_t>(model.assembly().cells()), 0)));
  const auto residual = [&](const Sweep::Solved &stage, bool facets, ByCell &sums) -> PetscErrorCode {
    const StageRecord &record = stage.record;
    PetscFunctionBeginUser;
    PetscCall(model.set_step(record.stage, record.airway.pressure, record.airway.flow));
    PetscCall(model.weighted_residual(facets, record.time, stage.state, stage.rate, stage.adjoint, sums));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  const auto visit = [&](const Sweep::Solved &stage) -> PetscErrorCode {
    const StageRecord &record = stage.record;
    PetscFunctionBeginUser;
    PetscCall(residual(stage, false, all));
    PetscCall(residual(stage, true, on_facets));
    for (std::size_t i = 0; i < parameters.size(); ++i) {
      const Parameter &p = parameters[i];
      const PetscReal change = p.change();
      if (p.places.empty()) {
        const PetscReal by_parameter = (target(record, p.more) - target(record, p.less)) / (2 * change);
        for (std::size_t k = 0; k < count; ++k)
          report.parameters[i].derivative[k] += rank == 0 ? stage.by_target[k] * by_parameter : 0;
        continue;
      }
      model.change_parameter(p.places, change);
      PetscCall(residual(stage, p.on_facets, moved));
      model.change_parameter({}, 0);
      const ByCell &base = p.on_facets ? on_facets : all;
      for (std::size_t k = 0; k < count; ++k)
        for (std::size_t c = 0; c < moved[k].size(); ++c) by_cell[i][k][c] += (moved[k][c] - base[k][c]) / change;
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  sweep.ask_targets();
  if (count > 0) PetscCall(sweep.run(functionals, tolerance, visit, report.failure));
  PetscCall(scene.mesh().regions(regions));
  for (std::size_t i = 0; i < parameters.size(); ++i) {
    SensitivityReport::Parameter &row = report.parameters[i];
    for (std::size_t k = 0; k < count; ++k)
      for (const PetscReal part : by_cell[i][k]) row.derivative[k] += part;
    PetscCall(sum_up(options.comm(), row.derivative));
    for (const Mesh::Region &region : regions) {
      if (parameters[i].places.empty()) break;
      std::vector<double> sums(count, 0);
      for (std::size_t k = 0; k < count; ++k)
        for (const PetscInt c : region.cells) sums[k] += by_cell[i][k][static_cast<std::size_t>(c)];
      PetscCall(sum_up(options.comm(), sums));
      row.by_region.emplace_back(region.name, sums);
    }
  }
  report.solves = static_cast<int>(sweep.solves());
  report.krylov = static_cast<int>(sweep.krylov());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Sensitivities::make(const Options &options, const Scene &scene, Model &model, Simulation &simulation,
                                   const Recording &recording, const std::vector<SignalRow> &rows,
                                   SensitivityReport &report)
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
    const auto f = functional(name, rows);
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
