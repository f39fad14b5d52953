// A simulation from its set-up to its end: phases, and the times that steps land on.
#include "pulmo/time/simulation.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>
#include <petsc/private/tsimpl.h>

namespace pulmo {

namespace {

/// A pressure is above a limit if it is so by more than this, cmH2O.
constexpr PetscReal same_pressure = 1e-6;

/// A step may be longer by this share to land on a time, so that no sliver of a step is left.
constexpr PetscReal stretch = 0.01;

} // namespace

PetscErrorCode Simulation::declare(Options &options)
{
  PetscFunctionBeginUser;
  PetscCall(predictor_.declare(options));
  PetscCall(lagging_.declare(options));
  PetscCall(step_control_.declare(options));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::setup()
{
  const DM dm = model_.dm();

  PetscFunctionBeginUser;
  PetscCall(DMCreateGlobalVector(dm, state_.out()));
  PetscCall(DMCreateLocalVector(dm, local_.out()));
  PetscCall(VecDuplicate(local_, rate_.out()));
  PetscCall(VecDuplicate(local_, local_residual_.out()));
  PetscCall(VecDuplicate(local_, evaluated_.local.out()));
  PetscCall(VecDuplicate(local_, before_.out()));
  PetscCall(predictor_.setup(state_));
  balance_.setup(scene_.mesh().volume(), model_.modulus());
  PetscCall(create_solver());
  partners_ = {&airway_};
  for (const Effect *effect : scene_.active())
    for (auto &partner : effect->partners(scene_.facts())) {
      partners_.push_back(partner.get());
      effect_partners_.push_back(std::move(partner));
    }
  (void)TSGetMaxTime(ts_, &max_time_);
  lay_out_phases();
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Simulation::lay_out_phases()
{
  const std::ptrdiff_t at = phase_ ? phase_ - phases_.data() : 0;
  std::vector<Phase> list;

  if (scene_.facts().ventilator)
    list = scene_.facts().ventilator->phases();
  else {
    Phase run;
    run.name = "run";
    run.end = max_time_ < PETSC_MAX_REAL ? max_time_ : 1;
    list.push_back(run);
  }
  for (const EndedPhase &ended : ended_) {
    const auto index = static_cast<std::size_t>(ended.index);
    PetscReal end = list[index].end = ended.time;
    for (std::size_t i = index + 1; i < list.size(); ++i) {
      list[i].end = end + (list[i].end - list[i].begin);
      list[i].begin = end;
      end = list[i].end;
    }
  }
  plan_ = Programme(list);
  while (list.size() > 1 && list.back().begin > max_time_ - same_time * wanted_dt_) list.pop_back();
  whole_end_ = scene_.facts().ventilator ? list.back().end : PETSC_MAX_REAL;
  list.back().end = std::min(list.back().end, max_time_);
  phases_ = std::move(list);
  end_ = phases_.back().end;
  if (phase_) phase_ = &phases_[at];
}

/// The phase at hand ends with the step accepted last, and the next one begins.
void Simulation::end_phase(PetscReal t)
{
  ended_.push_back({static_cast<PetscInt>(phase_ - phases_.data()), t});
  lay_out_phases();
}

bool Simulation::same(PetscReal t, PetscReal other) const
{
  return std::abs(t - other) <= same_time * asked_dt();
}

/// The size of the step from time t within a phase that ends at @p end, where steps of @p dt are wanted.
PetscReal Simulation::landing(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const
{
  for (const PetscReal stop : {phase.begin + phase.ramp, end})
    if (t < stop && !same(t, stop) && t + (1 + stretch) * dt > stop) return stop - t;
  return dt;
}

PetscReal Simulation::landing(PetscReal t) const
{
  return landing(*phase_, phase_->end, dt_, t);
}

PetscReal Simulation::goes_on_with(const Phase &phase, PetscReal end, PetscReal dt, PetscReal t) const
{
  const PetscReal h = landing(phase, end, dt, t), left = end - t;
  TSAdapt adapt;
  (void)TSGetAdapt(ts_, &adapt);
  if (h >= left || h * (1 + adapt->matchstepfac[0]) > left) return left;
  return h * adapt->matchstepfac[1] > left ? left / 2 : h;
}

bool Simulation::end_cuts_next() const
{
  const PetscReal t = accepted_.time;
  const Phase &last = phases_.back(), *next = phase_ ? phase_ : &phases_.front();
  if (same(end_, whole_end_) || same(t, end_)) return false;
  const bool begins = !phase_ || same(t, phase_->end);
  if (phase_ && begins) ++next; // the run goes on, so there is one
  if (next != &last) return false;
  const PetscReal asked = last.dt.value_or(wanted_dt_); // what run() begins a phase with
  const PetscReal dt = begins && (step_control_.in_use() || asked != asked_dt()) ? asked : dt_;
  const PetscReal now = begins ? landing(last, end_, dt, t) : goes_on_with(last, end_, dt, t),
                  whole = begins ? landing(last, whole_end_, dt, t) : goes_on_with(last, whole_end_, dt, t);
  return !same(now, whole);
}

PetscErrorCode Simulation::start()
{
  Measures measures;

  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(state_));
  PetscCall(predictor_.begin(state_));
  PetscCall(DMGlobalToLocal(model_.dm(), state_, INSERT_VALUES, before_));
  PetscCall(model_.measure(before_, measures));
  accepted_ = SignalRow();
  accepted_.phase = phases_.front().name;
  accepted_.breath = static_cast<int>(phases_.front().breath);
  if (phases_.front().control == Control::pressure) // a run begins with all at rest, or with a pressure of its own
    accepted_.pressure = phases_.front().from.value_or(0) / units::kPa_per_cmH2O;
  accepted_.ventilator_pressure = accepted_.pressure;
  airway_.start();
  accepted_.scalars.assign(model_.composition().n_scalars(), 0);
  accepted_.scalar_flows = accepted_.scalars;
  PetscCall(record_stage(0, 0, before_));
  PetscCall(scheme_.begin(model_, moment(0, measures.volume_change, before_)));
  PetscCall(warn_of_low_limits());
  dt_ = asked_dt();
  PetscCall(report(accepted_, measures));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::run(bool &finished)
{
  const MPI_Comm comm = options_.comm();
  PetscLogDouble begin, end;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&begin));
  if (!resumed_) PetscCall(start());
  finished = true;
  for (auto i = static_cast<std::size_t>(resumed_ ? phase_ - phases_.data() : 0); i < phases_.size(); ++i) {
    TSConvergedReason reason;
    const Phase phase = phases_[i]; // they are laid out again where one ends early
    const bool within = resumed_;
    resumed_ = false;
    if (within && same(accepted_.time, phase.end)) continue;
    const PetscReal asked_before = asked_dt();
    phase_ = &phases_[i];
    if (!within) {
      if (asked_dt() != asked_before) dt_ = asked_dt();
      PetscCall(warn_of_low_limit(phase, accepted_.machine_pressure()));
      airway_.begin_phase(phase, accepted_.volume * units::mm3_per_ml, std::min(asked_dt(), phase.end - phase.begin));
      if (trajectory_) trajectory_->begin_phase();
      begin_smooth_stretch();
      next_dt_ = landing(phase.begin);
    }
    PetscCall(TSSetTime(ts_, within ? accepted_.time : phase.begin));
    PetscCall(TSSetMaxTime(ts_, phase.end));
    PetscCall(TSSetTimeStep(ts_, next_dt_));
    PetscCall(scheme_.begin_solve(static_cast<PetscInt>(rows_.size()) - 1));
    if (!within) PetscCall(TSRestartStep(ts_)); // also where a restart found the phase before at its end
    PetscCall(TSSolve(ts_, state_));
    PetscCall(TSGetConvergedReason(ts_, &reason));
    if (reason < 0 || stopped_) {
      finished = false;
      ended_in_step_ = reason < 0 && !stopped_;
      break;
    }
  }
  if (finished) {
    bool alone;
    PetscCall(airway_alone(alone));
    finished = balance_.judge_run(alone ? worst_balance_ : 0);
    if (!finished)
      PetscCall(end_unsolved("the run was not solved", balance_.complaint()));
    else if (balance_.worst() > Balance::warning)
      PetscCall(PetscPrintf(comm, "pulmo: warning: the steps are hardly solved: the worst leaves %s\n",
                            balance_.complaint().c_str()));
  }
  if (!finished && !stopped_ && unsolved_.empty())
    PetscCall(diagnose(scene_, model_, failure_facts(), before_, diagnosis_));
  PetscCall(PetscTime(&end));
  seconds_.total = end - begin + seconds_.setup;
  seconds_.solve = end - begin - seconds_.residual - seconds_.jacobian - seconds_.output;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &seconds_, 6, MPI_DOUBLE, MPI_MAX, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::warm_up()
{
  /// Stops as soon as a linear system was solved.
  class FirstSystem final : public StopRequest {
  public:
    explicit FirstSystem(const Simulation &simulation) : simulation_(simulation) {}
    PetscErrorCode asked(bool &stop) override
    {
      PetscFunctionBeginUser;
      stop = simulation_.krylov_ > 0 || simulation_.accepted_.krylov > 0;
      PetscFunctionReturn(PETSC_SUCCESS);
    }

  private:
    const Simulation &simulation_;
  };
  FirstSystem first(*this);
  SNES snes;
  bool through;

  PetscFunctionBeginUser;
  heed(first);
  PetscCall(run(through));
  stop_request_ = nullptr;
  PetscCall(TSGetSNES(ts_, &snes));
  PetscCall(lagging_.settle(snes));
  lagging_.renew(snes);
  airway_.retake(false);
  ended_.clear();
  lay_out_phases();
  rows_.clear();
  attempts_.clear();
  accepted_attempts_.clear();
  attempt_begins_ = true;
  unsolved_.clear();
  newton_ = krylov_ = 0;
  stopped_ = given_up_ = ended_in_step_ = inverted_ = false;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Whether gas gets in and out by the airway and nowhere else: no source, and no other node of prescribed pressure.
PetscErrorCode Simulation::airway_alone(bool &alone)
{
  PetscReal force, gas = 0;

  PetscFunctionBeginUser;
  if (scene_.facts().airflow) PetscCall(model_.loads(accepted_.time, before_, local_residual_, force, gas));
  alone = scene_.facts().airflow && gas == 0;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::warn_of_low_limits()
{
  PetscReal pressure = accepted_.machine_pressure();
  bool known = true;

  PetscFunctionBeginUser;
  for (const Phase &phase : phases_) {
    if (known) PetscCall(warn_of_low_limit(phase, pressure));
    known = phase.control == Control::pressure;
    pressure = phase.to / units::kPa_per_cmH2O;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::warn_of_low_limit(const Phase &phase, PetscReal pressure)
{
  PetscFunctionBeginUser;
  if (!phase.limit) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal limit = *phase.limit / units::kPa_per_cmH2O;
  if (pressure <= limit + same_pressure || !low_limits_.insert(phase.where).second) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(options_.comm(),
                        "pulmo: warning: %s: phase '%s' begins at %.4g cmH2O, above its own limit of %.4g cmH2O: the "
                        "limit is held from its first step on, and gas flows out; raise 'limit', or lower the pressure "
                        "before the phase\n",
                        phase.where.c_str(), phase.name.c_str(), (double)pressure, (double)limit));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Simulation::failure_text() const
{
  return unsolved_.empty() ? pulmo::failure_text(scene_, failure_facts(), diagnosis_) : unsolved_;
}

} // namespace pulmo
