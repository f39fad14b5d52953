#include "pulmo/output.hpp"
#include "pulmo/units.hpp"

#include <nlohmann/json.hpp>

#include <cmath>
#include <fstream>

namespace pulmo {

namespace {

using Json = nlohmann::ordered_json;

Json optional_json(const std::optional<double> &v)
{
  return v ? Json(*v) : Json(nullptr);
}

/// One number of a breath: its key in summary.json, how it is printed, and its value.
struct Entry {
  const char *key, *label, *unit;
  std::optional<double> value;
};

/// All numbers of a breath in the order of the table. @p frc: gas volume at rest, ml.
std::vector<Entry> entries(const ClinicalNumbers &n, const std::optional<double> &frc)
{
  const auto strain = frc ? std::optional<double>(n.tidal_volume / *frc) : std::nullopt;
  return {
      {"peak_inspiratory_pressure_cmH2O", "peak inspiratory pressure", "cmH2O", n.peak_pressure},
      {"plateau_pressure_cmH2O", "plateau pressure", "cmH2O", n.plateau_pressure},
      {"peep_cmH2O", "PEEP", "cmH2O", n.peep},
      {"auto_peep_cmH2O", "auto-PEEP", "cmH2O", n.auto_peep},
      {"total_peep_cmH2O", "total PEEP", "cmH2O", n.total_peep},
      {"driving_pressure_cmH2O", "driving pressure", "cmH2O", n.driving_pressure},
      {"tidal_volume_ml", "tidal volume", "ml", n.tidal_volume},
      {"trapped_volume_ml", "trapped volume", "ml", n.trapped_volume},
      {"peak_flow_ml_per_s", "peak inspiratory flow", "ml/s", n.peak_flow},
      {"peak_expiratory_flow_ml_per_s", "peak expiratory flow", "ml/s", n.peak_expiratory_flow},
      {"compliance_ml_per_cmH2O", "compliance C_rs (fit)", "ml/cmH2O", n.compliance},
      {"resistance_cmH2O_s_per_l", "resistance R (fit)", "cmH2O s/l", n.resistance},
      {"time_constant_s", "time constant R C_rs", "s", n.time_constant},
      {"static_compliance_ml_per_cmH2O", "static compliance", "ml/cmH2O", n.static_compliance},
      {"dynamic_compliance_ml_per_cmH2O", "dynamic compliance", "ml/cmH2O", n.dynamic_compliance},
      {"static_curve_compliance_ml_per_cmH2O", "slope of the static curve", "ml/cmH2O", n.static_curve_compliance},
      {"pause_resistance_cmH2O_s_per_l", "resistance from the pause", "cmH2O s/l", n.pause_resistance},
      {"work_j", "work of (P - PEEP)", "J", n.work},
      {"mechanical_power_j_per_min", "mechanical power", "J/min", n.mechanical_power},
      {"strain", "strain V_T/FRC", "", strain},
  };
}

void add_numbers(Json &json, const ClinicalNumbers &n, const std::optional<double> &frc)
{
  for (const Entry &e : entries(n, frc)) json[e.key] = optional_json(e.value);
}

/// The same keys for a run without a breath.
void add_no_numbers(Json &json)
{
  for (const Entry &e : entries({}, {})) json[e.key] = nullptr;
}

/// Gas volume at rest, ml: Phi0 V0 (empty without airflow, where no porosity is given).
std::optional<double> functional_residual_capacity(const Scene &scene)
{
  if (!scene.facts().airflow) return std::nullopt;
  return scene.airflow().porosity() * scene.mesh().volume() / units::mm3_per_ml;
}

/// The end of every pause of the run.
Json static_curve(const std::vector<SignalRow> &rows)
{
  Json curve = Json::array();
  for (const StaticPoint &point : static_points(rows, 0, rows.size() - 1)) {
    const SignalRow &r = rows[point.row];
    curve.push_back({{"time_s", r.time},
                     {"phase", point.phase},
                     {"volume_ml", r.volume},
                     {"pressure_cmH2O", r.machine_pressure()}});
  }
  return curve;
}

/// Rows of the balance with their signs as listed.
Json energy_json(const EnergyAudit &audit, const EnergyBalance &balance)
{
  Json json;
  json["ventilator_work"] = balance.ventilator_work;
  for (std::size_t i = 0; i < balance.accounts.size(); ++i) json[audit.accounts()[i].name] = balance.accounts[i];
  json["residual"] = balance.residual;
  json["residual_relative"] = balance.relative_residual();
  return json;
}

/// The rows that regions are compared at: those of the last breath, or of the whole run without one.
BreathRows last_breath(const std::vector<SignalRow> &rows)
{
  const auto breaths = breath_rows(rows);
  return breaths.empty() ? BreathRows{0, rows.size() - 1, rows.size() - 1} : breaths.back();
}

/// What a region took in during a breath, ml.
double ventilation(const RegionAudit &audit, const BreathRows &breath, std::size_t region)
{
  return audit.state(breath.fullest, region).volume_change - audit.state(breath.first, region).volume_change;
}

/// The same as a share of the whole lung's.
std::optional<double> ventilation_share(const RegionAudit &audit, const BreathRows &breath, std::size_t region)
{
  const double whole = ventilation(audit, breath, audit.regions().size());
  return whole != 0 ? std::optional<double>(ventilation(audit, breath, region) / whole) : std::nullopt;
}

Json regions_json(const RegionAudit &audit, const BreathRows &breath, bool gas)
{
  Json json = Json::object();
  for (std::size_t r = 0; r < audit.regions().size(); ++r) {
    const RegionState &s = audit.state(breath.fullest, r);
    const auto pressure_json = [gas](double p) { return gas ? Json(p) : Json(nullptr); };
    json[audit.regions()[r].name] = {{"connected_body", audit.regions()[r].body},
                                     {"reference_volume_ml", audit.volume(r)},
                                     {"ventilation_ml", ventilation(audit, breath, r)},
                                     {"ventilation_share", optional_json(ventilation_share(audit, breath, r))},
                                     {"jacobian_mean", s.mean_J},
                                     {"jacobian_sd", s.sd_J},
                                     {"alveolar_pressure_mean_cmH2O", pressure_json(s.mean_pressure)},
                                     {"alveolar_pressure_sd_cmH2O", pressure_json(s.sd_pressure)}};
  }
  return json;
}

} // namespace

PetscErrorCode write_summary(const Options &options, const Output &output, const Scene &scene, const Model &model,
                             const Simulation &simulation, const Audits &audits, bool finished)
{
  const MPI_Comm comm = options.comm();
  PetscMPIInt rank, size;
  PetscInt dofs;
  std::vector<std::pair<std::string, std::string>> used;
  std::ofstream f;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(VecGetSize(simulation.state(), &dofs));
  PetscCall(options.all_used(used));
  const std::string file = output.path(finished ? "summary.json" : "failure.json");
  if (rank == 0) {
    Json json;
    json["finished"] = finished;
    if (!finished) json["failure"] = simulation.failure_text();
    const auto frc = functional_residual_capacity(scene);
    const std::vector<SignalRow> rows = audits.regions.complete(simulation.rows());
    if (scene.facts().ventilator) {
      if (breath_rows(rows).empty())
        add_no_numbers(json);
      else
        add_numbers(json, overall_numbers(rows), frc);
      json["static_curve"] = static_curve(rows);
      json["breaths"] = Json::array();
      for (const BreathRows &b : breath_rows(rows)) {
        Json breath;
        add_numbers(breath, clinical_numbers(rows, b.first, b.last), frc);
        if (audits.energy) {
          const auto &energy = audits.energy->rows();
          breath["energy_j"] = energy_json(*audits.energy, energy[b.last] - energy[b.first]);
          breath["inspiratory_energy_j"] = energy_json(*audits.energy, energy[b.fullest] - energy[b.first]);
        }
        json["breaths"].push_back(breath);
      }
    }
    if (audits.energy) json["energy_j"] = energy_json(*audits.energy, audits.energy->rows().back());
    const bool gas = scene.facts().airflow || scene.facts().ventilator;
    json["regions"] = regions_json(audits.regions, last_breath(rows), gas);
    json["functional_residual_capacity_ml"] = optional_json(frc);
    json["reference_volume_ml"] = scene.mesh().volume() / units::mm3_per_ml;
    PetscReal total = 0;
    Json areas;
    for (const auto &[name, surface] : scene.mesh().surfaces()) {
      total += surface.area;
      areas[name] = surface.area;
      if (name == "airway") json["airway_area_mm2"] = surface.area;
    }
    json["surface_area_mm2"] = total;
    json["surface_areas_mm2"] = areas;
    if (scene.facts().airflow) json["mass_balance_error_ml"] = simulation.mass_balance_error() / units::mm3_per_ml;
    if (model.composition().supported())
      json["support_reaction_n"] = simulation.support_reaction() * units::newton_per_kPa_mm2;
    json["min_jacobian"] = simulation.min_J();
    if (scene.facts().airflow) json["min_porosity"] = 1 - (1 - scene.airflow().porosity()) / simulation.min_J();
    json["end_time_s"] = simulation.time();
    json["steps"] = simulation.rows().size() - 1;
    json["rejected_steps"] = simulation.rejected_steps();
    long newton = 0, krylov = 0;
    for (const SignalRow &row : simulation.rows()) {
      newton += row.newton;
      krylov += row.krylov;
    }
    json["newton_iterations"] = newton;
    json["krylov_iterations"] = krylov;
    const StageSeconds &s = simulation.seconds();
    json["wall_seconds"] = {{"setup", s.setup}, {"residual", s.residual}, {"jacobian", s.jacobian},
                            {"solve", s.solve}, {"output", s.output},     {"total", s.total}};
    json["cells"] = scene.mesh().cells();
    json["dofs"] = dofs;
    json["ranks"] = size;
    json["tissue"] = scene.tissue().law().name();
    json["effects"] = Json::array();
    for (const Effect *effect : scene.active()) json["effects"].push_back(effect->name());
    json["integration"] = model.own_integration() ? "pulmo" : "basic";
    json["version"] = PULMO_VERSION;
    Json list;
    for (const auto &[name, value] : used) list[name] = value;
    json["options"] = list;

    f.open(file + ".part");
    f << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
  }
  PetscCall(finish_file(comm, f, file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode write_energy(MPI_Comm comm, const Output &output, const Simulation &simulation, const EnergyAudit &audit)
{
  const std::string file = output.path("energy.csv");
  PetscMPIInt rank;
  std::ofstream f;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) {
    f.open(file + ".part");
    f.precision(15);
    f << "time_s,ventilator_work_j";
    for (const EnergyAccount &a : audit.accounts()) f << "," << a.name << "_j";
    f << ",residual_j\n";
    for (std::size_t i = 0; i < audit.rows().size(); ++i) {
      const EnergyBalance &b = audit.rows()[i];
      f << simulation.rows()[i].time << "," << b.ventilator_work;
      for (double a : b.accounts) f << "," << a;
      f << "," << b.residual << "\n";
    }
  }
  PetscCall(finish_file(comm, f, file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// The balance of the last breath (without one: of the run), beside that of its filling.
PetscErrorCode print_energy(MPI_Comm comm, const EnergyAudit &audit, const BreathRows &breath, const char *span)
{
  const EnergyBalance whole = audit.rows()[breath.last] - audit.rows()[breath.first],
                      filling = audit.rows()[breath.fullest] - audit.rows()[breath.first];
  const auto line = [comm](const std::string &name, double a, double b) {
    return PetscPrintf(comm, "  %-28s %12.4g %12.4g J\n", name.c_str(), a, b);
  };

  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(comm, "\n%-30s %12s %12s\n", "Energy", span, "to the peak"));
  PetscCall(line("ventilator_work", whole.ventilator_work, filling.ventilator_work));
  for (std::size_t i = 0; i < audit.accounts().size(); ++i)
    if (whole.accounts[i] != 0 || filling.accounts[i] != 0)
      PetscCall(line((audit.accounts()[i].kind == Energy::external ? "+ " : "- ") + audit.accounts()[i].name,
                     whole.accounts[i], filling.accounts[i]));
  PetscCall(line("= residual", whole.residual, filling.residual));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_regions(MPI_Comm comm, const RegionAudit &audit, const BreathRows &breath)
{
  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(comm, "\n%-18s %10s %14s %7s %8s %8s %12s %8s\n", "Region", "rest ml", "ventilation ml",
                        "share", "J", "+-", "P cmH2O", "+-"));
  for (std::size_t r = 0; r < audit.regions().size(); ++r) {
    const RegionState &s = audit.state(breath.fullest, r);
    PetscCall(PetscPrintf(comm, "  %-16s %10.4g %14.4g %6.1f%% %8.4f %8.4f %12.4g %8.2g\n",
                          audit.regions()[r].name.c_str(), audit.volume(r), ventilation(audit, breath, r),
                          100 * ventilation_share(audit, breath, r).value_or(0), s.mean_J, s.sd_J, s.mean_pressure,
                          s.sd_pressure));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode print_numbers(MPI_Comm comm, const Output &output, const Scene &scene, const Simulation &simulation,
                             const Audits &audits)
{
  const std::vector<SignalRow> rows = audits.regions.complete(simulation.rows());
  const BreathRows breath = last_breath(rows);

  PetscFunctionBeginUser;
  const bool breathes = !breath_rows(rows).empty();
  if (breathes) {
    PetscCall(PetscPrintf(comm,
                          "\n%s tissue, %.0f ml at rest: clinical numbers of the last breath (fits over all breaths)\n",
                          scene.tissue().law().name(), (double)(scene.mesh().volume() / units::mm3_per_ml)));
    for (const Entry &e : entries(overall_numbers(rows), functional_residual_capacity(scene))) {
      if (!e.value) continue;
      const double shown = std::abs(*e.value) < 1e-9 ? 0 : *e.value; // what the solver left of a zero
      PetscCall(PetscPrintf(comm, "  %-28s %12.4g %s\n", e.label, shown, e.unit));
    }
  }
  if (audits.energy) PetscCall(print_energy(comm, *audits.energy, breath, breathes ? "breath" : "run"));
  if (audits.regions.regions().size() > 1) PetscCall(print_regions(comm, audits.regions, breath));
  PetscCall(PetscPrintf(comm, "\nSmallest J %.4f", (double)simulation.min_J()));
  if (scene.facts().airflow)
    PetscCall(PetscPrintf(comm, "; air lost by the numbers: %.2g ml",
                          (double)(simulation.mass_balance_error() / units::mm3_per_ml)));
  PetscCall(PetscPrintf(comm, ".\nWrote %s, %s, %s.\n", output.path("signals.csv").c_str(),
                        output.path("summary.json").c_str(), output.path("fields.xdmf").c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_ledger(MPI_Comm comm, const Scene &scene, const Model &model, const StageSeconds &seconds)
{
  const IntegrationLog &log = model.assembly().log();
  const Composition &composition = model.composition();
  const auto &fields = composition.fields();
  std::map<std::string, double> spent;
  double timed = 0;

  PetscFunctionBeginUser;
  auto left = log.seconds;
  // what was timed, scaled up; a callback of several terms counts for the first that registered it
  const double scale =
      log.timed_cells > 0 ? (double)(log.residual_cells + log.jacobian_cells) / (double)log.timed_cells : 0;
  const auto charge = [&](auto callback, const std::string &effect, double factor) {
    const auto entry = left.find(reinterpret_cast<void (*)(void)>(callback));
    if (!callback || entry == left.end()) return;
    spent[effect] += entry->second * factor;
    left.erase(entry);
  };
  for (const Term &t : composition.terms()) {
    for (auto f : {t.f0, t.f1}) charge(f, t.effect, scale);
    for (auto g : {t.g0, t.g1, t.g2, t.g3}) charge(g, t.effect, scale);
    for (auto f : {t.bd_f0, t.bd_f1}) charge(f, t.effect, 1);
    for (auto g : {t.bd_g0, t.bd_g1, t.bd_g2, t.bd_g3}) charge(g, t.effect, 1);
  }
  for (const auto &[effect, s] : spent) timed += s;
  PetscCall(PetscPrintf(
      comm, "\nEffects of this scene (seconds in its terms; one block of cells in %d is timed)\n%-16s %-22s %-9s %s\n",
      (int)Assembly::timed_share, "effect", "fields", "seconds", "share of run, terms, blocks"));
  for (const Effect *effect : scene.active()) {
    const std::string name = effect->name();
    std::string own_fields, terms;
    for (const FieldSpec &f : fields)
      if (f.effect == name) own_fields += (own_fields.empty() ? "" : ", ") + f.name + " P" + std::to_string(f.degree);
    for (const Term &t : composition.terms()) {
      if (t.effect != name) continue;
      const std::string where = t.surface.empty() ? "" : " on " + t.surface;
      if (t.trial < 0)
        terms += "\n    " + t.name + where + "  (row " + fields[t.test].name + ")";
      else
        terms += "\n    " + t.name + where + "  [" + fields[t.test].name + ", " + fields[t.trial].name + "]";
    }
    for (const Constraint &c : composition.constraints())
      if (c.effect == name)
        terms += "\n    " + c.name + " prescribed" + (c.surface.empty() ? " at vertices" : " on " + c.surface) + "  (" +
                 fields[c.field].name + ")";
    PetscCall(PetscPrintf(comm, "%-16s %-22s %9.4f %5.1f %%%s\n", name.c_str(),
                          own_fields.empty() ? "-" : own_fields.c_str(), spent[name],
                          seconds.total > 0 ? 100 * spent[name] / seconds.total : 0, terms.c_str()));
  }
  const double residual_points = log.residual_cells > 0 ? (double)log.residual_calls / (double)log.residual_cells : 0;
  const double jacobian_points = log.jacobian_cells > 0 ? (double)log.jacobian_calls / (double)log.jacobian_cells : 0;
  PetscCall(PetscPrintf(
      comm,
      "callbacks per cell: residual %.0f, Jacobian %.0f; run: setup %.3f s, residual %.3f s, Jacobian %.3f s, "
      "solve %.3f s, output %.3f s (callbacks above %.3f s)\n",
      residual_points, jacobian_points, seconds.setup, seconds.residual, seconds.jacobian, seconds.solve,
      seconds.output, timed));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
