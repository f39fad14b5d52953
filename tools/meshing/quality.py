"""Quality of tetrahedra: signed inverse condition number, dihedral angles, and what passes."""
import numpy as np

from .geometry import FACES

MIN_SICN = 0.15         # worst cell that passes
MIN_DIHEDRAL = 7.0      # degrees


def sicn(points, tets):
    """Signed inverse condition number of each tetrahedron, 1 for a regular one (gmsh's SICN)."""
    return sicn_of_corners(points[tets])


def sicn_of_corners(corners):
    """The same for tetrahedra given by their corners (m, 4, 3)."""
    regular = np.array([[1, 0, 0], [0.5, np.sqrt(3) / 2, 0], [0.5, np.sqrt(3) / 6, np.sqrt(2 / 3)]])
    maps = np.linalg.inv(regular) @ (corners[:, 1:] - corners[:, :1])
    a, b, c = np.moveaxis(maps, 1, 0)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    det = np.sum(a * cofactors[:, 0], axis=1)
    return 3 * det / np.sqrt(np.sum(maps**2, axis=(1, 2)) * np.sum(cofactors**2, axis=(1, 2)))


def dihedral_angles(points, tets):
    """The six dihedral angles of each tetrahedron, degrees."""
    corners = points[tets[:, FACES]]
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    i, j = np.triu_indices(4, 1)
    return np.degrees(np.arccos(np.clip(-np.sum(normals[:, i] * normals[:, j], axis=2), -1, 1)))
