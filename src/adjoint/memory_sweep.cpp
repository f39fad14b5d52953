#include "pulmo/adjoint/memory_sweep.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Kernels are moved by these shares of the state and of what is remembered: truncation and rounding of a central
/// difference are alike then. All is nearly linear in what is remembered.
constexpr PetscReal share = 2e-6, share_of_past = 2e-4;

/// Shares of a value below this are rounding.
constexpr PetscReal rounding = 1e-13;

/// What a sample holds, by the places of a SampleDerivative: of the state, then of the rates.
constexpr std::size_t entries = 16, all_entries = 2 * entries;
constexpr std::size_t groups[][2] = {{0, 9}, {9, 12}, {12, 13}, {13, 16}, {16, 25}, {25, 28}, {28, 29}, {29, 32}};

PetscScalar &entry(PointSample &s, std::size_t i)
{
  if (i < 9) return s.state.H[i];
  if (i < 12) return s.u[i - 9];
  if (i < 13) return s.p;
  if (i < 16) return s.grad_p[i - 13];
  if (i < 25) return s.state.H_rate[i - 16];
  if (i < 28) return s.u_t[i - 25];
  if (i < 29) return s.p_t;
  return s.grad_p_t[i - 29];
}

/// @p s with the entries from @p begin to @p end moved, each by @p by times its own change.
PointSample moved(const PointSample &s, std::size_t begin, std::size_t end, PetscReal by, const PetscReal change[])
{
  PointSample other = s;
  for (std::size_t i = begin; i < end; ++i) entry(other, i) += by * change[i];
  if (begin >= 9) return other;
  const PointState state = other.state;
  make_point_state(state.H, state.H_rate, other.state);
  return other;
}

/// Whether what is here, at more and at less lies on one line, nearly; else there is a kink.
bool on_a_line(const std::vector<PetscScalar> &more, const PetscScalar *here, const std::vector<PetscScalar> &less,
               std::size_t n)
{
  constexpr PetscReal bend = 1e-4;
  for (std::size_t j = 0; j < n; ++j)
    if (std::abs(more[j] - 2 * here[j] + less[j]) > bend * std::abs(more[j] - less[j]) + rounding * std::abs(here[j]))
      return false;
  return true;
}

/// Lets @p evaluate fill @p more and @p less at so many times its own change, by less where a kink is near the @p n
/// values of @p here. Returns how many times.
template <class Evaluate>
PetscReal move_both_ways(const PetscScalar *here, std::size_t n, std::vector<PetscScalar> &more,
                         std::vector<PetscScalar> &less, Evaluate &&evaluate)
{
  constexpr PetscReal closer = 0.03, closest = 1e-4;
  for (PetscReal times = 1;; times *= closer) {
    evaluate(times, more);
    evaluate(-times, less);
    if (times * closer < closest || on_a_line(more, here, less, n)) return times;
  }
}

/// Whether anything there is read by kernels.
bool acts(const PointMemory::Room &room)
{
  return std::any_of(room.specs().begin(), room.specs().end(), [](const MemorySpec *s) { return !s->told; });
}

} // namespace

MemorySweep::MemorySweep(const Model &model)
    : model_(model), memory_(*model.memory()), gas_(model.composition().fields().size() > pressure)
{}

std::string MemorySweep::obstacle(const Composition &composition)
{
  for (const MemorySpec &spec : composition.memories())
    if (spec.start) return "cannot follow what -" + spec.effect + " solves for before the run: run without that";
  return "";
}

/// A cell or facet in the stage at hand.
struct MemorySweep::Place {
  const MemorySweep &sweep;
  const PointMemory::Room &room;
  PetscInt number; ///< in the room
  const Sampling::Element &element;
  const PetscScalar *constants;
  PetscReal t;
  std::size_t points, width, first; ///< first: in Values
  std::vector<PointSample> now;     ///< [point]

  Memory memory(std::size_t q) const { return room.at(number, static_cast<PetscInt>(q)); }
  Point point(const PointSample &sample, const Step &step, const Memory &memory) const
  {
    return sweep.memory_.sampling().point(sample, element, t, step, memory);
  }
  /// Where what @p spec declares begins at point @p q.
  std::size_t at(const MemorySpec &spec, std::size_t q) const
  {
    return first + q * width + static_cast<std::size_t>(spec.offset);
  }
};

/// Calls @p visit for all places where something is remembered that acts.
template <class Visit>
void MemorySweep::for_places(PetscReal t, Vec x, Vec rate, Visit &&visit) const
{
  const Sampling &sampling = memory_.sampling();
  const ReadArray xs(x), x_ts(rate);
  std::vector<PointSample> rates;
  for (const PointMemory::Room &room : memory_.rooms()) {
    const auto points = static_cast<std::size_t>(room.points()), width = static_cast<std::size_t>(room.width());
    if (!acts(room)) continue;
    for (std::size_t i = 0; i < room.places().size(); ++i) {
      const Sampling::Element &e = room.places()[i];
      Place place{*this,  room,  static_cast<PetscInt>(i),          e, model_.constants_at(e.cell, room.surface()), t,
                  points, width, room.begin() + i * points * width, {}};
      sampling.sample(e, xs.data(), place.now);
      sampling.sample(e, x_ts.data(), rates);
      for (std::size_t q = 0; q < points; ++q) Sampling::take_rates(rates[q], place.now[q]);
      visit(place);
    }
  }
}

/// What follows from a place for each number.
struct MemorySweep::StateSums {
  using AtPoints = std::vector<std::vector<SampleDerivative>>;
  AtPoints state, rate;               ///< [number][point]; of the place at hand
  std::vector<PetscReal> by_pressure; ///< [number]; of all places

  explicit StateSums(std::size_t numbers) : state(numbers), rate(numbers), by_pressure(numbers, 0) {}
  void clear(std::size_t points)
  {
    for (AtPoints *list : {&state, &rate})
      for (auto &derivatives : *list) derivatives.assign(points, SampleDerivative{});
  }
};

void MemorySweep::state_by_formula(const Place &place, const MemorySpec &spec, const std::vector<OfState> &numbers,
                                   StateSums &sums) const
{
  for (std::size_t k = 0; k < numbers.size(); ++k)
    for (std::size_t q = 0; q < place.points && numbers[k].weights; ++q) {
      SampleDerivative &d = sums.state[k][q];
      spec.by_state(place.point(place.now[q], model_.step(), place.memory(q)), place.constants,
                    numbers[k].weights->data() + place.at(spec, q), d.data(),
                    gas_ ? d[SampleDerivative::p] : sums.by_pressure[k]);
    }
}

void MemorySweep::state_by_differences(const Place &place, const MemorySpec &spec, const std::vector<OfState> &numbers,
                                       StateSums &sums) const
{
  using D = SampleDerivative;
  const std::size_t n = spec.quantities.size();
  const Step &step = model_.step();
  const PetscReal L = model_.composition().mesh().length(), stiff = model_.modulus();
  PetscReal change[all_entries];
  std::vector<PetscScalar> here(place.points * n), more(n), less(n);

  for (std::size_t i = 0; i < entries; ++i) {
    change[i] = share * (i < D::u ? 1 : i < D::p ? L : i < D::grad_p ? stiff : stiff / L);
    change[entries + i] = step.slope * change[i];
  }
  const auto evaluate = [&](std::size_t q, const PointSample &s, const Step &with, PetscScalar *values) {
    spec.value(place.point(s, with, place.memory(q)), place.constants, values);
  };
  // of more and less, times the weights of a number
  const auto difference = [&](std::size_t k, std::size_t q) {
    PetscScalar sum = 0;
    for (std::size_t j = 0; numbers[k].weights && j < n; ++j)
      sum += (*numbers[k].weights)[place.at(spec, q) + j] * (more[j] - less[j]);
    return sum;
  };
  for (std::size_t q = 0; q < place.points; ++q) evaluate(q, place.now[q], step, &here[q * n]);
  const auto follows = [&](std::size_t begin, std::size_t end) {
    for (std::size_t q = 0; q < place.points; ++q) {
      evaluate(q, moved(place.now[q], begin, end, 1, change), step, more.data());
      if (!std::equal(more.begin(), more.end(), &here[q * n])) return true;
    }
    return false;
  };
  const bool by_others = follows(D::u, all_entries);
  for (const auto &[begin, end] : groups) {
    if (begin > 0 && !by_others) break;
    if (!follows(begin, end)) continue;
    for (std::size_t j = begin; j < end; ++j)
      for (std::size_t q = 0; q < place.points; ++q) {
        const PetscReal times =
            move_both_ways(&here[q * n], n, more, less, [&](PetscReal by, std::vector<PetscScalar> &values) {
              evaluate(q, moved(place.now[q], j, j + 1, by, change), step, values.data());
            });
        for (std::size_t k = 0; k < numbers.size(); ++k)
          (j < entries ? sums.state : sums.rate)[k][q][j % entries] += difference(k, q) / (2 * times * change[j]);
      }
  }
  for (std::size_t q = 0; q < place.points && !gas_; ++q) {
    const PetscReal times =
        move_both_ways(&here[q * n], n, more, less, [&](PetscReal by, std::vector<PetscScalar> &values) {
          Step with = step;
          with.gas_pressure += by * share * stiff;
          evaluate(q, place.now[q], with, values.data());
        });
    for (std::size_t k = 0; k < numbers.size(); ++k)
      sums.by_pressure[k] += difference(k, q) / (2 * times * share * stiff);
  }
}

PetscErrorCode MemorySweep::by_state(PetscReal t, Vec x, Vec rate, std::vector<OfState> &numbers) const
{
  const PetscReal slope = model_.step().slope;
  std::vector<std::unique_ptr<WriteArray>> states, rates;
  StateSums sums(numbers.size());

  PetscFunctionBeginUser;
  for (const OfState &number : numbers) {
    states.push_back(number.weights ? std::make_unique<WriteArray>(number.by_state) : nullptr);
    rates.push_back(number.weights ? std::make_unique<WriteArray>(number.by_rate) : nullptr);
  }
  for_places(t, x, rate, [&](const Place &place) {
    sums.clear(place.points);
    for (const MemorySpec *spec : place.room.specs()) {
      if (spec->told) continue;
      if (spec->by_state)
        state_by_formula(place, *spec, numbers, sums);
      else
        state_by_differences(place, *spec, numbers, sums);
    }
    for (std::size_t k = 0; k < numbers.size(); ++k) {
      if (!numbers[k].weights) continue;
      for (std::size_t q = 0; q < place.points; ++q)
        for (std::size_t j = 0; j < entries; ++j) sums.state[k][q][j] += slope * sums.rate[k][q][j];
      memory_.sampling().add_derivatives(place.element, sums.state[k], states[k]->data());
      memory_.sampling().add_derivatives(place.element, sums.rate[k], rates[k]->data());
    }
  });
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.by_pressure.data(), static_cast<PetscMPIInt>(sums.by_pressure.size()),
                             MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)model_.dm())));
  for (std::size_t k = 0; k < numbers.size(); ++k) numbers[k].by_pressure = sums.by_pressure[k];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// What kernels say at a point: a residual's f0 or f1, or what is remembered next.
struct MemorySweep::Output {
  const MemorySpec *spec = nullptr; ///< null: of a residual
  PetscPointFunc volume = nullptr;
  PetscBdPointFunc surface = nullptr;
  PetscInt test = displacement;
  bool gradient = false; ///< f1
  std::size_t size = 0;
};

std::vector<MemorySweep::Output> MemorySweep::outputs_of(const PointMemory::Room &room) const
{
  std::vector<Output> list;
  for (const Term &term : model_.composition().terms()) {
    if (term.trial >= 0 || term.surface != room.surface()) continue;
    const std::size_t components = term.test == displacement ? 3 : 1;
    if (term.f0 || term.bd_f0) list.push_back({nullptr, term.f0, term.bd_f0, term.test, false, components});
    if (term.f1 || term.bd_f1) list.push_back({nullptr, term.f1, term.bd_f1, term.test, true, 3 * components});
  }
  for (const MemorySpec *spec : room.specs())
    if (!spec->told) list.push_back({spec, nullptr, nullptr, displacement, false, spec->quantities.size()});
  return list;
}

/// Those that differences are taken by. Small ones count as a share of the largest of their effect.
std::vector<MemorySweep::Component> MemorySweep::components_of(const PointMemory::Room &room) const
{
  constexpr PetscReal least = 1e-3;
  std::vector<Component> list;
  for (const MemorySpec *spec : room.specs()) {
    if (spec->told || spec->by_past) continue;
    std::vector<PetscReal> size(spec->quantities.size(), 0);
    for (std::size_t i = 0; i < room.places().size(); ++i)
      for (PetscInt q = 0; q < room.points(); ++q) {
        const PetscScalar *last = room.at(static_cast<PetscInt>(i), q).last + spec->offset;
        for (std::size_t j = 0; j < size.size(); ++j) size[j] = std::max(size[j], std::abs(last[j]));
      }
    const PetscReal largest = *std::max_element(size.begin(), size.end());
    for (std::size_t j = 0; j < size.size(); ++j)
      list.push_back({static_cast<std::size_t>(spec->offset) + j,
                      share_of_past * (largest > 0 ? std::max(size[j], least * largest) : 1)});
  }
  return list;
}

/// What an output counts for each number at a point, and where derivatives by the last memory go.
struct MemorySweep::Counted {
  const Model &model;
  const Place &place;
  const Sampling &sampling;
  const std::vector<OfPast> &numbers;
  const std::vector<std::vector<PointSample>> &z; ///< [number][point]

  PetscReal weight(std::size_t q, PetscInt test) const
  {
    return model.row_scale(test) * sampling.weights(place.element)[q] * place.element.measure;
  }
  void weights(const Output &o, std::size_t k, std::size_t q, std::vector<PetscScalar> &w) const
  {
    const PointSample &s = z[k][q];
    const PetscScalar *values = o.test == displacement ? (o.gradient ? s.state.H : s.u) : o.gradient ? s.grad_p : &s.p;
    if (o.spec) values = numbers[k].weights ? numbers[k].weights->data() + place.at(*o.spec, q) : nullptr;
    const PetscReal factor = o.spec ? 1 : weight(q, o.test);
    w.assign(o.size, 0);
    for (std::size_t j = 0; values && j < o.size; ++j) w[j] = factor * values[j];
  }
  void add(std::size_t k, std::size_t at, PetscScalar by_last) const
  {
    (*numbers[k].by_last)[at] += by_last;
    if (numbers[k].by_earlier)
      (*numbers[k].by_earlier)[at] += model.step().earlier_weight / model.step().last_weight * by_last;
  }
};

void MemorySweep::evaluate(const Place &place, const Output &o, std::size_t q, const Memory &memory,
                           std::vector<PetscScalar> &out) const
{
  const PetscInt n_fields = gas_ ? 2 : 1, u_off[] = {0, 3, 4}, u_off_x[] = {0, 9, 12};
  const PointSample &s = place.now[q];
  const auto *state = reinterpret_cast<const PetscScalar *>(&s.state),
             *all = reinterpret_cast<const PetscScalar *>(&memory);

  out.assign(o.size, 0);
  if (o.spec) return o.spec->value(place.point(s, model_.step(), memory), place.constants, out.data());
  const PetscScalar u[] = {s.u[0], s.u[1], s.u[2], s.p}, u_t[] = {s.u_t[0], s.u_t[1], s.u_t[2], s.p_t};
  PetscScalar u_x[12], rate_x[12];
  std::copy_n(s.state.H, 9, u_x);
  std::copy_n(s.grad_p, 3, u_x + 9);
  std::copy_n(s.state.H_rate, 9, rate_x);
  std::copy_n(s.grad_p_t, 3, rate_x + 9);
  if (o.volume)
    o.volume(3, n_fields, precomputed_state, u_off, u_off_x, u, u_t, u_x, nullptr, u_off_x, state, all, rate_x, place.t,
             s.x, 0, place.constants, out.data());
  else
    o.surface(3, n_fields, precomputed_state, u_off, u_off_x, u, u_t, u_x, nullptr, u_off_x, state, all, rate_x,
              place.t, s.x, place.element.normal, 0, place.constants, out.data());
}

void MemorySweep::past_by_differences(const Counted &counted, const Output &o,
                                      const std::vector<Component> &components) const
{
  const Place &place = counted.place;
  const std::size_t numbers = counted.numbers.size();
  std::vector<PetscScalar> own(place.width), here, more, less;
  std::vector<std::vector<PetscScalar>> w(numbers);

  // point q with components from begin to end moved, each by so many of its own change
  const auto with = [&](std::size_t q, std::size_t begin, std::size_t end, PetscReal by) {
    const Memory memory = place.memory(q);
    std::copy_n(memory.last, place.width, own.begin());
    for (std::size_t c = begin; c < end; ++c) own[components[c].place] += by * components[c].change;
    return Memory{own.data(), memory.earlier};
  };
  const auto follows = [&] {
    for (std::size_t q = 0; q < place.points; ++q) {
      evaluate(place, o, q, place.memory(q), here);
      evaluate(place, o, q, with(q, 0, components.size(), 1), more);
      if (here != more) return true;
    }
    return false;
  };
  if (!follows()) return;
  for (std::size_t q = 0; q < place.points; ++q) {
    for (std::size_t k = 0; k < numbers; ++k) counted.weights(o, k, q, w[k]);
    evaluate(place, o, q, place.memory(q), here);
    for (std::size_t c = 0; c < components.size(); ++c) {
      const PetscReal times =
          move_both_ways(here.data(), o.size, more, less, [&](PetscReal by, std::vector<PetscScalar> &values) {
            evaluate(place, o, q, with(q, c, c + 1, by), values);
          });
      for (std::size_t k = 0; k < numbers; ++k) {
        PetscScalar sum = 0;
        for (std::size_t j = 0; j < o.size; ++j) sum += w[k][j] * (more[j] - less[j]);
        counted.add(k, place.first + q * place.width + components[c].place, sum / (2 * times * components[c].change));
      }
    }
  }
}

void MemorySweep::past_by_formula(const Counted &counted, const MemorySpec &spec) const
{
  const Place &place = counted.place;
  const std::size_t n = spec.quantities.size();
  const Output next{&spec, nullptr, nullptr, displacement, false, n};
  std::vector<PetscScalar> w, by(n);

  for (std::size_t q = 0; q < place.points; ++q)
    for (std::size_t k = 0; k < counted.numbers.size(); ++k) {
      PetscScalar gradient[9];
      for (int j = 0; j < 9; ++j) gradient[j] = counted.weight(q, displacement) * counted.z[k][q].state.H[j];
      counted.weights(next, k, q, w);
      by.assign(n, 0);
      spec.by_past(place.point(place.now[q], model_.step(), place.memory(q)), place.constants, w.data(), gradient,
                   by.data());
      for (std::size_t j = 0; j < n; ++j) counted.add(k, place.at(spec, q) + j, model_.step().last_weight * by[j]);
    }
}

PetscErrorCode MemorySweep::by_past(PetscReal t, Vec x, Vec rate, std::vector<OfPast> &numbers) const
{
  const Sampling &sampling = memory_.sampling();
  const PointMemory::Room *room = nullptr; // that of the lists
  std::vector<Output> outputs;
  std::vector<Component> components;
  std::vector<std::unique_ptr<ReadArray>> adjoints;
  std::vector<std::vector<PointSample>> z(numbers.size());

  PetscFunctionBeginUser;
  for (const OfPast &number : numbers) adjoints.push_back(std::make_unique<ReadArray>(number.adjoint));
  for_places(t, x, rate, [&](const Place &place) {
    if (room != &place.room) {
      room = &place.room;
      outputs = outputs_of(*room);
      components = components_of(*room);
    }
    for (std::size_t k = 0; k < numbers.size(); ++k) sampling.sample(place.element, adjoints[k]->data(), z[k]);
    const Counted counted{model_, place, sampling, numbers, z};
    if (!components.empty())
      for (const Output &o : outputs) past_by_differences(counted, o, components);
    for (const MemorySpec *spec : room->specs())
      if (spec->by_past) past_by_formula(counted, *spec);
  });
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode MemorySweep::add_weighted(bool facets, bool start, PetscReal t, Vec x, Vec rate,
                                         const std::vector<const Values *> &weights,
                                         std::vector<std::vector<PetscReal>> &sums) const
{
  Values values;

  PetscFunctionBeginUser;
  const auto counts = [facets](const PointMemory::Room &room) {
    return (!facets || !room.surface().empty()) && acts(room);
  };
  if (std::none_of(memory_.rooms().begin(), memory_.rooms().end(), counts)) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(memory_.evaluate(t, x, rate, start, values));
  for (const PointMemory::Room &room : memory_.rooms()) {
    const auto size = static_cast<std::size_t>(room.points() * room.width());
    if (!counts(room)) continue;
    for (std::size_t k = 0; k < weights.size(); ++k)
      for (std::size_t i = 0; weights[k] && i < room.places().size(); ++i) {
        const std::size_t first = room.begin() + i * size;
        for (std::size_t j = 0; j < size; ++j)
          sums[k][static_cast<std::size_t>(room.places()[i].cell)] += (*weights[k])[first + j] * values[first + j];
      }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
