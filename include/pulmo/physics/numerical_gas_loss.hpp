/// @file
/// What backward Euler loses where gas works on tissue: for the effects that bring the gas stress.
#pragma once

#include "pulmo/physics/point.hpp"

namespace pulmo {

/// What backward Euler loses between the gas and the tissue: p (dJ - cof F : dF), kPa. The ventilator pays for the
/// whole change of volume, the tissue gets the work of its gas stress, which is linear in the step.
static inline PetscScalar numerical_gas_loss(const Point &now, const Point &before, const NoParameters &)
{
  PetscScalar D[9];
  for (int i = 0; i < 9; ++i) D[i] = now.state.H[i] - before.state.H[i];
  return now.gas_pressure() * volume_beyond_linear(now.state.F, D);
}

} // namespace pulmo
