/// @file
/// The scalar unknowns of a scene in Newton's method: the pressure at the airway opening and those of effects.
#pragma once

#include "pulmo/fem/model.hpp"

#include <functional>
#include <vector>

namespace pulmo {

/// Scalars s with equations c(s, ds/dt, V, Q) = 0 beside the fields x with F(x, s) = 0; V is the lung's volume, Q are
/// the flows into it. The first is the pressure at the airway opening, whose equation is the ventilator's.
///
/// They are eliminated: with J y = F and, for each scalar that acts on the fields, J z_j = dF/ds_j,
///
///   dx = -y - sum_j z_j ds_j,   (c_s - c_x Z) ds = -c + c_x y,
///
/// so that the matrix gets no dense row; a Newton step costs one more solve for each such scalar. F and c are one
/// global vector (AirwayNodes): norms and line searches see both.
class ScalarUnknowns {
public:
  /// The equation of the pressure P at the opening, c(P, V) = 0, dimensionless; V: of the gas beyond it, mm^3
  /// above rest. @p by_volume: with the rate of V; @p by_flow: of that alone; @p by_target: of what is prescribed.
  struct Opening {
    PetscReal c = 0, by_pressure = 0, by_volume = 0, by_flow = 0, by_target = 0;
  };
  using OpeningEquation = std::function<Opening(PetscReal pressure, PetscReal volume)>;
  /// The equations and their derivatives by scalars, lung volume and flows.
  struct Rows {
    std::vector<PetscReal> c, by_volume; ///< [equation]
    std::vector<PetscReal> by_scalar;    ///< [equation][scalar], fields fixed, its rate not
    std::vector<PetscReal> by_rate;      ///< [equation][scalar], of effects' equations: by its rate alone
    std::vector<PetscReal> by_flow;      ///< [equation][scalar whose surfaces it enters by]
    PetscReal unmet = 0;                 ///< of the effects', the worst, kPa
    Opening opening;
  };

  explicit ScalarUnknowns(Model &model) : model_(model) {}

  /// The opening's and those of effects.
  std::size_t size() const { return 1 + model_.composition().n_scalars(); }
  bool of_effects() const { return model_.composition().n_scalars() > 0; }
  /// kPa; the opening's first.
  const std::vector<PetscReal> &values() const { return value_; }
  PetscReal opening() const { return value_.front(); }
  /// Flows into the lung through the surfaces of each, at the last close(), mm^3/s.
  const std::vector<PetscReal> &flows() const { return flow_; }
  /// d(value)/dt, kPa/s.
  std::vector<PetscReal> rates() const;
  /// What effects see of all that, in the order of Composition::scalar_groups().
  std::vector<ScalarState> states() const;
  /// Gas stored beside the lung at scalars @p values, mm^3; of their rates (kPa/s): what flows there, mm^3/s.
  PetscReal stored(const std::vector<PetscReal> &values) const;
  /// The same of each scalar, mm^3/kPa.
  std::vector<PetscReal> storages() const;

  /// Begins an attempt at a stage: scalars start at @p values; d(value)/dt = @p slope (1/s) value + @p past (kPa/s).
  /// @p unknown: Newton solves for them; else the opening's is given and effects have none.
  void begin(std::vector<PetscReal> values, bool unknown, PetscReal slope, std::vector<PetscReal> past);
  /// Takes what an accepted stage had, after begin(): the lung's @p volume and the @p flows; then rows() are its own.
  void recall(PetscReal volume, std::vector<PetscReal> flows);
  /// The equations as they are at the values at hand.
  Rows rows(const OpeningEquation &opening) const;
  /// Holds them at their last values for as long as @p frozen: the assembled Jacobian is that of the residual without
  /// them and their equations.
  void freeze(bool frozen) { frozen_ = frozen && unknown_; }
  /// Takes the values of a global vector where they are unknown.
  PetscErrorCode take(Vec X);
  /// Writes the equations at lung volume @p volume (mm^3 above rest) and the local residual @p local_F into their rows
  /// of a global residual.
  PetscErrorCode close(const OpeningEquation &opening, PetscReal volume, Vec local_F, Vec F);
  /// By how much the equations of effects were missed at the last close(): the worst, kPa.
  PetscReal unmet() const { return unmet_; }
  /// Completes the Newton step @p Y of a solution @p X with local state @p local. @p krylov counts iterations.
  PetscErrorCode complete(SNES snes, const OpeningEquation &opening, Mat A, Vec X, Vec Y, Vec local, PetscInt &krylov);

private:
  /// d(volume, flows) along a change @p y of the fields and @p scalars of the scalars.
  PetscErrorCode along(Vec local, Vec y, const std::vector<PetscReal> &scalars, PetscReal &volume,
                       std::vector<PetscReal> &flow);
  PetscErrorCode create_vectors(Vec like, Vec like_local);
  /// What makes an effect's equation dimensionless, as the mass rows are in proportion to a flow: the same for a whole
  /// attempt. A pressure behind a large resistance would else drown all other rows.
  PetscReal scale_of(std::size_t equation, ScalarRows &own, std::size_t row) const;

  Model &model_;
  std::vector<PetscReal> value_ = {0}, past_ = {0}, flow_;
  PetscReal slope_ = 1, volume_ = 0, unmet_ = 0;
  mutable std::vector<PetscReal> scale_; ///< of the equations in the attempt at hand; 0: not known yet
  bool unknown_ = false, frozen_ = false;
  std::vector<std::size_t> acting_; ///< scalars that the fields see: pressures of surfaces, or of all gas
  std::vector<VecHandle> column_, solution_;
  VecHandle x_, r_, local_y_;
};

/// Solves the dense system @p a x = @p b (@p a row by row) by elimination with pivots. Where it is singular the result
/// is not finite, for the caller to see; PETSc's and LAPACK's solvers end the run instead.
void solve_dense(std::vector<PetscReal> a, std::vector<PetscReal> &b);

} // namespace pulmo
