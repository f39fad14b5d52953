"""Flow and pressure of the breaths as a ventilator gives them out: the CSV of a Puritan Bennett 840 that ventMAP reads.

A breath begins with the line "BS, S:number," and ends with "BE"; between them a line "flow, pressure" (l/min, cmH2O) every
0.02 s. After the readme and raw_utils.py of github.com/hahnicity/ventMAP.
"""
import os

import numpy as np

from pulmo.errors import PulmoError
from reports.charts import jumps

STEP = 0.02  # s between samples
L_PER_MIN = 0.06  # of 1 ml/s
NAME = "ventilator.csv"


def samples(run, start, end):
    """(flow in l/min, pressure in cmH2O) in (start, end], s: flow as the mean over each sample's interval, so that its sum is
    the volume that came; pressure at the interval's end, on the machine's side of a tube."""
    column = "ventilator_pressure_cmH2O" if "ventilator_pressure_cmH2O" in run.signals else "airway_pressure_cmH2O"
    time, volume, pressure = (np.array(run.signals[name]) for name in ("time_s", "volume_ml", column))
    count = int((end - start) / STEP + 1e-6)
    at = start + STEP * np.arange(count + 1)
    flow = np.diff(np.interp(at, time, volume)) / STEP * L_PER_MIN
    values = np.interp(at[1:], time, pressure)
    rows = np.searchsorted(time, at[1:] - 1e-9)
    jumped = np.isin(rows, jumps(run, column))  # the new pressure holds from the start of the step that jumps
    values[jumped] = pressure[rows[jumped]]
    return flow, values


def export(run, given, moments, folder, say):
    """Writes the complete breaths into a folder; returns the name of the file."""
    breaths = run.summary.get("breaths") or []
    whole = [(number, breath) for number, breath in enumerate(breaths, 1) if breath["complete"]]
    if not whole:
        raise PulmoError(f"{run.directory} holds no complete breath, and the CSV of a ventilator is made of breaths")
    if len(whole) < len(breaths):
        say(f"{len(breaths) - len(whole)} of {len(breaths)} breaths were cut and are left out")
    with open(os.path.join(folder, NAME), "w", encoding="ascii") as out:
        for number, breath in whole:
            flow, pressure = samples(run, breath["start_s"], breath["end_s"])
            flow = np.diff(np.cumsum(flow).round(2), prepend=0)  # what rounding takes from a line it gives to the next
            rows = zip(flow + 0.0, pressure)
            out.write(f"BS, S:{number},\n" + "".join(f"{flow:.2f}, {pressure:.2f}\n" for flow, pressure in rows) + "BE\n")
    return [NAME]
