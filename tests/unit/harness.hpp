/// @file
/// What every effect must keep, whichever it is. Each check takes the effects of a scene and says what is wrong, so
/// that it serves for all that is registered and for effects that are wrong on purpose.
#pragma once

#include "unit/scenes.hpp"

#include <map>

namespace pulmo::test {

/// What a check found wrong, a sentence each; none: all is right.
using Findings = std::vector<std::string>;

/// How the lung is ventilated, on a mesh of 24 cells.
enum class Airway { held, free, common_pressure, no_airflow };
constexpr Airway all_airways[] = {Airway::held, Airway::free, Airway::common_pressure, Airway::no_airflow};

/// Effects that act together, as their examples say; no other does but springs, or pins, that hold the lung.
struct Subject {
  Registry registry;
  std::vector<std::string> effects;
  Airway airway = Airway::held;
  std::string law, permeability, scheme; ///< laws by name; scheme: of the restart

  std::string text() const;
  /// The scene, but for the effects themselves.
  std::string surroundings() const;
  /// All of it.
  std::string options() const;
  std::string example(const std::string &effect) const;
};

/// One rule. Collective.
struct Check {
  const char *name;
  PetscErrorCode (*find)(const Subject &, Findings &);
  bool pairs; ///< effects that meet may break it, where each alone does not

  friend void PrintTo(const Check &check, std::ostream *out) { *out << check.name; }
};

/// All of them.
const std::vector<Check> &checks();
/// What @p check finds wrong; an error of PETSc's is a finding.
Findings find(const Check &check, const Subject &subject);

/// Each effect of @p names alone, with every law and airway in turn that takes it. @p refused: what pulmo said of those
/// that no airway takes.
std::vector<Subject> alone(const Registry &registry, const std::vector<std::string> &names, Findings &refused);
/// Effects together, with a law and an airway that takes them; nothing if none does.
std::optional<Subject> together(const Registry &registry, const std::vector<std::string> &names, Findings &refused);
std::vector<std::string> names_of_effects(const Registry &registry);

// ------------------------------------------------------------------------------------- what the checks are made of

/// Takes what the process prints until it is asked for it.
class Quiet {
public:
  Quiet();
  ~Quiet() { (void)stop(); }
  Quiet(const Quiet &) = delete;
  Quiet &operator=(const Quiet &) = delete;
  struct Said {
    std::string out, errors;
  };
  Said stop();

private:
  struct Stream {
    int kept = -1;
    std::FILE *file = nullptr;
  };
  void take(int descriptor, Stream &stream);
  static std::string give_back(int descriptor, Stream &stream);
  Stream out_, errors_;
  bool stopped_ = false;
};

/// Each rank by itself, as if it were the only one.
class OneRank {
public:
  OneRank() : world_(PETSC_COMM_WORLD) { PETSC_COMM_WORLD = PETSC_COMM_SELF; }
  ~OneRank() { PETSC_COMM_WORLD = world_; }
  OneRank(const OneRank &) = delete;
  OneRank &operator=(const OneRank &) = delete;

private:
  MPI_Comm world_;
};

/// A folder that goes away.
class Folder {
public:
  Folder();
  ~Folder();
  Folder(const Folder &) = delete;
  Folder &operator=(const Folder &) = delete;
  std::string path(const std::string &name) const { return path_ + "/" + name; }

private:
  std::string path_;
  bool mine_ = false;
};

/// A whole run of the program, without its process.
struct Outcome {
  PetscErrorCode code = PETSC_SUCCESS;
  bool finished = false;
  Quiet::Said said;
  std::map<std::string, std::string> files; ///< text by name: signals.csv, energy.csv, fields.xdmf, summary.json

  /// Ended as a program may: finished, or with one sentence of pulmo's own.
  bool told() const;
  /// Refused before it began.
  bool refused() const { return code == PETSC_ERR_USER_INPUT && told(); }
  /// The numbers of a table by column; words are left out.
  std::map<std::string, std::vector<double>> table(const std::string &file) const;
};
Outcome run_program(const Registry &registry, const std::string &options, const std::string &directory);

/// Builds the scene; what it prints goes to @p said.
PetscErrorCode build(SceneRun &run, const std::string &options, Quiet::Said *said = nullptr);

/// Whether what is printed is one sentence of pulmo's, beside notes and warnings.
bool one_sentence(const std::string &errors);

/// A number in the text of a finding.
std::string shown(double number);

// The checks, in the file of their kind.
PetscErrorCode check_jacobian(const Subject &subject, Findings &findings);
PetscErrorCode check_off(const Subject &subject, Findings &findings);
PetscErrorCode check_integrators(const Subject &subject, Findings &findings);
PetscErrorCode check_energy(const Subject &subject, Findings &findings);
PetscErrorCode check_restart(const Subject &subject, Findings &findings);
PetscErrorCode check_ranks(const Subject &subject, Findings &findings);
PetscErrorCode check_schemes(const Subject &subject, Findings &findings);
PetscErrorCode check_help(const Subject &subject, Findings &findings);
PetscErrorCode check_ledger(const Subject &subject, Findings &findings);
PetscErrorCode check_values(const Subject &subject, Findings &findings);
/// Beside these: the sweep back over a run, of each effect that it takes, against differences of whole runs.
PetscErrorCode check_adjoint(const Subject &subject, Findings &findings);

} // namespace pulmo::test
