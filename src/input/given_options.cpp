// Options that were given, held against those that are declared: unknown, misspelt, idle and unused; the help.
#include "pulmo/input/options.hpp"

#include "pulmo/base/words.hpp"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <set>
#include <sstream>

namespace pulmo {

namespace {

/// How many letters must be added, left out, changed or swapped with their neighbour to make @p b of @p a.
std::size_t distance(const std::string &a, const std::string &b)
{
  std::vector<std::vector<std::size_t>> d(a.size() + 1, std::vector<std::size_t>(b.size() + 1));
  for (std::size_t i = 0; i <= a.size(); ++i)
    for (std::size_t j = 0; j <= b.size(); ++j) {
      d[i][j] = std::max(i, j);
      if (i == 0 || j == 0) continue;
      d[i][j] = std::min({d[i - 1][j] + 1, d[i][j - 1] + 1, d[i - 1][j - 1] + (a[i - 1] != b[j - 1])});
      if (i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1])
        d[i][j] = std::min(d[i][j], d[i - 2][j - 2] + 1);
    }
  return d[a.size()][b.size()];
}

/// Whether the last `-name` of the list says off.
bool turned_off(const OptionList &list, const std::string &name)
{
  bool off = false;
  for (const auto &[option, value] : list)
    if (option == "-" + name) off = truth(value) == false;
  return off;
}

/// Whether whoever gave @p name knew that @p off, the last word on its effect, turns the effect off. What comes after
/// that does. So does what stands beside it in one file or on the command line, unless the effect was turned on before:
/// then it belongs to that.
bool contradicts(const OptionList &sources, const std::string &name, const std::string &off)
{
  const auto last = [&](const std::string &option) {
    return std::find_if(sources.rbegin(), sources.rend(), [&](const auto &s) { return s.first == option; });
  };
  const auto setting = last(name), by = last(off);
  if (setting == sources.rend() || by == sources.rend()) return false;
  const bool after = setting < by; // both count from the end
  const bool on_before = std::any_of(std::next(by), sources.rend(), [&](const auto &s) { return s.first == off; });
  return after || (setting->second == by->second && !on_before);
}

/// Options that PETSc reads when it ends.
bool read_at_end(const std::string &option)
{
  static const std::set<std::string> list{
      "-options_left", "-options_view", "-log_view",    "-log_view_memory", "-log_view_gpu_time", "-log_all",
      "-log_trace",    "-log_sync",     "-log_exclude", "-malloc_dump",     "-malloc_view",       "-malloc_debug",
      "-malloc_info",  "-malloc_test",  "-memory_view", "-objects_dump",    "-get_total_flops",   "-citations",
      "-mpidump",      "-log",          "-log_mpe"};
  return list.count(option) > 0;
}

/// Options of pulmo's that moved, and where to.
struct Renamed {
  const char *before;
  struct {
    const char *name, *why;
  } now;
};

constexpr Renamed renamed[] = {
    {"-airflow_porosity", {"-tissue_porosity", "it belongs to the tissue, whether air flows or not"}}};

/// Options that a solver reads when it has gone through a phase.
bool read_after_steps(const std::string &option)
{
  return begins_with(option, "-ts_") && option.find("view") != std::string::npos;
}

/// Options of the blocks displacement and pressure and of their coupling. @p of_one: those that a scene with one field
/// leaves unused, where the whole matrix takes the preconditioner of the displacement.
bool is_of_blocks(const std::string &option, bool of_one)
{
  static const std::set<std::string> coupling{"type",
                                              "schur_fact_type",
                                              "schur_factorization_type",
                                              "schur_precondition",
                                              "schur_scale",
                                              "default",
                                              "block_size",
                                              "dm_splits",
                                              "diag_use_amat",
                                              "off_diag_use_amat",
                                              "gkb_tol",
                                              "gkb_maxit",
                                              "gkb_delay",
                                              "gkb_nu",
                                              "gkb_monitor",
                                              "detect_coupling",
                                              "detect_saddle_point"};
  const std::string own = "-pc_fieldsplit_", pressure = "-fieldsplit_pressure_",
                    displacement = "-fieldsplit_displacement_";
  return (begins_with(option, own) && coupling.count(option.substr(own.size())) > 0) || begins_with(option, pressure) ||
         begins_with(option, of_one ? displacement + "ksp_" : displacement);
}

/// Options of the levels of a multigrid, which may have a single one.
bool is_of_levels(const std::string &option)
{
  const std::size_t at = option.rfind("mg_levels_");
  if (at == std::string::npos) return false;
  const std::string tail = option.substr(at + std::string("mg_levels_").size());
  static const std::set<std::string> list{
      "ksp_type",   "ksp_max_it",     "pc_type", "pc_sor_local_forward", "pc_sor_local_symmetric",
      "pc_sor_its", "esteig_ksp_type"};
  return list.count(tail) > 0;
}

} // namespace

std::string Options::nearest(const std::string &name, std::size_t most) const
{
  std::string best;
  std::size_t least = most + 1;
  const auto try_name = [&](const std::string &known) {
    const std::size_t away = distance(known, name);
    if (away < least) {
      least = away;
      best = known;
    }
  };
  for (const Declared &d : declared_) try_name(d.name);
  for (const std::string &known : petsc_names()) try_name(known);
  return best;
}

/// The option that @p name, which nothing declared, must be meant for; empty if it may be one of PETSc's.
std::string Options::misspelt(const std::string &name) const
{
  // PETSc has thousands of names, some a letter away from one another: only those that make a scene are guarded
  static constexpr const char *essential[] = {"-dm_plex_filename", "-options_file", "-pc_type", "-ts_dt",
                                              "-ts_max_time"};
  constexpr std::size_t letters_per_slip = 4;
  const std::string guess = nearest(name, std::min<std::size_t>(2, (name.size() - 1) / letters_per_slip));
  const auto same = [&](const Declared &d) { return d.name == guess; };
  if (std::any_of(declared_.begin(), declared_.end(), same) ||
      (guess != name && guess[1] == name[1] &&
       std::find(std::begin(essential), std::end(essential), guess) != std::end(essential)))
    return guess;
  const std::string tail = "_" + name.substr(1); // -pip for -ventilator_pip
  for (const bool in_use : {true, false})
    for (const Declared &d : declared_)
      if (groups_[d.group].in_use == in_use && tail.size() > 3 && d.name.size() > tail.size() &&
          d.name.compare(d.name.size() - tail.size(), tail.size(), tail) == 0)
        return d.name;
  return "";
}

std::string Options::hint(const std::string &guess) const
{
  if (guess.empty()) return "";
  std::string needs;
  for (const Declared &d : declared_) {
    if (d.name != guess) continue;
    if (groups_[d.group].in_use) return ": did you mean " + guess + "?";
    needs = groups_[d.group].enabled_by;
  }
  return ": did you mean " + guess + (needs.empty() ? "?" : ", which needs " + needs + "?");
}

PetscErrorCode Options::all_given(OptionList &list) const
{
  char *text = nullptr, **left_names, **left_values;
  std::size_t length = 0;
  PetscInt n_left;
  std::map<std::string, std::string> left; // without dash
  PetscViewer viewer;

  PetscFunctionBeginUser;
  list.clear();
  // PETSc lists names one a line, and values between blanks that may belong to them; it tells the value of a name alone
  // only by marking the option as used
  PetscCall(PetscOptionsLeftGet(nullptr, &n_left, &left_names, &left_values));
  for (PetscInt i = 0; i < n_left; ++i) left[left_names[i]] = left_values[i] ? left_values[i] : "";
  PetscCall(PetscOptionsLeftRestore(nullptr, &n_left, &left_names, &left_values));
  std::FILE *memory = open_memstream(&text, &length);
  PetscCheck(memory, PETSC_COMM_SELF, PETSC_ERR_MEM, "no memory for the list of options");
  PetscCall(PetscViewerASCIIOpenWithFILE(PETSC_COMM_SELF, memory, &viewer));
  PetscCall(PetscOptionsView(nullptr, viewer));
  PetscCall(PetscViewerDestroy(&viewer));
  std::fclose(memory);
  std::istringstream lines(std::string(text, length));
  std::free(text);
  for (std::string line; std::getline(lines, line);) {
    if (line.empty() || line[0] != '-') continue; // a heading
    const std::string name = line.substr(0, line.find(' '));
    const auto unused = left.find(name.substr(1));
    const char *value = nullptr;
    if (unused != left.end())
      value = unused->second.c_str();
    else
      PetscCall(PetscOptionsFindPair(nullptr, nullptr, name.c_str(), &value, nullptr));
    list.emplace_back(name, value ? value : "");
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Options::source(const std::string &name) const
{
  const auto found = std::find_if(sources_.rbegin(), sources_.rend(), [&](const auto &s) { return s.first == name; });
  return found == sources_.rend() ? "" : found->second;
}

std::vector<std::string> Options::given_after(const std::string &name) const
{
  std::vector<std::string> names;
  auto at = std::find_if(sources_.begin(), sources_.end(), [&](const auto &s) { return s.first == name; });
  while (at != sources_.end() && ++at != sources_.end()) names.push_back(at->first);
  return names;
}

OptionList Options::own_used() const
{
  OptionList list;
  for (const Declared &d : declared_)
    if (groups_[d.group].in_use) list.emplace_back(d.name, d.used);
  return list;
}

std::vector<Options::RealOption> Options::real_options() const
{
  std::vector<RealOption> list;
  for (const Declared &d : declared_)
    if (groups_[d.group].in_use && d.target) {
      const auto copies = copies_.find(d.target);
      list.push_back({d.name, d.unit, d.target, copies == copies_.end() ? std::vector<PetscReal *>() : copies->second});
    }
  return list;
}

std::vector<Options::Setting> Options::settings(const std::string &group) const
{
  const std::string prefix = "-" + group;
  std::vector<Setting> list;
  for (const Declared &d : declared_) {
    if (groups_[d.group].name != group || !groups_[d.group].in_use) continue;
    const bool kind = d.unit == "-" || d.unit == "on/off" || d.unit == "text" || begins_with(d.unit, "one of ") ||
                      begins_with(d.unit, "names,"); // of value, and no unit
    std::string name = d.name.substr(std::min(d.name.size(), prefix.size() + 1));
    std::replace(name.begin(), name.end(), '_', ' ');
    list.push_back({name, d.used, kind ? "" : d.unit});
  }
  return list;
}

bool Options::at_default(const std::string &name) const
{
  return std::any_of(declared_.begin(), declared_.end(),
                     [&](const Declared &d) { return d.name == name && same_value(d.used, d.value); });
}

bool Options::same_value(const std::string &a, const std::string &b)
{
  if (a == b || (truth(a) && truth(a) == truth(b))) return true;
  const std::vector<std::string> parts_a = split(a, ','), parts_b = split(b, ',');
  return std::equal(parts_a.begin(), parts_a.end(), parts_b.begin(), parts_b.end(),
                    [](const std::string &x, const std::string &y) {
                      char *end_x = nullptr, *end_y = nullptr;
                      const double number_x = std::strtod(x.c_str(), &end_x), number_y = std::strtod(y.c_str(), &end_y);
                      return x == y || (*end_x == '\0' && *end_y == '\0' && number_x == number_y);
                    });
}

PetscErrorCode Options::all_used(OptionList &list) const
{
  OptionList given;

  PetscFunctionBeginUser;
  list = own_used();
  PetscCall(all_given(given));
  for (const auto &[name, value] : given) {
    const std::string &option = name;
    const auto same = [&](const Declared &d) { return d.name == option; };
    if (std::none_of(declared_.begin(), declared_.end(), same)) list.emplace_back(name, value);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::check_unknown() const
{
  OptionList list;

  PetscFunctionBeginUser;
  PetscCall(all_given(list));
  for (const auto &[name, value] : list) {
    const Declared *idle = nullptr;
    bool in_use = false;
    for (const Declared &d : declared_) {
      if (d.name != name) continue;
      if (groups_[d.group].in_use || d.tolerated)
        in_use = true;
      else
        idle = &d;
    }
    // an effect that the user turned off on purpose may keep its settings (from a scene file)
    const std::string effect = idle ? "-" + groups_[idle->group].name : "";
    const bool off = idle && turned_off(list, groups_[idle->group].name);
    if (in_use || (off && !contradicts(sources_, name, effect))) continue;
    PulmoUserCheck(!off, comm_,
                   "option %s (%s) has no effect in this scene, for %s is off (%s); leave it out, or leave out %s off",
                   name.c_str(), source(name).c_str(), effect.c_str(), source(effect).c_str(), effect.c_str());
    for (const auto &[before, now] : renamed)
      PulmoUserCheck(name != before, comm_, "option %s is called %s now: %s; give %s %s", name.c_str(), now.name,
                     now.why, now.name, value.c_str());
    PulmoUserCheck(!idle, comm_, "option %s has no effect in this scene: it needs %s", name.c_str(),
                   groups_[idle->group].enabled_by.c_str());
    for (const Group &group : groups_) {
      const std::string prefix = "-" + group.name;
      const bool ours = !group.name.empty() && name.compare(0, prefix.size(), prefix) == 0 &&
                        (name.size() == prefix.size() || name[prefix.size()] == '_');
      if (!ours) continue;
      const std::string guess = nearest(name, name.size() / 3 + 1);
      PulmoUserError(comm_, "unknown option %s%s; pulmo -help lists all", name.c_str(), hint(guess).c_str());
    }
    const std::string small = lower(name), meant = misspelt(small);
    PulmoUserCheck(name.compare(0, 2, "--") != 0, comm_, "unknown option %s: options begin with one dash%s",
                   name.c_str(), hint(nearest(name.substr(1), 0)).c_str());
    PulmoUserCheck(meant.empty(), comm_, "unknown option %s%s; pulmo -help lists all", name.c_str(),
                   hint(meant).c_str());
    // PETSc takes capitals for small letters, what pulmo checks would pass it by
    PulmoUserCheck(name == small, comm_, "unknown option %s: names of PETSc's options are in small letters, %s",
                   name.c_str(), small.c_str());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::warn_unused(bool two_fields, bool at_end)
{
  OptionList given;
  PetscInt n;
  char **names, **values;
  int idle = 0;
  std::string pc_type;

  PetscFunctionBeginUser;
  PetscCall(all_given(given));
  for (const auto &[name, value] : given)
    if (name == "-pc_type") pc_type = value;
  const bool splits = two_fields && pc_type == PCFIELDSPLIT;
  PetscCall(PetscOptionsLeftGet(nullptr, &n, &names, &values));
  for (PetscInt i = 0; i < n; ++i) {
    const std::string name = std::string("-") + names[i];
    if (read_at_end(name) || (!at_end && read_after_steps(name)) || told_.count(name)) continue;
    told_.insert(name);
    if (!splits && is_of_blocks(name, pc_type == PCFIELDSPLIT)) {
      ++idle;
      continue;
    }
    if (is_of_levels(name)) continue;
    const std::string from = source(name);
    std::string guess = nearest(name, name.size() / 4 + 1);
    if (guess == name || std::any_of(given.begin(), given.end(), [&](const auto &o) { return o.first == guess; }))
      guess = "";
    PetscCall(PetscPrintf(comm_, "pulmo: warning: option %s%s was not used%s\n", name.c_str(),
                          from.empty() || from == "command line" ? "" : (" (" + from + ")").c_str(),
                          hint(guess).c_str()));
  }
  PetscCall(PetscOptionsLeftRestore(nullptr, &n, &names, &values));
  // solver files serve scenes of one and of two fields
  if (idle > 0 && pc_type != PCFIELDSPLIT)
    PetscCall(PetscPrintf(comm_,
                          "pulmo: note: with -pc_type %s nothing uses the %d options of -pc_fieldsplit and "
                          "-fieldsplit\n",
                          pc_type.c_str(), idle));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::print_help() const
{
  std::string last;

  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(
      comm_, "pulmo's own options (beside PETSc's: -dm_plex_filename, -ts_*, -snes_*, -ksp_*, -pc_*).\nParameters of "
             "laws and effects may differ from place to place: -tissue_c 0.36,right_lung=0.7 gives "
             "a value\nto a volume of the mesh (or to a surface, where the effect acts on surfaces) and another to "
             "the rest,\n-tissue_c FILE.h5:dataset one to each tetrahedron in the order of the mesh file "
             "(docs/running.md).\n"));
  for (const Declared &d : declared_) {
    const std::string &about = groups_[d.group].about;
    if (about != last) PetscCall(PetscPrintf(comm_, "\n%s\n", about.c_str()));
    last = about;
    PetscCall(PetscPrintf(comm_, "  %-34s %s [%s]%s (default %s)\n", d.name.c_str(), d.help.c_str(), d.unit.c_str(),
                          d.range.empty() || d.range == "any" ? "" : (" " + d.range).c_str(),
                          d.value.empty() ? "none" : d.value.c_str()));
  }
  PetscCall(PetscPrintf(comm_, "\nExit code: 0 finished, 1 wrong input, 2 could not go on, 3 stopped by a signal and "
                               "there is a checkpoint to go on from (docs/running.md)\n"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Options::print_settled() const
{
  PetscFunctionBeginUser;
  for (const Declared &d : declared_)
    if (d.settled) PetscCall(PetscPrintf(comm_, "pulmo: in this scene %s is %s\n", d.name.c_str(), d.used.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
