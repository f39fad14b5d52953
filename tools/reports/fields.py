"""Snapshots of a run: the mesh and its fields, as fields.xdmf lists them."""
import functools
import os
import xml.etree.ElementTree as ElementTree

import h5py
import numpy as np

from .cuts import cut
from .read import Missing

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # of a tetrahedron, each seen from outside
LATTICE = 4  # points of a cell along an edge, where a cell is shared out among bins


class Fields:
    """Straight tetrahedra on their corners; a value per cell or per corner, by snapshot."""

    def __init__(self, directory):
        self.directory = directory
        path = os.path.join(directory, "fields.xdmf")
        if not os.path.exists(path):
            raise Missing("The directory has no fields.xdmf, so there is no picture of the lung.")
        try:
            steps = ElementTree.parse(path).getroot().findall(".//Grid[@GridType='Uniform']")
            self.times = [float(step.find("Time").get("Value")) for step in steps]
            self._where = [{a.get("Name"): a.find("DataItem").text for a in step.findall("Attribute")} for step in steps]
            self.centers = {a.get("Name"): a.get("Center") for a in steps[0].findall("Attribute")}
            points = self._read(steps[0].find("Geometry/DataItem").text)
            cells = self._read(steps[0].find("Topology/DataItem").text)[:, :4]
        except (ElementTree.ParseError, AttributeError, IndexError, TypeError, ValueError) as error:
            raise Missing(f"fields.xdmf is damaged or holds no snapshot yet ({error}).") from None
        for name in "J_mean", "displacement_mm":
            if any(name not in where for where in self._where):
                raise Missing(f"fields.xdmf has no {name}: another version of pulmo wrote it.")
        self.corners, cells = np.unique(cells, return_inverse=True)  # mid-edge nodes go
        self.cells = cells.reshape(-1, 4)
        self.points = points[self.corners]
        edges = self.points[self.cells[:, 1:]] - self.points[self.cells[:, :1]]
        signed = np.linalg.det(edges) / 6
        self.cells[signed < 0] = self.cells[signed < 0][:, [0, 2, 1, 3]]
        self.volumes = np.abs(signed)

    def _read(self, where):
        name, dataset = where.strip().split(":")
        try:
            with h5py.File(os.path.join(self.directory, os.path.basename(name))) as file:
                return file[dataset][()]
        except (OSError, KeyError) as error:
            raise Missing(f"{name}, which fields.xdmf names, cannot be read ({error}).") from None

    @functools.lru_cache(maxsize=64)
    def values(self, name, snapshot):
        """A field at a snapshot, on cells or corners; None if the run has no such field."""
        where = self._where[snapshot].get(name)
        if where is None:
            return None
        values = self._read(where)
        return values[self.corners] if self.centers[name] == "Node" else values

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
        return float(self.volumes @ self.values("J_mean", snapshot))

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
