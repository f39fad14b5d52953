#include "pulmo/base/run_lock.hpp"

#include "pulmo/base/text_file.hpp"

#include <cerrno>
#include <climits>
#include <csignal>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <fcntl.h>
#include <fstream>
#include <functional>
#include <map>
#include <sstream>
#include <sys/stat.h>
#include <unistd.h>

namespace pulmo {

namespace {

constexpr const char *lock_name = "pulmo.lock";

/// So often a lock that is about to change hands is looked at again, and so long are the pauses, microseconds.
constexpr int most_looks = 100;
constexpr useconds_t pause = 50000;

// a signal handler reaches nothing else
char held[PATH_MAX];
volatile std::sig_atomic_t is_held = 0;

/// The first line of a file, or what a link says; empty if there is none.
std::string line_of(const char *file)
{
  std::string line;
  std::getline(std::ifstream(file), line);
  return line;
}

std::string link_of(const char *file)
{
  char text[256];
  const ssize_t n = readlink(file, text, sizeof(text));
  return n > 0 ? std::string(text, static_cast<std::size_t>(n)) : "";
}

/// When a process was started, in ticks since the machine was: its number may be given to another later. Empty where
/// /proc does not tell.
std::string start_of(const std::string &process)
{
  constexpr int place = 20; // of field 22 after the name, which ends with the last ')'
  const std::string line = line_of(("/proc/" + process + "/stat").c_str());
  const std::size_t name_end = line.rfind(')');
  if (name_end == std::string::npos) return "";
  std::istringstream words(line.substr(name_end + 1));
  std::string word;
  for (int i = 0; i < place; ++i) words >> word;
  return word;
}

/// What a lock says of its process: key -> value.
using Owner = std::map<std::string, std::string>;

Owner this_process()
{
  char host[256] = "";
  char since[64] = "";
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  (void)gethostname(host, sizeof(host) - 1);
  (void)std::strftime(since, sizeof(since), "%Y-%m-%d %H:%M:%S UTC", gmtime_r(&now, &utc));
  const std::string process = std::to_string(getpid()), machine = line_of("/etc/machine-id");
  return {{"host", host},
          {"process", process},
          {"since", since},
          {"start", start_of(process)},
          {"machine", machine.empty() ? "" : std::to_string(std::hash<std::string>()(machine))}, // it is confidential
          {"boot", line_of("/proc/sys/kernel/random/boot_id")},
          {"namespace", link_of("/proc/self/ns/pid")}};
}

Owner read_owner(const std::string &text)
{
  const NamedValues list = named_values(text);
  return {list.begin(), list.end()};
}

enum class State { alive, gone, unknown };

State state_of(Owner owner)
{
  Owner here = this_process();
  const auto same = [&](const char *key) { return owner[key] == here[key]; };
  if (!same("host") || !same("machine") || !same("namespace")) return State::unknown;
  if (!same("boot")) return owner["machine"].empty() ? State::unknown : State::gone; // it was started anew
  const long process = std::strtol(owner["process"].c_str(), nullptr, 10);
  if (process <= 0) return State::unknown;
  if (kill(static_cast<pid_t>(process), 0) != 0 && errno == ESRCH) return State::gone;
  const std::string start = start_of(owner["process"]);
  return start.empty() || owner["start"].empty() || start == owner["start"] ? State::alive : State::gone;
}

std::string described(Owner owner)
{
  return "process " + owner["process"] + " on " + owner["host"] + ", started " + owner["since"];
}

/// What a file says; false if there is none.
bool read(const std::string &file, std::string &text)
{
  std::ifstream in(file);
  std::ostringstream content;
  if (!in.is_open()) return false;
  content << in.rdbuf();
  text = content.str();
  return true;
}

/// Writes all of @p text and closes. 0, or the error.
int write_all(int descriptor, const std::string &text)
{
  const ssize_t n = write(descriptor, text.data(), text.size());
  int error = n < 0 ? errno : 0;
  if (n >= 0 && static_cast<std::size_t>(n) < text.size()) error = ENOSPC;
  if (close(descriptor) != 0 && error == 0) error = errno;
  return error;
}

/// Makes a file with a name of its own in @p directory: @p own. 0, or the error.
int write_own(const std::string &directory, const std::string &text, std::string &own)
{
  own = directory + "/" + lock_name + ".XXXXXX";
  const int descriptor = mkstemp(own.data());
  if (descriptor < 0) return errno;
  (void)fchmod(descriptor, 0644); // others in this directory have to read it
  const int error = write_all(descriptor, text);
  if (error != 0) (void)unlink(own.c_str());
  return error;
}

/// Gives the file @p own, which says @p text, the further name @p name. 0, or the error: EEXIST if it is taken.
int link_to(const std::string &own, const std::string &text, const std::string &name)
{
  struct stat status {};
  if (link(own.c_str(), name.c_str()) == 0) return 0;
  if (errno == EEXIST) return stat(own.c_str(), &status) == 0 && status.st_nlink == 2 ? 0 : EEXIST; // NFS asked twice
  const int descriptor = open(name.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0644); // a disk without links
  if (descriptor < 0) return errno;
  const int error = write_all(descriptor, text);
  if (error != 0) (void)unlink(name.c_str());
  return error;
}

/// Puts @p own in the place of @p lock, which says @p left. 0, or the error: EEXIST if another process is about to, or
/// has. Of those that want to, one alone has the file @p claim.
int replace(const std::string &own, const std::string &text, const std::string &lock, const std::string &left,
            const std::string &claim)
{
  std::string now;
  int error = link_to(own, text, claim);
  if (error != 0) return error;
  if (!read(lock, now) || now != left)
    error = EEXIST;
  else if (rename(own.c_str(), lock.c_str()) != 0)
    error = errno;
  (void)unlink(claim.c_str());
  return error;
}

/// What a user is told of a lock whose owner is not known to be gone.
std::string refusal(const std::string &directory, const std::string &lock, const std::string &text)
{
  const Owner owner = read_owner(text);
  const std::string remove = "if no run is at work there any more, remove " + lock;
  if (!owner.count("process") || !owner.count("host"))
    return "-output_dir " + directory + " is locked by a file that does not say by whom; " + remove;
  return "-output_dir " + directory + " is in use by another run (" + described(owner) + "); " +
         (state_of(owner) == State::alive ? "give another directory, or wait for its end"
                                          : "give another directory, or, " + remove);
}

} // namespace

std::string RunLock::user_of(const std::string &directory)
{
  const std::string lock = directory + "/" + lock_name;
  std::string text;
  if (!read(lock, text) || state_of(read_owner(text)) == State::gone) return "";
  return text.empty() ? "" : refusal(directory, lock, text); // an empty one may be in the making: take() waits
}

std::string RunLock::take(const std::string &directory)
{
  std::string own, there;
  const std::string lock = directory + "/" + lock_name, claim = lock + ".next";
  const Owner process = this_process();
  const std::string text = text_of(NamedValues(process.begin(), process.end()));
  int error = write_own(directory, text, own), looks = 0;
  bool busy = false; // the lock, or a left one, changes hands

  left_by_.clear();
  while (error == 0) {
    error = link_to(own, text, lock);
    if (error != EEXIST) break;
    busy = !read(lock, there) || there.empty();
    if (!busy) {
      if (state_of(read_owner(there)) != State::gone) break;
      error = replace(own, text, lock, there, claim);
      if (error == 0) left_by_ = described(read_owner(there));
      if (error != EEXIST) break;
      busy = true;
    }
    if (++looks > most_looks) break;
    error = 0;
    usleep(pause);
  }
  (void)unlink(own.c_str());
  if (error == EEXIST && busy && read(claim, there)) return refusal(directory, claim, there);
  if (error == EEXIST) return refusal(directory, lock, there);
  if (error != 0)
    return "-output_dir " + directory + " cannot be written (" + std::strerror(error) +
           "); choose another directory or free the disk";
  file_ = lock;
  text_ = text;
  if (file_.size() < sizeof(held)) {
    std::strcpy(held, file_.c_str());
    is_held = 1;
  }
  return "";
}

void RunLock::release()
{
  std::string there;
  if (text_.empty()) return;
  is_held = 0;
  if (read(file_, there) && there == text_) (void)unlink(file_.c_str()); // else somebody removed it
  text_.clear();
}

void RunLock::abandon() noexcept
{
  if (is_held) (void)unlink(held);
  is_held = 0;
}

} // namespace pulmo
