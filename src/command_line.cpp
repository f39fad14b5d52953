#include "pulmo/command_line.hpp"

#include "pulmo/petsc.hpp"

#include <algorithm>
#include <filesystem>
#include <fstream>

namespace pulmo {

namespace {

/// Whether PETSc takes a word for the name of an option.
bool is_option(const std::string &word)
{
  PetscBool valid = PETSC_FALSE;
  (void)PetscOptionsValidKey(word.c_str(), &valid); // needs no PetscInitialize
  return valid;
}

/// A file that PETSc reads as YAML.
bool is_yaml(const std::string &file)
{
  const std::string extension = std::filesystem::path(file).extension();
  return extension == ".yaml" || extension == ".yml" || extension == ".json";
}

/// The words of a line of an option file; a value in quotes is one word. False if a quote is not closed.
bool split(const std::string &line, std::vector<std::string> &words)
{
  constexpr const char *space = " \t\r\n";
  words.clear();
  for (std::size_t at = line.find_first_not_of(space); at != std::string::npos;
       at = line.find_first_not_of(space, at)) {
    const bool quoted = line[at] == '"';
    const std::size_t end = quoted ? line.find('"', at + 1) : line.find_first_of(space, at);
    if (quoted && end == std::string::npos) return false;
    words.push_back(line.substr(at + quoted, end - at - quoted));
    if (end == std::string::npos) break;
    at = end + quoted;
  }
  return true;
}

/// What is wrong with a line of a file, which is `-name`, `-name value`, or `alias -new -old`; @p words: what it says.
std::string line_fault(const std::string &line, std::vector<std::string> &words)
{
  const auto odd = [](unsigned char c) { return (c < 32 && c != '\t' && c != '\r') || c == 127; };
  words.clear();
  if (std::any_of(line.begin(), line.end(), odd)) return "holds bytes that are no text";
  if (!split(line.substr(0, line.find('#')), words)) return "opens a quote and does not close it";
  if (words.empty()) return "";
  if (words[0] == "alias" && words.size() == 3 && is_option(words[1]) && is_option(words[2])) return "";
  if (!is_option(words[0])) return "begins with '" + words[0] + "', which is no option; write '-name value'";
  if (words.size() > 1 && is_option(words[1]))
    return "holds two options, " + words[0] + " and " + words[1] + "; give each a line of its own";
  if (words.size() > 2)
    return "has '" + words[2] + "' after the value of " + words[0] + "; write '-name value' and no more";
  if (words[0] == "-options_file" && words.size() < 2) return "has -options_file without the name of a file";
  return "";
}

/// What is wrong with a file and those that it asks for; @p asking: the files that led here.
std::string file_fault(const std::string &file, std::vector<std::string> &asking)
{
  const std::string named = "-options_file " + file;
  std::error_code error;
  std::ifstream in;
  if (std::find(asking.begin(), asking.end(), file) != asking.end())
    return named + " asks for itself" + (asking.back() == file ? "" : " through " + asking.back()) +
           "; remove that line";
  if (is_yaml(file)) return "";
  if (std::filesystem::is_regular_file(file, error)) in.open(file); // what flows through a pipe is gone after a look
  if (!in.is_open()) return named + " cannot be read; check its name";
  asking.push_back(file);
  std::vector<std::string> words;
  std::string line;
  for (int number = 1; std::getline(in, line); ++number) {
    std::string fault = line_fault(line, words);
    if (!fault.empty()) return named + ": line " + std::to_string(number) + " " + fault;
    if (words.empty() || words[0] != "-options_file") continue;
    fault = file_fault(words[1], asking);
    if (!fault.empty()) return fault;
  }
  asking.pop_back();
  return "";
}

} // namespace

std::string command_line_fault(const std::vector<std::string> &words)
{
  std::vector<std::string> asking;
  for (std::size_t i = 0; i < words.size(); ++i) {
    const std::string &name = words[i];
    if (!is_option(name))
      return "'" + name + "' on the command line belongs to no option" +
             (i > 1 ? ": it follows the value of " + words[i - 2] : "") + "; options are written -name value";
    const bool has_value = i + 1 < words.size() && !is_option(words[i + 1]);
    if (name == "-options_file") {
      if (!has_value) return "-options_file needs the name of a file";
      const std::string fault = file_fault(words[i + 1], asking);
      if (!fault.empty()) return fault;
    }
    if (has_value) ++i;
  }
  return "";
}

} // namespace pulmo
