// How the program is called, with an example whose files are there.
#include "pulmo/program/usage.hpp"

#include "pulmo/pulmo.hpp"

#include <filesystem>

namespace pulmo {

namespace {

/// Where pulmo's own meshes and option files are, with a slash at the end: beside the installed program, or in the
/// source tree above its build folder; nothing where they are in the working directory, or nowhere.
std::string data_folder()
{
  namespace fs = std::filesystem;
  std::error_code error;
  const fs::path program = fs::read_symlink("/proc/self/exe", error).parent_path();
  const auto holds = [&](const fs::path &folder) {
    return fs::exists(folder / "meshes/lung_test.msh", error) && fs::exists(folder / "petsc_options", error);
  };

  if (holds("")) return "";
  for (const char *beside : {"../share/pulmo", ".."}) {
    const fs::path folder = (program / beside).lexically_normal();
    if (holds(folder)) return (folder / "").string();
  }
  return "";
}

} // namespace

std::string usage(const std::string &called)
{
  const std::string data = data_folder();

  return "usage: [mpiexec -n RANKS] " + called +
         " -dm_plex_filename MESH.msh -options_file SCENE.opts -options_file SOLVER.opts [-NAME VALUE ...]\n\n"
         "For example, one breath of a small lung:\n\n"
         "  " +
         called + " -dm_plex_filename " + data + "meshes/lung_test.msh \\\n    -options_file " + data +
         "petsc_options/scenes/pcv.opts \\\n    -options_file " + data +
         "petsc_options/solvers/iterative.opts \\\n    -output_dir first_breath\n\n" + called +
         " -help lists all options, -list the laws and effects, -version the versions.\n";
}

} // namespace pulmo
