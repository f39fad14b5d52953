#include "pulmo/programme.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

PetscReal Phase::pressure(PetscReal t) const
{
  const PetscReal since = t - begin;
  return ramp > 0 && since < ramp ? from + (to - from) * std::max<PetscReal>(since, 0) / ramp : to;
}

PetscReal Programme::pressure(PetscReal t) const
{
  if (phases_.empty()) return 0;
  if (t <= phases_.front().begin) return phases_.front().from;
  // the last step of a phase ends there up to rounding: it must not see the next phase
  const PetscReal rounding = 1e-12 * (1 + std::abs(t));
  const auto phase = std::lower_bound(phases_.begin(), phases_.end(), t - rounding,
                                      [](const Phase &p, PetscReal time) { return p.end < time; });
  return phase == phases_.end() ? phases_.back().pressure(phases_.back().end) : phase->pressure(t);
}

} // namespace pulmo
