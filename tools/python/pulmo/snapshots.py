"""Snapshots of a run: the mesh and its fields, as fields.xdmf lists them."""
import functools
import os
import xml.etree.ElementTree as ElementTree

import h5py
import numpy as np

from .errors import Missing, PulmoError


def numbering(points, cells, of_points, of_cells):
    """How one mesh numbers what another one has: (nodes, cells), so that of_points[nodes] is points and of_cells[cells] holds
    the nodes of cells; None if the meshes differ. points: (n, 3); cells: (m, 10) nodes each."""
    if points.shape != of_points.shape or cells.shape != of_cells.shape:
        return None
    # places have ranks in both; nodes of a slit share theirs, those of one cell never do
    rank = np.unique(np.concatenate([points, of_points]), axis=0, return_inverse=True)[1].reshape(2, -1)
    ordered = []
    for mine, all_cells in zip(rank, (cells, of_cells)):
        within = np.argsort(mine[all_cells], axis=1)
        nodes = np.take_along_axis(all_cells, within, axis=1)
        order = np.lexsort(mine[nodes].T)
        ordered.append((order, nodes[order], mine[nodes[order]]))
    (order, nodes, places), (of_order, of_nodes, of_places) = ordered
    if not np.array_equal(places, of_places):
        return None
    to_node, to_cell = np.empty(len(points), int), np.empty(len(cells), int)
    to_node[nodes], to_cell[order] = of_nodes, of_order
    return to_node, to_cell


class Snapshots:
    """Fields of a run at the times it kept, on quadratic tetrahedra.

    times: s, one for each snapshot. names: of the fields, with their units. centers: {name: "Node" or "Cell"}.
    points: (n, 3) places of the nodes at rest, mm; in pulmo's lungs x points right, y to the front, z up.
    cells: (m, 10) nodes of the tetrahedra in VTK's order: four corners, then the middles of six edges.
    """

    def __init__(self, directory):
        self.directory = directory
        path = os.path.join(directory, "fields.xdmf")
        if not os.path.exists(path):
            raise Missing("The directory has no fields.xdmf, so there is no picture of the lung.")
        try:
            steps = ElementTree.parse(path).getroot().findall(".//Grid[@GridType='Uniform']")
            self.times = [float(step.find("Time").get("Value")) for step in steps]
            self._where = [{a.get("Name"): a.find("DataItem").text for a in step.findall("Attribute")} for step in steps]
            self._meshes = [(step.find("Geometry/DataItem").text, step.find("Topology/DataItem").text) for step in steps]
            self.centers = {a.get("Name"): a.get("Center") for a in steps[0].findall("Attribute")}
            self.names = list(self.centers)
            self.points, self.cells = self._mesh(0)
        except (ElementTree.ParseError, AttributeError, IndexError, TypeError, ValueError) as error:
            raise Missing(f"fields.xdmf is damaged or holds no snapshot yet ({error}).") from None
        for name in "J_mean", "displacement_mm":
            if any(name not in where for where in self._where):
                raise Missing(f"fields.xdmf has no {name}: another version of pulmo wrote it.")

    def _read(self, where):
        name, dataset = where.strip().split(":")
        try:
            with h5py.File(os.path.join(self.directory, os.path.basename(name))) as file:
                return file[dataset][()]
        except (OSError, KeyError) as error:
            raise Missing(f"{name}, which fields.xdmf names, cannot be read ({error}).") from None

    def _mesh(self, snapshot):
        geometry, topology = (self._read(where) for where in self._meshes[snapshot])
        return geometry, topology.reshape(-1, 10)

    @functools.lru_cache(maxsize=8)
    def _numbering(self, mesh):
        """Of the nodes and cells of a mesh that was written later: a run that was restarted on other ranks numbers anew."""
        found = numbering(self.points, self.cells, *self._mesh(self._meshes.index(mesh)))
        if found is None:
            raise Missing("The snapshots in fields.xdmf are of meshes that differ.")
        return found

    @functools.lru_cache(maxsize=64)
    def values(self, name, snapshot):
        """A field at a snapshot (its number, -1 the last), numbered as `points` or `cells` are: (n,), (n, 3) or (m,); None if
        the run has no such field."""
        if not hasattr(snapshot, "__index__") or not -len(self.times) <= snapshot < len(self.times):
            raise PulmoError(f"there is no snapshot {snapshot!r}: the run has {len(self.times)}, numbered from 0 (times: their s)")
        where = self._where[snapshot].get(name)
        if where is None:
            return None
        values = self._read(where)
        if self._meshes[snapshot] != self._meshes[0]:
            values = values[self._numbering(self._meshes[snapshot])[0 if self.centers[name] == "Node" else 1]]
        return values

    @functools.cached_property
    def volumes(self):
        """(m,) volumes of the cells at rest, mm^3."""
        corners = self.points[self.cells[:, :4]]
        return np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6

    def volume(self, snapshot):
        """Volume of the lung at a snapshot, mm^3."""
        return float(self.volumes @ self.values("J_mean", snapshot))
