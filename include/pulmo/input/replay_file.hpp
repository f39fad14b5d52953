/// @file
/// What a failed run writes down for `pulmo -replay`: where and how it ran, its options, its last attempts.
#pragma once

#include "pulmo/base/text_file.hpp"
#include "pulmo/input/command_line.hpp"

#include <string>
#include <vector>

namespace pulmo {

/// replay.json in the folder `replay` of a failed run.
struct ReplayFile {
  /// An attempt at the step that failed.
  struct Attempt {
    double dt = 0; ///< s
    std::string outcome;
    std::vector<double> norms; ///< of the residual before each Newton step and after the last one
  };

  std::string version, petsc;
  int ranks = 0;
  std::string directory;            ///< the working directory: options name files from there
  std::string mesh, mesh_hash;      ///< the file, and hash_of_file() of it
  NamedValues environment;          ///< what is set of variables that change rounding
  std::vector<GivenOption> options; ///< all, but those that only print
  std::vector<Attempt> attempts;    ///< since the last accepted step
  std::size_t first = 0;            ///< attempt at which a replay begins
  bool warms_up = false;            ///< the solver keeps what it made of the first Jacobian of the run
  std::string failure;              ///< what the run said

  static constexpr const char *folder = "replay", *file = "replay.json", *state = "state.h5";

  std::string text() const;
  /// Reads the file of @p directory, the folder itself or that of the failed run. @p found: the folder. What is wrong,
  /// in a sentence that tells how to fix it; empty if nothing is.
  std::string read(const std::string &directory, std::string &found);
};

/// The variables of the environment that change how linear algebra rounds, as they are set.
NamedValues rounding_environment();

/// Tells the bytes of a file from others; empty if it cannot be read.
std::string hash_of_file(const std::string &file);

} // namespace pulmo
