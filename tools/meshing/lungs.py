"""Meshes of lungs: from the shape of each to its named surfaces, with exactly the volume asked for."""
import functools
import math
from dataclasses import dataclass

import numpy as np

from .geometry import boundary_facets, enclosed_volume, tet_volumes
from .iso_surface import iso_surface
from .mesh import MeshError, Mesh, merged
from .shape import bronchi_distance, lung_shape
from .sizes import follow, limit_near
from .surfaces import SURFACES, VOLUMES, largest_patch, nearest_patch
from .tetrahedra import good_tetrahedra

SIDES = {"right": ["right"], "left": ["left"], "both": ["right", "left"]}
RIM_SIZE = 0.55         # element size at sharp borders as a share of the element size elsewhere
HILUM_AREA = 7.65       # cm2 of the hilum patch for a lung of the template's size
AIRWAY_LARGEST = {"hilum": 16, "main": 7, "lobar": 5}  # element size at the airway, template mm


@dataclass
class Options:
    """What to make: the command line's values, with defaults filled in (ml, mm)."""

    side: str
    volume: float
    size: float
    airway: str
    airway_size: float
    bronchus_radius: float
    wanted: tuple = ()  # nodes, tetrahedra and node sizes of another mesh that the sizes follow


@functools.cache
def shape_and_surface(side, airway, bronchus_radius):
    """The Shape of a lung and its surface, the same for all sizes of cells."""
    shape = lung_shape(side, airway, bronchus_radius)
    return shape, iso_surface(shape)


def make_lungs(options):
    """The Mesh asked for by the Options, with exactly the volume asked for."""
    shapes, surfaces = {}, {}
    for side in SIDES[options.side]:
        shapes[side], surfaces[side] = shape_and_surface(side, options.airway, options.bronchus_radius)
    scale = (options.volume * 1e3 / sum(enclosed_volume(*surface) for surface in surfaces.values())) ** (1 / 3)
    check_sizes(options, scale)
    lungs = [mesh_lung(side, shapes[side], surfaces[side], scale, options) for side in shapes]
    mesh = merged(lungs)
    mesh.points *= (options.volume * 1e3 / tet_volumes(mesh.points, mesh.tets).sum()) ** (1 / 3)
    return mesh


def check_sizes(options, scale):
    """Refuse element sizes that the lung cannot hold; scale: mm per template mm."""
    if not 3 * scale <= options.size <= 32 * scale:
        raise MeshError(f"--size {options.size:g} mm is outside {3 * scale:.1f} to {32 * scale:.1f} mm, "
                            "what a lung of this volume can be meshed with.")
    largest = AIRWAY_LARGEST[options.airway] * scale
    if not scale <= options.airway_size <= largest:
        raise MeshError(f"--airway-size {options.airway_size:g} mm is outside {scale:.1f} to {largest:.1f} mm, "
                            f"what --airway {options.airway} needs at this volume.")
    if not 5 <= options.bronchus_radius <= 11:
        raise MeshError(f"--bronchus-radius {options.bronchus_radius:g} mm is outside 5 to 11 mm, what the hilum can hold.")


def mesh_lung(side, shape, surface, scale, options):
    """The Mesh of one lung.

    side: "right" or "left". surface: points (template mm) and triangles. scale: mm per template mm.
    """
    points, triangles = surface
    if shape.capsules:
        centres = np.concatenate([np.linspace(start, end, 12) for start, end, _ in shape.capsules])
        centres = centres[shape.body_at(centres) > -3]
        reach = max(radius for *_, radius in shape.capsules) + 2
    else:
        centres, reach = shape.hilum[None], math.sqrt(HILUM_AREA * 100 / math.pi)
    rim = shape.rim(points)

    def default_sizes(factor):
        size = factor * options.size
        return [limit_near(centres * scale, min(options.airway_size, size), size, reach * scale),
                limit_near(rim * scale, RIM_SIZE * size, size, RIM_SIZE * size)]

    def wanted_sizes(factor):
        nodes, tets, sizes = options.wanted
        outwards = np.array([-1 if side == "left" else 1, 1, 1])
        mine = (nodes[tets].mean(axis=1) * outwards)[:, 0] > 0
        largest = AIRWAY_LARGEST[options.airway] * scale
        return [follow(nodes * outwards, tets[mine], factor * sizes),
                limit_near(centres * scale, largest, max(sizes.max(), largest), reach * scale)]

    sizes = wanted_sizes if options.wanted else default_sizes
    nodes, tets = good_tetrahedra(side, points * scale, triangles, sizes)
    return named_lung(side, shape, nodes, tets, scale)


def named_lung(side, shape, nodes, tets, scale):
    """One lung as a Mesh with its airway found, mirrored to its side of the body."""
    facets = boundary_facets(tets)
    centres = nodes[facets].mean(axis=1) / scale
    if shape.capsules:
        inside = bronchi_distance(centres, shape.capsules) < 2
        airway = largest_patch(facets, inside & (shape.body_at(centres) > 1.5))
    else:
        airway = nearest_patch(nodes / scale, facets, shape.hilum, HILUM_AREA * 100)
    if side == "left":
        nodes, tets, facets = nodes * (-1, 1, 1), tets[:, [1, 0, 2, 3]], facets[:, ::-1]
    names = {(2, tag): name for name, tag in SURFACES.items()} | {(3, VOLUMES[side]): f"{side}_lung"}
    return Mesh(nodes, tets, np.full(len(tets), VOLUMES[side]), facets,
                np.where(airway, SURFACES["airway"], SURFACES["pleura"]), names)
