#include "pulmo/time/balance.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

namespace pulmo {

void Balance::setup(PetscReal lung, PetscReal modulus)
{
  lung_ = lung;
  modulus_ = modulus;
}

PetscReal Balance::share(const Errors &errors, std::string &text) const
{
  const PetscReal surface = 6 * std::cbrt(lung_ * lung_); // of a cube
  const PetscReal gas = errors.gas / std::max(size_.gas, least * lung_),
                  force = errors.force / std::max(size_.force, least * modulus_ * surface),
                  pressure = errors.pressure / std::max(size_.pressure, least * modulus_);
  const PetscReal largest = std::isfinite(gas + force + pressure) ? std::max({gas, force, pressure}) : PETSC_INFINITY;
  std::ostringstream words;
  words.precision(2);
  if (gas == largest)
    words << errors.gas / units::mm3_per_ml << " ml of gas, " << gas << " of what the lung took in and gave back";
  else if (force == largest)
    words << "forces of " << errors.force * units::newton_per_kPa_mm2 << " N without balance, " << force
          << " of the load";
  else
    words << "a difference of " << errors.pressure / units::kPa_per_cmH2O << " cmH2O to the ventilator's pressure, "
          << pressure << " of it";
  text = words.str();
  return largest;
}

PetscErrorCode Balance::judge(int breath, PetscReal before, PetscReal volume, PetscReal pressure, const Errors &errors,
                              const std::function<PetscErrorCode(Loads &)> &load, bool &solved)
{
  Errors left = errors;

  PetscFunctionBeginUser;
  step_drift_ = errors.net_gas;
  left.gas = std::max(errors.gas, std::abs(drift_ + step_drift_));
  if (breath != breath_) {
    if (breath_ == 0) size_.gas = 0; // what filled the lung before its first breath is no tidal volume
    lowest_ = highest_ = before;     // what the first step moves counts, too
  }
  breath_ = breath;
  lowest_ = std::min(lowest_, volume);
  highest_ = std::max(highest_, volume);
  size_.gas = std::max(size_.gas, highest_ - lowest_);
  size_.pressure = std::max(size_.pressure, std::abs(pressure));
  if (!(left.force <= warning * size_.force && left.gas <= warning * size_.gas)) { // old loads are no larger
    Loads now;
    PetscCall(load(now));
    size_.force = std::max(size_.force, now.force);
    size_.gas = std::max(size_.gas, now.gas);
  }
  const PetscReal most = share(left, complaint_);
  solved = most <= failure;
  warns_ = !warned_ && most > warning;
  warned_ = warned_ || warns_;
  worst_share_ = std::max(worst_share_, most);
  worst_.gas = std::max(worst_.gas, left.gas);
  worst_.force = std::max(worst_.force, left.force);
  worst_.pressure = std::max(worst_.pressure, left.pressure);
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Balance::judge_run(PetscReal gas)
{
  worst_.gas = std::max(worst_.gas, gas);
  worst_share_ = share(worst_, complaint_);
  return worst_share_ <= failure;
}

PetscErrorCode Balance::persist(Archive &archive)
{
  PetscFunctionBeginUser;
  for (const auto &[name, errors] : {std::pair{"worst", &worst_}, std::pair{"size", &size_}}) {
    const std::string path = std::string("balance/") + name;
    PetscCall(archive.value(path + "_gas_mm3", errors->gas));
    PetscCall(archive.value(path + "_force_kPa_mm2", errors->force));
    PetscCall(archive.value(path + "_pressure_kPa", errors->pressure));
  }
  PetscCall(archive.value("balance/drift_mm3", drift_));
  PetscCall(archive.value("balance/lowest_mm3", lowest_));
  PetscCall(archive.value("balance/highest_mm3", highest_));
  PetscCall(archive.value("balance/breath", breath_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
