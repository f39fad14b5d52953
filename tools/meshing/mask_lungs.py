"""Meshes of the lungs of a scan: cells, airway, lobes, volumes, and what holds between the two lungs."""
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import spatial

from .geometry import boundary_facets, facet_areas, orient, tet_volumes
from .lobes import lobes_of
from .mask_surface import surfaces
from .mesh import Mesh, MeshError, merged
from .shape import RIM_BEND, TEMPLATE_VOLUME, bending, thinned
from .sizes import limit_near
from .surfaces import SURFACES, VOLUMES, largest_patch, nearest_patch, volume_name
from .tetrahedra import good_tetrahedra

LARGEST_CORRECTION = 0.07  # of the volume, that flat facets may lose of the smooth surface
TOLD_CORRECTION = 0.02
HILUM_AREA = 7.65       # cm2 of the hilum patch for a lung of half the template pair's volume
REACH = 4.0             # mm from the airway's voxels within which the surface is airway, in a lung of that volume
LEAST_AIRWAY = 0.2      # of HILUM_AREA, below which the label does not reach the lung
MOST_AIRWAY = 0.25      # of a lung's surface, above which the label is no airway
HILUM_HEIGHT = 0.55     # of the lung, from below
CELLS_ACROSS = 5        # the airway's patch, at least, where no size is given for it
FEW_CELLS = 3           # across it, below which this is told


@dataclass
class Sizes:
    """Edges of cells, mm: in general, at the airway, at sharp borders. fixed: the airway's is not made smaller for a small airway."""

    general: float
    airway: float
    rim: float
    fixed: bool

    def times(self, factor):
        """The same multiplied."""
        return replace(self, general=self.general * factor, airway=self.airway * factor, rim=self.rim * factor)


def make_mask_lungs(scan, shapes, sizes, scale, say):
    """The Mesh of a Scan's lungs, in the world's mm, then scaled about the lungs' middle.

    shapes: the surfaces of the lungs. sizes: mm in the image. scale: of lengths, for another volume than the image's.
    """
    meshes = []
    for number, (lung, surface) in enumerate(zip(scan.lungs, shapes)):
        other = shapes[1 - number][0].mean(axis=0) if len(shapes) == 2 else None
        meshes.append(mesh_lung(scan, lung, surface, other, sizes, scale, say))
    mesh = merged(meshes)
    check_apart(meshes)
    middle = mesh.points.mean(axis=0)
    mesh.points = middle + scale * (mesh.points - middle)
    return mesh


def mesh_lung(scan, lung, surface, other, sizes, scale, say):
    """The Mesh of one lung in the world's mm, with the volume of its voxels. other: the middle of the other lung or None."""
    points, triangles = surface
    stretch = (lung.volume / (TEMPLATE_VOLUME / 2)) ** (1 / 3)
    area = HILUM_AREA * 100 * stretch**2
    near, place = airway_places(scan, lung, surface, other, stretch, scale, say)
    reach = REACH * stretch
    if near is None:
        reach = math.sqrt(area / math.pi)
    else:
        area = facet_areas(points, triangles)[near[triangles].any(axis=1)].sum()
    if not sizes.fixed:
        sizes = replace(sizes, airway=min(sizes.airway, max(math.sqrt(area) / CELLS_ACROSS, sizes.general / 3)))
    places = thinned(points[near] if near is not None else place[None], 2 * scan.step)
    bend = scan.sampled(bending(lung.distance, scan.step), points)
    rim = thinned(points[bend > RIM_BEND / stretch], 2 * scan.step)

    def fields(factor):
        own = sizes.times(factor)
        found = [limit_near(places, min(own.airway, own.general), own.general, reach)]
        return found + ([limit_near(rim, min(own.rim, own.general), own.general, own.rim)] if len(rim) else [])

    nodes, tets = good_tetrahedra(lung.side, points, triangles, fields)
    regions = np.full(len(tets), VOLUMES[lung.side])
    names = {(2, tag): name for name, tag in SURFACES.items()}
    if lung.lobes:
        lobes = list(lung.lobes)
        nodes, lobe = lobes_of(nodes, tets, lambda at: np.array([scan.sampled(lung.lobes[k], at) for k in lobes]))
        regions = np.array([VOLUMES[k] for k in lobes])[lobe]
        names |= {(3, VOLUMES[k]): volume_name(k) for k in lobes}
    else:
        names[3, VOLUMES[lung.side]] = volume_name(lung.side)
    facets = boundary_facets(tets)
    airway = airway_facets(scan, nodes, facets, near is not None, place, stretch)
    check_airway(lung.side, nodes, facets, airway, sizes, say)
    nodes = with_volume(lung, nodes, tets, say)
    nodes = scan.world(nodes)
    if tet_volumes(nodes, tets[:1])[0] < 0:  # the image's axes are left-handed
        tets, facets = orient(nodes, tets), facets[:, ::-1]
    return Mesh(nodes, tets, regions, facets, np.where(airway, SURFACES["airway"], SURFACES["pleura"]), names)


def with_volume(lung, nodes, tets, say):
    """Nodes moved away from their middle until the cells have the volume of the lung's voxels."""
    share = tet_volumes(nodes, tets).sum() / (lung.volume * 1e3)
    if abs(share - 1) > LARGEST_CORRECTION:
        raise MeshError(f"the {lung.side} lung's flat cells hold {100 * share:.1f} % of the mask's volume: take a smaller --size.")
    if abs(share - 1) > TOLD_CORRECTION:
        say(f"the {lung.side} lung's flat cells held {100 * share:.1f} % of the mask's volume: all lengths are {100 * (share**(-1 / 3) - 1):.1f} % "
            "larger to make up for it; a smaller --size has less need of that.")
    middle = nodes.mean(axis=0)
    return middle + (nodes - middle) * share ** (-1 / 3)


def airway_places(scan, lung, surface, other, stretch, scale, say):
    """Surface points (boolean) at the airway's label, or None where it does not reach the lung, and the hilum's place."""
    points, triangles = surface
    patch = f"a patch of {HILUM_AREA * (stretch * scale) ** 2:.1f} cm2"
    if scan.airway is None:
        say(f"no airway label: {patch} in the middle of the {lung.side} lung's inner side is the airway.")
        return None, hilum(lung.side, points, other)
    distance = -scan.sampled(scan.airway, points)
    near = distance < REACH * stretch
    place = points[np.argmin(distance)]
    if facet_areas(points, triangles)[near[triangles].all(axis=1)].sum() > LEAST_AIRWAY * HILUM_AREA * 100 * stretch**2:
        return near, place
    say(f"the airway's label comes within {max(distance.min(), 0):.0f} mm of the {lung.side} lung in the scan, too far or too little to be its "
        f"opening: {patch} at the nearest place is the airway.")
    return None, place


def hilum(side, points, other):
    """A place in the middle of a lung's inner side: of its surface points the one most towards the other lung."""
    low, high = points.min(axis=0), points.max(axis=0)
    inwards = (other - points.mean(axis=0))[0] if other is not None else (-1 if side == "right" else 1)
    middle = np.array([0, (low[1] + high[1]) / 2, low[2] + HILUM_HEIGHT * (high[2] - low[2])])
    aside = np.linalg.norm((points - middle)[:, 1:], axis=1)
    central = points[aside < max(0.08 * (high[2] - low[2]), aside.min() + 1e-6)]
    return central[np.argmax(np.sign(inwards) * central[:, 0])]


def airway_facets(scan, nodes, facets, labelled, place, stretch):
    """The boundary triangles (boolean) that are airway: one patch, and the rest one patch as well."""
    if labelled:
        close = -scan.sampled(scan.airway, nodes[facets].mean(axis=1)) < REACH * stretch
        airway = largest_patch(facets, close)
    else:
        airway = nearest_patch(nodes, facets, place, HILUM_AREA * 100 * stretch**2)
    return ~largest_patch(facets, ~airway) if airway.any() else airway


def check_airway(side, nodes, facets, airway, sizes, say):
    """Refuses an airway that is none or most of the lung; tells one of few cells."""
    areas = facet_areas(nodes, facets)
    if not airway.any():
        raise MeshError(f"no cell's face is within reach of the airway at the {side} lung: take a smaller --airway-size.")
    if areas[airway].sum() > MOST_AIRWAY * areas.sum():
        raise MeshError(f"the airway's label touches {100 * areas[airway].sum() / areas.sum():.0f} % of the {side} lung's surface, so it "
                        "is no airway: check --labels.")
    across = math.sqrt(areas[airway].sum()) / sizes.airway
    if across < FEW_CELLS:
        say(f"the {side} lung's airway is only {across:.1f} cells across: a smaller --airway-size resolves it.")


def check_apart(meshes):
    """Refuses two lungs of which one reaches into the other."""
    if len(meshes) < 2:
        return
    for one, other in (meshes, meshes[::-1]):
        places = np.concatenate([one.points[np.unique(one.facets)], one.points[one.facets].mean(axis=1)])
        if contains(other, places).any():
            raise MeshError("the two lungs reach into one another where they touch: take a smaller --size.")


def contains(mesh, points):
    """Which points (n, 3), of those near its surface, are inside a closed Mesh, by the solid angle of the surface."""
    triangles = mesh.points[mesh.facets]
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max()
    found = spatial.cKDTree(mesh.points).query(points)[0] < longest
    for row in np.flatnonzero(found):
        a, b, c = np.moveaxis(triangles - points[row], 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        angle = np.arctan2(np.sum(a * np.cross(b, c), axis=1), la * lb * lc + np.sum(a * b, axis=1) * lc
                           + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb)
        found[row] = abs(angle.sum()) > np.pi  # half the solid angle: 2 pi inside, 0 outside
    return found
