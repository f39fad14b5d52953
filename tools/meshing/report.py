"""Numbers about a mesh, and whether it passes."""
import numpy as np

from .geometry import facet_areas, tet_volumes, triangle_edges
from .quality import MIN_DIHEDRAL, MIN_SICN, dihedral_angles, sicn
from .surfaces import SURFACES, patches


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


def topology(mesh, volume_tag):
    """Topology of one lung of a Mesh: whether its surface is closed, its genus and its airway patches."""
    inside = np.zeros(len(mesh.points), dtype=bool)
    inside[mesh.tets[mesh.regions == volume_tag]] = True
    mine = inside[mesh.facets].all(axis=1)
    facets = mesh.facets[mine]
    edges, count = np.unique(triangle_edges(facets), axis=0, return_counts=True)
    pieces, _ = patches(facets)
    airway = facets[mesh.surfaces[mine] == SURFACES["airway"]]
    return {
        "closed": bool(np.all(count == 2)),
        "genus": pieces - (len(np.unique(facets)) - len(edges) + len(facets)) / 2,
        "pieces": pieces,
        "airway_patches": patches(airway)[0] if len(airway) else 0,
    }


def print_report(mesh, numbers):
    """Print the measures of a mesh and the topology of each of its lungs; return the failed checks."""
    areas = numbers["areas"]
    print(f"tetrahedra             {numbers['tets']}")
    print(f"nodes                  {numbers['nodes']}")
    print(f"volume                 {numbers['volume']:.3f} ml")
    print(f"pleura, airway area    {areas['pleura']:.1f}, {areas['airway']:.2f} cm2")
    print(f"area / volume^(2/3)    {numbers['shape']:.2f}")
    print(f"min SICN               {numbers['min_sicn']:.3f}")
    print(f"min dihedral angle     {numbers['min_dihedral']:.1f} degrees")
    print(f"tets all on boundary   {100 * numbers['boundary_share']:.1f} %")
    failures = []
    if numbers["min_sicn"] <= MIN_SICN or numbers["min_dihedral"] <= MIN_DIHEDRAL:
        failures.append("the worst cell is too flat")
    for (dimension, tag), name in mesh.names.items():
        if dimension == 3:
            facts = topology(mesh, tag)
            print(f"{name:<22} {'closed' if facts['closed'] else 'OPEN'}, genus {facts['genus']:g}, "
                  f"airway patches {facts['airway_patches']}, {np.sum(mesh.regions == tag)} tets")
            if facts != {"closed": True, "genus": 0, "pieces": 1, "airway_patches": 1}:
                failures.append(f"the {name} is not one closed surface of genus 0 with one airway patch")
    return failures
