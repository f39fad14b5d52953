// What a run prints at its end.
#include "pulmo/base/units.hpp"
#include "pulmo/observers/output.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// A fit to fewer steps of a breath says more of the steps than of the lung.
constexpr std::size_t least_steps = 10;

/// The balance of the last complete breath (without one: of the run), beside that of its inspiration.
PetscErrorCode print_energy(MPI_Comm comm, const EnergyAudit &audit, const BreathRows &breath, const char *span)
{
  const EnergyBalance whole = audit.rows()[breath.last] - audit.rows()[breath.first],
                      filling = audit.rows()[breath.fullest] - audit.rows()[breath.first];
  const auto line = [comm](const std::string &name, double a, double b) {
    return PetscPrintf(comm, "  %-28s %12.4g %12.4g J\n", name.c_str(), a, b);
  };

  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(comm, "\n%-30s %12s %12s\n", "Energy", span, "inspiration"));
  PetscCall(line("ventilator_work", whole.ventilator_work, filling.ventilator_work));
  for (std::size_t i = 0; i < audit.accounts().size(); ++i)
    if (whole.accounts[i] != 0 || filling.accounts[i] != 0)
      PetscCall(line((audit.accounts()[i].kind == Energy::external ? "+ " : "- ") + audit.accounts()[i].name,
                     whole.accounts[i], filling.accounts[i]));
  PetscCall(line("= residual", whole.residual, filling.residual));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_regions(MPI_Comm comm, const RegionAudit &audit, const BreathRows &breath)
{
  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(comm, "\n%-18s %10s %14s %7s %8s %8s %12s %8s\n", "Region", "rest ml", "ventilation ml",
                        "share", "J", "+-", "P cmH2O", "+-"));
  for (std::size_t r = 0; r < audit.regions().size(); ++r) {
    const RegionState &s = audit.state(breath.fullest, r);
    PetscCall(PetscPrintf(comm, "  %-16s %10.4g %14.4g %6.1f%% %8.4f %8.4f %12.4g %8.2g\n",
                          audit.regions()[r].name.c_str(), audit.volume(r), audit.ventilation(breath, r),
                          100 * audit.ventilation_share(breath, r).value_or(0), s.mean_J, s.sd_J, s.mean_pressure,
                          s.sd_pressure));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_gravity(MPI_Comm comm, const GravityAudit &audit, const BreathRows &breath)
{
  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(comm, "\n%-18s %10s %14s %7s %10s %8s\n", "Along gravity", "rest ml", "ventilation ml", "share",
                        "J at start", "J"));
  for (int t = 0; t < n_thirds; ++t)
    PetscCall(PetscPrintf(comm, "  %-16s %10.4g %14.4g %6.1f%% %10.4f %8.4f\n", gravity_thirds[t], audit.volume(t),
                          audit.ventilation(breath, t), 100 * audit.ventilation_share(breath, t).value_or(0),
                          audit.mean_J(breath.first, t), audit.mean_J(breath.fullest, t)));
  PetscCall(PetscPrintf(comm, "  the lung weighs %.4g g; J grows upwards by %.3g per cm at the start, %.3g full\n",
                        audit.weight(), audit.gradient(breath.first), audit.gradient(breath.fullest)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What numbers the last complete breath does not define, or defines badly.
PetscErrorCode print_notes_of_breath(MPI_Comm comm, const std::vector<SignalRow> &rows)
{
  const auto breaths = complete_breaths(rows);

  PetscFunctionBeginUser;
  if (breaths.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const BreathRows &last = breaths.back();
  const ClinicalNumbers n = clinical_numbers(rows, last.first, last.last);
  const int breath = rows[last.last].breath;
  const std::size_t steps = last.last - last.first;
  if (!n.moves)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: breath %d moves no gas (its volume changes by less than 1e-9 of the lung's): "
                          "compliances, resistances and the time constant are null\n",
                          breath));
  if (!n.takes_in)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: in breath %d the volume falls below that of the breath's start by %.3g ml and "
                          "rises above it by %.3g ml: tidal volume, strain and end of inspiration are not defined, and "
                          "null; let the breath begin with the phase that fills the lung (in a programme: the word "
                          "'breath')\n",
                          breath, n.fall, n.tidal_volume));
  if ((n.compliance || n.equal_weight_compliance) && steps < least_steps)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: C_rs and R are fitted to the %d steps of breath %d, which are too few; give a "
                          "-ts_dt with which a breath takes %d steps or more\n",
                          (int)steps, breath, (int)least_steps));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What the clinical numbers leave out, or what they are not yet.
PetscErrorCode print_notes(MPI_Comm comm, const Scene &scene, const std::vector<SignalRow> &rows)
{
  const auto breaths = breath_rows(rows);
  const auto unsettled = unsettled_volume(rows);
  const auto unsteady = unsteadiness(rows);

  PetscFunctionBeginUser;
  if (complete_breaths(rows).empty())
    PetscCall(PetscPrintf(comm, "\nNo numbers of a breath: %s.\n", why_no_numbers(scene, rows).c_str()));
  if (breaths.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const SignalRow &end = rows.back();
  const ClinicalNumbers n = clinical_numbers(rows, breaths.back().first, breaths.back().last);
  if (end.cut)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: the run ends at t = %.6g s, within breath %d, which would end at %.6g s: that "
                          "breath has no numbers\n",
                          end.time, end.breath, *end.cut));
  const bool driven = n.peak_pressure > n.peep || n.fall > 0; // else what changes is what came before it
  if (unsteady && driven && !unsteady->steady())
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: not a steady breath yet: %s: %.3g %% (steady: up to %.3g %%); more breaths, or "
                          "longer ones, tell whether the numbers still change\n",
                          unsteady->what.c_str(), 100 * unsteady->change, 100 * Unsteadiness::tolerated));
  PetscCall(print_notes_of_breath(comm, rows));
  const double tidal = n.takes_in ? n.tidal_volume : n.fall;
  if (unsettled && n.moves && driven && *unsettled > unsettled_tolerated * tidal)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: the first breath starts at t = %.6g s before the lung is at rest: at least "
                          "%.3g ml are still to come, %.3g %% of the tidal volume, and count as breath; give a longer "
                          "-ventilator_settle_duration (in a programme: a longer phase before the first breath)\n",
                          rows[breaths.front().first].time, *unsettled, 100 * *unsettled / tidal));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// How far the numbers are from those of periodic breaths, where that is more than a part of their bars.
PetscErrorCode print_more_breaths(MPI_Comm comm, const std::vector<ErrorBar> &bars)
{
  constexpr double counts = 0.2, plain = 1e-4; // of the bar; of the number, where there is no bar
  const auto change = [](const ErrorBar &bar) { return bar.more_breaths->periodic.value_or(bar.more_breaths->next); };
  std::vector<ErrorBar> told;
  std::string list;

  PetscFunctionBeginUser;
  for (const ErrorBar &bar : bars)
    if (bar.more_breaths &&
        std::abs(change(bar)) > (bar.total() ? counts * *bar.total() : plain * std::abs(*bar.entry.value)))
      told.push_back(bar);
  if (told.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const bool limit =
      std::all_of(told.begin(), told.end(), [](const ErrorBar &bar) { return bar.more_breaths->periodic.has_value(); });
  for (const ErrorBar &bar : told) {
    const double by = limit ? change(bar) : bar.more_breaths->next;
    char text[128];
    std::snprintf(text, sizeof(text), "%s by %+.2g (%+.2g %%)", bar.entry.label.c_str(), by,
                  100 * by / *bar.entry.value);
    list += (list.empty() ? "" : ", ") + std::string(text);
  }
  PetscCall(PetscPrintf(comm,
                        "  Breaths are not periodic yet, and the bars do not include this. %s, these change: %s\n",
                        limit ? "Until they are" : "With one more breath", list.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode print_numbers(MPI_Comm comm, const Output &output, const Scene &scene, const Simulation &simulation,
                             const Audits &audits)
{
  const std::vector<SignalRow> rows = audits.regions.complete(simulation.rows());
  const BreathRows breath = last_breath(rows);

  PetscFunctionBeginUser;
  const bool breathes = !complete_breaths(rows).empty();
  if (breathes) {
    PetscCall(PetscPrintf(comm, "\n%s tissue, %.0f ml at rest: clinical numbers of breath %d\n",
                          scene.tissue().law().name(), (double)(scene.mesh().volume() / units::mm3_per_ml),
                          rows[breath.last].breath));
    for (const ClinicalEntry &e : audits.regions.numbers(simulation.rows())) {
      if (!e.value) continue;
      const double shown = std::abs(*e.value) < 1e-9 ? 0 : *e.value; // what the solver left of a zero
      PetscCall(PetscPrintf(comm, "  %-28s %12.4g %s\n", e.label.c_str(), shown, e.unit.c_str()));
    }
  }
  if (scene.facts().ventilator) PetscCall(print_notes(comm, scene, rows));
  if (audits.energy) PetscCall(print_energy(comm, *audits.energy, breath, breathes ? "breath" : "run"));
  if (audits.regions.regions().size() > 1) PetscCall(print_regions(comm, audits.regions, breath));
  if (audits.gravity) PetscCall(print_gravity(comm, *audits.gravity, breath));
  PetscCall(PetscPrintf(comm, "\nSmallest J %.4f", (double)simulation.min_J()));
  if (scene.facts().airflow)
    PetscCall(PetscPrintf(comm, "; air lost by the numbers: %.2g ml",
                          (double)(simulation.mass_balance_error() / units::mm3_per_ml)));
  PetscCall(PetscPrintf(comm, ".\nWrote %s, %s, %s.\n", output.path("signals.csv").c_str(),
                        output.path("summary.json").c_str(), output.path("fields.xdmf").c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_error_bars(MPI_Comm comm, const ErrorReport &report)
{
  const auto part = [](const std::optional<double> &v) {
    char text[32] = "?";
    if (v) std::snprintf(text, sizeof(text), "%.2g", *v);
    return std::string(text);
  };
  const ErrorLevel &run = report.levels.front();

  PetscFunctionBeginUser;
  const bool swept = report.method == "sweep";
  if (!report.failure.empty()) {
    PetscCall(PetscPrintf(comm, "pulmo: warning: no error estimate: %s\n", report.failure.c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(PetscPrintf(comm, "\n%-52s %9s %9s %9s%s\n", "Numerical errors (docs/accuracy/error_bars.md)", "time",
                        "space", "solver", swept ? "   corrected" : ""));
  for (const ErrorBar &bar : report.bars) {
    std::string rest = bar.unresolved.empty() ? "" : "   not resolved: " + bar.unresolved_words();
    if (bar.corrected) {
      char text[64];
      std::snprintf(text, sizeof(text), "   %.4g ± %.2g", *bar.corrected, *bar.corrected_error);
      rest = text;
    }
    PetscCall(PetscPrintf(comm, "  %-28s %10.4g ± %-7s %-10s %9s %9s %9s%s\n", bar.entry.label.c_str(),
                          *bar.entry.value, part(bar.total()).c_str(), bar.entry.unit.c_str(), part(bar.time).c_str(),
                          part(bar.space).c_str(), part(bar.solver).c_str(), rest.c_str()));
  }
  PetscCall(print_more_breaths(comm, report.bars));
  for (const ErrorLevel &level : report.levels)
    if (!level.failure.empty())
      PetscCall(PetscPrintf(comm, "  ?: %s: %s\n", level.name.c_str(), level.failure.c_str()));
  PetscCall(PetscPrintf(comm, "The bars took %.3g s beside the %.3g s of the run (%+.0f %%)%s", report.extra_seconds(),
                        run.seconds, 100 * report.extra_seconds() / run.seconds, swept ? ": one sweep back" : ":"));
  for (std::size_t i = 1; i < report.levels.size(); ++i)
    PetscCall(
        PetscPrintf(comm, "%s %s %.3g s", i > 1 ? "," : "", report.levels[i].name.c_str(), report.levels[i].seconds));
  PetscCall(PetscPrintf(comm, ".\n"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_sensitivities(MPI_Comm comm, const SensitivityReport &report, double run_seconds)
{
  PetscFunctionBeginUser;
  std::string undefined;
  for (const std::string &name : report.undefined) undefined += (undefined.empty() ? "" : ", ") + name;
  if (!undefined.empty())
    PetscCall(PetscPrintf(
        comm,
        "pulmo: note: -sensitivities: this run has no %s, or no more of it than rounding (docs/clinical.md tells "
        "when a number is defined)\n",
        undefined.c_str()));
  if (!report.failure.empty()) {
    PetscCall(PetscPrintf(comm, "pulmo: warning: no sensitivities: %s\n", report.failure.c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (report.numbers.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(comm, "\n%-36s %12s", "1 % more of it changes, by %", ""));
  for (const SensitivityReport::Number &n : report.numbers) PetscCall(PetscPrintf(comm, " %8s", n.name.c_str()));
  for (const SensitivityReport::Parameter &p : report.parameters) {
    if (p.varies) {
      PetscCall(PetscPrintf(comm, "\n  %-34s differs from place to place: see summary.json", p.option.c_str()));
      continue;
    }
    PetscCall(PetscPrintf(comm, "\n  %-34s %12.5g", p.option.c_str(), p.value));
    for (std::size_t k = 0; k < report.numbers.size(); ++k) {
      const auto percent = report.percent(p, k);
      PetscCall(percent ? PetscPrintf(comm, " %8.3f", *percent) : PetscPrintf(comm, " %8s", "-"));
    }
  }
  // zeros are many, and expected
  std::vector<std::pair<std::string, std::string>> reasons; // why, and of which
  for (const SensitivityReport::LeftOut &one : report.left_out) {
    if (one.zero) continue;
    const auto known =
        std::find_if(reasons.begin(), reasons.end(), [&](const auto &reason) { return reason.first == one.why; });
    if (known == reasons.end())
      reasons.emplace_back(one.why, one.option);
    else
      known->second += ", " + one.option;
  }
  for (const auto &[why, options] : reasons)
    PetscCall(PetscPrintf(comm, "\nNot in the table: %s (%s).", options.c_str(), why.c_str()));
  PetscCall(PetscPrintf(comm, "\nThe sweep took %.3g s beside the %.3g s of the run (%+.0f %%).\n", report.seconds,
                        run_seconds, 100 * report.seconds / run_seconds));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
