#include "pulmo/input/options.hpp"

#include "pulmo/base/words.hpp"
#include "pulmo/input/cell_values.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <numeric>
#include <optional>
#include <sstream>

namespace pulmo {

namespace {

std::string number_text(double v)
{
  std::ostringstream s;
  s << v;
  return s.str();
}

/// Whether a value is FILE:dataset. Names of the mesh may hold a colon, too, but they follow a number.
bool names_dataset(const std::string &value)
{
  const std::size_t colon = value.rfind(':');
  if (colon == std::string::npos || colon == 0 || colon + 1 == value.size()) return false;
  char *end = nullptr;
  (void)std::strtod(value.c_str(), &end);
  return end == value.c_str() || (*end != ',' && *end != '\0' && *end != ' ');
}

} // namespace

std::string Range::text() const
{
  const bool below = std::isfinite(low), above = std::isfinite(high);
  const std::string lt = open ? " < " : " <= ", gt = open ? "> " : ">= ";
  if (below && above) return number_text(low) + lt + "value" + lt + number_text(high);
  if (below) return gt + number_text(low);
  if (above) return (open ? "< " : "<= ") + number_text(high);
  return "any";
}

void Options::group(const std::string &name, const std::string &about, bool in_use, const std::string &enabled_by)
{
  groups_.push_back({name, about, enabled_by, in_use});
}

std::string Options::full(const std::string &name) const
{
  const std::string &group = groups_.back().name;
  std::string option = "-" + group + (group.empty() || name.empty() ? "" : "_") + name;
  std::replace(option.begin(), option.end(), ' ', '_'); // of a surface's name
  return option;
}

PetscErrorCode Options::given(const std::string &name, bool &is_given) const
{
  PetscBool has;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsHasName(nullptr, nullptr, full(name).c_str(), &has));
  is_given = has;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::find(const std::string &name, const std::string &default_value, const std::string &unit,
                             const std::string &range, const std::string &help, std::string &raw, bool &is_given)
{
  const std::string option = full(name);
  const Group &group = groups_.back();
  const char *value = nullptr;
  PetscBool has;

  PetscFunctionBeginUser;
  for (const Declared &d : declared_)
    PulmoUserCheck(
        d.group != groups_.size() - 1 || lower(d.name) != lower(option), comm_,
        "option %s would belong to two surfaces: capital letters do not count in the names of options, and a "
        "blank counts as _; rename one of the surfaces in gmsh",
        option.c_str());
  declared_.push_back({option, default_value, unit, range, help, default_value, groups_.size() - 1});
  PetscCall(PetscOptionsFindPair(nullptr, nullptr, option.c_str(), &value, &has));
  is_given = has && group.in_use; // check_unknown() reports an option of an effect or law that is not in use
  if (has) raw = value ? value : "";
  if (is_given) declared_.back().used = raw;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::parse_number(const std::string &option, const std::string &raw, const std::string &unit,
                                     const Range &range, double &value) const
{
  char *end = nullptr;

  PetscFunctionBeginUser;
  value = std::strtod(raw.c_str(), &end);
  PulmoUserCheck(!raw.empty() && *end == '\0' && std::isfinite(value), comm_, "option %s takes a number (%s), not '%s'",
                 option.c_str(), unit.c_str(), raw.c_str());
  PulmoUserCheck(range.holds(value), comm_, "option %s %s (%s) is out of range; it must be %s", option.c_str(),
                 raw.c_str(), unit.c_str(), range.text().c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::real(const std::string &name, const std::string &unit, Range range, const std::string &help,
                             PetscReal &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, number_text(value), unit, range.text(), help, raw, is_given));
  declared_.back().target = &value;
  if (is_given) {
    drop_varying(value);
    for (auto &[from, copies] : copies_) copies.erase(std::remove(copies.begin(), copies.end(), &value), copies.end());
    PetscCall(parse_varying(full(name), raw, unit, range, value));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::parse_varying(const std::string &option, const std::string &raw, const std::string &unit,
                                      const Range &range, PetscReal &value)
{
  const std::vector<std::string> parts = split(raw, ',');
  double number;
  Varying varying;

  PetscFunctionBeginUser;
  if (names_dataset(raw)) {
    PetscCall(parse_dataset(option, raw, unit, range, value));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (raw.find('=') == std::string::npos) {
    PetscCall(parse_number(option, raw, unit, range, number));
    value = number;
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PulmoUserCheck(!parts.empty() && parts.front().find('=') == std::string::npos, comm_,
                 "option %s begins with the value (%s) of all that is not named, e.g. 1,%s", option.c_str(),
                 unit.c_str(), raw.c_str());
  PetscCall(parse_number(option, parts.front(), unit, range, number));
  value = number;
  varying.option = option;
  varying.unit = unit;
  varying.text = raw;
  varying.target = &value;
  varying.everywhere = value;
  for (std::size_t i = 1; i < parts.size(); ++i) {
    const std::size_t equals = parts[i].rfind('=');
    PulmoUserCheck(equals != std::string::npos && equals > 0, comm_,
                   "option %s: '%s' is no name=value; give e.g. 1,right=2 with names of the mesh's volumes or surfaces",
                   option.c_str(), parts[i].c_str());
    const std::string name = parts[i].substr(0, equals);
    PetscCall(parse_number(option + " (" + name + ")", parts[i].substr(equals + 1), unit, range, number));
    for (const auto &other : varying.by_name)
      PulmoUserCheck(other.first != name, comm_, "option %s names '%s' twice; leave one out", option.c_str(),
                     name.c_str());
    varying.by_name.emplace_back(name, number);
  }
  varying_.push_back(varying);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::parse_dataset(const std::string &option, const std::string &raw, const std::string &unit,
                                      const Range &range, PetscReal &value)
{
  const std::size_t colon = raw.rfind(':');
  auto values = std::make_shared<std::vector<double>>();
  std::string fault;
  double mean = 0;
  PetscMPIInt rank;
  Varying varying;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm_, &rank));
  if (rank == 0) {
    fault = read_cell_values(raw.substr(0, colon), raw.substr(colon + 1), *values);
    const auto bad =
        std::find_if(values->begin(), values->end(), [&](double v) { return !std::isfinite(v) || !range.holds(v); });
    if (fault.empty() && bad != values->end())
      fault = ": value " + std::to_string(bad - values->begin()) + ", counted from 0, is " + number_text(*bad) + " (" +
              unit + "); each must be a number" + (range.text() == "any" ? "" : " " + range.text());
    if (fault.empty())
      mean = std::accumulate(values->begin(), values->end(), 0.0) / static_cast<double>(values->size());
  }
  PetscCall(from_root(comm_, fault));
  PulmoUserCheck(fault.empty(), comm_, "option %s %s%s", option.c_str(), raw.c_str(), fault.c_str());
  PetscCallMPI(MPI_Bcast(&mean, 1, MPI_DOUBLE, 0, comm_));
  value = mean;
  varying.option = option;
  varying.unit = unit;
  varying.text = raw;
  varying.target = &value;
  varying.everywhere = value;
  varying.by_cell = true;
  varying.of_cell = values;
  varying_.push_back(varying);
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Options::varies_by_cell() const
{
  return std::any_of(varying_.begin(), varying_.end(), [](const Varying &v) { return v.by_cell; });
}

OptionList Options::by_content(OptionList list) const
{
  for (auto &[name, value] : list) {
    const auto content = content_.find(name);
    if (content != content_.end()) value = content->second;
  }
  return list;
}

bool Options::varies(const PetscReal &value) const
{
  return std::any_of(varying_.begin(), varying_.end(), [&](const Varying &v) { return v.target == &value; });
}

void Options::hand_down(const PetscReal &from, PetscReal &to)
{
  to = from;
  copies_[&from].push_back(&to);
  for (std::size_t i = 0, n = varying_.size(); i < n; ++i) {
    if (varying_[i].target != &from) continue;
    Varying copy = varying_[i];
    copy.target = &to;
    varying_.push_back(copy);
  }
}

void Options::drop_varying(const PetscReal &value)
{
  varying_.erase(std::remove_if(varying_.begin(), varying_.end(), [&](const Varying &v) { return v.target == &value; }),
                 varying_.end());
}

void Options::only_volumes(const PetscReal &value)
{
  for (Varying &v : varying_)
    if (v.target == &value) v.surfaces = false;
}

PetscErrorCode Options::whole(const std::string &name, const std::string &unit, Range range, const std::string &help,
                              PetscInt &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, std::to_string(value), unit, range.text(), help, raw, is_given));
  if (is_given) {
    double number;
    PetscCall(parse_number(full(name), raw, unit, range, number));
    PulmoUserCheck(number == std::floor(number), comm_, "option %s takes a whole number, not '%s'", full(name).c_str(),
                   raw.c_str());
    value = static_cast<PetscInt>(number);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::flag(const std::string &name, const std::string &help, bool &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, value ? "on" : "off", "on/off", "", help, raw, is_given));
  if (is_given) {
    const std::optional<bool> on = truth(raw);
    PulmoUserCheck(on, comm_, "option %s is on or off, not '%s'", full(name).c_str(), raw.c_str());
    value = *on;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::text(const std::string &name, const std::string &help, std::string &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, value, "text", "", help, raw, is_given));
  if (is_given) {
    PulmoUserCheck(!raw.empty(), comm_, "option %s needs a value", full(name).c_str());
    value = raw;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::choice(const std::string &name, const std::vector<std::string> &choices,
                               const std::string &help, std::string &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, value, "one of " + join(choices, "|"), "", help, raw, is_given));
  if (is_given) {
    PulmoUserCheck(std::find(choices.begin(), choices.end(), raw) != choices.end(), comm_,
                   "option %s knows no '%s'; it takes one of %s", full(name).c_str(), raw.c_str(),
                   join(choices, ", ").c_str());
    value = raw;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::names(const std::string &name, const std::string &help, std::vector<std::string> &value)
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, join(value, ","), "names, separated by commas", "", help, raw, is_given));
  // also of an effect that is not in use: its options for each of these names are then known, too
  if (!raw.empty() || is_given) {
    value = split(raw, ',');
    PulmoUserCheck(!value.empty(), comm_, "option %s names nothing", full(name).c_str());
    auto sorted = value;
    std::sort(sorted.begin(), sorted.end());
    const auto twice = std::adjacent_find(sorted.begin(), sorted.end());
    PulmoUserCheck(twice == sorted.end(), comm_, "option %s names '%s' twice", full(name).c_str(), twice->c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::reals(const std::string &name, const std::string &unit, Range range, const std::string &help,
                              PetscReal value[], std::size_t most, std::size_t &n)
{
  const std::string option = full(name);
  std::string raw, text;
  bool is_given;
  std::vector<std::pair<std::string, std::vector<PetscReal>>> lists{{}}; // that of all that is not named comes first

  PetscFunctionBeginUser;
  for (std::size_t i = 0; i < n; ++i) text += (text.empty() ? "" : ",") + number_text(value[i]);
  PetscCall(find(name, text, unit, "each " + range.text(), help, raw, is_given));
  if (!is_given) PetscFunctionReturn(PETSC_SUCCESS);
  for (const std::string &part : split(raw, ',')) {
    const std::size_t equals = part.rfind('=');
    const bool names = equals != std::string::npos;
    double number;
    if (names) {
      const std::string part_name = part.substr(0, equals);
      for (const auto &other : lists)
        PulmoUserCheck(other.first != part_name, comm_,
                       part_name.empty() ? "option %s: '%s' lacks a name" : "option %s names '%s' twice; leave one out",
                       option.c_str(), part_name.empty() ? part.c_str() : part_name.c_str());
      lists.emplace_back(part_name, std::vector<PetscReal>());
    }
    const std::string &list_name = lists.back().first;
    PetscCall(parse_number(list_name.empty() ? option : option + " (" + list_name + ")",
                           names ? part.substr(equals + 1) : part, unit, range, number));
    lists.back().second.push_back(number);
  }
  const std::size_t count = lists.front().second.size();
  PulmoUserCheck(count > 0, comm_, "option %s begins with the numbers (%s) of all that is not named, not with '%s'",
                 option.c_str(), unit.c_str(), raw.c_str());
  PulmoUserCheck(count <= most, comm_, "option %s takes up to %d numbers, not %d", option.c_str(),
                 static_cast<int>(most), static_cast<int>(count));
  for (const auto &[part_name, list] : lists)
    PulmoUserCheck(list.size() == count, comm_, "option %s has %d numbers for '%s' and %d for all that is not named",
                   option.c_str(), static_cast<int>(list.size()), part_name.c_str(), static_cast<int>(count));
  n = count;
  for (std::size_t i = 0; i < n; ++i) {
    drop_varying(value[i]);
    value[i] = lists.front().second[i];
    Varying varying;
    varying.option = option;
    varying.unit = unit;
    varying.text = raw;
    varying.target = &value[i];
    varying.everywhere = value[i];
    for (std::size_t k = 1; k < lists.size(); ++k) varying.by_name.emplace_back(lists[k].first, lists[k].second[i]);
    if (!varying.by_name.empty()) varying_.push_back(varying);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::vector(const std::string &name, const std::string &unit, const std::string &help,
                               PetscReal value[3])
{
  std::string raw;
  bool is_given;

  PetscFunctionBeginUser;
  PetscCall(find(name, number_text(value[0]) + "," + number_text(value[1]) + "," + number_text(value[2]), unit, "",
                 help, raw, is_given));
  if (is_given) {
    const auto parts = split(raw, ',');
    PulmoUserCheck(parts.size() == 3, comm_, "option %s takes three numbers (%s) separated by commas, not '%s'",
                   full(name).c_str(), unit.c_str(), raw.c_str());
    for (int d = 0; d < 3; ++d) {
      double number;
      PetscCall(parse_number(full(name), parts[d], unit, Range::any(), number));
      value[d] = number;
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::expressions(const std::string &name, const std::string &unit, const std::string &help,
                                    std::vector<Expression> &value)
{
  std::string raw, text;
  bool is_given;
  std::vector<std::pair<std::size_t, std::size_t>> parts; // begin and end
  std::size_t begin = 0;
  int depth = 0;

  PetscFunctionBeginUser;
  for (const Expression &e : value) text += (text.empty() ? "" : ",") + e.text();
  PetscCall(find(name, text, unit, "", help, raw, is_given));
  if (!is_given) PetscFunctionReturn(PETSC_SUCCESS);
  for (std::size_t i = 0; i <= raw.size(); ++i) { // commas between parentheses are those of functions
    if (i < raw.size() && raw[i] == '(') ++depth;
    if (i < raw.size() && raw[i] == ')') --depth;
    if (i < raw.size() && (raw[i] != ',' || depth > 0)) continue;
    const std::size_t first = std::min(raw.find_first_not_of(" \t", begin), i),
                      last = i > first ? raw.find_last_not_of(" \t", i - 1) + 1 : first;
    parts.emplace_back(first, last);
    begin = i + 1;
  }
  PulmoUserCheck(depth <= 0, comm_, "option %s '%s' is wrong at column %d: a parenthesis is not closed",
                 full(name).c_str(), raw.c_str(), static_cast<int>(raw.size() + 1));
  PulmoUserCheck(parts.size() == value.size(), comm_, "option %s takes %s (%s)%s, not '%s'%s", full(name).c_str(),
                 value.size() == 3 ? "three numbers or expressions of x, y, z, t" : "a number or an expression of t",
                 unit.c_str(), value.size() == 3 ? " separated by commas" : "", raw.c_str(),
                 raw.empty() ? " (what begins with a minus and a letter is taken for an option: write (-x))" : "");
  for (std::size_t d = 0; d < value.size(); ++d) {
    std::string fault;
    std::size_t column;
    value[d] = Expression::read(raw.substr(parts[d].first, parts[d].second - parts[d].first), fault, column);
    PulmoUserCheck(fault.empty(), comm_, "option %s '%s' is wrong at column %d: %s", full(name).c_str(), raw.c_str(),
                   static_cast<int>(parts[d].first + column), fault.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Options::tolerate(const std::string &name)
{
  for (Declared &d : declared_) d.tolerated = d.tolerated || d.name == full(name);
}

void Options::settle(const std::string &name, const std::string &group, const std::vector<std::string> &value)
{
  for (Declared &d : declared_)
    if (d.name == "-" + group + "_" + name) {
      d.used = join(value, ",");
      d.settled = true;
    }
}

void Options::turn_off(const std::string &group)
{
  for (Declared &d : declared_)
    if (d.name == "-" + group) {
      d.used = "off";
      d.settled = true;
    }
  for (Group &g : groups_)
    if (g.name == group && !g.enabled_by.empty()) g.in_use = false;
}

} // namespace pulmo
