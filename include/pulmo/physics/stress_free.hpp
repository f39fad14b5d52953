/// @file
/// A tissue that is not free of stress in the shape of the mesh: its law is that of F G, and W(F G) / det G is the
/// energy per volume of the mesh.
///
/// G takes the stress-free shape of the tissue to the mesh. Effects that make it so announce a function of a point that
/// multiplies G (SceneFacts::stress_free): a lung that was imaged under pressure, tissue that takes part of its volume
/// up without stress. The tissue, and whoever asks for its stress, sees all of them through the constants of PetscDS.
#pragma once

#include "pulmo/physics/point.hpp"

namespace pulmo {

/// Of which state an effect is asked.
enum class When {
  now,     ///< of that at hand, which a step may end with
  accepted ///< of one that was accepted, by what Point::of_all remembers of it in Memory::last
};

/// Multiplies @p G, which begins as the identity, by the share of an effect.
using StressFreeFunction = void (*)(const Point &point, const PetscScalar constants[], When when, PetscScalar G[9]);

/// Adds dP'/dp, by which the tissue's stress depends on the gas pressure at a point, to @p to.
using StressByPressure = void (*)(const Point &point, const PetscScalar constants[], PetscScalar to[9]);

/// The functions of all effects, as constants of PetscDS.
struct StressFree {
  static constexpr const char *owner = "stress_free";
  static constexpr int most = 4;
  PetscScalar count = 0;
  PetscScalar function[most] = {0}; ///< StressFreeFunction, as constants::to_scalar() packs them

  /// Lets @p all, the constants of PetscDS, be those of tissue that is free of stress in the shape of the mesh.
  static void forget(std::vector<PetscScalar> &all)
  {
    const PetscInt offset = constants::offset_of(constants::tag(owner), all.data());
    if (offset > 0) all[static_cast<std::size_t>(offset)] = 0;
  }
};

/// The deformation gradient that the tissue feels.
struct FeltState {
  PetscScalar G[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  PetscScalar det = 1; ///< det G
  PointState state;    ///< of F G; no rates

  /// That of the mesh's @p of at @p point.
  FeltState(const Point &point, const PointState &of, const StressFree &k, When when)
  {
    PetscScalar H[9];
    for (int i = 0; i < static_cast<int>(k.count); ++i)
      constants::to_pointer<StressFreeFunction>(k.function[i])(point, point.constants, when, G);
    det = determinant(G);
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        H[3 * i + J] = of.F[3 * i] * G[J] + of.F[3 * i + 1] * G[3 + J] + of.F[3 * i + 2] * G[6 + J] - (i == J);
    make_point_state(H, nullptr, state);
  }

  /// Adds P = dW/d(F G) G^T / det G to @p to.
  void add_stress(const PetscScalar P[9], PetscScalar to[9]) const
  {
    for (int i = 0; i < 3; ++i)
      for (int J = 0; J < 3; ++J)
        to[3 * i + J] += (P[3 * i] * G[3 * J] + P[3 * i + 1] * G[3 * J + 1] + P[3 * i + 2] * G[3 * J + 2]) / det;
  }
  /// Adds the tangent A_iMkN G_JM G_LN / det G, stored [i][k][J][L], to @p to.
  void add_tangent(const PetscScalar A[81], PetscScalar to[81]) const
  {
    for (int ik = 0; ik < 9; ++ik) {
      const PetscScalar *a = A + 9 * ik;
      PetscScalar half[9]; // [M][L]
      for (int M = 0; M < 3; ++M)
        for (int L = 0; L < 3; ++L)
          half[3 * M + L] = (a[3 * M] * G[3 * L] + a[3 * M + 1] * G[3 * L + 1] + a[3 * M + 2] * G[3 * L + 2]) / det;
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L)
          to[9 * ik + 3 * J + L] += G[3 * J] * half[L] + G[3 * J + 1] * half[3 + L] + G[3 * J + 2] * half[6 + L];
    }
  }
};

} // namespace pulmo
