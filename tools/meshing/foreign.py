"""Meshes that other programs wrote: read with their names, checked in the words of lung_mesh, converted to MSH."""
from dataclasses import dataclass, field

import gmsh
import numpy as np

from .geometry import FACES, boundary_facets, orient, tet_volumes
from .gmsh_model import gmsh_nodes, gmsh_session
from .mesh import Mesh, MeshError

PLAUSIBLE = (100, 15_000)  # ml of human lungs, outside which the unit of length may be another
TETS = {4: 4, 11: 10, 29: 20}  # gmsh's types of tetrahedra: nodes
TRIANGLES = {2: 3, 9: 6, 21: 10}


@dataclass
class Raw:
    """What a file holds: points, tetrahedra and triangles with the group of each (0: none), {(dimension, group): name}.

    notes: what else there is to tell. refused: what pulmo would refuse of the file, though not of the Mesh made of it. lost: what
    neither has room for.
    """

    points: np.ndarray
    tets: np.ndarray
    regions: np.ndarray
    triangles: np.ndarray
    groups: np.ndarray
    names: dict
    notes: list = field(default_factory=list)
    refused: list = field(default_factory=list)
    lost: list = field(default_factory=list)


def read_msh(path):
    """The Raw of an MSH file of any version that gmsh reads."""
    with gmsh_session():
        try:
            gmsh.merge(path)
            points, row = gmsh_nodes()
        except Exception as error:  # gmsh raises bare Exceptions
            raise MeshError(f"{path} is no mesh that gmsh reads ({error}).") from error
        names, notes, refused, lost, parts = {}, [], [], [], {2: [], 3: []}
        for dimension, tag in gmsh.model.getPhysicalGroups():
            names[dimension, tag] = gmsh.model.getPhysicalName(dimension, tag) or str(tag)
        for dimension, kinds in ((2, TRIANGLES), (3, TETS)):
            for _, entity in gmsh.model.getEntities(dimension):
                group = gmsh.model.getPhysicalGroupsForEntity(dimension, entity)
                if len(group) > 1:
                    said = f"are in {len(group)} groups (" + ", ".join(names[dimension, g] for g in group) + "), here counted with the first"
                    if dimension == 3:
                        notes.append(f"some cells {said}.")
                        lost.append(f"some cells {said}")
                    else:
                        refused.append(f"some faces {said}; pulmo needs -mesh_prefer")
                for kind, _, nodes in zip(*gmsh.model.mesh.getElements(dimension, entity)):
                    if kind not in kinds:
                        notes.append(f"elements that are no {'tetrahedra' if dimension == 3 else 'triangles'} are there (gmsh's type {kind}): "
                                     "left out.")
                        lost.append(f"it has elements of gmsh's type {kind}, which are left out")
                        continue
                    if kinds[kind] != dimension + 1:
                        refused.append("elements are of higher order, here counted with their corners only; gmsh -order 1 saves straight ones")
                    cells = row[nodes.astype(int)].reshape(-1, kinds[kind])[:, :dimension + 1]
                    parts[dimension].append((cells, np.full(len(cells), group[0] if len(group) else 0)))
    raw = joined(points, parts, names, list(dict.fromkeys(notes)))
    raw.refused, raw.lost = list(dict.fromkeys(refused)), list(dict.fromkeys(lost))
    raw.notes += [f"{name} names {'curves' if dimension == 1 else 'points'}: left out." for (dimension, _), name in names.items() if dimension < 2]
    return raw


def joined(points, parts, names, notes):
    """A Raw of pieces: {dimension: [(cells, groups)]}."""
    whole = {d: (np.concatenate([cells for cells, _ in parts[d]] or [np.zeros((0, d + 1), int)]).astype(int),
                 np.concatenate([groups for _, groups in parts[d]] or [np.zeros(0, int)]).astype(int)) for d in parts}
    return Raw(points, *whole[3], *whole[2], {key: name for key, name in names.items() if key[0] in (2, 3)}, notes)


def mesh_of(raw):
    """The Mesh of a Raw, with notes about what had to be changed or looks wrong added to it."""
    volumes = tet_volumes(raw.points, raw.tets)
    if (volumes == 0).any():
        raise MeshError(f"{np.sum(volumes == 0)} of {len(volumes)} tetrahedra have no volume.")
    if (volumes < 0).any():
        raw.notes.append(f"{np.sum(volumes < 0)} of {len(volumes)} tetrahedra are left-handed; turned (pulmo turns them, too).")
    used, tets = np.unique(raw.tets, return_inverse=True)
    points, tets = raw.points[used], orient(raw.points[used], tets.reshape(-1, 4))
    if len(used) < len(raw.points) and not raw.refused:
        raw.notes.append(f"{len(raw.points) - len(used)} nodes belong to no tetrahedron; left out.")
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    _, count = np.unique(faces, axis=0, return_counts=True)
    if (count > 2).any():
        raise MeshError(f"{np.sum(count > 2)} faces belong to more than two tetrahedra, so cells lie in one another.")
    facets = boundary_facets(tets)
    new = np.full(len(raw.points), -1)
    new[used] = np.arange(len(used))
    surfaces, inner, strange = named_facets(facets, faces, new[raw.triangles], raw.groups)
    for name, number in inner.items():
        raw.notes.append(f"{number} faces of {raw.names.get((2, name), name)} lie within the volume; pulmo lets no effect use such a name.")
    if strange:
        raw.refused.append(f"{strange} triangles are no faces of cells")
    names = {key: name for key, name in raw.names.items()
             if (key[1] == surfaces).any() and key[0] == 2 or (key[1] == raw.regions).any() and key[0] == 3}
    apart = torn(points, facets)
    if apart:
        raw.notes.append(f"{apart} nodes of the boundary lie where another one does: parts that touch there are not joined (a tear).")
    mesh = Mesh(points, tets, raw.regions, facets, surfaces, names)
    total = np.abs(volumes).sum() / 1e3
    if not PLAUSIBLE[0] <= total <= PLAUSIBLE[1]:
        guess = next((f"; if the file is in {unit}, give pulmo -mesh_scale {scale:g}" for unit, scale in (("m", 1e3), ("cm", 10), ("um", 1e-3))
                      if 300 <= total * scale**3 <= 10_000), "")
        raw.notes.append(f"{total:.3g} ml if the file is in mm, which is no adult's lung{guess}.")
    return mesh


def named_facets(facets, faces, triangles, groups):
    """The group of each boundary facet (0: none), {group: number of inner faces}, number of triangles that are no face."""
    both = np.concatenate([np.sort(facets, axis=1), faces, np.sort(triangles, axis=1)])
    _, number = np.unique(both, axis=0, return_inverse=True)
    outer, own = number[:len(facets)], number[len(facets) + len(faces):]
    all_faces = number[len(facets):len(facets) + len(faces)]
    group_of = np.zeros(number.max() + 1, dtype=int)
    group_of[own] = groups
    named = groups != 0
    strange = int(np.sum(~np.isin(own, all_faces)))
    within = named & np.isin(own, all_faces) & ~np.isin(own, outer)
    values, counts = np.unique(groups[within], return_counts=True)
    return group_of[outer], dict(zip(values.tolist(), counts.tolist())), strange


def torn(points, facets):
    """Number of boundary nodes that have another at the same place."""
    nodes = np.unique(facets)
    extent = np.ptp(points, axis=0).max()
    _, count = np.unique(np.round(points[nodes] / (1e-6 * extent)), axis=0, return_counts=True)
    return int(count[count > 1].sum())
