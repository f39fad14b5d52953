/// @file
/// What the ventilator does over time: a list of phases.
#pragma once

#include "pulmo/input/options.hpp"

#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// What the ventilator imposes during a phase.
enum class Control {
  pressure, ///< kPa
  flow      ///< into the lung, mm^3/s
};

/// One phase (begin, end]: the controlled quantity goes linearly from @p from to @p to within @p ramp and stays.
struct Phase {
  std::string name;             ///< inspiration, pause, expiration, settle, ...
  PetscInt breath = 0;          ///< counted from 1; 0 before the first breath
  PetscReal begin = 0, end = 0; ///< s
  Control control = Control::pressure;
  std::optional<PetscReal> from;  ///< kPa or mm^3/s; not given: what the airway has when the phase begins
  PetscReal to = 0;               ///< kPa or mm^3/s
  PetscReal ramp = 0;             ///< s; 0: @p to holds from the first step on
  std::optional<PetscReal> limit; ///< of the ventilator's pressure in a flow phase, kPa: reached, it is held to the end
  std::optional<PetscReal> dt;    ///< step size, s; not given: -ts_dt
  /// The phase ends before @p end with the first step that meets one of these.
  std::optional<PetscReal> trigger_flow; ///< more flows into the lung than this, mm^3/s
  std::optional<PetscReal> trigger_drop; ///< the ventilator's pressure fell so far below its highest of the phase, kPa
  std::optional<PetscReal> cycle;        ///< the flow into the lung fell below this share of its highest of the phase
  std::string where;                     ///< file and line that it comes from; empty if from options

  /// The controlled quantity at a time of this phase (from must be known if there is a ramp).
  PetscReal value(PetscReal t) const;
  /// Volume that a flow phase delivers from its begin to time @p t, mm^3.
  PetscReal delivered(PetscReal t) const;
  bool may_end_early() const { return trigger_flow || trigger_drop || cycle; }
};

/// The phases of a run, in order and without gaps.
class Programme {
public:
  explicit Programme(std::vector<Phase> phases) : phases_(std::move(phases)) {}

  const std::vector<Phase> &phases() const { return phases_; }
  bool prescribes_flow() const;
  bool prescribes_pressure() const;
  bool limits_pressure() const;
  /// Whether some phase may end early: the phases after it begin earlier then.
  bool may_end_early() const;
  /// Whether some phase belongs to a breath.
  bool breathes() const;
  /// When the last phase of a breath ends, s.
  PetscReal end_of_breath(PetscInt breath) const;

private:
  std::vector<Phase> phases_;
};

/// Appends phases one after the other: keeps the clock, and the start value of each ramp where it is known.
class ProgrammeBuilder {
public:
  /// @p value and @p from in cmH2O or ml/s; the other arguments as in Phase.
  Phase &add(const std::string &name, PetscInt breath, PetscReal duration, Control control, PetscReal value,
             PetscReal ramp = 0, std::optional<PetscReal> from = {});
  /// Appends a phase of another list, its times moved to begin where the last one ends.
  void append(Phase phase);
  std::vector<Phase> take() { return std::move(phases_); }

private:
  std::vector<Phase> phases_;
};

/// Reads a programme of phases from a text file (docs/ventilator.md tells its grammar). User errors name file and line
/// and say how to fix it; @p option is the one that named the file. Collective: one rank reads.
PetscErrorCode read_programme(MPI_Comm comm, const std::string &option, const std::string &file,
                              std::vector<Phase> &phases);
/// The same from text that was read already.
PetscErrorCode parse_programme(MPI_Comm comm, const std::string &file, const std::string &text,
                               std::vector<Phase> &phases);

} // namespace pulmo
