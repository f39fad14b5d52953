"""Structured meshes of a hollow sphere or of one octant of it."""
import itertools
import os

import meshio
import numpy as np

from shared.common import written_whole

from .geometry import FACES, orient
from .mesh import MeshError

SIDES = ["airway", "pleura", "x0", "y0", "z0"]
BYTES = 1500     # of memory that a tetrahedron takes on the way
FLATTEST = 1e-4  # volume / (longest edge)^3 below which a cell is as good as none
RADII = (1e-3, 1e6)  # mm; coordinates are told apart by 1e-8 mm


def octant_directions(divisions):
    """Unit vectors (n, 3) with no negative component, and triangles between them."""
    grid = [(i, j) for i in range(divisions + 1) for j in range(divisions + 1 - i)]
    number = {place: k for k, place in enumerate(grid)}
    directions = np.array([np.sin(np.pi / 2 * np.array([i, j, divisions - i - j]) / divisions) for i, j in grid])
    triangles = []
    for i, j in grid:
        if i + j < divisions:
            triangles.append([number[i, j], number[i + 1, j], number[i, j + 1]])
        if i + j < divisions - 1:
            triangles.append([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]])
    return directions / np.linalg.norm(directions, axis=1)[:, None], np.array(triangles)


def mirrored(directions, triangles):
    """The whole sphere from one octant."""
    signs = list(itertools.product((1, -1), repeat=3))
    everywhere = np.vstack([directions * s for s in signs])
    _, first, number = np.unique(np.round(everywhere, 9) + 0.0, axis=0, return_index=True, return_inverse=True)
    copies = np.vstack([triangles + k * len(directions) for k in range(len(signs))])
    return everywhere[first], number.reshape(-1)[copies]


def shell(divisions, layers, inner, outer, octant=False):
    """Points (mm), positively oriented tetrahedra and the layers' radii of vertices (mm)."""
    directions, triangles = octant_directions(divisions)
    if not octant:
        directions, triangles = mirrored(directions, triangles)
    a, b, c = directions[triangles].transpose(1, 0, 2)
    enclosed = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))).sum() / 6
    larger = (4 / 3 * np.pi / (8 if octant else 1) / enclosed) ** (1 / 3)
    # pressure falls as 1/R: steps that even out the error of linear elements in its energy, R^2 (1/R)''^2 h^3
    radii = larger * np.linspace(inner ** (-1 / 3), outer ** (-1 / 3), layers + 1) ** -3
    points = (radii[:, None, None] * directions).reshape(-1, 3)
    # prisms cut by the order of their nodes, so that neighbours agree on the diagonals
    a, b, c = np.sort(triangles, axis=1).T
    n = len(directions)
    below = [np.stack([a, b, c, c + n]), np.stack([a, b, b + n, c + n]), np.stack([a, a + n, b + n, c + n])]
    tets = np.concatenate([np.concatenate(below, axis=1).T + k * n for k in range(layers)])
    return points, orient(points, tets), radii


def surfaces(points, tets, radii):
    """Boundary triangles and for each the number of its name in SIDES."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    faces = faces[count == 1]
    distance = np.linalg.norm(points, axis=1)
    on = np.column_stack([np.isclose(distance, radii[0]), np.isclose(distance, radii[-1]), np.isclose(points, 0)])
    on_side = on[faces].all(axis=1)
    assert (on_side.sum(axis=1) == 1).all(), "every boundary triangle has one name"
    return faces, on_side.argmax(axis=1)


def check(divisions, layers, inner, outer, octant):
    """Refuses what no mesh can be made of, before anything is made."""
    if divisions < 1 or layers < 1:
        raise MeshError(f"--divisions {divisions} and --layers {layers} must be at least 1")
    if not RADII[0] <= inner < outer <= RADII[1]:
        raise MeshError(f"--inner {inner:g} and --outer {outer:g} mm: it takes {RADII[0]:g} <= inner < outer <= {RADII[1]:g} mm")
    tets = 3 * divisions ** 2 * layers * (1 if octant else 8)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if tets * BYTES > memory:
        raise MeshError(f"--divisions {divisions} and --layers {layers} make {tets:.3g} tetrahedra, which take about "
                              f"{tets * BYTES / 1e9:.3g} GB; this machine has {memory / 1e9:.3g} GB: take fewer")


def check_shape(points, tets):
    """Refuses cells that are as good as flat."""
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    longest = np.max([np.linalg.norm(points[tets[:, i]] - points[tets[:, j]], axis=1) for i in range(4) for j in range(i)], axis=0)
    if not (np.linalg.det(edges) / 6 > FLATTEST * longest ** 3).all():
        raise MeshError("the cells would be as good as flat: take layers and divisions that make them about as thick as wide, or "
                              "radii that differ more")


def write(path, divisions, layers, inner=7.5, outer=72.5, octant=False):
    """Write the mesh; returns its number of tetrahedra."""
    check(divisions, layers, inner, outer, octant)
    points, tets, radii = shell(divisions, layers, inner, outer, octant)
    check_shape(points, tets)
    faces, side = surfaces(points, tets, radii)
    names = {name: np.array([i + 1, 2]) for i, name in enumerate(SIDES) if (side == i).any()}
    names["lung"] = np.array([len(SIDES) + 1, 3])
    tags = [side + 1, np.full(len(tets), len(SIDES) + 1)]
    with written_whole(path) as part:
        meshio.write(part, meshio.Mesh(points, [("triangle", faces), ("tetra", tets)], field_data=names,
                                       cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags}), "gmsh22", binary=False)
    return len(tets)
