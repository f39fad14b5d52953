"""Snapshots of a run as the page draws them: straight tetrahedra, their sections and surface."""
import functools

import numpy as np

import shared  # noqa: F401: where the module pulmo is
from pulmo.snapshots import Snapshots

from .cuts import cut

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # of a tetrahedron, each seen from outside
LATTICE = 4  # points of a cell along an edge, where a cell is shared out among bins


class Fields:
    """Straight tetrahedra on their corners; a value per cell or per corner, by snapshot."""

    def __init__(self, directory):
        self.kept = Snapshots(directory)
        self.times, self.centers, self.volumes = self.kept.times, self.kept.centers, self.kept.volumes
        self.corners, cells = np.unique(self.kept.cells[:, :4], return_inverse=True)  # mid-edge nodes go
        self.cells = cells.reshape(-1, 4)
        self.points = self.kept.points[self.corners]
        edges = self.points[self.cells[:, 1:]] - self.points[self.cells[:, :1]]
        signed = np.linalg.det(edges)
        self.cells[signed < 0] = self.cells[signed < 0][:, [0, 2, 1, 3]]

    def values(self, name, snapshot):
        """A field at a snapshot, on cells or corners; None if the run has no such field."""
        values = self.kept.values(name, snapshot)
        return values[self.corners] if values is not None and self.centers[name] == "Node" else values

    def on_cells(self, name, snapshot):
        values = self.values(name, snapshot)
        if values is not None and self.centers[name] == "Node":
            return values[self.cells].mean(axis=1)
        return values

    def shape(self, snapshot):
        """Places of the corners, mm."""
        return self.points + self.values("displacement_mm", snapshot)

    @functools.lru_cache(maxsize=32)
    def section(self, snapshot, axis, place):
        """(polygons, cells) of a section through the shape of a moment."""
        return cut(self.shape(snapshot), self.cells, axis, place)

    def volume(self, snapshot):
        """Volume of the lung, mm^3."""
        return self.kept.volume(snapshot)

    @functools.cached_property
    def lattice(self):
        """(places, cells, volumes): points that share out each cell evenly, mm, mm^3."""
        n = LATTICE
        weights = np.array([(a + 0.25, b + 0.25, c + 0.25, n - 1 - a - b - c + 0.25)
                            for a in range(n) for b in range(n - a) for c in range(n - a - b)]) / n
        places = np.einsum("wk,ckd->cwd", weights, self.points[self.cells]).reshape(-1, 3)
        cells = np.repeat(np.arange(len(self.cells)), len(weights))
        return places, cells, self.volumes[cells] / len(weights)

    @functools.cached_property
    def surface(self):
        """(triangles, cells behind them) of the boundary, seen from outside."""
        faces = self.cells[:, FACES].reshape(-1, 3)
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        outer = np.sort(first[count == 1])
        return faces[outer], outer // 4
