"""The single compartment P = PEEP + E (V - V0) + R Q that fits the last breath best, and what it leaves over in time."""
from ..charts import chart, jumps, number, series, shades, thinned
from ..read import Missing

NAME, TITLE = "fit", "Fit of one compartment"


def start_row(run, start):
    """The last row at or before the start of a breath."""
    return max(i for i, t in enumerate(run.time) if t <= start + 1e-9 * max(1, abs(start)))


def build(run):
    compliance, resistance = (run.summary.get(key) for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"))
    if not run.breath or compliance is None or resistance is None:
        raise Missing("The run defines no compliance and resistance: it needs a complete breath with flow.")
    column = "ventilator_pressure_cmH2O" if "ventilator_pressure_cmH2O" in run.signals else "airway_pressure_cmH2O"
    pressure = run.signals[column]
    volume, flow = run.signals["volume_ml"], run.signals["flow_ml_per_s"]
    first = run.summary["breaths"][0]
    rest = volume[start_row(run, first["start_s"])]
    begin, end = start_row(run, run.breath["start_s"]), start_row(run, run.breath["end_s"])
    rows = range(begin + 1, end + 1)
    time = [run.time[i] for i in rows]
    measured = [pressure[i] for i in rows]
    fitted = [first["peep_cmH2O"] + (volume[i] - rest) / compliance + resistance * flow[i] / 1000 for i in rows]
    left = [a - b for a, b in zip(measured, fitted)]
    weights = [run.time[i] - run.time[i - 1] for i in rows]
    rms = (sum(w * r * r for w, r in zip(weights, left)) / sum(weights)) ** 0.5
    worst = max(range(len(left)), key=lambda i: abs(left[i]))
    broken = {i - rows[0] for i in jumps(run, column) if i > rows[0]}
    drawn = thinned(len(rows), [j for k in broken if k < len(rows) for j in (k - 1, k)])

    def curve(label, values, index, marks):
        """Nothing is drawn over a jump."""
        points = [point for k in drawn for point in ([(time[k], None)] if k in broken else []) + [(time[k], values[k])]]
        return series(label, *zip(*points), index, marks=marks)
    spans = [s for s in shades(run) if s[2] > run.time[begin] and s[1] < run.time[end]]
    marks, name = len(rows) <= 400, run.name
    return {"charts": [
        chart(f"fit-{run.id}", f"Pressure and fit, breath {run.summary['numbers_of_breath']}", "time", "pressure",
              [curve("airway pressure", measured, 0, marks), curve("fit", fitted, 1, False)],
              f"pressure of {name} and of the single compartment", x_unit="s", y_unit="cmH₂O", shades=spans, hover="x", legend=True),
        chart(f"residual-{run.id}", "Pressure minus fit", "time", "residual", [curve("residual", left, 0, marks)],
              f"residual of the fit, {number(rms, 3)} cmH₂O in the mean square", x_unit="s", y_unit="cmH₂O", shades=spans, hover="x")],
        "compliance": number(compliance), "resistance": number(resistance), "constant": number(compliance * resistance / 1000),
        "peep": number(first["peep_cmH2O"]), "rms": number(rms, 3), "worst": number(left[worst], 3), "when": number(time[worst]),
        "share": number(100 * rms / max(max(measured) - min(measured), 1e-12), 2)}
