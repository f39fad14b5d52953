/// @file
/// Keeps a second run out of a run's directory.
#pragma once

#include <string>

namespace pulmo {

/// The file pulmo.lock in a directory names the process that works there. It is made with all that it says at once (a
/// hard link, also exclusive on NFS), so two runs that begin together cannot both have it. One that a killed run left
/// is taken over if its process was on this machine and is gone; of another machine nothing can be known, and the user
/// is told. For one process of a run.
class RunLock {
public:
  RunLock() = default;
  ~RunLock() { release(); }
  RunLock(const RunLock &) = delete;
  RunLock &operator=(const RunLock &) = delete;

  /// Who works in @p directory, as far as can be known, and what to do about it; empty if nobody does. Changes nothing.
  static std::string user_of(const std::string &directory);
  /// Locks @p directory. What kept it from that, or empty.
  std::string take(const std::string &directory);
  /// Who left a lock that take() replaced; empty without.
  const std::string &left_by() const { return left_by_; }
  void release();
  /// release() from a signal handler, of whatever lock this process has.
  static void abandon() noexcept;

private:
  std::string file_, text_, left_by_; ///< the lock, what it says while this process has it
};

} // namespace pulmo
