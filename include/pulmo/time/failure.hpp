/// @file
/// Why a run could not go on: at the airway's rim, everywhere, in some other place, or in the solver; and the paragraph
/// that says so.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/physics/scene.hpp"
#include "pulmo/physics/signal_row.hpp"
#include "pulmo/time/own_limit.hpp"

#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// An attempt at a step that was not accepted.
struct FailedAttempt {
  PetscReal time = 0, dt = 0; ///< where the step began and how long it was, s
  std::string reason;
  PetscInt newton = 0;
  Measures measures = {}; ///< of the last state that kernels may not see, if any
  bool inverted = false;  ///< there was one: J <= 0, or airless
};

/// What an attempt at a step hangs on, beside the state that it starts from.
struct AttemptBegin {
  PetscReal dt = 0;                    ///< of the attempt, s
  PetscReal wanted_dt = 0;             ///< before any shortening to land on a time, s
  PetscReal asked_dt = 0;              ///< -ts_dt, s
  bool cut = false;                    ///< the step was cut before
  bool always_new = false;             ///< no Jacobian is kept
  bool looks_back = false;             ///< the time scheme does, beyond the state before the step
  bool limited = false;                ///< the attempt before it asked for this one with a pressure held
  bool past_limit = false;             ///< it is past a limit point
  int crawled = 0;                     ///< accepted steps in a row before it that were tiny
  std::vector<FailedAttempt> failures; ///< that are remembered by then
};

/// An attempt, and how it went.
struct AttemptRecord {
  AttemptBegin begin;
  std::vector<PetscReal> norms; ///< of the residual, in all of its Newton solves
  std::string outcome = "accepted";
};

/// Refuses a model with cells whose tissue is not stable at rest; the message names the law's options. Collective.
PetscErrorCode check_stable_at_rest(const Options &options, const Scene &scene, const Model &model);

/// The end of a way along which volume follows pressure ever more steeply.
struct LimitPoint {
  double pressure = 0;             ///< that is held there, cmH2O
  bool highest = true;             ///< there is no equilibrium above it; else below
  double last = 0, on_the_way = 0; ///< change of volume by pressure in the last step, and before it, ml/cmH2O
};

/// Whether the last rows, of a phase that prescribes pressure, end at one. @p last: of the last state.
std::optional<LimitPoint> limit_point(const std::vector<SignalRow> &rows, const Measures &last);

/// What is known of the end of a run.
struct FailureFacts {
  std::vector<FailedAttempt> attempts; ///< the last ones
  std::vector<SignalRow> rows;         ///< accepted, of the whole run
  bool crawled = false;                ///< it ended because steps only crawled
  bool free_flow = false;              ///< in a phase that shares a prescribed flow by area
  bool prescribes_pressure = false;    ///< as its phase does
  bool could_flow_on = false;          ///< -ventilator_on_limit_point could be flow, and is not
  bool past_limit = false;             ///< a flow is prescribed past a limit point
  std::string phase = "run";
};

/// Where and why.
struct Diagnosis {
  enum class Kind {
    rim,        ///< the worst cell is within two cells of the edge of the airway
    everywhere, ///< the law has no stiffness left at this stretch
    inside,     ///< one place, neither of the two
    solver      ///< the tissue is well
  };
  Kind kind = Kind::solver;
  std::optional<Measures> worst;     ///< the cell that turned inside out, or is close to it
  std::optional<PetscReal> from_rim; ///< its distance from the edge of the airway, mm
  PetscReal mean_J = 1;              ///< of the last good state
  PetscReal inflation = 0;           ///< dp/dJ of uniform inflation there, kPa
  PetscReal acoustic = 0;         ///< acoustic_stiffness() of the mean deformation gradient of the last good state, kPa
  PetscReal acoustic_at_rest = 0; ///< the same at rest, kPa
  bool inflation_lost = false, acoustic_lost = false; ///< next to nothing of them is left
  PetscReal lost_share = 0;          ///< share of the volume whose cells are not elliptic in the last good state
  std::string limit;                 ///< sentence on a limit point of the pressure; empty if there is none
  std::optional<OwnLimit> own_limit; ///< of the law, where part of the lung is beyond it
  const char *name() const;          ///< of the kind, as in failure.json
};

/// Looks at the last good state @p local (a local vector). Collective.
PetscErrorCode diagnose(const Scene &scene, const Model &model, const FailureFacts &facts, Vec local,
                        Diagnosis &diagnosis);

/// One paragraph: where, when, what was tried, why, what to try.
std::string failure_text(const Scene &scene, const FailureFacts &facts, const Diagnosis &diagnosis);

} // namespace pulmo
