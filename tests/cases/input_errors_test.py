#!/usr/bin/python3
"""Bad input ends at once, on all ranks, with one sentence that names what is wrong and what to do; nothing is written.

The table below is the list of what a user can get wrong: options of the run and words that the sentence must hold.
"""
import itertools
import os
import re
import unittest
from concurrent.futures import ThreadPoolExecutor

import meshio
import numpy as np

import pulmo_case as pulmo

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
        kinds = {"triangle": 2, "tetra": 4, "triangle6": 9, "tetra10": 11, "hexahedron": 5}
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

    cube = Cube()
    cube.cells["tetra"][7, :2] = cube.cells["tetra"][7, 1::-1]
    made["inverted"] = cube.write("inverted")

    cube = Cube()  # an inner vertex pulled through the opposite face
    on_surface = set(cube.cells["triangle"].ravel())
    inner = next(i for i in range(len(cube.points)) if i not in on_surface)
    cube.points[inner] = (25, 25, 25)
    made["tangled"] = cube.write("tangled")

    cube = Cube()
    cube.points[:, 2] = 0
    made["flat"] = cube.write("flat")

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
        "missing airway": (with_mesh(m["no_airway"]), [m["no_airway"], "'airway'", "-airflow_surfaces", "mouth", "pleura"]),
        "surface mesh": (with_mesh(m["surface_only"]), [m["surface_only"], "no volume", "mesh the volume"]),
        "quadratic mesh": (with_mesh(m["quadratic"]), [m["quadratic"], "higher order", "-order 1"]),
        "hexahedra": (with_mesh(m["hexahedra"]), [m["hexahedra"], "tetrahedra"]),
        "one cell inverted": (with_mesh(m["inverted"]), [m["inverted"], "1 inverted", "mesh anew"]),
        "tangled mesh": (with_mesh(m["tangled"]), [m["tangled"], "inverted", "mesh anew"]),
        "flat mesh": (with_mesh(m["flat"]), [m["flat"], "100 inverted or degenerate", "mesh anew"]),
        "mesh in metres": (with_mesh(m["metres"]), [m["metres"], "metres", "-mesh_scale 1000"]),
        "mesh in micrometres": (with_mesh(m["micrometres"]), [m["micrometres"], "micrometres", "-mesh_scale 0.001"]),
        # surfaces
        "unknown surface of the springs": (good + ["-chest_wall_surfaces", "pleura,trachea"],
                                           ["'trachea'", "-chest_wall_surfaces", "airway, pleura"]),
        "unknown surface of the support": (good + ["-support", "-support_surfaces", "diaphragm"],
                                           ["'diaphragm'", "-support_surfaces", "airway, pleura"]),
        "unknown surface of the traction": (good + ["-traction", "-traction_surfaces", "x1"],
                                            ["'x1'", "-traction_surfaces", "airway, pleura"]),
        "a surface twice": (good + ["-chest_wall_surfaces", "pleura,pleura"], ["-chest_wall_surfaces", "'pleura' twice"]),
        "no surface in the list": (good + ["-airflow_surfaces", ","], ["-airflow_surfaces", "names nothing"]),
        # names of options
        "misspelt option": (good + ["-ventilator_pipp", "5"],
                            ["-ventilator_pipp", "did you mean -ventilator_pip?", "-help"]),
        "option of ours that is nothing": (good + ["-airflow_porridge", "1"], ["-airflow_porridge", "did you mean -airflow_porosity?"]),
        "law's name as option": (good + ["-tissue_stiffness_of_everything", "1"], ["-tissue_stiffness_of_everything", "-help"]),
        "parameter of another law": (good + ["-tissue_lambda", "0.4"], ["-tissue_lambda", "-tissue berger"]),
        "parameter of another law than the one given": (good + ["-tissue", "yoshihara", "-tissue_kappa", "3"],
                                                        ["-tissue_kappa", "-tissue rausch"]),
        "option of an effect that is off": (good + ["-traction_value", "1,0,0"], ["-traction_value", "-traction"]),
        "support option without support": (good + ["-support_rigid"], ["-support_rigid", "-support"]),
        # values
        "not a number": (good + ["-ventilator_pip", "six"], ["-ventilator_pip", "number", "'six'", "cmH2O"]),
        "a number and more": (good + ["-airflow_permeability", "1e4mm"], ["-airflow_permeability", "number", "'1e4mm'"]),
        "no value": (good + ["-ventilator_peep"], ["-ventilator_peep", "number"]),
        "not a number at all": (good + ["-airflow_permeability", "nan"], ["-airflow_permeability", "number", "'nan'"]),
        "infinite": (good + ["-chest_wall_stiffness", "inf"], ["-chest_wall_stiffness", "number", "'inf'"]),
        "out of range": (good + ["-airflow_permeability", "-3"], ["-airflow_permeability", "-3", "out of range", "> 0"]),
        "porosity above one": (good + ["-airflow_porosity", "1.5"], ["-airflow_porosity", "1.5", "0 < value < 1"]),
        "scale of nothing": (good + ["-mesh_scale", "0"], ["-mesh_scale", "out of range", "> 0"]),
        "half a breath": (good + ["-ventilator_breaths", "1.5"], ["-ventilator_breaths", "whole number", "'1.5'"]),
        "no breath": (good + ["-ventilator_breaths", "0"], ["-ventilator_breaths", "out of range"]),
        "neither on nor off": (good + ["-airflow", "perhaps"], ["-airflow", "on or off", "'perhaps'"]),
        "two numbers for three": (good + ["-traction", "-traction_surfaces", "airway", "-traction_value", "1,2"],
                                  ["-traction_value", "three numbers", "'1,2'"]),
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
        "a split of no flow": (good + ["-ventilator_flow_split", "uniform"], ["-ventilator_flow_split", "no effect"]),
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
        "binary programme": (file_of("junk.bin", bytes(range(256)) * 20), ["junk.bin:", "starts with the phase's name"]),
        "a wrong line": (file_of("wrong.txt", b"settle 1 pressure 5\n# fine so far\ninspiration 1 presure 15\n"),
                         ["wrong.txt:3:", "'presure'", "pressure, flow or hold"]),
        "a repeat without end": (file_of("open.txt", b"a 1 hold\nrepeat 3\nb 1 hold\n"), ["open.txt:2:", "'repeat'", "'end'"]),
        "tube without coefficients": (good + ["-tube"], ["-tube", "-tube_k1", "-tube_k2"]),
        "negative tube": (good + ["-tube", "-tube_k1", "-2"], ["-tube_k1", "-2", "out of range"]),
        "coefficient without tube": (good + ["-tube_k1", "2"], ["-tube_k1", "no effect", "-tube"]),
        "tube without ventilator": (lung + ["-tube", "-tube_k1", "2"], ["-tube", "-ventilator"]),
        "trust region with a common pressure": (
            lung + ["-ventilator", "vcv", "-ventilator_flow_split", "common_pressure", "-snes_type", "newtontr"],
            ["-snes_type", "newtonls"]),
        "trust region with a tube": (good + ["-tube", "-tube_k1", "2", "-snes_type", "newtontr"],
                                     ["-snes_type", "newtonls"]),
        "stock loops with a volume of uniform gas": (
            lung + ["-airflow", "off", "-ventilator", "vcv", "-petscfe_type", "basic"], ["-petscfe_type basic", "pulmo"]),
        # solver and time
        "no solver file": (pulmo.PCV + ["-dm_plex_filename", m["good"]], ["petsc_options/solvers/direct.opts", "-pc_type"]),
        "time integrator": (good + ["-ts_type", "bdf"], ["-ts_type", "beuler"]),
        "step backwards": (good + ["-ts_dt", "-0.1"], ["-ts_dt", "positive"]),
        "a word for a step": (good + ["-ts_dt", "short"], ["-ts_dt", "number", "short"]),
        "a word for a number of PETSc's": (good + ["-snes_rtol", "tiny"], ["-snes_rtol", "number", "tiny"]),
        "no time": (good + ["-ts_max_time", "0"], ["-ts_max_time"]),
        "a limit on steps": (good + ["-ts_max_steps", "5"], ["-ts_max_steps", "-ts_max_time"]),
        "another step control": (good + ["-ts_adapt_type", "none"], ["-ts_adapt_type"]),
        "unknown solver type": (good + ["-pc_type", "lemon"], ["lemon"]),
        "unknown element type": (good + ["-petscfe_type", "cubist"], ["cubist"]),
        "unknown partitioner": (good + ["-petscpartitioner_type", "knife"], ["knife"]),
        # files and folders
        "missing options file": (good + ["-options_file", pulmo.scratch("no.opts")], ["-options_file", "no.opts", "check its name"]),
        "an options file that asks for a missing one": (
            good + ["-options_file", text_file("asks.opts", b"# a comment\n-options_file not_here.opts\n-ts_dt 0.1\n")],
            ["-options_file", "not_here.opts"]),
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
        self.assertNotIn(case.code, (0, None), said)
        self.assertGreater(case.code, 0, f"killed by a signal: {said}")
        lines = [line for line in case.err.splitlines() if "pulmo: error:" in line]
        self.assertEqual(len(lines), 1, said)
        self.assertTrue(lines[0].startswith("pulmo: error: "), said)
        for word in words:
            self.assertIn(word, lines[0], said)
        for noise in ("PETSC ERROR", "Segmentation", "MPI_ABORT", "terminate called", "Traceback"):
            self.assertNotIn(noise, case.err + case.out, said)
        self.assertNotIn("%", lines[0].replace("20 %", ""), "a format that was not filled in")
        self.assertNotIn("time s", case.out, "the run had started")
        self.assertLess(case.seconds, LIMIT, said)

    def run_table(self, ranks):
        def run(entry):
            options, _ = entry
            directory = pulmo.scratch()
            own = "-output_dir" in options
            case = pulmo.Case(options, ranks=ranks, directory="-" if own else directory, timeout=2 * LIMIT)
            return case, os.path.exists(directory)

        with ThreadPoolExecutor(4) as pool:  # starting takes longer than failing
            cases = list(pool.map(run, self.table.values()))
        for (name, (_, words)), (case, made) in zip(self.table.items(), cases):
            with self.subTest(name, ranks=ranks):
                self.expect_one_sentence(case, words)
                self.assertFalse(made, f"{name}: an output directory was made")

    def test_the_unspoilt_mesh_runs(self):
        """Or every error above might have another cause."""
        case = pulmo.finished(NO_MESH + ["-dm_plex_filename", self.table["misspelt option"][0][5], "-ts_max_time", "0.05"])
        self.assertEqual(case.json()["cells"], 100)

    def test_one_rank(self):
        self.run_table(1)

    def test_two_ranks(self):
        self.run_table(2)

    def test_a_scale_that_is_meant_is_taken(self):
        mesh_file = self.table["mesh in metres"][0][-1]
        case = pulmo.finished(NO_MESH + ["-dm_plex_filename", mesh_file, "-mesh_scale", "1000", "-ts_max_time", "0.05"])
        self.assertAlmostEqual(case.json()["reference_volume_ml"], 1, places=9)

    def test_a_finished_run_is_kept(self):
        good = self.table["misspelt option"][0][:6] + ["-ts_max_time", "0.05"]
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
        results = os.path.join(pulmo.SOURCE, "results")
        before = sorted(os.listdir(results)) if os.path.isdir(results) else None
        case = pulmo.Case(self.table["misspelt option"][0], directory="-")
        self.expect_one_sentence(case, ["-ventilator_pipp"])
        self.assertEqual(sorted(os.listdir(results)) if os.path.isdir(results) else None, before)

    def test_an_unused_petsc_option_is_a_warning(self):
        good = self.table["misspelt option"][0][:6]
        case = pulmo.finished(good + ["-ts_max_time", "0.05", "-snes_mx_it", "3"])
        warnings = re.findall(r"^pulmo: warning: .*$", case.out, re.M)
        self.assertEqual(len(warnings), 1, case.out)
        self.assertIn("-snes_mx_it was not used", warnings[0])

    def test_the_table_is_long_enough(self):
        self.assertGreaterEqual(len(self.table), 25)


if __name__ == "__main__":
    pulmo.main()
