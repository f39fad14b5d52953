#!/usr/bin/python3
"""Bad input: one sentence that names the option or file and the mend, a non-zero exit, nothing written.

A row of BAD: a name, the options after the good scene, words that the sentence must hold.
"""
import os
import subprocess
import unittest

import pulmo_case as pulmo

GOOD = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE
SOLVER = pulmo.DIRECT


def file_with(name, content, mode="w"):
    path = pulmo.scratch(name)
    with open(path, mode) as f:
        f.write(content)
    return path


def ascii_cube():
    with open(pulmo.mesh("cube_msh22_ascii.msh")) as f:
        return f.read()


def section(text, name):
    """Begin and end of the lines between $name and $Endname."""
    lines = text.splitlines()
    return lines, lines.index("$" + name) + 1, lines.index("$End" + name)


def cube_without_names():
    lines, begin, end = section(ascii_cube(), "PhysicalNames")
    return "\n".join(lines[:begin - 1] + lines[end + 1:]) + "\n"


def cube_with(change_line, name):
    """The cube with every line of a section passed through change_line(list of words)."""
    lines, begin, end = section(ascii_cube(), name)
    for i in range(begin + 1, end):
        lines[i] = " ".join(change_line(lines[i].split()))
    return "\n".join(lines) + "\n"


def inverted_cube():
    """One tetrahedron with two corners swapped."""
    done = []

    def swap(words):
        if words[1] == "4" and not done:
            words[-1], words[-2] = words[-2], words[-1]
            done.append(True)
        return words
    return cube_with(swap, "Elements")


def cube_in_metres():
    return cube_with(lambda w: [w[0]] + [repr(float(v) / 1000) for v in w[1:]], "Nodes")


def flat_mesh():
    """A square of two triangles."""
    return ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n1\n2 1 \"airway\"\n$EndPhysicalNames\n$Nodes\n4\n"
            "1 0 0 0\n2 1 0 0\n3 1 1 0\n4 0 1 0\n$EndNodes\n$Elements\n2\n1 2 2 1 1 1 2 3\n2 2 2 1 1 1 3 4\n$EndElements\n")


def quadratic_cube():
    """The cube with elements of order 2, by gmsh."""
    path = pulmo.scratch("quadratic.msh")
    subprocess.run(["gmsh", "-v", "0", "-order", "2", "-3", "-format", "msh22", "-o", path,
                    pulmo.mesh("cube_msh22_ascii.msh")], check=True, capture_output=True)
    return path


def on(path):
    return ["-dm_plex_filename", path]


def bad_inputs():
    with open(pulmo.mesh("cube_msh41_binary.msh"), "rb") as f:
        half = f.read()
    ramp_long = ["-ventilator_ramp", "2", "-ventilator_inspiration", "1"]
    return [
        ("no mesh", SOLVER, ["-dm_plex_filename"]),
        ("missing mesh", GOOD + on("/no/such/mesh.msh"), ["/no/such/mesh.msh", "no such file"]),
        ("empty mesh", GOOD + on(file_with("empty.msh", "")), ["empty.msh", "empty"]),
        ("junk mesh", GOOD + on(file_with("junk.msh", os.urandom(3000), "wb")), ["junk.msh", "not a readable mesh", "gmsh"]),
        ("text that is no mesh", GOOD + on(file_with("text.msh", "hello\nlung\n")), ["text.msh", "not a readable mesh"]),
        ("truncated mesh", GOOD + on(file_with("half.msh", half[:len(half) // 2], "wb")), ["half.msh", "not a readable mesh"]),
        ("mesh without names", GOOD + on(file_with("nameless.msh", cube_without_names())), ["nameless.msh", "surface"]),
        ("flat mesh", GOOD + on(file_with("flat.msh", flat_mesh())), ["flat.msh", "volume"]),
        ("quadratic mesh", GOOD + on(quadratic_cube()), ["quadratic.msh", "-order 1"]),
        ("inverted cell", GOOD + on(file_with("inverted.msh", inverted_cube())), ["inverted.msh", "1 inverted", "mm"]),
        ("no airway in the mesh", GOOD + on(pulmo.mesh("cube.msh")), ["'airway'", "-airflow_surfaces", "x0"]),
        ("unknown surface", GOOD + ["-chest_wall_surfaces", "plura"], ["'plura'", "-chest_wall_surfaces", "pleura"]),
        ("surface named twice", GOOD + ["-chest_wall_surfaces", "pleura,pleura"], ["-chest_wall_surfaces", "twice"]),
        ("mesh in metres", SOLVER + pulmo.PCV + on(file_with("metres.msh", cube_in_metres())), ["-mesh_scale 1000"]),
        ("unknown option", GOOD + ["-tissue_stiffness", "3"], ["-tissue_stiffness"]),
        ("misspelt option", GOOD + ["-ventilator_piip", "8"], ["-ventilator_piip", "did you mean -ventilator_pip"]),
        ("out of range", GOOD + ["-airflow_porosity", "1.2"], ["-airflow_porosity", "out of range"]),
        ("negative permeability", GOOD + ["-airflow_permeability", "-1"], ["-airflow_permeability", "> 0"]),
        ("not a number", GOOD + ["-chest_wall_stiffness", "soft"], ["-chest_wall_stiffness", "number", "kPa/mm"]),
        ("NaN", GOOD + ["-ventilator_pip", "nan"], ["-ventilator_pip", "number"]),
        ("number with unit", GOOD + ["-ventilator_pip", "6cmH2O"], ["-ventilator_pip", "number"]),
        ("no value", GOOD + ["-mesh_scale"], ["-mesh_scale", "number"]),
        ("half a breath", GOOD + ["-ventilator_breaths", "1.5"], ["-ventilator_breaths", "whole number"]),
        ("neither on nor off", GOOD + ["-airflow", "perhaps"], ["-airflow", "on or off"]),
        ("unknown law", GOOD + ["-tissue", "rubber"], ["-tissue", "rubber", "birzle"]),
        ("parameter of another law", GOOD + ["-tissue", "yoshihara", "-tissue_kappa", "3"], ["-tissue_kappa", "-tissue rausch"]),
        ("unknown ventilator", GOOD + ["-ventilator", "bag"], ["-ventilator", "bag", "pcv"]),
        ("setting of an effect that is not on", SOLVER + pulmo.CUBE + ["-chest_wall", "-ventilator_pip", "8"],
         ["-ventilator_pip", "-ventilator pcv"]),
        ("ramp longer than inspiration", GOOD + ramp_long, ["-ventilator_ramp", "-ventilator_inspiration"]),
        ("pip below peep", GOOD + ["-ventilator_peep", "8"], ["-ventilator_pip", "-ventilator_peep"]),
        ("no inspiration", GOOD + ["-ventilator_inspiration", "0"], ["-ventilator_inspiration", "> 0"]),
        ("no solver", pulmo.PCV + pulmo.CUBE, ["direct.opts"]),
        ("missing options file", GOOD + ["-options_file", "/no/such.opts"], ["-options_file", "/no/such.opts"]),
        ("unknown time stepper", GOOD + ["-ts_type", "bdf"], ["-ts_type", "beuler"]),
        ("no step", GOOD + ["-ts_dt", "-0.1"], ["-ts_dt"]),
        ("nothing holds the lung", GOOD + ["-chest_wall", "off"], ["-chest_wall", "-support_rigid"]),
        ("support of nothing", GOOD + ["-support"], ["-support_surfaces", "-support_rigid"]),
        ("support of no component", GOOD + ["-support", "-support_surfaces", "pleura", "-support_components_pleura", "u"],
         ["-support_components_pleura", "x, y and z"]),
        ("traction on nothing", GOOD + ["-traction"], ["-traction_surfaces"]),
        ("traction of two numbers", GOOD + ["-traction", "-traction_surfaces", "pleura", "-traction_value", "1,2"],
         ["-traction_value", "three numbers"]),
        ("pressure of no gas", SOLVER + pulmo.CUBE + ["-chest_wall", "-lumen_pressure"], ["-lumen_pressure", "-ventilator"]),
    ]


class InputErrors(unittest.TestCase):
    def expect_refused(self, name, options, words, ranks, directory=None):
        case = pulmo.Case(options, ranks=ranks, directory=directory, timeout=60)
        with self.subTest(case=name, ranks=ranks):
            said = [line for line in (case.err + case.out).splitlines() if line.startswith("pulmo: error: ")]
            self.assertNotEqual(case.code, 0, case.tail())
            self.assertEqual(len(set(said)), 1, case.tail())
            for word in words:
                self.assertIn(word, said[0])
            self.assertNotIn("PETSC ERROR", case.err, case.tail())
            self.assertNotIn("Caught signal", case.err, case.tail())
            self.assertLess(len(said[0]), 500)
            return case

    def test_one_rank(self):
        for name, options, words in bad_inputs():
            case = self.expect_refused(name, options, words, 1)
            self.assertFalse(os.path.exists(case.directory), name)

    def test_two_ranks(self):
        for name, options, words in bad_inputs():
            case = self.expect_refused(name, options, words, 2)
            self.assertFalse(os.path.exists(case.directory), name)

    def test_finished_run_is_kept(self):
        first = pulmo.finished(GOOD + ["-ts_max_time", "0.05"])
        before = {f: os.stat(first.path(f)).st_mtime_ns for f in first.files()}
        self.expect_refused("finished run", GOOD + ["-ts_max_time", "0.05"], ["-output_dir", "-output_overwrite"], 2,
                            first.directory)
        self.assertEqual(before, {f: os.stat(first.path(f)).st_mtime_ns for f in first.files()})
        again = pulmo.finished(GOOD + ["-ts_max_time", "0.1", "-output_overwrite"], directory=first.directory)
        self.assertAlmostEqual(again.signals()["time_s"][-1], 0.1)

    def test_directory_that_cannot_be_written(self):
        blocked = file_with("occupied", "a file stands here\n")
        self.expect_refused("file in the way", GOOD, ["-output_dir", blocked], 1, blocked)
        with open(blocked) as f:
            self.assertEqual(f.read(), "a file stands here\n")

    def test_unused_petsc_option_is_a_warning(self):
        case = pulmo.finished(GOOD + ["-ts_max_time", "0.05", "-snes_maxx_it", "3"])
        self.assertIn("-snes_maxx_it was not used", case.out)


if __name__ == "__main__":
    pulmo.main()
