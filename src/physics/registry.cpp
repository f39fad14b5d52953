#include "pulmo/physics/registry.hpp"

#include "pulmo/physics/effects/airflow.hpp"
#include "pulmo/physics/effects/airway_tree.hpp"
#include "pulmo/physics/effects/breathing_effort.hpp"
#include "pulmo/physics/effects/cavity.hpp"
#include "pulmo/physics/effects/chest_wall.hpp"
#include "pulmo/physics/effects/gravity.hpp"
#include "pulmo/physics/effects/inertia.hpp"
#include "pulmo/physics/effects/lumen_pressure.hpp"
#include "pulmo/physics/effects/pressure_damping.hpp"
#include "pulmo/physics/effects/prestress.hpp"
#include "pulmo/physics/effects/recruitment.hpp"
#include "pulmo/physics/effects/support.hpp"
#include "pulmo/physics/effects/surfactant.hpp"
#include "pulmo/physics/effects/traction.hpp"
#include "pulmo/physics/effects/tube.hpp"
#include "pulmo/physics/effects/viscoelastic.hpp"
#include "pulmo/physics/permeability/constant.hpp"
#include "pulmo/physics/permeability/exponential.hpp"
#include "pulmo/physics/permeability/holmes_mow.hpp"
#include "pulmo/physics/permeability/kozeny_carman.hpp"
#include "pulmo/physics/permeability/power.hpp"
#include "pulmo/physics/tissue/berger.hpp"
#include "pulmo/physics/tissue/birzle.hpp"
#include "pulmo/physics/tissue/concha.hpp"
#include "pulmo/physics/tissue/ma.hpp"
#include "pulmo/physics/tissue/patte.hpp"
#include "pulmo/physics/tissue/rausch.hpp"
#include "pulmo/physics/tissue/yoshihara.hpp"

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
  r.tissue_law<Patte>();
  r.tissue_law<Concha>();
  // permeability laws; the first is the default
  r.permeability_law<ConstantPermeability>();
  r.permeability_law<PowerPermeability>();
  r.permeability_law<KozenyCarmanPermeability>();
  r.permeability_law<HolmesMowPermeability>();
  r.permeability_law<ExponentialPermeability>();
  // effects beside tissue, airflow and ventilator
  r.effect<AirwayTree>();
  r.effect<BreathingEffort>();
  r.effect<Cavity>();
  r.effect<ChestWall>();
  r.effect<Gravity>();
  r.effect<Inertia>();
  r.effect<LumenPressure>();
  r.effect<PressureDamping>();
  r.effect<Prestress>();
  r.effect<Recruitment>();
  r.effect<Support>();
  r.effect<Surfactant>();
  r.effect<Traction>();
  r.effect<Tube>();
  r.effect<Viscoelastic>();
  return r;
}

} // namespace pulmo
