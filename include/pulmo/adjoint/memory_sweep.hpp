/// @file
/// What effects remember at the points, in a backward sweep.
#pragma once

#include "pulmo/fem/point_memory.hpp"

namespace pulmo {

/// The multipliers of what is remembered. With h_n = phi(x_n, dx_n/dt, h_n-1, ...) at each point and the residual
/// R_n(x_n, dx_n/dt, h_n-1, ...),
///
///   l_n = sum over later stages m of (dR_m/dh_n)^T z_m + (dphi_m/dh_n)^T l_m,
///
/// which wants (dphi_n/dx_n)^T l_n of the state of stage n, and adds l_n . dphi_n/dp to a derivative by p. All
/// derivatives are those of kernels at a point: central differences, but where an effect says how it follows from its
/// own past (Composition::by_past). What does not follow is found out point by point and costs one call.
class MemorySweep {
public:
  using Values = PointMemory::Values;

  /// @p model must outlive this; its kernels see the states before the stage at hand (PointMemory::show).
  explicit MemorySweep(const Model &model);

  /// What keeps it from a scene, as the end of a sentence; empty: nothing does.
  static std::string obstacle(const Composition &composition);

  /// Of one number: its multipliers, and what they want.
  struct OfState {
    const Values *weights = nullptr;           ///< l_n; null: none
    Vec by_state = nullptr, by_rate = nullptr; ///< local; (dphi/dx)^T l and (dphi/d(dx/dt))^T l are added
    PetscReal by_pressure = 0;                 ///< by the uniform pressure of the gas, 1/kPa; over all ranks
  };
  /// From the local vectors @p x and @p rate of the stage at hand. Collective.
  PetscErrorCode by_state(PetscReal t, Vec x, Vec rate, std::vector<OfState> &numbers) const;

  struct OfPast {
    const Values *weights = nullptr;                  ///< l_n; null: none
    Vec adjoint = nullptr;                            ///< z_n, local
    Values *by_last = nullptr, *by_earlier = nullptr; ///< l of the stages before; added to. Null: no such stage
  };
  PetscErrorCode by_past(PetscReal t, Vec x, Vec rate, std::vector<OfPast> &numbers) const;

  /// Adds l . phi cell by cell to @p sums ([number][cell of this rank]), or the share of the facets; a facet counts to
  /// the cell behind it. @p start: what there is at the start, in place of a stage.
  PetscErrorCode add_weighted(bool facets, bool start, PetscReal t, Vec x, Vec rate,
                              const std::vector<const Values *> &weights,
                              std::vector<std::vector<PetscReal>> &sums) const;

private:
  struct Place;
  struct StateSums;
  struct Output;
  struct Counted;
  struct Component {
    std::size_t place; ///< among the scalars of a point
    PetscReal change;
  };

  template <class Visit>
  void for_places(PetscReal t, Vec x, Vec rate, Visit &&visit) const;
  /// Add what is wanted of the state at a place, from what @p spec declares.
  void state_by_formula(const Place &place, const MemorySpec &spec, const std::vector<OfState> &numbers,
                        StateSums &sums) const;
  void state_by_differences(const Place &place, const MemorySpec &spec, const std::vector<OfState> &numbers,
                            StateSums &sums) const;
  void evaluate(const Place &place, const Output &output, std::size_t q, const Memory &memory,
                std::vector<PetscScalar> &values) const;
  /// Add what is wanted of the states before, through an output or through all that @p spec's effect does.
  void past_by_differences(const Counted &counted, const Output &output,
                           const std::vector<Component> &components) const;
  void past_by_formula(const Counted &counted, const MemorySpec &spec) const;
  std::vector<Output> outputs_of(const PointMemory::Room &room) const;
  std::vector<Component> components_of(const PointMemory::Room &room) const;

  const Model &model_;
  const PointMemory &memory_;
  bool gas_; ///< the pressure is a field
};

} // namespace pulmo
