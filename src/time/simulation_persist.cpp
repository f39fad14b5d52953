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

} // namespace

PetscErrorCode Simulation::persist_rows(Archive &archive)
{
  PhaseNames phases;
  bool known = true;

  PetscFunctionBeginUser;
  for (const SignalRow &row : rows_) (void)phases.number(row.phase);
  std::string names = phases.text();
  PetscCall(archive.text("signal_phases", names));
  if (archive.reading()) phases.read(names);
  PetscCall(archive.table("signals", rows_, SignalRow(), [&](SignalRow &row, Cells &cells) {
    std::size_t phase = archive.reading() ? 0 : phases.number(row.phase);
    cells(row.time, row.pressure, row.flow, row.volume, phase, row.breath, row.dt, row.newton, row.krylov, row.min_J,
          row.max_J, row.hold, row.ventilator_pressure);
    const std::string *name = phases.name(phase);
    known = known && name;
    if (archive.reading() && name) row.phase = *name;
  }));
  PetscCall(archive.check(known && !rows_.empty(), "signals"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Simulation::persist(Archive &archive)
{
  PetscInt index = phase_ ? static_cast<PetscInt>(phase_ - phases_.data()) : 0;
  PetscReal wanted_dt = wanted_dt_, phase_end = phase_ ? phase_->end : 0;

  PetscFunctionBeginUser;
  PetscCall(persist_rows(archive));
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
  PetscCall(airway_.persist(archive));
  PetscCall(archive.local("state", before_));
  if (archive.reading()) {
    PetscCall(VecZeroEntries(state_));
    PetscCall(DMLocalToGlobal(model_.dm(), before_, INSERT_VALUES, state_));
    PetscCall(airway_.restore(state_));
  }
  PetscCall(scheme_.persist(archive, model_, accepted_.time, accepted_.volume * units::mm3_per_ml, before_));
  if (model_.memory()) PetscCall(model_.memory()->persist(archive, scheme_.multistep()));
  PetscCall(step_control_.persist(archive));
  PetscCall(predictor_.persist(archive, state_));
  for (Observer *observer : observers_) PetscCall(observer->persist(archive, before_));
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
  if (new_dt || phase_end != phase_->end) next_dt_ = landing(accepted_.time);
  resumed_ = true;
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
