"""tools/lung_mesh --refine: cells of any mesh of tetrahedra cut in two where they are too large, with all names and the shape kept."""
import math

import numpy as np
from scipy import spatial

from .foreign import mesh_of
from .formats import read_raw
from .geometry import boundary_facets, facet_areas, tet_volumes, triangle_edges
from .mesh import Mesh, MeshError, enough_memory
from .quality import MIN_SICN, dihedral_angles, sicn
from .size_field import read_size_field
from .sizes import SIZE_GROWTH

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
SAME = 1e-12            # share by which no volume and no area may change
ALIKE = 1e-2            # share by which the body of a size field may differ from the mesh
REGULAR = 6 * math.sqrt(2)  # cube of the edge of a regular tetrahedron over its volume
MISS = 0.05             # share by which a number of cells may be missed
STEP = 2 ** (1 / 3)     # what one cut changes the size of a cell by
FLATTER = 0.5           # share of the worst cell's SICN that cuts have to leave, where it is below MIN_SICN


def named_mesh(path):
    """The Mesh of a file with all its named triangles, also those within; refuses what would be lost. And its notes."""
    raw = read_raw([path])
    if raw.refused or raw.lost:
        raise MeshError(f"--refine {path} cannot keep all that is there: {'; '.join(raw.refused + raw.lost)}.")
    whole, named = mesh_of(raw), raw.groups != 0
    new = np.full(len(raw.points), -1)
    new[np.unique(raw.tets)] = np.arange(len(whole.points))
    return Mesh(whole.points, whole.tets, whole.regions, new[raw.triangles[named]], raw.groups[named], raw.names), raw.notes


def sizes(mesh):
    """Edge of the regular tetrahedron of a cell's volume."""
    return (REGULAR * tet_volumes(mesh.points, mesh.tets)) ** (1 / 3)


# ------------------------------------------------------------ cutting


def bisected(mesh, marked):
    """A Mesh whose marked cells (boolean) are cut through the middle of their longest edge, and each cell's parent.

    An edge is cut only where it is the longest of all cells around it; where it is not, those that have a longer one are cut there first
    (Rivara 1997: the path of longest edges). So the mesh conforms after each pass, and no cell gets flatter without end.
    """
    parent = np.arange(len(mesh.tets))
    waiting = marked.copy()
    while waiting.any():
        edges, number, longest = ranked_edges(mesh.points, mesh.tets)
        chosen = np.zeros(len(edges), dtype=bool)
        chosen[longest[waiting]] = True
        longer = chosen[number] & (number != longest[:, None])
        waiting |= longer.any(axis=1)
        chosen[number[longer]] = False
        if not chosen.any():
            continue
        mesh, of = cut(mesh, edges[chosen], chosen, longest)
        waiting = waiting[of] & ~chosen[longest][of]
        parent = parent[of]
    return mesh, parent


def ranked_edges(points, tets):
    """The edges in one order of length (k, 2), the six edges of each cell (m, 6), and the longest of them (m,)."""
    ends = np.sort(tets[:, EDGES], axis=2).reshape(-1, 2)
    keys, number = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
    edges = np.stack([keys // len(points), keys % len(points)], axis=1)
    length = np.sum((points[edges[:, 0]] - points[edges[:, 1]]) ** 2, axis=1)
    order = np.argsort(length, kind="stable")  # lengths that are equal: by their nodes
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order))
    number = rank[number].reshape(-1, 6)
    return edges[order], number, number.max(axis=1)


def cut(mesh, ends, chosen, longest):
    """The Mesh with some edges (k, 2) cut, and each cell's parent. chosen: of all edges; no cell has two of them. longest: each cell's."""
    middle = np.full(len(chosen), -1)
    middle[chosen] = len(mesh.points) + np.arange(len(ends))
    halved = chosen[longest]
    first, second = np.full((2, len(chosen)), -1)
    first[chosen], second[chosen] = ends.T
    edge = longest[halved]
    tets, more = halves(mesh.tets, halved, first[edge], second[edge], middle[edge])
    keys = ends[:, 0] * len(mesh.points) + ends[:, 1]
    order = np.argsort(keys)
    sides = triangle_edges(mesh.facets).reshape(-1, 3, 2)
    sides = sides[:, :, 0] * len(mesh.points) + sides[:, :, 1]
    place = np.minimum(np.searchsorted(keys, sides, sorter=order), len(keys) - 1)
    found = keys[order[place]] == sides
    hit = found.any(axis=1)
    edge = order[place[hit, found[hit].argmax(axis=1)]]
    facets, new = halves(mesh.facets, hit, *ends[edge].T, len(mesh.points) + edge)
    return Mesh(np.vstack([mesh.points, mesh.points[ends].mean(axis=1)]), np.vstack([tets, more]),
                np.concatenate([mesh.regions, mesh.regions[halved]]), np.vstack([facets, new]),
                np.concatenate([mesh.surfaces, mesh.surfaces[hit]]), mesh.names), np.concatenate([np.arange(len(tets)), np.flatnonzero(halved)])


def halves(cells, which, first, second, middle):
    """Cells of which some (boolean) are cut: all of them with the halves at `first`, and the halves at `second`."""
    cells, old = cells.copy(), cells[which]
    cells[which] = np.where(old == second[:, None], middle[:, None], old)
    return cells, np.where(old == first[:, None], middle[:, None], old)


# ------------------------------------------------------------ where


def until_small(mesh, wanted):
    """The Mesh cut until each cell has the size wanted(mesh), as near as halves come to it."""
    while True:
        ratio = sizes(mesh) / wanted(mesh)
        enough_memory(np.maximum(ratio ** 3, 1).sum())
        large = ratio > STEP ** 0.5
        if not large.any():
            return mesh
        mesh, _ = bisected(mesh, large)


def until_many(mesh, wanted, cells):
    """The Mesh cut where it is largest over the sizes wanted of its cells (m,) until it has about so many."""
    takes = 4.0  # new cells of one that is marked, with its neighbours
    while len(mesh.tets) < (1 - MISS) * cells:
        ratio = sizes(mesh) / wanted
        many = min(max(1, round((cells - len(mesh.tets)) / takes)), len(ratio))
        worst = np.argpartition(ratio, -many)[-many:]
        marked = np.zeros(len(ratio), dtype=bool)
        marked[worst[ratio[worst] >= ratio.max() / STEP]] = True
        finer, parent = bisected(mesh, marked)
        takes = max(1.0, (len(finer.tets) - len(mesh.tets)) / marked.sum())
        if len(finer.tets) <= (1 + MISS) * cells or many == 1:
            mesh, wanted = finer, wanted[parent]
    return mesh


def near(mesh, name, size):
    """What until_small() asks: so large near a named surface, more away from it as in other meshes of lung_mesh."""
    tags = [tag for (dimension, tag), other in mesh.names.items() if dimension == 2 and other == name]
    if not tags:
        there = ", ".join(other for (dimension, _), other in mesh.names.items() if dimension == 2) or "none"
        raise MeshError(f"--near {name} is no surface of the mesh; there are: {there}.")

    def wanted(now):
        own = now.facets[np.isin(now.surfaces, tags)]
        places = np.vstack([now.points[np.unique(own)], now.points[own].mean(axis=1)])
        distance, _ = spatial.cKDTree(places).query(now.points[now.tets].mean(axis=1))
        return size + SIZE_GROWTH * distance

    return wanted


def by_errors(mesh, path, cells):
    """The size wanted of each cell by the errors of a run, on this mesh or another of the same body, also in another unit."""
    field = read_size_field(path)
    volumes = tet_volumes(mesh.points, mesh.tets), np.abs(tet_volumes(field.points, field.tets))
    scale = (volumes[0].sum() / volumes[1].sum()) ** (1 / 3)
    boxes = [np.array([p.min(axis=0), p.max(axis=0)]) for p in (mesh.points, scale * field.points)]
    if np.abs(boxes[0] - boxes[1]).max() > ALIKE * np.ptp(boxes[0], axis=0).max():
        raise MeshError(f"--size-field {path} is of another body than the mesh: give the errors of a run on this mesh.")
    _, nearest = spatial.cKDTree(scale * field.points[field.tets].mean(axis=1)).query(mesh.points[mesh.tets].mean(axis=1))
    wanted = scale * (REGULAR * volumes[1]) ** (1 / 3) * field.ratios(cells, largest=1)
    return wanted[nearest]


# ------------------------------------------------------------ the command


def quality(mesh):
    """Least SICN and dihedral angle (degrees)."""
    return sicn(mesh.points, mesh.tets).min(), dihedral_angles(mesh.points, mesh.tets).min()


def contents(mesh):
    """{name of a surface or volume and its tag: area or volume}, and the whole volume and boundary."""
    areas, volumes = facet_areas(mesh.points, mesh.facets), tet_volumes(mesh.points, mesh.tets)
    boundary = facet_areas(mesh.points, boundary_facets(mesh.tets)).sum()
    return {"the whole volume": volumes.sum(), "the whole boundary": boundary} | {
        f"{name} ({'surface' if dimension == 2 else 'volume'} {tag})": (areas[mesh.surfaces == tag] if dimension == 2 else
                                                                        volumes[mesh.regions == tag]).sum()
        for (dimension, tag), name in mesh.names.items()}


def refined(path, size=None, cells=None, name=None, field=None):
    """The Mesh of a file cut as --size, --cells, --near and --size-field say, and notes; refuses one whose names or shape are not those of the file."""
    mesh, notes = named_mesh(path)
    if field or cells:
        cells = cells or 2 * len(mesh.tets)
        if cells <= len(mesh.tets):
            raise MeshError(f"--cells {cells} is no more than the {len(mesh.tets)} tetrahedra that {path} has: give more.")
        enough_memory(cells)
        fine = until_many(mesh, by_errors(mesh, field, cells) if field else np.ones(len(mesh.tets)), cells)
    else:
        fine = until_small(mesh, near(mesh, name, size) if name else lambda now: size)
    same(mesh, fine)
    for what, before, after in zip(("min SICN", "min dihedral angle"), quality(mesh), quality(fine)):
        print(f"{what:<22} {after:.3g}, before {before:.3g}")
    print(f"tetrahedra             {len(fine.tets)}, before {len(mesh.tets)}")
    return fine, notes


def same(mesh, fine):
    """Refuses a Mesh whose volumes or areas differ from those it had, or whose cells got flat."""
    before, after = contents(mesh), contents(fine)
    for name in before:
        if abs(after[name] - before[name]) > SAME * before[name]:
            raise MeshError(f"{name} changed by {after[name] / before[name] - 1:.2g} of itself, so no mesh was written: a cell may be as small as "
                            "the digits of its coordinates; move the mesh to the origin.")
    worst, least = quality(fine)[0], quality(mesh)[0]
    if worst < min(MIN_SICN, FLATTER * least):
        raise MeshError(f"cuts made the worst cell too flat (SICN {worst:.2g}, before {least:.2g}), so no mesh was written: make the coarse mesh anew.")
