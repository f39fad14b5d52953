#include "pulmo/registry.hpp"

#include "pulmo/effects/airflow.hpp"
#include "pulmo/effects/chest_wall.hpp"
#include "pulmo/effects/lumen_pressure.hpp"
#include "pulmo/effects/pressure_damping.hpp"
#include "pulmo/effects/support.hpp"
#include "pulmo/effects/traction.hpp"
#include "pulmo/effects/tube.hpp"
#include "pulmo/tissue/berger.hpp"
#include "pulmo/tissue/birzle.hpp"
#include "pulmo/tissue/ma.hpp"
#include "pulmo/tissue/rausch.hpp"
#include "pulmo/tissue/yoshihara.hpp"

namespace pulmo {

Registry Registry::standard()
{
  Registry r;
  // tissue laws; the first is the default
  r.tissue_law<Birzle>();
  r.tissue_law<Berger>();
  r.tissue_law<Ma>();
  r.tissue_law<Yoshihara>();
  r.tissue_law<Rausch>();
  // permeability laws; the first is the default
  r.permeability_law<ConstantPermeability>();
  // effects beside tissue, airflow and ventilator
  r.effect<ChestWall>();
  r.effect<LumenPressure>();
  r.effect<PressureDamping>();
  r.effect<Support>();
  r.effect<Traction>();
  r.effect<Tube>();
  return r;
}

} // namespace pulmo
