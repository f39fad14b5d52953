/// @file
/// Whether accepted steps were solved: what they leave of their equations, against what these balance.
#pragma once

#include "pulmo/fem/archive.hpp"

#include <functional>

namespace pulmo {

/// Holds the errors that the solver leaves in each step, and their worst in the run, against the volume that the lung
/// moves and the loads that it bears. A right solver file leaves 1e-7 of these or less; above 1e-4 the run warns, above
/// 1e-2 it ends.
///
/// What a step moves by itself counts from that step on. A small volume or load counts as a thousandth of the lung's
/// volume, or of the tissue's modulus on its surface, so that neither a short step at the start of a ramp nor what
/// -snes_atol leaves of a faint load is held against itself.
class Balance {
public:
  /// What a step leaves of its equations.
  struct Errors {
    PetscReal gas = 0;      ///< that the mass balance does not account for, or prescribed volume that is missed, mm^3
    PetscReal net_gas = 0;  ///< gas that all nodes together gain by it, mm^3: adds up over the steps
    PetscReal force = 0;    ///< without balance: sum over the nodes, kPa mm^2
    PetscReal pressure = 0; ///< by which the ventilator's is missed, kPa
  };

  /// What the nodes balance, as sums over them.
  struct Loads {
    PetscReal force = 0; ///< kPa mm^2
    PetscReal gas = 0;   ///< of sources, and through surfaces with a pressure other than the airway, mm^3 in the step
  };

  /// @p lung: volume at rest, mm^3; @p modulus: of the tissue, kPa.
  void setup(PetscReal lung, PetscReal modulus);
  /// Takes note of a step of @p breath that is to be accepted, begins at volume @p before (mm^3 above rest) and ends at
  /// @p volume and @p pressure (kPa). @p load gives what acts on the nodes; it is asked only if it matters. @p solved
  /// is false if the step leaves too much; complaint() then tells what.
  PetscErrorCode judge(int breath, PetscReal before, PetscReal volume, PetscReal pressure, const Errors &errors,
                       const std::function<PetscErrorCode(Loads &)> &load, bool &solved);
  /// The step that was judged last is accepted.
  void accept() { drift_ += step_drift_; }
  /// At the end of the run: the same of its worst step, and of @p gas (mm^3), which the run lost or made in all.
  bool judge_run(PetscReal gas = 0);

  /// Whether judge() came upon the first step that the user is to be warned of.
  bool warns() const { return warns_; }
  /// What the step, or after judge_run() the run, leaves of which equation. Half a sentence.
  const std::string &complaint() const { return complaint_; }
  /// The largest share that a step of the run left; after judge_run() with the sizes of the whole run.
  PetscReal worst() const { return worst_share_; }
  static constexpr PetscReal warning = 1e-4, failure = 1e-2;
  /// What volumes and loads count as at least, as a share of the lung's volume, or of the modulus on its surface: what
  /// is far below that, -snes_atol may leave.
  static constexpr PetscReal least = 1e-3;

  PetscErrorCode persist(Archive &archive);

private:
  /// The largest share of @p errors in the sizes so far.
  PetscReal share(const Errors &errors, std::string &text) const;

  PetscReal lung_ = 1, modulus_ = 1;
  Errors worst_;                       ///< of the run, each
  Errors size_;                        ///< largest so far: swing of the volume in a breath, load, pressure
  PetscReal lowest_ = 0, highest_ = 0; ///< volume in the breath at hand, mm^3
  PetscReal worst_share_ = 0;
  PetscReal drift_ = 0, step_drift_ = 0; ///< gas without account: of the run so far, of the step judged last, mm^3
  int breath_ = 0;
  bool warned_ = false, warns_ = false;
  std::string complaint_;
};

} // namespace pulmo
