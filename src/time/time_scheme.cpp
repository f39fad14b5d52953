#include "pulmo/time/time_scheme.hpp"

#include <petsc/private/tsimpl.h>

namespace pulmo {

PetscErrorCode TimeScheme::setup(TS ts, Vec like)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)ts);
  PetscBool euler, bdf;
  PetscInt order = 2, fields;
  DM dm;

  PetscFunctionBeginUser;
  ts_ = ts;
  PetscCall(PetscObjectTypeCompare((PetscObject)ts, TSBEULER, &euler));
  PetscCall(PetscObjectTypeCompare((PetscObject)ts, TSBDF, &bdf));
  PulmoUserCheck(euler || bdf, comm,
                 "-ts_type: gas is conserved by backward Euler and BDF2 only; use -ts_type beuler "
                 "or -ts_type bdf");
  if (bdf) PetscCall(TSBDFGetOrder(ts, &order));
  PulmoUserCheck(order == 2, comm, "-ts_bdf_order %d: of the BDF methods only order 2 is there; leave the option out",
                 (int)order);
  multistep_ = bdf;
  PetscCall(TSGetDM(ts, &dm));
  PetscCall(DMGetNumFields(dm, &fields));
  gas_ = multistep_ && fields > pressure;
  if (!multistep_) PetscFunctionReturn(PETSC_SUCCESS);
  for (Past *past : {&last_, &earlier_, &middle_}) PetscCall(VecDuplicate(like, past->state.out()));
  if (!gas_) PetscFunctionReturn(PETSC_SUCCESS);
  for (VecHandle *v : {&last_.gas, &earlier_.gas, &middle_.gas, &zero_, &rest_})
    PetscCall(VecDuplicate(like, v->out()));
  PetscCall(VecZeroEntries(zero_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::keep(Model &model, const Moment &now, Past &past)
{
  PetscSection section;
  PetscInt begin, end;

  PetscFunctionBeginUser;
  past.time = now.time;
  past.volume = now.volume;
  past.scalars = now.scalars;
  if (multistep_) PetscCall(VecCopy(now.local, past.state));
  if (!gas_) PetscFunctionReturn(PETSC_SUCCESS);
  // with a slope of 1/s the kernels integrate J - 1, and what does not depend on it
  PetscCall(model.set_step({1, 0, true}, 0));
  PetscCall(model.residual(now.time, now.local, zero_, rest_));
  PetscCall(model.set_step({1, 1, true}, 0));
  PetscCall(model.residual(now.time, now.local, zero_, past.gas));
  PetscCall(VecAXPY(past.gas, -1, rest_));
  PetscCall(VecScale(past.gas, 1 / model.row_scale(pressure)));
  PetscCall(DMGetLocalSection(model.dm(), &section));
  WriteArray g(past.gas);
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt dofs, offset;
    PetscCall(PetscSectionGetFieldDof(section, p, displacement, &dofs));
    PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
    for (PetscInt d = 0; d < dofs; ++d) g[offset + d] = 0;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::begin(Model &model, const Moment &start)
{
  PetscFunctionBeginUser;
  PetscCall(keep(model, start, last_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool TimeScheme::looks_back() const
{
  return multistep_ && !ts_->steprestart;
}

PetscErrorCode TimeScheme::persist(Archive &archive, Model &model, const Moment &last, bool looks_back)
{
  int there = order();
  Moment earlier{earlier_.time, earlier_.volume, nullptr, earlier_.scalars};

  PetscFunctionBeginUser;
  PetscCall(archive.value("time_scheme/order", there));
  PulmoUserCheck(there == order(), PetscObjectComm((PetscObject)ts_),
                 "-restart: the checkpoint was made with -ts_type %s; give that", there == 2 ? "bdf" : "beuler");
  PetscCall(archive.value("time_scheme/looks_back", looks_back));
  if (looks_back) {
    VecHandle state;
    PetscCall(archive.value("time_scheme/time_s", earlier.time));
    PetscCall(archive.value("time_scheme/volume_mm3", earlier.volume));
    if (model.composition().n_scalars() > 0)
      PetscCall(archive.table("time_scheme/scalars_kPa", earlier.scalars, 0.0,
                              [](PetscReal &row, TableCells &cells) { cells(row); }));
    PetscCall(VecDuplicate(last.local, state.out()));
    if (!archive.reading()) PetscCall(VecCopy(earlier_.state, state));
    PetscCall(archive.local("time_scheme/state", state));
    resumes_ = archive.reading();
    earlier.local = state;
    if (resumes_) PetscCall(keep(model, earlier, earlier_));
  }
  if (archive.reading()) PetscCall(keep(model, last, last_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::begin_solve(PetscInt steps)
{
  PetscFunctionBeginUser;
  if (resumes_) {
    // TS takes a first step for a fresh start. Its own past is empty then, which nothing but its guess notices.
    PetscCall(TSSetStepNumber(ts_, steps));
    ts_->steprestart = PETSC_FALSE;
    resumes_ = false;
  } else {
    PetscCall(TSRestartStep(ts_));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::begin_stage(PetscReal t, PetscReal dt)
{
  const PetscReal from = last_.time;

  PetscFunctionBeginUser;
  half_ = multistep_ && ts_->steprestart && t - from < 0.75 * dt;
  used_ = {&last_, nullptr};
  if (!multistep_ || half_) {
    dt_ = multistep_ ? t - from : dt;
    slope_ = 1 / dt_;
    weight_ = {-slope_, 0};
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  used_[1] = ts_->steprestart ? &middle_ : &earlier_;
  const PetscReal a = t - from, b = t - used_[1]->time;
  dt_ = a;
  slope_ = 1 / a + 1 / b;
  weight_ = {-b / (a * (b - a)), a / (b * (b - a))};
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::accept_stage(Model &model, const Moment &now)
{
  PetscFunctionBeginUser;
  if (half_) PetscCall(keep(model, now, middle_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::accept(Model &model, const Moment &now)
{
  PetscFunctionBeginUser;
  std::swap(last_, earlier_);
  PetscCall(keep(model, now, last_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode TimeScheme::rate(Vec now, Vec rate) const
{
  PetscFunctionBeginUser;
  PetscCall(VecAXPBY(rate, slope_, 0, now));
  for (std::size_t i = 0; i < used_.size(); ++i)
    if (used_[i]) PetscCall(VecAXPY(rate, weight_[i], used_[i]->state));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscReal TimeScheme::past_flow() const
{
  PetscReal sum = 0;
  for (std::size_t i = 0; i < used_.size(); ++i)
    if (used_[i]) sum += weight_[i] * used_[i]->volume;
  return sum;
}

std::vector<PetscReal> TimeScheme::past_rates() const
{
  std::vector<PetscReal> sum(last_.scalars.size(), 0);
  for (std::size_t i = 0; i < used_.size(); ++i)
    for (std::size_t k = 0; used_[i] && k < sum.size(); ++k) sum[k] += weight_[i] * used_[i]->scalars[k];
  return sum;
}

PetscErrorCode TimeScheme::add_past(const Model &model, Vec residual) const
{
  PetscFunctionBeginUser;
  if (!gas_) PetscFunctionReturn(PETSC_SUCCESS);
  for (std::size_t i = 0; i < used_.size(); ++i)
    if (used_[i]) PetscCall(VecAXPY(residual, weight_[i] * model.row_scale(pressure), used_[i]->gas));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
