// What a simulation remembers (Simulation::persist).
#include "pulmo/time/simulation.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <sstream>

namespace pulmo {

namespace {

/// The phases of rows that follow one another, as a word of a list and its number.
class PhaseNames {
public:
  std::size_t number(const std::string &name)
  {
    if (names_.empty() || names_[last_] != name) {
      const auto found = std::find(names_.begin(), names_.end(), name);
      last_ = static_cast<std::size_t>(found - names_.begin());
      if (found == names_.end()) names_.push_back(name);
    }
    return last_;
  }
  const std::string *name(std::size_t number) const { return number < names_.size() ? &names_[number] : nullptr; }

  std::string text() const
  {
    std::string lines;
    for (const std::string &name : names_) lines += name + "\n";
    return lines;
  }
  void read(const std::string &lines)
  {
    std::istringstream stream(lines);
    for (std::string line; std::getline(stream, line);) names_.push_back(line);
  }

private:
  std::vector<std::string> names_;
  std::size_t last_ = 0;
};

/// The past of a partner, under its name in an archive.
class ArchivedPast final : public Past {
public:
  ArchivedPast(Archive &archive, const char *name) : archive_(archive), path_(std::string(name) + "/") {}
  PetscErrorCode visit(const std::string &name, PetscReal &value) override
  {
    return archive_.value(path_ + name, value);
  }
  PetscErrorCode visit(const std::string &name, bool &value) override { return archive_.value(path_ + name, value); }
  PetscErrorCode visit(const std::string &name, std::vector<PetscReal> &values) override
  {
    return archive_.table(path_ + name, values, PetscReal(0), [](PetscReal &row, TableCells &cells) { cells(row); });
  }

private:
  Archive &archive_;
  std::string path_;
};

} // namespace

PetscErrorCode Simulation::past_of_partners(Archive &archive)
{
  PetscFunctionBeginUser;
  for (Partner *partner : partners_) {
    ArchivedPast past(archive, partner->name());
    PetscCall(partner->past(past));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::persist_rows(Archive &archive)
{
  PhaseNames phases;
  bool known = true;

  PetscFunctionBeginUser;
  for (const SignalRow &row : rows_) (void)phases.number(row.phase);
  std::string names = phases.text();
  PetscCall(archive.text("signal_phases", names));
  if (archive.reading()) phases.read(names);
  SignalRow empty;
  empty.scalars.assign(model_.composition().n_scalars(), 0);
  empty.scalar_flows = empty.scalars;
  empty.integrals.assign(model_.composition().integrals().size(), 0);
  PetscCall(archive.table("signals", rows_, empty, [&](SignalRow &row, TableCells &cells) {
    std::size_t phase = archive.reading() ? 0 : phases.number(row.phase);
    cells(row.time, row.pressure, row.flow, row.volume, phase, row.breath, row.dt, row.newton, row.krylov, row.min_J,
          row.max_J, row.hold, row.ventilator_pressure);
    if (scene_.facts().flow_past_limit_points) cells(row.past_limit);
    for (double &pressure : row.scalars) cells(pressure);
    for (double &flow : row.scalar_flows) cells(flow);
    if (!row.scalars.empty()) cells(row.stored_flow);
    for (double &integral : row.integrals) cells(integral);
    const std::string *name = phases.name(phase);
    known = known && name;
    if (archive.reading() && name) row.phase = *name;
  }));
  PetscCall(archive.check(known && !rows_.empty(), "signals"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::persist_begin(Archive &archive, AttemptBegin &begin)
{
  std::string reasons;

  PetscFunctionBeginUser;
  PetscCall(archive.value("attempt/dt_s", begin.dt));
  PetscCall(archive.value("attempt/dt_wanted_s", begin.wanted_dt));
  PetscCall(archive.value("attempt/dt_asked_s", begin.asked_dt));
  PetscCall(archive.value("attempt/cut", begin.cut));
  PetscCall(archive.value("attempt/always_new", begin.always_new));
  PetscCall(archive.value("attempt/looks_back", begin.looks_back));
  PetscCall(archive.value("attempt/limited", begin.limited));
  if (scene_.facts().flow_past_limit_points) PetscCall(archive.value("attempt/past_limit_point", begin.past_limit));
  PetscCall(archive.value("attempt/crawled", begin.crawled));
  PetscCall(archive.table("attempt_failures", begin.failures, FailedAttempt(), [](FailedAttempt &f, TableCells &cells) {
    Measures &m = f.measures;
    cells(f.time, f.dt, f.newton, f.inverted, m.min_J, m.min_air, m.airless_J, m.where[0], m.where[1], m.where[2],
          m.cell, m.rank);
  }));
  for (const FailedAttempt &f : begin.failures) reasons += f.reason + "\n";
  PetscCall(archive.text("attempt_reasons", reasons));
  std::istringstream lines(reasons);
  for (FailedAttempt &f : begin.failures) std::getline(lines, f.reason);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::persist_attempt(Archive &archive, AttemptBegin begin)
{
  SNES snes;

  PetscFunctionBeginUser;
  PetscCall(persist_begin(archive, begin));
  if (!archive.reading()) written_ = &begin;
  PetscCall(persist(archive));
  written_ = nullptr;
  if (!archive.reading()) PetscFunctionReturn(PETSC_SUCCESS);
  if (begin.asked_dt == wanted_dt_) { // else as persist() has it
    dt_ = begin.wanted_dt;
    next_dt_ = begin.dt;
  }
  cut_ = begin.cut;
  crawled_ = begin.crawled;
  failures_ = begin.failures;
  airway_.retake(begin.limited);
  if (scene_.facts().flow_past_limit_points) airway_.past_limit(begin.past_limit);
  PetscCall(TSGetSNES(ts_, &snes));
  if (begin.always_new && lagging_.in_use()) PetscCall(lagging_.stop_lagging(snes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::persist(Archive &archive)
{
  PetscInt index = phase_ ? static_cast<PetscInt>(phase_ - phases_.data()) : 0;
  PetscReal wanted_dt = wanted_dt_, phase_end = phase_ ? phase_->end : 0;

  PetscFunctionBeginUser;
  PetscCall(persist_rows(archive));
  if (plan_.may_end_early())
    PetscCall(archive.table("phases_ended", ended_, EndedPhase(),
                            [](EndedPhase &row, TableCells &cells) { cells(row.index, row.time); }));
  if (archive.reading()) {
    for (const EndedPhase &ended : ended_)
      PetscCall(archive.check(ended.index >= 0 && ended.index < static_cast<PetscInt>(plan_.phases().size()),
                              "phases_ended"));
    lay_out_phases();
  }
  PetscCall(archive.value("phase", index));
  PetscCall(archive.value("phase_end_s", phase_end));
  PetscCall(archive.value("dt_asked_s", wanted_dt));
  PetscCall(archive.value("dt_s", dt_));
  PetscCall(archive.value("dt_next_s", next_dt_));
  PetscCall(archive.value("rejected_steps", rejected_));
  PetscCall(archive.value("delivered_mm3", delivered_));
  PetscCall(archive.value("mass_balance_error_mm3", worst_balance_));
  PetscCall(archive.value("support_reaction_kPa_mm2", worst_reaction_));
  if (model_.composition().pinned()) PetscCall(pins_.persist(archive));
  PetscCall(archive.value("min_J", min_J_));
  PetscCall(balance_.persist(archive));
  if (archive.reading()) PetscCall(resume(archive, index, wanted_dt, phase_end));
  PetscCall(past_of_partners(archive));
  PetscCall(archive.local("state", before_));
  if (archive.reading()) {
    PetscCall(VecZeroEntries(state_));
    PetscCall(DMLocalToGlobal(model_.dm(), before_, INSERT_VALUES, state_));
    PetscCall(airway_.restore(state_));
    PetscCall(check_state());
  }
  PetscCall(scheme_.persist(archive, model_, moment(accepted_.time, accepted_.volume * units::mm3_per_ml, before_),
                            written_ ? written_->looks_back : scheme_.looks_back()));
  if (model_.memory()) PetscCall(model_.memory()->persist(archive, scheme_.multistep()));
  PetscCall(step_control_.persist(archive));
  PetscCall(predictor_.persist(archive, state_));
  for (Observer *observer : observers_) PetscCall(observer->persist(archive, before_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Refuses a state that does not have the volume and the pressure of the last row: whatever took it there, it is not
/// the state of these signals.
PetscErrorCode Simulation::check_state()
{
  constexpr PetscReal same = 1e-9; // of the lung's volume, of the tissue's modulus: beyond rounding on any ranks
  const auto &constraints = model_.composition().constraints();
  Measures measures;
  PetscReal pressure = accepted_.pressure * units::kPa_per_cmH2O;

  PetscFunctionBeginUser;
  PetscCall(model_.measure(before_, measures));
  // another pressure may be prescribed at the rim of the airway, and is not the airway's
  const bool other = std::any_of(constraints.begin(), constraints.end(),
                                 [](const Constraint &c) { return c.field == pulmo::pressure && !c.at_airway; });
  if (airway_.scalars().of_effects())
    pressure = airway_.scalars().opening();
  else if (scene_.facts().airflow && scene_.facts().ventilator && !other)
    PetscCall(model_.airway().mean_pressure(before_, pressure));
  const PetscReal volume = measures.volume_change / units::mm3_per_ml, P = pressure / units::kPa_per_cmH2O,
                  lung = scene_.mesh().volume() / units::mm3_per_ml, modulus = model_.modulus() / units::kPa_per_cmH2O;
  PulmoUserCheck(std::abs(volume - accepted_.volume) <= same * (lung + std::abs(accepted_.volume)), options_.comm(),
                 "-restart: the checkpoint's state does not belong to its signals: its volume is %.9g ml above rest, "
                 "that of the last row %.9g ml; the file was changed: take another checkpoint, or run from the start",
                 (double)volume, accepted_.volume);
  PulmoUserCheck(std::abs(P - accepted_.pressure) <= same * (modulus + std::abs(accepted_.pressure)), options_.comm(),
                 "-restart: the checkpoint's state does not belong to its signals: its airway pressure is %.9g cmH2O, "
                 "that of the last row %.9g cmH2O; the file was changed: take another checkpoint, or run from the "
                 "start",
                 (double)P, accepted_.pressure);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::resume(const Archive &archive, PetscInt index, PetscReal wanted_dt, PetscReal phase_end)
{
  PetscFunctionBeginUser;
  accepted_ = rows_.back();
  PulmoUserCheck(accepted_.time < end_ && !same(accepted_.time, end_), options_.comm(),
                 "-restart: the checkpoint is at %.6g s, and the run ends at %.6g s: nothing is left to run; give a "
                 "later -ts_max_time, or more breaths or phases",
                 accepted_.time, (double)end_);
  PetscCall(archive.check(index >= 0 && index < static_cast<PetscInt>(phases_.size()), "phase"));
  phase_ = &phases_[static_cast<std::size_t>(index)];
  airway_.begin_phase(*phase_, 0, 0);
  const bool new_dt = (!phase_->dt && wanted_dt != wanted_dt_) || (!step_control_.in_use() && dt_ > asked_dt());
  if (new_dt) dt_ = asked_dt();
  if (new_dt || phase_end != phase_->end) next_dt_ = goes_on_with(*phase_, phase_->end, dt_, accepted_.time);
  resumed_ = true;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
