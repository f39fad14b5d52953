/// @file
/// What a run leaves in its directory: signals.csv, summary.json, fields.xdmf with fields.h5, progress lines.
#pragma once

#include "pulmo/energy.hpp"
#include "pulmo/regions.hpp"

#include <cstdio>
#include <memory>

namespace pulmo {

/// The run's directory and the options `-output_*`, `-progress`.
class Output {
public:
  PetscErrorCode declare(Options &options);
  /// Makes the directory; refuses one that holds a finished run unless `-output_overwrite`.
  PetscErrorCode prepare(const Options &options);

  std::string path(const std::string &file) const { return directory_ + "/" + file; }
  const std::string &directory() const { return directory_; }
  bool progress() const { return progress_; }
  PetscReal fields_every() const { return fields_every_; } ///< s; 0: at phase ends

private:
  std::string directory_ = "results";
  bool overwrite_ = false, progress_ = true;
  PetscReal fields_every_ = 0;
};

/// Writes signals.csv.part row by row and renames it at the end.
class SignalWriter final : public Observer {
public:
  SignalWriter(MPI_Comm comm, const Output &output, const SceneFacts &facts)
      : comm_(comm), output_(output), facts_(facts)
  {}
  ~SignalWriter() override;
  PetscErrorCode observe(const StepReport &step) override;
  PetscErrorCode finish();

private:
  MPI_Comm comm_;
  const Output &output_;
  const SceneFacts &facts_;
  std::FILE *file_ = nullptr;
};

/// One line a step.
class ProgressPrinter final : public Observer {
public:
  ProgressPrinter(MPI_Comm comm, const SceneFacts &facts) : comm_(comm), facts_(facts) {}
  PetscErrorCode observe(const StepReport &step) override;

private:
  MPI_Comm comm_;
  const SceneFacts &facts_;
  PetscLogDouble start_ = 0;
};

/// Writes the mesh once and a snapshot of the fields at phase ends or at intervals; P2 stays quadratic.
class FieldWriter final : public Observer {
public:
  FieldWriter(const Output &output, const Scene &scene, Model &model) : output_(output), scene_(scene), model_(model) {}
  PetscErrorCode observe(const StepReport &step) override;
  /// Writes a snapshot of @p local now.
  PetscErrorCode snapshot(PetscReal time, Vec local);

private:
  PetscErrorCode number_nodes();
  PetscErrorCode write_mesh();
  PetscErrorCode write_index() const;

  const Output &output_;
  const Scene &scene_;
  Model &model_;
  std::vector<PetscInt> nodes_;       ///< local mesh points that carry a node and are owned here
  std::vector<PetscInt> node_number_; ///< [local mesh point]: global node number, -1 without node
  PetscInt n_nodes_ = -1, n_cells_ = 0;
  std::vector<PetscReal> times_;
  PetscReal next_ = 0;
};

/// What a run was watched by.
struct Audits {
  const RegionAudit &regions;
  const EnergyAudit *energy; ///< null with -energy_audit off
};

/// Writes summary.json (a finished run) or failure.json (a run that could not go on).
PetscErrorCode write_summary(const Options &options, const Output &output, const Scene &scene, const Model &model,
                             const Simulation &simulation, const Audits &audits, bool finished);

/// Writes energy.csv: the balance since the start of the run, a row per step.
PetscErrorCode write_energy(MPI_Comm comm, const Output &output, const Simulation &simulation,
                            const EnergyAudit &audit);

/// Prints the clinical numbers, the energy balance and the regions as tables.
PetscErrorCode print_numbers(MPI_Comm comm, const Output &output, const Scene &scene, const Simulation &simulation,
                             const Audits &audits);

/// Prints the ledger of `-effects_view`: effect, fields, terms, blocks, seconds.
PetscErrorCode print_ledger(MPI_Comm comm, const Scene &scene, const Model &model, const StageSeconds &seconds);

} // namespace pulmo
