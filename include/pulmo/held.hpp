/// @file
/// What holds a lung in place: which rigid motions of its bodies supports and springs leave free, the pins against
/// just these, what the pins bear, and values that are prescribed twice.
///
/// All of it reads the composition: every constraint of the displacement and every term that resists displacement
/// itself (a g0 of displacement by displacement) takes part, whichever effect it comes from.
#pragma once

#include "pulmo/archive.hpp"
#include "pulmo/mesh.hpp"
#include "pulmo/model.hpp"

#include <array>

namespace pulmo {

/// A rigid motion u(x) = s + w x (x - c) / R of a body with centroid c and size R: s, then w.
using RigidMotion = std::array<PetscReal, 6>;

/// Displacement of a point at (x - c) / R = @p r.
std::array<PetscReal, 3> displacement_of(const RigidMotion &motion, const PetscReal r[3]);

/// How a connected body is held.
struct HeldBody {
  Mesh::Body body;
  PetscReal size = 0;            ///< R: distance of the farthest vertex from the centroid, mm
  std::vector<RigidMotion> free; ///< orthonormal basis of the motions that nothing holds
  /// The motion that springs hold least, among those that no prescribed displacement stops, and how stiffly they hold
  /// it and the stiffest one, kPa mm; 0 if there is none.
  RigidMotion weakest{};
  PetscReal weakest_stiffness = 0, largest_stiffness = 0;
};

/// Tests the six rigid motions of every body against what holds it.
PetscErrorCode find_held(const Composition &composition, std::vector<HeldBody> &held);

/// Words for motions of a body: "translation along x, rotation about z through (0, 0, 1) mm".
std::string describe(const HeldBody &held, const std::vector<RigidMotion> &motions);

/// Where an effect asked for it, pins the motions that are left free, and nothing else: to be called once all effects
/// have spoken. A body that is wholly free is pinned 3-2-1 along the axes.
PetscErrorCode pin_free_motions(Composition &composition);

/// User error where two constraints prescribe different values for one component of the displacement of one node.
PetscErrorCode check_prescribed_once(const Composition &composition);

/// Refuses a lung with a rigid motion that nothing holds, and warns of one that is held barely. @p modulus: stiffness
/// of the tissue, kPa.
PetscErrorCode check_held(MPI_Comm comm, const Composition &composition, PetscReal modulus);

/// The largest force that the pins bear in a run: none, unless a load goes along a motion that they alone hold.
class PinForces {
public:
  /// @p forces: on each constraint, kPa mm^2. @p local: the state at time @p t; @p gas_pressure: kPa.
  PetscErrorCode follow(const Model &model, const std::vector<std::array<PetscReal, 3>> &forces, Vec local, PetscReal t,
                        PetscReal gas_pressure);
  PetscErrorCode persist(Archive &archive);
  /// Says at the end of a run that the pins bore a load.
  PetscErrorCode warn(const Model &model) const;

  PetscReal largest() const { return largest_; } ///< of one pin, kPa mm^2
  /// Whether it is more than rounding and the tolerances of the solver leave.
  bool loaded() const { return largest_ > faint * loads_; }

private:
  static constexpr PetscReal faint = 1e-5;

  PetscReal largest_ = 0, loads_ = 0; ///< loads_: what acts inside the tissue and on its surface, kPa mm^2
  PetscReal time_ = 0;                ///< s
  PetscInt body_ = -1;
  std::array<PetscReal, 3> sum_{}; ///< of the pins of that body then
};

} // namespace pulmo
