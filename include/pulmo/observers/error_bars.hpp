/// @file
/// Numerical error bars of the clinical numbers: what they are made of, and how they are listed.
#pragma once

#include "pulmo/observers/clinical.hpp"

#include <petscsys.h>

namespace pulmo {

/// What the steps make a number wrong by.
struct TimeError {
  double error;                ///< in the number's unit, not negative
  std::optional<double> order; ///< observed; none where the numbers do not approach a limit in one direction
};

/// Error in time of @p fine (steps dt) from the same number with steps 2 dt and 4 dt, by a scheme of order @p order:
/// Richardson's extrapolation with the factors of safety of Oberkampf & Roy 2010 (Verification and Validation in
/// Scientific Computing, section 8.6): 1.25 where the observed order is the scheme's within 10 %, else 3 with the
/// observed order, but not below 1/2 nor above the scheme's. Without an order: 1.25 times the largest difference seen.
TimeError time_error(double fine, double twice, double four_times, int order);

/// Error in space from the difference @p difference to the same number on a mesh of cells @p ratio times as large
/// (above or below 1). Of order 1, as rims and edges leave it, with a factor of safety of 1.25: 2.5 times the
/// difference to a mesh refined once, 1.25 times that to one twice as coarse.
double space_error(double difference, double ratio);

/// What a number lacks by the discrete adjoint of its run (pulmo/adjoint/error_parts.hpp), in its unit and signed.
struct LackingParts {
  double steps = 0; ///< by the rates of the time scheme
  double rows = 0;  ///< by the few rows that the number is made of
  double flow_in_space = 0, tissue_in_space = 0, solver = 0;
};

/// What a number changes by, in its unit and to first order, if the last breath is repeated. It is in no bar: the run
/// is what it is, and more breaths are another one.
struct MoreBreaths {
  double next = 0;                ///< by one more breath
  std::optional<double> periodic; ///< until breaths are periodic; empty where one breath does not tell that
};

/// Why a sweep has no part of a number's error.
enum class Unresolved { phase_ended_early, few_steps_in_a_phase, steps_too_long, cells_too_large };

/// The key of a reason in summary.json (docs/accuracy/error_bars.md), and the words for one who reads the table.
const char *key_of(Unresolved reason);
const char *words_of(Unresolved reason);

/// A clinical number with what the discretisation makes it wrong by, each part in the number's unit. A part that could
/// not be had is empty.
struct ErrorBar {
  ClinicalEntry entry;
  std::optional<double> time, space, solver;
  std::optional<double> time_order;  ///< observed
  std::optional<LackingParts> lacks; ///< by a sweep
  std::optional<double> corrected;   ///< the value with what it lacks, where its sign is known
  std::optional<double> corrected_error;
  std::optional<MoreBreaths> more_breaths; ///< by a sweep
  std::vector<Unresolved> unresolved;      ///< why parts are empty

  /// The words of all reasons; empty if there are none.
  std::string unresolved_words() const;

  /// The sum of the parts (they may all point the same way); empty if one is missing.
  std::optional<double> total() const;
};

/// The part in space that @p parts find, as a share of @p entry's value: richer elements see of it what they take of an
/// error of order 1 in h/p^2, 3/4 from P1 to P2, which is what a rim leaves. Flow and tissue count apart, as they may
/// cancel by chance.
double space_share(const ClinicalEntry &entry, const LackingParts &parts);

/// The bars of @p entry from what it lacks: 1.5 times the parts, that in space more by @p largest_share, the largest
/// space_share() of all numbers of the sweep (1 at most), by which an estimate of first order may be off; a third of
/// the bar is that of the corrected value. A part of more than a tenth of the number is no small change, and empty;
/// that in space is empty, too, where @p largest_share is above 3.
/// @p trouble_in_time: why there is no part in time, if there is none.
ErrorBar lacking_bar(const ClinicalEntry &entry, const LackingParts &parts, double largest_share,
                     std::optional<Unresolved> trouble_in_time);

/// One run that the estimate was made from.
struct ErrorLevel {
  std::string name;    ///< what is different from the run itself
  std::string failure; ///< why it has no numbers; empty if it finished
  PetscReal dt = 0;    ///< s; the first steps' if steps are chosen by their error
  PetscInt cells = 0, dofs = 0, steps = 0;
  double volume = 0;  ///< at rest, ml
  double seconds = 0; ///< wall
  std::vector<ClinicalEntry> numbers;
};

/// What an estimate found.
struct ErrorReport {
  std::vector<ErrorBar> bars;     ///< one for each clinical number that the run has
  std::vector<ErrorLevel> levels; ///< the run itself comes first
  std::string method = "runs";    ///< or "sweep"
  std::string failure;            ///< why there is no estimate
  double sweep_seconds = 0;
  double extra_seconds() const; ///< wall, what the estimate took
};

} // namespace pulmo
