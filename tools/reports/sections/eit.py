"""An image of 32 x 32 pixels of the air that comes into a belt, with the numbers that electrical impedance tomography gives."""
import numpy as np
from PIL import Image, ImageDraw

from .. import pictures
from ..charts import number
from ..cuts import cut
from ..read import Missing

NAME, TITLE = "eit", "Image as in EIT"
PIXELS, FINE, PLANES = 32, 16, 9  # fine pixels across a pixel; planes within the belt
BELT = 0.25  # of the height of the lung
INSIDE = 0.5  # share of a pixel that must be lung to count


def belt(run):
    """(ml per pixel, share of each pixel that is lung); front row first, right of the body in the first column."""
    fields, (start, full) = run.fields, run.full
    came = fields.values("J_mean", full) - fields.values("J_mean", start)
    low, high = fields.points.min(axis=0), fields.points.max(axis=0)
    side, middle = 1.04 * max(high[:2] - low[:2]), (low + high) / 2
    thickness = BELT * (high[2] - low[2])
    fine = PIXELS * FINE
    air, lung = np.zeros((fine, fine)), np.zeros((fine, fine))
    for plane in (np.arange(PLANES) + 0.5) / PLANES - 0.5:
        polygons, cells = cut(fields.points, fields.cells, 2, middle[2] + plane * thickness)
        which = Image.new("I", (fine, fine), 0)
        draw = ImageDraw.Draw(which)
        for polygon, cell in zip(polygons, cells):
            # columns from the right of the body (large x), rows from the front (large y), as seen from the feet
            across = (0.5 - (polygon[:, 0] - middle[0]) / side) * fine - 0.5
            down = (0.5 - (polygon[:, 1] - middle[1]) / side) * fine - 0.5
            draw.polygon(list(zip(across, down)), fill=int(cell) + 1)
        cell = np.asarray(which)
        lung += cell > 0
        air += np.where(cell > 0, came[np.maximum(cell, 1) - 1], 0)

    def coarse(values):
        return values.reshape(PIXELS, FINE, PIXELS, FINE).mean(axis=(1, 3)) / PLANES
    return coarse(air) * (side / PIXELS) ** 2 * thickness / 1000, coarse(lung), thickness


def measures(image, shares):
    """(global inhomogeneity index, centre of ventilation as (column, row)) over the pixels that are lung."""
    counted = shares >= INSIDE
    values = image[counted]
    if values.size < 4 or values.sum() <= 0:
        raise Missing("The belt takes in no air.")
    index = np.abs(values - np.median(values)).sum() / values.sum()
    rows, columns = np.nonzero(counted)
    return float(index), (float(values @ columns / values.sum()), float(values @ rows / values.sum()))


def build(run):
    image, shares, thickness = belt(run)
    index, (column, row) = measures(image, shares)
    rows, columns = np.nonzero(shares >= INSIDE)

    def along(place, taken):
        """From 0 to 100 % of the lung's extent in the image."""
        return 100 * (place - taken.min() + 0.5) / (taken.max() - taken.min() + 1)
    return {"image": pictures.eit(image, shares >= INSIDE, (column, row)), "index": number(index, 3), "thickness": number(thickness, 3),
            "back": number(along(row, rows), 3), "left": number(along(column, columns), 3), "pixels": int((shares >= INSIDE).sum()),
            "air": number(float(image.sum())), "between": " to ".join(run.moment(s) for s in run.full),
            "quarters": quarters(image)}


def quarters(image):
    """Share of the air in four layers from front to back, %."""
    rows = image.sum(axis=1)
    taken = np.flatnonzero(rows > 0)
    edges = np.linspace(taken[0], taken[-1] + 1, 5)
    cumulative = np.interp(edges, np.arange(len(rows) + 1), np.append(0, np.cumsum(rows)))
    return [number(100 * share, 3) for share in np.diff(cumulative) / rows.sum()]
