/// @file
/// Where a tissue law ends by itself, and how much of a lung is there.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/physics/law_range.hpp"
#include "pulmo/physics/scene.hpp"

#include <optional>
#include <string>

namespace pulmo {

/// A stiffness below this share of that at rest is none: steps end just before it is gone.
inline constexpr PetscReal no_stiffness = 0.01;

/// Where the law ends by itself in free inflation, F = J^(1/3) I with p = dW/dJ, whatever the mesh and the solver; J is
/// by the volume of the mesh, and the pressure that of the gas in it.
struct OwnLimit {
  enum class Kind {
    pressure, ///< a limit point: dp/dJ = 0
    plateau,  ///< dp/dJ falls to next to nothing there, and rises again
    waves     ///< plane waves meet no stiffness: the law is not elliptic below
  };
  Kind kind = Kind::pressure;
  LawRange::State at = {1, 0};   ///< -, kPa
  PetscReal stiffness_share = 0; ///< dp/dJ there over that at rest, of a plateau
  PetscReal beyond = 0;          ///< share of the volume of the last good state that is there or beyond
  const char *name() const;      ///< of the kind, as in failure.json
};

/// The limit of the law that most of the lung is beyond in the state @p local (a local vector), of which @p lost_share
/// is not elliptic; none where that is not known. Collective.
PetscErrorCode look_at_own_limit(const Scene &scene, const Model &model, Vec local, PetscReal lost_share,
                                 std::optional<OwnLimit> &found);

/// What is known of it, in a sentence that begins with a blank.
std::string own_limit_text(const Scene &scene, const OwnLimit &limit);

} // namespace pulmo
