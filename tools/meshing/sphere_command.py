"""Structured tetrahedral meshes of a hollow sphere or of one octant of it, as MSH 2.2 files for pulmo.

    tools/sphere_mesh --divisions 8 --layers 24 --octant --output octant.msh

Each octant of the sphere is a grid of triangles, divisions to an edge; each layer of prisms under them is cut in
tetrahedra. Surfaces: `airway` inside, `pleura` outside and, of an octant, its planes of symmetry `x0`, `y0`, `z0`.

Facets are flat, so vertices at the exact radii would leave a volume that is too small (by 3.9 % with 6 divisions). All
radii are therefore larger by one factor, known from the triangles alone: every layer has the volume of the exact one.
What is left is of second order in the size of the triangles (the areas are then 0.5 % too large with 6 divisions).

Runs on Debian's python3-numpy and -meshio. Lengths in mm.
"""
import argparse

from .mesh import MeshError
from .sphere import write


def main(arguments):
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="sphere_mesh", description=__doc__.splitlines()[0])
    parser.add_argument("--divisions", type=int, required=True, help="triangles to an edge of an octant, at least 1")
    parser.add_argument("--layers", type=int, required=True, help="layers of cells from inside to outside, at least 1")
    parser.add_argument("--inner", type=float, default=7.5, help="inner radius, mm (7.5)")
    parser.add_argument("--outer", type=float, default=72.5, help="outer radius, mm (72.5)")
    parser.add_argument("--octant", action="store_true", help="the octant x, y, z >= 0 only")
    parser.add_argument("--output", required=True, help="file to write")
    parser.error = lambda message: parser.exit(2, f"sphere_mesh: {message}; see --help.\n")
    given = parser.parse_args(arguments)
    try:
        tets = write(given.output, given.divisions, given.layers, given.inner, given.outer, given.octant)
    except OSError as error:
        parser.error(f"cannot write {given.output}: {error.strerror}")
    except MemoryError:
        parser.error("the memory is used up: take fewer divisions or layers")
    except MeshError as error:
        parser.error(error)
    print(f"wrote {given.output}: {tets} tetrahedra")
    return 0
