"""Named surfaces and volumes of the lungs, and patches of triangles that hang together."""
import numpy as np
from scipy import sparse

from .geometry import triangle_edges

SURFACES = {"airway": 1, "pleura": 2}
VOLUMES = {"right": 3, "left": 4}


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
