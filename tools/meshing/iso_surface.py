"""Triangles of a lung's surface from its implicit function, smoothed."""
import numpy as np
from scipy import ndimage, sparse
from skimage import measure

from .geometry import enclosed_volume
from .shape import GRID, bronchi_distance, smooth_min

SMOOTHING_STEPS = 12    # of Taubin's filter


def iso_surface(shape):
    """Smoothed triangles of the lung's surface: points (n, 3) in template mm, triangles (m, 3)."""
    field = shape.body
    if shape.capsules:
        grid = shape.origin + GRID * np.moveaxis(np.indices(field.shape), 0, -1)
        field = smooth_min(field, bronchi_distance(grid, shape.capsules), 3)
    parts, _ = ndimage.label(field > 0)
    lung = parts == np.argmax(np.bincount(parts[parts > 0]))
    field = np.where(ndimage.binary_dilation(lung, iterations=2), field, -GRID)
    points, triangles, _, _ = measure.marching_cubes(field, 0, spacing=(GRID,) * 3)
    points = taubin(points.astype(float) + shape.origin, triangles, SMOOTHING_STEPS)
    if enclosed_volume(points, triangles) < 0:
        triangles = triangles[:, ::-1]
    return points, triangles


def taubin(points, triangles, steps, shrink=0.5, grow=-0.53):
    """Smooth a closed surface without shrinking it (Taubin's two-step filter)."""
    rows, columns = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    neighbours = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(points),) * 2).tocsr()
    mean = sparse.diags(1 / np.asarray(neighbours.sum(axis=1)).ravel()) @ neighbours
    for _ in range(steps):
        for factor in (shrink, grow):
            points = points + factor * (mean @ points - points)
    return points
