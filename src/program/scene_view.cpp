// A scene in words: what is in it, what is not, how it breathes, how it is solved.
#include "pulmo/program/scene_view.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/observers/output.hpp"
#include "pulmo/pulmo.hpp"

#include <nlohmann/json.hpp>

#include <algorithm>
#include <cctype>
#include <sstream>

namespace pulmo {

namespace {

/// Phases that are told one by one; of more only their number is.
constexpr std::size_t most_phases = 12;

std::string number(PetscReal value)
{
  std::ostringstream text;
  text.precision(4);
  text << value;
  return text.str();
}

std::string with_blanks(std::string name)
{
  std::replace(name.begin(), name.end(), '_', ' ');
  return name;
}

std::string capital(std::string text)
{
  if (!text.empty()) text[0] = static_cast<char>(std::toupper(static_cast<unsigned char>(text[0])));
  return text;
}

/// What of an effect's options is told: those that have a value, and are not the effect's own "on".
std::vector<Options::Setting> told_settings(const Options &options, const std::string &effect)
{
  std::vector<Options::Setting> told;
  for (const Options::Setting &s : options.settings(effect))
    if (!s.value.empty() && !(s.name.empty() && (s.value == "on" || s.value == "true"))) told.push_back(s);
  return told;
}

/// "Chest wall: springs on the pleura; stiffness 0.08 kPa/mm; direction full." or "No gravity: nothing has weight
/// (-gravity)."
std::string sentence(const SceneWords::Effect &effect)
{
  if (!effect.active) return "No " + with_blanks(effect.name) + ": " + effect.words + " (-" + effect.name + ").";
  std::string text = capital(with_blanks(effect.name)) + ": " + effect.words;
  for (const Options::Setting &s : effect.settings)
    text += "; " + (s.name.empty() ? s.value : s.name + " " + s.value) + (s.unit.empty() ? "" : " " + s.unit);
  return text + ".";
}

/// "inspiration of breath 1 from 0 to 1 s: pressure to 6 cmH2O within 0.1 s".
std::string phase_text(const Phase &phase)
{
  const bool flow = phase.control == Control::flow;
  const PetscReal unit = flow ? units::mm3_per_ml : units::kPa_per_cmH2O;
  std::string text = "Phase " + phase.name + (phase.breath > 0 ? " of breath " + std::to_string(phase.breath) : "") +
                     ", " + number(phase.begin) + " to " + number(phase.end) +
                     " s: " + (flow ? "flow of " : "pressure of ") + number(phase.to / unit) +
                     (flow ? " ml/s" : " cmH2O");
  if (phase.ramp > 0) text += ", reached within " + number(phase.ramp) + " s";
  if (phase.limit) text += ", up to " + number(*phase.limit / units::kPa_per_cmH2O) + " cmH2O";
  if (phase.trigger_flow)
    text += ", ends where more than " + number(*phase.trigger_flow / units::mm3_per_ml) + " ml/s flow in";
  if (phase.trigger_drop)
    text += ", ends where the pressure falls by " + number(*phase.trigger_drop / units::kPa_per_cmH2O) + " cmH2O";
  if (phase.cycle) text += ", ends where the flow falls to " + number(100 * *phase.cycle) + " % of its highest";
  if (phase.dt) text += ", steps of " + number(*phase.dt) + " s";
  return text + ".";
}

void describe_mesh(const Scene &scene, std::vector<std::string> &lines)
{
  const Mesh &mesh = scene.mesh();
  lines.push_back("The mesh " + mesh.file() + " has " + number(mesh.volume() / units::mm3_per_ml) + " ml in " +
                  std::to_string(mesh.cells()) + " tetrahedra of about " + number(mesh.edge()) + " mm; elements " +
                  scene.facts().elements.name() + ".");
  for (const auto &[name, surface] : mesh.surfaces())
    lines.push_back("Surface " + name + " has " + number(surface.area / 100) + " cm^2.");
  for (const Mesh::Part &part : mesh.parts())
    if (part.dimension == 3)
      lines.push_back("Volume " + part.name + " has " + number(part.measure / units::mm3_per_ml) + " ml.");
}

void describe_effects(const Options &options, const Scene &scene, std::vector<SceneWords::Effect> &effects)
{
  for (const auto &effect : scene.effects()) {
    const std::string name = effect->name(), absence = effect->absence();
    const bool active = effect->active();
    effects.push_back({name,
                       active            ? effect->describe(scene.facts())
                       : absence.empty() ? effect->about()
                                         : absence,
                       active, active ? told_settings(options, name) : std::vector<Options::Setting>()});
  }
}

void describe_breathing(const Scene &scene, std::vector<std::string> &lines)
{
  if (!scene.facts().ventilator) {
    lines.emplace_back("No ventilator: the airway stays at atmospheric pressure.");
    return;
  }
  const auto &phases = scene.facts().ventilator->phases();
  for (std::size_t i = 0; i < std::min(phases.size(), most_phases); ++i) lines.push_back(phase_text(phases[i]));
  if (scene.facts().flow_past_limit_points) {
    const PetscReal flow = *scene.facts().flow_past_limit_points / units::mm3_per_ml;
    lines.push_back("Where the lung holds no more of a prescribed pressure, past a limit point, " +
                    (flow > 0 ? "a flow of " + number(flow) + " ml/s" : "the mean flow of the phase until then") +
                    " is prescribed.");
  }
  if (phases.size() > most_phases)
    lines.push_back("And so on: " + std::to_string(phases.size()) + " phases in all, up to " +
                    number(phases.back().end) + " s.");
}

PetscErrorCode describe_numerics(const Options &options, const Simulation &simulation, std::vector<std::string> &lines)
{
  static constexpr const char *of_solver[] = {"-snes_", "-ksp_", "-pc_", "-fieldsplit_", "-mat_"};
  static constexpr const char *chief[] = {"-snes_type", "-ksp_type", "-pc_type"};
  const StepControl &control = simulation.step_control();
  OptionList given;
  std::string kinds, sources;
  std::vector<std::string> told;

  PetscFunctionBeginUser;
  lines.push_back(
      std::string("Time goes on by ") + (simulation.scheme().multistep() ? "BDF2" : "backward Euler") +
      " in steps of " + number(simulation.wanted_dt()) + " s" +
      (control.in_use() ? ", or of what their error allows (-step_volume_tolerance, -step_pressure_tolerance)" : "") +
      ".");
  PetscCall(options.all_given(given));
  for (const auto &[name, value] : given) {
    const std::string &option = name;
    if (std::find(std::begin(chief), std::end(chief), option) != std::end(chief))
      kinds += (kinds.empty() ? "" : ", ") + option + " " + value;
    const bool is_solver = std::any_of(std::begin(of_solver), std::end(of_solver), [&](const std::string &prefix) {
      return option.compare(0, prefix.size(), prefix) == 0;
    });
    const std::string source = options.source(option);
    if (!is_solver || source.empty() || std::find(told.begin(), told.end(), source) != told.end()) continue;
    told.push_back(source);
    sources += (sources.empty() ? "" : ", ") + source;
  }
  if (kinds.empty())
    lines.emplace_back("No solver is named, so PETSc's defaults solve; give one of petsc_options/solvers.");
  else
    lines.push_back("The solver is " + kinds + (sources.empty() ? "" : "; its options come from " + sources) + ".");
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode describe_scene(const Options &options, const Scene &scene, const Model &model,
                              const Simulation &simulation, SceneWords &words)
{
  PetscFunctionBeginUser;
  describe_mesh(scene, words.mesh);
  describe_effects(options, scene, words.effects);
  PetscCall(describe_range(scene, model, words.range));
  describe_breathing(scene, words.breathing);
  PetscCall(describe_numerics(options, simulation, words.numerics));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode print_scene(MPI_Comm comm, const SceneWords &words)
{
  std::vector<std::string> in, out;

  PetscFunctionBeginUser;
  for (const SceneWords::Effect &effect : words.effects) (effect.active ? in : out).push_back(sentence(effect));
  out.emplace_back(
      "What no option brings in (blood, fluid, fissures, gas exchange, ...): docs/effects/not_modelled.md.");
  const std::pair<const char *, const std::vector<std::string> &> sections[] = {
      {"The mesh", words.mesh},
      {"In this scene", in},
      {"Not in this scene", out},
      {"How far the tissue goes", words.range},
      {"How it breathes", words.breathing},
      {"How it is solved", words.numerics}};
  for (const auto &[title, lines] : sections) {
    PetscCall(PetscPrintf(comm, "\n%s\n", title));
    for (const std::string &line : lines) PetscCall(PetscPrintf(comm, "  %s\n", line.c_str()));
  }
  PetscCall(PetscPrintf(comm, "\n"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode write_scene(const Options &options, const SceneWords &words, const std::string &file)
{
  using Json = nlohmann::ordered_json;
  const MPI_Comm comm = options.comm();
  OptionList given;
  PetscMPIInt size;

  PetscFunctionBeginUser;
  PetscCall(options.all_given(given));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  Json json = {{"version", version()},
               {"ranks", size},
               {"mesh", words.mesh},
               {"effects", Json::array()},
               {"tissue_range", words.range},
               {"breathing", words.breathing},
               {"numerics", words.numerics},
               {"options", Json::object()},
               {"option_sources", Json::object()}};
  for (const SceneWords::Effect &effect : words.effects) {
    Json entry = {
        {"name", effect.name}, {"active", effect.active}, {"words", effect.words}, {"settings", Json::array()}};
    for (const Options::Setting &s : effect.settings)
      entry["settings"].push_back({{"name", s.name}, {"value", s.value}, {"unit", s.unit}});
    json["effects"].push_back(entry);
  }
  for (const auto &[name, value] : given) {
    json["options"][name] = value;
    if (const std::string source = options.source(name); !source.empty()) json["option_sources"][name] = source;
  }
  PetscCall(write_text(comm, json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n", file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
