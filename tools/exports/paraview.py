"""The script `views.py` for ParaView, with the fields, ranges and times of a run."""
import os
from pathlib import Path

import numpy as np

from pulmo.errors import Missing

from .nifti import SHORT

NAME = "views.py"
LINE = "SETTINGS = {}  # tools/export fills this in\n"
WORDS = {"J_mean": "J", "ventilation_since_breath_start": "ventilation (ml/ml)", "displacement_mm": "displacement (mm)",
         "alveolar_pressure_cmH2O": "alveolar pressure (cmH2O)"}


def coloured(fields, name):
    """(name, title, [least, largest]) of a field over all times, of a vector its length."""
    values = [fields.values(name, s) for s in range(len(fields.times))]
    values = [np.linalg.norm(v, axis=1) if v.ndim > 1 else v for v in values]
    low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
    return name, WORDS[name], [low, max(high, low + 1e-6)]


def planes(fields):
    """Points that a coronal, a sagittal and an axial section go through; the sagittal one through the middle of the right half."""
    middles = fields.points[fields.cells[:, :4]].mean(axis=1)
    middle = fields.volumes @ middles / fields.volumes.sum()
    right = middles[:, 0] > middle[0]
    through = fields.volumes[right] @ middles[right] / fields.volumes[right].sum()
    return middle.tolist(), through.tolist(), middle.tolist()


def export(run, given, moments, folder, say):
    """Writes the script into a folder; returns its name."""
    fields = run.fields
    try:
        time = fields.times[run.full[1]]
    except Missing:
        time = fields.times[-1]
    air, sliced = (SHORT[short] if SHORT[short] in fields.names else SHORT["J"] for short in ("ventilation", "pressure"))
    source = os.path.abspath(os.path.join(run.directory, "fields.xdmf"))
    settings = {"path": source, "from_here": os.path.relpath(source, os.path.abspath(given.output)), "time": time,
                "air": coloured(fields, air), "sliced": coloured(fields, sliced),
                "sliced_kind": "POINTS" if fields.centers[sliced] == "Node" else "CELLS", "displacement": coloured(fields, "displacement_mm"),
                "planes": planes(fields), "middle": planes(fields)[0]}
    text = (Path(__file__).parent / NAME).read_text(encoding="utf-8")
    assert LINE in text
    lines = "".join(f"    {name!r}: {value!r},\n" for name, value in settings.items())
    with open(os.path.join(folder, NAME), "w", encoding="utf-8") as out:
        out.write(text.replace(LINE, "SETTINGS = {\n" + lines + "}\n"))
    return [NAME]
