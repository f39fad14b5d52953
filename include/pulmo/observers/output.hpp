/// @file
/// What a run leaves in its directory: signals.csv, summary.json, fields.xdmf with fields.h5, progress lines.
#pragma once

#include "pulmo/base/run_lock.hpp"
#include "pulmo/observers/energy.hpp"
#include "pulmo/observers/error_bars.hpp"
#include "pulmo/observers/gravity_audit.hpp"
#include "pulmo/observers/regions.hpp"
#include "pulmo/observers/sensitivity_report.hpp"
#include "pulmo/time/simulation.hpp"

#include <cstdio>
#include <memory>

namespace pulmo {

class ErrorIndicator;

/// Ends the run, on all ranks, unless rank 0's @p error (errno) of writing @p file is 0.
PetscErrorCode check_written(MPI_Comm comm, int error, const std::string &file);
/// Writes rank 0's @p text to @p file, whole.
PetscErrorCode write_text(MPI_Comm comm, const std::string &text, const std::string &file);

/// The run's directory and the options `-output_*`, `-progress`.
class Output {
public:
  PetscErrorCode declare(Options &options);
  /// Makes the directory and keeps other runs out of it; refuses one in which another run is at work, or that holds a
  /// finished run, or a checkpoint, unless `-output_overwrite`.
  /// @p restart: the checkpoint that the run goes on from, if any; what lies beside it stays as far as it is named in
  /// @p kept.
  PetscErrorCode prepare(const Options &options, const std::string &restart, const std::vector<std::string> &kept);

  std::string path(const std::string &file) const { return directory_ + "/" + file; }
  const std::string &directory() const { return directory_; }
  bool overwrite() const { return overwrite_; }
  bool progress() const { return progress_; }
  PetscReal fields_every() const { return fields_every_; } ///< s; 0: at phase ends
  /// Remembered quantities that snapshots hold, or `all`.
  const std::vector<std::string> &fields_memory() const { return fields_memory_; }
  /// Whether snapshots hold the indicators of pulmo/observers/error_indicator.hpp.
  bool error_indicator() const { return error_indicator_; }

private:
  /// Why the directory is not this run's, or empty.
  std::string occupied(bool continues) const;

  std::string directory_ = "results";
  bool overwrite_ = false, progress_ = true, error_indicator_ = false;
  PetscReal fields_every_ = 0;
  std::vector<std::string> fields_memory_;
  RunLock lock_; ///< of rank 0
};

/// Times a fixed interval apart; what is due comes with the first step at or after each of them.
class Schedule {
public:
  /// @p first: whether something is due at the start of the run.
  Schedule(PetscReal every, bool first) : every_(every), next_(first ? 0 : every) {}
  /// Whether something is due at time @p t; never if the interval is 0.
  bool due(PetscReal t);
  /// Goes on after time @p t.
  void skip(PetscReal t);

private:
  PetscReal every_, next_; ///< s
};

/// Writes signals.csv.part row by row and renames it at the end.
class SignalWriter final : public Observer {
public:
  SignalWriter(MPI_Comm comm, const Output &output, const SceneFacts &facts, const Composition &composition)
      : comm_(comm), output_(output), facts_(facts), signals_(composition.signals())
  {
    for (const ScalarGroup &group : composition.scalar_groups())
      scalars_.insert(scalars_.end(), group.scalars.begin(), group.scalars.end());
  }
  ~SignalWriter() override;
  PetscErrorCode observe(const StepReport &step) override;
  PetscErrorCode finish();

private:
  MPI_Comm comm_;
  const Output &output_;
  const SceneFacts &facts_;
  std::vector<ScalarSpec> scalars_; ///< each has columns of its own
  std::vector<SignalSpec> signals_;
  std::FILE *file_ = nullptr;
};

/// One line a step; the time left is foreseen from this session.
class ProgressPrinter final : public Observer {
public:
  ProgressPrinter(MPI_Comm comm, const SceneFacts &facts) : comm_(comm), facts_(facts) {}
  PetscErrorCode observe(const StepReport &step) override;

private:
  MPI_Comm comm_;
  const SceneFacts &facts_;
  PetscLogDouble start_ = 0;
  PetscReal from_ = -1; ///< time at which this session began, s
};

/// Writes the mesh once and a snapshot of the fields at phase ends or at intervals; quadratic, so that P3 loses its
/// cubic part.
class FieldWriter final : public Observer {
public:
  FieldWriter(const Output &output, const Scene &scene, Model &model);
  ~FieldWriter() override;
  /// Finds what `-output_fields_memory` names; user errors. Collective.
  PetscErrorCode setup();
  PetscErrorCode observe(const StepReport &step) override;
  /// The snapshots so far.
  PetscErrorCode persist(Archive &archive, Vec local) override;
  /// Their files.
  std::vector<std::string> files() const;
  /// After persist() has read: lists the earlier snapshots again. Those of another directory @p from come along as
  /// links (or copies); those that are no longer there are left out with a warning.
  PetscErrorCode carry_over(const std::string &from);
  /// Writes a snapshot of @p local now.
  PetscErrorCode snapshot(PetscReal time, Vec local);
  /// Writes values of the cells of this rank, by name, to @p name.h5 and .xdmf.
  PetscErrorCode write_cells(const std::string &name,
                             const std::vector<std::pair<std::string, std::vector<PetscReal>>> &values);

private:
  PetscErrorCode number_nodes();
  PetscErrorCode write_mesh();
  PetscErrorCode write_index() const;
  PetscErrorCode follow_breaths(const StepReport &step);
  /// For each cell of this rank the number of the smallest region that holds it, as in summary.json.
  PetscErrorCode region_numbers(std::vector<PetscScalar> &numbers) const;

  struct Snapshot {
    PetscReal time;         ///< s
    std::string file, mesh; ///< in the output directory
    bool error_indicator;   ///< whether it has one
    std::vector<std::string> remembered;
  };
  /// A quantity that effects remember, and what it is called in the files.
  struct Remembered {
    const MemorySpec *spec;
    std::size_t index;
    std::string name;
  };

  const Output &output_;
  const Scene &scene_;
  Model &model_;
  std::vector<PetscInt> nodes_;       ///< local mesh points that carry a node and are owned here
  std::vector<PetscInt> node_number_; ///< [local mesh point]: global node number, -1 without node
  PetscInt n_nodes_ = -1, n_cells_ = 0;
  std::vector<Snapshot> snapshots_;
  PetscInt count_ = 0;             ///< snapshots made, also those that are lost
  std::string mesh_ = "fields.h5"; ///< nodes and cells of this session's snapshots
  bool mesh_written_ = false;
  Schedule schedule_;
  std::vector<Remembered> remembered_;
  VecHandle breath_start_, phase_end_;        ///< local states, with a ventilator: at the start of the breath at hand,
                                              ///< and at the end of the last phase
  int breath_ = 0;                            ///< the breath at hand
  std::unique_ptr<ErrorIndicator> indicator_; ///< made for the first snapshot that wants one
};

/// What a run was watched by, and what is known of its errors.
struct Audits {
  const RegionAudit &regions;
  const EnergyAudit *energy;                        ///< null with -energy_audit off
  const GravityAudit *gravity = nullptr;            ///< null without gravity
  const ErrorReport *errors = nullptr;              ///< null before the estimate, or without -error_estimate
  const SensitivityReport *sensitivities = nullptr; ///< null before the sweep, or without -sensitivities
};

/// Why a run with a ventilator has no clinical numbers, if it has none.
std::string why_no_numbers(const Scene &scene, const std::vector<SignalRow> &rows);

/// Writes summary.json (a finished run) or failure.json (a run that could not go on).
PetscErrorCode write_summary(const Options &options, const Output &output, const Scene &scene, const Model &model,
                             const Simulation &simulation, const Audits &audits, bool finished);

/// Writes energy.csv: the balance since the start of the run, a row per step.
PetscErrorCode write_energy(MPI_Comm comm, const Output &output, const Simulation &simulation,
                            const EnergyAudit &audit);

/// Prints the clinical numbers, the energy balance and the regions as tables, and what keeps the numbers from being
/// those of a steady breath that starts at rest.
PetscErrorCode print_numbers(MPI_Comm comm, const Output &output, const Scene &scene, const Simulation &simulation,
                             const Audits &audits);

/// Prints each clinical number with its error bar, and what the bars cost.
PetscErrorCode print_error_bars(MPI_Comm comm, const ErrorReport &report);

/// Prints by how many percent each number changes where a parameter grows by one.
PetscErrorCode print_sensitivities(MPI_Comm comm, const SensitivityReport &report, double run_seconds);

} // namespace pulmo
