#include "pulmo/time/own_limit.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/sampling.hpp"

#include <sstream>
#include <vector>

namespace pulmo {

namespace {

/// Steps end just before a limit of the law: what is this near it is there.
constexpr PetscReal at_limit = 0.02;

/// Where the law with the constants @p all ends by itself; the nearest to rest of what ends it in inflation, and in
/// compression. Nothing where that is not known: other effects have a share in J or in the stiffness, or the parameters
/// differ from place to place.
std::vector<OwnLimit> own_limits(const Scene &scene, const Model &model)
{
  const SceneFacts &facts = scene.facts();
  const TissueLaw &law = scene.tissue().law();
  const bool stretched = facts.prestress && facts.prestress->volume;
  std::vector<OwnLimit> limits;
  if (model.composition().varying() || facts.film_stiffness || facts.stress_by_pressure ||
      facts.stress_free.size() != (stretched ? 1 : 0))
    return limits;

  std::vector<PetscScalar> all = model.composition().constants(model.step());
  StressFree::forget(all);
  const PetscReal pressure = stretched ? facts.prestress->pressure : 0;
  const PetscReal stretch = stretched ? inflated_J(law, pressure, all.data()).value_or(1) : 1;
  const LawRange range = law_range(law, all.data());
  const auto add = [&](OwnLimit::Kind kind, const LawRange::State &state, PetscReal share) {
    limits.push_back({kind, {state.J / stretch, state.pressure - pressure}, share, 0});
  };
  if (range.largest) add(OwnLimit::Kind::pressure, *range.largest, 0);
  if (range.softest && range.softest_share < no_stiffness)
    add(OwnLimit::Kind::plateau, *range.softest, range.softest_share);
  if (range.waves_below) add(OwnLimit::Kind::waves, *range.waves_below, 0);
  return limits;
}

} // namespace

const char *OwnLimit::name() const
{
  switch (kind) {
  case Kind::pressure:
    return "pressure";
  case Kind::plateau:
    return "plateau";
  case Kind::waves:
    break;
  }
  return "waves";
}

PetscErrorCode look_at_own_limit(const Scene &scene, const Model &model, Vec local, PetscReal lost_share,
                                 std::optional<OwnLimit> &found)
{
  std::vector<OwnLimit> limits = own_limits(scene, model);
  std::vector<PointSample> samples;
  Sampling sampling;

  PetscFunctionBeginUser;
  if (limits.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  std::vector<PetscReal> sums(limits.size() + 1);
  PetscCall(sampling.setup(model));
  {
    const ReadArray x(local);
    for (const Sampling::Element &cell : sampling.cells()) {
      const auto &weights = sampling.weights(cell);
      sampling.sample(cell, x.data(), samples);
      for (std::size_t q = 0; q < weights.size(); ++q) {
        const PetscReal J = 1 + samples[q].state.J_minus_1, volume = weights[q] * cell.measure;
        for (std::size_t i = 0; i < limits.size(); ++i)
          if (J > (1 - at_limit) * limits[i].at.J) sums[i] += volume;
        sums.back() += volume;
      }
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPIU_REAL, MPI_SUM,
                             PetscObjectComm((PetscObject)model.dm())));
  for (std::size_t i = 0; i < limits.size(); ++i) {
    // shear has a share in where it is lost, J alone does not tell
    limits[i].beyond = limits[i].kind == OwnLimit::Kind::waves ? lost_share : sums[i] / sums.back();
    if (limits[i].beyond > (found ? found->beyond : 0)) found = limits[i];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string own_limit_text(const Scene &scene, const OwnLimit &limit)
{
  std::ostringstream text;
  text.precision(4);
  const PetscReal pressure = limit.at.pressure / units::kPa_per_cmH2O;
  text << " The law's own limit: " << scene.tissue().law().name()
       << " in free inflation, p = dW/dJ with F = J^(1/3) I, ";
  switch (limit.kind) {
  case OwnLimit::Kind::pressure:
    text << "holds no more than " << pressure << " cmH2O (dp/dJ = 0 at J = " << limit.at.J << ")";
    break;
  case OwnLimit::Kind::plateau:
    text << "has next to no stiffness at J = " << limit.at.J << " and " << pressure << " cmH2O (dp/dJ is "
         << 100 * limit.stiffness_share << " % of that at rest)";
    break;
  case OwnLimit::Kind::waves:
    text << "is not elliptic below J = " << limit.at.J << " (" << pressure << " cmH2O)";
    break;
  }
  text << "; " << 100 * limit.beyond << " % of the lung is there or beyond.";
  return text.str();
}

} // namespace pulmo
