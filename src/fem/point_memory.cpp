#include "pulmo/fem/point_memory.hpp"

#include "pulmo/fem/archive.hpp"

namespace pulmo {

PetscErrorCode PointMemory::setup(const Model &model)
{
  PetscFunctionBeginUser;
  model_ = &model;
  width_ = model.composition().memory_width();
  PetscCall(sampling_.setup(model));
  points_ = static_cast<PetscInt>(model.assembly().relative_weights().size());
  const std::size_t n = sampling_.cells().size() * static_cast<std::size_t>(points_ * width_);
  last_.assign(n, 0);
  next_.assign(n, 0);
  PetscCall(evaluate(0, nullptr, nullptr, Step(Stage(1, 0, true)), true, last_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::size_t PointMemory::bytes() const
{
  return (last_.size() + earlier_.size() + middle_.size() + next_.size()) * sizeof(PetscScalar);
}

Memory PointMemory::at(PetscInt c, PetscInt q) const
{
  const auto first = static_cast<std::size_t>((c * points_ + q) * width_);
  const std::vector<PetscScalar> *other = past_ == Past::earlier  ? &earlier_
                                          : past_ == Past::middle ? &middle_
                                                                  : nullptr;
  return {last_.data() + first, other ? other->data() + first : nullptr};
}

PetscErrorCode PointMemory::evaluate(PetscReal t, const PetscScalar *x, const PetscScalar *rate, const Step &step,
                                     bool start, std::vector<PetscScalar> &values)
{
  PetscSection section;
  PetscInt size = 0;
  std::vector<PointSample> now, rates;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(model_->dm(), &section));
  if (start) PetscCall(PetscSectionGetStorageSize(section, &size));
  const std::vector<PetscScalar> zero(static_cast<std::size_t>(size), 0);
  for (const Sampling::Element &e : sampling_.cells()) {
    const PetscScalar *constants = model_->constants_at(e.cell);
    sampling_.sample(e, start ? zero.data() : x, now);
    if (!start) sampling_.sample(e, rate, rates);
    for (PetscInt q = 0; q < points_; ++q) {
      if (!start) Sampling::take_rates(rates[q], now[q]);
      const Point point = sampling_.point(now[q], e, t, step, start ? Memory() : at(e.cell, q));
      PetscScalar *value = &values[static_cast<std::size_t>((e.cell * points_ + q) * width_)];
      for (const MemorySpec &memory : model_->composition().memories())
        memory.value(point, constants, value + memory.offset);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::compute(PetscReal t, Vec x, Vec rate)
{
  PetscFunctionBeginUser;
  next_.resize(last_.size());
  const ReadArray values(x), rates(rate);
  PetscCall(evaluate(t, values.data(), rates.data(), model_->step(), false, next_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void PointMemory::settle()
{
  if (!pending_) return;
  pending_ = false;
  earlier_.swap(last_);
  last_.swap(next_);
}

PetscErrorCode PointMemory::persist(Archive &archive, bool looks_back)
{
  PetscFunctionBeginUser;
  if (!archive.reading()) settle();
  const auto width = static_cast<std::size_t>(points_ * width_);
  PetscCall(archive.cells("memory/last", width, last_));
  bool two = looks_back && !earlier_.empty();
  PetscCall(archive.value("memory/two", two));
  if (two) PetscCall(archive.cells("memory/earlier", width, earlier_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
