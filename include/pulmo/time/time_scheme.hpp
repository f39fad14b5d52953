/// @file
/// The rate of what is conserved (gas, volume) in the stage at hand, as PETSc's TS makes the rate of the state.
#pragma once

#include "pulmo/fem/archive.hpp"
#include "pulmo/fem/model.hpp"
#include "pulmo/fem/point_memory.hpp"

#include <array>
#include <vector>

namespace pulmo {

/// A state that a rate may look back at.
struct Moment {
  PetscReal time = 0, volume = 0;      ///< s; mm^3 above rest
  Vec local = nullptr;                 ///< the fields, constrained values in place
  std::vector<PetscReal> scalars = {}; ///< kPa (ScalarUnknowns)
};

/// Keeps the past that a rate is made of: dy/dt = slope y + sum w_i y_i (LeVeque 2007, Finite Difference Methods for
/// Ordinary and Partial Differential Equations, section 8.6; weights for any step sizes from Lagrange's polynomials).
///
/// -ts_type beuler: y_0 is the state before the step. The kernels make dJ/dt themselves (effects/airflow.hpp).
///
/// -ts_type bdf, order 2: the last two states. After a kink PETSc makes half a step with backward Euler first, and y_1
/// is the state there. Kernels see the rate of the fields itself. That of J is no function of it: they give
/// slope (J - 1), and the past is kept as int (J_i - 1) q, so that gas is conserved to rounding.
class TimeScheme {
public:
  /// Reads the type off @p ts and refuses those whose rate is not conservative here. @p like: a local vector.
  PetscErrorCode setup(TS ts, Vec like);
  bool multistep() const { return multistep_; }
  /// Whether the stage at hand is the half step that PETSc's BDF begins with.
  bool half_step() const { return half_; }
  int order() const { return multistep_ ? 2 : 1; }

  PetscErrorCode begin(Model &model, const Moment &start);
  /// Whether the step at hand looks back beyond the state before it.
  bool looks_back() const;
  /// Writes or reads the past; @p last: of the last accepted step. @p looks_back: what is written of that.
  PetscErrorCode persist(Archive &archive, Model &model, const Moment &last, bool looks_back);
  /// Before the first step of a TSSolve: lets it look back on what was read, or on nothing.
  PetscErrorCode begin_solve(PetscInt steps);
  /// Begins a stage that ends at time @p t of a step of size @p dt, s.
  PetscErrorCode begin_stage(PetscReal t, PetscReal dt);
  /// Takes note of the solution of the stage at hand if it is the half step of a restart.
  PetscErrorCode accept_stage(Model &model, const Moment &now);
  /// Takes note of an accepted step.
  PetscErrorCode accept(Model &model, const Moment &now);

  PetscReal slope() const { return slope_; } ///< 1/s
  /// What kernels are told of the stage at hand.
  Stage stage() const { return {dt_, slope_, multistep_, weight_[0], weight_[1]}; }
  /// What a rate looks back at in the stage at hand.
  PointMemory::Past looks_back_at() const
  {
    return !used_[1]              ? PointMemory::Past::last
           : used_[1] == &middle_ ? PointMemory::Past::middle
                                  : PointMemory::Past::earlier;
  }
  /// Rate of the fields at the local state @p now, constrained values in place.
  PetscErrorCode rate(Vec now, Vec rate) const;
  /// The share of the past in the rate of volume, mm^3/s, and in those of the scalars, kPa/s.
  PetscReal past_flow() const;
  std::vector<PetscReal> past_rates() const;
  /// Rate of volume at @p volume, mm^3/s.
  PetscReal flow(PetscReal volume) const { return slope_ * volume + past_flow(); }
  /// Adds the share of the past to the mass rows of a local residual of @p model.
  PetscErrorCode add_past(const Model &model, Vec residual) const;

private:
  struct Past {
    PetscReal time = 0, volume = 0; ///< s, mm^3
    std::vector<PetscReal> scalars; ///< kPa
    VecHandle state;                ///< local; with more than one state before
    VecHandle gas;                  ///< local: its int (J - 1) q in the mass rows, mm^3
  };

  /// Fills @p past with the state @p now.
  PetscErrorCode keep(Model &model, const Moment &now, Past &past);

  TS ts_ = nullptr;
  bool multistep_ = false, gas_ = false; ///< BDF; and there is a mass balance
  bool half_ = false;                    ///< the stage at hand is the half step of a restart
  bool resumes_ = false;                 ///< the first step looks back on a past that was read
  Past last_, earlier_, middle_;
  std::array<const Past *, 2> used_{};
  std::array<PetscReal, 2> weight_{};
  PetscReal dt_ = 1, slope_ = 1;
  VecHandle zero_, rest_; ///< local: zero; for keep()
};

} // namespace pulmo
