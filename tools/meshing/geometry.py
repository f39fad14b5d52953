"""Tetrahedra and triangles as arrays of nodes: boundary, orientation, volumes, areas."""
import numpy as np

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # outward, of a positive tetrahedron


def boundary_facets(tets):
    """Faces that belong to one tetrahedron only, as triangles seen from outside."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def orient(points, tets):
    """The tetrahedra with two nodes swapped where the volume would be negative."""
    tets = tets.copy()
    negative = tet_volumes(points, tets) < 0
    tets[negative, :2] = tets[negative, 1::-1]
    return tets


def tet_volumes(points, tets):
    """Signed volumes of the tetrahedra, in the cube of the unit of the points."""
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    return np.linalg.det(edges) / 6


def facet_areas(points, facets):
    """Areas of triangles, in the square of the unit of the points."""
    a, b, c = (points[facets[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def triangle_edges(facets):
    """The three edges of each triangle, (3 b, 2), smaller node first."""
    return np.sort(facets[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)


def enclosed_volume(points, triangles):
    """Volume inside a closed surface whose triangles are seen from outside, cubed unit of the points."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return np.sum(a * np.cross(b, c)) / 6
