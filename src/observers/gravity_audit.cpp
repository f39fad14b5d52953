// Weight, gradient of J and thirds along gravity.
#include "pulmo/observers/gravity_audit.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <limits>

namespace pulmo {

namespace {

constexpr double g_per_kg_per_m3_mm3 = 1e-6, mm_per_cm = 10;

} // namespace

double GravityAudit::height(const PetscReal x[3]) const
{
  const auto &down = scene_.facts().gravity->down;
  return -(down[0] * x[0] + down[1] * x[1] + down[2] * x[2]) - middle_;
}

int GravityAudit::third(double height) const
{
  return std::clamp(static_cast<int>((height / extent_ + 0.5) * n_thirds), 0, n_thirds - 1);
}

PetscErrorCode GravityAudit::setup()
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  const auto mass = scene_.facts().gravity->mass.function;
  double ends[2]; // least height and least depth
  std::array<double, n_thirds + 4> sums{};
  VecHandle rest;
  std::vector<PointSample> samples;

  PetscFunctionBeginUser;
  middle_ = 0;
  ends[0] = ends[1] = std::numeric_limits<double>::max();
  for (const Sampling::Element &e : sampling_.cells())
    for (int corner = 0; corner < 4; ++corner) {
      PetscReal x[3]; // corner 0 is v0, the others are two units along an axis of the reference cell
      for (int d = 0; d < 3; ++d) x[d] = e.v0[d] + (corner > 0 ? 2 * e.J[3 * d + corner - 1] : 0);
      ends[0] = std::min(ends[0], height(x));
      ends[1] = std::min(ends[1], -height(x));
    }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, ends, 2, MPI_DOUBLE, MPI_MIN, comm));
  middle_ = (ends[0] - ends[1]) / 2;
  extent_ = -ends[1] - ends[0];
  PetscCall(DMCreateLocalVector(model_.dm(), rest.out()));
  PetscCall(VecZeroEntries(rest));
  {
    const ReadArray x(rest);
    for (const Sampling::Element &e : sampling_.cells()) {
      const auto &weights = sampling_.weights(e);
      const PetscScalar *constants = model_.constants_at(e.cell);
      sampling_.sample(e, x.data(), samples);
      for (std::size_t q = 0; q < weights.size(); ++q) {
        const double w = weights[q] * e.measure, h = height(samples[q].x);
        const Point point = sampling_.point(samples[q], e, 0, Step());
        sums[third(h)] += w / units::mm3_per_ml;
        sums[n_thirds] += w * mass(point, point, constants) * g_per_kg_per_m3_mm3;
        sums[n_thirds + 1] += w;
        sums[n_thirds + 2] += w * h;
        sums[n_thirds + 3] += w * h * h;
      }
    }
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPI_DOUBLE, MPI_SUM, comm));
  std::copy_n(sums.begin(), static_cast<int>(n_thirds), volumes_.begin());
  weight_ = sums[n_thirds];
  volume_ = sums[n_thirds + 1];
  mean_height_ = sums[n_thirds + 2] / volume_;
  height_variance_ = sums[n_thirds + 3] / volume_ - mean_height_ * mean_height_;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode GravityAudit::observe(const StepReport &step)
{
  std::array<double, n_thirds + 1> sums{};
  std::vector<PointSample> samples;
  Row row;

  PetscFunctionBeginUser;
  {
    const ReadArray x(step.local);
    for (const Sampling::Element &e : sampling_.cells()) {
      const auto &weights = sampling_.weights(e);
      sampling_.sample(e, x.data(), samples);
      for (std::size_t q = 0; q < weights.size(); ++q) {
        const double w = weights[q] * e.measure * samples[q].state.J_minus_1, h = height(samples[q].x);
        sums[third(h)] += w / units::mm3_per_ml;
        sums[n_thirds] += w * (h - mean_height_);
      }
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPI_DOUBLE, MPI_SUM,
                             PetscObjectComm((PetscObject)model_.dm())));
  std::copy_n(sums.begin(), static_cast<int>(n_thirds), row.volume_change.begin());
  row.gradient = sums[n_thirds] / volume_ / height_variance_ * mm_per_cm;
  rows_.push_back(row);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode GravityAudit::persist(Archive &archive, Vec)
{
  PetscFunctionBeginUser;
  PetscCall(archive.table("gravity", rows_, Row(), [](Row &row, TableCells &cells) {
    for (double &change : row.volume_change) cells(change);
    cells(row.gradient);
  }));
  PetscFunctionReturn(PETSC_SUCCESS);
}

double GravityAudit::mean_J(std::size_t row, int third) const
{
  return 1 + rows_[row].volume_change[third] / volumes_[third];
}

double GravityAudit::ventilation(const BreathRows &breath, int third) const
{
  return rows_[breath.fullest].volume_change[third] - rows_[breath.first].volume_change[third];
}

std::optional<double> GravityAudit::ventilation_share(const BreathRows &breath, int third) const
{
  double whole = 0;
  for (int t = 0; t < n_thirds; ++t) whole += ventilation(breath, t);
  return whole != 0 ? std::optional<double>(ventilation(breath, third) / whole) : std::nullopt;
}

} // namespace pulmo
