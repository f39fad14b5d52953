"""Lobes of a meshed lung: each cell belongs to one, and the nodes between two of them lie where the scan has the fissure."""
import numpy as np
from scipy import sparse

from .geometry import FACES, boundary_facets
from .quality import sicn, sicn_of_corners

LEAST = 0.3             # SICN that a move of nodes leaves at least, or what the cell had


def lobes_of(points, tets, distances):
    """Nodes moved to the borders between lobes, and the lobe (index) of each tetrahedron.

    distances: function from points (n, 3) to the distance into each lobe (lobes, n).
    """
    lobe = one_piece_each(tets, distances(points[tets].mean(axis=1)).argmax(axis=0))
    points = fitted(points, tets, lobe, distances)
    return points, lobe


def neighbours(tets):
    """Pairs of tetrahedra that share a face, (n, 2)."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    return np.stack([order[:-1][same], order[1:][same]], axis=1) // 4


def pieces(tets, keep=None):
    """The piece of each tetrahedron: those that hang together through faces (between which keep is the same)."""
    pairs = neighbours(tets)
    if keep is not None:
        pairs = pairs[keep[pairs[:, 0]] == keep[pairs[:, 1]]]
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(tets),) * 2)
    return sparse.csgraph.connected_components(graph, directed=False)[1]


def one_piece_each(tets, lobe):
    """The lobe of each tetrahedron, where bits that hang apart from the rest of their lobe go to the lobe around them."""
    pairs = neighbours(tets)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    lobe = lobe.copy()
    for _ in range(20):
        piece = pieces(tets, lobe)
        largest = [np.bincount(piece[lobe == k]).argmax() for k in np.unique(lobe)]
        loose = ~np.isin(piece, largest)
        if not loose.any():
            break
        edge = pairs[loose[pairs[:, 0]] & (lobe[pairs[:, 0]] != lobe[pairs[:, 1]])]
        for one in np.unique(piece[loose]):
            around = lobe[edge[piece[edge[:, 0]] == one, 1]]
            lobe[piece == one] = np.bincount(around).argmax()
    return lobe


def fitted(points, tets, lobe, distances):
    """Points where inner nodes between two lobes are moved to where both are equally far, as far as cells stay good."""
    points = points.copy()
    free = np.ones(len(points), dtype=bool)
    free[boundary_facets(tets)] = False
    touching = np.zeros((len(points), lobe.max() + 1), dtype=bool)
    for corner in tets.T:
        touching[corner, lobe] = True
    nodes = np.flatnonzero(free & (touching.sum(axis=1) == 2))
    order = np.argsort(tets.ravel(), kind="stable")
    first = np.searchsorted(tets.ravel()[order], np.arange(len(points) + 1))
    quality = sicn(points, tets)
    for step in (1.0, 0.5, 0.5):
        moves = step * to_border(points[nodes], touching[nodes], distances)
        for node, move in zip(nodes, moves):
            mine = order[first[node]:first[node + 1]] // 4
            ball = tets[mine]
            limit = min(LEAST, quality[mine].min())
            for share in (1, 0.5, 0.25):
                corners = points[ball]
                corners[ball == node] += share * move
                better = sicn_of_corners(corners)
                if better.min() >= limit:
                    points[node] += share * move
                    quality[mine] = better
                    break
    return points


def to_border(places, touching, distances):
    """The way (n, 3) from places to where the distances into their two lobes are equal, by their slope."""
    two = np.argsort(~touching, axis=1, kind="stable")[:, :2]
    rows = np.arange(len(places))

    def difference(at):
        values = distances(at)
        return values[two[:, 0], rows] - values[two[:, 1], rows]

    here = difference(places)
    reach = 1.0
    slope = np.stack([(difference(places + reach * axis) - difference(places - reach * axis)) / (2 * reach)
                      for axis in np.eye(3)], axis=1)
    return -(here / np.maximum(np.sum(slope**2, axis=1), 0.25))[:, None] * slope
