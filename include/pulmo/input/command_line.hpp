/// @file
/// Reads options from where PETSc would: .petscrc files, the environment, the command line and the files that these
/// name. pulmo reads them itself, before PETSc starts, so that each word is either part of an option or an error, and
/// each option's origin is known.
#pragma once

#include <string>
#include <vector>

namespace pulmo {

/// An option as it was given.
struct GivenOption {
  std::string name;   ///< with its dash
  std::string value;  ///< empty: none
  std::string source; ///< "command line", the name of a file, or that of a variable of the environment
};

/// What surrounds the program: where options come from beside its command line.
struct Surroundings {
  std::string home;                  ///< folder of a .petscrc; empty: none
  bool working_directory = false;    ///< .petscrc and petscrc of the working directory are read
  std::string options, options_yaml; ///< the variables PETSC_OPTIONS and PETSC_OPTIONS_YAML

  static Surroundings of_process();
};

/// Everything that was given, later ones of a name after earlier ones.
struct GivenOptions {
  std::vector<GivenOption> list;
  std::string fault;                ///< what is wrong, in a sentence that tells how to fix it; empty: nothing
  std::vector<std::string> unasked; ///< sources that the command line does not name
  std::string question;             ///< "version", "list", or "usage" if nothing is given; empty: a run
  std::string directory;            ///< working directory of the run that -replay repeats; empty: that of now

  /// As one string, to be sent to the other ranks, and back.
  std::string packed() const;
  static GivenOptions unpacked(const std::string &text);
};

/// @p words: the command line without the program's name.
GivenOptions read_options(const std::vector<std::string> &words, const Surroundings &around = {});

} // namespace pulmo
