// Error bars by one sweep back over the run.
#include "pulmo/program/error_estimate.hpp"

#include "pulmo/adjoint/error_parts.hpp"
#include "pulmo/adjoint/periodicity.hpp"
#include "pulmo/adjoint/recording.hpp"
#include "pulmo/observers/output.hpp"
#include "pulmo/observers/regions.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Where more than this share of a number is a guess of a sweep's part in time, that part is not resolved.
constexpr double guessed = 1e-3;

} // namespace

PetscErrorCode ErrorEstimate::make_by_sweep(const Options &options, const Scene &scene, Model &model,
                                            Simulation &simulation, const Recording &recording,
                                            const RegionAudit &regions, FieldWriter &fields, ErrorReport &report) const
{
  const MPI_Comm comm = options.comm();
  Sweep sweep(scene, model, simulation, recording.trajectory());
  ErrorParts parts(scene, model, simulation, recording.trajectory());
  const std::vector<SignalRow> rows = regions.complete(simulation.rows());
  const std::vector<ClinicalEntry> numbers = regions.numbers(simulation.rows());
  Periodicity periodicity(scene, rows, recording.trajectory());
  std::vector<Functional> functionals;
  std::vector<std::pair<std::string, std::vector<PetscReal>>> in_space;
  PetscLogDouble begin, end;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&begin));
  report.method = "sweep";
  report.levels.resize(1);
  PetscCall(describe(simulation, scene, report.levels.front()));
  report.levels.front().name = "the run itself";
  report.levels.front().seconds = simulation.seconds().total;
  report.levels.front().numbers = numbers;
  PetscCall(recording.complaint(comm, report.failure));
  if (!report.failure.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  for (const std::string &name : names_.empty() ? functional_names() : names_) {
    const auto f = functional(name, rows, parts.kinks(), &regions);
    if (f)
      functionals.push_back(*f);
    else if (!names_.empty())
      PetscCall(PetscPrintf(comm, "pulmo: note: -error_estimate_numbers: this run has no %s\n", name.c_str()));
  }
  const std::size_t asked = functionals.size();
  // R tells best of cells that are too large, for the other numbers too
  const auto witness = functional("R", rows, parts.kinks());
  if (asked > 0 && witness && std::find(names_.begin(), names_.end(), "R") == names_.end() && !names_.empty())
    functionals.push_back(*witness);
  if (functionals.empty()) {
    report.failure = "the run has none of the numbers";
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  StopSignal signal(comm);
  sweep.heed(signal);
  periodicity.ask(sweep);
  PetscCall(PetscPrintf(comm, "\nError estimate: a sweep back over %d steps\n",
                        static_cast<int>(simulation.rows().size()) - 1));
  PetscCall(parts.run(sweep, functionals, recording.tolerance(), report.failure));
  PulmoFailureCheck(!sweep.stopped(), comm,
                    "stopped by %s while the errors were estimated; the run itself is whole, without error bars",
                    signal.name());
  if (!report.failure.empty()) PetscFunctionReturn(PETSC_SUCCESS); // its parts are of some steps only
  std::vector<ClinicalEntry> entries;
  double largest_share = 0;
  for (std::size_t k = 0; k < functionals.size(); ++k) {
    const Functional &f = functionals[k];
    const auto entry =
        std::find_if(numbers.begin(), numbers.end(), [&](const ClinicalEntry &e) { return f.key == e.key; });
    if (f.part) {
      entries.push_back({f.key, "ventilation of " + f.part->region, f.unit, f.value});
    } else {
      PetscCheck(entry != numbers.end() && entry->value, PETSC_COMM_SELF, PETSC_ERR_PLIB, "no clinical number %s",
                 f.key.c_str());
      entries.push_back(*entry);
    }
    largest_share = std::max(largest_share, space_share(entries.back(), parts.lacking()[k]));
    if (k < asked) in_space.emplace_back("lacks_in_space_" + f.key, parts.in_space()[k]);
  }
  const bool early = ended_early(scene, simulation.rows());
  for (std::size_t k = 0; k < asked; ++k) {
    const bool resolved = functionals[k].resolved && parts.rough_in_time(k) <= guessed * std::abs(*entries[k].value);
    std::optional<Unresolved> trouble;
    if (early)
      trouble = Unresolved::phase_ended_early;
    else if (!resolved)
      trouble = Unresolved::few_steps_in_a_phase;
    report.bars.push_back(lacking_bar(entries[k], parts.lacking()[k], largest_share, trouble));
    report.bars.back().more_breaths = periodicity.change(functionals[k], k);
  }
  PetscCall(fields.write_cells("errors", in_space));
  PetscCall(PetscTime(&end));
  report.sweep_seconds = end - begin;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
