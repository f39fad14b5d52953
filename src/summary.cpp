#include "pulmo/output.hpp"
#include "pulmo/units.hpp"

#include <nlohmann/json.hpp>

#include <filesystem>
#include <fstream>

namespace pulmo {

namespace {

using Json = nlohmann::ordered_json;

Json optional_json(const std::optional<double> &v)
{
  return v ? Json(*v) : Json(nullptr);
}

void add_numbers(Json &json, const ClinicalNumbers &n)
{
  json["compliance_ml_per_cmH2O"] = optional_json(n.compliance);
  json["resistance_cmH2O_s_per_l"] = optional_json(n.resistance);
  json["time_constant_s"] = optional_json(n.time_constant);
  json["peak_inspiratory_pressure_cmH2O"] = n.peak_pressure;
  json["plateau_pressure_cmH2O"] = optional_json(n.plateau_pressure);
  json["driving_pressure_cmH2O"] = n.driving_pressure;
  json["tidal_volume_ml"] = n.tidal_volume;
  json["trapped_volume_ml"] = n.trapped_volume;
  json["peak_flow_ml_per_s"] = n.peak_flow;
  json["work_j"] = n.work;
  json["mechanical_power_j_per_min"] = n.mechanical_power;
}

} // namespace

PetscErrorCode write_summary(const Options &options, const Output &output, const Scene &scene, const Model &model,
                             const Simulation &simulation, bool finished)
{
  const MPI_Comm comm = options.comm();
  PetscMPIInt rank, size;
  PetscInt dofs;
  std::vector<std::pair<std::string, std::string>> used;
  int written = 1;

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
    if (scene.facts().ventilator) {
      add_numbers(json, overall_numbers(simulation.rows(), scene.ventilator().peep()));
      json["breaths"] = Json::array();
      for (const ClinicalNumbers &n : breath_numbers(simulation.rows(), scene.ventilator().peep())) {
        json["breaths"].emplace_back();
        add_numbers(json["breaths"].back(), n);
      }
    }
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

    const std::string part = file + ".part";
    std::ofstream f(part);
    f << json.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
    f.close();
    std::error_code error;
    if (f.good()) std::filesystem::rename(part, file, error);
    written = f.good() && !error;
  }
  PetscCallMPI(MPI_Bcast(&written, 1, MPI_INT, 0, comm));
  PulmoUserCheck(written, comm, "cannot write %s; free the disk or choose another -output_dir", file.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_numbers(MPI_Comm comm, const Output &output, const Scene &scene, const Simulation &simulation)
{
  PetscFunctionBeginUser;
  if (scene.facts().ventilator) {
    const ClinicalNumbers n = overall_numbers(simulation.rows(), scene.ventilator().peep());
    PetscCall(
        PetscPrintf(comm,
                    "\nThe lung (%.0f ml at rest, %s tissue) took %.1f ml per breath at a peak airway pressure of "
                    "%.2f cmH2O; %.1f ml stayed behind.\n",
                    (double)(scene.mesh().volume() / units::mm3_per_ml), scene.tissue().law().name(), n.tidal_volume,
                    n.peak_pressure, n.trapped_volume));
    if (n.compliance)
      PetscCall(PetscPrintf(comm,
                            "Respiratory-system compliance %.2f ml/cmH2O, resistance %.3f cmH2O s/l, time constant "
                            "%.3f s (single-compartment fit).\n",
                            *n.compliance, *n.resistance, *n.time_constant));
    PetscCall(PetscPrintf(comm,
                          "Driving pressure %.2f cmH2O, peak flow %.0f ml/s, work %.4f J per breath, mechanical power "
                          "%.3f J/min.\n",
                          n.driving_pressure, n.peak_flow, n.work, n.mechanical_power));
  }
  PetscCall(PetscPrintf(comm, "Smallest J %.4f", (double)simulation.min_J()));
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
