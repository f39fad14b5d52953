"""Pressure-volume and flow-volume loops with hover values; where a static curve bends."""
from ..charts import chart, jumps, series, thinned
from ..pv_curve import describe
from ..read import Missing, phase_spans

NAME, TITLE = "loops", "Loops"


def loop(run, across, up, index, several):
    time, phase = run.time, run.signals.get("phase") or [""] * len(run.time)
    pressure = across == "airway_pressure_cmH2O"
    broken = set(jumps(run, across)) if pressure else set(jumps(run, up))
    rows = thinned(len(time), [j for k in broken for j in (k - 1, k)])
    x, y, words = [], [], []
    for i in rows:
        if i in broken:
            x.append(run.signals[across][i])
            y.append(None)
            words.append("")
        x.append(run.signals[across][i])
        y.append(run.signals[up][i])
        words.append(f"t = {time[i]:.5g} s, {phase[i]}")
    return series(run.name if several else "loop", x, y, index, marks=len(time) <= 400, words=words)


def static_points(run, index, several):
    ends = [run.time.index(span[2]) for span in phase_spans(run.signals) if span[0] in ("pause", "hold")] if "phase" in run.signals else []
    if len(ends) < 3:
        return []
    return [series(f"{run.name + ': ' if several else ''}end of each pause", [run.signals["airway_pressure_cmH2O"][i] for i in ends],
                   [run.signals["volume_ml"][i] for i in ends], index + 1, marks=True,
                   words=[f"t = {run.time[i]:.5g} s" for i in ends])]


def compare(runs):
    runs = [run for run in runs if run.moving and "airway_pressure_cmH2O" in run.signals]
    if not runs:
        raise Missing("A loop needs a ventilator and at least one step.")
    several = len(runs) > 1
    pv = [c for i, run in enumerate(runs) for c in [loop(run, "airway_pressure_cmH2O", "volume_ml", i, several)] +
          static_points(run, i, several)]
    charts = [chart("loop-pressure-volume", "Pressure–volume loop", "airway pressure", "volume above rest", pv,
                    "volume above rest over airway pressure, row by row", x_unit="cmH₂O", y_unit="ml", height=20)]
    flowing = [run for run in runs if "flow_ml_per_s" in run.signals]
    if flowing:
        charts.append(chart("loop-flow-volume", "Flow–volume loop", "volume above rest", "flow into the lung",
                            [loop(run, "volume_ml", "flow_ml_per_s", i, several) for i, run in enumerate(flowing)],
                            "flow into the lung over volume above rest, row by row", x_unit="ml", y_unit="ml/s", height=20))
    return {"charts": charts, "static": [(run.name, describe(run.summary)) for run in runs if describe(run.summary)], "several": several}
