// The check of the backward sweep: it gives what differences of whole runs give.
#include "unit/harness.hpp"

#include "pulmo/adjoint/sensitivities.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo::test {

namespace {

/// Parameters of an effect, and of the tissue, that are looked at.
constexpr std::size_t most = 2;

/// A run of two phases, its volume, flow and pressure in a step of the first and at its end.
struct ShortRun {
  std::vector<double> numbers;
  std::vector<SensitivityReport::Parameter> parameters; ///< if it sweeps
  std::string obstacle, failure;
};

PetscErrorCode run(const Subject &subject, const std::string &more, bool sweeps, ShortRun &result)
{
  SceneRun run(subject.registry);
  Trajectory trajectory(std::size_t(1) << 30, testing::TempDir());
  Quiet::Said said;
  bool done = false;

  PetscFunctionBeginUser;
  const std::string scheme = subject.effects.size() > 1 ? "-ts_type bdf " : ""; // each effect meets both
  const PetscErrorCode code = build(
      run, subject.options() + "-ts_dt 0.05 -ts_max_time 0.3 -snes_rtol 1e-13 -ksp_pc_side right " + scheme + more,
      &said);
  if (code == PETSC_ERR_USER_INPUT) {
    result.obstacle = said.errors;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(code);
  result.obstacle = Sweep::obstacle(run.scene(), run.model());
  if (sweeps && !result.obstacle.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  if (sweeps) run.simulation().record(trajectory);
  {
    const Quiet quiet;
    PetscCall(run.simulation().run(done));
  }
  if (!done) result.failure = run.simulation().failure_text();
  if (!done) PetscFunctionReturn(PETSC_SUCCESS);
  const std::vector<SignalRow> &rows = run.simulation().rows();
  std::vector<Functional> list;
  for (const std::size_t row : {std::size_t(2), rows.size() - 1})
    for (int which = 0; which < 3; ++which) {
      Functional f;
      for (auto *gradient : {&f.by_volume, &f.by_pressure, &f.by_flow}) gradient->assign(rows.size(), 0);
      (which == 0 ? f.by_volume : which == 1 ? f.by_pressure : f.by_flow)[row] = 1;
      list.push_back(f);
      const SignalRow &r = rows[row];
      result.numbers.push_back(which == 0 ? r.volume : which == 1 ? r.machine_pressure() : r.flow);
    }
  if (!sweeps) PetscFunctionReturn(PETSC_SUCCESS);
  SensitivityReport report;
  Sweep sweep(run.scene(), run.model(), run.simulation(), trajectory);
  PetscCall(add_derivatives(run.options(), run.scene(), run.model(), sweep, list, 1e-13, report));
  result.failure = report.failure;
  const auto is_of = [](const SensitivityReport::Parameter &p, const std::string &effect) {
    return p.option.rfind("-" + effect + "_", 0) == 0;
  };
  std::map<std::string, std::size_t> taken;
  for (const SensitivityReport::Parameter &p : report.parameters)
    for (const std::string &effect : {subject.effects.front(), std::string("tissue")})
      if (is_of(p, effect) && taken[effect]++ < most) result.parameters.push_back(p);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode check_adjoint(const Subject &subject, Findings &findings)
{
  constexpr double tolerated = 1e-5, least = 1e-7;
  const bool meet = subject.effects.size() > 1;
  const double share = meet ? 2e-6 : 1e-4; // where kinks of two effects meet, no point is to cross one
  const std::string names[] = {"the volume", "the pressure", "the flow"};
  ShortRun swept;

  PetscFunctionBeginUser;
  PetscCall(run(subject, "", true, swept));
  if (!swept.obstacle.empty()) PetscFunctionReturn(PETSC_SUCCESS); // refused in that sentence
  if (meet && swept.failure.rfind("the solver leaves", 0) == 0) PetscFunctionReturn(PETSC_SUCCESS); // told
  if (!swept.failure.empty()) findings.push_back("its sweep fails: " + swept.failure);
  for (const SensitivityReport::Parameter &p : swept.parameters) {
    std::vector<double> change(swept.numbers.size(), 0);
    for (const double by : {-1, 1}) {
      ShortRun moved;
      std::ostringstream option;
      option.precision(17);
      option << p.option << " " << p.value * (1 + by * share);
      PetscCall(run(subject, option.str(), false, moved));
      if (!moved.obstacle.empty()) { // two effects have to agree about it
        change.clear();
        break;
      }
      if (!moved.failure.empty() || moved.numbers.size() != change.size()) {
        findings.push_back("its run with " + option.str() + " fails: " + moved.failure);
        PetscFunctionReturn(PETSC_SUCCESS);
      }
      for (std::size_t k = 0; k < change.size(); ++k) change[k] += by * moved.numbers[k] / (2 * share);
    }
    for (std::size_t k = 0; k < change.size(); ++k)
      if (const double found = p.derivative[k] * p.value;
          !(std::abs(found - change[k]) <=
            tolerated * std::abs(change[k]) +
                least * (std::abs(swept.numbers[k % 3]) + std::abs(swept.numbers[k % 3 + 3]))))
        findings.push_back(names[k % 3] + " changes by " + shown(change[k]) + " with " + p.option +
                           ", by the sweep by " + shown(found));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
