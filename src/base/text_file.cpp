#include "pulmo/base/text_file.hpp"

#include <algorithm>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <utility>

namespace pulmo {

std::string clean_text(std::string &text)
{
  const auto begins = [&](const char *mark) { return text.rfind(mark, 0) == 0; };
  if (begins("\xFF\xFE") || begins("\xFE\xFF")) return "is saved as UTF-16; save it as UTF-8 or plain text";
  if (begins("\xEF\xBB\xBF")) text.erase(0, 3);
  std::string clean;
  clean.reserve(text.size());
  int line = 1;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto c = static_cast<unsigned char>(text[i]);
    if (c == '\r' || c == '\n') {
      if (c == '\r' && i + 1 < text.size() && text[i + 1] == '\n') ++i;
      clean += '\n';
      ++line;
    } else if ((c < 32 && c != '\t' && c != '\f' && c != '\v') || c == 127) {
      return "line " + std::to_string(line) + " holds bytes that are no text" +
             (c == 0 ? " (UTF-16?); save it as UTF-8 or plain text" : "; check that this is the right file");
    } else {
      clean += c == '\f' || c == '\v' ? ' ' : text[i];
    }
  }
  text = std::move(clean);
  return "";
}

std::vector<std::string> lines_of(const std::string &text)
{
  std::vector<std::string> lines;
  for (std::size_t from = 0; from < text.size();) {
    const std::size_t end = std::min(text.find('\n', from), text.size());
    lines.push_back(text.substr(from, end - from));
    from = end + 1;
  }
  return lines;
}

std::string text_of(const NamedValues &list)
{
  std::string text;
  for (const auto &[name, value] : list) text += name + " " + value + "\n";
  return text;
}

NamedValues named_values(const std::string &text)
{
  NamedValues list;
  for (const std::string &line : lines_of(text)) {
    const std::size_t blank = line.find(' ');
    if (!line.empty())
      list.emplace_back(line.substr(0, blank), blank == std::string::npos ? "" : line.substr(blank + 1));
  }
  return list;
}

bool read_text(const std::string &file, std::size_t most, std::string &text)
{
  std::error_code error;
  if (std::filesystem::is_directory(file, error)) return false;
  std::ifstream in(file, std::ios::binary);
  if (!in.is_open()) return false;
  text.resize(most);
  in.read(text.data(), static_cast<std::streamsize>(most));
  text.resize(static_cast<std::size_t>(in.gcount()));
  return !in.bad();
}

std::string look_alike(const std::string &word)
{
  static const std::pair<const char *, const char *> others[] = {
      {"\xC2\xA0", "a no-break space"},        {"\xE2\x80\x8B", "a zero-width space"},
      {"\xEF\xBB\xBF", "a byte order mark"},   {"\xE2\x80\xAF", "a narrow no-break space"},
      {"\xE2\x80\x90", "a Unicode hyphen"},    {"\xE2\x80\x91", "a no-break hyphen"},
      {"\xE2\x80\x93", "an en dash"},          {"\xE2\x80\x94", "an em dash"},
      {"\xE2\x88\x92", "a Unicode minus sign"}};
  for (const auto &[bytes, name] : others)
    if (word.find(bytes) != std::string::npos) return name;
  return "";
}

} // namespace pulmo
