/// @file
/// Scalar unknowns of a scene: pressures that the whole lung, or a surface of it, has one of.
///
/// An effect declares its scalars s and as many equations c(s, ds/dt, P, Q) = 0 (Composition::scalars): P is the
/// pressure at the airway opening, Q the gas that flows into the lung through the surfaces whose pressure a scalar is.
#pragma once

#include "pulmo/base/petsc.hpp"

#include <functional>
#include <string>
#include <vector>

namespace pulmo {

/// A surface of the mesh, or what of it belongs to one part of the volume.
struct SurfacePart {
  std::string surface;
  std::string region; ///< empty: all of the surface
  std::string text() const { return "'" + surface + "'" + (region.empty() ? "" : " of '" + region + "'"); }
};

/// A scalar unknown, a pressure in kPa; shown in cmH2O.
struct ScalarSpec {
  std::string name;                  ///< as in signals.csv
  std::vector<SurfacePart> surfaces; ///< of the airway, whose gas pressure it is; empty: of none
  PetscReal storage = 0;             ///< gas stored beside the lung per unit of it, mm^3/kPa
};

/// What the equations of an effect see; its scalars by their number.
struct ScalarState {
  PetscReal opening = 0;        ///< pressure at the airway opening, kPa
  std::vector<PetscReal> value; ///< kPa
  std::vector<PetscReal> rate;  ///< kPa/s, by the time scheme
  std::vector<PetscReal> flow;  ///< into the lung through their surfaces, mm^3/s; 0 for those without
};

/// The equations, kPa, with their derivatives by what they see.
class ScalarRows {
public:
  explicit ScalarRows(std::size_t n) : value(n, 0), by_opening(n, 0), n_(n), by_(3 * n * n, 0) {}
  std::size_t size() const { return n_; }

  std::vector<PetscReal> value, by_opening;
  PetscReal &by_value(std::size_t equation, std::size_t scalar) { return by_[equation * n_ + scalar]; }
  PetscReal &by_rate(std::size_t equation, std::size_t scalar) { return by_[(n_ + equation) * n_ + scalar]; }
  PetscReal &by_flow(std::size_t equation, std::size_t scalar) { return by_[(2 * n_ + equation) * n_ + scalar]; }

private:
  std::size_t n_;
  std::vector<PetscReal> by_;
};

/// Fills in the equations, all of them zero before.
using ScalarEquations = std::function<void(const ScalarState &state, ScalarRows &rows)>;

/// What happens to energy at the scalars in a step of @p dt s, kPa mm^3.
using ScalarEnergy = std::function<PetscReal(const ScalarState &now, const ScalarState &before, PetscReal dt)>;

} // namespace pulmo
