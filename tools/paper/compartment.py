"""Figure 4: CM3 beside the single compartment."""
import math

import numpy as np

from .cases import PIP
from .drawing import letter_panels, plt, save, shade_phases, write_csv
from .laws import BY_LABEL


def compartment(time, pressure, compliance, resistance):
    """Volume (ml) and flow (ml/s) of P = V/C + R dV/dt at rest at the start, P linear between the times (exact).

    compliance: ml/cmH2O. resistance: cmH2O s/ml.
    """
    volume = np.zeros(len(time))
    tau = resistance * compliance
    for i, h in enumerate(np.diff(time)):
        a, b = pressure[i] * compliance, (pressure[i + 1] - pressure[i]) / h * compliance
        # V = a + b (t - tau) + c exp(-t / tau)
        c = volume[i] - a + b * tau
        volume[i + 1] = a + b * (h - tau) + c * math.exp(-h / tau)
    return volume, (pressure - volume / compliance) / resistance


def single_compartment(results):
    """The CM3 run and the single compartment with its fitted C_rs and R under the same pressure, on a fine time grid."""
    outcome = results["pcv_birzle"]
    C, R = outcome["compliance_ml_per_cmH2O"], outcome["resistance_cmH2O_s_per_l"] / 1000
    ramp, end = 0.1, results.plan.inspiration
    jump = 1e-6  # the pressure falls at once
    time = np.unique(np.concatenate([np.arange(0, end + results.plan.expiration, 0.005), outcome.time, [ramp, end + jump]]))
    pressure = np.where(time <= end, PIP * np.minimum(time / ramp, 1), 0)
    volume, flow = compartment(time, pressure, C, R)
    return outcome, C, R, time, pressure, volume, flow


def figure4(results, folder):
    outcome, C, R, time, pressure, volume, flow = single_compartment(results)
    law = BY_LABEL["CM3"]
    figure, axes = plt.subplots(1, 3, figsize=(9.4, 2.9))
    axes[0].plot(time, pressure, color="#444444")
    axes[1].plot(outcome.time[1:] - np.diff(outcome.time) / 2, outcome.flow[1:], "o", ms=3.2, mfc="none", color=law.colour)
    axes[1].plot(time, flow, color="#444444", lw=1.1)
    axes[2].plot(outcome.time, outcome.volume, "o", ms=3.2, mfc="none", color=law.colour, label="CM3, 3-D")
    axes[2].plot(time, volume, color="#444444", lw=1.1, label="single compartment")
    labels = ("airway pressure (cmH$_2$O)", "flow into the lung (ml/s)", "volume above rest (ml)")
    for panel, label in zip(axes, labels):
        panel.set(xlabel="time (s)", ylabel=label, xlim=(0, time[-1]))
        shade_phases(panel, outcome)
    letter_panels(axes)
    axes[1].legend(*axes[2].get_legend_handles_labels(), loc="upper right", handlelength=1.2)
    axes[2].text(0.98, 0.95, f"$C_{{rs}}$ = {C:.1f} ml/cmH$_2$O\n$R$ = {1000 * R:.2f} cmH$_2$O s/l",
                 transform=axes[2].transAxes, ha="right", va="top")
    save(figure, folder / "figure4.png")
    at = np.searchsorted(time, outcome.time - 1e-12)
    write_csv(folder / "figure4.csv", ["time_s", "airway_pressure_cmH2O", "flow_pulmo_ml_per_s", "volume_pulmo_ml",
                                       "volume_single_compartment_ml"],
              [(float(t), float(p), float(q), float(v), float(s)) for t, p, q, v, s in
               zip(outcome.time, outcome.pressure, outcome.flow, outcome.volume, volume[at])])


def figure4_text(results):
    """How far the three-dimensional volume is from the single compartment's, share of the tidal volume."""
    outcome, _, _, time, _, volume, _ = single_compartment(results)
    at = np.searchsorted(time, outcome.time - 1e-12)
    gap = np.abs(volume[at] - outcome.volume)
    worst = int(np.argmax(gap))
    share = 100 * gap[worst] / outcome["tidal_volume_ml"]
    return (f"largest difference of volume {gap[worst]:.0f} ml ({share:.1f} % of the tidal volume) at "
            f"{outcome.time[worst]:.2f} s")
