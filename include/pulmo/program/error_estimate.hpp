/// @file
/// Numerical error bars of the clinical numbers: `-error_estimate`.
#pragma once

#include "pulmo/input/options.hpp"
#include "pulmo/observers/error_bars.hpp"

namespace pulmo {

class FieldWriter;
class Model;
class Output;
class Recording;
class RegionAudit;
class Registry;
class Scene;
class Simulation;

/// One sweep back over the run (ErrorParts), or the scene again with steps of 2 dt and 4 dt, with 4 dt and tighter
/// tolerances, and with 4 dt on another mesh; docs/accuracy/error_bars.md.
class ErrorEstimate {
public:
  explicit ErrorEstimate(const Registry &registry) : registry_(registry) {}

  /// Declares -error_estimate and its settings.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return in_use_; }
  /// Whether a sweep back is to tell the errors; until check() whether it may.
  bool sweeps() const { return in_use_ && sweeps_; }
  /// Before the run: refuses a scene that has no clinical numbers, and a mesh that cannot be read. Chooses the method
  /// where none is given. @p restarts: the run goes on from a checkpoint.
  PetscErrorCode check(const Options &options, const Scene &scene, const Model &model, bool restarts);
  /// Refuses a run whose steps or solver @p changed at a restart (Checkpoint::numerics_changed): all bars are made of
  /// the options of its last session.
  PetscErrorCode check_sessions(const Options &options, const std::string &changed) const;
  /// After the run: @p numbers are its own. A level that cannot be finished leaves parts empty.
  PetscErrorCode make(const Options &options, const Output &output, const Scene &scene, const Simulation &simulation,
                      const std::vector<ClinicalEntry> &numbers, ErrorReport &report) const;

  /// The same by a sweep back over the recorded run, which @p regions have followed. The part in space goes by
  /// cells to errors.xdmf, through @p fields.
  PetscErrorCode make_by_sweep(const Options &options, const Scene &scene, Model &model, Simulation &simulation,
                               const Recording &recording, const RegionAudit &regions, FieldWriter &fields,
                               ErrorReport &report) const;

private:
  /// Whether a condition may have ended a phase of the run before its time: it does so with a step, up to one late, and
  /// no part in time sees that.
  static bool ended_early(const Scene &scene, const std::vector<SignalRow> &rows);
  /// Fills in what @p simulation is, but not its name, seconds and numbers.
  static PetscErrorCode describe(const Simulation &simulation, const Scene &scene, ErrorLevel &level);
  PetscErrorCode choose_method(const Options &options, const Scene &scene, const Model &model, bool restarts);
  PetscErrorCode try_other_mesh(const Options &options, const Scene &scene) const;
  PetscErrorCode other_mesh(OptionList &changes, std::string &name) const;
  PetscErrorCode run_level(const Options &options, const Output &output, const OptionList &changes,
                           ErrorLevel &level) const;

  const Registry &registry_;
  bool in_use_ = false, sweeps_ = false;
  std::string mesh_, method_;
  std::vector<std::string> names_;
};

} // namespace pulmo
