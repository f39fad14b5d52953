/// @file
/// What effects remember at the quadrature points of the cells: values of the states before the one at hand.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/fem/sampling.hpp"

namespace pulmo {

class Archive;

/// Keeps what Composition::remember() declared, [cell][point][quantity]. A residual only reads it: Newton's iterations
/// and cut attempts leave no trace. Once a step is accepted, each quantity is computed anew from the state there.
class PointMemory {
public:
  /// Allocates what @p model's effects remember and fills it with what they say of the start. @p model must outlive
  /// this.
  PetscErrorCode setup(const Model &model);
  bool empty() const { return width_ == 0; }
  /// Scalars at a point.
  PetscInt width() const { return width_; }
  /// Memory of this rank.
  std::size_t bytes() const;

  /// What the time scheme looks back at: the last state, and maybe one more.
  enum class Past { last, earlier, middle };
  void look_back(Past past) { past_ = past; }
  /// What kernels see at point @p q of cell @p c; the next point's follows, width() apart.
  Memory at(PetscInt c, PetscInt q) const;

  /// Computes all quantities at time @p t from the local vectors @p x and @p rate, with the constants of the step at
  /// hand.
  PetscErrorCode compute(PetscReal t, Vec x, Vec rate);
  /// What was computed belongs to the half step that BDF2 begins with.
  void keep_middle() { middle_.swap(next_); }
  /// What was computed belongs to a step that is accepted; observers still see the states before it.
  void accept() { pending_ = true; }
  /// The next step begins.
  void settle();
  /// Writes or reads the states before the next step; @p looks_back: there are two.
  PetscErrorCode persist(Archive &archive, bool looks_back);

private:
  /// Calls the effects' own functions at all points.
  PetscErrorCode evaluate(PetscReal t, const PetscScalar *x, const PetscScalar *rate, const Step &step, bool start,
                          std::vector<PetscScalar> &values);

  const Model *model_ = nullptr;
  Sampling sampling_;
  PetscInt width_ = 0, points_ = 0;
  Past past_ = Past::last;
  bool pending_ = false;
  std::vector<PetscScalar> last_, earlier_, middle_, next_;
};

} // namespace pulmo
