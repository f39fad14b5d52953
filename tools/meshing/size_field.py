"""Element sizes by the error indicators of a run of pulmo on an earlier mesh."""
import math
import os
import xml.etree.ElementTree
from dataclasses import dataclass

import numpy as np

from .geometry import tet_volumes
from .mesh import MeshError
from .sizes import SIZE_GROWTH

# indicator in a run's fields -> order of the gradients in it: of P2 displacement, of P1 pressure
INDICATORS = {"error_indicator_J": 2, "error_indicator_flux_W": 1}
LACKS = "lacks_in_space_"  # what a number lacks by -error_estimate: a product of two gradients of P1 pressure
SIZE_CHANGE = (0.25, 2)  # least and largest ratio of new to old size


@dataclass
class SizeField:
    """What the cells of an earlier mesh add to the error.

    points: (n, 3) its nodes, mm. tets: (m, 4).
    errors: [((m,) square of a cell's error relative to the whole, the order with which the error falls)].
    """

    points: np.ndarray
    tets: np.ndarray
    errors: list

    def sizes(self, cells):
        """Element size at each node, mm, that makes the sum of the squared errors least for so many tetrahedra."""
        volumes = np.abs(tet_volumes(self.points, self.tets))
        wanted = 1 / (6 * math.sqrt(2) * volumes * self.ratios(cells) ** 3)
        weight, total = np.zeros(len(self.points)), np.zeros(len(self.points))
        for corner in self.tets.T:
            np.add.at(weight, corner, volumes)
            np.add.at(total, corner, volumes * wanted)
        return graded(self.points, self.tets, (total / weight) ** (-1 / 3))

    def ratios(self, cells, largest=SIZE_CHANGE[1]):
        """Ratios of new to old size, in bounds (largest: 1 where cells can only be cut), that make so many cells of the old ones.

        In place of an old cell there are f^-3 new ones, and its squared error e of order p is e f^(2p). The sum of
        errors is least for a number of cells where 2p e f^(2p+3) (summed over the errors) is the same everywhere; for
        one error that is f = (target / root e)^(1 / (p + 1.5)), the same error in all new cells.
        """
        def counted(target):
            low, high = (np.full(len(self.tets), bound, dtype=float) for bound in (SIZE_CHANGE[0], largest))
            for _ in range(40):
                middle = (low + high) / 2
                small = sum(2 * p * e * middle ** (2 * p + 3) for e, p in self.errors) < target
                low, high = np.where(small, middle, low), np.where(small, high, middle)
            return high

        low, high = -80.0, 20.0  # ln of the target
        for _ in range(60):
            middle = (low + high) / 2
            if np.sum(counted(math.exp(middle)) ** -3.0) > cells:
                low = middle
            else:
                high = middle
        return counted(math.exp(high))


def graded(points, tets, sizes):
    """Node sizes lowered until none grows faster along an edge than SIZE_GROWTH."""
    edges = np.unique(np.sort(tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1), axis=0)
    step = SIZE_GROWTH * np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    while True:
        before = sizes.copy()
        for a, b in ((0, 1), (1, 0)):
            np.minimum.at(sizes, edges[:, a], sizes[edges[:, b]] + step)
        if np.array_equal(before, sizes):
            return sizes


def read_size_field(path):
    """The SizeField of a run's fields.xdmf or errors.xdmf; its snapshots on the last mesh are added up."""
    import h5py

    def dataset(item, more=""):
        name, inside = item.text.strip().split(":")
        with h5py.File(os.path.join(os.path.dirname(path), name)) as file:
            return file[inside + more][()]

    try:
        grids = [g for g in xml.etree.ElementTree.parse(path).iter("Grid") if g.get("GridType") == "Uniform"]
        mesh = grids[-1].find("Topology/DataItem").text
        points = dataset(grids[-1].find("Geometry/DataItem"))
        tets = dataset(grids[-1].find("Topology/DataItem")).reshape(-1, 10)[:, :4]
        energies, lacks, whole = {}, [], 0
        for grid in grids:
            if grid.find("Topology/DataItem").text != mesh:
                continue
            for attribute in grid.iter("Attribute"):
                name, item = attribute.get("Name"), attribute.find("DataItem")
                if name.startswith(LACKS):
                    lacks.append(np.abs(dataset(item)))
                if name in INDICATORS:
                    energies[name] = energies.get(name, 0) + dataset(item)
                if name == "error_indicator_J":
                    whole = whole + dataset(item, "_whole")
    except (OSError, KeyError, IndexError, ValueError, AttributeError, xml.etree.ElementTree.ParseError) as error:
        raise MeshError(f"--size-field {path} is not the fields.xdmf or errors.xdmf of a run with its HDF5 files ({error}).") from error
    errors = [(energies[name] / total, INDICATORS[name])
              for name, total in zip(INDICATORS, np.atleast_1d(whole)) if name in energies and total > 0]
    errors += [(lack / lack.sum(), 1) for lack in lacks if lack.sum() > 0]
    if not errors:
        raise MeshError(f"--size-field {path} holds no errors: give the errors.xdmf of a run with -error_estimate, or "
                        "the fields.xdmf of one with -output_fields_error_indicator.")
    corners, tets = np.unique(tets, return_inverse=True)
    return SizeField(points[corners], tets.reshape(-1, 4), errors)
