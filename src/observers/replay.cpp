#include "pulmo/observers/replay.hpp"

#include "pulmo/base/whole_file.hpp"

#include <cmath>
#include <cstring>
#include <filesystem>
#include <sstream>

namespace pulmo {

namespace {

namespace fs = std::filesystem;

std::string petsc_version()
{
  std::ostringstream text;
  text << PETSC_VERSION_MAJOR << '.' << PETSC_VERSION_MINOR << '.' << PETSC_VERSION_SUBMINOR;
  return text.str();
}

/// Ends a replay when a step was accepted, unless that ends the run.
class FirstStep final : public StopRequest {
public:
  explicit FirstStep(const Simulation &simulation) : simulation_(simulation), before_(simulation.rows().size()) {}
  PetscErrorCode asked(bool &stop) override
  {
    PetscFunctionBeginUser;
    stop = simulation_.rows().size() > before_ && !simulation_.crawls();
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  const Simulation &simulation_;
  std::size_t before_;
};

/// Which value of @p now is not that of @p then, bit for bit.
std::size_t first_difference(const std::vector<double> &then, const std::vector<double> &now)
{
  std::size_t i = 0;
  while (i < then.size() && i < now.size() &&
         (then[i] == now[i] || (std::isnan(then[i]) && std::isnan(now[i])))) // any NaN is as good as another
    ++i;
  return i;
}

} // namespace

PetscErrorCode Replay::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("replay", "the end of a run that could not go on, once more");
  PetscCall(options.text("",
                         "directory of a run that failed in a step: repeat its last attempts, with its options, and "
                         "write nothing; comes first, options after it replace those of the run",
                         folder_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Replay::check()
{
  const MPI_Comm comm = options_.comm();
  PetscMPIInt rank, size;
  std::string complaint, note;

  PetscFunctionBeginUser;
  for (const std::string &name : options_.given_after("-replay"))
    for (const char *other : {"-restart", "-dry_run", "-scene_view_only"})
      PulmoUserCheck(
          name != other, comm,
          "%s does not go with -replay, which repeats the end of a run from its last good state; leave one out", other);
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  if (rank == 0) {
    std::string found;
    complaint = file_.read(folder_, found);
    const std::string named = "-replay " + folder_;
    const std::string mesh = complaint.empty() ? hash_of_file(file_.mesh) : "";
    if (!complaint.empty()) {
    } else if (file_.version != PULMO_VERSION || file_.petsc != petsc_version())
      complaint = named + ": the run was one of pulmo " + file_.version + " with PETSc " + file_.petsc + ", this is " +
                  PULMO_VERSION + " with " + petsc_version() +
                  ": the same numbers cannot be expected; replay it with that one, or go on from the run's "
                  "checkpoint.h5 with -restart";
    else if (file_.ranks != size)
      complaint = named + ": the run had " + std::to_string(file_.ranks) + " rank" + (file_.ranks > 1 ? "s" : "") +
                  ", this one has " + std::to_string(size) +
                  ": sums round differently; give as many, or go on from the run's checkpoint.h5 with -restart";
    else if (mesh != file_.mesh_hash)
      complaint = named + ": the mesh file " + file_.mesh +
                  (mesh.empty() ? " cannot be read" : " has changed since the run") +
                  "; put that of the run in its place";
    if (rounding_environment() != file_.environment) note = "OMP_NUM_THREADS, OPENBLAS_NUM_THREADS and the like";
  }
  PetscCall(from_root(comm, complaint));
  PulmoUserCheck(complaint.empty(), comm, "%s", complaint.c_str());
  if (!note.empty())
    PetscCall(PetscPrintf(
        comm, "pulmo: warning: -replay: %s are not set as for the run: numbers may round differently\n", note.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Replay::compared(const AttemptRecord &now, std::size_t i, bool &same) const
{
  std::ostringstream text;

  text << "dt " << now.begin.dt << " s, " << now.outcome << ", " << now.norms.size() << " residuals: ";
  same = false;
  if (i >= file_.attempts.size()) {
    text << "the run made no such attempt";
    return text.str();
  }
  const ReplayFile::Attempt &then = file_.attempts[i];
  const std::size_t at = first_difference(then.norms, now.norms);
  same = then.dt == now.begin.dt && then.outcome == now.outcome && at == then.norms.size() && at == now.norms.size();
  if (same) {
    text << "as in the run, bit for bit";
  } else if (then.dt != now.begin.dt) {
    text << "in the run dt " << then.dt << " s";
  } else {
    text << "in the run " << then.outcome << ", " << then.norms.size() << " residuals";
    text.precision(17);
    if (at < then.norms.size() && at < now.norms.size())
      text << ", number " << at + 1 << " of them " << then.norms[at] << ", here " << now.norms[at];
  }
  return text.str();
}

PetscErrorCode Replay::make(bool &finished)
{
  const MPI_Comm comm = options_.comm();
  const std::vector<std::string> more = options_.given_after("-replay");
  bool through, all_same = true;
  std::ostringstream told;
  PetscReal begin;

  PetscFunctionBeginUser;
  bool warms_up = file_.warms_up;
  PetscCall(from_root(comm, warms_up));
  if (warms_up) PetscCall(simulation_.warm_up());
  PetscCall(checkpoint_.restore_attempt((fs::path(folder_) / ReplayFile::state).string()));
  begin = simulation_.time();
  for (const std::string &name : more) told << (told.str().empty() ? ", with other options: " : ", ") << name;
  PetscCall(PetscPrintf(comm, "replay of %s from t = %.6g s%s\n", folder_.c_str(), (double)simulation_.time(),
                        told.str().c_str()));
  FirstStep first(simulation_);
  simulation_.heed(first);
  PetscCall(simulation_.run(through));
  finished = through || simulation_.stopped();
  const std::vector<AttemptRecord> &attempts = finished ? simulation_.accepted_attempts() : simulation_.last_attempts();
  for (std::size_t i = 0; i < attempts.size(); ++i) {
    bool same;
    const std::string line = compared(attempts[i], file_.first + i, same); // rank 0 has the file and prints
    all_same = all_same && same;
    PetscCall(PetscPrintf(comm, "  attempt %d: %s\n", (int)(file_.first + i + 1), line.c_str()));
  }
  all_same = all_same && attempts.size() + file_.first == file_.attempts.size();
  PetscCall(from_root(comm, all_same));
  if (!all_same && more.empty())
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: -replay: these attempts are not those of the run, bit for bit: its solver "
                          "keeps more of its past than a replay knows of, or the machine is another\n"));
  if (finished)
    PetscCall(PetscPrintf(comm, "the step to t = %.6g s was accepted: to go on, give the run's options, these ones%s\n",
                          (double)simulation_.time(),
                          begin > 0 ? ", and -restart with its checkpoint.h5" : "; it has to begin anew"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Replay::observe(const StepReport &)
{
  PetscFunctionBeginUser;
  if (simulation_.crawls_soon()) PetscCall(checkpoint_.make_attempt(simulation_.next_attempt(), crawl_image_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Replay::write(const std::string &failure, std::string &text)
{
  const MPI_Comm comm = options_.comm();
  const std::vector<AttemptRecord> &attempts = simulation_.last_attempts();
  std::vector<char> image;
  OptionList given;
  PetscMPIInt rank, size;
  std::string complaint;

  PetscFunctionBeginUser;
  text.clear();
  if (!simulation_.ended_in_step() || attempts.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  const std::size_t begins = simulation_.first_repeatable();
  if (simulation_.crawls())
    image = crawl_image_;
  else
    PetscCall(checkpoint_.make_attempt(attempts[begins].begin, image));
  PetscCall(options_.all_given(given));
  if (rank == 0) {
    std::error_code error;
    ReplayFile file;
    file.version = PULMO_VERSION;
    file.petsc = petsc_version();
    file.ranks = size;
    file.directory = fs::current_path(error).string();
    file.environment = rounding_environment();
    file.failure = failure;
    file.first = begins;
    // else this is the first system, or the checkpoint of that is gone
    file.warms_up = checkpoint_.restart().empty() && (begins > 0 || simulation_.rows().size() > 1);
    for (const auto &[name, value] : given) {
      if (name == "-dm_plex_filename") file.mesh = value;
      if (!prints(name)) file.options.push_back({name, value, options_.source(name)});
    }
    file.mesh_hash = hash_of_file(file.mesh);
    for (const AttemptRecord &a : attempts) file.attempts.push_back({a.begin.dt, a.outcome, a.norms});
    const std::string json = file.text(), folder = output_.path(ReplayFile::folder);
    fs::create_directory(folder, error);
    int wrong = error.value();
    if (wrong == 0) wrong = write_image(folder + "/" + ReplayFile::state, image, true);
    if (wrong == 0)
      wrong = write_whole(folder + "/" + ReplayFile::file, {json.begin(), json.end()}); // last: all is there
    if (wrong != 0) complaint = std::strerror(wrong);
  }
  PetscCall(from_root(comm, complaint));
  text = complaint.empty() ? " To see its last attempts again: -replay " + output_.directory() + "."
                           : " No folder for -replay (" + complaint + ").";
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
