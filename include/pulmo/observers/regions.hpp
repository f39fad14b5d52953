/// @file
/// The lung part by part: volume, deformation, alveolar pressure and what effects remember, of the whole, of each body
/// and of each named part.
#pragma once

#include "pulmo/fem/sampling.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/observers/clinical.hpp"
#include "pulmo/physics/scene.hpp"
#include "pulmo/time/observer.hpp"

namespace pulmo {

/// What a region is like at one time; means are over its reference volume.
struct RegionState {
  double volume_change = 0; ///< int (J - 1), ml
  double mean_J = 1, sd_J = 0;
  double mean_pressure = 0, sd_pressure = 0; ///< alveolar, cmH2O (without airflow: the uniform gas pressure)
  std::vector<double> columns;               ///< RegionAudit::columns()
};

/// Follows all regions over the accepted steps.
class RegionAudit final : public Observer {
public:
  RegionAudit(const Scene &scene, const Model &model, const Sampling &sampling)
      : scene_(scene), model_(model), sampling_(sampling)
  {}

  /// After the model was built and the sampling set up.
  PetscErrorCode setup();
  PetscErrorCode observe(const StepReport &step) override;
  PetscErrorCode persist(Archive &archive, Vec local) override;

  const std::vector<Mesh::Region> &regions() const { return regions_; }
  /// Reference volume of a region, ml.
  double volume(std::size_t region) const { return volumes_[region]; }
  /// Columns of the signals that are told region by region, too.
  const std::vector<RememberedIntegral> &columns() const { return columns_; }
  /// State of a region at a row of the signals.
  const RegionState &state(std::size_t row, std::size_t region) const { return rows_[row][region]; }
  /// What a region took in from the start of a breath to the end of inspiration, ml.
  double ventilation(const BreathRows &breath, std::size_t region) const;
  /// The same as a share of the whole lung's.
  std::optional<double> ventilation_share(const BreathRows &breath, std::size_t region) const;
  /// The signals with what the steps alone do not tell: the mean alveolar pressure of the whole lung, whether anything
  /// resists the flow, and whether the run ends within a breath.
  std::vector<SignalRow> complete(std::vector<SignalRow> rows) const;
  /// The clinical numbers of a run with these signals.
  std::vector<ClinicalEntry> numbers(const std::vector<SignalRow> &rows) const
  {
    return overall_entries(complete(rows), functional_residual_capacity());
  }
  /// Gas volume at rest int Phi0, ml; empty without airflow.
  std::optional<double> functional_residual_capacity() const;
  /// The least porosity anywhere in the lung at each row of the signals; needs airflow.
  std::vector<double> least_porosity(const std::vector<SignalRow> &rows) const;

private:
  /// The porosity at rest of a cell.
  Porosity porosity(PetscInt cell) const;
  PetscErrorCode follow_porosity(Vec local);
  PetscErrorCode integrate_columns(std::vector<RegionState> &states) const;

  const Scene &scene_;
  const Model &model_;
  const Sampling &sampling_;
  double breath_end_ = 0;              ///< of the breath at hand, s
  double air_ = 0;                     ///< ml, at rest
  std::vector<double> least_porosity_; ///< [row], where parts of the lung have porosities of their own
  std::vector<RememberedIntegral> columns_;
  std::vector<Mesh::Region> regions_;
  std::vector<std::vector<std::size_t>> regions_of_; ///< [cell]; the last entry of a row stands for the whole lung
  std::vector<double> volumes_;
  std::vector<std::vector<RegionState>> rows_; ///< [row][region], the whole lung last
};

} // namespace pulmo
