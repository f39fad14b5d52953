/// @file
/// The discrete adjoint of a run: one sweep back over its steps gives the derivative of clinical numbers by all that
/// the steps depend on.
#pragma once

#include "pulmo/adjoint/functional.hpp"
#include "pulmo/adjoint/memory_sweep.hpp"
#include "pulmo/time/simulation.hpp"

#include <algorithm>
#include <functional>
#include <map>

namespace pulmo {

/// Goes back over the accepted stages of a run. With R_n(x_n, x_n-1, ...) = 0 the equations of stage n and G a number
/// of the signals,
///
///   (dR_n/dx_n)^T z_n = - dG/dx_n - sum over later stages m of (dR_m/dx_n)^T z_m,
///   dG/dp = sum over all n of z_n . dR_n/dp.
///
/// The matrix is the transposed Jacobian of the stage, in the run's own matrix and by its own solver. Where scalars s
/// are unknown (ScalarUnknowns) each of their equations c(s, ds/dt, V, Q) = 0 has a multiplier m of its own. The
/// consistent fluxes Q into a held airway are sums of rows of R_n: their derivatives stand in z_n at these nodes. With
/// y_V and y_j, the z_n of a unit of the lung's volume and of the flux by scalar j,
///
///   z_n = y_0 + y_V sum_i m_i dc_i/dV + sum_j y_j sum_i m_i dc_i/dQ_j,
///
/// and a dense system makes z_n . dR_n/ds + m . dc/ds what is wanted of the scalars. What effects remember has
/// multipliers of its own (MemorySweep).
class Sweep {
public:
  Sweep(const Scene &scene, Model &model, Simulation &simulation, const Trajectory &trajectory)
      : scene_(scene), model_(model), simulation_(simulation), trajectory_(trajectory), scalars_(model)
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
    /// multipliers of the scalars' equations in place.
    std::vector<PetscReal> by_volume, by_mean_pressure;
    std::vector<PetscReal> by_flow; ///< [functional]: by the rate of the lung's volume in the opening's flow, s/mm^3
    std::vector<PetscReal> by_drop; ///< [functional]: by what the pressure falls along the tube, 1/kPa
    /// [functional][scalar]: by the rates of scalars, s/kPa; and the multipliers of their equations
    /// (weighted_scalars())
    std::vector<std::vector<PetscReal>> by_rate, multipliers;
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
    std::vector<PetscReal> volume; ///< [functional]: what becomes of the volume it looks at, ml, to first order
  };
  /// Asks for Shift::change of @p shift, which must outlive the sweep.
  void ask_shift(Shift &shift) { shifts_.push_back(&shift); }

  /// Lets @p request end the sweep after the stage at hand; stopped() tells that it did. It must outlive the sweep.
  void heed(StopRequest &request) { stop_request_ = &request; }
  bool stopped() const { return stopped_; }

  /// The equations of the scalars of @p stage, the one solved last, times their multipliers: [functional], with the
  /// settings as they are now.
  std::vector<PetscReal> weighted_scalars(const Solved &stage) const;
  /// Of a stage, once the sweep has begun: the lung's volume, mm^3 above rest; the flow through the opening, mm^3/s;
  /// the scalars of effects and the opening's pressure, kPa (empty without the former).
  PetscReal volume(PetscInt stage) const { return volumes_[static_cast<std::size_t>(stage)]; }
  PetscReal flow(PetscInt stage) const { return flows_[static_cast<std::size_t>(stage)]; }
  const std::vector<PetscReal> &scalars(PetscInt stage) const
  {
    return trajectory_.stages()[static_cast<std::size_t>(stage)].airway.scalars;
  }
  PetscInt solves() const { return solves_; }
  PetscInt krylov() const { return krylov_; }

private:
  /// What later stages and the number itself want of a stage.
  struct Wanted {
    VecHandle state;                ///< local, to be summed over the ranks; null: nothing
    PetscReal volume = 0, flow = 0; ///< of the lung, per mm^3; into the lung, per mm^3/s
    PetscReal stored = 0, drop = 0; ///< flow into what is stored beside it, per mm^3/s; along the tube, per kPa
    std::vector<PetscReal> scalars; ///< per kPa; the opening's pressure first (of a free airway its mean)
    PetscReal part = 0;             ///< per mm^3 of the part that the number is of
    MemorySweep::Values memory;     ///< by what is remembered; empty: nothing
    bool nothing() const
    {
      return !state && volume == 0 && flow == 0 && stored == 0 && part == 0 && memory.empty() &&
             std::all_of(scalars.begin(), scalars.end(), [](PetscReal by) { return by == 0; });
    }
    const MemorySweep::Values *weights() const { return memory.empty() ? nullptr : &memory; }
  };
  using Pending = std::map<PetscInt, std::vector<Wanted>>;

  /// What the scalars' equations see of the fields adds to z, for a unit of it.
  struct Border {
    bool seen = false;
    VecHandle right;                  ///< global
    VecHandle z;                      ///< local
    std::vector<PetscReal> by_scalar; ///< z . dR/ds
  };

  PetscErrorCode setup(const std::vector<Functional> &functionals);
  PetscErrorCode create(VecHandle &local) const;
  Wanted &wanted(Pending &pending, PetscInt stage, std::size_t functional) const;
  /// Fills in the changes of all shifts of a stage, of which @p pending is what later stages want.
  PetscErrorCode make_shifts(const std::vector<Functional> &functionals, PetscInt stage, const Pending &pending);
  void want_row(const std::vector<Functional> &functionals, PetscInt stage, Pending &pending) const;
  /// Adds a derivative by the pressure at the ventilator at the end of a stage, 1/kPa.
  void want_ventilator_pressure(PetscInt stage, PetscReal derivative, Wanted &wanted) const;
  /// Adds a derivative by the volume of the gas beyond the opening, 1/mm^3.
  void want_gas(PetscReal derivative, Wanted &wanted) const;
  /// Adds a derivative by the rate of the volume of a stage, s/mm^3, to the volumes that it looks back at.
  void want_past_volumes(const StageRecord &record, PetscReal by_flow, std::size_t k, Pending &pending) const;
  /// Makes the model that of a stage; fills x_ and rate_.
  PetscErrorCode recall(const StageRecord &record, PetscInt number);
  std::vector<PetscReal> values_of(const StageRecord &record) const;
  /// Derivatives of the local residual by the scalars that act on it, 1/kPa, or by the flow prescribed on a free
  /// airway, s/mm^3.
  PetscErrorCode make_columns(const StageRecord &record);
  PetscErrorCode make_column(const StageRecord &record, std::size_t scalar, Vec column);
  PetscErrorCode assemble(const StageRecord &record, PetscInt number);
  PetscErrorCode right_side(const StageRecord &record, std::size_t k, Wanted &w, Pending &pending, Vec right);
  /// Rate of the gas beyond the opening by the time scheme, mm^3/s.
  PetscReal gas_rate(const StageRecord &record, PetscInt number) const;
  /// The scalars' equations, whose derivatives rows_ has, at a stage that was recalled.
  ScalarUnknowns::OpeningEquation equation(const StageRecord &record, PetscInt number) const;
  PetscErrorCode recall_scalars(const StageRecord &record, PetscInt number);
  /// Right-hand sides of the borders, before the airway's rows are closed; then their solutions.
  PetscErrorCode begin_borders();
  PetscErrorCode solve_borders(std::string &failure);
  /// The multipliers of the scalars' equations, where @p wanted is what is wanted of the scalars beside them.
  std::vector<PetscReal> solve_scalars(const std::vector<PetscReal> &wanted) const;
  PetscErrorCode add_scalars(const StageRecord &record, std::size_t k, const std::vector<PetscReal> &wanted,
                             Solved &result, std::string &failure);
  PetscErrorCode solve_stage(const StageRecord &record, std::size_t k, const Wanted &w, Vec right, Pending &pending,
                             Solved &result, std::string &failure);
  /// Adds what @p result, solved, wants of earlier stages through the opening and the scalars.
  void look_back_at_scalars(const StageRecord &record, std::size_t k, const Solved &result, Pending &pending);
  PetscErrorCode solve(Vec right, Vec solution, std::string &failure);
  PetscErrorCode to_global(Vec local, Vec global) const;
  PetscErrorCode to_local(Vec global, Vec local) const;
  PetscErrorCode dot(Vec a, Vec b, PetscReal &sum) const;
  /// z . dR/ds of the scalars that act.
  PetscErrorCode along_columns(Vec z, std::vector<PetscReal> &by_scalar) const;
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
  } kept_;                                      ///< the stage whose preconditioner is in use, stages ago
  std::vector<PetscReal> volumes_, flows_;      ///< [stage]: mm^3; through the opening, mm^3/s
  VecHandle x_, rate_, past_, work_, other_;    ///< local
  VecHandle right_, held_, product_, residual_; ///< global
  ScalarUnknowns scalars_;                      ///< as they were in the stage at hand, where they are unknown
  ScalarUnknowns::Rows rows_;
  std::vector<PetscReal> storages_; ///< [scalar]: mm^3/kPa
  std::vector<std::size_t> acting_; ///< scalars that the fields see
  std::vector<VecHandle> columns_;  ///< [of these]
  Border volume_;                   ///< of the opening's equation
  std::vector<Border> fluxes_;      ///< [of acting_]
  PetscReal tolerance_ = 0;
  StopRequest *stop_request_ = nullptr;
  bool stopped_ = false;
  PetscInt solves_ = 0, krylov_ = 0;
};

} // namespace pulmo
