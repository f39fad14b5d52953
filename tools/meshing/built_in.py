"""Make every mesh of the folder meshes/ and its README.md: cubes, column, hollow sphere and the lungs.

    tools/make_meshes meshes

Lengths are in mm. Runs on Debian's python3-gmsh, -numpy, -scipy, -skimage and -matplotlib.
"""
import argparse
import contextlib
import io
import os
import sys

import numpy as np

from . import lung_command
from .boxes import box, box_face, irregular_cube, refined, tagged, x1_or_rest
from .msh import read_mesh, write_mesh
from .report import measures
from .sphere import shell

CUBE_FACES = ["x0", "x1", "y0", "y1", "z0", "z1"]
LUNGS = {
    "lung_test.msh": "--side right --volume 1350 --bronchus-radius 7 --size 32 --airway-size 7",
    "lung_pair.msh": "--side both",
}
SPHERE = {"divisions": 4, "layers": 12}
ABOUT = {
    "lung_test.msh": "one right lung, main bronchus carved: tests and quickstart",
    "lung_pair.msh": "both lungs, main bronchi carved: the default pair",
    "hollow_sphere.msh": "shell 7.5 <= r <= 72.5 mm, structured, `airway` inside and `pleura` outside",
    "cube.msh": "[0,1]^3 mm, cube_coarse refined once",
    "cube_coarse.msh": "[0,1]^3 mm, irregular",
    "cube_fine.msh": "[0,1]^3 mm, cube_coarse refined twice",
    "cube_lung.msh": "[0,10]^3 mm, face x = 10 `airway`, the rest `pleura`",
    "column.msh": "1 x 0.1 x 0.1 mm",
    "cube_msh22_ascii.msh": "one cube in four flavours for the reader's test, face x = 1 `airway`, the rest `pleura`",
    "cube_msh22_binary.msh": "the same",
    "cube_msh41_ascii.msh": "the same",
    "cube_msh41_binary.msh": "the same",
}
README = """# Meshes

All made by `tools/make_meshes meshes`, which writes this file too. The lungs can be made one by one with the
commands shown; `tools/lung_mesh --help` tells how to make others. MSH 4.1 ASCII unless the name says otherwise,
lengths in mm, lung axes RAS (x to the subject's right, y to the front, z up).

Every volume and boundary surface has a physical name. min SICN is gmsh's signed inverse condition number of the
worst cell, 1 for a regular tetrahedron.

{table}

`tools/lung_mesh --picture docs/figures/lung_mesh.png` drew the picture of the pair.

The three cubes are nested: each tetrahedron is cut in eight, so h halves exactly from one to the next. Their face
centres are moved off the middle, so no symmetry makes a solution converge faster than it should.

The hollow sphere is that of `tools/sphere_mesh --divisions {divisions} --layers {layers}`, which makes finer ones and octants. Its
facets are flat; its radii are scaled so that every layer has the exact volume. Errors of its areas: {sphere}.

`lung_pair_ards.h5` holds values for the cells of `lung_pair.msh`; `petsc_options/scenes/ards.opts` says how `tools/cell_values` made them.

The lungs come from a parametric shape (rib cage, apex, mediastinum, spine, heart with cardiac notch, diaphragm),
not from a patient. Surface area over volume^(2/3) of the pair is {pair_shape:.2f}; real pairs have 8.4 to 9.0.
"""


def simple_meshes():
    """The meshes that are not lungs: {file name: (Mesh, MSH version, binary)}."""
    unit = (1, 1, 1)
    coarse = irregular_cube()
    cube = refined(*coarse)
    fine = refined(*cube)
    column_lengths = (1, 0.1, 0.1)
    column_side = np.array([0, 1, 2, 2, 3, 3])
    tiny = tagged(*coarse, x1_or_rest(unit), ["airway", "pleura"], "body")
    meshes = {
        "cube_coarse.msh": tagged(*coarse, box_face(unit), CUBE_FACES, "body"),
        "cube.msh": tagged(*cube, box_face(unit), CUBE_FACES, "body"),
        "cube_fine.msh": tagged(*fine, box_face(unit), CUBE_FACES, "body"),
        "cube_lung.msh": tagged(*box((10, 10, 10), 5), x1_or_rest((10, 10, 10)), ["airway", "pleura"], "lung"),
        "column.msh": tagged(*box(column_lengths, 0.045), lambda c: column_side[box_face(column_lengths)(c)],
                             ["x0", "x1", "sides_y", "sides_z"], "body"),
        "hollow_sphere.msh": tagged(*shell(SPHERE["divisions"], SPHERE["layers"], 7.5, 72.5)[:2],
                                    lambda c: (np.linalg.norm(c, axis=1) > 40).astype(int),
                                    ["airway", "pleura"], "lung"),
    }
    files = {name: (mesh, 4.1, False) for name, mesh in meshes.items()}
    for version in (2.2, 4.1):
        for binary in (False, True):
            name = f"cube_msh{round(10 * version)}_{'binary' if binary else 'ascii'}.msh"
            files[name] = (tiny, version, binary)
    return files


def row(name, mesh, command):
    """One line of README.md's table."""
    numbers = measures(mesh)
    small = numbers["volume"] < 10
    volume = f"{1000 * numbers['volume']:.6g} mm³" if small else f"{numbers['volume']:.6g} ml"
    areas = ", ".join(f"`{surface}` {area * (100 if small else 1):.4g}" for surface, area in numbers["areas"].items())
    volumes = ", ".join(f"`{name}`" for (dimension, _), name in mesh.names.items() if dimension == 3)
    return (f"| `{name}` | {ABOUT[name]} | {numbers['tets']} | {numbers['nodes']} | {volumes} {volume} | "
            f"{areas} {'mm²' if small else 'cm²'} | {numbers['min_sicn']:.2f} | `{command}` |")


def main(arguments):
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make_meshes", description=__doc__.splitlines()[0])
    parser.add_argument("folder", help="where to write the meshes and README.md")
    folder = parser.parse_args(arguments).folder
    if not os.path.isdir(folder):
        sys.exit(f"make_meshes: {folder} is not a folder.")
    meshes = {}
    commands = {}
    for name, options in LUNGS.items():
        with contextlib.redirect_stdout(io.StringIO()):
            code = lung_command.main(options.split() + ["--output", os.path.join(folder, name)])
        if code:
            return code
        meshes[name] = read_mesh(os.path.join(folder, name))
        commands[name] = f"tools/lung_mesh {options} --output meshes/{name}"
    for name, (mesh, version, binary) in simple_meshes().items():
        write_mesh(mesh, os.path.join(folder, name), version, binary, digits=9)
        meshes[name] = mesh
        commands[name] = "tools/make_meshes meshes"
    write_readme(os.path.join(folder, "README.md"), meshes, commands)
    return 0


def write_readme(path, meshes, commands):
    """Write README.md about {file name: Mesh} made by {file name: command}."""
    titles = ["file", "what", "tets", "nodes", "volumes", "surfaces", "min SICN", "made by"]
    head = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    table = head + [row(name, meshes[name], commands[name]) for name in ABOUT]
    sphere = measures(meshes["hollow_sphere.msh"])
    exact = {"airway": 4 * np.pi * 0.75**2, "pleura": 4 * np.pi * 7.25**2}
    errors = ", ".join(f"`{name}` {100 * (sphere['areas'][name] / exact[name] - 1):+.1f} %" for name in exact)
    pair_shape = measures(meshes["lung_pair.msh"])["shape"]
    with open(path, "w", encoding="utf-8") as file:
        file.write(README.format(table="\n".join(table), sphere=errors, pair_shape=pair_shape, **SPHERE))
