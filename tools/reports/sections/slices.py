"""Coronal, sagittal and axial sections at the moments of a breath, one scale for each quantity."""
import numpy as np

from .. import pictures
from ..read import Missing

NAME, TITLE = "slices", "Sections through the lung"


class Quantity:
    def __init__(self, field, words, label, colours, less=0):
        self.field, self.words, self.label, self.map, self.less = field, words, label, colours, less

    def values(self, run, snapshot):
        return run.fields.on_cells(self.field, snapshot) - self.less

    def limits(self, values):
        """From the least to the largest but for one cell in a hundred at each end, so that a single one does not take the scale."""
        low, high = np.quantile(values, (0.01, 0.99))
        return (low, high) if high - low > 1e-9 * max(1, abs(high)) else (low - 0.5, low + 0.5)


QUANTITIES = [
    Quantity("J_mean", "Volume gained since rest", "J − 1 (ml gained per ml at rest)", "viridis", 1),
    Quantity("alveolar_pressure_cmH2O", "Alveolar pressure", "alveolar pressure (cmH₂O)", "cividis"),
    Quantity("hydrostatic_stress_kPa", "Mean stress of the tissue", "hydrostatic stress (kPa)", "magma"),
]


def build(run):
    moments = run.moments  # raises Missing
    drawn = []
    for quantity in QUANTITIES:
        if run.fields.values(quantity.field, moments[0][1]) is None:
            continue
        image, alt, low, high = pictures.sections(run, quantity)
        drawn.append({"image": image, "alt": alt, "words": quantity.words, "low": f"{low:.3g}", "high": f"{high:.3g}"})
    if not drawn:
        raise Missing("The snapshots hold no field that a section could show.")
    return {"drawn": drawn, "moments": [run.moment(s) for _, s in moments]}
