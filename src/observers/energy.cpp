#include "pulmo/observers/energy.hpp"

#include "pulmo/fem/point_memory.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo {

namespace {

constexpr double j_per_cmH2O_ml = units::kPa_per_cmH2O * units::mm3_per_ml * units::j_per_kPa_mm3;

/// The rows of the balance that every run lists, in this order.
const EnergyAccount usual_accounts[] = {
    {"external", Energy::external},         {"elastic_tissue", Energy::stored},
    {"elastic_springs", Energy::stored},    {"resistive", Energy::dissipated},
    {"resistive_tube", Energy::dissipated}, {"numerical_dissipation", Energy::numerical}};

} // namespace

EnergyBalance EnergyBalance::operator-(const EnergyBalance &other) const
{
  EnergyBalance d = *this;
  d.ventilator_work -= other.ventilator_work;
  d.exchanged -= other.exchanged;
  d.residual -= other.residual;
  for (std::size_t i = 0; i < d.accounts.size(); ++i) d.accounts[i] -= other.accounts[i];
  return d;
}

double EnergyBalance::relative_residual() const
{
  return exchanged > 0 ? std::abs(residual) / exchanged : 0;
}

double EnergyAudit::worst_residual() const
{
  double worst = 0;
  for (const EnergyBalance &row : rows_) worst = std::max(worst, std::abs(row.residual));
  return worst;
}

double EnergyAudit::least_work() const
{
  constexpr double strain = 1e-6;
  return model_.modulus() * scene_.mesh().volume() * strain * strain * units::j_per_kPa_mm3;
}

double EnergyAudit::worst_share() const
{
  return worst_residual() / std::max(rows_.back().exchanged, least_work());
}

std::optional<double> EnergyAudit::relative_residual(const EnergyBalance &balance) const
{
  // without any work and residual there is nothing wrong, and 0 says so
  if (balance.exchanged < least_work() && balance.residual != 0) return {};
  return balance.relative_residual();
}

std::size_t EnergyAudit::account(const std::string &name, Energy kind)
{
  const auto found =
      std::find_if(accounts_.begin(), accounts_.end(), [&](const EnergyAccount &a) { return a.name == name; });
  if (found != accounts_.end()) return static_cast<std::size_t>(found - accounts_.begin());
  accounts_.push_back({name, kind});
  return accounts_.size() - 1;
}

PetscErrorCode EnergyAudit::setup()
{
  PetscSection section;
  PetscInt begin, end;
  std::map<std::string, std::size_t> part_of; // surface -> parts_

  PetscFunctionBeginUser;
  accounts_.assign(std::begin(usual_accounts), std::end(usual_accounts));
  for (const EnergyTerm &term : model_.composition().energies()) {
    const auto [entry, is_new] = part_of.try_emplace(term.surface, parts_.size());
    if (is_new) {
      parts_.emplace_back();
      parts_.back().surface = term.surface;
      if (term.surface.empty())
        parts_.back().elements = sampling_.cells();
      else
        PetscCall(sampling_.surface(scene_.mesh(), term.surface, parts_.back().elements));
    }
    Part &part = parts_[entry->second];
    part.terms.push_back(&term);
    part.account.push_back(account(term.account, term.kind));
  }
  for (const ScalarEnergyTerm &term : model_.composition().scalar_energies()) (void)account(term.account, term.kind);
  PetscCall(DMCreateLocalVector(model_.dm(), before_.out()));
  PetscCall(DMGetLocalSection(model_.dm(), &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt n, offset;
    const PetscInt *components;
    PetscCall(PetscSectionGetFieldConstraintDof(section, p, displacement, &n));
    if (n == 0) continue;
    PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
    PetscCall(PetscSectionGetFieldConstraintIndices(section, p, displacement, &components));
    for (PetscInt i = 0; i < n; ++i) held_.push_back(offset + components[i]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode EnergyAudit::persist(Archive &archive, Vec local)
{
  EnergyBalance empty;

  PetscFunctionBeginUser;
  empty.accounts.assign(accounts_.size(), 0);
  PetscCall(archive.table("energy", rows_, empty, [](EnergyBalance &row, TableCells &cells) {
    cells(row.ventilator_work, row.exchanged, row.residual);
    for (double &sum : row.accounts) cells(sum);
  }));
  PetscCall(archive.value("energy/gas_pressure_kPa", gas_pressure_));
  if (archive.reading()) PetscCall(VecCopy(local, before_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode EnergyAudit::integrate(const Part &part, const StepReport &step, std::vector<double> &sums)
{
  std::vector<PointSample> now, before;
  const PetscReal t = step.row.time, dt = step.row.dt;
  Step step_now(dt), step_before(dt);

  PetscFunctionBeginUser;
  step_now.load = model_.load();
  step_now.gas_pressure = step.row.pressure * units::kPa_per_cmH2O;
  step_before.gas_pressure = gas_pressure_;
  const ReadArray x(step.local), x_before(before_);
  const PointMemory::Room *room = model_.memory() ? model_.memory()->room(part.surface) : nullptr;
  for (std::size_t i = 0; i < part.elements.size(); ++i) {
    const Sampling::Element &e = part.elements[i];
    const auto &weights = sampling_.weights(e);
    const PetscScalar *constants = model_.constants_at(e.cell, part.surface);
    sampling_.sample(e, x.data(), now);
    sampling_.sample(e, x_before.data(), before);
    for (std::size_t q = 0; q < weights.size(); ++q) {
      Sampling::make_rates(before[q], dt, now[q]);
      const Memory memory = room ? room->at(static_cast<PetscInt>(i), static_cast<PetscInt>(q)) : Memory();
      const Point a = sampling_.point(now[q], e, t, step_now, memory),
                  b = sampling_.point(before[q], e, t - dt, step_before, memory);
      for (std::size_t k = 0; k < part.terms.size(); ++k)
        sums[part.account[k]] += weights[q] * e.measure * part.terms[k]->density(a, b, constants);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode EnergyAudit::add_support_work(const StepReport &step, double &sum)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  int moved = 0;

  PetscFunctionBeginUser;
  {
    const ReadArray x(step.local), x_before(before_);
    for (PetscInt dof : held_) moved = moved || x[dof] != x_before[dof];
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &moved, 1, MPI_INT, MPI_LOR, comm));
  if (!moved) PetscFunctionReturn(PETSC_SUCCESS);
  // the residual of a held row is the force that its support bears
  const ReadArray x(step.local), x_before(before_), f(step.residual);
  for (PetscInt dof : held_) sum += f[dof] / model_.row_scale(displacement) * (x[dof] - x_before[dof]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

void EnergyAudit::add_scalars(const StepReport &step, std::vector<double> &sums)
{
  const SignalRow &row = step.row, &last = step.rows[step.rows.size() - 2];
  const auto state = [&](const ScalarGroup &group, const SignalRow &at) {
    ScalarState s;
    s.opening = at.pressure * units::kPa_per_cmH2O;
    for (std::size_t i = group.offset; i < group.offset + group.scalars.size(); ++i) {
      const auto value = [i](const SignalRow &r) {
        return r.scalars.empty() ? 0 : r.scalars[i] * units::kPa_per_cmH2O;
      };
      s.value.push_back(value(at));
      s.rate.push_back((value(row) - value(last)) / row.dt);
      s.flow.push_back(at.scalar_flows.empty() ? 0 : at.scalar_flows[i] * units::mm3_per_ml);
    }
    return s;
  };
  for (const ScalarEnergyTerm &term : model_.composition().scalar_energies())
    for (const ScalarGroup &group : model_.composition().scalar_groups())
      if (group.effect == term.effect)
        sums[account(term.account, term.kind)] += term.energy(state(group, row), state(group, last), row.dt);
}

PetscErrorCode EnergyAudit::observe(const StepReport &step)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)model_.dm());
  const SignalRow &row = step.row;
  EnergyBalance balance;

  PetscFunctionBeginUser;
  if (rows_.empty()) {
    balance.accounts.assign(accounts_.size(), 0);
  } else {
    std::vector<double> sums(accounts_.size(), 0);
    balance = rows_.back();
    for (const Part &part : parts_) PetscCall(integrate(part, step, sums));
    PetscCall(add_support_work(step, sums[account("external", Energy::external)]));
    PetscCallMPI(
        MPI_Allreduce(MPI_IN_PLACE, sums.data(), static_cast<PetscMPIInt>(sums.size()), MPI_DOUBLE, MPI_SUM, comm));
    if (!row.scalars.empty()) add_scalars(step, sums);
    for (double &sum : sums) sum *= units::j_per_kPa_mm3;
    const double volume = (row.flow + row.stored_flow) * row.dt,
                 work = row.machine_pressure() * volume * j_per_cmH2O_ml;
    sums[account("resistive_tube", Energy::dissipated)] +=
        (row.machine_pressure() - row.pressure) * volume * j_per_cmH2O_ml;
    balance.ventilator_work += work;
    balance.exchanged += std::max(work, 0.0);
    balance.residual += work;
    for (std::size_t i = 0; i < sums.size(); ++i) {
      const bool given = accounts_[i].kind == Energy::external;
      balance.accounts[i] += sums[i];
      balance.residual += given ? sums[i] : -sums[i];
      if (given) balance.exchanged += std::max(sums[i], 0.0);
    }
  }
  rows_.push_back(balance);
  gas_pressure_ = row.pressure * units::kPa_per_cmH2O;
  PetscCall(VecCopy(step.local, before_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
