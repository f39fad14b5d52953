/// @file
/// Numerical error bars of the clinical numbers: `-error_estimate`.
#pragma once

#include "pulmo/clinical.hpp"
#include "pulmo/options.hpp"

namespace pulmo {

class Output;
class Registry;
class Scene;
class Simulation;

/// Whether an option of PETSc's prints or writes, and changes nothing else.
bool prints(const std::string &option);

/// What the steps make a number wrong by.
struct TimeError {
  double error;                ///< in the number's unit, not negative
  std::optional<double> order; ///< observed; none where the numbers do not approach a limit in one direction
};

/// Error in time of @p fine (steps dt) from the same number with steps 2 dt and 4 dt, by a scheme of order @p order:
/// Richardson's extrapolation with the factors of safety of Oberkampf & Roy 2010 (Verification and Validation in
/// Scientific Computing, section 8.6): 1.25 where the observed order is the scheme's within 10 %, else 3 with the
/// observed order, but not below 1/2 nor above the scheme's. Without an order: 1.25 times the largest difference seen.
TimeError time_error(double fine, double twice, double four_times, int order);

/// Error in space from the difference @p difference to the same number on a mesh of cells @p ratio times as large
/// (above or below 1). Of order 1, as rims and edges leave it, with a factor of safety of 1.25: 2.5 times the
/// difference to a mesh refined once, 1.25 times that to one twice as coarse.
double space_error(double difference, double ratio);

/// A clinical number with what the discretisation makes it wrong by, each part in the number's unit. A part that could
/// not be had is empty.
struct ErrorBar {
  ClinicalEntry entry;
  std::optional<double> time, space, solver;
  std::optional<double> time_order; ///< observed

  /// The sum of the parts (they may all point the same way); empty if one is missing.
  std::optional<double> total() const;
};

/// One run that the estimate was made from.
struct ErrorLevel {
  std::string name;    ///< what is different from the run itself
  std::string failure; ///< why it has no numbers; empty if it finished
  PetscReal dt = 0;    ///< s; the first steps' if steps are chosen by their error
  PetscInt cells = 0, dofs = 0, steps = 0;
  double volume = 0;  ///< at rest, ml
  double seconds = 0; ///< wall
  std::vector<ClinicalEntry> numbers;
};

/// What an estimate found.
struct ErrorReport {
  std::vector<ErrorBar> bars;     ///< one for each clinical number that the run has
  std::vector<ErrorLevel> levels; ///< the run itself comes first
  double extra_seconds() const;   ///< wall, what the estimate took
};

/// Runs the scene again with steps of 2 dt and 4 dt, with 4 dt and tighter tolerances, and with 4 dt on another mesh;
/// docs/accuracy/error_bars.md.
class ErrorEstimate {
public:
  explicit ErrorEstimate(const Registry &registry) : registry_(registry) {}

  /// Declares -error_estimate and -error_estimate_mesh.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return in_use_; }
  /// Before the run: refuses a scene that has no clinical numbers, and a mesh that cannot be read.
  PetscErrorCode check(const Options &options, const Scene &scene) const;
  /// Refuses a run whose steps or solver @p changed at a restart (Checkpoint::numerics_changed): all bars are made of
  /// the options of its last session.
  PetscErrorCode check_sessions(const Options &options, const std::string &changed) const;
  /// After the run: @p numbers are its own. A level that cannot be finished leaves parts empty.
  PetscErrorCode make(const Options &options, const Output &output, const Scene &scene, const Simulation &simulation,
                      const std::vector<ClinicalEntry> &numbers, ErrorReport &report) const;

private:
  PetscErrorCode try_other_mesh(const Options &options, const Scene &scene) const;
  PetscErrorCode level_options(const Options &options, const OptionList &changes, OptionList &list) const;
  PetscErrorCode other_mesh(OptionList &changes, std::string &name) const;
  PetscErrorCode run_level(const Options &options, const Output &output, const OptionList &changes,
                           ErrorLevel &level) const;

  const Registry &registry_;
  bool in_use_ = false;
  std::string mesh_;
};

} // namespace pulmo
