/// @file
/// The run of a scene over time: one TSSolve per ventilator phase, step control, acceptance of steps.
#pragma once

#include "pulmo/base/stop_signal.hpp"
#include "pulmo/fem/model.hpp"
#include "pulmo/fem/pins.hpp"
#include "pulmo/physics/scene.hpp"
#include "pulmo/solvers/fixed_stress.hpp"
#include "pulmo/solvers/lagging.hpp"
#include "pulmo/solvers/p1_space.hpp"
#include "pulmo/time/airway.hpp"
#include "pulmo/time/balance.hpp"
#include "pulmo/time/failure.hpp"
#include "pulmo/time/observer.hpp"
#include "pulmo/time/predictor.hpp"
#include "pulmo/time/step_control.hpp"
#include "pulmo/time/trajectory.hpp"

#include <set>

namespace pulmo {

/// Wall seconds by stage, largest over the ranks at the end.
struct StageSeconds {
  double setup = 0, residual = 0, jacobian = 0, solve = 0, output = 0, total = 0;
};

class Simulation {
public:
  Simulation(const Options &options, const Scene &scene, Model &model)
      : options_(options), scene_(scene), model_(model), airway_(model, scene.facts(), scheme_)
  {}

  /// Declares the options of the steps.
  PetscErrorCode declare(Options &options);
  /// Creates TS, SNES, KSP and the matrix from the options database.
  PetscErrorCode setup();
  /// Counts what was done before the run as set-up, s.
  void setup_took(double seconds) { seconds_.setup = seconds; }
  void add(Observer &observer) { observers_.push_back(&observer); }
  /// Lets @p trajectory keep the accepted stages from the start on. It must outlive the run.
  void record(Trajectory &trajectory) { trajectory_ = &trajectory; }
  /// Lets @p request end the run after the step at hand. It must outlive the run.
  void heed(StopRequest &request) { stop_request_ = &request; }
  /// Writes or reads the run after its last accepted step, observers included; after reading, run() goes on from there.
  PetscErrorCode persist(Archive &archive);
  /// Starts the run, until its solver has made what it keeps to the end (orderings, coarse spaces) of the first
  /// Jacobian, and forgets all else. persist_attempt() has to read next.
  PetscErrorCode warm_up();
  /// The same before attempt @p begin at the step after it, as it was when that began; after reading, run() repeats it.
  PetscErrorCode persist_attempt(Archive &archive, AttemptBegin begin);
  /// How the next attempt would begin.
  AttemptBegin next_attempt() const;
  /// Attempts at the step at which the run ended: those since the last accepted one, or at that one if steps crawled.
  const std::vector<AttemptRecord> &last_attempts() const { return crawls() ? accepted_attempts_ : attempts_; }
  /// Attempts at the last accepted step, that one included.
  const std::vector<AttemptRecord> &accepted_attempts() const { return accepted_attempts_; }
  /// The first of the last attempts that needs nothing of the solver's past.
  std::size_t first_repeatable() const;
  /// Whether a run that could not go on ended in a step, and not when it was judged as a whole.
  bool ended_in_step() const { return ended_in_step_; }
  /// Whether it ends as its steps only crawl, or does with one more such step.
  bool crawls() const { return crawled_ >= max_crawling_steps; }
  bool crawls_soon() const { return crawled_ == max_crawling_steps - 1; }
  /// Runs to the end. @p finished is false if the run was asked to stop, or if no step could be accepted any more;
  /// failure_text() then tells why.
  PetscErrorCode run(bool &finished);

  Vec state() const { return state_; }        ///< global vector, the last accepted state
  Vec local_state() const { return before_; } ///< the same, local, constrained values in place
  PetscReal time() const { return accepted_.time; }
  bool at_end() const { return same(accepted_.time, end_); }
  PetscReal end() const { return end_; }    ///< of the run, s
  bool stopped() const { return stopped_; } ///< as asked
  const std::vector<SignalRow> &rows() const { return rows_; }
  PetscReal mass_balance_error() const { return worst_balance_; } ///< largest of the run, mm^3
  PetscReal min_J() const { return min_J_; }
  PetscReal support_reaction() const { return worst_reaction_; } ///< largest force component of the run, kPa mm^2
  const PinForces &pins() const { return pins_; }
  PetscInt rejected_steps() const { return rejected_; }
  const StageSeconds &seconds() const { return seconds_; }
  const TimeScheme &scheme() const { return scheme_; }
  const StepControl &step_control() const { return step_control_; }
  PetscReal wanted_dt() const { return wanted_dt_; } ///< -ts_dt, s
  TS ts() const { return ts_; }
  Mat matrix() const { return matrix_; } ///< of the Jacobians
  /// Whether the step after the last accepted one would be another one if the run did not end at -ts_max_time.
  bool end_cuts_next() const;
  /// Makes failure_text() say that @p what, as the solver leaves @p left, and which options made it so.
  PetscErrorCode end_unsolved(const std::string &what, const std::string &left);
  /// One paragraph on a run that could not go on: where, when, what was tried, what to try.
  std::string failure_text() const;
  /// Whether a partner ended such a run, for what no solver mends.
  bool given_up() const { return given_up_; }
  /// Where and why such a run ended.
  const Diagnosis &diagnosis() const { return diagnosis_; }

  // what PETSc calls back
  PetscErrorCode residual(PetscReal t, Vec X, Vec Xdot, Vec F);
  PetscErrorCode jacobian(PetscReal t, Vec X, Vec Xdot, Mat A);
  PetscErrorCode before_stage(PetscReal t);
  /// First guess of a step; comes as the state before it.
  PetscErrorCode guess(SNES snes, Vec X);
  /// Completes the Newton step @p Y of a solution @p X where scalars are unknown.
  PetscErrorCode border(SNES snes, Vec X, Vec Y);
  /// The matrix times @p x. Along a bordered step the rate of change of the residual is minus the residual, as along
  /// any Newton step; the matrix lacks the columns and the rows of the scalars.
  PetscErrorCode product(Vec x, Vec y);
  /// PETSc's test, but a prescribed volume must be met too.
  PetscErrorCode converged(SNES snes, PetscInt it, PetscReal xnorm, PetscReal ynorm, PetscReal fnorm,
                           SNESConvergedReason *reason);
  PetscErrorCode after_stage();
  PetscErrorCode accept_stage(PetscReal t, Vec X, PetscBool *accept);
  PetscErrorCode after_step();
  /// Whether the step of size @p h from @p t is accepted, and the size of the one after it (or of the next attempt):
  /// grows back after cuts, or follows the error in time.
  PetscReal next_step(PetscReal t, PetscReal h, TSAdapt adapt, PetscBool &accept);

private:
  /// So many tiny steps in a row end a run: it only crawls towards a state that it cannot pass.
  static constexpr int max_crawling_steps = 20;

  PetscErrorCode create_solver();
  /// Notes how the attempt at hand went.
  void went(const std::string &outcome);
  PetscErrorCode persist_begin(Archive &archive, AttemptBegin &begin);
  FailureFacts failure_facts() const;
  /// The row at t = 0.
  PetscErrorCode start();
  PetscErrorCode persist_rows(Archive &archive);
  /// Finds the phase that goes on at what was read.
  PetscErrorCode check_state();
  PetscErrorCode resume(const Archive &archive, PetscInt index, PetscReal wanted_dt, PetscReal phase_end);
  /// Ends the run with @p reason if it is asked to stop.
  PetscErrorCode heed_request(TSConvergedReason reason);
  PetscErrorCode offer_fixed_stress(KSP ksp);
  /// @p pc_type: what -pc_type says.
  PetscErrorCode offer_view(KSP ksp, const std::string &pc_type);
  /// Two times closer than this share of the step are the same.
  static constexpr PetscReal same_time = 1e-9;
  /// Whether two times of this run are the same up to rounding.
  bool same(PetscReal t, PetscReal other) const;
  /// The last accepted state is at a kink in time: nothing may look back beyond it.
  void begin_smooth_stretch();
  /// Step size from time @p t, shortened to land on the end of the ramp or of the phase.
  PetscReal landing(PetscReal t) const;
  PetscErrorCode airway_alone(bool &alone);
  PetscErrorCode make_rate();
  PetscErrorCode local_residual(PetscReal t);
  PetscErrorCode is_evaluated(PetscReal t, bool &evaluated) const;
  PetscErrorCode measure(PetscReal t, Measures &measures) const;
  PetscErrorCode scatter(PetscReal t, Vec X, Vec Xdot);
  Moment moment(PetscReal t, PetscReal volume, Vec local) const
  {
    return {t, volume, local, airway_.scalars().of_effects() ? airway_.scalars().values() : std::vector<PetscReal>()};
  }
  PetscErrorCode ask_partners(const Attempt &attempt, PetscBool *accept);
  PetscErrorCode past_of_partners(Archive &archive);
  void list_scalars(SignalRow &row) const;
  /// Hands the accepted stage that ends at @p t with @p local to the trajectory. @p row: of the signals, or -1.
  PetscErrorCode record_stage(PetscReal t, PetscInt row, Vec local);
  PetscErrorCode judge(PetscReal t, PetscReal volume, PetscReal pressure, bool &solved);
  PetscErrorCode consistent_flow(PetscReal &flow) const;
  PetscErrorCode keep_step(PetscReal dt);
  PetscErrorCode fail(PetscReal dt, const std::string &reason, PetscInt newton, const Measures &measures, bool inverted,
                      bool retry);
  PetscErrorCode warn_of_faint_load(SNES snes);
  /// Says so, once for each line of a programme, if a phase that begins at @p pressure (cmH2O) has a lower limit.
  PetscErrorCode warn_of_low_limit(const Phase &phase, PetscReal pressure);
  /// The same before the run for all phases whose first pressure is known by then.
  PetscErrorCode warn_of_low_limits();
  /// Step size asked for in the phase at hand (before the run: in its first), s.
  PetscReal asked_dt() const { return (phase_ ? *phase_ : phases_.front()).dt.value_or(wanted_dt_); }
  /// Notes an attempt that failed; ends the run if the next one would be too short.
  /// @p share: the length of the next one over this one's, where something tells.
  PetscErrorCode reject(PetscReal dt, const std::string &reason, PetscInt newton, const Measures &measures,
                        bool inverted, std::optional<PetscReal> share = {});
  /// Holds what @p attempt changed against the bounds of -step_J_change and -step_p_change, and asks for a shorter step
  /// if that is more.
  PetscErrorCode judge_changes(const Attempt &attempt, PetscBool *accept);
  PetscErrorCode measure_change(const Attempt &attempt, StepBound::Quantity quantity, PetscReal &change) const;
  /// Lets the run go on past the limit point that its last accepted state is at, if there is one and the scene asks for
  /// that; whether it does.
  PetscErrorCode flow_on(bool &flows_on);
  PetscErrorCode report(SignalRow row, const Measures &measures);
  /// Lays out the phases again, those that ended early as long as they were.
  void lay_out_phases();
  void end_phase(PetscReal t);
  PetscReal landing(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const;
  /// The same as PETSc changes it for all steps of a phase but the first (TSAdaptChoose), so that none before the end
  /// is a sliver.
  PetscReal goes_on_with(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const;

  const Options &options_;
  const Scene &scene_;
  Model &model_;
  TimeScheme scheme_;
  Airway airway_;
  std::vector<std::unique_ptr<Partner>> effect_partners_;
  std::vector<Partner *> partners_; ///< the airway and those of effects
  bool kink_ = false;               ///< a partner saw one in the attempt judged last
  StepControl step_control_;
  StepControl::Value candidate_; ///< at the end of the step that is to be accepted
  Balance balance_;
  std::string unsolved_; ///< why the run ends, if it is not solved
  bool given_up_ = false;
  Predictor predictor_;
  PinForces pins_;
  Lagging lagging_;
  FixedStress fixed_stress_;
  P1Matrix p1_;
  std::vector<Observer *> observers_;
  StopRequest *stop_request_ = nullptr;
  Trajectory *trajectory_ = nullptr;
  TSHandle ts_;
  MatHandle matrix_;
  VecHandle state_, local_, rate_, local_residual_, before_;
  /// The state that residual() was asked for last. What follows from it need not be computed again when it is accepted.
  struct {
    bool known = false; ///< and local_residual_ is that of this state
    PetscReal t = 0;
    Step step;
    VecHandle local;
    Measures measures;
  } evaluated_;
  std::vector<Phase> phases_;
  /// A phase that ended before its time.
  struct EndedPhase {
    PetscInt index = 0;
    PetscReal time = 0; ///< s
  };
  std::vector<EndedPhase> ended_;
  PetscReal max_time_ = PETSC_MAX_REAL; ///< -ts_max_time, s
  std::set<std::string> low_limits_;    ///< lines of the programme that were warned of
  const Phase *phase_ = nullptr;
  PetscReal wanted_dt_ = 0.05, dt_ = 0.05; ///< -ts_dt; in use before any shortening to land on a time
  PetscReal next_dt_ = 0;                  ///< size of the step after the last accepted one, before any cut
  PetscReal end_ = 0, whole_end_ = 0;      ///< of the run; of its last phase but for -ts_max_time
  Programme plan_{{}};                     ///< all phases as they are laid out now, but for -ts_max_time
  SignalRow accepted_;
  std::vector<SignalRow> rows_;
  PetscReal delivered_ = 0, worst_balance_ = 0, worst_reaction_ = 0, min_J_ = 1;
  PetscInt newton_ = 0, krylov_ = 0, rejected_ = 0;
  void (*multiply_)() = nullptr; ///< PETSc's product with matrix_
  struct {
    Vec step = nullptr, product = nullptr;
  } bordered_;                  ///< a bordered step and the residual at its start, until the search along it begins
  PetscReal start_norm_ = 0;    ///< residual of the attempt at hand before any Newton step and guess
  int extra_newton_ = 0;        ///< Newton steps of the attempt at hand for the prescribed volume alone
  bool inverted_ = false;       ///< the attempt at hand met J <= 0, or no air
  bool tests_jacobian_ = false; ///< -snes_test_jacobian
  bool cut_ = false;            ///< the step at hand was cut
  bool resumed_ = false;        ///< the run goes on from what was read
  bool stopped_ = false;        ///< as asked
  int crawled_ = 0;             ///< accepted steps in a row that were tiny
  Measures inverted_measures_;
  std::vector<FailedAttempt> failures_;
  std::vector<AttemptRecord> attempts_, accepted_attempts_; ///< at the step at hand; at the last accepted one
  bool attempt_begins_ = true;                              ///< the next stage is the first of an attempt
  bool ended_in_step_ = false;
  const AttemptBegin *written_ = nullptr; ///< what persist() is to write the past of the scheme for
  Diagnosis diagnosis_;                   ///< of a run that could not go on
  StageSeconds seconds_;
};

/// Registers the TSAdapt type "pulmo": cut on failure, grow back to the step asked for, land on kinks.
PetscErrorCode register_step_control();

} // namespace pulmo
