/// @file
/// Words of options and files: their parts, capitals, and what those of a flag say.
#pragma once

#include <algorithm>
#include <cctype>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

namespace pulmo {

/// The parts between separators, without blanks at their ends; empty ones are left out.
inline std::vector<std::string> split(const std::string &text, char separator)
{
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, separator);) {
    const auto first = part.find_first_not_of(" \t"), last = part.find_last_not_of(" \t");
    if (first != std::string::npos) parts.push_back(part.substr(first, last - first + 1));
  }
  return parts;
}

/// All parts, with a separator between.
inline std::string join(const std::vector<std::string> &parts, const char *separator)
{
  std::string s;
  for (const auto &part : parts) s += (s.empty() ? "" : separator) + part;
  return s;
}

/// As PETSc compares names of options.
inline std::string lower(std::string text)
{
  std::transform(text.begin(), text.end(), text.begin(), [](unsigned char c) { return c < 128 ? std::tolower(c) : c; });
  return text;
}

inline bool begins_with(const std::string &text, const std::string &start)
{
  return text.rfind(start, 0) == 0;
}

/// What the value of a flag says, in any case; empty if it says neither.
inline std::optional<bool> truth(std::string value)
{
  value = lower(value);
  for (const char *yes : {"", "on", "true", "yes", "1"})
    if (value == yes) return true;
  for (const char *no : {"off", "false", "no", "0"})
    if (value == no) return false;
  return {};
}

} // namespace pulmo
