/// @file
/// Clinical numbers from the signals of a run; docs/clinical.md tells what each of them is and where it comes from.
#pragma once

#include "pulmo/physics/signal_row.hpp"

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// Numbers of one breath, or of a whole run. What a breath does not define stays empty. Pressures are the machine's.
struct ClinicalNumbers {
  std::optional<double> compliance;              ///< C_rs of the fit, ml/cmH2O
  std::optional<double> resistance;              ///< R of the fit, cmH2O s/l
  std::optional<double> time_constant;           ///< R C_rs, s
  std::optional<double> equal_weight_compliance; ///< of the fit with an intercept, ml/cmH2O
  std::optional<double> equal_weight_resistance; ///< of the same, cmH2O s/l
  std::optional<double> plateau_pressure;        ///< at the end of inspiration if that is the end of a pause, cmH2O
  std::optional<double> pause_resistance;   ///< drop of pressure into that pause over the flow before it, cmH2O s/l
  std::optional<double> static_compliance;  ///< V_T / (plateau - total PEEP at the start), ml/cmH2O
  std::optional<double> dynamic_compliance; ///< V_T / (peak - PEEP), ml/cmH2O
  std::optional<double> static_curve_compliance; ///< slope of the inflation limb through the pauses, ml/cmH2O
  std::optional<double> auto_peep;               ///< mean alveolar pressure at the end - PEEP there, cmH2O
  std::optional<double> total_peep;              ///< mean alveolar pressure at the end, cmH2O
  double peep = 0;                               ///< pressure from which the breath starts, cmH2O
  double peak_pressure = 0;                      ///< cmH2O
  double driving_pressure = 0;                   ///< plateau - PEEP (peak - PEEP without a pause), cmH2O
  double tidal_volume = 0;                       ///< ml
  double trapped_volume = 0;                     ///< ml
  double peak_flow = 0;                          ///< into the lung, ml/s
  double peak_expiratory_flow = 0;               ///< out of the lung, ml/s
  double work = 0;                               ///< closed integral of (P - PEEP) dV, J
  double mechanical_power = 0;                   ///< work times rate, J/min
  bool moves = true;    ///< the volume changes beyond what a solver leaves; else no ratio of it means anything
  bool takes_in = true; ///< more gas above the volume of the start than it gives below it; else V_T is not defined
  double fall = 0;      ///< by which the volume falls below that of the start, ml
};

/// A volume below this share of the lung's is what a solver leaves of nothing.
constexpr double least_movement = 1e-9;

/// A number of a breath as it is listed.
struct ClinicalEntry {
  std::string key, label, unit; ///< key: in summary.json
  std::optional<double> value;
};

/// All numbers of a breath in the order of the table. @p frc: gas volume at rest, ml.
std::vector<ClinicalEntry> clinical_entries(const ClinicalNumbers &numbers, const std::optional<double> &frc);

/// First and last row of a breath, and the end of its inspiration. The first row is the last one before the breath.
struct BreathRows {
  std::size_t first, last, fullest;
  bool complete = true; ///< the run went on to the breath's end
};

/// The end of a pause: a point of the static pressure-volume curve.
struct StaticPoint {
  std::size_t row;   ///< the pause's last
  std::string phase; ///< that the pause follows
};

/// The end of inspiration in rows first ... last, row @p first being the start of the breath: the end of the pause that
/// holds the largest volume; without one the last row at the largest volume within its phase. Volumes that differ by a
/// millionth of the tidal volume count as equal, so that rounding chooses nothing. Row @p first if nothing flows in.
std::size_t end_of_inspiration(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last);

/// The rows of each breath.
std::vector<BreathRows> breath_rows(const std::vector<SignalRow> &rows);

/// Those that were not cut.
std::vector<BreathRows> complete_breaths(const std::vector<SignalRow> &rows);

/// The last complete breath, or the whole run without one.
BreathRows last_breath(const std::vector<SignalRow> &rows);

/// The end of every pause of rows (first, last].
std::vector<StaticPoint> static_points(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last);

/// Least-squares fit of P - PEEP = E (V - V_start) + R flow with weights dt (Aviles-Rojas & Hurtado 2022, eq. 52)
/// over rows (first, last]: C_rs = 1/E and R. Leaves both empty where the rows do not define them, and R where nothing
/// resists the flow. @p start: V_start, ml; that of row @p first if not given.
void fit_single_compartment(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep,
                            ClinicalNumbers &numbers, std::optional<double> start = {});

/// The fit that most other groups make: P = P_0 + E V + R flow with equal weights for all rows (first, last], and P_0
/// free. Leaves both empty where the rows do not define them.
void fit_with_intercept(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last,
                        ClinicalNumbers &numbers);

/// Numbers over rows first ... last, row @p first being the start of the breath.
ClinicalNumbers clinical_numbers(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last);

/// One entry per complete breath.
std::vector<ClinicalNumbers> breath_numbers(const std::vector<SignalRow> &rows);

/// A level of PEEP in a trial of several.
struct PeepLevel {
  double peep;                      ///< cmH2O
  std::size_t last;                 ///< last row at that level of the last breath that starts from it
  std::optional<double> compliance; ///< C_rs of the fit to that breath up to there, ml/cmH2O
};

/// The levels of PEEP that complete breaths start from, in their order; empty if there are fewer than three.
std::vector<PeepLevel> peep_levels(const std::vector<SignalRow> &rows);

/// The level of the largest compliance; null if none has one.
const PeepLevel *best_compliance(const std::vector<PeepLevel> &levels);

/// The numbers of the last complete breath. C_rs, R and time constant are fitted over its rows, but with the pressure
/// and the volume from which the first breath starts: there the lung is at rest, also if later breaths trap gas.
ClinicalNumbers overall_numbers(const std::vector<SignalRow> &rows);

/// The overall numbers as they are listed; all values are empty if no breath is complete.
std::vector<ClinicalEntry> overall_entries(const std::vector<SignalRow> &rows, const std::optional<double> &frc);

/// The first row of the first breath at which a lung that was at rest has less volume than at the breath's start,
/// though the pressure has not been below that of the start: no passive lung does so. Empty if there is none.
std::optional<std::size_t> shrinks_under_pressure(const std::vector<SignalRow> &rows);

/// How far the last complete breath is from a steady one.
struct Unsteadiness {
  static constexpr double tolerated = 0.01;
  double change = 0; ///< the largest of the changes looked at, as a share
  std::string what;  ///< changes by so much

  bool steady() const { return change <= tolerated; }
};

/// Looks at the trapped volume over the tidal volume and, if there is a complete breath just before it, at the changes
/// of tidal volume, C_rs and R from that one. Empty if no breath is complete, or the last one has no V_T.
std::optional<Unsteadiness> unsteadiness(const std::vector<SignalRow> &rows);

/// More than this share of the tidal volume is told.
constexpr double unsettled_tolerated = 0.003;

/// Volume that at least is still to come (or to go) when the first breath starts after other phases, ml: the flow there
/// is taken to fade as it did in the last step, and a flow that comes to rest never fades faster later. Empty if the
/// run starts with the breath, or if nothing resists the flow.
std::optional<double> unsettled_volume(const std::vector<SignalRow> &rows);

} // namespace pulmo
