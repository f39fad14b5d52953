#include "pulmo/observers/regions.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/point_memory.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

/// Moments of J - 1 and of p - P over a region.
enum Moment { J1, J2, p1, p2, n_moments };

/// Two times of a run closer than this share are the same.
constexpr double same_time = 1e-9;

} // namespace

PetscErrorCode RegionAudit::setup()
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());

  const PetscReal everywhere = scene_.tissue().porosity().reference;
  double others = 0; // what parts with a porosity of their own have more, mm^3

  PetscFunctionBeginUser;
  PetscCall(scene_.mesh().regions(regions_));
  const std::size_t whole = regions_.size();
  regions_of_.assign(sampling_.cells().size(), {});
  for (std::size_t r = 0; r < whole; ++r)
    for (PetscInt c : regions_[r].cells) regions_of_[c].push_back(r);
  for (const RememberedIntegral &integral : model_.composition().integrals())
    if (!integral.column.empty()) columns_.push_back(integral);
  volumes_.assign(whole + 1, 0);
  for (std::size_t c = 0; c < regions_of_.size(); ++c) {
    regions_of_[c].push_back(whole);
    for (std::size_t r : regions_of_[c]) volumes_[r] += sampling_.cells()[c].measure / units::mm3_per_ml;
    if (scene_.tissue().porosity_varies())
      others += (porosity(static_cast<PetscInt>(c)).reference - everywhere) * sampling_.cells()[c].measure;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &others, 1, MPI_DOUBLE, MPI_SUM, comm));
  air_ = everywhere * scene_.mesh().volume() / units::mm3_per_ml + others / units::mm3_per_ml;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, volumes_.data(), static_cast<PetscMPIInt>(volumes_.size()), MPI_DOUBLE,
                             MPI_SUM, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

Porosity RegionAudit::porosity(PetscInt cell) const
{
  return constants::get<Porosity>(model_.constants_at(cell));
}

std::optional<double> RegionAudit::functional_residual_capacity() const
{
  return scene_.facts().airflow ? std::optional<double>(air_) : std::nullopt;
}

/// Appends the least porosity over points and corners of all cells, each with its own Phi0.
PetscErrorCode RegionAudit::follow_porosity(Vec local)
{
  const Assembly &assembly = model_.assembly();
  std::vector<PointState> states;
  double least = 1;

  PetscFunctionBeginUser;
  const ReadArray x(local);
  for (PetscInt c = 0; c < assembly.cells(); ++c) {
    const Porosity own = porosity(c);
    assembly.point_states(c, x.data(), states);
    for (const PointState &s : states) least = std::min<double>(least, own.at(s.J));
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &least, 1, MPI_DOUBLE, MPI_MIN, PetscObjectComm((PetscObject)model_.dm())));
  least_porosity_.push_back(least);
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<double> RegionAudit::least_porosity(const std::vector<SignalRow> &rows) const
{
  if (scene_.tissue().porosity_varies()) return least_porosity_;
  std::vector<double> list;
  for (const SignalRow &row : rows) list.push_back(scene_.tissue().porosity().at(row.min_J));
  return list;
}

/// Fills the columns of all regions from what effects remember.
PetscErrorCode RegionAudit::integrate_columns(std::vector<RegionState> &states) const
{
  const std::size_t n = columns_.size();
  std::vector<double> sums(states.size() * n, 0);
  std::vector<PetscScalar> means;

  PetscFunctionBeginUser;
  for (std::size_t i = 0; i < n; ++i) {
    model_.memory()->means(*model_.composition().remembered_in_cells(columns_[i].effect), columns_[i].quantity, means);
    for (std::size_t c = 0; c < regions_of_.size(); ++c)
      for (std::size_t r : regions_of_[c]) sums[r * n + i] += sampling_.cells()[c].measure * means[c];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPI_DOUBLE, MPI_SUM,
                             PetscObjectComm((PetscObject)model_.dm())));
  for (std::size_t r = 0; r < states.size(); ++r)
    for (std::size_t i = 0; i < n; ++i) {
      const double factor = columns_[i].mean ? 1 / (volumes_[r] * units::mm3_per_ml) : columns_[i].factor;
      states[r].columns.push_back(factor * sums[r * n + i]);
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode RegionAudit::observe(const StepReport &step)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  const double airway = step.row.pressure * units::kPa_per_cmH2O;
  const bool gas = scene_.facts().airflow;
  std::vector<double> sums(volumes_.size() * n_moments, 0);
  std::vector<PointSample> samples;
  std::vector<RegionState> states(volumes_.size());

  PetscFunctionBeginUser;
  breath_end_ = step.breath_end;
  {
    const ReadArray x(step.local);
    for (std::size_t c = 0; c < regions_of_.size(); ++c) {
      const Sampling::Element &e = sampling_.cells()[c];
      const auto &weights = sampling_.weights(e);
      double cell[n_moments] = {0, 0, 0, 0};
      sampling_.sample(e, x.data(), samples);
      for (std::size_t q = 0; q < weights.size(); ++q) {
        const double w = weights[q] * e.measure, J = samples[q].state.J_minus_1, p = gas ? samples[q].p - airway : 0;
        cell[J1] += w * J;
        cell[J2] += w * J * J;
        cell[p1] += w * p;
        cell[p2] += w * p * p;
      }
      for (std::size_t r : regions_of_[c])
        for (int m = 0; m < n_moments; ++m) sums[r * n_moments + m] += cell[m];
    }
  }
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPI_DOUBLE, MPI_SUM, comm));
  for (std::size_t r = 0; r < states.size(); ++r) {
    const double *sum = &sums[r * n_moments], V = volumes_[r] * units::mm3_per_ml;
    const auto spread = [V](double first, double second) {
      return std::sqrt(std::max(second / V - (first / V) * (first / V), 0.0));
    };
    states[r].volume_change = sum[J1] / units::mm3_per_ml;
    states[r].mean_J = 1 + sum[J1] / V;
    states[r].sd_J = spread(sum[J1], sum[J2]);
    states[r].mean_pressure = (airway + sum[p1] / V) / units::kPa_per_cmH2O;
    states[r].sd_pressure = spread(sum[p1], sum[p2]) / units::kPa_per_cmH2O;
  }
  if (!columns_.empty()) PetscCall(integrate_columns(states));
  rows_.push_back(std::move(states));
  if (gas && scene_.tissue().porosity_varies()) PetscCall(follow_porosity(step.local));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode RegionAudit::persist(Archive &archive, Vec)
{
  RegionState nothing;
  nothing.columns.assign(columns_.size(), 0);
  const std::vector<RegionState> empty(volumes_.size(), nothing);

  PetscFunctionBeginUser;
  PetscCall(archive.value("regions_breath_end_s", breath_end_)); // a run that goes on may accept no further step
  PetscCall(archive.table("regions", rows_, empty, [](std::vector<RegionState> &row, TableCells &cells) {
    for (RegionState &s : row) {
      cells(s.volume_change, s.mean_J, s.sd_J, s.mean_pressure, s.sd_pressure);
      for (double &column : s.columns) cells(column);
    }
  }));
  if (scene_.facts().airflow && scene_.tissue().porosity_varies())
    PetscCall(
        archive.table("least_porosity", least_porosity_, 0.0, [](double &row, TableCells &cells) { cells(row); }));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<SignalRow> RegionAudit::complete(std::vector<SignalRow> rows) const
{
  const SceneFacts &facts = scene_.facts();
  for (std::size_t i = 0; i < rows.size(); ++i) {
    if (facts.airflow) rows[i].alveolar_pressure = rows_[i].back().mean_pressure;
    rows[i].flow_resistance = facts.airflow || facts.tube;
    rows[i].rest_volume = scene_.mesh().volume() / units::mm3_per_ml;
  }
  if (facts.ventilator && rows.back().breath > 0) {
    if (rows.back().time < breath_end_ * (1 - same_time)) rows.back().cut = breath_end_;
  }
  return rows;
}

double RegionAudit::ventilation(const BreathRows &breath, std::size_t region) const
{
  return state(breath.fullest, region).volume_change - state(breath.first, region).volume_change;
}

std::optional<double> RegionAudit::ventilation_share(const BreathRows &breath, std::size_t region) const
{
  const double whole = ventilation(breath, regions_.size());
  return whole != 0 ? std::optional<double>(ventilation(breath, region) / whole) : std::nullopt;
}

} // namespace pulmo
