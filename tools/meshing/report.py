"""Numbers about a mesh, and whether it passes."""
from dataclasses import dataclass

import numpy as np

from .geometry import FACES, facet_areas, tet_volumes, triangle_edges
from .lobes import pieces
from .quality import MIN_DIHEDRAL, MIN_SICN, dihedral_angles, sicn
from .surfaces import patches


def measures(mesh):
    """Numbers about a Mesh in mm: sizes, volume (ml), areas (cm2) and quality, as a dictionary."""
    areas = facet_areas(mesh.points, mesh.facets) / 100
    volume = tet_volumes(mesh.points, mesh.tets).sum() / 1e3
    on_boundary = np.zeros(len(mesh.points), dtype=bool)
    on_boundary[mesh.facets] = True
    return {
        "tets": len(mesh.tets),
        "nodes": len(mesh.points),
        "volume": volume,
        "areas": {name: areas[mesh.surfaces == tag].sum() for (d, tag), name in mesh.names.items() if d == 2},
        "shape": areas.sum() / volume ** (2 / 3),
        "min_sicn": sicn(mesh.points, mesh.tets).min(),
        "min_dihedral": dihedral_angles(mesh.points, mesh.tets).min(),
        "boundary_share": on_boundary[mesh.tets].all(axis=1).mean(),
    }


@dataclass
class Body:
    """Cells of a Mesh that hang together: name by their volumes, cells and facets (boolean), volume (ml), areas (cm2), topology."""

    name: str
    cells: np.ndarray
    facets: np.ndarray
    volume: float
    areas: dict
    closed: bool
    genus: float
    pieces: int
    airway_patches: int


def bodies(mesh):
    """The Bodies of a Mesh, the one with the lowest volume tag first."""
    piece = pieces(mesh.tets)
    owner = piece[cells_of(mesh.tets, mesh.facets)]
    first = sorted(range(piece.max() + 1), key=lambda k: (mesh.regions[piece == k].min(), k))
    return [body(mesh, piece == k, owner == k) for k in first]


def cells_of(tets, facets):
    """The tetrahedron that each boundary triangle belongs to."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    both, number = np.unique(np.concatenate([faces, np.sort(facets, axis=1)]), axis=0, return_inverse=True)
    cell = np.full(len(both), -1)
    cell[number[:len(faces)]] = np.arange(len(faces)) // 4
    return cell[number[len(faces):]]


def body(mesh, cells, mine):
    """The Body of some cells and their facets (boolean)."""
    facets, tags = mesh.facets[mine], mesh.surfaces[mine]
    areas = facet_areas(mesh.points, facets) / 100
    edges, count = np.unique(triangle_edges(facets), axis=0, return_counts=True)
    patch_count, _ = patches(facets)
    by_name = {name: tags == tag for (dimension, tag), name in mesh.names.items() if dimension == 2}
    airway = facets[by_name.get("airway", np.zeros(len(facets), dtype=bool))]
    return Body(
        body_name(mesh, cells), cells, mine, tet_volumes(mesh.points, mesh.tets[cells]).sum() / 1e3,
        {name: areas[chosen].sum() for name, chosen in by_name.items()}, bool(np.all(count == 2)),
        patch_count - (len(np.unique(facets)) - len(edges) + len(facets)) / 2, patch_count,
        patches(airway)[0] if len(airway) else 0)


def body_name(mesh, cells):
    """A body's name: that of its volume, or of the lung whose lobes it holds."""
    names = [mesh.names[3, tag] for tag in np.unique(mesh.regions[cells]) if (3, tag) in mesh.names]
    sides = {name.split("_")[0] for name in names}
    if len(names) > 1 and len(sides) == 1:
        return sides.pop() + "_lung"
    return " + ".join(names) or "no name"


def regions(mesh):
    """{name: ml} of the named volumes."""
    volumes = tet_volumes(mesh.points, mesh.tets) / 1e3
    return {name: volumes[mesh.regions == tag].sum() for (dimension, tag), name in mesh.names.items() if dimension == 3}


def print_report(mesh, numbers):
    """Print the measures of a mesh and the topology of each of its lungs; return the failed checks."""
    areas = numbers["areas"]
    print(f"tetrahedra             {numbers['tets']}")
    print(f"nodes                  {numbers['nodes']}")
    print(f"volume                 {numbers['volume']:.3f} ml")
    print(f"pleura, airway area    {areas.get('pleura', 0):.1f}, {areas.get('airway', 0):.2f} cm2")
    print(f"area / volume^(2/3)    {numbers['shape']:.2f}")
    print(f"min SICN               {numbers['min_sicn']:.3f}")
    print(f"min dihedral angle     {numbers['min_dihedral']:.1f} degrees")
    print(f"tets all on boundary   {100 * numbers['boundary_share']:.1f} %")
    failures = []
    if numbers["min_sicn"] <= MIN_SICN or numbers["min_dihedral"] <= MIN_DIHEDRAL:
        failures.append("the worst cell is too flat")
    for one in bodies(mesh):
        print(f"{one.name:<22} {'closed' if one.closed else 'OPEN'}, genus {one.genus:g}, "
              f"airway patches {one.airway_patches}, {np.sum(one.cells)} tets")
        if (one.closed, one.genus, one.pieces, one.airway_patches) != (True, 0, 1, 1):
            failures.append(f"the {one.name} is not one closed surface of genus 0 with one airway patch")
    return failures
