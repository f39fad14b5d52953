// Scenes of the harness, and runs of the program within a test.
#include "unit/harness.hpp"

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <unistd.h>

namespace pulmo::test {

namespace fs = std::filesystem;

namespace {

bool has(const std::vector<std::string> &list, const std::string &word)
{
  return std::find(list.begin(), list.end(), word) != list.end();
}

const char *name_of(Airway airway)
{
  switch (airway) {
  case Airway::held:
    return "held airway";
  case Airway::free:
    return "free airway";
  case Airway::common_pressure:
    return "common pressure";
  default:
    return "no airflow";
  }
}

template <class Law>
std::vector<std::string> names_of(const std::vector<std::unique_ptr<Law>> &laws)
{
  std::vector<std::string> names;
  for (const auto &law : laws) names.emplace_back(law->name());
  return names;
}

/// Laws, airways and schemes take turns from where the names tell: a new effect changes no scene of the others.
Subject subject_of(const Registry &registry, const std::vector<std::string> &names, std::size_t turn)
{
  const std::vector<std::string> law = names_of(registry.make_tissue_laws()),
                                 permeability = names_of(registry.make_permeability_laws());
  std::string all;
  for (const std::string &name : names) all += name + " ";
  const std::size_t number = static_cast<std::size_t>(constants::tag(all)) + turn;
  Subject s;
  s.registry = registry;
  s.effects = names;
  s.law = law[number % law.size()];
  s.permeability = permeability[number % permeability.size()];
  s.airway = all_airways[number % std::size(all_airways)];
  s.scheme = number % 2 ? "bdf" : "beuler";
  return s;
}

/// Whether pulmo builds the scene. @p why: else what it said, which must be a sentence.
bool taken(const Subject &subject, std::string &why)
{
  SceneRun run(subject.registry);
  Quiet::Said said;
  const PetscErrorCode code = build(run, subject.options(), &said);
  why = subject.text() + ": " + said.errors;
  if (code != 0 && !(code == PETSC_ERR_USER_INPUT && one_sentence(said.errors)))
    why = "no sentence of pulmo's ends " + why;
  return code == 0;
}

} // namespace

std::string Subject::text() const
{
  std::string all;
  for (const std::string &e : effects) all += (all.empty() ? "" : " + ") + e;
  return all + " (" + law + ", " + name_of(airway) + (airway == Airway::no_airflow ? "" : ", " + permeability) + ")";
}

std::string Subject::surroundings() const
{
  const std::string breath = "-ventilator_inspiration 0.2 -ventilator_expiration 0.2 -ventilator_ramp 0.1 "
                             "-ventilator_settle off ",
                    flow = "-ventilator vcv -ventilator_tidal_volume 0.01 -ventilator_flow_split ",
                    gas = "-airflow -airflow_permeability 300 -airflow_permeability_law " + permeability + " ",
                    holder = has(effects, "chest_wall") ? "" : "chest_wall";
  std::string s = "-dm_plex_filename " + source("meshes/cube_msh22_ascii.msh") +
                  " -mesh_scale 10 -pc_type lu -snes_rtol 1e-12 -snes_atol 1e-13 -snes_stol 0 -snes_max_it 40 "
                  "-ts_dt 0.05 -tissue " +
                  law + " " + breath;
  switch (airway) {
  case Airway::held:
    s += gas + "-ventilator pcv -ventilator_pip 2 ";
    break;
  case Airway::free:
    s += gas + flow + "uniform ";
    break;
  case Airway::common_pressure:
    s += gas + flow + "common_pressure ";
    break;
  case Airway::no_airflow:
    s += "-airflow off -ventilator pcv -ventilator_pip 2 ";
  }
  // pins hold what has no springs; effects that are on by default are none here
  for (const std::string &e : names_of_effects(registry))
    if (!has(effects, e) && !(holder.empty() && e == "support")) s += "-" + e + (e == holder ? " " : " off ");
  if (holder.empty() && !has(effects, "support")) s += "-support -support_rigid ";
  return s;
}

std::string Subject::example(const std::string &effect) const
{
  for (const auto &e : registry.make_effects())
    if (e->name() == effect) return e->example() + " ";
  return "";
}

std::string Subject::options() const
{
  std::string s = surroundings();
  for (const std::string &e : effects) s += example(e);
  return s;
}

std::vector<std::string> names_of_effects(const Registry &registry)
{
  std::vector<std::string> names;
  for (const auto &effect : registry.make_effects()) names.emplace_back(effect->name());
  return names;
}

std::vector<Subject> alone(const Registry &registry, const std::vector<std::string> &names, Findings &refused)
{
  std::vector<Subject> list;
  for (const std::string &name : names) {
    Findings complaints;
    for (std::size_t i = 0; i < std::size(all_airways); ++i) {
      std::string why;
      Subject s = subject_of(registry, {name}, i);
      s.airway = all_airways[i];
      if (taken(s, why))
        list.push_back(s);
      else
        complaints.push_back(why);
    }
    if (complaints.size() == std::size(all_airways))
      refused.insert(refused.end(), complaints.begin(), complaints.end());
  }
  return list;
}

std::optional<Subject> together(const Registry &registry, const std::vector<std::string> &names, Findings &refused)
{
  for (std::size_t i = 0; i < std::size(all_airways); ++i) {
    std::string why;
    Subject s = subject_of(registry, names, i);
    if (taken(s, why)) return s;
    refused.push_back(why);
  }
  return {};
}

const std::vector<Check> &checks()
{
  static const std::vector<Check> list{{"jacobian", check_jacobian, true},       {"off", check_off, false},
                                       {"integrators", check_integrators, true}, {"energy", check_energy, true},
                                       {"restart", check_restart, true},         {"ranks", check_ranks, true},
                                       {"schemes", check_schemes, false},        {"help", check_help, false},
                                       {"ledger", check_ledger, false},          {"values", check_values, false}};
  return list;
}

Findings find(const Check &check, const Subject &subject)
{
  Findings findings;
  const PetscErrorCode code = check.find(subject, findings);
  if (code != 0) findings.push_back("it ends with PETSc's error " + std::to_string(static_cast<int>(code)));
  return findings;
}

// ------------------------------------------------------------------------------------------------------------ output

Quiet::Quiet()
{
  take(STDOUT_FILENO, out_);
  take(STDERR_FILENO, errors_);
}

void Quiet::take(int descriptor, Stream &stream)
{
  (void)std::fflush(nullptr);
  stream.kept = dup(descriptor);
  stream.file = std::tmpfile();
  if (stream.file) (void)dup2(fileno(stream.file), descriptor);
}

std::string Quiet::give_back(int descriptor, Stream &stream)
{
  std::string text;
  (void)std::fflush(nullptr);
  (void)dup2(stream.kept, descriptor);
  (void)close(stream.kept);
  if (!stream.file) return text;
  std::rewind(stream.file);
  for (int c = std::fgetc(stream.file); c != EOF; c = std::fgetc(stream.file)) text += static_cast<char>(c);
  (void)std::fclose(stream.file);
  return text;
}

Quiet::Said Quiet::stop()
{
  Said said;
  if (stopped_) return said;
  stopped_ = true;
  said.errors = give_back(STDERR_FILENO, errors_);
  said.out = give_back(STDOUT_FILENO, out_);
  return said;
}

Folder::Folder()
{
  const fs::path memory = "/dev/shm"; // a disk would wait for each checkpoint
  std::error_code error;
  const fs::path above = fs::is_directory(memory, error) ? memory : fs::temp_directory_path();
  std::string name = (above / "pulmo_harness_XXXXXX").string();
  PetscMPIInt rank;
  (void)MPI_Comm_rank(PETSC_COMM_WORLD, &rank);
  mine_ = rank == 0;
  if (mine_ && !mkdtemp(name.data())) name.clear();
  (void)from_root(PETSC_COMM_WORLD, name);
  path_ = name;
}

Folder::~Folder()
{
  std::error_code error;
  if (mine_ && !path_.empty()) fs::remove_all(path_, error);
}

// --------------------------------------------------------------------------------------------------------------- runs

bool one_sentence(const std::string &errors)
{
  PetscMPIInt rank = 0;
  (void)MPI_Comm_rank(PETSC_COMM_WORLD, &rank);
  if (rank > 0) return true; // the first one speaks
  const std::string begin = "pulmo: error: ";
  return errors.rfind(begin, 0) == 0 && errors.size() > begin.size() + 10 &&
         std::count(errors.begin(), errors.end(), '\n') == 1;
}

bool Outcome::told() const
{
  if (code == 0) return finished;
  return (code == PETSC_ERR_USER_INPUT || code == PULMO_ERR_COULD_NOT_GO_ON) && one_sentence(said.errors);
}

std::map<std::string, std::vector<double>> Outcome::table(const std::string &file) const
{
  std::map<std::string, std::vector<double>> columns;
  const auto text = files.find(file);
  if (text == files.end()) return columns;
  std::istringstream lines(text->second);
  std::vector<std::string> names;
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::size_t column = 0;
    for (std::string word; std::getline(words, word, ','); ++column) {
      char *end = nullptr;
      const double number = std::strtod(word.c_str(), &end);
      if (names.size() <= column)
        names.push_back(word);
      else if (*end == '\0')
        columns[names[column]].push_back(number);
    }
  }
  return columns;
}

Outcome run_program(const Registry &registry, const std::string &options, const std::string &directory)
{
  Outcome outcome;
  {
    Quiet quiet;
    outcome.code = set_options(options + " -progress off -output_fields_every 1000 -output_dir " + directory);
    if (outcome.code == 0) outcome.code = run(registry, outcome.finished);
    outcome.said = quiet.stop();
  }
  for (const char *name : {"signals.csv", "energy.csv", "fields.xdmf", "summary.json"}) {
    std::ifstream file(directory + "/" + name);
    std::ostringstream text;
    text << file.rdbuf();
    if (file) outcome.files[name] = text.str();
  }
  return outcome;
}

PetscErrorCode build(SceneRun &run, const std::string &options, Quiet::Said *said)
{
  Quiet quiet;
  const PetscErrorCode code = prepare(run, options);
  const Quiet::Said text = quiet.stop();
  if (said) *said = text;
  return code;
}

std::string shown(double number)
{
  std::ostringstream s;
  s.precision(3);
  s << number;
  return s.str();
}

} // namespace pulmo::test
