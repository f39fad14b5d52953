"""Errors of the fields: displacement and pressure, as the ten-node cells of the files have them, of one run against those of another, on any two meshes of one body.

The integrals are over the reference's mesh, by a rule of Gauss and Jacobi in each tetrahedron that is exact for the square
of two P2 fields on one mesh. The coarse cell of a point is found among those with the nearest centroids, by its
barycentric coordinates; a point outside of the coarse mesh (meshes of a curved body differ there) takes the cell
that it is least outside of, extrapolated, and the share of such points is told.
"""
import re
from dataclasses import dataclass

import h5py
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import roots_jacobi

from shared.common import KPA_PER_CMH2O

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # of the nodes 4 to 9, the order of VTK
INSIDE = -1e-9   # barycentric coordinates from here on are inside
CHUNK = 200_000  # points that are worked on at a time
NEAREST = (8, 64)  # centroids that are looked at, and for the points that are in none of these
GAS = "alveolar_pressure_cmH2O"
SAME = 1e-4        # s: snapshots that are further apart are of different times; fields.xdmf has six digits


@dataclass(frozen=True)
class Fields:
    """points (n, 3) mm; cells (m, 10); u (n, 3) mm; p (n,) kPa or None without airflow."""
    points: np.ndarray
    cells: np.ndarray
    u: np.ndarray
    p: np.ndarray | None


def snapshots(folder):
    """(time s, file, mesh file) of each snapshot of a run."""
    text = (folder / "fields.xdmf").read_text()
    grids = re.findall(r'<Time Value="([^"]+)"/>.*?(fields\w*\.h5):/topology.*?(fields_\d+\.h5):/displacement', text, re.S)
    return [(float(t), folder / values, folder / mesh) for t, mesh, values in grids]


def read(folder, time):
    """The snapshot of a run at a time; None if it left none there."""
    at, values, mesh = min(snapshots(folder), key=lambda s: abs(s[0] - time))
    if abs(at - time) > SAME:
        return None
    with h5py.File(mesh) as file:
        points, cells = file["geometry"][:], file["topology"][:].reshape(-1, 10)
    with h5py.File(values) as file:
        return Fields(points, cells, file["displacement_mm"][:].reshape(-1, 3),
                      file[GAS][:].ravel() * KPA_PER_CMH2O if GAS in file else None)


def rule(n=3):
    """Barycentric points (n^3, 4) and weights (sum 1) on a tetrahedron, exact for degree 2 n - 1 (Stroud 1971)."""
    (a, wa), (b, wb), (c, wc) = (roots_jacobi(n, k, 0) for k in (2, 1, 0))
    x, y, z = ((1 + t) / 2 for t in (a, b, c))
    X, Y, Z = np.meshgrid(x, y, z, indexing="ij")
    bary = np.stack([X, Y * (1 - X), Z * (1 - X) * (1 - Y)], axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", wa, wb, wc).ravel()
    return np.column_stack([1 - bary.sum(axis=1), bary]), weights / weights.sum()


def gradients(corners):
    """Gradients (m, 4, 3) of the barycentric coordinates of tetrahedra with corners (m, 4, 3), and their volumes."""
    edges = corners[:, 1:] - corners[:, :1]
    inverse = np.linalg.inv(edges).transpose(0, 2, 1)
    return np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1), np.abs(np.linalg.det(edges)) / 6


def quadratic(bary):
    """P2 shape functions (k, 10) at barycentric points (k, 4)."""
    return np.concatenate([bary * (2 * bary - 1), np.stack([4 * bary[:, i] * bary[:, j] for i, j in EDGES], axis=1)], axis=1)


def quadratic_slopes(bary):
    """Their derivatives by the barycentric coordinates, (k, 10, 4)."""
    slopes = np.zeros((len(bary), 10, 4))
    for i in range(4):
        slopes[:, i, i] = 4 * bary[:, i] - 1
    for n, (i, j) in enumerate(EDGES, 4):
        slopes[:, n, i], slopes[:, n, j] = 4 * bary[:, j], 4 * bary[:, i]
    return slopes


class Locator:
    """Cells of a mesh and barycentric coordinates there of points."""

    def __init__(self, points, cells):
        self.corners = points[cells[:, :4]]
        self.slopes, _ = gradients(self.corners)
        self.tree = cKDTree(self.corners.mean(axis=1))

    def barycentric(self, cells, x):
        last = np.einsum("kid,kd->ki", self.slopes[cells, 1:], x - self.corners[cells, 0])
        return np.column_stack([1 - last.sum(axis=1), last])

    def __call__(self, x):
        """(cell, barycentric coordinates, found inside) of points (k, 3)."""
        cell, bary = np.zeros(len(x), int), np.full((len(x), 4), -np.inf)
        rest = np.arange(len(x))
        for count in NEAREST:
            count = min(count, len(self.corners))
            near = self.tree.query(x[rest], k=count)[1].reshape(len(rest), count)
            for column in near.T:
                here = self.barycentric(column, x[rest])
                better = here.min(axis=1) > bary[rest].min(axis=1)
                cell[rest[better]], bary[rest[better]] = column[better], here[better]
            rest = rest[bary[rest].min(axis=1) < INSIDE]
            if not len(rest):
                break
        return cell, bary, bary.min(axis=1) >= INSIDE


class Comparison:
    """Errors of fields against a reference; the places on another mesh are found once."""

    def __init__(self, reference):
        self.reference = reference
        self.bary, weights = rule()
        corners = reference.points[reference.cells[:, :4]]
        slopes, volumes = gradients(corners)
        self.x = np.einsum("qi,mid->mqd", self.bary, corners).reshape(-1, 3)
        self.weights = (volumes[:, None] * weights).ravel()
        m, q = len(corners), len(self.bary)
        cells = np.repeat(np.arange(m), q)
        self.own = (cells, np.tile(self.bary, (m, 1)), slopes)
        self.values = self.evaluate(reference, *self.own)
        self.places = {}

    @staticmethod
    def evaluate(fields, cells, bary, slopes):
        """u (k, 3), Grad u (k, 3, 3) and p (k,) at barycentric points of cells; slopes: of the barycentric coordinates by cell."""
        values, slope = np.empty((len(cells), 3)), np.empty((len(cells), 3, 3))
        p = None if fields.p is None else np.einsum("ki,ki->k", bary, fields.p[fields.cells[cells, :4]])
        for begin in range(0, len(cells), CHUNK):
            part = slice(begin, begin + CHUNK)
            u = fields.u[fields.cells[cells[part]]]
            values[part] = np.einsum("kn,knc->kc", quadratic(bary[part]), u)
            by_bary = np.einsum("kni,knc->kci", quadratic_slopes(bary[part]), u)
            slope[part] = np.einsum("kci,kid->kcd", by_bary, slopes[cells[part]])
        return values, slope, p

    def norm(self, values):
        return float(np.sqrt(self.weights @ (values.reshape(len(values), -1) ** 2).sum(axis=1)))

    def place(self, fields):
        key = (len(fields.points), len(fields.cells), fields.points.tobytes()[:4096], fields.cells.tobytes()[:4096])
        if key not in self.places:
            locator = Locator(fields.points, fields.cells)
            cells, bary, inside = locator(self.x)
            self.places[key] = (cells, bary, locator.slopes, float(self.weights @ ~inside / self.weights.sum()))
        return self.places[key]

    def __call__(self, fields):
        """Relative errors by name: u L2, u H1 (seminorm), p L2; and the share of the volume outside of the mesh."""
        *place, outside = self.place(fields)
        found = dict(zip(("u L2", "u H1", "p L2"), (
            None if mine is None else self.norm(mine - exact) / self.norm(exact)
            for mine, exact in zip(self.evaluate(fields, *place), self.values))))
        return found | {"outside": outside}
