"""gmsh: a session of it, and the nodes and elements of its model."""
import contextlib

import gmsh
import numpy as np


@contextlib.contextmanager
def gmsh_session():
    """A silent, single-threaded (hence reproducible) gmsh with an empty model."""
    gmsh.initialize(["lung_mesh"], False)  # without the user's own settings
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        gmsh.model.add("mesh")
        yield
    finally:
        gmsh.finalize()


def gmsh_nodes():
    """Coordinates of the nodes of the current gmsh model, and a table from gmsh node tag to row."""
    tags, xyz, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    row = np.zeros(int(tags.max()) + 1, dtype=int)
    row[tags[order].astype(int)] = np.arange(len(tags))
    return xyz.reshape(-1, 3)[order], row


def gmsh_elements(dimension, row, entity=-1):
    """Node rows of the linear simplices of one dimension (2 or 3) of the current gmsh model."""
    _, nodes = gmsh.model.mesh.getElementsByType({2: 2, 3: 4}[dimension], entity)
    return row[nodes.astype(int)].reshape(-1, dimension + 1)
