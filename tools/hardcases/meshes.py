"""Meshes that are hard on purpose: stretched boxes, slivers."""
import itertools

import numpy as np

from .lab import case_meshes


def quality(points, tets):
    """Least of 3 inscribed over circumscribed radius: 1 regular, 0 flat."""
    corner = points[tets]
    e = [corner[:, j] - corner[:, i] for i, j in itertools.combinations(range(4), 2)]
    volume = np.abs(np.einsum("ij,ij->i", e[0], np.cross(e[1], e[2]))) / 6
    faces = sum(np.linalg.norm(np.cross(e[a], e[b]), axis=1) / 2 for a, b in [(0, 1), (0, 2), (1, 2), (3, 4)])
    products = [np.linalg.norm(e[a], axis=1) * np.linalg.norm(e[b], axis=1) for a, b in [(0, 5), (1, 4), (2, 3)]]
    half = sum(products) / 2
    area = np.sqrt(np.maximum(half * (half - products[0]) * (half - products[1]) * (half - products[2]), 0))
    return (3 * (3 * volume / faces) / (area / (6 * volume))).min()


def box(counts, lengths, flatten=0.0, seed=1):
    """Points and tetrahedra of a box; `flatten`: inner nodes move towards a neighbour until cells are nearly flat."""
    points, tets = case_meshes.kuhn(counts, lengths)
    if flatten:
        inner = np.setdiff1d(np.arange(len(points)), case_meshes.boundary(tets))
        random = np.random.default_rng(seed)
        for node in inner:  # as far as the flattest of its cells allows
            here = tets[(tets == node).any(axis=1)]
            direction = random.normal(size=3) * np.array(lengths) / np.array(counts)
            old = points[node].copy()
            start = np.linalg.det(points[here[:, 1:]] - points[here[:, :1]])
            low, high = 0.0, 4.0
            for _ in range(40):
                middle = (low + high) / 2
                points[node] = old + middle * direction
                now = np.linalg.det(points[here[:, 1:]] - points[here[:, :1]])
                low, high = (middle, high) if (now > (1 - flatten) * start).all() else (low, middle)
            points[node] = old + low * direction
    return points, tets


def box_options(counts, lengths, **arguments):
    """A box on disk with surfaces x0 ... z1."""
    points, tets = box(counts, lengths, **arguments)
    facets = case_meshes.boundary(tets)
    return case_meshes.write(points, tets, facets, case_meshes.faces_of_box(points, facets, lengths))
