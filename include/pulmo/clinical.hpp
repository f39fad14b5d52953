/// @file
/// Clinical numbers from the signals of a run; docs/clinical.md tells what each of them is and where it comes from.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// One accepted step; row 0 is the start of the run. Flow into the lung is positive.
struct SignalRow {
  double time = 0;     ///< s
  double pressure = 0; ///< airway pressure, cmH2O
  double flow = 0;     ///< ml/s, of the step that ends here
  double volume = 0;   ///< ml, int (J - 1)
  std::string phase;   ///< of the programme; the phase that ends at its last row
  int breath = 0;      ///< counted from 1; 0 before the first
  double dt = 0;       ///< s
  long newton = 0, krylov = 0;
  double min_J = 1, max_J = 1;
  bool hold = false;                         ///< the phase holds the volume (prescribed flow 0)
  std::optional<double> ventilator_pressure; ///< on the machine's side of a tube, cmH2O; without one the airway's
  std::optional<double> alveolar_pressure;   ///< mean over the reference volume, cmH2O; empty without airflow

  /// What a clinician reads: the pressure at the machine, cmH2O.
  double machine_pressure() const { return ventilator_pressure.value_or(pressure); }
  /// Whether the phase waits for the lung to come to rest.
  bool pause() const { return hold || phase == "pause"; }
};

/// Numbers of one breath, or of a whole run. What a breath does not define stays empty. Pressures are the machine's.
struct ClinicalNumbers {
  std::optional<double> compliance;         ///< C_rs of the fit, ml/cmH2O
  std::optional<double> resistance;         ///< R of the fit, cmH2O s/l
  std::optional<double> time_constant;      ///< R C_rs, s
  std::optional<double> plateau_pressure;   ///< at the end of the pause with the largest volume, cmH2O
  std::optional<double> pause_resistance;   ///< drop of pressure into that pause over the flow before it, cmH2O s/l
  std::optional<double> static_compliance;  ///< V_T / (plateau - total PEEP at the start), ml/cmH2O
  std::optional<double> dynamic_compliance; ///< V_T / (peak - PEEP), ml/cmH2O
  std::optional<double> static_curve_compliance; ///< slope of the inflation limb through the pauses, ml/cmH2O
  std::optional<double> auto_peep;               ///< mean alveolar pressure at the end - PEEP, cmH2O
  std::optional<double> total_peep;              ///< PEEP + auto-PEEP, cmH2O
  double peep = 0;                               ///< pressure from which the breath starts, cmH2O
  double peak_pressure = 0;                      ///< cmH2O
  double driving_pressure = 0;                   ///< plateau - PEEP (peak - PEEP without a pause), cmH2O
  double tidal_volume = 0;                       ///< ml
  double trapped_volume = 0;                     ///< ml
  double peak_flow = 0;                          ///< into the lung, ml/s
  double peak_expiratory_flow = 0;               ///< out of the lung, ml/s
  double work = 0;                               ///< closed integral of (P - PEEP) dV, J
  double mechanical_power = 0;                   ///< work times rate, J/min
};

/// A number of a breath as it is listed.
struct ClinicalEntry {
  const char *key, *label, *unit; ///< key: in summary.json
  std::optional<double> value;
};

/// All numbers of a breath in the order of the table. @p frc: gas volume at rest, ml.
std::vector<ClinicalEntry> clinical_entries(const ClinicalNumbers &numbers, const std::optional<double> &frc);

/// First and last row of a breath, and the row with its largest volume. The first row is the last one before the
/// breath.
struct BreathRows {
  std::size_t first, last, fullest;
};

/// The end of a pause: a point of the static pressure-volume curve.
struct StaticPoint {
  std::size_t row;   ///< the pause's last
  std::string phase; ///< that the pause follows
};

/// The rows of each breath.
std::vector<BreathRows> breath_rows(const std::vector<SignalRow> &rows);

/// Those of the last breath, or of the whole run without one.
BreathRows last_breath(const std::vector<SignalRow> &rows);

/// The end of every pause of rows (first, last].
std::vector<StaticPoint> static_points(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last);

/// Least-squares fit of P - PEEP = E (V - V_start) + R flow with weights dt (Aviles-Rojas & Hurtado 2022, eq. 52)
/// over rows (first, last]: C_rs = 1/E and R. Leaves both empty where the rows do not define them.
void fit_single_compartment(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep,
                            ClinicalNumbers &numbers);

/// Numbers over rows first ... last, row @p first being the start of the breath.
ClinicalNumbers clinical_numbers(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last);

/// One entry per breath of the rows.
std::vector<ClinicalNumbers> breath_numbers(const std::vector<SignalRow> &rows);

/// The last breath's numbers with C_rs, R and time constant fitted over all breaths.
ClinicalNumbers overall_numbers(const std::vector<SignalRow> &rows);

} // namespace pulmo
