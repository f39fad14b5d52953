"""Closed surfaces for the tests of the cavity, as STL files: a box, and ellipsoids of any fineness."""
import struct

import numpy as np

import pulmo_case as pulmo


def box(low, high):
    """The corners of its twelve triangles, counterclockwise from outside."""
    x = np.array(np.meshgrid(*zip(low, high), indexing="ij"), float).reshape(3, -1).T
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x[[t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]]


def ellipsoid(axes, refine=4):
    """An icosahedron, each triangle in four so many times, its nodes on the ellipsoid that has the volume of the true one."""
    g = (1 + np.sqrt(5)) / 2
    points = np.array([(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1),
                       (-g, 0, -1), (-g, 0, 1)])
    t = points[[(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2),
                (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]]
    for _ in range(refine):
        a, b, c = (t[:, i] for i in range(3))
        t = np.concatenate([np.stack(corners, axis=1) for corners in
                            ((a, a + b, a + c), (a + b, b, b + c), (a + c, b + c, c), (a + b, b + c, a + c))])
        t /= np.linalg.norm(t, axis=2, keepdims=True)
    t /= np.linalg.norm(t, axis=2, keepdims=True)
    t *= np.cbrt(4 * np.pi / 3 / volume(t))
    return np.round(t * axes, 9)


def volume(triangles):
    return np.linalg.det(triangles).sum() / 6


def save(triangles, binary=False, name="cavity.stl"):
    """Path of a new STL file."""
    path = pulmo.scratch(name)
    if binary:
        with open(path, "wb") as f:
            f.write(b"solid, but binary".ljust(80) + struct.pack("<I", len(triangles)))
            for t in triangles:
                f.write(np.concatenate([np.zeros(3), t.ravel()]).astype("<f4").tobytes() + b"\0\0")
        return path
    with open(path, "w") as f:
        f.write("solid cavity\n")
        for t in triangles:
            f.write("facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in t) + "endloop\nendfacet\n")
        f.write("endsolid cavity\n")
    return path


def distance_from(triangles, x):
    """From each of the points to the nearest of the triangles (by projections on faces, edges and corners)."""
    best = np.full(len(x), np.inf)
    for a, b, c in triangles:
        n = np.cross(b - a, c - a)
        n /= np.linalg.norm(n)
        height = (x - a) @ n
        foot = x - height[:, None] * n
        inside = np.all([np.cross(q - p, foot - p) @ n >= 0 for p, q in ((a, b), (b, c), (c, a))], axis=0)
        best = np.where(inside, np.minimum(best, np.abs(height)), best)
        for p, q in ((a, b), (b, c), (c, a)):
            s = np.clip((x - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            best = np.minimum(best, np.linalg.norm(x - p - s[:, None] * (q - p), axis=1))
    return best
