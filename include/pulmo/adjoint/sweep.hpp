/// @file
/// The discrete adjoint of a run: one sweep back over its steps gives the derivative of clinical numbers by all that
/// the steps depend on.
#pragma once

#include "pulmo/adjoint/functional.hpp"
#include "pulmo/adjoint/memory_sweep.hpp"
#include "pulmo/time/simulation.hpp"

#include <functional>
#include <map>

namespace pulmo {

/// Goes back over the accepted stages of a run. With R_n(x_n, x_n-1, ...) = 0 the equations of stage n and G a number
/// of the signals,
///
///   (dR_n/dx_n)^T z_n = - dG/dx_n - sum over later stages m of (dR_m/dx_n)^T z_m,
///   dG/dp = sum over all n of z_n . dR_n/dp.
///
/// The matrix is the transposed Jacobian of the stage, in the run's own matrix and by its own solver. Where the
/// pressure at the opening is an unknown its equation c(P, V) = 0 has a multiplier of its own, eliminated as in
/// ScalarUnknowns. The consistent flux into a held airway is a sum of rows of R_n: its derivative stands in z_n at
/// these nodes. What effects remember has multipliers of its own (MemorySweep).
class Sweep {
public:
  Sweep(const Scene &scene, Model &model, Simulation &simulation, const Trajectory &trajectory)
      : scene_(scene), model_(model), simulation_(simulation), trajectory_(trajectory)
  {}

  /// What keeps the sweep from this scene, as the end of a sentence; empty: nothing does.
  static std::string obstacle(const Scene &scene, const Model &model);

  /// What is known once a stage was solved.
  struct Solved {
    PetscInt number; ///< of the stage
    const StageRecord &record;
    Vec state, rate;                  ///< local, of the stage
    std::vector<Vec> adjoint;         ///< [functional]: z, local, with the rows of a held airway
    std::vector<PetscReal> by_target; ///< [functional]: its derivative by StageRecord::airway.target (ask_targets())
    /// [functional]: what it wants of the volume, 1/mm^3, and of the mean pressure of a free airway, 1/kPa, with the
    /// multiplier of the opening's equation in place, which stands in @p opening.
    std::vector<PetscReal> by_volume, by_mean_pressure, opening;
    std::vector<PetscReal> by_flow; ///< [functional]: of the gas of this stage through the opening, s/mm^3
    /// What the number itself wants of the volume of a part of the lung.
    struct OfPart {
      const std::vector<PetscInt> *cells = nullptr; ///< of this rank; null: it is of the whole lung
      PetscReal by_volume = 0;                      ///< 1/mm^3
    };
    std::vector<OfPart> of_part;                        ///< [functional]
    std::vector<const MemorySweep::Values *> by_memory; ///< [functional]: l; null: none
  };
  using Visit = std::function<PetscErrorCode(const Solved &)>;

  /// Sweeps back for all @p functionals at once. @p tolerance: of the linear systems, relative. @p visit is called
  /// after each stage that matters, with the model told of it. @p failure: why there is no result; empty if there is
  /// one.
  PetscErrorCode run(const std::vector<Functional> &functionals, PetscReal tolerance, const Visit &visit,
                     std::string &failure);

  /// Asks for Solved::by_target: a held airway needs two residuals a stage for it.
  void ask_targets() { targets_ = true; }
  /// Whether rates act in the kernels by more than the gas that is stored; known once a stage was solved.
  bool other_rates() const { return other_rates_.value_or(false); }
  /// The residual of @p stage, or the share of the facets in it, times the multipliers, cell by cell:
  /// [functional][cell], with the parameters as they are now. Of what is remembered, too.
  PetscErrorCode weighted_residual(const Solved &stage, bool facets, std::vector<std::vector<PetscReal>> &sums);
  /// After the sweep: whether a number follows from what is remembered at the start.
  bool wants_start() const { return memory_ && !start_.empty(); }
  /// What is remembered there at the start times its multipliers, in the same way.
  PetscErrorCode weighted_start(bool facets, std::vector<std::vector<PetscReal>> &sums);

  /// The state of @p stage moved by what separates the states of two others, and what that makes of the numbers.
  struct Shift {
    PetscInt stage, from, to;
    std::vector<PetscReal> change; ///< [functional]: to first order, through later stages alone
  };
  /// Asks for Shift::change of @p shift, which must outlive the sweep.
  void ask_shift(Shift &shift) { shifts_.push_back(&shift); }

  /// Lets @p request end the sweep after the stage at hand; stopped() tells that it did. It must outlive the sweep.
  void heed(StopRequest &request) { stop_request_ = &request; }
  bool stopped() const { return stopped_; }

  /// What the solver left of the equation c(P, V) = 0 of the pressure at the opening, where that is an unknown.
  PetscReal left_at_opening(const Solved &stage) const;
  /// Of a stage, mm^3 above rest; once the sweep has begun.
  PetscReal volume(PetscInt stage) const { return volumes_[static_cast<std::size_t>(stage)]; }
  PetscInt solves() const { return solves_; }
  PetscInt krylov() const { return krylov_; }

private:
  /// What later stages and the number itself want of a stage.
  struct Wanted {
    VecHandle state;                              ///< local, to be summed over the ranks; null: nothing
    PetscReal volume = 0, pressure = 0, flow = 0; ///< per mm^3, kPa (at the opening), mm^3/s
    PetscReal part = 0;                           ///< per mm^3 of the part that the number is of
    MemorySweep::Values memory;                   ///< by what is remembered; empty: nothing
    bool nothing() const { return !state && volume == 0 && pressure == 0 && flow == 0 && part == 0 && memory.empty(); }
    const MemorySweep::Values *weights() const { return memory.empty() ? nullptr : &memory; }
  };
  using Pending = std::map<PetscInt, std::vector<Wanted>>;

  /// Derivatives of the equation of the pressure at the opening.
  struct Opening {
    PetscReal by_pressure = 0, by_volume = 0, by_flow = 0, by_target = 0; ///< by_flow: of the gas, through pasts, too
  };

  PetscErrorCode setup(const std::vector<Functional> &functionals);
  PetscErrorCode create(VecHandle &local) const;
  Wanted &wanted(Pending &pending, PetscInt stage, std::size_t functional) const;
  /// Fills in the changes of all shifts of a stage, of which @p pending is what later stages want.
  PetscErrorCode make_shifts(PetscInt stage, const Pending &pending);
  void want_row(const std::vector<Functional> &functionals, PetscInt stage, Pending &pending) const;
  /// Adds a derivative by the pressure at the ventilator at the end of a stage, 1/kPa.
  void want_ventilator_pressure(PetscInt stage, PetscReal derivative, Wanted &wanted) const;
  /// Adds a derivative by the flow of gas of a stage, s/mm^3, to the volumes that it looks back at.
  void want_past_volumes(const StageRecord &record, PetscReal by_flow, std::size_t k, Pending &pending) const;
  /// Makes the model that of a stage; fills x_ and rate_.
  PetscErrorCode recall(const StageRecord &record, PetscInt number);
  /// Derivative of the local residual by the pressure at the opening, 1/kPa, or by the flow prescribed on a free
  /// airway, s/mm^3.
  PetscErrorCode make_column(const StageRecord &record);
  PetscErrorCode assemble(const StageRecord &record, PetscInt number);
  PetscErrorCode right_side(const StageRecord &record, std::size_t k, Wanted &w, Pending &pending, Vec right);
  Opening opening(const StageRecord &record, PetscInt number) const;
  /// Rate of the volume by the time scheme, mm^3/s.
  PetscReal volume_rate(const StageRecord &record, PetscInt number) const;
  PetscErrorCode solve_border(const Opening &c, std::string &failure);
  PetscErrorCode solve_stage(const StageRecord &record, const Opening &c, std::size_t k, const Wanted &w, Vec right,
                             Pending &pending, Solved &result, std::string &failure);
  PetscErrorCode solve(Vec right, Vec solution, std::string &failure);
  PetscErrorCode to_global(Vec local, Vec global) const;
  PetscErrorCode to_local(Vec global, Vec local) const;
  PetscErrorCode dot(Vec a, Vec b, PetscReal &sum) const;
  /// Adds (dR/dx_i)^T z for the stages that @p record looks back at.
  PetscErrorCode look_back(const StageRecord &record, Vec z, std::size_t functional, Pending &pending);
  /// Adds what is remembered of a stage to what is wanted of its state and of those that it looks back at.
  PetscErrorCode want_by_memory(const StageRecord &record, std::vector<Wanted> &want, Pending &pending);
  /// Adds what a stage, solved, wants of what is remembered of those that it looks back at.
  PetscErrorCode look_back_at_memory(const Solved &stage, Pending &pending);
  /// Whether rates act in the kernels by more than the gas that is stored.
  PetscErrorCode compare_rates(const StageRecord &record);

  const Scene &scene_;
  Model &model_;
  Simulation &simulation_;
  const Trajectory &trajectory_;
  std::unique_ptr<MemorySweep> memory_; ///< null: nothing follows from what is remembered
  std::vector<Wanted> start_;           ///< of the start, once all is swept
  std::vector<Shift *> shifts_;
  std::vector<std::vector<PetscInt>> parts_; ///< [number]: cells of this rank of the part that it is of
  std::size_t count_ = 0;                    ///< of the numbers
  KSP ksp_ = nullptr;                        ///< of the run
  bool gas_ = false;                         ///< there is a mass balance
  bool targets_ = false;                     ///< are asked for
  std::optional<bool> other_rates_;
  struct {
    PetscInt age = 0;
    PetscReal slope = 0;
    Airway::Mode mode = Airway::Mode::held;
  } kept_;                                                     ///< the stage whose preconditioner is in use, stages ago
  std::vector<PetscReal> volumes_, flows_;                     ///< [stage]: mm^3; through the opening, mm^3/s
  VecHandle x_, rate_, past_, column_, border_, work_, other_; ///< local
  VecHandle right_, held_, product_, residual_;                ///< global
  PetscReal border_column_ = 0, tolerance_ = 0;
  StopRequest *stop_request_ = nullptr;
  bool stopped_ = false;
  PetscInt solves_ = 0, krylov_ = 0;
};

} // namespace pulmo
