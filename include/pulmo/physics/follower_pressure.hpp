/// @file
/// A pressure on a surface that moves with it: traction -p J F^-T N per reference area.
#pragma once

#include "pulmo/physics/kinematics.hpp"
#include "pulmo/physics/point.hpp"

namespace pulmo {

/// f0 += p cof F N.
static inline void add_follower_pressure(const Point &point, PetscScalar p, PetscScalar f0[])
{
  const PetscScalar *cof = point.state.cof_F;
  const PetscReal *N = point.normal;
  for (int i = 0; i < 3; ++i) f0[i] += p * (cof[3 * i] * N[0] + cof[3 * i + 1] * N[1] + cof[3 * i + 2] * N[2]);
}

/// g1 += p d(cof F N)/dF.
static inline void add_follower_pressure_by_displacement(const Point &point, PetscScalar p, PetscScalar g1[])
{
  PetscScalar g3[81] = {0};
  const PetscReal *N = point.normal;
  add_cofactor_derivative(point.state.F, p, g3);
  for (int ik = 0; ik < 9; ++ik)
    for (int L = 0; L < 3; ++L)
      g1[3 * ik + L] += g3[9 * ik + L] * N[0] + g3[9 * ik + 3 + L] * N[1] + g3[9 * ik + 6 + L] * N[2];
}

/// Work on the lung in a step: -p cof F N . du, kPa mm.
static inline PetscScalar follower_pressure_work(const Point &now, const Point &before, PetscScalar p)
{
  PetscScalar f0[3] = {0, 0, 0}, sum = 0;
  add_follower_pressure(now, p, f0);
  for (int i = 0; i < 3; ++i) sum -= f0[i] * (now.u[i] - before.u[i]);
  return sum;
}

} // namespace pulmo
