#include "pulmo/observers/output.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/base/whole_file.hpp"

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <sys/stat.h>
#include <system_error>

namespace pulmo {

namespace {

namespace fs = std::filesystem;

/// Whether an open file still has the name @p path.
bool is_at(std::FILE *file, const std::string &path)
{
  struct stat opened {
  }, named{};
  return fstat(fileno(file), &opened) == 0 && stat(path.c_str(), &named) == 0 && opened.st_ino == named.st_ino &&
         opened.st_dev == named.st_dev;
}

} // namespace

PetscErrorCode check_written(MPI_Comm comm, int error, const std::string &file)
{
  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Bcast(&error, 1, MPI_INT, 0, comm));
  PulmoFailureCheck(
      error != ENOENT, comm,
      "cannot write %s: it or its directory was removed while the run was at work; begin again, or go on from a "
      "checkpoint, in another -output_dir",
      file.c_str());
  PulmoFailureCheck(error == 0, comm,
                    "cannot write %s (%s): free the disk or choose another -output_dir; files written before are whole",
                    file.c_str(), std::strerror(error));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode write_text(MPI_Comm comm, const std::string &text, const std::string &file)
{
  PetscMPIInt rank;
  int error = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) error = write_whole(file, {text.begin(), text.end()});
  PetscCall(check_written(comm, error, file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Output::declare(Options &options)
{
  PetscFunctionBeginUser;
  options.group("output", "output");
  PetscCall(options.text("dir", "directory of the results (made if absent)", directory_));
  PetscCall(options.flag("overwrite", "replace a finished run in that directory", overwrite_));
  PetscCall(options.real("fields_every", "s", Range::not_negative(),
                         "interval of field snapshots, at the first step at or after (0: at the end of each phase)",
                         fields_every_));
  PetscCall(options.flag("fields_error_indicator", "write what each cell adds to the error in space (docs/accuracy)",
                         error_indicator_));
  PetscCall(options.names("fields_memory", "write what effects remember: names of quantities, or all", fields_memory_));
  options.group("progress", "progress");
  PetscCall(options.flag("", "one line a step", progress_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::string Output::occupied(bool continues) const
{
  std::error_code error;
  std::string left; // a checkpoint of an earlier run
  if (overwrite_) return "";
  if (fs::exists(path("summary.json"), error))
    return "-output_dir " + directory_ + " holds a finished run; give another directory or -output_overwrite";
  for (const char *name : {"checkpoint_previous.h5", "checkpoint.h5"})
    if (fs::exists(path(name), error)) left = path(name);
  return continues || left.empty()
             ? ""
             : "-output_dir " + directory_ + " holds the checkpoint of an unfinished run: go on with -restart " + left +
                   ", or give another directory or -output_overwrite";
}

PetscErrorCode Output::prepare(const Options &options, const std::string &restart, const std::vector<std::string> &kept)
{
  const MPI_Comm comm = options.comm();
  PetscMPIInt rank;
  bool continues = false;
  std::string complaint, left_by;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  if (rank == 0) {
    std::error_code error;
    continues = !restart.empty() && fs::equivalent(fs::absolute(restart).parent_path(), directory_, error) && !error;
    complaint = RunLock::user_of(directory_);
    if (complaint.empty()) complaint = occupied(continues);
    if (complaint.empty()) {
      fs::create_directories(directory_, error);
      complaint = lock_.take(directory_);
      if (complaint.empty()) complaint = occupied(continues); // by a run that has just ended
      left_by = lock_.left_by();
    }
  }
  PetscCall(from_root(comm, complaint));
  PulmoUserCheck(complaint.empty(), comm, "%s", complaint.c_str());
  if (!left_by.empty())
    PetscCall(PetscPrintf(comm, "pulmo: note: the run that worked in %s before was killed (%s)\n", directory_.c_str(),
                          left_by.c_str()));
  if (rank == 0) { // what an earlier run left must not pass for this one's
    std::error_code error;
    std::vector<fs::path> old;
    for (const char *name : {"scene.json", "summary.json", "failure.json", "signals.csv", "energy.csv", "fields.xdmf",
                             "errors.xdmf", "errors.h5", "sensitivities.xdmf", "sensitivities.h5"})
      old.push_back(path(name));
    if (!continues) // else they are replaced whole
      for (const char *name : {"signals.csv.part", "checkpoint.h5", "checkpoint_previous.h5", "checkpoint.h5.part"})
        old.push_back(path(name));
    for (const auto &entry : fs::directory_iterator(directory_, error)) {
      const std::string name = entry.path().filename().string();
      const bool keep = continues && std::find(kept.begin(), kept.end(), name) != kept.end();
      if (name.rfind("fields", 0) == 0 && entry.path().extension() == ".h5" && !keep) old.push_back(entry.path());
    }
    if (fs::is_directory(path("replay"), error)) // no file of the user's
      for (const char *name : {"replay/replay.json", "replay/state.h5", "replay"}) old.push_back(path(name));
    for (const fs::path &file : old) fs::remove(file, error);
  }
  PetscCallMPI(MPI_Barrier(comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool Schedule::due(PetscReal t)
{
  if (every_ <= 0 || t < next_ - 1e-9 * every_) return false;
  skip(t);
  return true;
}

void Schedule::skip(PetscReal t)
{
  if (every_ > 0) next_ = (std::floor(t / every_ + 1e-9) + 1) * every_;
}

SignalWriter::~SignalWriter()
{
  if (file_) std::fclose(file_);
}

PetscErrorCode SignalWriter::observe(const StepReport &step)
{
  const std::string part = output_.path("signals.csv.part");
  PetscMPIInt rank;
  int error = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm_, &rank));
  if (rank == 0) {
    const bool ventilator = facts_.ventilator != nullptr, flow = ventilator || facts_.airflow;
    std::size_t first = step.rows.size() - 1;
    if (!file_) {
      first = 0; // a restarted run has earlier rows
      file_ = std::fopen(part.c_str(), "w");
      if (!file_) error = errno;
      if (file_)
        std::fprintf(file_, "time_s,%s%svolume_ml,%sdt_s,newton_iterations,krylov_iterations,min_J,max_J%s",
                     ventilator ? "airway_pressure_cmH2O," : "", flow ? "flow_ml_per_s," : "",
                     ventilator ? "phase," : "", facts_.tube ? ",ventilator_pressure_cmH2O" : "");
      for (const ScalarSpec &s : scalars_) {
        if (!file_) break;
        std::fprintf(file_, ",pressure_%s_cmH2O", s.name.c_str());
        if (!s.surfaces.empty()) std::fprintf(file_, ",flow_%s_ml_per_s", s.name.c_str());
      }
      for (const SignalSpec &s : signals_)
        if (file_) std::fprintf(file_, ",%s", s.name.c_str());
      if (file_) std::fprintf(file_, "\n");
    }
    for (std::size_t i = first; file_ && i < step.rows.size(); ++i) {
      const SignalRow &r = step.rows[i];
      std::fprintf(file_, "%.15g,", r.time);
      if (ventilator) std::fprintf(file_, "%.15g,", r.pressure);
      if (flow) std::fprintf(file_, "%.15g,", r.flow);
      std::fprintf(file_, "%.15g,", r.volume);
      if (ventilator) std::fprintf(file_, "%s,", r.phase.c_str());
      std::fprintf(file_, "%.15g,%ld,%ld,%.15g,%.15g", r.dt, r.newton, r.krylov, r.min_J, r.max_J);
      if (facts_.tube) std::fprintf(file_, ",%.15g", r.machine_pressure());
      for (std::size_t k = 0; k < scalars_.size(); ++k) {
        std::fprintf(file_, ",%.15g", r.scalars[k]);
        if (!scalars_[k].surfaces.empty()) std::fprintf(file_, ",%.15g", r.scalar_flows[k]);
      }
      for (const SignalSpec &s : signals_) std::fprintf(file_, ",%.15g", s.value(r));
      std::fprintf(file_, "\n");
    }
    if (file_ && (std::fflush(file_) != 0 || std::ferror(file_))) error = errno > 0 ? errno : EIO;
    if (file_ && error == 0 && !is_at(file_, part)) error = ENOENT; // what has no name can be written, too
  }
  PetscCall(check_written(comm_, error, part));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode SignalWriter::finish()
{
  const std::string file = output_.path("signals.csv");
  PetscMPIInt rank;
  bool open = file_ != nullptr;
  int error = 0;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm_, &rank));
  PetscCall(from_root(comm_, open));
  if (!open) PetscFunctionReturn(PETSC_SUCCESS);
  if (rank == 0) {
    if (std::fclose(file_) != 0 || std::rename((file + ".part").c_str(), file.c_str()) != 0) error = errno;
    file_ = nullptr;
  }
  PetscCall(check_written(comm_, error, file));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode ProgressPrinter::observe(const StepReport &step)
{
  const SignalRow &r = step.row;
  PetscLogDouble now;

  PetscFunctionBeginUser;
  PetscCall(PetscTime(&now));
  if (from_ < 0) {
    start_ = now;
    from_ = r.time;
    PetscCall(PetscPrintf(comm_, "%9s %10s %6s %6s %10s %10s %8s %8s  %s\n", "time s", "dt s", "Newton", "Krylov",
                          "P cmH2O", "V ml", "min J", "ETA s", facts_.ventilator ? "phase" : ""));
    if (r.dt == 0) PetscFunctionReturn(PETSC_SUCCESS);
  }
  const double left = r.time > from_ ? (now - start_) * (step.end - r.time) / (r.time - from_) : 0;
  PetscCall(PetscPrintf(comm_, "%9.4f %10.3g %6ld %6ld %10.3f %10.3f %8.4f %8.0f  %s\n", r.time, r.dt, r.newton,
                        r.krylov, r.pressure, r.volume, r.min_J, left, facts_.ventilator ? r.phase.c_str() : ""));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
