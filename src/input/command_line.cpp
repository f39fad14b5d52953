#include "pulmo/input/command_line.hpp"

#include "pulmo/base/petsc.hpp"
#include "pulmo/base/text_file.hpp"
#include "pulmo/base/words.hpp"
#include "pulmo/input/replay_file.hpp"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <map>

namespace pulmo {

namespace {

/// Larger files hold no options, bytes.
constexpr std::size_t largest_file = 4U << 20;
/// PETSc takes no longer names.
constexpr std::size_t longest_name = 500;

/// A word; in quotes it is a value, whatever it begins with.
struct Word {
  std::string text;
  bool quoted = false;
};

/// Whether PETSc takes a word for the name of an option.
bool is_name(const std::string &word)
{
  PetscBool valid = PETSC_FALSE;
  (void)PetscOptionsValidKey(word.c_str(), &valid); // needs no PetscInitialize
  return valid;
}
bool is_name(const Word &word)
{
  return !word.quoted && is_name(word.text);
}

bool is_one_of(const std::string &word, std::initializer_list<const char *> list)
{
  return std::any_of(list.begin(), list.end(), [&](const char *one) { return word == one; });
}

bool ends_with(const std::string &s, const std::string &end)
{
  return s.size() >= end.size() && s.compare(s.size() - end.size(), end.size(), end) == 0;
}

/// The words of a line: parted by blanks, a value in quotes is one word, # before a word begins a comment. What is
/// wrong with it; empty if nothing is.
std::string split(const std::string &line, std::vector<Word> &words)
{
  constexpr const char *space = " \t\n";
  words.clear();
  for (std::size_t at = line.find_first_not_of(space); at != std::string::npos && line[at] != '#';
       at = line.find_first_not_of(space, at)) {
    const bool quoted = line[at] == '"' || line[at] == '\'';
    const std::size_t end = quoted ? line.find(line[at], at + 1) : line.find_first_of(space, at);
    if (quoted && end == std::string::npos) return "opens a quote and does not close it";
    words.push_back({line.substr(at + quoted, end - at - quoted), quoted});
    if (end == std::string::npos) break;
    at = end + quoted;
    if (quoted && at < line.size() && !std::strchr(space, line[at]))
      return "goes on right after a closing quote; put the whole value in quotes";
  }
  return "";
}

/// Names and values of a text in YAML, by PETSc's reader. Whether that could read it.
bool read_yaml(const std::string &text, std::vector<std::pair<std::string, std::string>> &pairs)
{
  PetscOptions options = nullptr;
  PetscInt n = 0;
  char **names = nullptr, **values = nullptr;
  bool good = PetscPushErrorHandler(PetscReturnErrorHandler, nullptr) == 0;

  good = good && PetscOptionsCreate(&options) == 0 && PetscOptionsInsertStringYAML(options, text.c_str()) == 0 &&
         PetscOptionsLeftGet(options, &n, &names, &values) == 0; // none was read yet: all are left
  for (PetscInt i = 0; good && i < n; ++i) pairs.emplace_back(std::string("-") + names[i], values[i] ? values[i] : "");
  if (good) good = PetscOptionsLeftRestore(options, &n, &names, &values) == 0;
  if (options) (void)PetscOptionsDestroy(&options);
  (void)PetscPopErrorHandler();
  return good;
}

class Reader {
public:
  explicit Reader(GivenOptions &given) : given_(given) {}

  /// Each returns what is wrong, or nothing.
  std::string command_line(const std::vector<std::string> &line)
  {
    std::vector<Word> words;
    for (const std::string &word : line) words.push_back({word, false});
    for (Word &word : words)
      if (is_one_of(word.text, {"--help", "-h", "-?"}))
        word.text = "-help";
      else if (is_one_of(word.text, {"-version", "--version"}))
        given_.question = "version";
      else if (is_one_of(word.text, {"-list", "--list"}))
        given_.question = "list";
    if (!given_.question.empty() && words.size() > 1) {
      const std::string asked = "-" + given_.question;
      given_.question.clear();
      return asked + " stands alone: leave out what else is on the command line";
    }
    return sequence(words, "command line", "on the command line");
  }

  std::string variable(const std::string &name, std::string text)
  {
    std::vector<Word> words;
    if (text.find_first_not_of(" \t\r\n") == std::string::npos) return "";
    given_.unasked.push_back(name);
    std::string fault = clean_text(text);
    std::replace(text.begin(), text.end(), '\n', ' ');
    if (fault.empty()) fault = split(text, words);
    if (!fault.empty()) return "the environment variable " + name + " " + fault;
    return sequence(words, name, "in the environment variable " + name);
  }

  std::string yaml(const std::string &source, std::string text, const std::string &where)
  {
    std::vector<std::pair<std::string, std::string>> pairs;
    const std::string fault = clean_text(text);
    if (!fault.empty()) return where + " " + fault;
    if (!read_yaml(text, pairs))
      return where + " is no YAML that holds options; write a line 'name: value' for each, names without a dash";
    for (const auto &[name, value] : pairs) {
      const std::string wrong = is_name(name) ? set(name, value, source) : "";
      if (!is_name(name) || !wrong.empty())
        return where + ": " + (wrong.empty() ? "'" + name.substr(1) + "' is no name of an option" : wrong);
    }
    return "";
  }

  /// All options of a run that failed, as they were in force.
  std::string replay(const std::string &directory)
  {
    ReplayFile file;
    std::string folder;
    const std::string fault = file.read(directory, folder);
    if (!fault.empty()) return fault;
    given_.list = file.options;
    given_.list.push_back({"-replay", folder, "command line"});
    given_.directory = file.directory;
    return "";
  }

  /// A file that is read if it is there.
  std::string petscrc(const std::string &file)
  {
    std::error_code error;
    if (!std::filesystem::is_regular_file(file, error)) return "";
    for (const std::string &read : given_.unasked)
      if (std::filesystem::equivalent(read, file, error)) return "";
    given_.unasked.push_back(file);
    return this->file("", file, false);
  }

  std::string end() const
  {
    return prefixes_.empty() ? "" : "-prefix_push " + prefixes_.back() + " lacks its -prefix_pop";
  }

private:
  /// Options one after the other.
  std::string sequence(const std::vector<Word> &words, const std::string &source, const std::string &where)
  {
    for (std::size_t i = 0; i < words.size(); ++i) {
      const std::string &name = words[i].text;
      if (!is_name(words[i])) {
        const std::string odd = look_alike(name);
        return "'" + name + "' " + where + " belongs to no option" +
               (!odd.empty() ? ": it holds " + odd
                : i > 1      ? ": it follows the value of " + words[i - 2].text
                             : "") +
               "; options are written -name value, a value with blanks in quotes";
      }
      const bool has_value = i + 1 < words.size() && !is_name(words[i + 1]);
      const std::string fault = option(name, has_value ? &words[i + 1].text : nullptr, source);
      if (!fault.empty()) return fault;
      if (has_value) ++i;
    }
    return "";
  }

  /// An option, or what stands for more of them.
  std::string option(const std::string &given_name, const std::string *value, const std::string &source)
  {
    const std::string name = lower(given_name);
    if (name == "-options_file" || name == "-options_file_yaml")
      return value ? file(name, *value, name == "-options_file_yaml") : name + " needs the name of a file";
    if (name == "-options_string_yaml")
      return value ? yaml(source, *value, "the value of " + name + " (" + source + ")") : name + " needs a value";
    if (name == "-replay")
      return "-replay " + (value ? *value : "DIR") + " (" + source +
             ") must be the first word on the command line: what follows it replaces options of the run that failed";
    if (name == "-options_string")
      return "-options_string is no option of PETSc's; write the options themselves, or -options_string_yaml";
    if (name == "-prefix_push") {
      if (!value || !is_name("-" + *value))
        return "-prefix_push needs a prefix without a dash, such as fieldsplit_pressure_";
      prefixes_.push_back(*value);
      return "";
    }
    if (name == "-prefix_pop") {
      if (prefixes_.empty()) return "-prefix_pop ends no -prefix_push; remove it";
      prefixes_.pop_back();
      return "";
    }
    return set(given_name, value ? *value : "", source);
  }

  std::string set(const std::string &given_name, const std::string &value, const std::string &source)
  {
    const auto is_odd = [](unsigned char c) { return c <= 32 || c == 127; };
    std::string name = "-";
    for (const std::string &prefix : prefixes_) name += prefix;
    name += given_name.substr(1);
    const std::string odd = look_alike(name);
    if (std::any_of(name.begin(), name.end(), is_odd))
      return "the option '" + name + "' (" + source +
             ") holds a blank; write name and value as two words, and a blank in "
             "the name of a surface as _";
    if (!odd.empty()) return "the option '" + name + "' (" + source + ") holds " + odd + "; type it anew";
    if (name.size() > longest_name)
      return "an option of " + std::to_string(name.size()) + " letters (" + source + "); PETSc takes " +
             std::to_string(longest_name);
    if (std::any_of(value.begin(), value.end(), [](unsigned char c) { return (c < 32 && c != '\t') || c == 127; }))
      return "the value of " + name + " (" + source + ") holds a line end or bytes that are no text";
    const std::string key = lower(name);
    // PETSc looks for these before all others and answers other values by a crash
    if (is_one_of(key, {"-options_monitor", "-options_monitor_cancel", "-skip_petscrc", "-petsc_ci", "-help"}) &&
        !is_one_of(lower(value), {"", "1", "0", "true", "false", "yes", "no", "on", "off"}) &&
        !(key == "-help" && value == "intro"))
      return "option " + key + " is on or off, not '" + value + "' (" + source + ")";
    for (auto alias = aliases_.find(key); alias != aliases_.end(); alias = aliases_.find(lower(name)))
      name = alias->second;
    given_.list.push_back({name, value, source});
    return "";
  }

  std::string file(const std::string &option, const std::string &name, bool yaml)
  {
    const std::string named = option + (option.empty() ? "" : " ") + name;
    std::string text;
    if (std::find(asking_.begin(), asking_.end(), name) != asking_.end())
      return named + " asks for itself" + (asking_.back() == name ? "" : " through " + asking_.back()) +
             "; remove that line";
    std::string path = name;
    if (ends_with(path, ":yaml")) {
      path.resize(path.size() - 5);
      yaml = true;
    }
    if (!read_text(path, largest_file + 1, text))
      return named + " cannot be read; check its name" +
             (asking_.empty() ? "" : " (" + asking_.back() + " asks for it)");
    if (text.size() > largest_file) return named + " has more than 4 MB: it holds no options; check its name";
    for (const char *extension : {".yaml", ".yml", ".json"}) yaml = yaml || ends_with(path, extension);
    if (yaml || text.rfind("%YAML ", 0) == 0 || text.rfind("---", 0) == 0) return this->yaml(path, text, named);
    const std::string fault = clean_text(text);
    if (!fault.empty()) return named + ": " + fault;
    asking_.push_back(name);
    int number = 0;
    for (const std::string &line : lines_of(text)) {
      ++number;
      std::vector<Word> words;
      std::string wrong = split(line, words);
      if (wrong.empty()) wrong = form_fault(words);
      if (!wrong.empty()) return named + ": line " + std::to_string(number) + " " + wrong;
      if (words.empty()) continue;
      if (words[0].text == "alias") {
        aliases_[lower(words[1].text)] = words[2].text;
        continue;
      }
      const std::string said = this->option(words[0].text, words.size() > 1 ? &words[1].text : nullptr, name);
      if (!said.empty()) return said;
    }
    asking_.pop_back();
    return "";
  }

  /// What is wrong with a line of a file, which is `-name`, `-name value`, or `alias -new -old`.
  std::string form_fault(const std::vector<Word> &words) const
  {
    if (words.empty()) return "";
    const std::string &name = words[0].text;
    if (name == "alias" && words.size() == 3 && is_name(words[1]) && is_name(words[2]))
      return lower(words[1].text) == lower(words[2].text) || aliases_.count(lower(words[2].text))
                 ? "makes " + words[1].text + " an alias of an alias; name the option itself"
                 : "";
    if (!is_name(words[0])) {
      const std::string odd = look_alike(name);
      return "begins with '" + name + "', which is no option" + (odd.empty() ? "" : ": it holds " + odd) +
             "; write '-name value'";
    }
    if (words.size() > 1 && is_name(words[1]))
      return "holds two options, " + name + " and " + words[1].text +
             "; give each a line of its own, or put a value that begins with a dash in quotes";
    if (words.size() > 2)
      return "has '" + words[2].text + "' after the value of " + name +
             "; write '-name value' and no more, a value with blanks in quotes";
    if (name == "-options_file" && words.size() < 2) return "has -options_file without the name of a file";
    return "";
  }

  GivenOptions &given_;
  std::vector<std::string> asking_, prefixes_;
  std::map<std::string, std::string> aliases_;
};

} // namespace

Surroundings Surroundings::of_process()
{
  const auto variable = [](const char *name) {
    const char *value = std::getenv(name);
    return std::string(value ? value : "");
  };
  return {variable("HOME"), true, variable("PETSC_OPTIONS"), variable("PETSC_OPTIONS_YAML")};
}

GivenOptions read_options(const std::vector<std::string> &words, const Surroundings &around)
{
  GivenOptions given;
  Reader reader(given);
  bool skip = false; // wherever it stands

  if (!words.empty() && lower(words[0]) == "-replay") { // with what surrounded the run, not with what does now
    given.fault = words.size() < 2 || is_name(words[1]) ? "-replay needs the directory of a run that failed"
                                                        : reader.replay(words[1]);
    if (given.fault.empty()) given.fault = reader.command_line({words.begin() + 2, words.end()});
    if (given.fault.empty()) given.fault = reader.end();
    return given;
  }
  for (std::size_t i = 0; i < words.size(); ++i)
    if (lower(words[i]) == "-skip_petscrc")
      skip = i + 1 == words.size() || !is_one_of(lower(words[i + 1]), {"0", "false", "no", "off"});
  if (!skip) {
    if (!around.home.empty()) given.fault = reader.petscrc(around.home + "/.petscrc");
    for (const char *file : {".petscrc", "petscrc"})
      if (given.fault.empty() && around.working_directory) given.fault = reader.petscrc(file);
  }
  if (given.fault.empty()) given.fault = reader.variable("PETSC_OPTIONS", around.options);
  if (given.fault.empty() && !around.options_yaml.empty()) {
    given.unasked.emplace_back("PETSC_OPTIONS_YAML");
    given.fault = reader.yaml("PETSC_OPTIONS_YAML", around.options_yaml, "the environment variable PETSC_OPTIONS_YAML");
  }
  if (given.fault.empty()) given.fault = reader.command_line(words);
  if (given.fault.empty()) given.fault = reader.end();
  if (words.empty() && given.fault.empty() && given.list.empty()) given.question = "usage";
  return given;
}

std::string GivenOptions::packed() const
{
  std::string text;
  const auto add = [&](const std::string &s) { text += s + '\0'; };
  add(fault);
  add(question);
  add(directory);
  add(std::to_string(unasked.size()));
  for (const std::string &s : unasked) add(s);
  for (const GivenOption &o : list) {
    add(o.name);
    add(o.value);
    add(o.source);
  }
  return text;
}

GivenOptions GivenOptions::unpacked(const std::string &text)
{
  GivenOptions given;
  std::size_t at = 0;
  const auto next = [&] {
    const std::size_t end = text.find('\0', at);
    const std::string s = text.substr(at, end - at);
    at = end + 1;
    return s;
  };
  given.fault = next();
  given.question = next();
  given.directory = next();
  for (auto n = std::stoul(next()); n > 0; --n) given.unasked.push_back(next());
  while (at < text.size()) {
    GivenOption o;
    o.name = next();
    o.value = next();
    o.source = next();
    given.list.push_back(o);
  }
  return given;
}

} // namespace pulmo
