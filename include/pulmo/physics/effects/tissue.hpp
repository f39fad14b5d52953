/// @file
/// Effect `tissue`: momentum balance of the alveolar tissue, int P' : Grad eta, P' = dW/dF. Always on. Its porosity is
/// a parameter for others.
#pragma once

#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/porosity.hpp"

#include <algorithm>
#include <cctype>

namespace pulmo {

/// Displacement field (mm) and the effective stress of the tissue law that the scene chose.
class Tissue final : public Effect {
public:
  explicit Tissue(std::vector<std::unique_ptr<TissueLaw>> laws) : laws_(std::move(laws)) {}

  const char *name() const override { return "tissue"; }
  const char *about() const override { return "hyperelastic alveolar tissue (momentum balance)"; }
  bool active() const override { return true; }
  const TissueLaw &law() const { return *laws_[chosen_]; }
  /// What is not named by a region of its own has.
  const Porosity &porosity() const { return porosity_; }
  /// The copy that the law reads, among its parameters; null: it reads none.
  const PetscScalar *porosity_of_law() const { return laws_[chosen_]->porosity(); }
  /// Whether parts of the lung have porosities of their own.
  bool porosity_varies() const { return porosity_varies_; }

  PetscErrorCode declare(Options &options) override
  {
    std::vector<std::string> names;
    std::string wanted = laws_.front()->name();

    PetscFunctionBeginUser;
    for (const auto &law : laws_) {
      names.emplace_back(law->name());
      if (*law->alias()) names.emplace_back(law->alias());
    }
    options.group(name(), about());
    PetscCall(options.choice("", names, "tissue law", wanted));
    const auto found = std::find_if(laws_.begin(), laws_.end(),
                                    [&](const auto &law) { return wanted == law->name() || wanted == law->alias(); });
    chosen_ = static_cast<std::size_t>(found - laws_.begin());
    PetscScalar *porosity_of_law = laws_[chosen_]->porosity();
    if (porosity_of_law) porosity_.reference = *porosity_of_law;
    PetscCall(options.real("porosity", "-", {0, 1, true},
                           "reference porosity Phi0: share of the volume at rest that is air (by region: "
                           "0.99,right=0.7)",
                           porosity_.reference));
    options.only_volumes(porosity_.reference);
    porosity_varies_ = options.varies(porosity_.reference);
    if (porosity_of_law) options.hand_down(porosity_.reference, *porosity_of_law);
    for (std::size_t i = 0; i < laws_.size(); ++i) {
      const std::string law = laws_[i]->name();
      options.group(name(), "law " + law + " (" + laws_[i]->source() + ")", i == chosen_, "-tissue " + law);
      PetscCall(laws_[i]->declare(options));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.law = &law();
    return PETSC_SUCCESS;
  }

  void fields(Composition &c) const override { c.field("displacement", 3, c.elements().displacement_degree, "mm"); }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    PetscInt count;
    const PetscScalar *parameters = law().parameters(&count);
    const LawCallbacks of_law = law().callbacks(!facts.stress_free.empty());

    PetscFunctionBeginUser;
    c.parameters(name(), parameters, count);
    // the weak form of tissue and gas does without it: J and Phi0 + J - 1 have one rate
    if (facts.porosity || porosity_varies_) c.parameters(porosity_);
    if (!facts.stress_free.empty()) {
      PetscCheck(facts.stress_free.size() <= StressFree::most, PETSC_COMM_SELF, PETSC_ERR_ARG_OUTOFRANGE,
                 "more than %d effects say where the tissue is free of stress", StressFree::most);
      stress_free_.count = 0;
      for (const StressFreeFunction function : facts.stress_free)
        stress_free_.function[static_cast<int>(stress_free_.count++)] = constants::to_scalar(function);
      c.parameters(stress_free_);
    }
    c.residual("P' : Grad eta", displacement, f1(of_law.stress));
    c.jacobian("dP'/dF", displacement, displacement, g3(of_law.tangent));
    c.energy(Energy::stored, "elastic_tissue", "", of_law.stored);
    c.energy(Energy::numerical, "numerical_dissipation", "", of_law.numerical);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  std::vector<std::unique_ptr<TissueLaw>> laws_;
  std::size_t chosen_ = 0;
  Porosity porosity_;
  mutable StressFree stress_free_; ///< packed for the kernels by terms()
  bool porosity_varies_ = false;
};

} // namespace pulmo
