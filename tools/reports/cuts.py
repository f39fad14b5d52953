"""Geometry of tetrahedra: sections by planes, surfaces with fewer triangles."""
import numpy as np

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def cut(points, cells, axis, place):
    """Where the plane x[axis] = place meets the cells: ([polygon of 3 or 4 points], their cells)."""
    # a corner that lies in the plane counts as above it: no cell is cut in a single point
    above = points[cells][:, :, axis] >= place
    count = above.sum(axis=1)
    met = np.flatnonzero((count > 0) & (count < 4))
    corners, above = points[cells[met]], above[met]
    begin, end = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]
    crossed = above[:, EDGES[:, 0]] != above[:, EDGES[:, 1]]
    run = end[..., axis] - begin[..., axis]
    share = np.where(crossed, (place - begin[..., axis]) / np.where(crossed, run, 1), 0)
    crossing = begin + share[..., None] * (end - begin)
    polygons = []
    for found, where in zip(crossing, crossed):
        polygon = found[where]
        if len(polygon) == 4:  # around its middle
            flat = np.delete(polygon - polygon.mean(axis=0), axis, axis=1)
            polygon = polygon[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))]
        polygons.append(polygon)
    return polygons, met


def rarer(points, triangles, cells, most):
    """About as many triangles as wanted at most: corners that share a box of a grid become the one of them nearest to their
    middle, and triangles that this makes flat go."""
    boxes, low, extent = 96, points.min(axis=0), np.ptp(points, axis=0).max()
    kept, behind = triangles, cells
    while len(kept) > most and boxes > 4:
        used = np.unique(triangles)
        box = np.floor((points[used] - low) / extent * boxes * (1 - 1e-9)).astype(int)
        _, group = np.unique(box, axis=0, return_inverse=True)
        group = group.ravel()
        middle = np.stack([np.bincount(group, points[used, k]) for k in range(3)], axis=1) / np.bincount(group)[:, None]
        order = np.lexsort((np.linalg.norm(points[used] - middle[group], axis=1), group))
        first = order[np.unique(group[order], return_index=True)[1]]
        to = np.arange(len(points))
        to[used] = used[first[group]]
        moved = to[triangles]
        whole = (moved[:, 0] != moved[:, 1]) & (moved[:, 1] != moved[:, 2]) & (moved[:, 2] != moved[:, 0])
        kept, behind = moved[whole], cells[whole]
        boxes = int(boxes * 0.8)
    return kept, behind
