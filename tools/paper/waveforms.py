"""Figures 3 and 7 and the table of VCV: pressure, flow and volume over time."""
import numpy as np

from .drawing import letter_panels, plt, save, shade_phases, write_csv
from .tables import markdown, stop_text


def flow_steps(outcome):
    """Flow as the means over the steps: times and values to be drawn with steps-pre."""
    return outcome.time, np.concatenate([outcome.flow[1:2], outcome.flow[1:]])


def pressure_line(outcome):
    """Times and airway pressure with the fall at the start of an expiration, which holds from its first step on."""
    phase = outcome.signals["phase"]
    falls = np.flatnonzero((phase[1:] == "expiration") & (phase[:-1] != "expiration"))
    return (np.insert(outcome.time, falls + 1, outcome.time[falls]),
            np.insert(outcome.pressure, falls + 1, outcome.pressure[falls + 1]))


def waveforms(results, start):
    """Pressure, flow and volume over time, one curve per law (Figures 3 and 7)."""
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(6.4, 6.6), sharex=True)
    rows = []
    for law, outcome, label in results.best(start):
        shade = outcome if outcome.finished else None
        style = {"color": law.colour, "label": label + ("" if outcome.finished else " (stops)")}
        top.plot(*pressure_line(outcome), **style)
        middle.plot(*flow_steps(outcome), drawstyle="steps-pre", **style)
        bottom.plot(outcome.time, outcome.volume, **style)
        if not outcome.finished:
            for axes, values in ((top, outcome.pressure), (bottom, outcome.volume)):
                axes.plot(outcome.time[-1], values[-1], "x", color=law.colour)
        rows += [(label, float(t), float(p), float(q), float(v)) for t, p, q, v in
                 zip(outcome.time, outcome.pressure, outcome.flow, outcome.volume)]
    for axes, label in ((top, "airway pressure\n(cmH$_2$O)"), (middle, "flow into the lung\n(ml/s)"),
                        (bottom, "volume above rest\n(ml)")):
        axes.set_ylabel(label)
        if shade:
            shade_phases(axes, shade)
    bottom.set_xlabel("time (s)")
    bottom.set_xlim(0, outcome.time[-1])
    letter_panels((top, middle, bottom))
    top.legend(ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.02), columnspacing=1.2, handlelength=1.5)
    figure.align_ylabels()
    return figure, (top, middle, bottom), rows


def field_instants(results):
    """t1 (peak flow), t2 (end of inspiration), t3 (half of the expiration), s."""
    peaks = {float(o.time[np.argmax(o.flow)]) for _, o, _ in results.best("pcv")}
    inspiration, expiration = results.plan.inspiration, results.plan.expiration
    return min(peaks), inspiration, inspiration + expiration / 2


def figure3(results, folder):
    figure, axes, rows = waveforms(results, "pcv")
    ends = {"$t_1$": field_instants(results)[0], "$t_2$": results.plan.inspiration,
            "$t_3$": results.plan.inspiration + results.plan.expiration / 2}
    for name, t in ends.items():
        axes[2].axvline(t, color="#555555", lw=0.8, ls=":")
        axes[2].annotate(name, (t, 1.02), xycoords=("data", "axes fraction"), ha="center")
    save(figure, folder / "figure3.png")
    write_csv(folder / "figure3.csv", ["law", "time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"], rows)


def figure7(results, folder):
    figure, _, rows = waveforms(results, "vcv")
    save(figure, folder / "figure7.png")
    write_csv(folder / "figure7.csv", ["law", "time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"], rows)


def vcv_page(results):
    rows = []
    for label, _, o in results.all("vcv"):
        if o.finished:
            pip, plateau = o["peak_inspiratory_pressure_cmH2O"], o["plateau_pressure_cmH2O"]
            rows.append((label, f"{pip:.2f}", f"{plateau:.2f}", f"{pip - plateau:.2f}", f"{o.volume[-1]:.0f}",
                         f"{o['min_jacobian']:.3f}"))
        else:
            rows.append((label, stop_text(o), "–", "–", "–", f"{o.signals['min_J'].min():.3f}"))
    return markdown(["law", "PIP", "plateau", "PIP − plateau", "left at the end ml", "min J"], rows)
