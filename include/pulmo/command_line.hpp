/// @file
/// Looks through the command line and the option files before PETSc does.
#pragma once

#include <string>
#include <vector>

namespace pulmo {

/// What is wrong with the words of a command line or with the files that its -options_file name (and the files that
/// those name), in a sentence that says how to fix it; empty if nothing is. PETSc answers mistakes in a file with a stack
/// trace and passes over words that belong to no option. Files in YAML are left to PETSc.
std::string command_line_fault(const std::vector<std::string> &words);

} // namespace pulmo
