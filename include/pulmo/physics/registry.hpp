/// @file
/// What pulmo offers: tissue laws, permeability laws, effects. A test or another program may add its own.
#pragma once

#include "pulmo/physics/effect.hpp"

#include <functional>

namespace pulmo {

class Registry {
public:
  /// pulmo's own laws and effects (src/physics/registry.cpp: one line each).
  static Registry standard();

  template <class Law>
  void tissue_law()
  {
    tissue_laws_.push_back([] { return std::make_unique<TissueLawOf<Law>>(); });
  }
  template <class Law>
  void permeability_law()
  {
    permeability_laws_.push_back([] { return std::make_unique<PermeabilityLawOf<Law>>(); });
  }
  template <class E>
  void effect()
  {
    effects_.push_back([] { return std::make_unique<E>(); });
  }
  /// For effects that need arguments.
  void effect(std::function<std::unique_ptr<Effect>()> make) { effects_.push_back(std::move(make)); }

  std::vector<std::unique_ptr<TissueLaw>> make_tissue_laws() const { return make<TissueLaw>(tissue_laws_); }
  std::vector<std::unique_ptr<PermeabilityLaw>> make_permeability_laws() const
  {
    return make<PermeabilityLaw>(permeability_laws_);
  }
  /// The same but for the effects of which @p leave_out says so.
  Registry without(const std::function<bool(const Effect &)> &leave_out) const
  {
    Registry rest = *this;
    rest.effects_.clear();
    for (const auto &maker : effects_)
      if (!leave_out(*maker())) rest.effects_.push_back(maker);
    return rest;
  }

  /// Effects beside tissue, airflow and ventilator (which the scene knows by name).
  std::vector<std::unique_ptr<Effect>> make_effects() const { return make<Effect>(effects_); }

private:
  template <class T>
  static std::vector<std::unique_ptr<T>> make(const std::vector<std::function<std::unique_ptr<T>()>> &makers)
  {
    std::vector<std::unique_ptr<T>> all;
    for (const auto &maker : makers) all.push_back(maker());
    return all;
  }

  std::vector<std::function<std::unique_ptr<TissueLaw>()>> tissue_laws_;
  std::vector<std::function<std::unique_ptr<PermeabilityLaw>()>> permeability_laws_;
  std::vector<std::function<std::unique_ptr<Effect>()>> effects_;
};

} // namespace pulmo
