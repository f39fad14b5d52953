// Tables that people write.
#include "pulmo/input/csv.hpp"

#include "pulmo/base/text_file.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/input/user_file.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

namespace pulmo {

namespace {

constexpr std::size_t largest_file = 16 << 20; ///< bytes

std::string trimmed(const std::string &text)
{
  const char *blanks = " \t";
  const auto first = text.find_first_not_of(blanks);
  if (first == std::string::npos) return "";
  std::string word = text.substr(first, text.find_last_not_of(blanks) - first + 1);
  if (word.size() >= 2 && word.front() == '"' && word.back() == '"') word = word.substr(1, word.size() - 2);
  return word;
}

std::vector<std::string> cells_of(const std::string &line)
{
  std::vector<std::string> cells;
  std::size_t begin = 0;
  for (bool more = true; more;) {
    const auto comma = line.find(',', begin);
    more = comma != std::string::npos;
    cells.push_back(trimmed(line.substr(begin, more ? comma - begin : std::string::npos)));
    begin = comma + 1;
  }
  return cells;
}

std::string listed(const std::vector<std::string> &names)
{
  std::string text;
  for (const std::string &name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

} // namespace

PetscErrorCode Csv::parse(MPI_Comm comm, const std::string &file, std::string text,
                          const std::vector<std::string> &known, Csv &table)
{
  int number = 0;

  PetscFunctionBeginUser;
  table = Csv();
  table.comm_ = comm;
  table.file_ = file;
  const std::string fault = clean_text(text);
  PulmoUserCheck(fault.empty(), comm, "%s: %s", file.c_str(), fault.c_str());
  for (const std::string &line : lines_of(text)) {
    ++number;
    const std::string bare = trimmed(line);
    if (bare.empty() || bare.front() == '#') continue;
    const std::vector<std::string> cells = cells_of(line);
    if (std::all_of(cells.begin(), cells.end(), [](const std::string &c) { return c.empty(); })) continue;
    if (table.columns_.empty()) {
      for (std::size_t i = 0; i < cells.size(); ++i) {
        PulmoUserCheck(std::find(known.begin(), known.end(), cells[i]) != known.end(), comm,
                       "%s:%d: unknown column '%s'; the first line names columns, separated by commas, of: %s",
                       file.c_str(), number, cells[i].c_str(), listed(known).c_str());
        PulmoUserCheck(table.columns_.emplace(cells[i], i).second, comm, "%s:%d: two columns '%s'; keep one",
                       file.c_str(), number, cells[i].c_str());
      }
      continue;
    }
    PulmoUserCheck(cells.size() == table.columns_.size(), comm,
                   "%s:%d: %d cells, but the first line names %d columns; separate cells by commas, and leave those "
                   "without a value empty",
                   file.c_str(), number, (int)cells.size(), (int)table.columns_.size());
    table.rows_.push_back(cells);
    table.lines_.push_back(number);
  }
  PulmoUserCheck(!table.rows_.empty(), comm, "%s has no rows below its names of columns", file.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Csv::read(MPI_Comm comm, const std::string &option, const std::string &file,
                         const std::vector<std::string> &known, Csv &table)
{
  std::string text;

  PetscFunctionBeginUser;
  PetscCall(read_user_file(comm, option, file, largest_file, "table", text));
  PetscCall(parse(comm, file, text, known, table));
  PetscFunctionReturn(PETSC_SUCCESS);
}

const std::string &Csv::cell(std::size_t row, const std::string &column) const
{
  static const std::string none;
  const auto found = columns_.find(column);
  return found == columns_.end() ? none : rows_[row][found->second];
}

PetscErrorCode Csv::number(std::size_t row, const std::string &column, Range range,
                           std::optional<PetscReal> &value) const
{
  const std::string &text = cell(row, column);
  char *rest = nullptr;

  PetscFunctionBeginUser;
  value.reset();
  if (text.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal x = std::strtod(text.c_str(), &rest);
  const bool decimal = text.find_first_not_of("+-.0123456789eE") == std::string::npos;
  PulmoUserCheck(decimal && *rest == '\0' && std::isfinite(x), comm_, "%s: %s must be a number, not '%s'",
                 where(row).c_str(), column.c_str(), text.c_str());
  PulmoUserCheck(range.holds(x), comm_, "%s: %s is %s, but must be %s", where(row).c_str(), column.c_str(),
                 text.c_str(), range.text().c_str());
  value = x;
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Csv::hash() const
{
  std::uint64_t h = 0xcbf29ce484222325U; // FNV-1a
  const auto add = [&h](const std::string &text) {
    for (const char c : text + '\n') h = (h ^ static_cast<unsigned char>(c)) * 0x100000001b3U;
  };
  for (std::size_t row = 0; row < rows_.size(); ++row)
    for (const auto &[column, place] : columns_)
      if (!rows_[row][place].empty()) add(std::to_string(row) + "," + column + "," + rows_[row][place]);
  char text[32];
  std::snprintf(text, sizeof(text), "hash %016llx", static_cast<unsigned long long>(h));
  return text;
}

} // namespace pulmo
