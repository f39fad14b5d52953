#include "pulmo/time/failure.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/sampling.hpp"
#include "pulmo/mesh/openings.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>

namespace pulmo {

namespace {

/// At a limit point volume follows pressure more steeply than on the way there, by this factor at least: dV/dP goes to
/// infinity, and steps end far closer to it than this asks for.
constexpr double limit_steepness = 5;

/// No cell that has less than this J is well.
constexpr double well_formed = 0.5;
/// Steps end just before a cell folds: with more than this J left it is not what stopped them.
constexpr double folded = 0.05;

/// Cells this many edges from the edge of the airway are at its rim.
constexpr PetscReal rim_reach = 2;

/// Some laws have none at rest (CM5 against shear): only what is negative beyond rounding is lost.
constexpr PetscReal rounding = 1e-8;

/// More of the lung than this is no single place.
constexpr PetscReal large_share = 0.1;

/// Distance of a point from a segment.
PetscReal distance(const PetscReal x[3], const RimSegment &s)
{
  PetscReal along = 0, length = 0, square = 0;
  for (int d = 0; d < 3; ++d) {
    along += (x[d] - s[d]) * (s[3 + d] - s[d]);
    length += (s[3 + d] - s[d]) * (s[3 + d] - s[d]);
  }
  const PetscReal t = length > 0 ? std::clamp<PetscReal>(along / length, 0, 1) : 0;
  for (int d = 0; d < 3; ++d) {
    const PetscReal away = x[d] - s[d] - t * (s[3 + d] - s[d]);
    square += away * away;
  }
  return std::sqrt(square);
}

PetscReal length_of(const RimSegment &s)
{
  return std::hypot(s[3] - s[0], s[4] - s[1], s[5] - s[2]);
}

/// Distance of the cell from the edge of the airway and whether that is within two cells. Collective.
PetscErrorCode look_at_rim(const Scene &scene, const Measures &cell, std::optional<PetscReal> &away, bool &near)
{
  const Mesh &mesh = scene.mesh();
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  PetscMPIInt rank;
  PetscInt begin;
  PetscReal edge = 0;
  std::vector<std::string> names;
  std::vector<RimSegment> rim;

  PetscFunctionBeginUser;
  near = false;
  for (const std::string &name : scene.facts().airway_surfaces)
    if (mesh.surfaces().count(name)) names.push_back(name);
  PetscCall(find_rim(mesh, names, rim));
  if (rim.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == cell.rank && cell.cell >= 0) {
    PetscReal volume;
    PetscCall(DMPlexGetHeightStratum(mesh.dm(), 0, &begin, nullptr));
    PetscCall(DMPlexComputeCellGeometryFVM(mesh.dm(), begin + cell.cell, &volume, nullptr, nullptr));
    edge = 2 * std::cbrt(volume);
  }
  PetscCallMPI(MPI_Bcast(&edge, 1, MPIU_REAL, cell.rank, comm));
  const auto nearest = std::min_element(rim.begin(), rim.end(), [&](const RimSegment &a, const RimSegment &b) {
    return distance(cell.where, a) < distance(cell.where, b);
  });
  away = distance(cell.where, *nearest);
  near = *away <= rim_reach * std::max(edge, length_of(*nearest));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Mean deformation gradient of each cell: share of the volume whose mean is not elliptic; and that of the whole lung.
PetscErrorCode look_at_tissue(const Scene &scene, const Model &model, Vec local, Diagnosis &d)
{
  const TissueLaw &law = scene.tissue().law();
  const MPI_Comm comm = PetscObjectComm((PetscObject)model.dm());
  const PetscScalar zero[9] = {0};
  PetscScalar mean[9];
  PetscReal sums[12] = {0}; // Grad u, J - 1, lost volume, volume
  PointState state;
  Sampling sampling;
  std::vector<PointSample> samples;

  PetscFunctionBeginUser;
  const std::vector<PetscScalar> all_over = model.composition().constants(model.step());
  make_point_state(zero, nullptr, state);
  d.acoustic_at_rest = acoustic_stiffness(law, state, true, all_over.data()).least;
  const auto lost = [&](PetscReal stiffness, PetscReal at_rest) {
    return stiffness < std::max<PetscReal>(no_stiffness * at_rest, 0) - rounding * model.modulus();
  };
  const bool varies = model.composition().varying() != nullptr;
  const auto at_rest = [&](const PetscScalar *constants) { // in the state at hand, which is that
    return varies ? acoustic_stiffness(law, state, true, constants).least : d.acoustic_at_rest;
  };
  PetscCall(sampling.setup(model));
  {
    const ReadArray x(local);
    for (const Sampling::Element &cell : sampling.cells()) {
      PetscScalar H[9] = {0};
      const auto &weights = sampling.weights(cell);
      sampling.sample(cell, x.data(), samples);
      for (std::size_t q = 0; q < weights.size(); ++q) {
        for (int i = 0; i < 9; ++i) H[i] += weights[q] * samples[q].state.H[i];
        sums[9] += weights[q] * cell.measure * samples[q].state.J_minus_1;
      }
      for (int i = 0; i < 9; ++i) sums[i] += cell.measure * H[i];
      const PetscScalar *constants = model.constants_at(cell.cell);
      make_point_state(H, nullptr, state);
      const PetscReal least = acoustic_stiffness(law, state, false, constants).least;
      make_point_state(zero, nullptr, state);
      if (lost(least, at_rest(constants))) sums[10] += cell.measure;
      sums[11] += cell.measure;
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums, 12, MPIU_REAL, MPI_SUM, comm));
  for (int i = 0; i < 9; ++i) mean[i] = sums[i] / sums[11];
  d.mean_J = 1 + sums[9] / sums[11];
  d.lost_share = sums[10] / sums[11];
  make_point_state(mean, nullptr, state);
  d.acoustic = acoustic_stiffness(law, state, true, all_over.data()).least;
  d.acoustic_lost = lost(d.acoustic, d.acoustic_at_rest);
  const auto inflation = [&](PetscReal J) {
    const auto film = scene.facts().film_stiffness;
    return inflation_stiffness(law, J, all_over.data()) + (film ? film(J, all_over.data()) : 0);
  };
  d.inflation = inflation(d.mean_J);
  d.inflation_lost = lost(d.inflation, inflation(1));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A sentence on a limit point, that begins with a blank.
std::string sentence(const LimitPoint &limit)
{
  std::ostringstream text;
  text.precision(4);
  text << " Volume follows pressure ever more steeply, by " << limit.last << " ml/cmH2O in the last step and "
       << limit.on_the_way << " on the way there: a limit point. There is no equilibrium "
       << (limit.highest ? "above " : "below ");
  text.precision(6);
  text << limit.pressure << " cmH2O.";
  return text.str();
}

const FailedAttempt *last_inverted(const FailureFacts &facts)
{
  const auto found =
      std::find_if(facts.attempts.rbegin(), facts.attempts.rend(), [](const auto &f) { return f.inverted; });
  return found != facts.attempts.rend() ? &*found : nullptr;
}

/// Whether the last attempts all failed in the linear solver.
bool linear_solver_failed(const FailureFacts &facts)
{
  return !facts.attempts.empty() && facts.attempts.back().reason.find("LINEAR") != std::string::npos;
}

/// The option that bounds the changes of a step, if the last attempt was solved but changed more
/// (StepBound::complaint); else empty.
std::string low_bound(const FailureFacts &facts)
{
  if (facts.attempts.empty()) return "";
  const std::string &reason = facts.attempts.back().reason;
  return reason.rfind("-step_", 0) == 0 ? reason.substr(0, reason.find(':')) : "";
}

/// What the diagnosis says, in a sentence that begins with a blank.
std::string why(const Scene &scene, const FailureFacts &facts, const Diagnosis &d)
{
  std::ostringstream text;
  text.precision(4);
  const char *law = scene.tissue().law().name();
  const auto stiffness = [&] {
    text << "at the mean J = " << d.mean_J << " free inflation has dp/dJ = " << d.inflation / units::kPa_per_cmH2O
         << " cmH2O, and the least stiffness against a plane wave (acoustic tensor, at the mean deformation) is "
         << d.acoustic << " kPa, " << d.acoustic_at_rest << " at rest";
    if (d.lost_share > 0) text << "; in " << 100 * d.lost_share << " % of the lung next to nothing of it is left";
    text << ".";
  };
  switch (d.kind) {
  case Diagnosis::Kind::rim:
    text << " Where: at the airway's rim. That cell is " << *d.from_rim
         << " mm from the edge of the airway, within two cells.";
    break;
  case Diagnosis::Kind::everywhere:
    text << " Where: everywhere. The law " << law << (scene.facts().film_stiffness ? ", with its film," : "")
         << " has no stiffness left at this stretch: ";
    stiffness();
    break;
  case Diagnosis::Kind::inside:
    text << " Where: inside the lung, in one place";
    if (d.lost_share > 0) {
      text << "; the law " << law << " loses its stiffness there: ";
      stiffness();
    } else {
      text << ".";
    }
    break;
  case Diagnosis::Kind::solver:
    text << " Where: in the solver. "
         << (!low_bound(facts).empty()
                 ? "The bound of " + low_bound(facts) + " asks for shorter steps than there may be"
             : linear_solver_failed(facts) ? "The linear solver failed"
                                           : "Newton's method stalled")
         << " while no cell of the last step is near turning inside out (least J = " << facts.rows.back().min_J
         << ") and the law " << law << " is elliptic" << (d.lost_share > 0 ? " in the mean: " : ": ");
    stiffness();
    break;
  }
  return text.str() + d.limit + (d.own_limit ? own_limit_text(scene, *d.own_limit) : "");
}

std::string what_to_try(const Scene &scene, const FailureFacts &facts, const Diagnosis &d)
{
  bool wall = false; // the gas presses on it
  for (const Effect *effect : scene.active()) wall = wall || effect->name() == std::string("lumen_pressure");
  switch (d.kind) {
  case Diagnosis::Kind::rim:
    return std::string(wall ? "" : "-lumen_pressure (here it is off: nothing but springs bears the airway's wall), ") +
           "a finer mesh there, a slower rise or fall of pressure or flow, another -tissue.";
  case Diagnosis::Kind::everywhere:
    return std::string("less pressure or volume, ") +
           (facts.could_flow_on && !d.limit.empty() ? "-ventilator_on_limit_point flow, or " : "") +
           "prescribed flow (-ventilator vcv), which goes on beyond a limit point of the pressure, more that holds the "
           "lung (-chest_wall), another -tissue.";
  case Diagnosis::Kind::inside:
    return "a finer mesh there, a slower rise or fall of pressure or flow, another -tissue.";
  case Diagnosis::Kind::solver:
    break;
  }
  if (const std::string bound = low_bound(facts); !bound.empty())
    return "a larger " + bound + ", a smaller -ts_adapt_dt_min, a slower rise or fall of pressure or flow.";
  return std::string(scene.facts().surface_pressures_by.empty()
                         ? ""
                         : "the sizes and resistances of -" + scene.facts().surface_pressures_by +
                               " (are their units right?), ") +
         "another file of petsc_options/solvers, a smaller -ts_dt, a larger -snes_max_it, a slower rise or fall of "
         "pressure or flow, -snes_linesearch_type basic where volume is far stiffer than shape; -snes_monitor and "
         "-ksp_monitor "
         "show where it stalls.";
}

} // namespace

PetscErrorCode check_stable_at_rest(const Options &options, const Scene &scene, const Model &model)
{
  const TissueLaw &law = scene.tissue().law();
  const bool varies = model.composition().varying() != nullptr;
  PetscInt begin, end;
  std::string why, where, given;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(model.dm(), 0, &begin, &end));
  for (PetscInt c = 0; c < (varies ? end - begin : std::min<PetscInt>(1, end - begin)) && why.empty(); ++c) {
    PetscReal volume, x[3];
    why = unstable_at_rest(law, model.constants_at(c));
    if (why.empty() || !varies) continue;
    PetscCall(DMPlexComputeCellGeometryFVM(model.dm(), begin + c, &volume, x, nullptr));
    std::ostringstream text;
    text << " at (" << x[0] << ", " << x[1] << ", " << x[2] << ") mm";
    where = text.str();
  }
  const MPI_Comm comm = options.comm();
  PetscCall(from_first(comm, why));
  PetscCall(from_first(comm, where)); // of the same rank
  if (why.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const auto &[name, value] : options.own_used()) // those of other laws are not in use
    if (name.rfind("-tissue_", 0) == 0) given += (given.empty() ? "" : ", ") + name + " " + value;
  PulmoUserError(comm,
                 "-tissue %s%s is not stable at rest: %s; change its parameters (%s; -help has the published ones), or "
                 "take another law",
                 law.name(), where.c_str(), why.c_str(), given.c_str());
}

std::optional<LimitPoint> limit_point(const std::vector<SignalRow> &rows, const Measures &last)
{
  std::size_t first = rows.size() - 1;
  if (!(last.min_J > well_formed) || rows.back().past_limit) return {};
  while (first > 0 && rows[first - 1].phase == rows.back().phase && rows[first - 1].breath == rows.back().breath &&
         !rows[first - 1].past_limit)
    --first;
  if (first + 2 >= rows.size()) return {};
  const SignalRow &begin = rows[first], &before = rows[rows.size() - 2], &end = rows.back();
  const double step = end.pressure - before.pressure, way = before.pressure - begin.pressure;
  const LimitPoint limit = {end.pressure, step > 0, (end.volume - before.volume) / step,
                            (before.volume - begin.volume) / way};
  if (!(step * way > 0 && limit.last > limit_steepness * limit.on_the_way && limit.on_the_way > 0)) return {};
  return limit;
}

const char *Diagnosis::name() const
{
  switch (kind) {
  case Kind::rim:
    return "airway rim";
  case Kind::everywhere:
    return "everywhere";
  case Kind::inside:
    return "inside";
  case Kind::solver:
    break;
  }
  return "solver";
}

PetscErrorCode diagnose(const Scene &scene, const Model &model, const FailureFacts &facts, Vec local, Diagnosis &d)
{
  const FailedAttempt *inverted = last_inverted(facts);
  Measures last;
  bool at_rim = false;

  PetscFunctionBeginUser;
  d = Diagnosis();
  PetscCall(look_at_tissue(scene, model, local, d));
  PetscCall(look_at_own_limit(scene, model, local, d.lost_share, d.own_limit));
  PetscCall(model.measure(local, last));
  const bool well = last.min_J > well_formed;
  if (inverted)
    d.worst = inverted->measures;
  else if (!well)
    d.worst = last;
  if (d.worst) PetscCall(look_at_rim(scene, *d.worst, d.from_rim, at_rim));
  // tissue that folds at a rim gives way, too; at a limit point all of it is well, and only attempts turn it inside out
  if (const auto limit = limit_point(facts.rows, last); limit && facts.prescribes_pressure) d.limit = sentence(*limit);
  if (!d.limit.empty() || d.acoustic_lost)
    d.kind = Diagnosis::Kind::everywhere;
  else if (linear_solver_failed(facts) && !facts.attempts.back().inverted && last.min_J > folded)
    d.kind = Diagnosis::Kind::solver; // longer steps turned tissue inside out; the shortest ones, that count, did not
  else if (at_rim)
    d.kind = Diagnosis::Kind::rim;
  else if (d.lost_share > large_share || d.inflation_lost)
    d.kind = Diagnosis::Kind::everywhere;
  else if (d.worst)
    d.kind = Diagnosis::Kind::inside;
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string failure_text(const Scene &scene, const FailureFacts &facts, const Diagnosis &d)
{
  const SignalRow &last = facts.rows.back();
  const FailedAttempt *inverted = last_inverted(facts);
  std::ostringstream text;

  text.precision(6);
  text << (facts.crawled ? "steps only crawl at t = " : "no step could be accepted after t = ") << last.time
       << " s (phase " << facts.phase << ", airway pressure " << last.pressure << " cmH2O, volume " << last.volume
       << " ml, tissue law " << scene.tissue().law().name() << ", J from " << last.min_J << " to " << last.max_J
       << ").";
  if (inverted) {
    const Measures &m = inverted->measures;
    if (m.airless())
      text << " There was no air left: J = " << m.min_air + m.airless_J << ", 1 - Phi0 = " << m.airless_J;
    else
      text << " The tissue turned inside out: J = " << m.min_J;
    text << " in the cell at (" << m.where[0] << ", " << m.where[1] << ", " << m.where[2] << ") mm (cell " << m.cell
         << " of rank " << m.rank << ").";
  }
  text << " Tried";
  for (const FailedAttempt &f : facts.attempts) {
    text << (&f == &facts.attempts.front() ? " " : ", ") << "dt " << f.dt << " s (" << f.reason;
    if (f.newton > 0) text << " after " << f.newton << " Newton steps";
    if (f.newton > 0 && f.inverted) text << (f.measures.airless() ? ", no air on the way" : ", J <= 0 on the way");
    text << ")";
  }
  text << "." << why(scene, facts, d);
  std::string first;
  if (inverted && inverted->measures.airless())
    first =
        "less suction or load, the lung's own -tissue_porosity, -airflow_permeability_law constant (it goes on, with "
        "a warning), ";
  if (facts.free_flow && scene.openings()) {
    const std::string unequal = scene.openings()->unequal_shares();
    if (!unequal.empty()) {
      text << " -ventilator_flow_split uniform shares the flow by area: " << unequal << ".";
      first += "-ventilator_flow_split common_pressure, ";
    }
  }
  if (facts.past_limit) {
    text << " A flow is prescribed here, past a limit point of the pressure (-ventilator_on_limit_point).";
    first += "another -ventilator_limit_point_flow, ";
  }
  text << " What to try: " << first << what_to_try(scene, facts, d);
  return text.str();
}

} // namespace pulmo
