/// @file
/// Clinical numbers from the signals of a run.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// One accepted step; row 0 is the start of the run. Flow into the lung is positive.
struct SignalRow {
  double time = 0;                ///< s
  double pressure = 0;            ///< airway pressure, cmH2O
  double ventilator_pressure = 0; ///< at the machine's side of the tube, cmH2O; the airway pressure without one
  double flow = 0;                ///< ml/s, of the step that ends here
  double volume = 0;              ///< ml, int (J - 1)
  std::string phase;              ///< of the programme; the phase that ends at its last row
  int breath = 0;                 ///< counted from 1; 0 before the first
  double dt = 0;                  ///< s
  long newton = 0, krylov = 0;
  double min_J = 1, max_J = 1;
};

/// Numbers of one breath, or of a whole run. What a breath does not define stays empty.
struct ClinicalNumbers {
  std::optional<double> compliance;       ///< C_rs of the fit, ml/cmH2O
  std::optional<double> resistance;       ///< R of the fit, cmH2O s/l
  std::optional<double> time_constant;    ///< R C_rs, s
  std::optional<double> plateau_pressure; ///< airway pressure at the end of the pause, cmH2O
  double peak_pressure = 0;               ///< cmH2O
  double driving_pressure = 0;            ///< plateau - PEEP (peak - PEEP without a pause), cmH2O
  double tidal_volume = 0;                ///< ml
  double trapped_volume = 0;              ///< ml
  double peak_flow = 0;                   ///< ml/s
  double work = 0;                        ///< closed integral of (P - PEEP) dV, J
  double mechanical_power = 0;            ///< work times rate, J/min
};

/// Least-squares fit of P - PEEP = E (V - V_start) + R flow with weights dt (Aviles-Rojas & Hurtado 2022, eq. 52)
/// over rows (first, last]: C_rs = 1/E and R. Leaves both empty where the rows do not define them.
void fit_single_compartment(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep,
                            ClinicalNumbers &numbers);

/// Numbers over rows first ... last, row @p first being the start of the breath.
ClinicalNumbers clinical_numbers(const std::vector<SignalRow> &rows, std::size_t first, std::size_t last, double peep);

/// One entry per breath of the rows.
std::vector<ClinicalNumbers> breath_numbers(const std::vector<SignalRow> &rows, double peep);

/// The last breath's numbers with C_rs, R and time constant fitted over all breaths.
ClinicalNumbers overall_numbers(const std::vector<SignalRow> &rows, double peep);

} // namespace pulmo
