/// @file
/// Options: each is declared once with name, unit, range, default and help; parsing, `-help`, range checks,
/// the list in summary.json and the search for misspelt names all come from that one declaration.
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/input/expression.hpp"

#include <limits>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

namespace pulmo {

/// The admissible values of a number.
struct Range {
  double low = -std::numeric_limits<double>::infinity();
  double high = std::numeric_limits<double>::infinity();
  bool open = false; ///< the ends themselves are not allowed

  static Range any() { return {}; }
  static Range positive() { return {0, std::numeric_limits<double>::infinity(), true}; }
  static Range not_negative() { return {0, std::numeric_limits<double>::infinity(), false}; }
  static Range between(double low, double high) { return {low, high, false}; }
  bool holds(double v) const { return open ? v > low && v < high : v >= low && v <= high; }
  std::string text() const;
};

/// Names and values of options.
using OptionList = std::vector<std::pair<std::string, std::string>>;

/// Names of PETSc's options that a misspelt one may be meant for.
const std::vector<std::string> &petsc_names();

/// Declares and reads pulmo's own options from PETSc's database.
///
/// Every function reads the option `-<group>_<name>` (or `-<group>` for an empty name) into @p value, whose
/// content on entry is the default. Errors are user errors that name the option and how to fix it.
class Options {
public:
  explicit Options(MPI_Comm comm) : comm_(comm) {}

  MPI_Comm comm() const { return comm_; }

  /// What follows belongs to option prefix @p name. A group that is not @p in_use is listed by -help, and an
  /// option given for it is an error that quotes @p enabled_by.
  void group(const std::string &name, const std::string &about, bool in_use = true, const std::string &enabled_by = "");

  /// Also `0.36,right=0.7`: one number, and others for named parts of the mesh (varying(); @p value is the first). Or
  /// `FILE.h5:dataset`: a number for each tetrahedron of the mesh file (@p value is their mean).
  PetscErrorCode real(const std::string &name, const std::string &unit, Range range, const std::string &help,
                      PetscReal &value);
  PetscErrorCode whole(const std::string &name, const std::string &unit, Range range, const std::string &help,
                       PetscInt &value);
  PetscErrorCode flag(const std::string &name, const std::string &help, bool &value);
  PetscErrorCode text(const std::string &name, const std::string &help, std::string &value);
  /// One of @p choices.
  PetscErrorCode choice(const std::string &name, const std::vector<std::string> &choices, const std::string &help,
                        std::string &value);
  /// Names separated by commas.
  PetscErrorCode names(const std::string &name, const std::string &help, std::vector<std::string> &value);
  /// Up to @p most numbers, separated by commas: @p n of them. Also `0.2,0.1,right=0.4,0.3`: as many for a named part
  /// of the mesh.
  PetscErrorCode reals(const std::string &name, const std::string &unit, Range range, const std::string &help,
                       PetscReal value[], std::size_t most, std::size_t &n);
  /// Three numbers separated by commas.
  PetscErrorCode vector(const std::string &name, const std::string &unit, const std::string &help, PetscReal value[3]);

  /// Numbers or expressions separated by commas, as many as @p value has.
  PetscErrorCode expressions(const std::string &name, const std::string &unit, const std::string &help,
                             std::vector<Expression> &value);

  /// A number that was given with others for parts of the mesh.
  struct Varying {
    std::string option, unit, text; ///< text: as given
    const PetscReal *target = nullptr;
    PetscReal everywhere = 0;
    std::vector<std::pair<std::string, PetscReal>> by_name;
    bool surfaces = true;                               ///< names may be those of surfaces
    bool by_cell = false;                               ///< a dataset tells
    std::shared_ptr<const std::vector<double>> of_cell; ///< in the order of the mesh file; rank 0 alone has them
  };
  /// Those read so far; ParameterFields finds a place for each, or refuses it.
  const std::vector<Varying> &varying() const { return varying_; }
  bool varies(const PetscReal &value) const;
  /// Whether a dataset tells any of them, so that cells must know their number in the mesh file.
  bool varies_by_cell() const;
  /// What was read into @p from, a default of others, goes to @p to, too; call drop_varying(from) at the end.
  void hand_down(const PetscReal &from, PetscReal &to);
  void drop_varying(const PetscReal &value);
  /// Lets only volumes be named for @p value.
  void only_volumes(const PetscReal &value);

  /// Whether the user gave `-<group>_<name>` of the current group.
  PetscErrorCode given(const std::string &name, bool &is_given) const;

  /// Lets option @p name of the current group be given where it has no effect.
  void tolerate(const std::string &name);
  /// Notes what an option of effect @p group that was left open came to; it counts as used with that value.
  void settle(const std::string &name, const std::string &group, const std::vector<std::string> &value);
  /// An effect that is on by default turned out to have nothing to do in this scene: as if it had been given as off.
  void turn_off(const std::string &group);

  /// Ends with a user error if the database holds a name under one of pulmo's prefixes that nothing declared, or one
  /// of an effect that is not in use (unless that effect was turned off by `-<effect> off`).
  /// So does a name outside these prefixes that is an option of pulmo's but for a letter or two, or for its prefix.
  PetscErrorCode check_unknown() const;
  /// Ends with a user error if one of PETSc's options that scenes and solver files use has a value that PETSc would
  /// take for something else, or would answer with a stack trace: numbers out of range, types that are not there.
  PetscErrorCode check_petsc() const;
  /// Names the options given that let a solver pass for done when it is not, and how to fix that: a sentence without
  /// its full stop.
  PetscErrorCode loosened(std::string &text) const;
  /// Warns, once each, of PETSc options that nobody read, with the nearest name that is known. @p two_fields: the scene
  /// has a pressure, so that it may split its matrix. @p at_end: also of those that are read when a run ends.
  PetscErrorCode warn_unused(bool two_fields, bool at_end);
  /// Prints every declared option (the part of -help that is pulmo's own).
  PetscErrorCode print_help() const;
  /// Prints what the options that were left open came to (settle(), turn_off()).
  PetscErrorCode print_settled() const;
  /// Where options came from, by name; the last entry of a name counts.
  void came_from(const OptionList &sources) { sources_ = sources; }
  /// Where @p name came from: the command line, a file, the environment; empty if nothing tells.
  std::string source(const std::string &name) const;
  /// Names that came after @p name, in their order.
  std::vector<std::string> given_after(const std::string &name) const;
  /// Name and value of each option in the database.
  PetscErrorCode all_given(OptionList &list) const;
  /// Name and value of every option that the run used: pulmo's own of what is in use, defaults included, and PETSc's
  /// as given.
  PetscErrorCode all_used(OptionList &list) const;
  /// The first half of it: pulmo's own.
  OptionList own_used() const;
  /// A number that an option of pulmo's own gave, or left at its default, in a group that is in use. What it was read
  /// into has to be there for as long as the options are.
  struct RealOption {
    std::string option, unit;
    PetscReal *target = nullptr;
    std::vector<PetscReal *> copies; ///< what it was handed down to
  };
  std::vector<RealOption> real_options() const;
  /// What the run uses of the options of an effect.
  struct Setting {
    std::string name, value, unit; ///< name: without the effect's, blanks for _; unit: empty if it has none
  };
  std::vector<Setting> settings(const std::string &group) const;
  /// Notes what an option says whose value names a file, and puts that in place of the value in a list: a file may
  /// move, or hold something else the next time.
  void note_content(const std::string &name, const std::string &content) { content_[name] = content; }
  OptionList by_content(OptionList list) const;
  /// Whether an option of pulmo's own has its default value.
  bool at_default(const std::string &name) const;
  /// Whether two values of an option say the same: 1e4 and 10000, on and true.
  static bool same_value(const std::string &a, const std::string &b);

private:
  struct Declared {
    std::string name, value, unit, range, help; ///< value: the default
    std::string used;                           ///< as given, or the default
    std::size_t group;
    PetscReal *target = nullptr; ///< of one number
    bool tolerated = false;      ///< may be given where its group is not in use
    bool settled = false;        ///< left open, and decided by the scene
  };
  struct Group {
    std::string name, about, enabled_by;
    bool in_use;
  };

  PetscErrorCode find(const std::string &name, const std::string &default_value, const std::string &unit,
                      const std::string &range, const std::string &help, std::string &raw, bool &is_given);
  /// Ends with a user error if one of PETSc's options in @p given does not go with pulmo.
  PetscErrorCode check_refused(const OptionList &given) const;
  PetscErrorCode parse_number(const std::string &option, const std::string &raw, const std::string &unit,
                              const Range &range, double &value) const;
  PetscErrorCode parse_varying(const std::string &option, const std::string &raw, const std::string &unit,
                               const Range &range, PetscReal &value);
  PetscErrorCode parse_dataset(const std::string &option, const std::string &raw, const std::string &unit,
                               const Range &range, PetscReal &value);
  std::string full(const std::string &name) const;
  /// The declared option, or PETSc's option that pulmo knows, whose name is nearest; empty if all are further away
  /// than @p most letters.
  std::string nearest(const std::string &name, std::size_t most) const;
  std::string misspelt(const std::string &name) const;
  /// ": did you mean ...?" with what that option needs in this scene; empty for an empty @p guess.
  std::string hint(const std::string &guess) const;

  MPI_Comm comm_;
  std::vector<Group> groups_;
  std::vector<Declared> declared_;
  std::vector<Varying> varying_;
  std::map<std::string, std::string> content_;
  std::map<const PetscReal *, std::vector<PetscReal *>> copies_; ///< hand_down()
  OptionList sources_;
  std::set<std::string> told_; ///< options of which warn_unused() has warned
};

/// Whether an option of PETSc's prints or writes, and changes nothing else.
bool prints(const std::string &option);

} // namespace pulmo
