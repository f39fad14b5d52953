/// @file
/// What holds a lung in place: which rigid motions of its bodies supports and springs leave free, and values that are
/// prescribed twice.
///
/// All of it reads the composition: every constraint of the displacement and every term that resists displacement
/// itself (a g0 of displacement by displacement) takes part, whichever effect it comes from.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/mesh/mesh.hpp"

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

/// User error where two constraints prescribe different values for one component of the displacement of one node.
PetscErrorCode check_prescribed_once(const Composition &composition);

/// Refuses a lung with a rigid motion that nothing holds, and warns of one that is held barely. @p modulus: stiffness
/// of the tissue, kPa.
PetscErrorCode check_held(MPI_Comm comm, const Composition &composition, PetscReal modulus);

} // namespace pulmo
