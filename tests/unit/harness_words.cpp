// Checks of what pulmo says of an effect and takes from a user: -help, the ledger, values of options.
#include "unit/harness.hpp"

#include <algorithm>
#include <cmath>
#include <set>
#include <sstream>

namespace pulmo::test {

namespace {

/// An option as -help shows it.
struct Shown {
  std::string name, help, unit, range, value;

  bool number() const { return unit != "on/off" && unit != "text" && !choice() && unit.rfind("names", 0) != 0; }
  bool choice() const { return unit.rfind("one of ", 0) == 0; }
};

/// Reads "  -name   help [unit] range (default value)".
std::optional<Shown> read_help(const std::string &line)
{
  const std::size_t unit = line.rfind(" ["), end = line.find(']', unit == std::string::npos ? 0 : unit),
                    value = line.rfind(" (default ");
  if (line.rfind("  -", 0) != 0 || unit == std::string::npos || end == std::string::npos || value == std::string::npos)
    return {};
  Shown o;
  const std::size_t blank = line.find(' ', 2);
  o.name = line.substr(2, blank - 2);
  const std::size_t help = line.find_first_not_of(' ', blank);
  if (help < unit) o.help = line.substr(help, unit - help);
  o.unit = line.substr(unit + 2, end - unit - 2);
  if (value > end + 1) o.range = line.substr(end + 2, value - end - 2);
  o.value = line.substr(value + 10, line.size() - value - 11);
  return o;
}

/// What -help lists in a scene.
PetscErrorCode help_of(const Registry &registry, const std::string &options, std::vector<Shown> &list,
                       std::string &text)
{
  SceneRun run(registry);
  Quiet quiet;

  PetscFunctionBeginUser;
  PetscCall(set_options(options));
  PetscCall(run.declare());
  PetscCall(run.options().print_help());
  text = quiet.stop().out;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);)
    if (const auto option = read_help(line)) list.push_back(*option);
  PetscFunctionReturn(PETSC_SUCCESS);
}

Registry without(const Subject &subject)
{
  return subject.registry.without([&](const Effect &e) { return e.name() == subject.effects.front(); });
}

/// The options that its first effect brings.
PetscErrorCode own_options(const Subject &subject, std::vector<Shown> &own, std::string &text)
{
  Subject unheard = subject;
  std::vector<Shown> rest;
  std::set<std::string> others;
  std::string ignored;

  PetscFunctionBeginUser;
  unheard.registry = without(subject);
  PetscCall(help_of(subject.registry, subject.options(), own, text));
  PetscCall(help_of(unheard.registry, unheard.surroundings(), rest, ignored));
  for (const Shown &o : rest) others.insert(o.name);
  own.erase(std::remove_if(own.begin(), own.end(), [&](const Shown &o) { return others.count(o.name) > 0; }),
            own.end());
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode check_help(const Subject &subject, Findings &findings)
{
  const std::string option = "-" + subject.effects.front();
  std::vector<Shown> own;
  std::string text;
  bool turns_on = false;

  PetscFunctionBeginUser;
  PetscCall(own_options(subject, own, text));
  for (const Shown &o : own) {
    turns_on = turns_on || (o.name == option && (o.unit == "on/off" || o.help.find("off") != std::string::npos));
    if (o.name != option && o.name.rfind(option + "_", 0) != 0)
      findings.push_back("-help: " + o.name + " does not begin with " + option);
    if (o.unit.empty()) findings.push_back("-help: " + o.name + " has no unit");
    if (o.help.empty()) findings.push_back("-help: " + o.name + " says nothing");
  }
  if (!turns_on) findings.push_back("-help: no " + option + " turns it on and off");
  for (const auto &effect : subject.registry.make_effects())
    if (effect->name() == subject.effects.front()) {
      const std::string about = effect->about();
      if (about.empty() || text.find("\n" + about + "\n") == std::string::npos)
        findings.push_back("-help does not say what it is");
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// Rows of the ledger by effect, without what a clock tells.
std::map<std::string, std::string> ledger_of(const std::string &out)
{
  std::map<std::string, std::string> rows;
  std::string effect;
  std::istringstream lines(out.substr(std::min(out.size(), out.find("\nEffects of this scene"))));
  for (std::string line; std::getline(lines, line);) {
    if (line.rfind("effect ", 0) == 0 || line.rfind("Effects ", 0) == 0) continue;
    if (line.rfind("callbacks per cell", 0) == 0) break;
    if (line.rfind("    ", 0) == 0) {
      rows[effect] += line + "\n";
    } else if (!line.empty()) {
      std::istringstream words(line);
      std::string fields;
      words >> effect >> fields;
      rows[effect] = fields + "\n";
    }
  }
  return rows;
}

} // namespace

/// It has a row of its own with all that it brings.
PetscErrorCode check_ledger(const Subject &subject, Findings &findings)
{
  const std::string &name = subject.effects.front(), view = "-ts_max_time 0.05 -energy_audit off -effects_view ";
  Subject unheard = subject;
  const Folder folder;

  PetscFunctionBeginUser;
  unheard.registry = without(subject);
  const Outcome with = run_program(subject.registry, subject.options() + view, folder.path("with")),
                plain = run_program(unheard.registry, unheard.surroundings() + view, folder.path("without"));
  if (with.code != 0 || plain.code != 0) {
    findings.push_back("a step does not end well: " + with.said.errors + plain.said.errors);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const auto rows = ledger_of(with.said.out), rest = ledger_of(plain.said.out);
  if (rows.empty() || rest.empty()) findings.push_back("there is no ledger");
  if (rows.count(name) == 0) findings.push_back("the ledger has no row of it");
  for (const auto &[effect, row] : rows) { // springs make pins needless; but nothing is added
    if (effect == name || rest.count(effect) == 0) continue;
    std::istringstream lines(row);
    for (std::string line; std::getline(lines, line);)
      if (rest.at(effect).find(line + "\n") == std::string::npos)
        findings.push_back("the ledger counts '" + line + "' as a part of " + effect);
  }
  for (const auto &[effect, row] : rows)
    if (effect != name && rest.count(effect) == 0) findings.push_back("the ledger has an effect " + effect);
  if (with.files.at("summary.json").find('"' + name + '"') == std::string::npos)
    findings.push_back("summary.json does not list it");
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// A value to try, and whether it has to be refused.
struct Trial {
  std::string word;
  bool wrong;
};

/// The ends of a range as -help writes it: ">= 0", "0 < value < 1", "each > 0".
struct Ends {
  std::optional<double> low, high;
  bool open = false;

  explicit Ends(const std::string &text)
  {
    open = text.find('=') == std::string::npos;
    std::istringstream words(text);
    std::string before;
    for (std::string word; words >> word; before = word) {
      char *end = nullptr;
      const double number = std::strtod(word.c_str(), &end);
      if (*end != '\0') continue;
      if (before.empty() || before == "each" || before[0] == '>')
        low = number;
      else
        high = number;
    }
  }
  bool holds(double v) const
  {
    return (!low || (open ? v > *low : v >= *low)) && (!high || (open ? v < *high : v <= *high));
  }
};

std::vector<Trial> trials(const Shown &o)
{
  std::vector<Trial> list{{"what", o.unit != "text"}};
  if (o.unit == "on/off") list.insert(list.end(), {{"on", false}, {"2", true}});
  if (o.choice()) {
    std::istringstream words(o.unit.substr(7));
    for (std::string word; std::getline(words, word, '|');) list.push_back({word, false});
  }
  if (o.unit == "text") list.insert(list.end(), {{"nan", false}, {"0", false}, {"-1", false}});
  if (!o.number()) return list;
  const Ends range(o.range);
  // as many numbers as there are by default
  const auto repeated = [&](const std::string &word) {
    std::string all = word;
    for (auto n = std::count(o.value.begin(), o.value.end(), ','); n > 0; --n) all += "," + word;
    return all;
  };
  for (const char *word : {"nan", "inf", "1e999"}) list.push_back({repeated(word), true});
  std::vector<double> numbers{-1, 0, 1e-6, 1e6};
  if (range.low) numbers.insert(numbers.end(), {*range.low, *range.low - 1e-3});
  if (range.high) numbers.insert(numbers.end(), {*range.high, *range.high + 1e-3});
  for (const double number : std::set<double>(numbers.begin(), numbers.end())) {
    std::ostringstream word; // with all its digits
    word.precision(15);
    word << number;
    list.push_back({repeated(word.str()), !range.holds(number)});
  }
  return list;
}

bool finite(const std::vector<double> &values)
{
  return std::all_of(values.begin(), values.end(), [](double v) { return std::isfinite(v); });
}

/// Whether the equations of a scene that pulmo takes are numbers: at rest, where the first step begins.
PetscErrorCode numbers_at_rest(const Subject &subject, const std::string &options, bool &good)
{
  SceneRun run(subject.registry);
  VecHandle x, x_t, F;
  MatHandle A;
  PetscReal norm, entries;
  const PetscReal dt = 0.05;

  PetscFunctionBeginUser;
  PetscCall(build(run, options));
  PetscCall(DMCreateLocalVector(run.model().dm(), x.out()));
  PetscCall(VecDuplicate(x, x_t.out()));
  PetscCall(VecDuplicate(x, F.out()));
  PetscCall(run.model().set_step(dt, 0.1));
  PetscCall(run.model().residual(dt, x, x_t, F));
  PetscCall(VecNorm(F, NORM_2, &norm));
  PetscCall(run.model().create_matrix(A.out()));
  PetscCall(run.model().jacobian(dt, x, x_t, 1 / dt, A));
  PetscCall(MatNorm(A, NORM_FROBENIUS, &entries));
  good = std::isfinite(norm) && std::isfinite(entries);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

/// What -help calls wrong is refused in a sentence with the option's name; all else gives numbers, or is told.
PetscErrorCode check_values(const Subject &subject, Findings &findings)
{
  const Folder folder;
  std::vector<Shown> own;
  std::string text;
  int runs = 0;

  PetscFunctionBeginUser;
  PetscCall(own_options(subject, own, text));
  for (const Shown &o : own)
    for (const Trial &trial : trials(o)) {
      const std::string given = o.name + " " + trial.word, options = subject.options() + given + " ";
      const Outcome run =
          run_program(subject.registry, options + "-ts_max_time 0.1 -ts_dt 0.1 ", folder.path(std::to_string(++runs)));
      bool good = true;
      if (!trial.wrong && !run.refused()) PetscCall(numbers_at_rest(subject, options, good));
      // where other options are named after it, one of these may be told
      const bool named = o.unit.rfind("names", 0) == 0 || run.said.errors.find(o.name) != std::string::npos;
      if (trial.wrong && !(run.refused() && named))
        findings.push_back("values: " + given + " is not refused in a sentence: " + run.said.errors);
      else if (!good)
        findings.push_back("values: with " + given + " the equations are no numbers at rest");
      else if (!run.told())
        findings.push_back("values: " + given + " ends with " + run.said.errors);
      else if (run.code == 0)
        for (const auto &[column, values] : run.table("signals.csv"))
          if (!finite(values)) findings.push_back("values: with " + given + " " + column + " is no number");
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
