/// @file
/// What solver, time steps and elements make the numbers of a run wrong by, from one backward sweep.
#pragma once

#include "pulmo/adjoint/enrichment.hpp"
#include "pulmo/observers/error_bars.hpp"

namespace pulmo {

/// Weighs what is left of the equations of each stage by the multipliers of a sweep. With x the states of a run and z
/// its multipliers a better run has the number G + sum of z . R_better(x) to first order (Giles & Suli, Acta Numerica
/// 11, 2002, 145-236):
///
/// solver  R as it is, and the equations of scalars: what Newton left;
/// time    rates of one order more: the polynomial through states of the phase before and after the stage. Beside
///         that the number itself is a sum over the rows, and its largest values lie between them
///         (Functional::better_value);
/// space   elements one degree richer (Enrichment): for the pressure in every stage; for the displacement, without
///         airflow in every stage, else in some: a look stands for the stages before it by the size of multipliers
///         and displacements there, until that has changed much.
class ErrorParts {
public:
  ErrorParts(const Scene &scene, Model &model, Simulation &simulation, const Trajectory &trajectory)
      : scene_(scene), model_(model), simulation_(simulation), trajectory_(trajectory)
  {}
  /// What keeps the parts from this scene, as the end of a sentence; empty: nothing does.
  static std::string obstacle(const Scene &scene, const Model &model);
  /// Sweeps back for @p functionals. @p failure: as of Sweep::run(). Collective.
  PetscErrorCode run(Sweep &sweep, const std::vector<Functional> &functionals, PetscReal tolerance,
                     std::string &failure);
  /// When the ramps of the run ended, s.
  std::vector<double> kinks() const;
  /// What each number lacks.
  const std::vector<LackingParts> &lacking() const { return lacking_; }
  /// [number][cell of this rank]: the part in space.
  const std::vector<std::vector<PetscReal>> &in_space() const { return in_space_; }
  /// What phases with too few steps add to the part in time of number @p k, in sizes: so much of it is a guess.
  PetscReal rough_in_time(std::size_t k) const { return rough_[k]; }

private:
  using ByCell = std::vector<std::vector<PetscReal>>;
  struct Kept { ///< multipliers of a stage that looks back at one where the displacement is looked at
    PetscReal factor;
    std::vector<VecHandle> adjoint;
  };

  struct Found { ///< [number]: size of the parts in space so far
    std::vector<PetscReal> flow, tissue;
  };

  PetscErrorCode setup(const std::vector<Functional> &functionals);
  /// Notes the stages that a number looks at itself, if these are few.
  void find_looked_at(const std::vector<Functional> &functionals);
  /// Whether to look at the displacement in a stage where the numbers have these sizes(): the last look is of another
  /// kind, or long ago.
  bool samples(PetscInt stage, const std::vector<PetscReal> &size, const Found &found);
  PetscErrorCode found(Found &sizes) const;
  PetscErrorCode visit(const Sweep &sweep, const Sweep::Solved &stage);
  PetscErrorCode add_solver(const Sweep::Solved &stage);
  PetscErrorCode add_time(const Sweep &sweep, const Sweep::Solved &stage);
  PetscErrorCode add_space(const Sweep::Solved &stage);
  /// [number]: sum of |z u| over the displacements.
  PetscErrorCode sizes(const Sweep::Solved &stage, std::vector<PetscReal> &sums) const;
  /// Stages, and by how much their weight in a better rate of a stage exceeds that in its own, 1/s.
  using Changes = std::vector<std::pair<PetscInt, PetscReal>>;
  /// @p rough: there are too few between two kinks.
  Changes better_rate(PetscInt number, bool &rough) const;
  PetscErrorCode add_other_rates(const Sweep::Solved &stage, const Changes &changes);
  PetscErrorCode total(const ByCell &parts, std::vector<PetscReal> &sums) const;

  const Scene &scene_;
  Model &model_;
  Simulation &simulation_;
  const Trajectory &trajectory_;
  bool gas_ = false;
  std::optional<Enrichment> flow_, tissue_;
  std::vector<bool> looked_at_;                 ///< [stage]
  std::map<PetscInt, std::vector<Kept>> later_; ///< [stage]
  struct {
    PetscInt age = 0; ///< stages ago
    std::vector<PetscReal> size;
    ByCell part;
  } sample_;                       ///< the last look at the displacement
  std::vector<PetscReal> largest_; ///< [number]: size so far
  std::vector<PetscReal> rough_;   ///< [number]
  std::vector<LackingParts> lacking_;
  ByCell solver_, time_, flow_part_, tissue_part_, in_space_;
  VecHandle state_; ///< local
};

} // namespace pulmo
