"""The moving surface in three dimensions, as numbers of 8 and 16 bits for three.js."""
import base64

import matplotlib
import numpy as np

from ..cuts import rarer
from ..read import Missing

NAME, TITLE = "surface", "The lung as it moves"
QUANTITIES = [("J_mean", "volume gained since rest, J − 1", "ml/ml", "viridis", 1),
              ("alveolar_pressure_cmH2O", "alveolar pressure", "cmH₂O", "cividis", 0),
              ("hydrostatic_stress_kPa", "hydrostatic stress of the tissue", "kPa", "magma", 0),
              ("von_mises_stress_kPa", "von Mises stress of the tissue", "kPa", "inferno", 0)]
TRIANGLES = 16000
BYTES = 1.6e6  # of all runs of a page, in the page


def packed(array):
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def colours(name):
    return packed((255 * matplotlib.colormaps[name](np.arange(256))[:, :3]).round().astype("u1"))


def build(run):
    fields = run.fields
    present = [q for q in QUANTITIES if fields.values(q[0], 0) is not None]
    triangles, cells = rarer(fields.points, *fields.surface, TRIANGLES)
    corners, triangles = np.unique(triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    of_frame = 4 / 3 * (6 * len(corners) + len(present) * len(triangles))
    most = max(2, int(BYTES / run.of / of_frame))
    frames = sorted({*np.linspace(0, len(fields.times) - 1, min(most, len(fields.times))).round().astype(int),
                     *[s for _, s in run.moments]})
    rest = fields.points[corners]
    low, extent = rest.min(axis=0), float(np.ptp(rest, axis=0).max())
    moved = np.array([fields.values("displacement_mm", s)[corners] for s in frames])
    step = max(float(np.abs(moved).max()), 1e-9) / 32767
    painted = []
    for name, words, unit, colour, less in present:
        values = np.array([fields.on_cells(name, s)[cells] for s in frames]) - less
        least, most_of_it = np.quantile(values, (0.005, 0.995))
        if most_of_it - least < 1e-12:
            least, most_of_it = least - 0.5, least + 0.5
        scaled = np.clip((values - least) / (most_of_it - least), 0, 1) * 255
        painted.append({"words": words, "unit": unit, "low": float(least), "high": float(most_of_it), "colours": colours(colour),
                        "values": packed(scaled.round().astype("u1"))})
    if not painted:
        raise Missing("The snapshots hold no field to colour the surface with.")
    data = {"corners": len(corners), "triangles": len(triangles), "times": [float(f"{fields.times[s]:.6g}") for s in frames],
            "low": low.tolist(), "extent": extent, "step": step, "index": packed(triangles.astype("<u4" if len(corners) > 65535 else "<u2")),
            "wide": len(corners) > 65535, "rest": packed(((rest - low) / extent * 65535).round().astype("<u2")),
            "moved": packed((moved / step).round().astype("<i2")), "quantities": painted}
    return {"data": data, "frames": len(frames), "all": len(fields.times), "thinned": len(cells) < len(fields.surface[1]),
            "first": painted[0], "full": frames.index(fullest(run))}


def fullest(run):
    """The snapshot with the most air: where the slider starts."""
    return max((s for _, s in run.moments), key=run.fields.volume)
