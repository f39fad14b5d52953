// Checks of runs of a few steps: energy, restarts, ranks, time schemes.
#include "unit/harness.hpp"

#include "pulmo/observers/energy.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo::test {

namespace {

using Table = std::map<std::string, std::vector<double>>;

/// How far two tables are apart, column by column over its largest number; Newton's work aside.
void compare_tables(const Table &a, const Table &b, double tolerated, const std::string &what, Findings &findings)
{
  for (const auto &[name, column] : a) {
    if (name == "newton_iterations" || name == "krylov_iterations" || name == "residual_j") continue;
    const auto other = b.find(name);
    if (other == b.end() || other->second.size() != column.size()) {
      findings.push_back(what + ": column " + name + " is not there, or has other rows");
      return;
    }
    double largest = 0, apart = 0;
    for (std::size_t i = 0; i < column.size(); ++i) {
      largest = std::max(largest, std::abs(column[i]));
      apart = std::max(apart, std::abs(column[i] - other->second[i]));
    }
    if (!(apart <= tolerated * largest))
      findings.push_back(what + ": " + name + " differs by " + shown(apart / largest));
  }
}

bool finished(const Outcome &outcome, const std::string &what, Findings &findings)
{
  if (outcome.code == 0 && outcome.finished) return true;
  findings.push_back(what + " does not end well: " + outcome.said.errors);
  return false;
}

constexpr double same_ranks = 1e-9, other_ranks = 1e-8;

} // namespace

PetscErrorCode check_energy(const Subject &subject, Findings &findings)
{
  constexpr double tolerated = 1e-8;
  SceneRun run(subject.registry);
  Sampling sampling;
  EnergyAudit audit(run.scene(), run.model(), sampling);
  bool done = false;

  PetscFunctionBeginUser;
  PetscCall(build(run, subject.options() + "-ts_dt 0.1 -ts_max_time 0.3"));
  PetscCall(sampling.setup(run.model()));
  PetscCall(audit.setup());
  run.simulation().add(audit);
  {
    const Quiet quiet;
    PetscCall(run.simulation().run(done));
  }
  if (!done)
    findings.push_back("its run fails: " + run.simulation().failure_text());
  else if (!(audit.worst_share() < tolerated))
    findings.push_back("the energy does not balance: " + shown(audit.worst_share()) + " of the work has no account");
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A run that goes on from the middle against one that never stopped; on several ranks from the checkpoint of one.
PetscErrorCode check_restart(const Subject &subject, Findings &findings)
{
  // four steps, of which the first two belong to the ramp
  const std::string options =
      subject.options() + "-ts_max_time 0.2 -checkpoint_every 0.1 -ts_type " + subject.scheme + " ";
  const Folder folder;
  PetscMPIInt size, rank;
  Outcome whole;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  PetscCallMPI(MPI_Comm_rank(PETSC_COMM_WORLD, &rank));
  {
    const OneRank alone;
    whole = run_program(subject.registry, options, folder.path("whole_" + std::to_string(rank)));
  }
  if (!finished(whole, "a run", findings)) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCallMPI(MPI_Barrier(PETSC_COMM_WORLD));
  const Outcome rest =
      run_program(subject.registry, options + "-restart " + folder.path("whole_0") + "/checkpoint_previous.h5",
                  folder.path("rest"));
  if (!finished(rest, "a run that goes on", findings)) PetscFunctionReturn(PETSC_SUCCESS);
  for (const char *file : {"signals.csv", "energy.csv"})
    compare_tables(whole.table(file), rest.table(file), size == 1 ? same_ranks : other_ranks,
                   "after a restart under " + subject.scheme, findings);
  PetscCallMPI(MPI_Barrier(PETSC_COMM_WORLD)); // all have read
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// Whether tissue that is sheared at rest resists. Where it does so to the third power only (rausch), rounding shears
/// it.
bool resists_shear(const TissueLaw &law)
{
  constexpr PetscScalar rest[9] = {0};
  PointState state;
  PetscScalar A[81];
  make_point_state(rest, nullptr, state);
  law.tangent(state, A);
  return A[3 + 1] + A[9 + 3] > 1e-9 * A[0]; // dP_xy by F_xy and F_yx, dP_xx by F_xx
}

/// Signals, and the norm of the state at the end where the problem has but one.
PetscErrorCode signature(const Subject &subject, std::vector<double> &numbers, std::vector<std::string> &names)
{
  SceneRun run(subject.registry);
  bool done = false;

  PetscFunctionBeginUser;
  PetscCall(build(run, subject.options() + "-ts_max_time 0.15 -ts_dt 0.05"));
  {
    const Quiet quiet;
    PetscCall(run.simulation().run(done));
  }
  const auto add = [&](const std::string &name, double number) {
    names.push_back(name);
    numbers.push_back(number);
  };
  for (const SignalRow &row : run.simulation().rows()) {
    const std::string when = " at t = " + shown(row.time) + " s";
    add("the time", row.time);
    add("the pressure" + when, row.pressure);
    add("the flow" + when, row.flow);
    add("the volume" + when, row.volume);
    add("the largest J" + when, row.max_J);
  }
  PetscReal norm;
  PetscCall(VecNorm(run.simulation().state(), NORM_2, &norm));
  if (resists_shear(*run.scene().facts().law)) add("the norm of the state", norm);
  add("whether it ends well", done);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

/// Several ranks against one.
PetscErrorCode check_ranks(const Subject &subject, Findings &findings)
{
  PetscMPIInt size;
  std::vector<double> one, several;
  std::vector<std::string> names, other_names;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  if (size == 1) PetscFunctionReturn(PETSC_SUCCESS);
  {
    const OneRank alone;
    PetscCall(signature(subject, one, names));
  }
  PetscCall(signature(subject, several, other_names));
  if (names.size() != other_names.size()) {
    findings.push_back("steps are others on several ranks");
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  double largest = 0; // pressures in cmH2O, ml, ml/s: all of the order of one here
  for (const double v : one) largest = std::max(largest, std::abs(v));
  for (std::size_t i = 0; i < one.size() && findings.empty(); ++i)
    if (!(std::abs(one[i] - several[i]) <= other_ranks * largest))
      findings.push_back(names[i] + " is " + shown(several[i]) + " on several ranks, " + shown(one[i]) + " on one");
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// The volume at the end of a smooth run of @p steps steps.
PetscErrorCode final_volume(const Subject &subject, const std::string &scheme, int steps, double &volume,
                            Findings &findings)
{
  constexpr double end = 0.4;
  SceneRun run(subject.registry);
  bool done = false;

  PetscFunctionBeginUser;
  PetscCall(build(run, subject.options() + "-ventilator_inspiration 0.4 -ventilator_ramp 0.4 -ts_max_time " +
                           std::to_string(end) + " -ts_dt " + std::to_string(end / steps) + " -ts_type " + scheme));
  {
    const Quiet quiet;
    PetscCall(run.simulation().run(done));
  }
  if (!done) findings.push_back("its run under " + scheme + " fails: " + run.simulation().failure_text());
  volume = run.simulation().rows().back().volume;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

/// BDF2 has to come to what backward Euler comes to as steps get shorter, and to be there sooner.
PetscErrorCode check_schemes(const Subject &subject, Findings &findings)
{
  double coarse, fine, multistep;

  PetscFunctionBeginUser;
  PetscCall(final_volume(subject, "beuler", 8, coarse, findings));
  PetscCall(final_volume(subject, "beuler", 16, fine, findings));
  PetscCall(final_volume(subject, "bdf", 16, multistep, findings));
  const double limit = 2 * fine - coarse, least = 1e-6 * std::abs(limit);
  if (!(std::abs(multistep - limit) <= 0.5 * std::abs(fine - limit) + least))
    findings.push_back("BDF2 ends at " + shown(multistep) + " ml, backward Euler at " + shown(fine) +
                       " ml and with ever shorter steps at " + shown(limit) + " ml");
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
