/// @file
/// What elements one degree richer would change in the numbers of a run: the error in space, cell by cell.
#pragma once

#include "pulmo/adjoint/sweep.hpp"
#include "pulmo/mesh/elements.hpp"

namespace pulmo {

/// The equations of a run in elements whose displacement or pressure is one degree richer, on the same mesh.
///
/// With the state x and the multipliers z of the run as they stand in the richer elements, and R the residual there,
/// the number of a run with richer elements is G + sum of z' . R to first order, where z' are the multipliers of what
/// the richer elements have beyond the run's. These solve a system with the block of the Jacobian among them alone, in
/// the sense of hierarchical estimates (Bank & Smith, SIAM J. Numer. Anal. 30, 1993, 921-935; for numbers of interest
/// Becker & Rannacher, Acta Numerica 10, 2001, 1-102): of the pressure its diagonal, of the displacement the whole.
class Enrichment {
public:
  /// @p field: displacement or pressure.
  explicit Enrichment(PetscInt field) : field_(field) {}
  /// Whether there are richer elements than @p elements.
  static bool exists(const Elements &elements)
  {
    return elements.displacement_degree <= 2 && elements.pressure_degree <= 1;
  }
  /// @p model: of the run; must outlive this. Collective.
  PetscErrorCode setup(Model &model);

  /// What the multipliers of later stages want of a stage through the gas that they look back at.
  struct Later {
    PetscReal factor;         ///< of int (J - 1) q
    std::vector<Vec> adjoint; ///< [number]: local, of the run
  };
  /// A state that the gas of a stage looks back at where kernels do not see it (multistep).
  struct Past {
    PetscReal factor; ///< of int (J - 1) q
    Vec state;        ///< local, of the run
  };
  using ByCell = std::vector<std::vector<PetscReal>>; ///< [number][cell of this rank]
  /// Adds the changes of the numbers by one stage to @p sums. @p matrix: of the stage, its diagonal is looked at.
  /// @p left: null, or gets what the solver left of the equations, weighted by the multipliers of the run.
  PetscErrorCode add(const Sweep::Solved &stage, const std::vector<Later> &later, const std::vector<Past> &past,
                     Mat matrix, ByCell &sums, ByCell *left = nullptr);

private:
  /// A value at a node of the richer elements, of values of the run's at nodes nearby.
  struct Node {
    PetscInt dof;  ///< in the local vector, first component
    PetscInt n;    ///< values that it is made of
    PetscInt from; ///< the first of these in sources_, weights_
    PetscInt components;
  };
  /// A function that the run's elements do not have: of one node, or of the difference of two.
  struct Function {
    PetscInt dof, other; ///< in the local vector, first component; other: -1, or where it is minus one
  };

  PetscErrorCode find_nodes();
  PetscErrorCode interpolate(Vec run, Vec rich) const;
  /// Sums over the ranks; zero where something is prescribed, and at the airway's nodes while these are @p held.
  PetscErrorCode sum_up(Vec local, bool held);
  /// Adds to weights_ the rows of the transposed Jacobian times z_, and makes the diagonal of its block, for the new
  /// functions, at the first node of each; to be summed up.
  PetscErrorCode weigh(const StageRecord &record, Mat matrix);
  /// Keeps the block of a cell's matrix among the new functions.
  void keep_block(const PetscInt *dofs, const PetscScalar *entries);
  /// @p y = the kept blocks, transposed, times @p x; global vectors, rich. @p y is zero where no new function is free.
  PetscErrorCode apply_blocks(Vec x, Vec y);
  /// Solves the kept blocks for the weights of one number, by conjugate gradients.
  PetscErrorCode solve_blocks(Vec weights);
  /// Adds a local vector, as the new functions see it, to @p sum.
  PetscErrorCode add_at_functions(Vec local, Vec sum) const;
  /// Makes weights_ the multipliers of the new functions.
  PetscErrorCode solve();
  PetscInt components() const { return field_ == displacement ? 3 : 1; }

  PetscInt field_;
  Model *run_ = nullptr;
  Model rich_;
  std::vector<Node> nodes_;
  std::vector<PetscInt> sources_; ///< in the local vector of the run, first component
  std::vector<PetscReal> source_weights_;
  std::vector<Function> functions_;
  std::vector<PetscInt>
      function_of_; ///< of a dof of the local vector: sign times (number of the function + 1); 0: none
  VecHandle x_, rate_, diagonal_, stiffness_, work_, other_; ///< local, rich
  std::vector<VecHandle> z_, weights_; ///< [number]: local, rich: multipliers of the run; of new functions
  struct Block {                       ///< of a cell's matrix among its new functions
    PetscInt size;
    std::size_t places, entries; ///< the first of these
  };
  std::vector<Block> blocks_;
  std::vector<PetscInt> block_places_;                      ///< in the local vector, of the first node
  std::vector<float> block_entries_;                        ///< many, and worth few digits
  VecHandle global_, inverse_, left_, direction_, product_; ///< global, rich
  VecHandle run_work_, run_global_;                         ///< local and global, of the run
};

} // namespace pulmo
