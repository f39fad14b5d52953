/// @file
/// True errors of a computed state in the norms of the error indicators, as pulmo/observers/error_indicator.hpp defines
/// them.
#pragma once

#include "verification/support/fields.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/physics/tissue_law.hpp"

namespace pulmo::test {

/// Integrands of the squared norms at a point.
struct ErrorDensity {
  PetscScalar tissue = 0, flow = 0;        ///< of the errors, J/mm^3 and W/mm^3
  PetscScalar stress = 0, dissipation = 0; ///< of the exact stress and the computed flow, the same units
};

/// At a sample of the computed state: @p k is its permeability there, mm^2/(kPa s), @p grad_u and @p grad_p (kPa/mm)
/// are exact.
inline ErrorDensity error_density(const TissueLaw &law, PetscReal modulus, PetscReal k, const Sample &s,
                                  const PetscScalar grad_u[9], const PetscScalar grad_p[3])
{
  ErrorDensity e;
  PointState exact, computed;
  PetscScalar P[9], P_h[9], flux[3] = {0, 0, 0}, flux_h[3] = {0, 0, 0};
  make_point_state(grad_u, nullptr, exact);
  make_point_state(s.grad_u, nullptr, computed);
  const PetscReal stress = units::j_per_kPa_mm3 / (2 * modulus), flow = units::j_per_kPa_mm3 * k / computed.J;
  law.stress(exact, P);
  law.stress(computed, P_h);
  e.stress = stress * contract(P, P);
  for (int i = 0; i < 9; ++i) P[i] -= P_h[i];
  e.tissue = stress * contract(P, P);
  for (int i = 0; i < 9; ++i) {
    flux[i / 3] += computed.cof_F[i] * (grad_p[i % 3] - s.grad_p[i % 3]);
    flux_h[i / 3] += computed.cof_F[i] * s.grad_p[i % 3];
  }
  for (int i = 0; i < 3; ++i) {
    e.flow += flow * flux[i] * flux[i];
    e.dissipation += flow * flux_h[i] * flux_h[i];
  }
  return e;
}

} // namespace pulmo::test
