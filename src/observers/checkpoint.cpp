#include "pulmo/observers/checkpoint.hpp"

#include "pulmo/base/text_file.hpp"
#include "pulmo/base/whole_file.hpp"
#include "pulmo/mesh/named_parts.hpp"

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <fcntl.h>
#include <filesystem>
#include <sstream>
#include <unistd.h>

namespace pulmo {

namespace {

namespace fs = std::filesystem;

/// Options under these prefixes may change at a restart: the mesh and the programme are compared themselves, the rest
/// does not change what is computed, but how.
constexpr std::array<const char *, 15> free_prefixes{
    "-mesh",       "-ventilator", "-predictor", "-newton",         "-step",  "-output",        "-progress", "-effects",
    "-checkpoint", "-restart",    "-replay",    "-error_estimate", "-scene", "-sensitivities", "-sweep"};
/// Prefixes of options that change no number but rounding, and of what is compared by itself.
constexpr std::array<const char *, 22> aside{"-mesh",
                                             "-ventilator",
                                             "-output",
                                             "-progress",
                                             "-effects",
                                             "-checkpoint",
                                             "-restart",
                                             "-replay",
                                             "-ts_max_time",
                                             "-options",
                                             "-dm_plex",
                                             "-petscpartitioner",
                                             "-log",
                                             "-malloc",
                                             "-info",
                                             "-help",
                                             "-skip_petscrc",
                                             "-no_signal_handler",
                                             "-error_estimate",
                                             "-scene",
                                             "-sensitivities",
                                             "-sweep"};
// no part of the programme
constexpr const char *flow_split = "-ventilator_flow_split", *on_limit_point = "-ventilator_on_limit_point";

template <class List>
bool begins_with_one_of(const List &prefixes, const std::string &option)
{
  return std::any_of(prefixes.begin(), prefixes.end(), [&](const char *prefix) {
    const std::size_t n = std::strlen(prefix);
    return option.compare(0, n, prefix) == 0 && (option.size() == n || option[n] == '_');
  });
}

bool is_free(const std::string &option)
{
  return option != flow_split && option != on_limit_point && begins_with_one_of(free_prefixes, option);
}

std::optional<std::string> value_in(const OptionList &list, const std::string &name)
{
  const auto found = std::find_if(list.begin(), list.end(), [&](const auto &entry) { return entry.first == name; });
  return found == list.end() ? std::optional<std::string>() : found->second;
}

/// Makes a directory's entries survive a loss of power, as far as its file system can.
void sync_directory(const std::string &directory)
{
  const int descriptor = open(directory.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (descriptor < 0) return;
  (void)fsync(descriptor);
  (void)close(descriptor);
}

/// Gives @p newest, which has another name still, the name @p file; what had it is called @p previous then, unless
/// @p spare_previous. At any moment @p file is whole.
int take_place(const std::string &newest, const std::string &file, const std::string &previous, bool spare_previous)
{
  std::error_code error;
  if (!spare_previous && fs::exists(file, error)) {
    const std::string link = previous + ".part";
    fs::remove(link, error);
    fs::create_hard_link(file, link, error);
    if (error) // a file system without links: for a moment there is only the previous one
      fs::rename(file, previous, error);
    else
      fs::rename(link, previous, error);
    if (error) return error.value();
    fs::remove(link, error); // left if both names were the same file already
  }
  fs::rename(newest, file, error);
  return error.value();
}

/// Whether two numbers that come from the same text, perhaps by other sums, are the same; none equals none.
bool same(const std::optional<PetscReal> &a, const std::optional<PetscReal> &b)
{
  constexpr PetscReal rounding = 1e-12;
  if (!a || !b) return !a && !b;
  return std::abs(*a - *b) <= rounding * (std::abs(*a) + std::abs(*b));
}

bool same(const Phase &a, const Phase &b)
{
  return a.name == b.name && a.breath == b.breath && a.control == b.control && same(a.begin, b.begin) &&
         same(a.end, b.end) && same(a.from, b.from) && same(a.to, b.to) && same(a.ramp, b.ramp) &&
         same(a.limit, b.limit) && same(a.trigger_flow, b.trigger_flow) && same(a.trigger_drop, b.trigger_drop) &&
         same(a.cycle, b.cycle) && same(a.dt, b.dt);
}

} // namespace

PetscErrorCode Checkpoint::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("checkpoint", "checkpoint and restart");
  PetscCall(options.real("every", "s", Range::not_negative(),
                         "interval of checkpoints in time of the run, at the first step at or after, and at its end "
                         "(0: only where a signal or a failure ends it)",
                         every_));
  options.group("restart", "checkpoint and restart");
  PetscCall(options.text("", "checkpoint.h5 of the run to go on with", restart_));
  schedule_.emplace(every_, false);
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Checkpoint::restart_directory() const
{
  return fs::absolute(restart_).parent_path().string();
}

PetscErrorCode Checkpoint::observe(const StepReport &step)
{
  std::string complaint;

  PetscFunctionBeginUser;
  const bool end = every_ > 0 && step.phase_ends && step.row.time > step.end - 1e-9 * every_;
  const bool begins = step.rows.size() == 1, cuts = every_ > 0 && step.end_cuts_next && !cut_from_;
  bool due = schedule_->due(step.row.time) || end;
  // an uninterrupted run goes through the state before a step that -ts_max_time cuts, but not through those after it
  if (cut_from_) due = end && *cut_from_ == 0;
  if (cuts) {
    cut_from_ = step.row.time;
    due = !begins;
  }
  if (!due) PetscFunctionReturn(PETSC_SUCCESS);
  if (cuts)
    PetscCall(PetscPrintf(options_.comm(),
                          "pulmo: note: -ts_max_time %.6g cuts the last step: the checkpoint is of t = %.6g s, from "
                          "where a longer run goes on as if it had never stopped\n",
                          (double)step.end, (double)step.row.time));
  else if (cut_from_)
    PetscCall(PetscPrintf(options_.comm(),
                          "pulmo: note: -ts_max_time %.6g cuts the first step: a run that goes on from this checkpoint "
                          "keeps it, and an uninterrupted one does not take it\n",
                          (double)step.end));
  PetscCall(write(complaint));
  PulmoFailureCheck(complaint.empty(), options_.comm(), "%s", complaint.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::write(std::string &complaint)
{
  const MPI_Comm comm = options_.comm();
  const std::string part = path() + ".part";
  std::vector<char> image;
  PetscMPIInt rank;
  int error = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCall(make(nullptr, image));
  if (rank == 0) {
    error = write_image(part, image, true);
    if (error == 0) error = take_place(part, path(), output_.path("checkpoint_previous.h5"), spare_previous_);
    std::error_code ignored;
    if (error != 0) fs::remove(part, ignored);
    sync_directory(output_.directory());
  }
  spare_previous_ = false;
  PetscCallMPI(MPI_Bcast(&error, 1, MPI_INT, 0, comm));
  complaint.clear();
  if (error != 0)
    complaint = "cannot write " + path() + " (" + std::strerror(error) +
                "): free the disk, or go on in another -output_dir; checkpoints that were there are as they were";
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::persist(Archive &archive, const AttemptBegin *begin)
{
  PetscFunctionBeginUser;
  PetscCall(persist_scene(archive));
  if (begin)
    PetscCall(simulation_.persist_attempt(archive, *begin));
  else
    PetscCall(simulation_.persist(archive));
  PetscCall(persist_numerics(archive));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::make(const AttemptBegin *begin, std::vector<char> &image)
{
  std::unique_ptr<Archive> archive;

  PetscFunctionBeginUser;
  if (!order_.ready()) PetscCall(order_.setup(model_.dm()));
  PetscCall(Archive::create(model_, order_, archive));
  PetscCall(persist(*archive, begin));
  PetscCall(archive->finish(image));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::make_attempt(const AttemptBegin &begin, std::vector<char> &image)
{
  PetscFunctionBeginUser;
  PetscCall(make(&begin, image));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::restore_attempt(const std::string &file)
{
  const AttemptBegin begin;
  std::unique_ptr<Archive> archive;

  PetscFunctionBeginUser;
  named_ = "-replay " + file;
  PetscCall(order_.setup(model_.dm()));
  PetscCall(Archive::open(model_, order_, "-replay", file, archive));
  PetscCall(persist(*archive, &begin));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::restore()
{
  std::unique_ptr<Archive> archive;

  PetscFunctionBeginUser;
  named_ = "-restart " + restart_;
  PetscCall(order_.setup(model_.dm()));
  PetscCall(Archive::open(model_, order_, "-restart", restart_, archive));
  PetscCall(persist(*archive, nullptr));
  schedule_->skip(simulation_.time());
  if (simulation_.end_cuts_next()) cut_from_ = simulation_.time(); // this file is the one to go on from, once more
  spare_previous_ = fs::path(restart_).filename() == "checkpoint_previous.h5";
  PetscCall(
      PetscPrintf(options_.comm(), "going on from %s at t = %.6g s\n", restart_.c_str(), (double)simulation_.time()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::persist_scene(Archive &archive)
{
  std::string mesh = order_.identity(), version = PULMO_VERSION, options;

  PetscFunctionBeginUser;
  PetscCall(archive.text("version", version));
  PetscCall(archive.text("mesh", mesh));
  PulmoUserCheck(mesh == order_.identity(), options_.comm(),
                 "%s is a checkpoint of another mesh (%s; this one: %s, coordinates in mm); give that run's "
                 "-dm_plex_filename and -mesh_scale",
                 named_.c_str(), mesh.c_str(), order_.identity().c_str());
  PetscCall(persist_names(archive));
  OptionList own = options_.by_content(options_.own_used());
  // the next phases may be of a mode that has no such option
  const auto may_change = [](const auto &o) {
    return is_free(o.first) || (o.first == on_limit_point && o.second == "stop");
  };
  own.erase(std::remove_if(own.begin(), own.end(), may_change), own.end());
  options = text_of(own);
  PetscCall(archive.text("options", options));
  if (archive.reading()) PetscCall(compare_options(options));
  PetscCall(persist_programme(archive));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::persist_names(Archive &archive)
{
  std::vector<NamedPart> here, there;
  std::string text;

  PetscFunctionBeginUser;
  PetscCall(find_named_parts(scene_.mesh(), here));
  text = text_of(here);
  PetscCall(archive.text("names", text));
  PetscCall(archive.check(read_named_parts(text, there), "names"));
  const std::string differs = difference(there, here);
  PulmoUserCheck(differs.empty(), options_.comm(),
                 "%s is a checkpoint of a mesh with other names: %s; give the mesh of that run", named_.c_str(),
                 differs.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::compare_options(const std::string &stored) const
{
  const OptionList then = named_values(stored), now = options_.by_content(options_.own_used());

  PetscFunctionBeginUser;
  const auto refuse = [&](const std::string &name) -> PetscErrorCode {
    const auto text = [&](const auto &list) { return value_in(list, name).value_or("(not in use)"); };
    PetscFunctionBeginUser;
    PulmoUserError(options_.comm(),
                   "%s is a checkpoint of another scene: there %s is '%s', here '%s'; give the same effects "
                   "and parameters (solver, output, -ts_max_time and phases that begin later may change)",
                   named_.c_str(), name.c_str(), text(then).c_str(), text(now).c_str());
  };
  for (const auto &[name, value] : then) {
    const auto here = value_in(now, name);
    if (!here || !Options::same_value(value, *here)) PetscCall(refuse(name));
  }
  for (const auto &[name, value] : now) // an earlier pulmo did not have all options, and did what is the default now
    if (!is_free(name) && !value_in(then, name) && !options_.at_default(name)) PetscCall(refuse(name));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::persist_numerics(Archive &archive)
{
  OptionList now;
  std::string text;

  PetscFunctionBeginUser;
  PetscCall(options_.all_used(now));
  now = options_.by_content(now);
  now.erase(std::remove_if(now.begin(), now.end(),
                           [](const auto &o) { return begins_with_one_of(aside, o.first) || prints(o.first); }),
            now.end());
  text = text_of(now);
  PetscCall(archive.text("numerics", text));
  PetscCall(archive.text("numerics_changed", numerics_changed_));
  if (!archive.reading() || !numerics_changed_.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  const OptionList then = named_values(text);
  const auto compare = [&](const OptionList &list, const OptionList &other) {
    for (const auto &option : list) {
      const std::string &name = option.first;
      const auto elsewhere = value_in(other, name);
      if (!numerics_changed_.empty() || (elsewhere && Options::same_value(option.second, *elsewhere))) continue;
      const auto told = [&](const OptionList &l) {
        const auto known = value_in(l, name);
        return known ? "'" + *known + "'" : "not given";
      };
      std::ostringstream sentence;
      sentence << name << " was " << told(then) << " until t = " << simulation_.time() << " s and " << told(now)
               << " after it";
      numerics_changed_ = sentence.str();
    }
  };
  compare(then, now);
  compare(now, then);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::persist_programme(Archive &archive)
{
  std::vector<Phase> phases;
  std::string names;
  PetscReal time = simulation_.time();

  PetscFunctionBeginUser;
  if (scene_.facts().ventilator) phases = scene_.facts().ventilator->phases();
  const bool may_end_early = Programme(phases).may_end_early();
  for (const Phase &phase : phases) names += phase.name + "\n";
  PetscCall(archive.text("programme_phases", names));
  PetscCall(archive.table("programme", phases, Phase(), [&](Phase &phase, TableCells &cells) {
    int control = phase.control == Control::flow;
    cells(phase.breath, phase.begin, phase.end, control, phase.from, phase.to, phase.ramp, phase.limit, phase.dt);
    if (may_end_early) cells(phase.trigger_flow, phase.trigger_drop, phase.cycle);
    phase.control = control ? Control::flow : Control::pressure;
  }));
  PetscCall(archive.value("time_s", time));
  if (!archive.reading()) PetscFunctionReturn(PETSC_SUCCESS);
  std::istringstream lines(names);
  for (Phase &phase : phases) std::getline(lines, phase.name);
  // where phases may end early the times of the list are not those of the run
  PetscCall(compare_programme(phases, may_end_early ? PETSC_MAX_REAL : time));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Checkpoint::compare_programme(const std::vector<Phase> &stored, PetscReal time) const
{
  std::vector<Phase> now;

  PetscFunctionBeginUser;
  if (scene_.facts().ventilator) now = scene_.facts().ventilator->phases();
  PulmoUserCheck(stored.empty() == now.empty(), options_.comm(),
                 "%s is a checkpoint of another scene: there -ventilator is %s, here %s; give that run's",
                 named_.c_str(), stored.empty() ? "off" : "in use", now.empty() ? "off" : "in use");
  for (std::size_t i = 0; i < stored.size() && stored[i].begin < time; ++i)
    PulmoUserCheck(i < now.size() && same(stored[i], now[i]), options_.comm(),
                   "%s is a checkpoint of another scene: phase %zu of the ventilator (%s, %.6g to %.6g s), "
                   "which began before the checkpoint at %.6g s, was another; change only phases that begin later",
                   named_.c_str(), i + 1, stored[i].name.c_str(), (double)stored[i].begin, (double)stored[i].end,
                   (double)time);
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
