"""Meshes that are hard on purpose: stretched boxes, slivers, cells with all nodes on the boundary."""
import itertools

import meshio
import numpy as np

from .lab import pulmo

FACES = ["x0", "x1", "y0", "y1", "z0", "z1"]


def write(points, tets, facets, facet_names, volume="lung"):
    """Options that read a new MSH 2.2 file; facet_names: one for each facet."""
    kinds = list(dict.fromkeys(facet_names))
    tags = np.array([1 + kinds.index(n) for n in facet_names])
    number = 1 + len(kinds)
    physical = [tags, np.full(len(tets), number)]
    names = {n: np.array([i + 1, 2]) for i, n in enumerate(kinds)} | {volume: np.array([number, 3])}
    path = pulmo.scratch("made.msh")
    meshio.Mesh(points, [("triangle", facets), ("tetra", tets)], field_data=names,
                cell_data={"gmsh:physical": physical, "gmsh:geometrical": physical}).write(path, file_format="gmsh22",
                                                                                         binary=False)
    return ["-dm_plex_filename", path]


def kuhn(counts, lengths):
    """Points and tetrahedra of a box cut into cubes and these into six (Kuhn 1960)."""
    shape = [n + 1 for n in counts]
    points = np.stack(np.meshgrid(*(np.linspace(0, l, n) for l, n in zip(lengths, shape)), indexing="ij"), axis=-1)
    node = np.arange(np.prod(shape)).reshape(shape)
    tets = []
    for order in itertools.permutations(range(3)):
        corner, path = np.zeros(3, int), [np.zeros(3, int)]
        for axis in order:
            corner = corner + np.eye(3, dtype=int)[axis]
            path.append(corner)
        tets.append(np.stack([node[tuple(slice(c, c + n) for c, n in zip(corner, counts))].ravel() for corner in path], axis=1))
    return points.reshape(-1, 3), np.concatenate(tets)


def oriented(points, tets):
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    turned = np.linalg.det(edges) < 0
    tets = tets.copy()
    tets[turned, :2] = tets[turned, 1::-1]
    return tets


def boundary(tets):
    faces = np.sort(tets[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    return faces[count == 1]


def quality(points, tets):
    """Least of 3 inscribed over circumscribed radius: 1 regular, 0 flat."""
    corner = points[tets]
    e = [corner[:, j] - corner[:, i] for i, j in itertools.combinations(range(4), 2)]
    volume = np.abs(np.einsum("ij,ij->i", e[0], np.cross(e[1], e[2]))) / 6
    faces = sum(np.linalg.norm(np.cross(e[a], e[b]), axis=1) / 2 for a, b in [(0, 1), (0, 2), (1, 2), (3, 4)])
    products = [np.linalg.norm(e[a], axis=1) * np.linalg.norm(e[b], axis=1) for a, b in [(0, 5), (1, 4), (2, 3)]]
    half = sum(products) / 2
    area = np.sqrt(np.maximum(half * (half - products[0]) * (half - products[1]) * (half - products[2]), 0))
    return (3 * (3 * volume / faces) / (area / (6 * volume))).min()


def box(counts, lengths, flatten=0.0, seed=1):
    """Points and tetrahedra of a box; `flatten`: inner nodes move towards a neighbour until cells are nearly flat."""
    points, tets = kuhn(counts, lengths)
    tets = oriented(points, tets)
    if flatten:
        inner = np.setdiff1d(np.arange(len(points)), boundary(tets))
        random = np.random.default_rng(seed)
        for node in inner:  # as far as the flattest of its cells allows
            here = tets[(tets == node).any(axis=1)]
            direction = random.normal(size=3) * np.array(lengths) / np.array(counts)
            old = points[node].copy()
            start = np.linalg.det(points[here[:, 1:]] - points[here[:, :1]])
            low, high = 0.0, 4.0
            for _ in range(40):
                middle = (low + high) / 2
                points[node] = old + middle * direction
                now = np.linalg.det(points[here[:, 1:]] - points[here[:, :1]])
                low, high = (middle, high) if (now > (1 - flatten) * start).all() else (low, middle)
            points[node] = old + low * direction
    return points, tets


def faces_of_box(points, facets, lengths):
    middle = points[facets].mean(axis=1)
    distance = np.stack([middle, np.array(lengths) - middle], axis=2).reshape(len(facets), 6)
    return [FACES[i] for i in distance.argmin(axis=1)]


def box_options(counts, lengths, **arguments):
    """A box on disk with surfaces x0 ... z1."""
    points, tets = box(counts, lengths, **arguments)
    facets = boundary(tets)
    return write(points, tets, facets, faces_of_box(points, facets, lengths))


def scaled(name, factor):
    """A mesh of the project with all lengths times a factor."""
    mesh = meshio.read(pulmo.mesh(name))
    path = pulmo.scratch("scaled.msh")
    physical = mesh.cell_data["gmsh:physical"]
    meshio.Mesh(mesh.points * factor, mesh.cells, field_data=mesh.field_data,
                cell_data={"gmsh:physical": physical, "gmsh:geometrical": physical}).write(path, file_format="gmsh22",
                                                                                         binary=False, float_fmt=".17g")
    return ["-dm_plex_filename", path]
