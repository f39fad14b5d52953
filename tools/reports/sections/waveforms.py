"""Pressure, flow and volume over time, phases shaded, a mark for each step; of several runs on one another."""
from ..charts import chart, jumps, series, shades, thinned
from ..read import Missing

NAME, TITLE = "waveforms", "Waveforms"
CURVES = [("airway_pressure_cmH2O", "airway pressure", "cmH₂O"), ("flow_ml_per_s", "flow into the lung", "ml/s"),
          ("volume_ml", "volume above rest", "ml")]


def curve(run, column, label, index):
    """Points of a signal in time; a gap where it jumps; flow is the mean of the step that ends at its row."""
    time, values = run.time, run.signals[column]
    broken = set(jumps(run, column)) if column == "airway_pressure_cmH2O" else ()
    x, y = [], []
    for i in thinned(len(time), [j for k in broken for j in (k - 1, k)]):
        if i in broken:
            x.append(time[i])
            y.append(None)
        x.append(time[i])
        y.append(values[i])
    return series(label, x, y, index, stepped=column == "flow_ml_per_s", marks=len(time) <= 400)


def compare(runs):
    runs = [run for run in runs if run.moving]
    if not runs:
        raise Missing("The run has not made a step yet.")
    charts = []
    for column, words, unit in CURVES:
        having = [(i, run) for i, run in enumerate(runs) if column in run.signals]
        if not having:
            continue
        curves = [curve(run, column, run.name if len(runs) > 1 else words, i) for i, run in having]
        if column == "airway_pressure_cmH2O":
            curves += [curve(run, "ventilator_pressure_cmH2O", f"{run.name + ': ' if len(runs) > 1 else ''}at the ventilator", i + 1)
                       for i, run in having if "ventilator_pressure_cmH2O" in run.signals]
        least, most = min(min(r.signals[column]) for _, r in having), max(max(r.signals[column]) for _, r in having)
        charts.append(chart(f"waveform-{column.split('_')[0]}", words[0].upper() + words[1:], "time", words, curves,
                            f"{words} from {least:.4g} to {most:.4g} {unit} over {max(r.time[-1] for _, r in having):g} s",
                            x_unit="s", y_unit=unit, shades=shades(runs[0]), hover="x"))
    broken = any(jumps(run, "airway_pressure_cmH2O") for run in runs if "airway_pressure_cmH2O" in run.signals)
    phases = list(dict.fromkeys((name, colour) for name, _, _, colour in shades(runs[0])))
    return {"charts": charts, "broken": broken, "phases": phases, "shaded": runs[0].name if len(runs) > 1 else "",
            "thinned": any(len(thinned(len(run.time))) < len(run.time) for run in runs)}
