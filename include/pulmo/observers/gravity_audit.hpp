/// @file
/// The lung along gravity: its weight, how J changes with height, and what each third takes in.
#pragma once

#include "pulmo/fem/sampling.hpp"
#include "pulmo/observers/clinical.hpp"
#include "pulmo/physics/scene.hpp"
#include "pulmo/time/observer.hpp"

#include <array>

namespace pulmo {

/// Thirds of equal height of the undeformed lung, from what lies lowest.
enum GravityThird { dependent, middle, nondependent, n_thirds };
constexpr const char *gravity_thirds[n_thirds] = {"dependent", "middle", "nondependent"};

/// Follows a lung that has weight over the accepted steps.
class GravityAudit final : public Observer {
public:
  /// @p scene: with gravity.
  GravityAudit(const Scene &scene, const Model &model, const Sampling &sampling)
      : scene_(scene), model_(model), sampling_(sampling)
  {}

  /// After the model was built and the sampling set up.
  PetscErrorCode setup();
  PetscErrorCode observe(const StepReport &step) override;
  PetscErrorCode persist(Archive &archive, Vec local) override;

  /// What tissue and air weigh at rest, g.
  double weight() const { return weight_; }
  /// Reference volume of a third, ml.
  double volume(int third) const { return volumes_[third]; }
  double mean_J(std::size_t row, int third) const;
  /// Slope of the line through J over height that fits the lung best (least squares over its reference volume), 1/cm:
  /// positive where what lies high is stretched more.
  double gradient(std::size_t row) const { return rows_[row].gradient; }
  /// What a third took in from the start of a breath to the end of inspiration, ml, and as a share of the lung's.
  double ventilation(const BreathRows &breath, int third) const;
  std::optional<double> ventilation_share(const BreathRows &breath, int third) const;

private:
  struct Row {
    std::array<double, n_thirds> volume_change{}; ///< int (J - 1), ml
    double gradient = 0;                          ///< 1/cm
  };

  /// Height of a material point above the middle of the lung, mm.
  double height(const PetscReal x[3]) const;
  int third(double height) const;

  const Scene &scene_;
  const Model &model_;
  const Sampling &sampling_;
  double weight_ = 0, middle_ = 0, extent_ = 0;               ///< g; mm
  double mean_height_ = 0, height_variance_ = 0, volume_ = 0; ///< mm, mm^2, mm^3
  std::array<double, n_thirds> volumes_{};
  std::vector<Row> rows_;
};

} // namespace pulmo
