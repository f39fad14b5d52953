/// @file
/// The energy audit: where the work of the ventilator goes, step by step, from the discrete fields.
///
/// Momentum tested with the step du and mass tested with p give, for backward Euler and to solver tolerance,
///
///   P_aw Q dt + external = stored + dissipated + numerical
///
/// The effects declare the terms (Composition::energy); the audit integrates them with the rules of the weak form and
/// knows no effect by name. "numerical" is evaluated by formulas of its own, not as what is left over.
#pragma once

#include "pulmo/fem/sampling.hpp"
#include "pulmo/physics/scene.hpp"
#include "pulmo/time/observer.hpp"

namespace pulmo {

/// A row of the balance, as in summary.json without its unit.
struct EnergyAccount {
  std::string name;
  Energy kind;
};

/// Energies of a run up to one of its rows, or of a part of it, J.
struct EnergyBalance {
  double ventilator_work = 0;   ///< int P Q dt at the machine
  double exchanged = 0;         ///< what ventilator and external loads gave, without what they took back
  std::vector<double> accounts; ///< in the order of EnergyAudit::accounts()
  double residual = 0;          ///< ventilator_work + external - stored - dissipated - numerical

  EnergyBalance operator-(const EnergyBalance &other) const;
  /// The residual over the work that was given; 0 if there was none.
  double relative_residual() const;
};

/// Follows the balance over the accepted steps.
class EnergyAudit final : public Observer {
public:
  EnergyAudit(const Scene &scene, Model &model, const Sampling &sampling)
      : scene_(scene), model_(model), sampling_(sampling)
  {}

  /// After the model was built and the sampling set up.
  PetscErrorCode setup();
  PetscErrorCode observe(const StepReport &step) override;
  PetscErrorCode persist(Archive &archive, Vec local) override;

  const std::vector<EnergyAccount> &accounts() const { return accounts_; }
  /// The largest residual of the run, and that as a share of what was given (a strain of a millionth at least), J.
  double worst_residual() const;
  double worst_share() const;
  /// Of a part of the run; empty where so little work was given that rounding is as large.
  std::optional<double> relative_residual(const EnergyBalance &balance) const;
  /// Since the start of the run, one entry per row of the signals.
  const std::vector<EnergyBalance> &rows() const { return rows_; }

private:
  struct Part {          ///< a surface, or the volume
    std::string surface; ///< empty: the volume
    std::vector<Sampling::Element> elements;
    std::vector<const EnergyTerm *> terms;
    std::vector<std::size_t> account; ///< of each term
  };

  std::size_t account(const std::string &name, Energy kind);
  /// Work that strains the lung by a millionth, J.
  double least_work() const;
  /// Adds the terms of @p part to @p sums (kPa mm^3, this rank).
  PetscErrorCode integrate(const Part &part, const StepReport &step, std::vector<double> &sums);
  /// Adds the terms of the scalars to @p sums (kPa mm^3, all ranks).
  void add_scalars(const StepReport &step, std::vector<double> &sums);
  /// Adds the work of supports that move (this rank).
  PetscErrorCode add_support_work(const StepReport &step, double &sum);

  const Scene &scene_;
  Model &model_;
  const Sampling &sampling_;
  std::vector<Part> parts_;
  std::vector<PetscInt> held_; ///< constrained displacement components, offsets in the local vector
  std::vector<EnergyAccount> accounts_;
  std::vector<EnergyBalance> rows_;
  VecHandle before_;
  double gas_pressure_ = 0; ///< uniform pressure at the start of the step, kPa
};

} // namespace pulmo
