/// @file
/// `-sensitivities`: how clinical numbers follow the parameters of a scene, from one backward sweep.
#pragma once

#include "pulmo/adjoint/recording.hpp"
#include "pulmo/adjoint/sweep.hpp"
#include "pulmo/observers/sensitivity_report.hpp"

namespace pulmo {

class RegionAudit;

/// Sweeps back for @p functionals and adds them and their derivatives by all parameters of the scene to @p report.
/// @p tolerance: of the linear systems, relative. Collective.
PetscErrorCode add_derivatives(const Options &options, const Scene &scene, Model &model, Sweep &sweep,
                               const std::vector<Functional> &functionals, PetscReal tolerance,
                               SensitivityReport &report);

/// Sweeps back over a recorded run.
class Sensitivities {
public:
  /// Declares -sensitivities.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return !names_.empty(); }
  /// Refuses what the sweep cannot do, before the run. @p restarts: the run goes on from a checkpoint.
  PetscErrorCode check(const Options &options, const Scene &scene, const Model &model, const StepControl &steps,
                       bool restarts) const;
  /// After the run, whose complete signals are @p rows. @p regions: for numbers of parts; null: there are none.
  PetscErrorCode make(const Options &options, const Scene &scene, Model &model, Simulation &simulation,
                      const Recording &recording, const std::vector<SignalRow> &rows, const RegionAudit *regions,
                      SensitivityReport &report);

  /// With -sensitivities_fields the derivatives by cell, with the names of their fields.
  std::vector<std::pair<std::string, std::vector<double>>> fields(const SensitivityReport &report) const;

private:
  std::vector<std::string> names_;
  bool fields_ = false;
};

} // namespace pulmo
