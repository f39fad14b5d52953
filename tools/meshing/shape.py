"""The lung as an implicit function, smooth and parametric: rib cage, apex, mediastinum, heart, diaphragm, bronchi."""
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, spatial
from scipy.interpolate import PchipInterpolator
from skimage import measure

BRONCHUS_RADIUS = 7.8   # of the main bronchi, template mm
TEMPLATE_VOLUME = 2450  # of the template's pair, ml
GRID = 2.5              # spacing of the implicit function, template mm
BORDER_RADIUS = 3.5     # of the sharpest outer borders, template mm
RIM_BEND = 1 / 14       # sum of the principal curvatures that makes a sharp border, 1/mm

# Rib cage by height z: half width (from the midline), half depth, and y of the middle; template mm.
CAGE_WIDTH = [(-20, 117), (20, 120), (70, 119), (110, 114), (150, 106), (180, 95), (205, 82), (250, 60)]
CAGE_DEPTH = [(-20, 90), (20, 92), (70, 92), (120, 85), (160, 72), (200, 55), (250, 36)]
CAGE_MIDDLE = [(-20, -8), (60, -6), (120, -11), (160, -19), (200, -31), (250, -46)]

# Bronchi as capsules: start, end (|x|, y, z) and radius, template mm. The first starts outside the lung.
BRONCHI = {
    "right": [((5, -14, 134), (50, -18, 120), BRONCHUS_RADIUS),
              ((50, -18, 120), (69, -10, 138), 5.0),
              ((50, -18, 120), (60, -18, 98), 5.5),
              ((60, -18, 98), (76, 10, 86), 4.5),
              ((60, -18, 98), (72, -36, 76), 4.5)],
    "left": [((5, -20, 142), (50, -28, 131), BRONCHUS_RADIUS),
             ((50, -28, 131), (71, -12, 146), 5.0),
             ((50, -28, 131), (70, -44, 98), 4.5)],
}


def profile(table, z):
    """Smooth monotone interpolation of (z, value) pairs at heights z, mm."""
    heights, values = np.array(table, dtype=float).T
    return PchipInterpolator(heights, values)(np.clip(z, heights[0], heights[-1]))


def smooth_min(a, b, radius):
    """Minimum of two distance fields, the edge rounded over about radius mm."""
    overlap = np.maximum(radius - np.abs(a - b), 0) / radius
    return np.minimum(a, b) - overlap**2 * radius / 4


def as_distance(field, spacing):
    """First-order signed distance (mm) to the zero level of a field given on a grid."""
    slope = np.sqrt(sum(g**2 for g in np.gradient(field, spacing)))
    return field / np.maximum(slope, 1e-6)


def outside_ellipse(x, y, half_x, half_y, power=2.0):
    """Field that is positive outside a (super-)ellipse about the origin."""
    return (np.abs(x / half_x) ** power + np.abs(y / half_y) ** power) ** (1 / power) - 1


def outside_ellipsoid(offsets, axis, half_long, half_short):
    """Field that is positive outside a spheroid.

    offsets: (..., 3) positions from its centre. axis: direction of the half axis half_long, mm.
    """
    axis = np.asarray(axis) / np.linalg.norm(axis)
    along = offsets @ axis
    across2 = np.sum(offsets**2, axis=-1) - along**2
    return np.sqrt((along / half_long) ** 2 + across2 / half_short**2) - 1


def capsule_distance(points, start, end, radius):
    """Signed distance (mm) of points (..., 3) to a capsule, negative inside."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = np.clip((points - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
    return np.linalg.norm(points - start - along[..., None] * (end - start), axis=-1) - radius


def bronchi_distance(points, capsules):
    """Signed distance (mm) of points to the union of bronchi, the forks rounded."""
    distance = capsule_distance(points, *capsules[0])
    for capsule in capsules[1:]:
        distance = smooth_min(distance, capsule_distance(points, *capsule), 4)
    return distance


@dataclass
class Shape:
    """One lung as an implicit function on a grid (template mm, x counted from the midline outwards).

    origin: first point of the grid. body: distance into the lung without its airways.
    capsules: the carved bronchi (none for a hilum patch). hilum: where the bronchus enters.
    """

    origin: np.ndarray
    body: np.ndarray
    capsules: list
    hilum: np.ndarray

    def body_at(self, points):
        """Distance (mm) into the uncarved lung at points (n, 3)."""
        return self.sampled(self.body, points)

    def sampled(self, field, points):
        """A field of the grid, interpolated at points (n, 3)."""
        return ndimage.map_coordinates(field, ((points - self.origin) / GRID).T, order=1, mode="nearest")

    def rim(self, points):
        """Those of the surface points (n, 3) that lie on the sharp borders of the uncarved lung, thinned out."""
        bend = bending(self.body, GRID)
        return thinned(points[(self.sampled(bend, points) > RIM_BEND) & (np.abs(self.body_at(points)) < GRID)], 2 * GRID)


def bending(distance, step):
    """Sum of the principal curvatures of the levels of a distance (positive inside), 1/mm, on a grid of a step (mm)."""
    normal = np.array(np.gradient(ndimage.gaussian_filter(-distance, 1.0), step))
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-6)
    return sum(np.gradient(normal[i], step, axis=i) for i in range(3))


def thinned(points, apart):
    """Some of the points (n, 3), about one in each cube of an edge."""
    _, first = np.unique(np.round(points / apart), axis=0, return_index=True)
    return points[first]


def lung_shape(side, airway, bronchus_radius):
    """The implicit lung of one side ("right" or "left") with its airway ("hilum", "main" or "lobar").

    bronchus_radius: of the main bronchus, template mm.
    """
    axes = [np.arange(a, b, GRID) for a, b in ((-10, 146), (-116, 106), (-40, 252))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    x, y, z = np.moveaxis(grid, -1, 0)
    body = smooth_min(chest(x, y, z), clear_of_mediastinum(x, y, z, grid, side == "left"), 14)
    body = smooth_min(body, above_diaphragm(x, y, z, side == "left"), 12)
    body = blunted(body, BORDER_RADIUS)
    count = {"hilum": 0, "main": 1, "lobar": len(BRONCHI[side])}[airway]
    origin = grid[0, 0, 0]
    start, end, _ = BRONCHI[side][0]
    capsules = [(start, end, bronchus_radius)] + BRONCHI[side][1:]
    shape = Shape(origin, body, capsules[:count], np.zeros(3))
    track = np.linspace(start, end, 200)
    shape.hilum = track[np.argmax(shape.body_at(track) > 0)]
    return shape


def blunted(body, radius):
    """A distance field whose sharp outer borders are rounded to a radius (mm); flat parts stay in place."""
    core, _, _, _ = measure.marching_cubes(body, radius, spacing=(GRID,) * 3)
    near = np.abs(body - radius) < 4 * radius
    distance, _ = spatial.cKDTree(core).query(GRID * np.argwhere(near))
    rounded = body.copy()
    rounded[near] = radius - np.sign(radius - body[near]) * distance
    return rounded


def chest(x, y, z):
    """Distance (mm) into the rib cage: superelliptic sections, closed above by the dome of the apex."""
    middle = profile(CAGE_MIDDLE, z)
    cage = -outside_ellipse(x, y - middle, profile(CAGE_WIDTH, z), profile(CAGE_DEPTH, z), 2.3)
    dome = 230 - 40 * ((x - 53) / 46) ** 2 - 36 * ((y + 38) / 54) ** 2 - z
    return smooth_min(as_distance(cage, GRID), as_distance(dome, GRID), 25)


def clear_of_mediastinum(x, y, z, grid, left):
    """Distance (mm) from the midline, vertebral column, great vessels and heart."""
    middle, depth = profile(CAGE_MIDDLE, z), profile(CAGE_DEPTH, z)
    spine = outside_ellipse(x, y - (middle - depth + 16), 34, 36)
    vessels = outside_ellipse(x, y - middle + 12, 40 - 0.06 * (z - 120), 0.5 * depth)
    mirror = np.array([-1 if left else 1, 1, 1])
    heart = outside_ellipsoid(grid * mirror - (-26, 28, 58), (-0.72, 0.35, -0.6), 77, 61)
    free = smooth_min(as_distance(spine, GRID), as_distance(vessels, GRID), 20)
    free = smooth_min(free, as_distance(heart, GRID), 20)
    free = smooth_min(free, x - 7, 15)
    if left:
        notch = np.sqrt(((x - 30) / 46) ** 2 + ((y - 76) / 50) ** 2 + ((z - 52) / 42) ** 2) - 1
        free = smooth_min(free, as_distance(notch, GRID), 12)
    return free


def above_diaphragm(x, y, z, left):
    """Distance (mm) above the diaphragm: a dome whose rim lies deeper at the back."""
    across = (x - 70) / np.where(x > 70, 59, 120)
    rise = (92 if left else 100) * (1 - across**2 - ((y + 2) / 98) ** 2)
    return as_distance(z + 38 - 0.15 * (y + 95) - rise, GRID)
