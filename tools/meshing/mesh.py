"""A tetrahedral mesh whose surfaces and volumes have names."""
import os
from dataclasses import dataclass

import numpy as np

BYTES = 3000            # of memory that a tetrahedron takes on the way


@dataclass
class Mesh:
    """A tetrahedral mesh with named boundary surfaces and named volumes.

    points: (n, 3) coordinates, mm.
    tets: (m, 4) node indices, positively oriented.
    regions: (m,) volume tag of each tetrahedron.
    facets: (b, 3) node indices of the boundary triangles, seen from outside.
    surfaces: (b,) surface tag of each boundary triangle.
    names: {(dimension, tag): physical name}.
    """

    points: np.ndarray
    tets: np.ndarray
    regions: np.ndarray
    facets: np.ndarray
    surfaces: np.ndarray
    names: dict


def merged(lungs):
    """Several Meshes as one, their nodes kept apart."""
    start = np.cumsum([0] + [len(lung.points) for lung in lungs])
    names = {}
    for lung in lungs:
        names |= lung.names
    return Mesh(np.concatenate([lung.points for lung in lungs]),
                np.concatenate([lung.tets + first for lung, first in zip(lungs, start)]),
                np.concatenate([lung.regions for lung in lungs]),
                np.concatenate([lung.facets + first for lung, first in zip(lungs, start)]),
                np.concatenate([lung.surfaces for lung in lungs]), names)


class MeshError(Exception):
    """A request that cannot be met, or a mesh that fails a check, in one sentence."""


def enough_memory(cells):
    """Refuses more tetrahedra than this machine has memory for."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if cells * BYTES > memory:
        raise MeshError(f"about {cells:.2g} tetrahedra take {cells * BYTES / 1e9:.2g} GB; this machine has {memory / 1e9:.2g} GB: "
                        "take fewer.")
