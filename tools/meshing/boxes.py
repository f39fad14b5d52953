"""Meshes of cubes and other boxes whose faces have names."""
import gmsh
import numpy as np

from .geometry import boundary_facets, orient
from .gmsh_model import gmsh_elements, gmsh_nodes, gmsh_session
from .mesh import Mesh


def current_mesh():
    """Points and positively oriented tetrahedra of the current gmsh model."""
    points, row = gmsh_nodes()
    tets = gmsh_elements(3, row)
    used, tets = np.unique(tets, return_inverse=True)
    points, tets = points[used], tets.reshape(-1, 4)
    return points, orient(points, tets)


def tagged(points, tets, classify, surface_names, volume_name):
    """A one-volume mesh whose boundary triangles are named by their centres.

    classify: function from centres (b, 3) to an index into surface_names.
    """
    facets = boundary_facets(tets)
    surfaces = 1 + classify(points[facets].mean(axis=1))
    names = {(2, i + 1): name for i, name in enumerate(surface_names)}
    volume = len(surface_names) + 1
    names[3, volume] = volume_name
    return Mesh(points, tets, np.full(len(tets), volume), facets, surfaces, names)


def box(lengths, size):
    """Points and tetrahedra of the box [0, lengths] meshed by gmsh with one element size."""
    with gmsh_session():
        gmsh.model.occ.addBox(0, 0, 0, *lengths)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.optimize("")
        return current_mesh()


def box_face(lengths):
    """A classifier of facet centres of the box [0, lengths]: 0 to 5 for x0 x1 y0 y1 z0 z1."""
    def classify(centres):
        distance = np.stack([centres, np.asarray(lengths) - centres], axis=2).reshape(len(centres), 6)
        return np.argmin(distance, axis=1)
    return classify


def x1_or_rest(lengths):
    """A classifier of facet centres of the box [0, lengths]: 0 for the face x1, 1 for the others."""
    return lambda centres: (box_face(lengths)(centres) != 1).astype(int)


def irregular_cube():
    """The unit cube of 24 tetrahedra, its face centres moved so that no symmetry is left.

    Solutions on a symmetric mesh can converge faster than they should.
    """
    points, tets = box((1, 1, 1), 1)
    shift = 0.12 * np.sin(np.arange(1, 3 * len(points) + 1) * 12.9898).reshape(-1, 3)
    on_face = np.isclose(points, 0) | np.isclose(points, 1)
    return np.where(on_face, points, points + shift), tets


def refined(points, tets):
    """Each tetrahedron cut in eight through its edge middles, along the shortest inner diagonal."""
    pairs = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    edges, number = np.unique(np.sort(tets[:, pairs], axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    middle = len(points) + number.reshape(-1, 6)
    points = np.vstack([points, points[edges].mean(axis=1)])
    nodes = np.hstack([tets, middle])
    corners = nodes[:, [[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3]]].reshape(-1, 4)
    inner = []
    rings = {(4, 9): [5, 6, 8, 7], (5, 8): [4, 6, 9, 7], (6, 7): [4, 5, 9, 8]}
    lengths = np.stack([np.linalg.norm(points[nodes[:, a]] - points[nodes[:, b]], axis=1) for a, b in rings])
    shortest = np.argmin(lengths, axis=0)
    for choice, ((a, b), ring) in enumerate(rings.items()):
        quarters = [[a, b, ring[i], ring[(i + 1) % 4]] for i in range(4)]
        inner.append(nodes[shortest == choice][:, quarters].reshape(-1, 4))
    tets = np.vstack([corners, *inner])
    return points, orient(points, tets)
