"""Tetrahedra inside a closed surface, made by gmsh and mended."""
import math

import gmsh
import numpy as np

from .geometry import boundary_facets, orient, triangle_edges
from .gmsh_model import gmsh_elements, gmsh_nodes, gmsh_session
from .mesh import MeshError
from .quality import MIN_DIHEDRAL, MIN_SICN, dihedral_angles, sicn, sicn_of_corners
from .sizes import take_smallest


def good_tetrahedra(side, points, triangles, sizes):
    """Nodes and tetrahedra inside one lung's surface; a slightly other size is tried where gmsh gives no or bad cells.

    side: "right" or "left", for messages. points, triangles: the surface, mm. sizes: gmsh's fields of element sizes from a
    factor of all sizes.
    """
    for factor in (1, 0.97, 1.03, 0.94):
        try:
            nodes, tets = mesh_inside(points, triangles, lambda: take_smallest(sizes(factor)))
        except Exception as error:  # gmsh raises bare Exceptions
            problem = f"gmsh could not mesh the {side} lung at this size ({error})"
            continue
        worst, angle = sicn(nodes, tets).min(), dihedral_angles(nodes, tets).min()
        if worst > MIN_SICN and angle > MIN_DIHEDRAL:
            return nodes, tets
        problem = f"the {side} lung's worst cell is too flat (SICN {worst:.2f}, dihedral angle {angle:.1f} degrees)"
    raise MeshError(problem + "; try another --size or --airway-size.")


def mesh_inside(points, triangles, set_sizes):
    """Tetrahedra inside a closed surface, made by gmsh.

    Delaunay, because HXT gives another mesh in each run; its few poor cells are repaired afterwards.
    points, triangles: the surface, mm. set_sizes: tells gmsh the element sizes.
    Returns nodes (n, 3) and positively oriented tetrahedra (m, 4).
    """
    with gmsh_session():
        surface = gmsh.model.addDiscreteEntity(2)
        gmsh.model.mesh.addNodes(2, surface, np.arange(1, len(points) + 1), points.ravel())
        gmsh.model.mesh.addElementsByType(surface, 2, np.arange(1, len(triangles) + 1), triangles.ravel() + 1)
        gmsh.model.mesh.classifySurfaces(math.pi, True, True, math.pi)
        gmsh.model.mesh.createGeometry()
        loop = gmsh.model.geo.addSurfaceLoop([tag for _, tag in gmsh.model.getEntities(2)])
        gmsh.model.geo.addVolume([loop])
        set_sizes()
        for option, value in (("Algorithm", 6), ("Algorithm3D", 1), ("Optimize", 1), ("OptimizeThreshold", 0.5)):
            gmsh.option.setNumber("Mesh." + option, value)
        gmsh.model.mesh.generate(3)
        for method in ("", "Relocate3D", ""):
            gmsh.model.mesh.optimize(method)
        nodes, row = gmsh_nodes()
        used, tets = np.unique(gmsh_elements(3, row), return_inverse=True)
        nodes, tets = nodes[used], orient(nodes[used], tets.reshape(-1, 4))
        nodes = improved(nodes, tets)
        return nodes, without_boundary_slivers(nodes, tets)


def improved(points, tets, goal=0.4, rounds=8):
    """Points with inner nodes of poor tetrahedra moved to where the worst cell around them is best.

    goal: SICN below which a cell is poor. rounds: passes over the poor cells.
    """
    points = points.copy()
    inner = np.ones(len(points), dtype=bool)
    inner[boundary_facets(tets)] = False
    flat = np.argsort(tets.ravel(), kind="stable")
    first = np.searchsorted(tets.ravel()[flat], np.arange(len(points) + 1))
    steps = np.array([[0, 0, 0]] + [d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], dtype=float)
    steps[1:] = (steps[1:] - 1) / np.linalg.norm(steps[1:] - 1, axis=1, keepdims=True)
    for reach in np.geomspace(0.25, 0.02, rounds):
        poor = np.unique(tets[sicn(points, tets) < goal])
        for node in poor[inner[poor]]:
            ball = tets[flat[first[node]:first[node + 1]] // 4]
            length = np.linalg.norm(points[ball] - points[node], axis=2).max()
            trials = np.repeat(points[ball][None], len(steps), axis=0)
            trials[:, ball == node] += reach * length * steps[:, None]
            worst = sicn_of_corners(trials.reshape(-1, 4, 3)).reshape(len(steps), -1).min(axis=1)
            points[node] += reach * length * steps[np.argmax(worst)]
    return points


def without_boundary_slivers(points, tets, limit=0.35):
    """The tetrahedra less those flat ones (SICN below limit) that only cap two neighbouring surface triangles.

    Taking one away turns the edge between its two surface triangles; the topology stays.
    """
    for cell in np.flatnonzero(sicn(points, tets) < limit)[::-1]:
        facets = boundary_facets(tets)
        surface = {tuple(facet) for facet in np.sort(facets, axis=1)}
        edges = {tuple(edge) for edge in triangle_edges(facets)}
        nodes = np.sort(tets[cell])
        opposite = [node for node in nodes if tuple(nodes[nodes != node]) in surface]
        if len(opposite) == 2 and tuple(opposite) not in edges:
            tets = np.delete(tets, cell, axis=0)
    return tets
