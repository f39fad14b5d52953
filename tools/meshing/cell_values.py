"""One number for each tetrahedron of a mesh, as pulmo reads it with -tissue_c FILE.h5:NAME.

    tools/cell_values meshes/lung_pair.msh ards.h5 "c=0.36*where(behind < 0.35, 5, 1)" "k=1e4*where(behind < 0.35, 0.1, 1)"

Each NAME=EXPRESSION becomes a dataset. An expression may use x, y, z (of the middle of each cell, in the mesh's unit), left, behind and
below (the share of the mesh's volume that lies further to the left, further back, lower; axes RAS, so `behind` is 0 at the most
dependent place of somebody who lies on the back) and numpy's functions. Values from elsewhere, a CT for example, go the same way: a
dataset of one dimension, tetrahedra in the order of the mesh file (meshio's order).
Runs on Debian's python3-numpy, -meshio and -h5py.
"""
import argparse
import sys

import h5py
import meshio
import numpy as np

from shared.common import written_whole

from .mesh import MeshError


def places(path):
    """What expressions may use."""
    try:
        mesh = meshio.read(path)
    except (OSError, ValueError, KeyError, IndexError, meshio.ReadError, SystemExit) as error:
        raise MeshError(f"{path} is not a mesh that meshio reads ({error})") from error
    if "tetra" not in mesh.cells_dict:
        raise MeshError(f"{path} holds no tetrahedra")
    corners = mesh.points[mesh.cells_dict["tetra"]]
    x, y, z = corners.mean(axis=1).T
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))

    def share(coordinate):
        order = np.argsort(coordinate, kind="stable")
        before = np.empty(len(volume))
        before[order] = (np.cumsum(volume[order]) - volume[order] / 2) / volume.sum()
        return before

    return {"x": x, "y": y, "z": z, "left": share(x), "behind": share(y), "below": share(z)}


def evaluate(expression, names):
    """One value for each cell."""
    try:
        values = np.asarray(eval(expression, {"__builtins__": {}} | vars(np) | names), dtype=float)  # the user's own words
    except Exception as error:  # whatever an expression may raise
        raise MeshError(f"'{expression}' cannot be worked out ({error})") from error
    values = np.broadcast_to(values, names["x"].shape)
    if not np.isfinite(values).all():
        raise MeshError(f"'{expression}' is no finite number in {np.sum(~np.isfinite(values))} cells")
    return values


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh")
    parser.add_argument("file", help="HDF5 file to write")
    parser.add_argument("values", nargs="+", metavar="NAME=EXPRESSION")
    args = parser.parse_args()
    try:
        names = places(args.mesh)
        made = {}
        for word in args.values:
            name, equals, expression = word.partition("=")
            if not (name and equals and expression):
                raise MeshError(f"'{word}' is no NAME=EXPRESSION")
            made[name] = evaluate(expression, names)
        with written_whole(args.file) as part, h5py.File(part, "w", track_order=True) as file:
            for name, values in made.items():
                file.create_dataset(name, data=values, compression="gzip", shuffle=True, track_times=False)
    except (MeshError, OSError) as error:
        sys.exit(f"cell_values: error: {error}")
    for name, values in made.items():
        print(f"{name}: {len(values)} cells, {values.min():g} to {values.max():g}, mean {values.mean():g}")
