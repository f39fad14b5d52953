"""Meshes that the case tests and tools/hardcases make: MSH 2.2 files, boxes of cubes cut in six, two bodies on one airway."""
import itertools

import meshio
import numpy as np

import pulmo_case as pulmo

FACES = ["x0", "x1", "y0", "y1", "z0", "z1"]


def save(points, blocks, names, file="made.msh"):
    """Options that read a new MSH 2.2 file of (kind, cells, physical tags); names: name -> (tag, dimension)."""
    path = pulmo.scratch(file)
    tags = [np.asarray(t) for *_, t in blocks]
    meshio.write(path, meshio.Mesh(points, [(kind, cells) for kind, cells, _ in blocks], cell_data={
        "gmsh:physical": tags, "gmsh:geometrical": tags}, field_data={n: np.array(v) for n, v in names.items()}), "gmsh22", binary=False)
    return ["-dm_plex_filename", path]


def blocks_of(name):
    """Points, (kind, cells, physical tags) of each block, and names of one of the project's meshes."""
    mesh = meshio.read(pulmo.mesh(name))
    return mesh.points, [(c.type, c.data, t) for c, t in zip(mesh.cells, mesh.cell_data["gmsh:physical"])], mesh.field_data


def scaled(name, factor):
    """One of the project's meshes with all lengths times a factor."""
    points, blocks, names = blocks_of(name)
    return save(points * factor, blocks, names, "scaled.msh")


def write(points, tets, facets, facet_names, volume="lung"):
    """Options that read a new mesh; facet_names: one for each facet."""
    kinds = list(dict.fromkeys(facet_names))
    number = 1 + len(kinds)
    return save(points, [("triangle", facets, [1 + kinds.index(n) for n in facet_names]), ("tetra", tets, np.full(len(tets), number))],
                {n: (i + 1, 2) for i, n in enumerate(kinds)} | {volume: (number, 3)})


def kuhn(counts, lengths):
    """Points and right-handed tetrahedra of a box cut into cubes and these into six (Kuhn 1960)."""
    shape = [n + 1 for n in counts]
    points = np.stack(np.meshgrid(*(np.linspace(0, l, n) for l, n in zip(lengths, shape)), indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(np.prod(shape)).reshape(shape)
    tets = []
    for order in itertools.permutations(range(3)):
        corner, path = np.zeros(3, int), [np.zeros(3, int)]
        for axis in order:
            corner = corner + np.eye(3, dtype=int)[axis]
            path.append(corner)
        tets.append(np.stack([node[tuple(slice(c, c + n) for c, n in zip(corner, counts))].ravel() for corner in path], axis=1))
    tets = np.concatenate(tets)
    turned = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0
    tets[turned, :2] = tets[turned, 1::-1]
    return points, tets


def boundary(tets):
    """Facets of one tetrahedron alone."""
    faces = np.sort(tets[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    return faces[count == 1]


def faces_of_box(points, facets, lengths):
    """Name of the face of a box, x0 to z1, that each facet is on."""
    middle = points[facets].mean(axis=1)
    distance = np.stack([middle, np.array(lengths) - middle], axis=2).reshape(len(facets), 6)
    return [FACES[i] for i in distance.argmin(axis=1)]


def bodies(*names):
    """Cubes made of meshes/cube_lung.msh: `stiff` of 50 mm, `soft` of 40 mm beside it; each has its airway at the face of
    largest x and gives its name to the other faces."""
    cube, blocks, numbers = blocks_of("cube_lung.msh")
    tags = {"airway": 1, "stiff": 2, "soft": 3, "lung": 4}
    points, copies = [], []
    for name in names:
        mine = {numbers["airway"][0]: tags["airway"], numbers["pleura"][0]: tags[name], numbers["lung"][0]: tags["lung"]}
        copies += [(kind, cells + sum(map(len, points)), [mine[t] for t in physical]) for kind, cells, physical in blocks]
        points.append(cube * (5 if name == "stiff" else 4) + ([0, 0, 0] if name == "stiff" else [100, 0, 0]))
    return save(np.concatenate(points), copies, {name: (tags[name], 3 if name == "lung" else 2) for name in ("airway", "lung") + names})


def coarse_cube_lung():
    """Path of meshes/cube_lung.msh in six tetrahedra: another mesh for error bars, where only the steps are looked at."""
    points, cells = kuhn((1, 1, 1), (10, 10, 10))
    facets = boundary(cells)
    return write(points, cells, facets, ["airway" if face == "x1" else "pleura" for face in faces_of_box(points, facets, (10, 10, 10))])[1]
