#!/usr/bin/python3
"""Bad input ends at once, on all ranks, with one sentence that names what is wrong and what to do; nothing is written.

The table below is the list of what a user can get wrong: options of the run and words that the sentence must hold.
"""
import itertools
import os
import re
import subprocess
import unittest
from concurrent.futures import ThreadPoolExecutor

import h5py
import meshio
import numpy as np

import pulmo_case as pulmo
from case_meshes import bodies

NO_MESH = pulmo.DIRECT + pulmo.PCV
LIMIT = 30  # s, on a busy machine; a hang would take for ever
EDGES = [(0, 1), (1, 2), (0, 2), (0, 3), (2, 3), (1, 3)]  # of gmsh's quadratic tetrahedron and, the first 3, triangle


class Cube:
    """meshes/cube_lung.msh, to be spoilt and written as MSH 2.2."""

    def __init__(self):
        m = meshio.read(pulmo.mesh("cube_lung.msh"))
        self.points = m.points.copy()
        self.cells = {kind: m.cells_dict[kind].copy() for kind in ("triangle", "tetra")}
        self.tags = {kind: m.cell_data_dict["gmsh:physical"][kind].copy() for kind in self.cells}
        self.names = [(3 if dim == 3 else 2, tag, name) for name, (tag, dim) in m.field_data.items()]
        assert len(self.cells["tetra"]) == 100 and sorted(n[2] for n in self.names) == ["airway", "lung", "pleura"]

    def write(self, name):
        kinds = {"triangle": 2, "tetra": 4, "triangle6": 9, "tetra10": 11, "hexahedron": 5, "vertex": 15}
        path = pulmo.scratch(name + ".msh")
        with open(path, "w") as f:
            f.write("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n")
            if self.names:
                f.write(f"$PhysicalNames\n{len(self.names)}\n")
                f.writelines(f'{dim} {tag} "{text}"\n' for dim, tag, text in self.names)
                f.write("$EndPhysicalNames\n")
            f.write(f"$Nodes\n{len(self.points)}\n")
            f.writelines(f"{i} {x:.17g} {y:.17g} {z:.17g}\n" for i, (x, y, z) in enumerate(self.points, 1))
            f.write(f"$EndNodes\n$Elements\n{sum(map(len, self.cells.values()))}\n")
            number = itertools.count(1)
            for kind, cells in self.cells.items():
                for cell, tag in zip(cells, self.tags[kind]):
                    f.write(f"{next(number)} {kinds[kind]} 2 {tag} {tag} " + " ".join(str(n + 1) for n in cell) + "\n")
            f.write("$EndElements\n")
        return path


def text_file(name, text):
    path = pulmo.scratch(name)
    with open(path, "wb") as f:
        f.write(text)
    return path


# a tetrahedron of 3 mm
FACETS = [((0, 0, 0), (0, 3, 0), (3, 0, 0)), ((0, 0, 0), (3, 0, 0), (0, 0, 3)), ((3, 0, 0), (0, 3, 0), (0, 0, 3)), ((0, 0, 0), (0, 0, 3), (0, 3, 0))]


def stl(facets):
    text = "".join("facet normal 0 0 0 outer loop " + "".join("vertex %g %g %g " % x for x in t) + "endloop endfacet\n" for t in facets)
    return ("solid wall\n" + text + "endsolid").encode()


def meshes():
    """Name -> path of a spoilt mesh."""
    with open(pulmo.mesh("cube_lung.msh"), "rb") as f:
        good = f.read()
    made = {
        "good": Cube().write("good"),
        "empty": text_file("empty.msh", b""),
        "junk": text_file("junk.msh", bytes(range(256)) * 20),
        "text": text_file("text.msh", b"this is not a mesh\n" * 50),
        "half": text_file("half.msh", good[:len(good) // 2]),
        "no_end": text_file("no_end.msh", good[:good.index(b"$Elements") + 200]),
        "folder": os.path.dirname(pulmo.scratch()),
    }

    cube = Cube()
    cube.names = [n for n in cube.names if n[0] == 3]
    made["numbers"] = cube.write("numbers")  # groups without names
    cube.tags = {kind: 0 * tags for kind, tags in cube.tags.items()}
    made["nameless"] = cube.write("nameless")

    cube = Cube()
    cube.names = [(dim, tag, "mouth" if name == "airway" else name) for dim, tag, name in cube.names]
    made["no_airway"] = cube.write("no_airway")

    cube = Cube()
    del cube.cells["tetra"]
    cube.names = [n for n in cube.names if n[0] == 2]
    made["surface_only"] = cube.write("surface_only")

    cube = Cube()
    middles, points = {}, list(cube.points)
    for kind, n_edges in (("triangle", 3), ("tetra", 6)):
        rows = []
        for cell in cube.cells.pop(kind):
            extra = []
            for a, b in EDGES[:n_edges]:
                key = tuple(sorted((cell[a], cell[b])))
                if key not in middles:
                    middles[key] = len(points)
                    points.append((cube.points[key[0]] + cube.points[key[1]]) / 2)
                extra.append(middles[key])
            rows.append(list(cell) + extra)
        quadratic = {"triangle": "triangle6", "tetra": "tetra10"}[kind]
        cube.cells[quadratic], cube.tags[quadratic] = np.array(rows), cube.tags.pop(kind)
    cube.points = np.array(points)
    made["quadratic"] = cube.write("quadratic")

    cube = Cube()  # an inner vertex pulled through the opposite face
    on_surface = set(cube.cells["triangle"].ravel())
    inner = next(i for i in range(len(cube.points)) if i not in on_surface)
    cube.points[inner] = (25, 25, 25)
    made["tangled"] = cube.write("tangled")

    cube = Cube()
    cube.points[:, 2] = 0
    made["flat"] = cube.write("flat")

    cube = Cube()
    cube.names = [(dim, 3, name) for dim, tag, name in cube.names]
    made["two_names"] = cube.write("two_names")

    cube = Cube()
    cube.points *= 1e-3
    made["metres"] = cube.write("metres")

    cube = Cube()
    cube.points *= 1e3
    made["micrometres"] = cube.write("micrometres")

    cube = Cube()
    corners = np.array([(x, y, z) for z in (0, 10) for x, y in ((0, 0), (10, 0), (10, 10), (0, 10))], float)
    cube.points = corners
    cube.cells, cube.tags = {"hexahedron": np.array([range(8)])}, {"hexahedron": [3]}
    made["hexahedra"] = cube.write("hexahedra")

    cube = Cube()  # cells left of the middle get nodes of their own
    left = cube.points[cube.cells["tetra"]].mean(axis=1)[:, 0] < 5
    here, there = (set(cube.cells["tetra"][side].ravel()) for side in (left, ~left))
    twin = {n: len(cube.points) + i for i, n in enumerate(sorted(here & there))}
    cube.points = np.concatenate([cube.points, cube.points[sorted(twin)]])
    owner = {tuple(sorted(c[list(f)])): side for c, side in zip(cube.cells["tetra"], left)
             for f in itertools.combinations(range(4), 3)}
    renamed = np.vectorize(lambda n: twin.get(n, n))
    cube.cells["triangle"] = np.array([renamed(f) if owner[tuple(sorted(f))] else f for f in cube.cells["triangle"]])
    cube.cells["tetra"][left] = renamed(cube.cells["tetra"][left])
    made["torn"] = cube.write("torn")

    cube = Cube()
    corners = cube.cells["tetra"][0]
    outsider = next(n for n in range(len(cube.points)) if n not in corners)
    cube.cells["triangle"][3] = (*corners[:2], outsider)
    made["stray_facet"] = cube.write("stray_facet")

    cube = Cube()
    cube.cells["tetra"] = np.concatenate([cube.cells["tetra"], cube.cells["tetra"]])
    cube.tags["tetra"] = np.concatenate([cube.tags["tetra"], cube.tags["tetra"]])
    made["overlap"] = cube.write("overlap")

    cube = Cube()
    cube.cells["tetra"][5, 3] = cube.cells["tetra"][5, 0]
    made["node_twice"] = cube.write("node_twice")

    cube = Cube()
    cube.cells["tetra"][5, 3] = 98765
    made["no_such_node"] = cube.write("no_such_node")

    for name, value in ("nan", np.nan), ("inf", np.inf):
        cube = Cube()
        cube.points[4, 1] = value
        made[name] = cube.write(name)

    cube = Cube()  # one inner face is named
    inside = [f for c in cube.cells["tetra"] for f in itertools.combinations(sorted(c), 3)]
    twice = next(f for f in inside if inside.count(f) == 2)
    cube.cells["triangle"] = np.concatenate([cube.cells["triangle"], [twice]])
    airway = next(tag for _, tag, name in cube.names if name == "airway")
    cube.tags["triangle"] = np.append(cube.tags["triangle"], airway)
    made["named_inside"] = cube.write("named_inside")

    cube = Cube()
    cube.names = [(dim, tag, "depth" if name == "pleura" else name) for dim, tag, name in cube.names]
    made["petsc_name"] = cube.write("petsc_name")

    cube = Cube()  # a second body whose whole surface is pleura
    n = len(cube.points)
    pleura = next(tag for _, tag, name in cube.names if name == "pleura")
    cube.points = np.concatenate([cube.points, cube.points + (20, 0, 0)])
    for kind, tags in cube.tags.items():
        cube.cells[kind] = np.concatenate([cube.cells[kind], cube.cells[kind] + n])
        cube.tags[kind] = np.concatenate([tags, np.full_like(tags, pleura) if kind == "triangle" else tags])
    made["shut_body"] = cube.write("shut_body")

    cube = Cube()  # group 77 has the number of the airway for a name
    cube.names.append((2, 77, str(airway)))
    cube.tags["triangle"][np.flatnonzero(cube.tags["triangle"] == pleura)[0]] = 77
    made["other_number"] = cube.write("other_number")

    cube = Cube()  # pleura is the whole boundary, airway a part of it
    part = cube.cells["triangle"][cube.tags["triangle"] == airway]
    cube.cells["triangle"] = np.concatenate([cube.cells["triangle"], part])
    cube.tags["triangle"] = np.append(cube.tags["triangle"], [pleura] * len(part))
    made["whole_boundary"] = cube.write("whole_boundary")

    cube = Cube()  # half of the lung is in a group of its own, too
    half = cube.cells["tetra"][:50]
    cube.names.append((3, 99, "half"))
    cube.cells["tetra"] = np.concatenate([cube.cells["tetra"], half])
    cube.tags["tetra"] = np.append(cube.tags["tetra"], [99] * len(half))
    made["overlapping_parts"] = cube.write("overlapping_parts")

    def edited(name, *changes, of="good"):
        with open(made.get(of, of), "rb") as f:
            text = f.read()
        for old, new in changes:
            assert old in text, (name, old)
            text = text.replace(old, new, 1)
        made[name] = text_file(name + ".msh", text)

    edited("version_1", (b"2.2 0 8", b"1 0 8"))
    edited("version_4", (b"2.2 0 8", b"4 0 8"))
    edited("no_nodes", (b"$Nodes\n45\n", b"$Nodes\n0\n"))
    edited("many_nodes", (b"$Nodes\n45\n", b"$Nodes\n2000000000\n"))
    edited("negative_nodes", (b"$Nodes\n45\n", b"$Nodes\n-45\n"))
    edited("same_tag", (b"$Nodes\n45\n1 ", b"$Nodes\n45\n2 "))
    edited("huge_tag", (b"\n45 ", b"\n2000000001 "))
    edited("too_many_tags", (b" 2 2 ", b" 2 -2 "))
    edited("unknown_type", (b" 4 2 ", b" 44 2 "))
    edited("big_endian", (b"\1\0\0\0\n$EndM", b"\0\0\0\1\n$EndM"), of=pulmo.mesh("cube_msh22_binary.msh"))
    edited("twice_named", (b"1 1 0 0 1 1 1 1 1 0", b"1 1 0 0 1 1 1 2 1 2 0"), of=pulmo.mesh("cube_msh41_ascii.msh"))
    edited("stray_block", (b"\n2 1 2 4\n", b"\n2 9 2 4\n"), of=pulmo.mesh("cube_msh41_ascii.msh"))
    edited("parametric", (b"\n2 1 0 0\n", b"\n2 1 1 0\n"), of=pulmo.mesh("cube_msh41_ascii.msh"))
    for i, flavour in enumerate(("22_ascii", "22_binary", "41_ascii", "41_binary")):
        with open(pulmo.mesh(f"cube_msh{flavour}.msh"), "rb") as f:
            bytes_ = f.read()
        made["cut_" + flavour] = text_file(f"cut_{flavour}.msh", bytes_[:len(bytes_) * (2 * i + 3) // 10])
    with open(made["good"], "rb") as f:
        made["not_msh"] = text_file("mesh.txt", f.read())
    return made


def table(m):
    """name: (options, words of the sentence)."""
    def with_mesh(path):
        return NO_MESH + ["-dm_plex_filename", path]

    good = with_mesh(m["good"])
    blocked = text_file("blocked", b"a file where the directory should be\n")
    missing = pulmo.scratch("nowhere.msh")
    lung = pulmo.DIRECT + ["-dm_plex_filename", m["good"], "-airflow", "-chest_wall"]

    def file_of(name, text):
        return lung + ["-ventilator", "programme", "-ventilator_programme", text_file(name, text)]

    def options_of(name, text):
        return good + ["-options_file", text_file(name, text)]

    def values(name, data, option="-tissue_c"):
        path = pulmo.scratch(name + ".h5")
        with h5py.File(path, "w") as f:
            f[name] = data
        return [option, f"{path}:{name}"]

    some = np.full(100, 0.5)
    listed = values("some", some)[1]
    itself = ["-options_file", pulmo.scratch("itself.opts")]
    with open(itself[1], "w") as f:
        f.write(f"-airflow\n-options_file {itself[1]}\n")
    circle = ["-options_file", pulmo.scratch("circle.opts")]
    with open(circle[1], "w") as f:
        f.write("-options_file " + text_file("half_circle.opts", f"-options_file {circle[1]}\n".encode()) + "\n")

    return {
        # the mesh
        "no mesh": (NO_MESH, ["-dm_plex_filename FILE"]),
        "missing mesh": (with_mesh(missing), ["-dm_plex_filename", missing, "no such file"]),
        "empty mesh": (with_mesh(m["empty"]), ["-dm_plex_filename", m["empty"], "empty"]),
        "a folder as mesh": (with_mesh(m["folder"]), ["-dm_plex_filename", m["folder"]]),
        "junk mesh": (with_mesh(m["junk"]), [m["junk"], "not a readable mesh", "MSH"]),
        "text for a mesh": (with_mesh(m["text"]), [m["text"], "not a readable mesh", "MSH"]),
        "half a mesh": (with_mesh(m["half"]), [m["half"], "not a readable mesh", "MSH"]),
        "a mesh cut in its elements": (with_mesh(m["no_end"]), [m["no_end"], "not a readable mesh", "MSH"]),
        "mesh of no names": (with_mesh(m["nameless"]), [m["nameless"], "names no surface", "airway", "pleura"]),
        "mesh of numbers for names": (with_mesh(m["numbers"]), [m["numbers"], "'airway'", "it has 1, 2"]),
        "PETSc's scale": (good + ["-dm_plex_scale", "2"], ["-dm_plex_scale", "-mesh_scale"]),
        "PETSc's label of the boundary": (good + ["-dm_plex_boundary_label", "all"], ["-dm_plex_boundary_label", "leave"]),
        "a mesh that is not shared out": (good + ["-dm_distribute_overlap", "1"], ["-dm_distribute_overlap", "leave"]),
        "missing airway": (with_mesh(m["no_airway"]), [m["no_airway"], "'airway'", "-airflow_surfaces", "mouth", "pleura"]),
        "surface mesh": (with_mesh(m["surface_only"]), [m["surface_only"], "no volume", "mesh the volume"]),
        "quadratic mesh": (with_mesh(m["quadratic"]), [m["quadratic"], "higher order", "-order 1"]),
        "hexahedra": (with_mesh(m["hexahedra"]), [m["hexahedra"], "tetrahedra"]),
        "tangled mesh": (with_mesh(m["tangled"]), [m["tangled"], "folded", "same side", "mesh anew"]),
        "flat mesh": (with_mesh(m["flat"]), [m["flat"], "100 degenerate cells", "mesh anew"]),
        "mesh in metres": (with_mesh(m["metres"]), [m["metres"], "metres", "-mesh_scale 1000"]),
        "mesh in micrometres": (with_mesh(m["micrometres"]), [m["micrometres"], "micrometres", "-mesh_scale 0.001"]),
        "cut MSH 2.2": (with_mesh(m["cut_22_ascii"]), [m["cut_22_ascii"], "not a readable mesh", "line "]),
        "cut binary MSH 2.2": (with_mesh(m["cut_22_binary"]), [m["cut_22_binary"], "not a readable mesh", "byte "]),
        "cut MSH 4.1": (with_mesh(m["cut_41_ascii"]), [m["cut_41_ascii"], "not a readable mesh", "line "]),
        "cut binary MSH 4.1": (with_mesh(m["cut_41_binary"]), [m["cut_41_binary"], "not a readable mesh", "byte "]),
        "a mesh of another machine": (with_mesh(m["big_endian"]), [m["big_endian"], "not a readable mesh", "byte order"]),
        "a mesh with another ending": (with_mesh(m["not_msh"]), [m["not_msh"], "not a readable mesh", ".msh"]),
        "an old mesh format": (with_mesh(m["version_1"]), [m["version_1"], "MSH 1;", "save it as 2.2 or 4.1"]),
        "an unusual mesh format": (with_mesh(m["version_4"]), [m["version_4"], "MSH 4;", "save it as 2.2 or 4.1"]),
        "a mesh of no nodes": (with_mesh(m["no_nodes"]), [m["no_nodes"], "$EndNodes", "line "]),
        "more nodes than there are": (with_mesh(m["many_nodes"]), [m["many_nodes"], "more nodes announced"]),
        "a negative number of nodes": (with_mesh(m["negative_nodes"]), [m["negative_nodes"], "more nodes announced"]),
        "a node's number twice": (with_mesh(m["same_tag"]), [m["same_tag"], "the tag 2 to two nodes", "save it anew"]),
        "a huge number of a node": (with_mesh(m["huge_tag"]), [m["huge_tag"], "too many gaps", "renumber"]),
        "a cell of a node that is not there": (with_mesh(m["no_such_node"]), [m["no_such_node"], "node 98766", "save it anew"]),
        "a coordinate that is no number": (with_mesh(m["nan"]), [m["nan"], "no finite number for a coordinate", "line "]),
        "a node at infinity": (with_mesh(m["inf"]), [m["inf"], "no finite number for a coordinate", "line "]),
        "a node twice in a cell": (with_mesh(m["node_twice"]), [m["node_twice"], "uses a node twice", "mesh anew"]),
        "every cell twice": (with_mesh(m["overlap"]), [m["overlap"], "overlap", "the same nodes", "remove one"]),
        "a facet of no cell": (with_mesh(m["stray_facet"]), [m["stray_facet"], "facet 4", "no face of a tetrahedron",
                                                             "mesh surface and volume together"]),
        "a torn mesh": (with_mesh(m["torn"]), [m["torn"], "torn", "Coherence Mesh"]),
        "a negative number of tags": (with_mesh(m["too_many_tags"]), [m["too_many_tags"], "number of tags", "line "]),
        "an element of no known type": (with_mesh(m["unknown_type"]), [m["unknown_type"], "unknown type", "line "]),
        "a surface in two groups of MSH 4.1": (with_mesh(m["twice_named"]),
                                               [m["twice_named"], "two groups, 'airway' (100 % of its area) and 'pleura' (16.7 %)",
                                                "-mesh_prefer airway"]),
        "a surface in two groups of MSH 2.2": (with_mesh(m["whole_boundary"]),
                                               ["14 facets (100 mm^2) in two groups",
                                                "'airway' (100 % of its area) and 'pleura' (16.7 %)", "-mesh_prefer airway"]),
        "a name to prefer that is not there": (with_mesh(m["good"]) + ["-mesh_prefer", "trachea"],
                                               ["no surface 'trachea'", "-mesh_prefer", "airway, pleura"]),
        "a block of no surface": (with_mesh(m["stray_block"]), [m["stray_block"], "surface 9", "groups", "MSH 2.2"]),
        "parametric nodes": (with_mesh(m["parametric"]), [m["parametric"], "parametric", "Mesh.SaveParametric 0"]),
        "two names for a group": (with_mesh(m["two_names"]), [m["two_names"], "two names for one group", "line "]),
        "PETSc's name for a surface": (with_mesh(m["petsc_name"]), [m["petsc_name"], "'depth'", "another name"]),
        "a surface within the volume": (with_mesh(m["named_inside"]), [m["named_inside"], "'airway'", "-airflow_surfaces",
                                                                       "inside the volume", "boundary only"]),
        "another group's number for a name": (with_mesh(m["other_number"]),
                                              [m["other_number"], "group 77", "the number of another one ('airway')"]),
        "a body without an airway": (with_mesh(m["shut_body"]) + ["-mesh_scale", "1"],
                                     [m["shut_body"], "the body around (2", "-airflow_surfaces", "name its opening"]),
        # parameters that differ from place to place
        "a value of no part of the mesh": (good + ["-tissue_c", "0.36,lobe=0.7"],
                                           ["-tissue_c", "no volume and no surface 'lobe'", "it has: lung, airway, pleura"]),
        "a part before the value of the rest": (good + ["-tissue_c", "lung=0.7"],
                                                ["-tissue_c begins with the value (kPa)", "1,lung=0.7"]),
        "a value of no name": (good + ["-tissue_c", "0.36,=0.7"], ["-tissue_c", "'=0.7' is no name=value", "right=2"]),
        "a list of another length for a part": (good + ["-viscoelastic", "-viscoelastic_moduli", "0.2,0.1,lung=0.3", "-viscoelastic_times", "1,2"],
                                                ["-viscoelastic_moduli has 1 numbers for 'lung' and 2 for all that is not named"]),
        "a list of a part before that of the rest": (good + ["-viscoelastic", "-viscoelastic_moduli", "lung=0.3,0.2"],
                                                     ["-viscoelastic_moduli begins with the numbers (-)", "lung=0.3,0.2"]),
        "a list too long": (good + ["-viscoelastic", "-viscoelastic_moduli", "1,1,1,1,1,1,1"], ["-viscoelastic_moduli takes up to 6 numbers, not 7"]),
        "a list that names a part twice": (good + ["-viscoelastic", "-viscoelastic_moduli", "1,1,1,a=1,1,1,a=2,2,2"],
                                           ["-viscoelastic_moduli names 'a' twice"]),
        "branches without a time": (good + ["-viscoelastic", "-viscoelastic_moduli", "0.2"], ["-viscoelastic_moduli has 1 numbers and -viscoelastic_times 3"]),
        "memory of no effect": (good + ["-output_fields_memory", "all"], ["-output_fields_memory", "no effect of this scene remembers"]),
        "memory of another name": (good + ["-viscoelastic", "-output_fields_memory", "overstress"],
                                   ["-output_fields_memory", "'overstress'", "overstress_3_xy_kPa"]),
        "memory of all and of one more": (good + ["-viscoelastic", "-output_fields_memory", "all,overstress_1_xx_kPa"],
                                          ["-output_fields_memory", "'all' stands alone"]),
        "a part without its value": (good + ["-tissue_c", "0.36,lung=0.7,pleura"], ["'pleura' is no name=value"]),
        "an empty value of a part": (good + ["-tissue_c", "0.36,lung="], ["-tissue_c (lung) takes a number (kPa), not ''"]),
        "only a sign of equality": (good + ["-tissue_c", "="], ["-tissue_c", "begins with the value"]),
        "a value that is no number for a part": (good + ["-tissue_c", "0.36,lung=nan"], ["-tissue_c (lung) takes a number", "'nan'"]),
        "a value out of range for a part": (good + ["-tissue_c", "0.36,lung=-1"],
                                            ["-tissue_c (lung) -1 (kPa) is out of range", "> 0"]),
        "a value out of range beside a part": (good + ["-tissue_c", "0,lung=1"], ["-tissue_c 0 (kPa) is out of range"]),
        "a part twice": (good + ["-tissue_c", "0.36,lung=1,lung=2"], ["-tissue_c names 'lung' twice"]),
        "parts that overlap": (with_mesh(m["overlapping_parts"]) + ["-tissue_c", "0.36,lung=1,half=2"],
                               ["-tissue_c", "'lung' and 'half' share cells", "do not overlap"]),
        "a surface where nothing reads it": (good + ["-tissue_c", "0.36,airway=1"],
                                             ["-tissue_c", "nothing reads it on surface 'airway'"]),
        "another surface of an option of one": (good + ["-chest_wall_stiffness_pleura", "0.1,airway=0.2"],
                                                ["-chest_wall_stiffness_pleura", "nothing reads it on surface 'airway'"]),
        "a part of a number that is no parameter": (good + ["-ventilator_pip", "6,lung=7"],
                                                    ["-ventilator_pip takes one number", "no parameter of a tissue law"]),
        "a part of an option of another law": (good + ["-tissue", "yoshihara", "-tissue_c1", "1,lung=2"], ["-tissue_c1"]),
        "no file of values": (good + ["-tissue_c", missing + ":c"], ["-tissue_c", missing + ":c", "no such file"]),
        "a mesh for a file of values": (good + ["-tissue_c", m["good"] + ":c"], ["-tissue_c", "not HDF5", "FILE.h5:dataset"]),
        "no dataset of that name": (good + ["-tissue_c", listed[:-4] + "c"], ["-tissue_c", "no such dataset; it has some"]),
        "values of another mesh": (good + values("few", some[1:]), ["-tissue_c", "99 values", m["good"], "100 tetrahedra"]),
        "a value that is no number in a dataset": (good + values("nan", np.where(np.arange(100) == 7, np.nan, some)),
                                                   ["-tissue_c", "value 7, counted from 0, is nan"]),
        "a value out of range in a dataset": (good + values("zero", np.where(np.arange(100) == 99, 0, some)),
                                              ["-tissue_c", "value 99", "is 0 (kPa)", "> 0"]),
        "a dataset of vectors": (good + values("vectors", np.ones((100, 3))), ["-tissue_c", "2 dimensions"]),
        "a dataset of text": (good + values("words", ["stiff"] * 100), ["-tissue_c", "holds no numbers"]),
        "an empty dataset": (good + values("empty", np.zeros(0)), ["-tissue_c", "is empty"]),
        "a dataset for a number that is no parameter": (good + values("pip", some, "-ventilator_pip"),
                                                        ["-ventilator_pip takes one number"]),
        # surfaces
        "unknown surface of the springs": (good + ["-chest_wall_surfaces", "pleura,trachea"],
                                           ["'trachea'", "-chest_wall_surfaces", "airway, pleura"]),
        "unknown surface of the support": (good + ["-support", "-support_surfaces", "diaphragm"],
                                           ["'diaphragm'", "-support_surfaces", "airway, pleura"]),
        "unknown surface of the traction": (good + ["-traction", "-traction_surfaces", "x1"],
                                            ["'x1'", "-traction_surfaces", "airway, pleura"]),
        "unknown surface of the cavity": (good + ["-cavity", "-cavity_surfaces", "chest"],
                                          ["'chest'", "-cavity_surfaces", "airway, pleura"]),
        "a cavity that is nowhere": (good + ["-cavity", "-cavity_file", "nowhere.stl"], ["-cavity_file nowhere.stl", "cannot be read"]),
        "a cavity that is no mesh": (good + ["-cavity", "-cavity_file", m["text"]], ["-cavity_file", "not a readable mesh"]),
        "a cavity that is text": (good + ["-cavity", "-cavity_file", text_file("words.stl", b"a wall, say\n" * 20)],
                                  ["-cavity_file", "no readable STL file"]),
        "a cavity with a hole": (good + ["-cavity", "-cavity_file", text_file("hole.stl", stl(FACETS[:-1]))],
                                 ["-cavity_file", "no closed surface", "3 edges of one triangle alone", "close its holes"]),
        "a cavity with a turned facet": (good + ["-cavity", "-cavity_file", text_file("turned.stl", stl(FACETS[:-1] + [FACETS[-1][::-1]]))],
                                         ["-cavity_file", "run the same way", "orient"]),
        "a lung outside of its cavity": (good + ["-cavity", "-cavity_file", text_file("small.stl", stl(FACETS))],
                                         ["-cavity_file", "not within the cavity", "mm outside at rest", "-cavity_scale"]),
        "a lung outside of a cavity with fluid": (good + ["-cavity", "-cavity_tension", "-cavity_file", text_file("wet.stl", stl(FACETS))],
                                                  ["-cavity_file", "not within the cavity", "mm outside at rest", "-cavity_scale"]),
        "a negative gap": (good + ["-cavity", "-cavity_gap", "-1"], ["-cavity_gap", "-1"]),
        "a gap by cell": (good + ["-cavity"] + values("gap", np.ones(100), "-cavity_gap"), ["-cavity_gap", "parts of the mesh"]),
        "a gap beside a file": (good + ["-cavity", "-cavity_file", text_file("with_gap.stl", stl(FACETS)), "-cavity_gap", "1"],
                                ["-cavity_gap", "without -cavity_file"]),
        "a gap beside tension": (good + ["-cavity", "-cavity_tension", "-cavity_gap", "1"], ["-cavity_gap", "-cavity_tension"]),
        "too coarse a wall": (good + ["-cavity", "-cavity_spacing", "1e3"], ["-cavity_spacing", "shape would be lost"]),
        "too fine a wall": (good + ["-cavity", "-cavity_spacing", "1e-3"], ["-cavity_spacing", "nodes"]),
        "a lung that only a wall holds": (good + ["-cavity", "-chest_wall", "off"], ["held in place by nothing", "does not touch"]),
        "a surface twice": (good + ["-chest_wall_surfaces", "pleura,pleura"], ["-chest_wall_surfaces", "'pleura' twice"]),
        "no surface in the list": (good + ["-airflow_surfaces", ","], ["-airflow_surfaces", "names nothing"]),
        # names of options
        "misspelt option": (good + ["-ventilator_pipp", "5"],
                            ["-ventilator_pipp", "did you mean -ventilator_pip?", "-help"]),
        "option of ours that is nothing": (good + ["-airflow_surfacing", "1"], ["-airflow_surfacing", "did you mean -airflow_surfaces?"]),
        "law's name as option": (good + ["-tissue_stiffness_of_everything", "1"], ["-tissue_stiffness_of_everything", "-help"]),
        "parameter of another law": (good + ["-tissue_lambda", "0.4"], ["-tissue_lambda", "-tissue berger"]),
        "parameter of another law than the one given": (good + ["-tissue", "yoshihara", "-tissue_kappa", "3"],
                                                        ["-tissue_kappa", "-tissue rausch"]),
        "option of an effect that is off": (good + ["-traction_value", "1,0,0"], ["-traction_value", "-traction"]),
        "support option without support": (good + ["-support_rigid"], ["-support_rigid", "-support"]),
        "misspelt name of an effect": (good + ["-tisue", "ma"], ["-tisue", "did you mean -tissue?"]),
        "misspelt prefix": (good + ["-ventilater_pip", "9"], ["-ventilater_pip", "did you mean -ventilator_pip?"]),
        "option without its prefix": (good + ["-permeability", "1"], ["-permeability", "did you mean -airflow_permeability?"]),
        "two dashes": (good + ["--ventilator_pip", "5"], ["--ventilator_pip", "did you mean -ventilator_pip?"]),
        "misspelt mesh": (NO_MESH + ["-dm_plex_filenam", m["good"]], ["-dm_plex_filenam", "did you mean -dm_plex_filename?"]),
        "misspelt solver": (good + ["-pc_tpye", "lu"], ["-pc_tpye", "did you mean -pc_type?"]),
        "misspelt duration": (good + ["-ts_maxtime", "1"], ["-ts_maxtime", "did you mean -ts_max_time?"]),
        "a word that follows a value": (good + ["-tissue", "ma", "berger"], ["'berger'", "-tissue", "belongs to no option"]),
        "a forgotten dash": (["ventilator", "pcv"] + good, ["'ventilator'", "belongs to no option"]),
        # values
        "not a number": (good + ["-ventilator_pip", "six"], ["-ventilator_pip", "number", "'six'", "cmH2O"]),
        "a number and more": (good + ["-airflow_permeability", "1e4mm"], ["-airflow_permeability", "number", "'1e4mm'"]),
        "no value": (good + ["-ventilator_peep"], ["-ventilator_peep", "number"]),
        "not a number at all": (good + ["-airflow_permeability", "nan"], ["-airflow_permeability", "number", "'nan'"]),
        "infinite": (good + ["-chest_wall_stiffness", "inf"], ["-chest_wall_stiffness", "number", "'inf'"]),
        "out of range": (good + ["-airflow_permeability", "-3"], ["-airflow_permeability", "-3", "out of range", "> 0"]),
        "porosity by its old name": (good + ["-airflow_porosity", "0.8"],
                                     ["-airflow_porosity", "is called -tissue_porosity now", "give -tissue_porosity 0.8"]),
        "a direction that is none": (good + ["-gravity", "-gravity_direction", "0,0,0"],
                                     ["-gravity_direction", "points nowhere", "0,-1,0"]),
        "porosity above one": (good + ["-tissue_porosity", "1.5"], ["-tissue_porosity", "1.5", "0 < value < 1"]),
        "scale of nothing": (good + ["-mesh_scale", "0"], ["-mesh_scale", "out of range", "1e-09 <="]),
        "scale beyond measure": (good + ["-mesh_scale", "1e300"], ["-mesh_scale", "1e300", "out of range"]),
        "minus infinity": (good + ["-ventilator_peep", "-inf"], ["-ventilator_peep", "number", "'-inf'"]),
        "a number too large": (good + ["-ventilator_pip", "1e400"], ["-ventilator_pip", "number", "'1e400'"]),
        "an empty value": (good + ["-ventilator_pip", ""], ["-ventilator_pip", "number", "''"]),
        "a comma for a point": (good + ["-ventilator_pip", "6,5"], ["-ventilator_pip", "number", "'6,5'"]),
        "negative stiffness of tissue": (good + ["-tissue_c1", "-1"], ["-tissue_c1", "-1", "out of range"]),
        "half a breath": (good + ["-ventilator_breaths", "1.5"], ["-ventilator_breaths", "whole number", "'1.5'"]),
        "no breath": (good + ["-ventilator_breaths", "0"], ["-ventilator_breaths", "out of range"]),
        "neither on nor off": (good + ["-airflow", "perhaps"], ["-airflow", "on or off", "'perhaps'"]),
        "two numbers for three": (good + ["-traction", "-traction_surfaces", "airway", "-traction_value", "1,2"],
                                  ["-traction_value", "three numbers", "'1,2'"]),
        "unknown elements": (good + ["-elements", "P2-P2"], ["-elements", "'P2-P2'", "P2-P1", "P3-P2"]),
        "error indicator of other elements": (good + ["-elements", "P3-P2", "-output_fields_error_indicator"],
                                              ["-output_fields_error_indicator", "-elements P2-P1"]),
        "rule too coarse for the elements": (good + ["-elements", "P3-P2", "-quadrature_degree", "3"],
                                             ["-quadrature_degree", "3", "out of range", "4"]),
        "damping of quadratic pressure": (good + ["-elements", "P3-P2", "-pressure_damping"], ["-pressure_damping", "linear", "P2-P1"]),
        "too few points for the stock integrator": (good + ["-elements", "P1-P1", "-petscfe_type", "basic"],
                                                    ["-petscfe_type basic", "-quadrature_degree 2"]),
        "unknown law": (good + ["-tissue", "steel"], ["-tissue", "'steel'", "berger", "rausch"]),
        "unknown ventilator": (good + ["-ventilator", "bellows"], ["-ventilator", "'bellows'", "pcv"]),
        "unknown permeability law": (good + ["-airflow_permeability_law", "magic"],
                                     ["-airflow_permeability_law", "'magic'", "constant"]),
        "unknown direction": (good + ["-chest_wall_direction", "sideways"],
                              ["-chest_wall_direction", "'sideways'", "full", "normal"]),
        "letters that are no axes": (good + ["-support", "-support_surfaces", "pleura", "-support_components_pleura", "w"],
                                     ["-support_components_pleura", "'w'", "x, y and z"]),
        "too high a quadrature": (good + ["-quadrature_degree", "40"], ["-quadrature_degree", "40", "out of range"]),
        # contradictions
        "ramp longer than inspiration": (good + ["-ventilator_ramp", "2"],
                                         ["-ventilator_ramp 2", "-ventilator_inspiration 1", "shorten"]),
        "ramp down longer than expiration": (good + ["-ventilator_ramp_down", "3"],
                                             ["-ventilator_ramp_down 3", "-ventilator_expiration 2", "shorten"]),
        "pip below peep": (good + ["-ventilator_peep", "8"],
                           ["-ventilator_pip 6", "-ventilator_peep 8", "raise pip or lower peep"]),
        "no inspiration": (good + ["-ventilator_inspiration", "0"], ["-ventilator_inspiration", "out of range", "> 0"]),
        "negative pause": (good + ["-ventilator_pause", "-1"], ["-ventilator_pause", "out of range"]),
        "lumen pressure without gas": (pulmo.DIRECT + ["-dm_plex_filename", m["good"], "-chest_wall", "-lumen_pressure"],
                                       ["-lumen_pressure", "-ventilator", "-airflow"]),
        "a traction on nothing": (good + ["-traction"], ["-traction", "-traction_surfaces"]),
        "a support that holds nothing": (good + ["-support"], ["-support", "-support_surfaces", "-support_rigid"]),
        "nothing holds the lung": (pulmo.DIRECT + ["-dm_plex_filename", m["good"], "-ventilator", "pcv"],
                                   ["-chest_wall", "-support_rigid"]),
        "nothing holds one of two bodies": (pulmo.DIRECT + bodies("stiff", "soft") +
                                            ["-ventilator", "pcv", "-airflow", "-chest_wall", "-chest_wall_surfaces", "stiff"],
                                            ["the body around (1", "held in place by nothing", "-chest_wall_surfaces",
                                             "-support_surfaces"]),
        # modes of the ventilator
        "pip of volume control": (lung + ["-ventilator", "vcv", "-ventilator_pip", "6"],
                                  ["-ventilator_pip", "no effect", "-ventilator pcv"]),
        "tidal volume of pressure control": (good + ["-ventilator_tidal_volume", "500"],
                                             ["-ventilator_tidal_volume", "no effect", "-ventilator vcv"]),
        "steps of volume control": (lung + ["-ventilator", "vcv", "-ventilator_steps", "3"],
                                    ["-ventilator_steps", "no effect", "-ventilator supersyringe"]),
        "peep of the supersyringe": (lung + ["-ventilator", "supersyringe", "-ventilator_peep", "3"],
                                     ["-ventilator_peep", "no effect", "-ventilator pcv or vcv"]),
        "inspiration of a programme": (file_of("fine.txt", b"a 1 hold\n") + ["-ventilator_inspiration", "1"],
                                       ["-ventilator_inspiration", "no effect"]),
        "gas on the wall of a lung that only pins hold": (
            lung + pulmo.PINS + ["-chest_wall", "off", "-ventilator", "pcv"],
            ["there is no equilibrium", "-support_rigid", "-lumen_pressure off", "-chest_wall", "-support_surfaces"]),
        "unknown split": (lung + ["-ventilator", "vcv", "-ventilator_flow_split", "fair"],
                          ["-ventilator_flow_split", "'fair'", "uniform", "common_pressure"]),
        "no tidal volume": (lung + ["-ventilator", "vcv", "-ventilator_tidal_volume", "0"],
                            ["-ventilator_tidal_volume", "out of range", "> 0"]),
        "half a step": (lung + ["-ventilator", "supersyringe", "-ventilator_steps", "1.5"],
                        ["-ventilator_steps", "whole number", "'1.5'"]),
        "ramp of flow longer than inspiration": (lung + ["-ventilator", "vcv", "-ventilator_ramp", "1.2"],
                                                 ["-ventilator_ramp 1.2", "-ventilator_inspiration 1", "shorten"]),
        "file without the mode": (good + ["-ventilator_programme", text_file("idle.txt", b"a 1 hold\n")],
                                  ["-ventilator_programme", "no effect", "-ventilator programme"]),
        "programme without a file": (lung + ["-ventilator", "programme"], ["-ventilator_programme FILE", "docs/ventilator.md"]),
        "missing programme": (lung + ["-ventilator", "programme", "-ventilator_programme", missing],
                              ["-ventilator_programme", missing, "check its name"]),
        "a folder as programme": (lung + ["-ventilator", "programme", "-ventilator_programme", m["folder"]],
                                  ["-ventilator_programme", m["folder"], "check its name"]),
        "empty programme": (file_of("empty.txt", b""), ["empty.txt holds no phase", "inspiration 1.0 pressure 15"]),
        "binary programme": (file_of("junk.bin", bytes(range(256)) * 20), ["junk.bin:", "holds bytes that are no text"]),
        "a wrong line": (file_of("wrong.txt", b"settle 1 pressure 5\n# fine so far\ninspiration 1 presure 15\n"),
                         ["wrong.txt:3:", "'presure'", "pressure, flow or hold"]),
        "a repeat without end": (file_of("open.txt", b"a 1 hold\nrepeat 3\nb 1 hold\n"), ["open.txt:2:", "'repeat'", "'end'"]),
        "tube without coefficients": (good + ["-tube"], ["-tube", "-tube_k1", "-tube_k2"]),
        "negative tube": (good + ["-tube", "-tube_k1", "-2"], ["-tube_k1", "-2", "out of range"]),
        "coefficient without tube": (good + ["-tube_k1", "2"], ["-tube_k1", "no effect", "-tube"]),
        "setting after its effect was turned off": (good + ["-airflow", "off", "-airflow_permeability", "3"],
                                                    ["-airflow_permeability (command line)", "-airflow is off (command line)"]),
        "setting beside a switch that is off": (lung + ["-traction_value", "1,0,0", "-traction", "off"],
                                                ["-traction_value", "-traction is off"]),
        "setting of a surface after its effect was turned off": (
            good + ["-chest_wall", "off", "-chest_wall_stiffness_airway", "1"],
            ["-chest_wall_stiffness_airway", "no effect", "-chest_wall is off"]),
        "setting of no ventilator": (good + ["-ventilator", "off", "-ventilator_pip", "3"],
                                     ["-ventilator_pip", "no effect", "-ventilator is off"]),
        "setting of an effect that a file turned off": (
            good + pulmo.PAPER + ["-lumen_pressure_surfaces", "airway"],
            ["-lumen_pressure_surfaces (command line)", "-lumen_pressure is off (", "paper.opts)"]),
        "tube without ventilator": (lung + ["-tube", "-tube_k1", "2"], ["-tube", "-ventilator"]),
        "trust region with a common pressure": (
            lung + ["-ventilator", "vcv", "-ventilator_flow_split", "common_pressure", "-snes_type", "newtontr"],
            ["-snes_type newtontr", "-ventilator_flow_split common_pressure", "-snes_type newtonls",
             "or -ventilator_flow_split uniform"]),
        "trust region with a tube": (good + ["-tube", "-tube_k1", "2", "-snes_type", "newtontr"],
                                     ["-snes_type newtontr does not go with -tube", "use -snes_type newtonls"]),
        "trust region with a limit": (
            file_of("limited.txt", b"inspiration 1 flow 100 limit 5\n") + ["-snes_type", "newtontr"],
            ["-snes_type newtontr does not go with a limit of pressure", "use -snes_type newtonls"]),
        "trust region with a volume of uniform gas": (
            lung + ["-airflow", "off", "-ventilator", "vcv", "-snes_type", "newtontr"],
            ["-snes_type newtontr does not go with a flow into a lung with -airflow off", "use -snes_type newtonls"]),
        "stock loops with a volume of uniform gas": (
            lung + ["-airflow", "off", "-ventilator", "vcv", "-petscfe_type", "basic"], ["-petscfe_type basic", "pulmo"]),
        # solver and time
        "no solver file": (pulmo.PCV + ["-dm_plex_filename", m["good"]], ["petsc_options/solvers/direct.opts", "-pc_type"]),
        "time integrator": (good + ["-ts_type", "cn"], ["-ts_type", "beuler"]),
        "order of BDF": (good + ["-ts_type", "bdf", "-ts_bdf_order", "3"], ["-ts_bdf_order 3", "order 2"]),
        "step backwards": (good + ["-ts_dt", "-0.1"], ["-ts_dt", "-0.1", "out of range", ">="]),
        "a word for a step": (good + ["-ts_dt", "short"], ["-ts_dt", "number", "short"]),
        "a word for a number of PETSc's": (good + ["-snes_rtol", "tiny"], ["-snes_rtol", "number", "tiny"]),
        "no time": (good + ["-ts_max_time", "0"], ["-ts_max_time"]),
        "a step of no length": (good + ["-ts_dt", "0"], ["-ts_dt", "0", "out of range"]),
        "a step below the clock's rounding": (good + ["-ts_dt", "1e-9"], ["-ts_dt", "1e-9", "out of range", ">= 1e-07"]),
        "an infinite step": (good + ["-ts_dt", "inf"], ["-ts_dt", "number", "'inf'"]),
        "no step": (good + ["-ts_dt"], ["-ts_dt", "number", "''"]),
        "an end that is no number": (good + ["-ts_max_time", "nan"], ["-ts_max_time", "number", "'nan'"]),
        "no Newton step": (good + ["-snes_max_it", "-3"], ["-snes_max_it", "-3", "out of range"]),
        "half a Newton step": (good + ["-snes_max_it", "2.5"], ["-snes_max_it", "whole number", "'2.5'"]),
        "a tolerance above one": (good + ["-ksp_rtol", "7"], ["-ksp_rtol", "7", "out of range", "0.99"]),
        "a negative refinement": (good + ["-dm_refine", "-1"], ["-dm_refine", "-1", "out of range"]),
        "a lag of nothing": (good + ["-snes_lag_jacobian", "0"], ["-snes_lag_jacobian", "0", "out of range"]),
        "no number for a number of PETSc's": (good + ["-snes_linesearch_damping", "nan"],
                                              ["-snes_linesearch_damping", "finite number", "'nan'"]),
        "a limit on steps": (good + ["-ts_max_steps", "5"], ["-ts_max_steps", "-ts_max_time"]),
        "another step control": (good + ["-ts_adapt_type", "none"], ["-ts_adapt_type"]),
        "a phase that ends between steps": (good + ["-ts_exact_final_time", "interpolate"],
                                            ["-ts_exact_final_time interpolate", "-ts_max_time"]),
        "a phase that ends after a step": (good + ["-ts_exact_final_time", "stepover"], ["-ts_exact_final_time stepover"]),
        "theta of another method": (good + ["-ts_theta_theta", "0.5"], ["-ts_theta_theta 0.5", "BDF2"]),
        "the endpoint form of theta": (good + ["-ts_theta_endpoint"], ["-ts_theta_endpoint", "BDF2"]),
        "a guess of PETSc's": (good + ["-ts_theta_initial_guess_extrapolate"],
                               ["-ts_theta_initial_guess_extrapolate", "-predictor_increments"]),
        "a limit on attempts": (good + ["-ts_max_reject", "3"], ["-ts_max_reject", "-ts_adapt_dt_min"]),
        "a limit on failures": (good + ["-ts_max_snes_failures", "1"], ["-ts_max_snes_failures", "-ts_adapt_dt_min"]),
        "a start of the clock": (good + ["-ts_init_time", "0.1"], ["-ts_init_time", "-restart"]),
        "a span of times": (good + ["-ts_time_span", "0,0.1,0.2"], ["-ts_time_span", "-ts_max_time"]),
        "an old name": (good + ["-ts_final_time", "1"], ["-ts_final_time", "-ts_max_time"]),
        "a split of the equations": (good + ["-ts_use_splitrhsfunction"], ["-ts_use_splitrhsfunction"]),
        "a tolerance of PETSc's for steps": (good + ["-ts_rtol", "1e-3"], ["-ts_rtol", "-step_volume_tolerance"]),
        "a safety of PETSc's for steps": (good + ["-ts_adapt_safety", "0.5"], ["-ts_adapt_safety", "-step_volume_tolerance"]),
        "a longest step that nothing chooses": (good + ["-ts_adapt_dt_max", "0.01"], ["-ts_adapt_dt_max", "-step_volume_tolerance"]),
        "a failed step as an error": (good + ["-ts_error_if_step_fails"], ["-ts_error_if_step_fails", "shorter"]),
        "states that PETSc keeps": (good + ["-ts_save_trajectory"], ["-ts_save_trajectory", "-output_fields_every"]),
        "a Newton method of one step": (good + ["-snes_type", "ksponly"], ["-snes_type ksponly", "newtonls"]),
        "a transposed step": (good + ["-snes_type", "ksptransposeonly"], ["-snes_type ksptransposeonly", "newtonls"]),
        "no test of convergence": (good + ["-snes_convergence_test", "skip"], ["-snes_convergence_test skip", "-snes_rtol"]),
        **{f"-snes_type {name}": (good + ["-snes_type", name], [f"-snes_type {name}", "cannot solve", "-npc_snes_type newtonls"])
           for name in ("anderson", "ngmres", "nrichardson", "ncg", "qn")},
        **{f"-snes_type {name}": (good + ["-snes_type", name], [f"-snes_type {name}", "cannot work here", "newtonls"])
           for name in ("fas", "ms", "nasm", "aspin", "ngs", "patch", "composite", "shell")},
        "a preconditioner of one step": (good + ["-snes_type", "anderson", "-npc_snes_type", "ksponly"], ["ksponly", "newtonls"]),
        "grids in sequence": (good + ["-snes_grid_sequence", "1"], ["-snes_grid_sequence", "-dm_refine"]),
        "a step that fails as an error": (good + ["-snes_error_if_not_converged"], ["-snes_error_if_not_converged", "shorter"]),
        "a block that fails as an error": (good + ["-fieldsplit_pressure_ksp_error_if_not_converged"],
                                           ["-fieldsplit_pressure_ksp_error_if_not_converged", "shorter"]),
        "a Jacobian that is never made": (good + ["-snes_lag_jacobian", "-1"], ["-snes_lag_jacobian -1", "-2 for once"]),
        "multigrid that is applied once": (good + ["-pc_type", "gamg"], ["-ksp_type preonly", "-pc_type gamg", "fgmres"]),
        "no matrix to factorise": (good + ["-snes_mf"], ["-snes_mf", "-snes_mf_operator"]),
        "a symmetric factorisation of the inverse": (
            good + ["-airflow", "off", "-prestress", "-prestress_method", "inverse", "-pc_type", "cholesky"],
            ["-pc_type cholesky", "-prestress_method inverse", "lu"]),
        "an unloaded shape that is hardly solved": (
            good + ["-prestress", "-prestress_method", "inverse", "-prestress_pressure", "2", "-snes_rtol", "0.5", "-snes_atol", "1"],
            ["-prestress_method inverse", "-snes_rtol"]),
        "a symmetric factorisation": (good + ["-pc_type", "cholesky"], ["-pc_type cholesky", "symmetric", "lu"]),
        **{f"a matrix {name}": (good + ["-dm_mat_type" if name == "is" else "-mat_type", name], [f"mat_type {name}", "leave the option out"])
           for name in ("is", "sbaij", "nest", "dense", "shell")},
        "vectors of a card": (good + ["-vec_type", "cuda"], ["-vec_type cuda", "leave the option out"]),
        "unknown solver type": (good + ["-pc_type", "lemon"], ["-pc_type", "'lemon'", "check its spelling"]),
        "unknown solver type of a block": (
            good + ["-pc_type", "fieldsplit", "-fieldsplit_pressure_pc_type", "lemon"],
            ["-fieldsplit_pressure_pc_type", "'lemon'", "check its spelling"]),
        "unknown way to split": (good + ["-ksp_type", "fgmres", "-pc_type", "fieldsplit", "-pc_fieldsplit_type", "banana"],
                          ["-pc_fieldsplit_type", "banana", "schur"]),
        "unknown Krylov method": (good + ["-ksp_type", "lemon"], ["-ksp_type", "'lemon'", "check its spelling"]),
        "unknown Newton method": (good + ["-snes_type", "lemon"], ["-snes_type", "'lemon'", "check its spelling"]),
        "unknown line search": (good + ["-snes_linesearch_type", "lemon"], ["Line Search", "lemon", "check its spelling"]),
        "unknown package": (good + ["-pc_factor_mat_solver_type", "superman"],
                            ["-pc_factor_mat_solver_type", "'superman'", "mumps"]),
        "fixed stress beside differences": (lung + pulmo.options_file("solvers/iterative.opts") + ["-ventilator", "pcv"] + ["-snes_fd_color"],
                                            ["-pc_fieldsplit_schur_precondition user", "-snes_fd_color", "leave it out"]),
        "p-multigrid of another matrix": (lung + pulmo.options_file("solvers/iterative.opts") + ["-ventilator", "pcv"] + ["-dm_mat_type", "baij"],
                                          ["p_multigrid", "-dm_mat_type"]),
        "blocks in another order": (lung + pulmo.options_file("solvers/iterative.opts") + ["-ventilator", "pcv", "-pc_fieldsplit_0_fields", "1"],
                                    ["-pc_fieldsplit_0_fields", "in this order"]),
        "unknown element type": (good + ["-petscfe_type", "cubist"], ["cubist"]),
        "unknown partitioner": (good + ["-petscpartitioner_type", "knife"], ["-petscpartitioner_type knife", "metis"]),
        "partitioner that this PETSc lacks": (good + ["-petscpartitioner_type", "chaco"], ["-petscpartitioner_type chaco", "metis"]),
        # files and folders
        "missing options file": (good + ["-options_file", pulmo.scratch("no.opts")], ["-options_file", "no.opts", "check its name"]),
        "an options file that asks for a missing one": (
            good + ["-options_file", text_file("asks.opts", b"# a comment\n-options_file not_here.opts\n-ts_dt 0.1\n")],
            ["-options_file", "not_here.opts"]),
        "a folder as options file": (good + ["-options_file", m["folder"]], ["-options_file", m["folder"], "check its name"]),
        "no name of an options file": (good + ["-options_file"], ["-options_file", "needs the name of a file"]),
        "missing solver file": (pulmo.PCV + ["-options_file", "petsc_options/solvers/none.opts"],
                                ["-options_file", "solvers/none.opts", "check its name"]),
        "an options file that asks for itself": (good + itself, ["-options_file", "itself.opts", "asks for itself"]),
        "two options files that ask for each other": (good + circle, ["-options_file", "circle.opts", "asks for itself",
                                                                      "through"]),
        "junk for options": (options_of("junk.opts", bytes(range(256)) * 8), ["junk.opts: line 1", "no text"]),
        "a mesh for options": (good + ["-options_file", m["good"]], ["good.msh: line 1", "no option"]),
        "a line without a dash": (options_of("dash.opts", b"# a comment\n-airflow\ntissue ma\n"),
                                  ["dash.opts: line 3", "'tissue'", "-name value"]),
        "two options on a line": (options_of("two.opts", b"-ts_dt 0.1\n-airflow -chest_wall\n"),
                                  ["two.opts: line 2", "-airflow and -chest_wall", "a line of its own"]),
        "two values on a line": (options_of("values.opts", b"-chest_wall_surfaces pleura, airway\n"),
                                 ["values.opts: line 1", "'airway'", "-chest_wall_surfaces"]),
        "an open quote": (options_of("quote.opts", b'-output_dir "here\n'), ["quote.opts: line 1", "quote"]),
        "a misspelt option in a file": (options_of("slip.opts", b"-chest_wall_stifness 0.1\n"),
                                        ["-chest_wall_stifness", "did you mean -chest_wall_stiffness?"]),
        "an option out of range in a file": (options_of("range.opts", b"-tissue_porosity 99\n"),
                                             ["-tissue_porosity", "99", "0 < value < 1"]),
        "an unreadable programme line by its number": (
            file_of("long.txt", b"a 1 hold\n" * 400 + b"inspiration 1 pressure 15 rampe 0.1\n"),
            ["long.txt:401:", "'rampe'", "'from', 'ramp', 'trigger', 'cycle', 'dt' and 'breath'"]),
        "a ramp longer than its phase": (file_of("ramp.txt", b"inspiration 1 pressure 15 ramp 2\n"),
                                         ["ramp.txt:1:", "ramp 2", "duration 1"]),
        "a phase of no duration": (file_of("zero.txt", b"inspiration 0 pressure 15\n"),
                                   ["zero.txt:1:", "duration 0", "must be positive"]),
        "a mesh as programme": (lung + ["-ventilator", "programme", "-ventilator_programme", m["good"]],
                                ["good.msh:1:", "starts with the phase's name"]),
        "output where a file is": (good + ["-output_dir", blocked], ["-output_dir", blocked, "cannot be written"]),
        "output below a file": (good + ["-output_dir", blocked + "/run"], ["-output_dir", blocked, "cannot be written"]),
        "no output directory": (good + ["-output_dir"], ["-output_dir", "needs a value"]),
    }


class InputErrors(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.table = table(meshes())

    def expect_one_sentence(self, case, words):
        said = f"{case.command}\n{case.tail()}"
        self.assertEqual(case.code, 1, said)
        lines = [line for line in case.err.splitlines() if "pulmo: error:" in line]
        self.assertEqual(len(lines), 1, said)
        self.assertTrue(lines[0].startswith("pulmo: error: "), said)
        for word in words:
            self.assertIn(word, lines[0], said)
        for noise in ("PETSC ERROR", "Segmentation", "MPI_ABORT", "terminate called", "Traceback", "Sanitizer",
                      "runtime error"):
            self.assertNotIn(noise, case.err + case.out, said)
        self.assertNotIn("%", re.sub(r"\d %", "", lines[0]), "a format that was not filled in")
        self.assertNotIn("time s", case.out, "the run had started")
        self.assertLess(case.seconds, LIMIT, said)

    def run_table(self, ranks, names):
        def run(name):
            options, _ = self.table[name]
            directory = pulmo.scratch()
            own = "-output_dir" in options
            case = pulmo.Case(options, ranks=ranks, directory="-" if own else directory, timeout=2 * LIMIT)
            return case, os.path.exists(directory)

        with ThreadPoolExecutor(4) as pool:  # starting takes longer than failing
            cases = list(pool.map(run, names))
        for name, (case, made) in zip(names, cases):
            _, words = self.table[name]
            with self.subTest(name, ranks=ranks):
                self.expect_one_sentence(case, words)
                self.assertFalse(made, f"{name}: an output directory was made")

    def test_the_unspoilt_mesh_runs(self):
        """Or every error above might have another cause."""
        case = pulmo.finished(NO_MESH + ["-dm_plex_filename", self.table["misspelt option"][0][-3], "-ts_max_time", "0.05"])
        self.assertEqual(case.json()["cells"], 100)

    def test_one_rank(self):
        self.run_table(1, list(self.table))

    def test_two_ranks(self):
        """Every second mistake, and all that are found once the mesh is shared out or by one rank for the other."""
        shared = {"tangled mesh", "flat mesh", "mesh in metres", "a body without an airway",
                  "a surface within the volume", "mesh of no names", "missing airway",
                  "missing mesh", "junk mesh", "a facet of no cell", "a torn mesh", "missing programme", "empty programme",
                  "a wrong line", "nothing holds the lung", "nothing holds one of two bodies",
                  "output where a file is", "output below a file", "parts that overlap", "values of another mesh",
                  "a value that is no number in a dataset"}
        self.assertLessEqual(shared, set(self.table))
        self.run_table(2, [name for i, name in enumerate(self.table) if i % 2 or name in shared])

    def test_every_rank_fails(self):
        """Each rank by itself, without the launcher's help."""
        for name in "misspelt option", "missing mesh", "junk mesh", "tangled mesh", "a wrong line", "missing options file":
            folder = os.path.dirname(pulmo.scratch())
            with self.subTest(name):
                run = '"$@"; echo $? > ' + folder + "/$OMPI_COMM_WORLD_RANK; exit 0"
                command = pulmo.LAUNCHER + ["2", "sh", "-c", run, "sh", pulmo.PROGRAM] + self.table[name][0]
                subprocess.run(command + ["-output_dir", folder + "/run"], cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT,
                               capture_output=True, timeout=2 * LIMIT, check=True)
                codes = {}
                for rank in os.listdir(folder):
                    with open(os.path.join(folder, rank)) as f:
                        codes[rank] = int(f.read())
                self.assertEqual(codes, {"0": 1, "1": 1})

    def test_a_scale_that_is_meant_is_taken(self):
        mesh_file = self.table["mesh in metres"][0][-1]
        case = pulmo.finished(NO_MESH + ["-dm_plex_filename", mesh_file, "-mesh_scale", "1000", "-ts_max_time", "0.05"])
        self.assertAlmostEqual(case.json()["reference_volume_ml"], 1, places=9)

    def test_a_finished_run_is_kept(self):
        good = self.table["misspelt option"][0][:-2] + ["-ts_max_time", "0.05"]
        first = pulmo.finished(good)

        def content():
            found = {}
            for name in first.files():
                with open(first.path(name), "rb") as f:
                    found[name] = f.read()
            return found

        before = content()
        for ranks in (1, 2):
            again = pulmo.Case(good, directory=first.directory, ranks=ranks)
            self.expect_one_sentence(again, ["-output_dir", first.directory, "finished run", "-output_overwrite"])
            self.assertEqual(content(), before)
        again = pulmo.finished(good + ["-output_overwrite", "-ts_max_time", "0.1"], directory=first.directory)
        self.assertEqual(len(again.signals()["time_s"]), 3)
        self.assertIn("summary.json", again.files())

    def test_the_working_directory_stays_clean(self):
        """The default output directory is not made on an error either."""
        folder = pulmo.scratch()
        os.mkdir(folder)
        case = pulmo.Case(self.table["misspelt option"][0], directory="-", cwd=folder)
        self.expect_one_sentence(case, ["-ventilator_pipp"])
        self.assertEqual(os.listdir(folder), [])

    def test_an_unused_petsc_option_is_a_warning(self):
        good = self.table["misspelt option"][0][:-2]
        case = pulmo.finished(good + ["-ts_max_time", "0.05", "-snes_mx_it", "3"])
        warnings = re.findall(r"^pulmo: warning: .*$", case.out, re.M)
        self.assertEqual(len(warnings), 1, case.out)
        self.assertIn("-snes_mx_it was not used", warnings[0])

    def test_a_load_below_the_tolerance_is_a_warning(self):
        good = pulmo.LITRE + pulmo.DIRECT + pulmo.SCENE
        for peak, warned in (("1e-9", True), ("1", False)):
            case = pulmo.finished(good + ["-ts_max_time", "0.05", "-ventilator", "pcv", "-ventilator_pip", peak])
            self.assertEqual("lower -snes_atol" in case.out, warned, case.out)

    def test_the_table_is_long_enough(self):
        self.assertGreaterEqual(len(self.table), 160)


if __name__ == "__main__":
    pulmo.main()
