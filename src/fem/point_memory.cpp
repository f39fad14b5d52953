#include "pulmo/fem/point_memory.hpp"

#include "pulmo/fem/archive.hpp"
#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <limits>

namespace pulmo {

PetscErrorCode PointMemory::setup(const Model &model)
{
  PetscFunctionBeginUser;
  model_ = &model;
  PetscCall(sampling_.setup(model));
  for (const MemorySpec &spec : model.composition().memories())
    if (!room(spec.surface)) PetscCall(add_room(spec.surface));
  PetscCall(begin());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::begin()
{
  PetscFunctionBeginUser;
  for (Room &r : rooms_) PetscCall(evaluate_start(r, r.last_.data()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::evaluate_start(const Room &r, PetscScalar *values) const
{
  PetscSection section;
  PetscInt size;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(model_->dm(), &section));
  PetscCall(PetscSectionGetStorageSize(section, &size));
  const std::vector<PetscScalar> zero(static_cast<std::size_t>(size), 0);
  PetscCall(take_given(r, values));
  PetscCall(evaluate(0, zero.data(), nullptr, Step(Stage(1, 0, true)), true, r, values));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void PointMemory::copy(bool start, Values &values) const
{
  values.clear();
  for (const Room &r : rooms_) {
    const std::vector<PetscScalar> &of = start ? r.last_ : r.next_;
    values.insert(values.end(), of.begin(), of.end());
  }
}

void PointMemory::show(const Values &last, const Values &earlier)
{
  past_ = earlier.empty() ? Past::last : Past::earlier;
  for (Room &r : rooms_) {
    std::copy_n(last.data() + r.begin_, r.last_.size(), r.last_.data());
    if (!earlier.empty()) r.earlier_.assign(earlier.data() + r.begin_, earlier.data() + r.begin_ + r.last_.size());
  }
}

PetscErrorCode PointMemory::evaluate(PetscReal t, Vec x, Vec rate, bool start, Values &values) const
{
  PetscFunctionBeginUser;
  values.resize(size());
  if (start) {
    for (const Room &r : rooms_) PetscCall(evaluate_start(r, values.data() + r.begin_));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const ReadArray now(x), rates(rate);
  for (const Room &r : rooms_)
    PetscCall(evaluate(t, now.data(), rates.data(), model_->step(), false, r, values.data() + r.begin_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::add_room(const std::string &surface)
{
  const Mesh &mesh = model_->composition().mesh();
  Room r;

  PetscFunctionBeginUser;
  r.memory_ = this;
  r.surface_ = surface;
  r.width_ = model_->composition().memory_width(surface);
  for (const MemorySpec &spec : model_->composition().memories())
    if (spec.surface == surface) r.specs_.push_back(&spec);
  if (surface.empty()) {
    r.places_ = sampling_.cells();
    r.points_ = sampling_.points_of_cell();
  } else {
    PetscCall(sampling_.surface(mesh, surface, r.places_));
    PetscCall(mesh.facets(surface, r.facets_));
    r.points_ = sampling_.points_of_facet();
  }
  const std::size_t n = r.places_.size() * static_cast<std::size_t>(r.points_ * r.width_);
  r.last_.assign(n, 0);
  r.next_.assign(n, 0);
  r.begin_ = size();
  rooms_.push_back(std::move(r));
  PetscFunctionReturn(PETSC_SUCCESS);
}

const PointMemory::Room *PointMemory::room(const std::string &surface) const
{
  const auto found = std::find_if(rooms_.begin(), rooms_.end(), [&](const Room &r) { return r.surface_ == surface; });
  return found == rooms_.end() ? nullptr : &*found;
}

std::size_t PointMemory::bytes() const
{
  std::size_t sum = 0;
  for (const Room &r : rooms_)
    sum += (r.last_.size() + r.earlier_.size() + r.middle_.size() + r.next_.size()) * sizeof(PetscScalar);
  return sum;
}

std::size_t PointMemory::bytes(const MemorySpec &spec) const
{
  const Room &r = *room(spec.surface);
  return (r.last_.size() + r.earlier_.size() + r.middle_.size() + r.next_.size()) * sizeof(PetscScalar) /
         static_cast<std::size_t>(r.width_) * spec.quantities.size();
}

Memory PointMemory::Room::at(PetscInt i, PetscInt q) const
{
  const auto first = static_cast<std::size_t>((i * points_ + q) * width_);
  const std::vector<PetscScalar> *other = memory_->past_ == Past::earlier  ? &earlier_
                                          : memory_->past_ == Past::middle ? &middle_
                                                                           : nullptr;
  return {last_.data() + first, other ? other->data() + first : nullptr};
}

Memory PointMemory::Room::accepted(PetscInt i, PetscInt q) const
{
  const std::vector<PetscScalar> &state = memory_->pending_ ? next_ : last_;
  return {state.data() + static_cast<std::size_t>((i * points_ + q) * width_), nullptr};
}

/// Fills what is given at the start.
PetscErrorCode PointMemory::take_given(const Room &r, PetscScalar *values) const
{
  PetscFunctionBeginUser;
  for (const MemorySpec *spec : r.specs_) {
    if (!given(*spec)) continue;
    const std::size_t n = spec->quantities.size(), points = r.places_.size() * static_cast<std::size_t>(r.points_);
    PetscCheck(spec->start->size() == n * points, PETSC_COMM_SELF, PETSC_ERR_ARG_SIZ, "%s is given at other points",
               spec->effect.c_str());
    for (std::size_t i = 0; i < points; ++i)
      std::copy_n(spec->start->data() + i * n, n,
                  values + i * static_cast<std::size_t>(r.width_) + static_cast<std::size_t>(spec->offset));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::evaluate(PetscReal t, const PetscScalar *x, const PetscScalar *rate, const Step &step,
                                     bool start, const Room &r, PetscScalar *value) const
{
  std::vector<PointSample> now, rates;

  PetscFunctionBeginUser;
  for (std::size_t i = 0; i < r.places_.size(); ++i) {
    const Sampling::Element &e = r.places_[i];
    const PetscScalar *constants = model_->constants_at(e.cell, r.surface_);
    sampling_.sample(e, x, now);
    if (!start) sampling_.sample(e, rate, rates);
    for (PetscInt q = 0; q < r.points_; ++q, value += r.width_) {
      if (!start) Sampling::take_rates(rates[q], now[q]);
      const Memory before = start ? Memory{value, nullptr} : r.at(static_cast<PetscInt>(i), q);
      Point point = sampling_.point(now[q], e, t, step, before);
      point.start = start;
      for (const MemorySpec *spec : r.specs_)
        if (!start || !given(*spec)) spec->value(point, constants, value + spec->offset);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode PointMemory::compute(PetscReal t, Vec x, Vec rate)
{
  PetscFunctionBeginUser;
  const ReadArray values(x), rates(rate);
  for (Room &r : rooms_) {
    r.next_.resize(r.last_.size());
    PetscCall(evaluate(t, values.data(), rates.data(), model_->step(), false, r, r.next_.data()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void PointMemory::keep_middle()
{
  for (Room &r : rooms_) r.middle_.swap(r.next_);
}

void PointMemory::settle()
{
  if (!pending_) return;
  pending_ = false;
  two_ = true;
  for (Room &r : rooms_) {
    r.earlier_.swap(r.last_);
    r.last_.swap(r.next_);
  }
}

PetscErrorCode PointMemory::persist(Archive &archive, bool looks_back)
{
  PetscFunctionBeginUser;
  if (!archive.reading()) settle();
  two_ = two_ && looks_back;
  PetscCall(archive.value("memory/two", two_));
  for (Room &r : rooms_) {
    const auto width = static_cast<std::size_t>(r.points_ * r.width_);
    const std::string name = r.surface_.empty() ? "memory" : "memory/of_" + r.surface_;
    const auto visit = [&](const std::string &which, std::vector<PetscScalar> &values) {
      return r.surface_.empty() ? archive.cells(name + which, width, values)
                                : archive.facets(name + which, r.surface_, r.facets_, width, values);
    };
    PetscCall(visit("/last", r.last_));
    if (two_) PetscCall(visit("/earlier", r.earlier_));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void PointMemory::means(const MemorySpec &spec, std::size_t index, std::vector<PetscScalar> &values) const
{
  const Room &r = *room(spec.surface);
  const std::vector<PetscScalar> &state = pending_ ? r.next_ : r.last_;
  std::vector<PetscReal> measure(static_cast<std::size_t>(model_->assembly().cells()), 0);

  values.assign(measure.size(), 0);
  std::size_t at = static_cast<std::size_t>(spec.offset) + index;
  for (const Sampling::Element &e : r.places_) {
    const std::vector<PetscReal> &weights = sampling_.weights(e);
    measure[e.cell] += e.measure;
    for (PetscInt q = 0; q < r.points_; ++q, at += static_cast<std::size_t>(r.width_))
      values[e.cell] += weights[q] * e.measure * state[at];
  }
  for (std::size_t c = 0; c < values.size(); ++c)
    values[c] = measure[c] > 0 ? values[c] / measure[c] : std::numeric_limits<PetscScalar>::quiet_NaN();
}

PetscErrorCode PointMemory::integrals(std::vector<double> &values) const
{
  const Composition &composition = model_->composition();
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_->dm());
  std::vector<PetscScalar> of_cells;
  std::vector<double> largest;

  PetscFunctionBeginUser;
  values.clear();
  for (const RememberedIntegral &integral : composition.integrals()) {
    const bool cells = integral.over == Over::cells;
    bool known = false;
    double sum = 0, most = -std::numeric_limits<double>::max();
    for (const MemorySpec &spec : composition.memories()) {
      if (spec.effect != integral.effect || spec.surface.empty() != cells) continue;
      known = true;
      if (cells) {
        means(spec, integral.quantity, of_cells);
        for (const Sampling::Element &e : sampling_.cells()) sum += e.measure * of_cells[e.cell];
      } else {
        const Room &r = *room(spec.surface);
        const std::vector<PetscScalar> &state = pending_ ? r.next_ : r.last_;
        std::size_t at = static_cast<std::size_t>(spec.offset) + integral.quantity;
        for (const Sampling::Element &e : r.places_)
          for (const PetscReal weight : sampling_.weights(e)) {
            sum += weight * e.measure * state[at];
            most = std::max(most, state[at]);
            at += static_cast<std::size_t>(r.width_);
          }
      }
    }
    PetscCheck(known, PETSC_COMM_SELF, PETSC_ERR_ARG_WRONG, "%s integrates what it does not remember",
               integral.effect.c_str());
    values.push_back(integral.factor * sum);
    largest.push_back(integral.factor * most);
  }
  const auto n = static_cast<PetscMPIInt>(values.size());
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, values.data(), n, MPI_DOUBLE, MPI_SUM, comm));
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, largest.data(), n, MPI_DOUBLE, MPI_MAX, comm));
  for (std::size_t i = 0; i < values.size(); ++i)
    if (composition.integrals()[i].over == Over::largest_of_facets) values[i] = largest[i];
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
