"""The picture of a run: pressure, flow and volume over time and the pressure-volume loop."""
import textwrap

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from .read import phase_spans  # noqa: E402

SHADES = {"settle": "#eeeeee", "inspiration": "#dbe9f6", "pause": "#e8e1f2", "hold": "#e8e1f2",
          "inflation": "#dbe9f6", "deflation": "#f6e6db"}
# column: label, colour
CURVES = {
    "airway_pressure_cmH2O": ("airway pressure (cmH$_2$O)", "#b5403a"),
    "flow_ml_per_s": ("flow into the lung (ml/s)", "#2f6c9e"),
    "volume_ml": ("volume above rest (ml)", "#3b7d4f"),
}


def numbers_text(summary):
    """The clinical numbers that the run defines, one a line."""
    lines = [("compliance", "compliance_ml_per_cmH2O", "ml/cmH$_2$O", 2), ("resistance", "resistance_cmH2O_s_per_l", "cmH$_2$O s/l", 2),
             ("time constant", "time_constant_s", "s", 3), ("tidal volume", "tidal_volume_ml", "ml", 1),
             ("driving pressure", "driving_pressure_cmH2O", "cmH$_2$O", 2), ("peak flow", "peak_flow_ml_per_s", "ml/s", 0),
             ("mechanical power", "mechanical_power_j_per_min", "J/min", 3)]
    return "\n".join(f"{label} {summary[key]:.{digits}f} {unit}" for label, key, unit, digits in lines
                     if summary.get(key) is not None)


def draw(signals, summary, unfinished, path):
    curves = [name for name in CURVES if name in signals]
    loop = "airway_pressure_cmH2O" in signals
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    rows = 3 if loop else len(curves)
    figure = plt.figure(figsize=(11 if loop else 7, 2.2 * max(rows, 2)), constrained_layout=True)
    grid = figure.add_gridspec(rows, 2 if loop else 1, width_ratios=[1.45, 1] if loop else None)
    time, first = signals["time_s"], None
    for i, name in enumerate(curves):
        axes = first = figure.add_subplot(grid[i, 0], sharex=first)
        label, colour = CURVES[name]
        for phase, begin, end in phase_spans(signals) if "phase" in signals else []:
            if phase in SHADES:
                axes.axvspan(begin, end, color=SHADES[phase], lw=0)
                if i == 0 and end - begin > 0.08 * time[-1]:
                    axes.text((begin + end) / 2, 1.02, phase, transform=axes.get_xaxis_transform(), ha="center",
                              va="bottom", fontsize=8, color="#555555")
        if min(signals[name]) < 0:
            axes.axhline(0, color="#999999", lw=0.7)
        if name == "flow_ml_per_s":  # the mean over the step that ends at a row
            axes.step(time, signals[name], where="pre", color=colour, lw=1.6)
        else:
            axes.plot(time, signals[name], color=colour, lw=1.6)
        if name == "airway_pressure_cmH2O" and "ventilator_pressure_cmH2O" in signals:
            axes.plot(time, signals["ventilator_pressure_cmH2O"], color=colour, lw=1, ls="--", label="at the ventilator")
            axes.legend(frameon=False, fontsize=8)
        axes.set_ylabel(label.replace(" (", "\n("))
        axes.set_xlim(time[0], time[-1])
        axes.tick_params(labelbottom=i == len(curves) - 1)
    axes.set_xlabel("time (s)")
    if loop:
        axes = figure.add_subplot(grid[:2, 1])
        pressure, volume = signals["airway_pressure_cmH2O"], signals["volume_ml"]
        axes.plot(pressure, volume, color="#444444", lw=1.6)
        still = [span[2] for span in phase_spans(signals) if span[0] in ("pause", "hold")]
        if len(still) > 2:  # a manoeuvre in steps: the static curve
            ends = [time.index(t) for t in still]
            axes.plot([pressure[i] for i in ends], [volume[i] for i in ends], "o:", color="#b5403a", ms=4,
                      label="end of each pause")
            axes.legend(frameon=False, fontsize=8, loc="lower right")
        middle = max(1, len(time) // 12)
        if len(time) > middle + 1:
            axes.annotate("", xy=(pressure[middle + 1], volume[middle + 1]), xytext=(pressure[middle], volume[middle]),
                          arrowprops={"arrowstyle": "-|>", "color": "#444444"})
        axes.set_xlabel(CURVES["airway_pressure_cmH2O"][0])
        axes.set_ylabel(CURVES["volume_ml"][0])
        axes.set_title("pressure-volume loop", fontsize=10)
        table = figure.add_subplot(grid[2, 1])
        table.axis("off")
        table.text(0.08, 0.95, "" if unfinished else numbers_text(summary), transform=table.transAxes, va="top", linespacing=1.5)
    if summary:
        figure.suptitle(f"{summary.get('tissue', '')} tissue, {summary.get('reference_volume_ml', 0):.0f} ml at rest, "
                        f"{summary.get('cells', '?')} tetrahedra", fontsize=11)
    if unfinished:
        figure.supxlabel(textwrap.fill(textwrap.shorten(unfinished, 600), 120 if loop else 80), fontsize=9,
                         color="#b00000")
    figure.savefig(path, dpi=150)
