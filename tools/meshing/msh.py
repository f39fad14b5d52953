"""Writes meshes as MSH files and reads them."""
import os

import gmsh
import numpy as np

from shared.common import written_whole

from .gmsh_model import gmsh_elements, gmsh_nodes, gmsh_session
from .mesh import MeshError, Mesh


def write_mesh(mesh, path, version=4.1, binary=False, digits=6):
    """Write a mesh as MSH with physical names.

    path: file to write. version: 4.1 or 2.2. binary: binary instead of ASCII.
    digits: decimals kept of the coordinates (short ASCII files).
    """
    with gmsh_session():
        first = {}
        for (dimension, tag), name in mesh.names.items():
            entity = gmsh.model.addDiscreteEntity(dimension, tag)
            gmsh.model.addPhysicalGroup(dimension, [entity], tag)
            gmsh.model.setPhysicalName(dimension, tag, name)
            first[dimension] = min(first.get(dimension, tag), tag)
        node_tags = np.arange(1, len(mesh.points) + 1)
        gmsh.model.mesh.addNodes(3, first[3], node_tags, np.round(mesh.points, digits).ravel())
        number = 1
        for (dimension, tag) in mesh.names:
            cells = mesh.facets[mesh.surfaces == tag] if dimension == 2 else mesh.tets[mesh.regions == tag]
            gmsh.model.mesh.addElementsByType(
                tag, {2: 2, 3: 4}[dimension], np.arange(number, number + len(cells)), cells.ravel() + 1)
            number += len(cells)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", int(binary))
        with written_whole(path) as part:
            gmsh.write(part)
            if not is_whole(part):
                raise MeshError(f"--output {path} cannot be written whole: free the disk, or choose another folder.")


def is_whole(path):
    """Whether a MSH file has its end: gmsh says nothing of a full disk."""
    try:
        with open(path, "rb") as f:
            f.seek(max(0, os.path.getsize(path) - 100))
            return b"$EndElements" in f.read()
    except OSError:
        return False


def read_mesh(path):
    """The Mesh of a file written by write_mesh."""
    with gmsh_session():
        gmsh.merge(path)
        points, row = gmsh_nodes()
        parts = {2: [], 3: []}
        names = {}
        for dimension, tag in gmsh.model.getPhysicalGroups():
            names[dimension, tag] = gmsh.model.getPhysicalName(dimension, tag)
            cells = [gmsh_elements(dimension, row, entity)
                     for entity in gmsh.model.getEntitiesForPhysicalGroup(dimension, tag)]
            parts[dimension].append((np.concatenate(cells), tag))
    tags = {d: np.concatenate([np.full(len(cells), tag) for cells, tag in parts[d]]) for d in parts}
    cells = {d: np.concatenate([cells for cells, _ in parts[d]]) for d in parts}
    return Mesh(points, cells[3], tags[3], cells[2], tags[2], names)
