/// @file
/// What an effect is: options, fields, weak-form terms, constraints, declared in one header in pulmo/physics/effects/.
///
/// An effect that a scene does not ask for only lists its options; it adds no field, no term, no matrix block.
#pragma once

#include "pulmo/input/programme.hpp"
#include "pulmo/mesh/elements.hpp"
#include "pulmo/physics/partner.hpp"
#include "pulmo/physics/permeability.hpp"
#include "pulmo/physics/point.hpp"
#include "pulmo/physics/scalars.hpp"
#include "pulmo/physics/signal_row.hpp"
#include "pulmo/physics/tissue_law.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

class Mesh;
class ParameterFields;

/// A finite-element field: P1, P2, ... Lagrange on tetrahedra.
struct FieldSpec {
  std::string name;
  PetscInt components;
  PetscInt degree;
  std::string unit;
  std::string effect; ///< who brought it
};

/// One term of the weak form: callbacks of one residual row, or of one Jacobian block.
struct Term {
  std::string effect, name;
  std::string surface; ///< empty: the whole volume
  PetscInt test = displacement;
  PetscInt trial = -1; ///< -1: a residual term
  bool bears = true;   ///< may bear a load at rest; a mass does not
  PetscPointFunc f0 = nullptr, f1 = nullptr;
  PetscPointJac g0 = nullptr, g1 = nullptr, g2 = nullptr, g3 = nullptr;
  PetscBdPointFunc bd_f0 = nullptr, bd_f1 = nullptr;
  PetscBdPointJac bd_g0 = nullptr, bd_g1 = nullptr, bd_g2 = nullptr, bd_g3 = nullptr;
};

/// A callback in its place in a term.
template <class F, PetscInt Order>
struct Slot {
  Callback<F> callback;

  void put(Term &t) const
  {
    if constexpr (std::is_same_v<F, PetscPointFunc>)
      (Order == 0 ? t.f0 : t.f1) = callback.function;
    else if constexpr (std::is_same_v<F, PetscBdPointFunc>)
      (Order == 0 ? t.bd_f0 : t.bd_f1) = callback.function;
    else if constexpr (std::is_same_v<F, PetscPointJac>)
      (Order == 0 ? t.g0 : Order == 1 ? t.g1 : Order == 2 ? t.g2 : t.g3) = callback.function;
    else
      (Order == 0 ? t.bd_g0 : Order == 1 ? t.bd_g1 : Order == 2 ? t.bd_g2 : t.bd_g3) = callback.function;
  }
};

// residual: f0 . q + f1 : Grad q; Jacobian: g0 by value and value, g1 by Grad of the trial field, g2 of the test field,
// g3 of both (pulmo/physics/point.hpp)
template <class F>
Slot<F, 0> f0(Callback<F> c)
{
  return {c};
}
template <class F>
Slot<F, 1> f1(Callback<F> c)
{
  return {c};
}
template <class F>
Slot<F, 0> g0(Callback<F> c)
{
  return {c};
}
template <class F>
Slot<F, 1> g1(Callback<F> c)
{
  return {c};
}
template <class F>
Slot<F, 2> g2(Callback<F> c)
{
  return {c};
}
template <class F>
Slot<F, 3> g3(Callback<F> c)
{
  return {c};
}

/// Prescribed values of some components of a field, on a surface or at single vertices.
struct Constraint {
  std::string effect, name;
  PetscInt field = displacement;
  bool component[3] = {false, false, false};
  std::string surface;            ///< empty: at @p vertices
  std::vector<PetscInt> vertices; ///< local mesh points (on every rank that has them)
  bool at_airway = false;         ///< steered by the ventilator: its pressure while it holds one, else free
  PetscInt pinned_body = -1;      ///< the body of Mesh::bodies() that this pins against a rigid motion; -1: no pin
  /// Value of all components at time t (s) and material point x (mm); unused if at_airway.
  std::function<void(PetscReal t, const PetscReal x[3], PetscScalar value[3])> value;
};

/// Where energy goes in the balance  work of the ventilator + external = stored + dissipated + numerical.
enum class Energy { external, stored, dissipated, numerical };

/// A share of the energy balance: what happens to energy in a step, point by point (pulmo/observers/energy.hpp).
struct EnergyTerm {
  std::string effect;
  Energy kind;
  std::string account; ///< the row that it adds to, as in summary.json
  std::string surface; ///< empty: the whole volume
  EnergyDensity density;
};

/// The scalar unknowns of one effect (pulmo/physics/scalars.hpp).
struct ScalarGroup {
  std::string effect;
  std::vector<ScalarSpec> scalars;
  ScalarEquations equations;
  std::vector<const PetscReal *> parameters; ///< settings that the equations read anew at each call
  std::size_t offset = 0;                    ///< number of the first one among those of all effects
};

/// A share of the energy balance that scalars have.
struct ScalarEnergyTerm {
  std::string effect;
  Energy kind;
  std::string account;
  ScalarEnergy energy;
};

/// A block of kernel parameters that lives in an effect and is copied into PetscDS before each evaluation.
struct ParameterBlock {
  const char *owner;
  const PetscScalar *data;
  PetscInt count;
};

/// A column that an effect adds to the signals; its name ends with its unit.
struct SignalSpec {
  std::string name;
  std::function<double(const SignalRow &)> value;
};

/// A quantity that an effect remembers at the points of the cells, or of the facets of a surface.
struct Quantity {
  std::string name, unit;
};

/// How a number for each row of the signals comes of what an effect remembers at many points.
enum class Over { cells, facets, largest_of_facets };

/// An integral over the lung, or over the surfaces, of what an effect remembers there, or the largest value on them
/// (SignalRow::integrals).
struct RememberedIntegral {
  std::string effect;
  std::size_t quantity; ///< number among those of the effect
  PetscReal factor;     ///< of mm^3, mm^2 or 1, times the quantity's unit
  Over over = Over::cells;
  std::string column; ///< of the signals, which the summary has region by region, too; empty: none
  bool mean = false;  ///< over the lung's volume, and over that of a region
};

/// The largest value of a column in @p rows.
inline double largest(const SignalSpec &signal, const std::vector<SignalRow> &rows)
{
  double most = -std::numeric_limits<double>::infinity();
  for (const SignalRow &row : rows) most = std::max(most, signal.value(row));
  return most;
}

/// A column of the signals that should not rise above a limit.
struct SignalLimit {
  std::size_t signal; ///< number among Composition::signals()
  double most;
  std::string complaint; ///< what it means, and what to do: the end of a sentence
};

/// What one effect remembers there.
struct MemorySpec {
  std::string effect;
  std::string surface; ///< empty: in the cells
  const char *owner;   ///< of the parameters of its kernels
  std::vector<Quantity> quantities;
  MemoryFunction value; ///< what they are in a state
  /// What they are at the start, [cell][point][quantity], where that is not for @p value to say; null: it is.
  std::shared_ptr<const std::vector<PetscScalar>> start;
  PetscInt offset = 0;              ///< among the scalars of a point
  bool told = false;                ///< no kernel reads them: they are for the signals and the fields
  PastFunction by_past = nullptr;   ///< null: differences tell how all follows from them
  StateFunction by_state = nullptr; ///< null: differences tell how they follow from the state
};

/// A parameter of a kernel that follows from others, wherever these differ from place to place.
struct DerivedParameter {
  const PetscScalar *target;                                            ///< in a block of parameters
  std::function<PetscScalar(std::vector<PetscScalar> constants)> value; ///< from what all effects handed over
  std::string complaint;                                                ///< what a user reads where it is not a number
};

/// What parameters must be to each other, in every part of the lung.
struct ParameterRelation {
  std::function<bool(const PetscScalar constants[])> holds;
  std::string complaint; ///< what a user reads where it does not
};

/// What the effects of a scene put together; filled by Effect::fields and Effect::terms.
class Composition {
public:
  Composition(const Mesh &mesh, const Elements &elements) : mesh_(mesh), elements_(elements) {}

  const Mesh &mesh() const { return mesh_; }
  const Elements &elements() const { return elements_; }
  /// Names the effect that speaks next (used by the ledger).
  void speaker(const std::string &effect) { effect_ = effect; }

  void field(const std::string &name, PetscInt components, PetscInt degree, const std::string &unit)
  {
    fields_.push_back({name, components, degree, unit, effect_});
  }

  /// Hands a struct of parameters to the kernels. The struct must outlive the model.
  template <class P>
  void parameters(const P &p)
  {
    parameters(P::owner, reinterpret_cast<const PetscScalar *>(&p), sizeof(P) / sizeof(PetscScalar));
  }
  void parameters(const char *owner, const PetscScalar *data, PetscInt count)
  {
    parameters_.push_back({owner, data, count});
  }

  /// Says that a parameter which was handed over follows from others, and how.
  void derive(DerivedParameter parameter) { derived_.push_back(std::move(parameter)); }
  const std::vector<DerivedParameter> &derived() const { return derived_; }
  /// Refuses a lung that has parameters, all over or in some part, for which @p relation does not hold.
  void require(ParameterRelation relation) { relations_.push_back(std::move(relation)); }
  const std::vector<ParameterRelation> &relations() const { return relations_; }

  /// A residual term of the volume, e.g. residual("P : Grad eta", displacement, f1(volume_residual<P, K::stress>)).
  template <class... Slots>
  void residual(const std::string &name, PetscInt test, Slots... slots)
  {
    add(term(name, "", test, -1), slots...);
  }
  /// A Jacobian term of the volume: of the row @p test by the field @p trial.
  template <class... Slots>
  void jacobian(const std::string &name, PetscInt test, PetscInt trial, Slots... slots)
  {
    add(term(name, "", test, trial), slots...);
  }
  template <class... Slots>
  void surface_residual(const std::string &name, const std::string &surface, PetscInt test, Slots... slots)
  {
    add(term(name, surface, test, -1), slots...);
  }
  template <class... Slots>
  void surface_jacobian(const std::string &name, const std::string &surface, PetscInt test, PetscInt trial,
                        Slots... slots)
  {
    add(term(name, surface, test, trial), slots...);
  }
  /// Says that the term added last resists motion alone: nothing rests on it.
  void bears_nothing() { terms_.back().bears = false; }
  /// A term of the energy balance: work done on the lung in a step (external), growth of a stored energy, energy
  /// turned to heat (dissipated), and what backward Euler loses beside these: work of the term's force at the end of
  /// the step along the step, less what is stored (numerical).
  void energy(Energy kind, const std::string &account, const std::string &surface, Callback<EnergyDensity> density)
  {
    energies_.push_back({effect_, kind, account, surface, density.function});
    note_readers(effect_, account, surface, density.owners);
  }
  /// Lets an effect remember quantities at the points of the cells, or of the facets of @p surface. @p value computes
  /// all of them from a state, of which the effect sees those before in Point::memory and Point::past(); it is called
  /// once for an accepted step, and at the start (memory.last is null then). Kernels there whose parameters have the
  /// same owner see what is remembered; residuals and @p value follow from it through Point::past() alone, where there
  /// are states before. An effect that remembers on several surfaces remembers the same on each.
  void remember(std::vector<Quantity> quantities, Callback<MemoryFunction> value, const std::string &surface = "");
  /// Says what the quantities that were declared last are at the start: [cell][point][quantity], filled before
  /// Model::build().
  void begin_with(std::shared_ptr<const std::vector<PetscScalar>> start) { memories_.back().start = std::move(start); }
  /// Says that no kernel reads the quantities that were declared last.
  void only_tell() { memories_.back().told = true; }
  /// Says how all that the effect does follows from the quantities that were declared last, and these from the state.
  /// Where they are many that is less work for the backward sweep than differences.
  void follows(Callback<PastFunction> by_past, Callback<StateFunction> by_state)
  {
    memories_.back().by_past = by_past.function;
    memories_.back().by_state = by_state.function;
  }
  const std::vector<MemorySpec> &memories() const { return memories_; }
  /// Whether the residual of a step follows from anything that is remembered.
  bool memory_acts() const
  {
    return std::any_of(memories_.begin(), memories_.end(), [](const MemorySpec &m) { return !m.told; });
  }
  /// What @p effect remembers in the cells; null: nothing.
  const MemorySpec *remembered_in_cells(const std::string &effect) const
  {
    for (const MemorySpec &spec : memories_)
      if (spec.effect == effect && spec.surface.empty()) return &spec;
    return nullptr;
  }
  /// Adds a column to the signals: the integral over the lung of quantity @p quantity of those that the effect which
  /// speaks remembers in the cells, times @p factor.
  void integrate(std::size_t quantity, const std::string &name, PetscReal factor)
  {
    column_of({effect_, quantity, factor, Over::cells, name, false});
  }
  /// The same of its mean over the lung.
  void average(std::size_t quantity, const std::string &name);
  /// Which of SignalRow::integrals is quantity @p quantity @p over the places where the effect remembers it, times @p
  /// factor.
  std::size_t sum_up(std::size_t quantity, Over over, PetscReal factor)
  {
    integrals_.push_back({effect_, quantity, factor, over, "", false});
    return integrals_.size() - 1;
  }
  const std::vector<RememberedIntegral> &integrals() const { return integrals_; }
  /// Scalars that are remembered at a point of a cell, or of a facet of @p surface.
  PetscInt memory_width(const std::string &surface = "") const;
  /// Adds scalar unknowns and as many equations. @p parameters: settings that these read anew at each call, so that a
  /// backward sweep may move them.
  void scalars(std::vector<ScalarSpec> list, ScalarEquations equations, std::vector<const PetscReal *> parameters = {})
  {
    scalar_groups_.push_back({effect_, std::move(list), std::move(equations), std::move(parameters), n_scalars_});
    n_scalars_ += scalar_groups_.back().scalars.size();
  }
  /// Whether a scalar's equation reads @p setting so.
  bool read_by_scalars(const PetscReal *setting) const;
  const std::vector<ScalarGroup> &scalar_groups() const { return scalar_groups_; }
  /// Names settings that the kernels of @p owner read where they are, by a pointer among their parameters.
  void read_in_place(const char *owner, const std::vector<const PetscReal *> &settings)
  {
    for (const PetscReal *setting : settings) in_place_.emplace_back(setting, owner);
  }
  /// Whose kernels read @p setting so; null: none.
  const char *reader_in_place(const PetscReal *setting) const;
  /// Scalar unknowns of all effects; the pressure at the airway opening is not among them.
  std::size_t n_scalars() const { return n_scalars_; }
  /// A term of the energy balance for what the scalars of the effect that speaks do.
  void scalar_energy(Energy kind, const std::string &account, ScalarEnergy energy)
  {
    scalar_energies_.push_back({effect_, kind, account, std::move(energy)});
  }
  const std::vector<ScalarEnergyTerm> &scalar_energies() const { return scalar_energies_; }
  /// A column of signals.csv that follows from the others, e.g. signal("muscle_pressure_cmH2O", ...).
  void signal(const std::string &name, std::function<double(const SignalRow &)> value)
  {
    signals_.push_back({name, std::move(value)});
  }
  const std::vector<SignalSpec> &signals() const { return signals_; }
  /// The largest value that the last column had in the run stands in summary.json, and a run is told of one above
  /// @p most.
  void limit(double most, const std::string &complaint) { limits_.push_back({signals_.size() - 1, most, complaint}); }
  const std::vector<SignalLimit> &limits() const { return limits_; }
  void constrain(Constraint c)
  {
    c.effect = effect_;
    constraints_.push_back(std::move(c));
  }
  /// Kernels are not to see a state without air, J - 1 + Phi0 <= 0; they read the tissue's porosity.
  void need_air() { needs_air_ = true; }
  bool needs_air() const { return needs_air_; }
  /// The uniform gas pressure of a lung without airflow is an unknown in some phases.
  void solve_for_gas_pressure() { common_gas_pressure_ = true; }
  bool common_gas_pressure() const { return common_gas_pressure_; }

  /// Whether displacement is prescribed anywhere.
  bool supported() const
  {
    for (const Constraint &c : constraints_)
      if (c.field == displacement) return true;
    return false;
  }
  /// Asks for pins against the rigid motions that nothing else holds, once all effects have spoken.
  void pin_free_motions() { pins_for_ = effect_; }
  /// The effect that asked for them, or nothing.
  const std::string &pins_for() const { return pins_for_; }
  bool pinned() const
  {
    return std::any_of(constraints_.begin(), constraints_.end(),
                       [](const Constraint &c) { return c.pinned_body >= 0; });
  }

  /// The surfaces where something bears a load: a prescribed displacement, or a term that resists displacement itself;
  /// an empty name stands for all of the lung. Pins at single vertices bear none.
  std::vector<std::string> bearing_surfaces() const
  {
    std::vector<std::string> list;
    for (const Constraint &c : constraints_)
      if (c.field == displacement && !c.surface.empty()) list.push_back(c.surface);
    for (const Term &t : terms_)
      if (resists(t)) list.push_back(t.surface);
    return list;
  }
  /// The surfaces on which an effect has terms.
  std::vector<std::string> surfaces_of(const std::string &effect) const
  {
    std::vector<std::string> list;
    for (const Term &t : terms_)
      if (t.effect == effect && !t.surface.empty()) list.push_back(t.surface);
    return list;
  }

  const std::vector<FieldSpec> &fields() const { return fields_; }
  const std::vector<Term> &terms() const { return terms_; }
  const std::vector<Constraint> &constraints() const { return constraints_; }
  const std::vector<EnergyTerm> &energies() const { return energies_; }
  const std::vector<ParameterBlock> &parameter_blocks() const { return parameters_; }
  /// Parameters that differ from place to place, once all effects have spoken.
  void vary(std::shared_ptr<const ParameterFields> fields) { varying_ = std::move(fields); }
  /// Null where there are none.
  const ParameterFields *varying() const { return varying_.get(); }
  /// The same parameters and memory, and of the fields the displacement alone: for another problem on this mesh.
  Composition without_terms() const
  {
    Composition other(mesh_, elements_);
    other.fields_.push_back(fields_.front());
    other.parameters_ = parameters_;
    other.memories_ = memories_;
    other.varying_ = varying_;
    return other;
  }
  /// The same with field @p field one degree richer, for what remembers nothing at points. Of the Jacobian the rows and
  /// columns of that field are left.
  Composition enriched(PetscInt field) const
  {
    Composition other = *this;
    ++other.fields_[static_cast<std::size_t>(field)].degree;
    ++(field == displacement ? other.elements_.displacement_degree : other.elements_.pressure_degree);
    const auto elsewhere = [field](const Term &t) { return t.trial >= 0 && t.trial != field && t.test != field; };
    other.terms_.erase(std::remove_if(other.terms_.begin(), other.terms_.end(), elsewhere), other.terms_.end());
    return other;
  }
  /// The place of @p parameter among the constants, or -1; @p owner: of its block.
  PetscInt constant_at(const PetscReal *parameter, const char **owner) const;
  /// The surfaces on which terms read the parameters of @p owner.
  std::vector<std::string> surfaces_that_read(const char *owner) const;
  /// Whether no term of the volume reads them.
  bool read_on_surfaces_alone(const char *owner) const;
  /// Whether a kernel with the parameters of @p owner remembers what acts in later steps.
  bool remembers(const char *owner) const;
  /// Refuses terms that read parameters which no effect hands over, or two hand over, and memories that cannot be told
  /// apart: errors in an effect's code.
  PetscErrorCode check_parameters(MPI_Comm comm) const;
  /// Constants of PetscDS for a step: those of the step and of all effects, under a directory.
  std::vector<PetscScalar> constants(const Step &step) const;

private:
  /// Entries of the directory of constants().
  PetscInt constant_blocks() const
  {
    return static_cast<PetscInt>(1 + parameters_.size() + (memories_.empty() ? 0 : memories_.size() + 1));
  }
  void column_of(RememberedIntegral integral)
  {
    signal(integral.column, [i = integrals_.size()](const SignalRow &row) { return row.integrals[i]; });
    integrals_.push_back(std::move(integral));
  }
  /// Whether a term resists displacement itself.
  static bool resists(const Term &t)
  {
    return t.bears && t.test == displacement && t.trial == displacement && (t.g0 || t.bd_g0);
  }
  Term term(const std::string &name, const std::string &surface, PetscInt test, PetscInt trial) const
  {
    Term t;
    t.effect = effect_;
    t.name = name;
    t.surface = surface;
    t.test = test;
    t.trial = trial;
    return t;
  }

  template <class... Slots>
  void add(Term t, Slots... slots)
  {
    const auto fill = [&](const auto &slot) {
      slot.put(t);
      note_readers(t.effect, t.name, t.surface, slot.callback.owners);
    };
    static_assert(sizeof...(Slots) > 0, "a term needs a callback: f0(...), f1(...), g0(...) ... g3(...)");
    (fill(slots), ...);
    terms_.push_back(std::move(t));
  }

  void note_readers(const std::string &effect, const std::string &term, const std::string &surface,
                    const Owners &owners)
  {
    for (const char *owner : owners)
      if (owner) readers_.push_back({effect, term, surface, owner});
  }

  /// What reads a block of parameters.
  struct Reader {
    std::string effect, term, surface;
    const char *owner;
  };

  const Mesh &mesh_;
  Elements elements_;
  std::string effect_, pins_for_;
  bool common_gas_pressure_ = false, needs_air_ = false;
  std::vector<FieldSpec> fields_;
  std::vector<Term> terms_;
  std::vector<Constraint> constraints_;
  std::vector<EnergyTerm> energies_;
  std::vector<ParameterBlock> parameters_;
  std::vector<DerivedParameter> derived_;
  std::vector<ParameterRelation> relations_;
  std::vector<Reader> readers_;
  std::vector<MemorySpec> memories_;
  std::vector<RememberedIntegral> integrals_;
  std::vector<ScalarGroup> scalar_groups_;
  std::vector<std::pair<const PetscReal *, const char *>> in_place_; ///< settings, and whose kernels read them
  std::vector<ScalarEnergyTerm> scalar_energies_;
  std::vector<SignalSpec> signals_;
  std::vector<SignalLimit> limits_;
  std::size_t n_scalars_ = 0;
  std::shared_ptr<const ParameterFields> varying_;
};

/// Pressure lost between ventilator and airway, after Rohrer: K1 Q + K2 |Q| Q with the flow Q in mm^3/s.
struct AirwayResistance {
  PetscReal linear = 0;    ///< K1, kPa s/mm^3
  PetscReal quadratic = 0; ///< K2, kPa s^2/mm^6

  PetscReal drop(PetscReal flow) const { return (linear + quadratic * std::abs(flow)) * flow; }
  PetscReal slope(PetscReal flow) const { return linear + 2 * quadratic * std::abs(flow); }
};

/// How the flow of a flow phase is shared by the airway patches.
enum class FlowSplit {
  automatic,      ///< not said: uniform where the airway is one patch, else common_pressure (Scene::prepare)
  uniform,        ///< the same flux through every element of area (Aviles-Rojas & Hurtado 2022, eq. 45)
  common_pressure ///< so that all patches have one pressure, which is unknown until solved
};

/// What comes before the first breath where PEEP or a load moves the lung at rest.
struct Settling {
  std::shared_ptr<const Programme> programme; ///< the ventilator's with a phase `settle` first; null: that is no matter
  bool off = false;                           ///< loads that move the lung at rest are counted as breath
  bool pressure = false;                      ///< so is the pressure that the airway begins with
};

/// Gravity, as others may know it.
struct GravityFacts {
  std::array<PetscReal, 3> down{}; ///< unit vector along it
  PetscReal force = 0;             ///< weight of 1 kg/m^3, kPa/mm
  PetscReal air_density = 0;       ///< kg/m^3
  Callback<EnergyDensity> mass;    ///< of tissue and air at a point, kg per m^3 of reference volume (1e-3 g/ml)
};

/// A stress-free shape that has to be solved for before a run (pulmo/program/unloading.hpp).
struct Unloading {
  /// Weight of the lung per volume of the mesh, as the tissue has to carry it, kPa/mm; null: it has none.
  std::function<void(const PetscScalar constants[], PetscReal weight[3])> weight;
  /// Adds the terms of the problem; its unknown is where the tissue goes once it is unloaded.
  std::function<void(Composition &)> terms;
  /// What is known of a point of a cell.
  struct AtPoint : std::array<PetscScalar, 13> {
    static constexpr int F0 = 0;        ///< takes the stress-free shape to the mesh, 9
    static constexpr int pleural = 9;   ///< pressure less than that of the gas, kPa
    static constexpr int gradient = 10; ///< its slope, kPa/mm, 3; until the shape is found all that balances weight
    static constexpr int count = 13;

    explicit AtPoint(PetscScalar pressure) : std::array<PetscScalar, 13>{1, 0, 0, 0, 1, 0, 0, 0, 1, pressure, 0, 0, 0}
    {}
    static std::vector<Quantity> quantities()
    {
      std::vector<Quantity> list;
      for (int i = 0; i < 9; ++i) list.push_back({std::string("F0_") + "xyz"[i / 3] + "xyz"[i % 3], ""});
      list.push_back({"pleural_suction", "kPa"});
      for (char d : {'x', 'y', 'z'}) list.push_back({std::string("pleural_slope_") + d, "kPa/mm"});
      return list;
    }
  };
  /// Filled by the solution, [cell][point][AtPoint].
  std::shared_ptr<std::vector<PetscScalar>> points = std::make_shared<std::vector<PetscScalar>>();
  PetscReal pressure = 0; ///< transpulmonary, kPa
  PetscReal left = 0;     ///< norm of the residual (Model) that the solution leaves
  PetscReal volume = 0;   ///< of the stress-free shape, mm^3
};

/// A lung that is under pressure in the shape of the mesh, as others may know it.
struct PrestressFacts {
  PetscReal pressure = 0; ///< transpulmonary, kPa
  /// Unloaded, over that of the mesh, at a point; null where it is solved for.
  std::function<PetscReal(const PetscScalar constants[])> volume;
  std::shared_ptr<Unloading> unloading; ///< null: the stress-free shape is known without solving
};

/// What one effect may know of the scene beside itself.
struct SceneFacts {
  /// How fast a load comes or goes, s, and what says so: longer steps do not see it.
  struct LoadTime {
    PetscReal seconds;
    std::string of;
  };

  Elements elements;
  const TissueLaw *law = nullptr;                ///< of the tissue
  std::vector<StressFreeFunction> stress_free;   ///< where it is free of stress, if not in the shape of the mesh
  StressByPressure stress_by_pressure = nullptr; ///< how its stress depends on the gas pressure, if it does
  /// dp/dJ that films of constant tension add in uniform inflation, kPa; null: there are none.
  PetscReal (*film_stiffness)(PetscReal J, const PetscScalar constants[]) = nullptr;
  bool airflow = false;                          ///< the pressure field exists
  bool porosity = false;                         ///< a kernel or an observer reads the tissue's porosity (Porosity)
  const PermeabilityLaw *permeability = nullptr; ///< that the gas flows by; null without airflow
  /// The least share of that permeability that a place may be left with; null: all of it.
  PetscReal (*least_permeability)(const PetscScalar constants[]) = nullptr;
  std::optional<GravityFacts> gravity;
  bool inertia = false; ///< tissue and air have mass
  std::optional<PrestressFacts> prestress;
  PetscScalar (*pleural_suction)(PetscReal t, const PetscScalar constants[]) = nullptr; ///< by muscles, kPa; or none
  std::vector<std::string> airway_surfaces;    ///< open to the ventilator; without airflow those that would be
  std::shared_ptr<const Programme> ventilator; ///< null without a ventilator
  /// Its phases laid out again by its settings as they are now; @p settles: with a phase `settle` first.
  std::function<Programme(bool settles)> programme_again;
  std::vector<LoadTime> load_times; ///< of loads other than the ventilator's
  /// What loads other than the ventilator's are at a time of the run, those that change with the place at one place.
  std::vector<std::function<PetscReal(PetscReal t)>> courses;
  Settling settling;
  FlowSplit flow_split = FlowSplit::automatic;
  /// Where no more of a prescribed pressure can be held a flow of this size is prescribed, mm^3/s; 0: the mean one of
  /// the phase until then; none: the run ends there.
  std::optional<PetscReal> flow_past_limit_points;
  std::optional<AirwayResistance> tube;         ///< between ventilator and airway
  std::function<AirwayResistance()> tube_again; ///< that of its settings as they are now
  std::string surface_pressures_by; ///< the effect that solves for the pressures of the open surfaces; or nothing
  bool pressure_damping = false;    ///< oscillations of the pressure are damped

  /// Whether some phase leaves the airway's pressure field free, with its flux prescribed.
  bool free_airway() const
  {
    return airflow && ventilator && ventilator->prescribes_flow() && flow_split == FlowSplit::uniform &&
           surface_pressures_by.empty();
  }
  /// Whether some phase has the pressure at the airway opening (without airflow: of all gas) as an unknown of its own.
  bool unknown_opening_pressure() const
  {
    return ventilator && (!surface_pressures_by.empty() || tube || ventilator->limits_pressure() ||
                          flow_past_limit_points || (ventilator->prescribes_flow() && !free_airway()));
  }
};

/// One physical effect.
class Effect {
public:
  virtual ~Effect() = default;

  /// The option prefix, and the owner of its parameters.
  virtual const char *name() const = 0;
  /// One line for -help and the ledger: what it is and where it is published.
  virtual const char *about() const = 0;
  /// For -scene_view, what it does in this scene (after check()), without a full stop; its options follow.
  virtual std::string describe(const SceneFacts &) const { return about(); }
  /// For -scene_view, what a scene without it leaves out, e.g. "nothing has weight". Empty: what about() says.
  virtual const char *absence() const { return ""; }
  /// Options that bring it into a scene of a lung with the surfaces pleura and airway. The harness checks it with
  /// these.
  virtual std::string example() const { return std::string("-") + name(); }
  /// Declares all options, whether or not the scene asks for the effect, and learns whether it does.
  virtual PetscErrorCode declare(Options &options) = 0;
  /// Whether the scene asks for it (after declare()).
  virtual bool active() const = 0;
  /// Tells the other effects what they may need to know.
  virtual PetscErrorCode announce(SceneFacts &) { return PETSC_SUCCESS; }
  /// For an effect that is on by default where others are: they have announced themselves, the mesh is read, active()
  /// is asked next.
  virtual PetscErrorCode consider(Options &, const Mesh &, const SceneFacts &) { return PETSC_SUCCESS; }
  /// Checks against the mesh and the other effects; errors name the option and how to fix it.
  virtual PetscErrorCode check(const Options &, const Mesh &, const SceneFacts &) { return PETSC_SUCCESS; }
  /// Adds its fields.
  virtual void fields(Composition &) const {}
  /// Adds its parameters, terms, constraints, memory and scalars.
  virtual PetscErrorCode terms(Composition &, const SceneFacts &) const { return PETSC_SUCCESS; }
  /// Who has a past or a say in the steps of a run; they must not outlive the effect.
  virtual std::vector<std::unique_ptr<Partner>> partners(const SceneFacts &) const { return {}; }
};

} // namespace pulmo
