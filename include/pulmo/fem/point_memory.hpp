/// @file
/// What effects remember at the quadrature points of cells and facets: values of the states before the one at hand.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/fem/sampling.hpp"

namespace pulmo {

class Archive;

/// Keeps what Composition::remember() declared. A residual only reads it: Newton's iterations and cut attempts leave no
/// trace. Once a step is accepted, each quantity is computed anew from the state there.
class PointMemory {
public:
  /// Allocates what @p model's effects remember and fills it with what they say of the start. @p model must outlive
  /// this.
  PetscErrorCode setup(const Model &model);
  /// Fills it anew, where what is given at the start has changed (Composition::begin_with).
  PetscErrorCode begin();
  /// Memory of this rank: of all effects, or of what @p spec declares.
  std::size_t bytes() const;
  std::size_t bytes(const MemorySpec &spec) const;

  /// What the time scheme looks back at: the last state, and maybe one more.
  enum class Past { last, earlier, middle };
  void look_back(Past past) { past_ = past; }

  /// The cells, or the facets of one surface: [place][point][width].
  class Room {
  public:
    /// Scalars at a point.
    PetscInt width() const { return width_; }
    /// What kernels see at point @p q of place @p i; the next point's follows, width() apart. Cells are those of this
    /// rank, facets as Sampling::surface() has them.
    Memory at(PetscInt i, PetscInt q) const;
    /// The last accepted state as its observers see it.
    Memory accepted(PetscInt i, PetscInt q) const;
    /// The surface; empty: the cells.
    const std::string &surface() const { return surface_; }
    /// Quadrature points of a place.
    PetscInt points() const { return points_; }
    const std::vector<Sampling::Element> &places() const { return places_; }
    /// What is remembered there.
    const std::vector<const MemorySpec *> &specs() const { return specs_; }
    /// Where this room begins in Values.
    std::size_t begin() const { return begin_; }
    /// The mesh points of the facets.
    const std::vector<PetscInt> &facets() const { return facets_; }
    /// The quadrature points of place @p i, [point][3], mm.
    void coordinates(PetscInt i, std::vector<PetscReal> &x) const { memory_->sampling_.coordinates(places_[i], x); }

  private:
    friend class PointMemory;
    const PointMemory *memory_ = nullptr;
    std::string surface_; ///< empty: the cells
    std::vector<const MemorySpec *> specs_;
    std::vector<Sampling::Element> places_;
    std::vector<PetscInt> facets_;
    PetscInt width_ = 0, points_ = 0;
    std::size_t begin_ = 0;
    std::vector<PetscScalar> last_, earlier_, middle_, next_;
  };
  /// That of the cells, or of the facets of @p surface; null if nothing is remembered there.
  const Room *room(const std::string &surface = "") const;
  const std::vector<Room> &rooms() const { return rooms_; }
  const Sampling &sampling() const { return sampling_; }

  /// What is remembered in all rooms, one after the other.
  using Values = std::vector<PetscScalar>;
  std::size_t size() const { return rooms_.empty() ? 0 : rooms_.back().begin_ + rooms_.back().last_.size(); }
  /// What was computed last, or what there is at the start.
  void copy(bool start, Values &values) const;
  /// Lets kernels see @p last, and of the state before that @p earlier, or none if that is empty.
  void show(const Values &last, const Values &earlier);
  /// What follows from the local vectors @p x and @p rate at time @p t and from what kernels see, in @p values; or, if
  /// @p start, what there is at the start.
  PetscErrorCode evaluate(PetscReal t, Vec x, Vec rate, bool start, Values &values) const;

  /// Computes all quantities at time @p t from the local vectors @p x and @p rate, with the constants of the step at
  /// hand.
  PetscErrorCode compute(PetscReal t, Vec x, Vec rate);
  /// What was computed belongs to the half step that BDF2 begins with.
  void keep_middle();
  /// What was computed belongs to a step that is accepted; observers still see the states before it.
  void accept() { pending_ = true; }
  /// The next step begins.
  void settle();
  /// Writes or reads the states before the next step; @p looks_back: there are two. Collective.
  PetscErrorCode persist(Archive &archive, bool looks_back);

  /// Means over the cells of quantity @p index of @p spec in the last accepted state; of a quantity of facets those
  /// over a cell's facets, and no number where a cell has none.
  void means(const MemorySpec &spec, std::size_t index, std::vector<PetscScalar> &values) const;

  /// Composition::integrals() in the last accepted state. Collective.
  PetscErrorCode integrals(std::vector<double> &values) const;

private:
  PetscErrorCode add_room(const std::string &surface);
  static bool given(const MemorySpec &spec) { return spec.start && !spec.start->empty(); }
  PetscErrorCode take_given(const Room &room, PetscScalar *values) const;
  /// Calls the effects' own functions at all points.
  PetscErrorCode evaluate(PetscReal t, const PetscScalar *x, const PetscScalar *rate, const Step &step, bool start,
                          const Room &room, PetscScalar *values) const;
  PetscErrorCode evaluate_start(const Room &room, PetscScalar *values) const;

  const Model *model_ = nullptr;
  Sampling sampling_;
  Past past_ = Past::last;
  bool pending_ = false; ///< what was computed belongs to an accepted step
  bool two_ = false;     ///< there is a state before the last
  std::vector<Room> rooms_;
};

} // namespace pulmo
