/// @file
/// What each accepted step of a run leaves: a row of signals.csv.
#pragma once

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
  std::vector<double> scalars, scalar_flows; ///< of effects: cmH2O; into the lung by their surfaces, ml/s
  std::vector<double> integrals;             ///< of what effects remember (Composition::integrals)
  double stored_flow = 0;                    ///< flow through the opening that does not enter the lung, ml/s
  bool hold = false;                         ///< the phase holds the volume (prescribed flow 0)
  bool past_limit = false; ///< after a limit point; no prescribed pressure was held again yet, flows are prescribed
  std::optional<double> ventilator_pressure; ///< on the machine's side of a tube, cmH2O; without one the airway's
  std::optional<double> alveolar_pressure;   ///< mean over the reference volume, cmH2O; empty without airflow
  double rest_volume = 0;                    ///< of the lung, ml; 0: not known
  bool flow_resistance = true;               ///< something resists the flow: airflow through the tissue, or a tube
  std::optional<double> cut;                 ///< the run ends here, before its breath does: when that would end, s

  /// What a clinician reads: the pressure at the machine, cmH2O.
  double machine_pressure() const { return ventilator_pressure.value_or(pressure); }
  /// Whether the phase waits for the lung to come to rest.
  bool pause() const { return hold || phase == "pause"; }
};

} // namespace pulmo
