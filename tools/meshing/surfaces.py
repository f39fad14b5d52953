"""Named surfaces and volumes of the lungs, and patches of triangles that hang together."""
import numpy as np
from scipy import sparse

from .geometry import facet_areas, triangle_edges

SURFACES = {"airway": 1, "pleura": 2}
VOLUMES = {"right": 3, "left": 4, "right_upper": 5, "right_middle": 6, "right_lower": 7, "left_upper": 8, "left_lower": 9}


def volume_name(part):
    """Physical name of a lung or lobe, one of VOLUMES."""
    return part + ("_lobe" if "_" in part else "_lung")


def patches(facets):
    """Number of edge-connected patches of triangles, and the patch of each triangle."""
    _, edge = np.unique(triangle_edges(facets), axis=0, return_inverse=True)
    touches = sparse.coo_matrix((np.ones(len(edge)), (np.repeat(np.arange(len(facets)), 3), edge.ravel()))).tocsr()
    return sparse.csgraph.connected_components(touches @ touches.T, directed=False)


def largest_patch(facets, chosen):
    """The chosen triangles (boolean) reduced to their largest edge-connected patch."""
    if not chosen.any():
        return chosen
    _, patch = patches(facets[chosen])
    kept = chosen.copy()
    kept[chosen] = patch == np.argmax(np.bincount(patch))
    return kept


def nearest_patch(points, facets, place, area):
    """The triangles (boolean) nearest to a place, up to an area in the square of the points' unit, in one patch."""
    distance = np.linalg.norm(points[facets].mean(axis=1) - place, axis=1)
    nearest = np.argsort(distance, kind="stable")
    chosen = np.zeros(len(facets), dtype=bool)
    chosen[nearest[np.cumsum(facet_areas(points, facets[nearest])) <= area]] = True
    return largest_patch(facets, chosen)
