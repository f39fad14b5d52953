// summary.json and energy.csv.
#include "pulmo/base/units.hpp"
#include "pulmo/fem/free_boundary.hpp"
#include "pulmo/observers/ledger.hpp"
#include "pulmo/observers/output.hpp"

#include <nlohmann/json.hpp>

#include <algorithm>
#include <fstream>

namespace pulmo {

namespace {

using Json = nlohmann::ordered_json;

Json optional_json(const std::optional<double> &v)
{
  return v ? Json(*v) : Json(nullptr);
}

/// A breath; one that was cut has null for each number, and the fit over the rows that there are.
Json breath_json(const std::vector<SignalRow> &rows, const BreathRows &b, const std::optional<double> &frc)
{
  const ClinicalNumbers numbers = clinical_numbers(rows, b.first, b.last);
  Json json;
  json["complete"] = b.complete;
  json["start_s"] = rows[b.first].time;
  json["end_of_inspiration_s"] = b.complete && numbers.takes_in ? Json(rows[b.fullest].time) : Json(nullptr);
  json["end_s"] = rows[b.last].time;
  for (const ClinicalEntry &e : clinical_entries(numbers, frc))
    json[e.key] = b.complete ? optional_json(e.value) : Json(nullptr);
  if (!b.complete)
    json["fit_until_cut"] = {{"compliance_ml_per_cmH2O", optional_json(numbers.compliance)},
                             {"resistance_cmH2O_s_per_l", optional_json(numbers.resistance)}};
  return json;
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

/// The ways on past limit points, each until a prescribed pressure was held again or the run ended.
Json limit_points(const std::vector<SignalRow> &rows)
{
  Json list = Json::array();
  for (std::size_t i = 1; i < rows.size(); ++i) {
    if (!rows[i].past_limit || rows[i - 1].past_limit) continue;
    std::size_t last = i;
    while (last + 1 < rows.size() && rows[last + 1].past_limit) ++last;
    const SignalRow &begin = rows[i - 1];
    list.push_back({{"phase", rows[i].phase},
                    {"time_s", begin.time},
                    {"volume_ml", begin.volume},
                    {"pressure_cmH2O", begin.machine_pressure()},
                    {"flow_ml_per_s", std::abs(rows[i].volume - begin.volume) / rows[i].dt},
                    {"end_s", rows[last].time},
                    {"end_volume_ml", rows[last].volume},
                    {"end_phase", rows[last].phase}});
  }
  return list;
}

/// Rows of the balance with their signs as listed.
Json energy_json(const EnergyAudit &audit, const EnergyBalance &balance)
{
  Json json;
  json["ventilator_work"] = balance.ventilator_work;
  for (std::size_t i = 0; i < balance.accounts.size(); ++i) json[audit.accounts()[i].name] = balance.accounts[i];
  json["residual"] = balance.residual;
  const auto relative = audit.relative_residual(balance);
  json["residual_relative"] = relative ? Json(*relative) : Json(nullptr);
  return json;
}

/// The columns of effects in a region at a row of the signals.
Json columns_json(const RegionAudit &audit, std::size_t row, std::size_t region)
{
  Json json = Json::object();
  for (std::size_t i = 0; i < audit.columns().size(); ++i)
    json[audit.columns()[i].column] = audit.state(row, region).columns[i];
  return json;
}

Json regions_json(const RegionAudit &audit, const BreathRows &breath, bool gas)
{
  Json json = Json::object();
  for (std::size_t r = 0; r < audit.regions().size(); ++r) {
    const RegionState &s = audit.state(breath.fullest, r);
    const auto pressure_json = [gas](double p) { return gas ? Json(p) : Json(nullptr); };
    Json &region = json[audit.regions()[r].name];
    region = {{"number", r + 1},
              {"connected_body", audit.regions()[r].body},
              {"reference_volume_ml", audit.volume(r)},
              {"ventilation_ml", audit.ventilation(breath, r)},
              {"ventilation_share", optional_json(audit.ventilation_share(breath, r))},
              {"jacobian_mean", s.mean_J},
              {"jacobian_sd", s.sd_J},
              {"alveolar_pressure_mean_cmH2O", pressure_json(s.mean_pressure)},
              {"alveolar_pressure_sd_cmH2O", pressure_json(s.sd_pressure)}};
    region.update(columns_json(audit, breath.fullest, r));
  }
  return json;
}

/// Along gravity: at the start of the breath and at the end of its inspiration.
Json gravity_json(const GravityAudit &audit, const BreathRows &breath)
{
  Json json = {{"lung_weight_g", audit.weight()},
               {"jacobian_gradient_at_start_per_cm", audit.gradient(breath.first)},
               {"jacobian_gradient_per_cm", audit.gradient(breath.fullest)}};
  for (int t = 0; t < n_thirds; ++t)
    json[gravity_thirds[t]] = {{"reference_volume_ml", audit.volume(t)},
                               {"jacobian_mean_at_start", audit.mean_J(breath.first, t)},
                               {"jacobian_mean", audit.mean_J(breath.fullest, t)},
                               {"ventilation_ml", audit.ventilation(breath, t)},
                               {"ventilation_share", optional_json(audit.ventilation_share(breath, t))}};
  return json;
}

/// Where and why a run could not go on.
Json diagnosis_json(const Diagnosis &d)
{
  Json json = {{"where", d.name()},
               {"mean_jacobian", d.mean_J},
               {"inflation_stiffness_cmH2O", d.inflation / units::kPa_per_cmH2O},
               {"acoustic_stiffness_kPa", d.acoustic},
               {"acoustic_stiffness_at_rest_kPa", d.acoustic_at_rest},
               {"not_elliptic_volume_share", d.lost_share},
               {"worst_cell_mm", nullptr},
               {"distance_from_rim_mm", nullptr},
               {"law_limit", nullptr}};
  if (d.worst) json["worst_cell_mm"] = {d.worst->where[0], d.worst->where[1], d.worst->where[2]};
  if (d.from_rim) json["distance_from_rim_mm"] = *d.from_rim;
  if (d.own_limit)
    json["law_limit"] = {{"what", d.own_limit->name()},
                         {"jacobian", d.own_limit->at.J},
                         {"pressure_cmH2O", d.own_limit->at.pressure / units::kPa_per_cmH2O},
                         {"volume_share_there_or_beyond", d.own_limit->beyond}};
  return json;
}

/// A trial of several levels of PEEP, with the columns of effects at the last moment of each, also by region; null if
/// the run is none.
Json peep_trial(const Composition &composition, const RegionAudit &audit, const std::vector<SignalRow> &rows)
{
  const std::vector<PeepLevel> levels = peep_levels(rows);
  const PeepLevel *best = best_compliance(levels);
  if (levels.empty()) return nullptr;
  Json json = {{"best_compliance_ml_per_cmH2O", best ? Json(*best->compliance) : Json(nullptr)},
               {"peep_of_best_compliance_cmH2O", best ? Json(best->peep) : Json(nullptr)},
               {"levels", Json::array()}};
  for (const PeepLevel &level : levels) {
    const SignalRow &end = rows[level.last];
    Json one = {{"peep_cmH2O", level.peep},
                {"breath", end.breath},
                {"compliance_ml_per_cmH2O", optional_json(level.compliance)},
                {"end_expiratory_volume_ml", end.volume}};
    for (const SignalSpec &signal : composition.signals()) one[signal.name] = signal.value(end);
    if (!audit.columns().empty())
      for (std::size_t r = 0; r < audit.regions().size(); ++r)
        one["regions"][audit.regions()[r].name] = columns_json(audit, level.last, r);
    json["levels"].push_back(one);
  }
  return json;
}

/// Boundary that no effect uses.
Json free_boundary_json(const std::vector<FreeBoundary> &parts)
{
  Json list = Json::array();
  for (const FreeBoundary &p : parts)
    list.push_back({{"name", p.name.empty() ? Json(nullptr) : Json(p.name)},
                    {"area_mm2", p.area},
                    {"share", p.share},
                    {"centroid_mm", p.centroid},
                    {"lowest_mm", p.lowest},
                    {"highest_mm", p.highest}});
  return list;
}

/// Error bars by the key of their number, and the runs they come from.
Json errors_json(const ErrorReport &report)
{
  Json json = {{"method", report.method}, {"numbers", Json::object()}};
  for (const ErrorBar &bar : report.bars) {
    Json &number = json["numbers"][bar.entry.key];
    number = {{"value", *bar.entry.value},         {"error", optional_json(bar.total())},
              {"time", optional_json(bar.time)},   {"time_order", optional_json(bar.time_order)},
              {"space", optional_json(bar.space)}, {"solver", optional_json(bar.solver)}};
    if (!bar.lacks) continue;
    number["corrected"] = optional_json(bar.corrected);
    number["corrected_error"] = optional_json(bar.corrected_error);
    number["not_resolved"] = bar.unresolved.empty() ? Json(nullptr) : Json(bar.unresolved_words());
    number["not_resolved_because"] = Json::array();
    for (Unresolved reason : bar.unresolved) number["not_resolved_because"].push_back(key_of(reason));
    number["lacks"] = {{"steps", bar.lacks->steps},
                       {"rows", bar.lacks->rows},
                       {"flow_in_space", bar.lacks->flow_in_space},
                       {"tissue_in_space", bar.lacks->tissue_in_space},
                       {"solver", bar.lacks->solver}};
    number["more_breaths"] = nullptr;
    if (bar.more_breaths)
      number["more_breaths"] = {{"next", bar.more_breaths->next},
                                {"periodic", optional_json(bar.more_breaths->periodic)}};
  }
  json["runs"] = Json::array();
  for (const ErrorLevel &level : report.levels) {
    Json run = {{"name", level.name},      {"dt_s", level.dt},     {"cells", level.cells},
                {"dofs", level.dofs},      {"steps", level.steps}, {"reference_volume_ml", level.volume},
                {"seconds", level.seconds}};
    if (!level.failure.empty()) run["failure"] = level.failure;
    for (const ClinicalEntry &e : level.numbers) run["numbers"][e.key] = optional_json(e.value);
    json["runs"].push_back(run);
  }
  if (!report.failure.empty()) json["failure"] = report.failure;
  json["extra_seconds"] = report.extra_seconds();
  return json;
}

/// Derivatives of numbers by parameters, and what the sweep took.
Json sensitivities_json(const SensitivityReport &report)
{
  Json json = {{"numbers", Json::object()}};
  for (std::size_t k = 0; k < report.numbers.size() && report.failure.empty(); ++k) {
    Json parameters = Json::object();
    for (const SensitivityReport::Parameter &p : report.parameters) {
      Json &entry = parameters[p.option];
      entry = {{"value", p.value}, {"unit", p.unit}, {"derivative", p.derivative[k]}};
      entry["percent_for_one_percent_more"] = optional_json(report.percent(p, k));
      for (const auto &[region, derivative] : p.by_region) entry["regions"][region] = derivative[k];
    }
    json["numbers"][report.numbers[k].key] = {{"value", report.numbers[k].value}, {"parameters", parameters}};
  }
  json["left_out"] = Json::object();
  for (const SensitivityReport::LeftOut &left_out : report.left_out) json["left_out"][left_out.option] = left_out.why;
  json["not_defined"] = report.undefined;
  json["failure"] = report.failure.empty() ? Json(nullptr) : Json(report.failure);
  json["seconds"] = report.seconds;
  json["linear_solves"] = report.solves;
  json["krylov_iterations"] = report.krylov;
  return json;
}

/// What each effect adds and takes, on rank 0.
Json ledger_json(const Scene &scene, const Model &model, const StageSeconds &seconds)
{
  Json list = Json::array();
  for (const LedgerEntry &entry : ledger(scene, model))
    list.push_back({{"effect", entry.effect},
                    {"fields", entry.fields},
                    {"terms", entry.terms},
                    {"remembered_bytes", entry.bytes},
                    {"seconds", entry.seconds},
                    {"share_of_run", seconds.total > 0 ? Json(entry.seconds / seconds.total) : Json(nullptr)}});
  return list;
}

/// Volume of the lung of a prestressed scene without pressure, each cell inflated back on its own, mm^3. Collective.
PetscErrorCode unloaded_volume(const Scene &scene, const Model &model, PetscReal &volume)
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  if (scene.facts().prestress->unloading) {
    volume = scene.facts().prestress->unloading->volume;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(DMPlexGetHeightStratum(model.dm(), 0, &begin, &end));
  volume = 0;
  for (PetscInt c = begin; c < end; ++c) {
    PetscReal of_cell;
    PetscCall(DMPlexComputeCellGeometryFVM(model.dm(), c, &of_cell, nullptr, nullptr));
    volume += of_cell * scene.facts().prestress->volume(model.constants_at(c - begin));
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &volume, 1, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)model.dm())));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

std::string why_no_numbers(const Scene &scene, const std::vector<SignalRow> &rows)
{
  if (!scene.facts().ventilator->breathes())
    return "no phase of the programme begins a breath: name one 'inspiration', or add the word 'breath' to its line";
  return breath_rows(rows).empty() ? "the run ends before its first breath" : "the run ends within its first breath";
}

PetscErrorCode write_summary(const Options &options, const Output &output, const Scene &scene, const Model &model,
                             const Simulation &simulation, const Audits &audits, bool finished)
{
  const MPI_Comm comm = options.comm();
  PetscMPIInt rank, size;
  PetscInt dofs;
  OptionList used;
  std::ostringstream f;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(VecGetSize(simulation.state(), &dofs));
  std::vector<FreeBoundary> free_boundary;
  PetscCall(find_free_boundary(model.composition(), free_boundary));
  PetscCall(options.all_used(used));
  PetscReal unloaded = 0;
  if (scene.facts().prestress) PetscCall(unloaded_volume(scene, model, unloaded));
  const std::string file = output.path(finished ? "summary.json" : "failure.json");
  if (rank == 0) {
    Json json;
    json["finished"] = finished;
    if (!finished) json["failure"] = simulation.failure_text();
    if (!finished) json["diagnosis"] = diagnosis_json(simulation.diagnosis());
    const auto frc = audits.regions.functional_residual_capacity();
    const std::vector<SignalRow> rows = audits.regions.complete(simulation.rows());
    if (scene.facts().ventilator) {
      const auto complete = complete_breaths(rows);
      for (const ClinicalEntry &e : overall_entries(rows, frc)) json[e.key] = optional_json(e.value);
      json["numbers_of_breath"] = complete.empty() ? Json(nullptr) : Json(rows[complete.back().last].breath);
      if (complete.empty()) json["why_no_numbers"] = why_no_numbers(scene, rows);
      const auto unsteady = unsteadiness(rows);
      json["steady"] = unsteady ? Json(unsteady->steady()) : Json(nullptr);
      json["steady_change"] = unsteady ? Json(unsteady->change) : Json(nullptr);
      json["unsettled_volume_ml"] = optional_json(unsettled_volume(rows));
      json["static_curve"] = static_curve(rows);
      if (scene.facts().flow_past_limit_points) json["limit_points"] = limit_points(rows);
      json["peep_trial"] = peep_trial(model.composition(), audits.regions, rows);
      json["breaths"] = Json::array();
      for (const BreathRows &b : breath_rows(rows)) {
        Json breath = breath_json(rows, b, frc);
        if (audits.energy) {
          const auto &energy = audits.energy->rows();
          const auto until = [&](std::size_t row) {
            return b.complete ? energy_json(*audits.energy, energy[row] - energy[b.first]) : Json(nullptr);
          };
          breath["energy_j"] = until(b.last);
          breath["inspiratory_energy_j"] =
              clinical_numbers(rows, b.first, b.last).takes_in ? until(b.fullest) : Json(nullptr);
        }
        json["breaths"].push_back(breath);
      }
    }
    if (audits.sensitivities) json["sensitivities"] = sensitivities_json(*audits.sensitivities);
    if (audits.errors) json["error_estimate"] = errors_json(*audits.errors);
    if (audits.energy) json["energy_j"] = energy_json(*audits.energy, audits.energy->rows().back());
    const bool gas = scene.facts().airflow || scene.facts().ventilator;
    json["regions"] = regions_json(audits.regions, last_breath(rows), gas);
    if (scene.facts().prestress)
      json["prestress"] = {
          {"transpulmonary_pressure_cmH2O", scene.facts().prestress->pressure / units::kPa_per_cmH2O},
          {"unloaded_volume_ml", unloaded / units::mm3_per_ml},
          {"unloaded_volume_ratio", unloaded / scene.mesh().volume()},
      };
    if (audits.gravity) json["gravity"] = gravity_json(*audits.gravity, last_breath(rows));
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
    json["free_boundary"] = free_boundary_json(free_boundary);
    if (scene.facts().airflow) json["mass_balance_error_ml"] = simulation.mass_balance_error() / units::mm3_per_ml;
    if (model.composition().supported())
      json["support_reaction_n"] = simulation.support_reaction() * units::newton_per_kPa_mm2;
    if (model.composition().pinned()) json["pin_force_n"] = simulation.pins().largest() * units::newton_per_kPa_mm2;
    for (const SignalLimit &limit : model.composition().limits()) {
      const SignalSpec &signal = model.composition().signals()[limit.signal];
      json["largest_" + signal.name] = largest(signal, simulation.rows());
    }
    json["min_jacobian"] = simulation.min_J();
    if (scene.facts().airflow) {
      const std::vector<double> least = audits.regions.least_porosity(simulation.rows());
      json["min_porosity"] = *std::min_element(least.begin(), least.end());
    }
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
    json["ledger"] = ledger_json(scene, model, s);
    json["elements"] = scene.facts().elements.name();
    json["integration"] = model.own_integration() ? "pulmo" : "basic";
    json["version"] = PULMO_VERSION;
    Json list;
    for (const auto &[name, value] : used) list[name] = value;
    json["options"] = list;
    Json sources = Json::object(); // of what was given
    for (const auto &[name, value] : used)
      if (const std::string source = options.source(name); !source.empty()) sources[name] = source;
    json["option_sources"] = sources;

    f << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
  }
  PetscCall(write_text(comm, f.str(), file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode write_energy(MPI_Comm comm, const Output &output, const Simulation &simulation, const EnergyAudit &audit)
{
  const std::string file = output.path("energy.csv");
  PetscMPIInt rank;
  std::ostringstream f;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) {
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
  PetscCall(write_text(comm, f.str(), file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
