#!/usr/bin/python3
"""What holds a lung: rigid motions that are left free, pins against just these, values prescribed twice."""
import re
import unittest

import numpy as np

import case_meshes
import pulmo_case as pulmo

SCENE = pulmo.DIRECT + pulmo.QUIET + ["-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", 4, "-ts_dt", 0.5,
                                      "-ts_max_time", 1, "-ventilator_settle", "off"]
BLOCK = SCENE + pulmo.BLOCK  # a cube of 100 mm
ROLLER = ["-support", "-support_surfaces", "z0", "-support_components_z0", "z"]
SPRINGS = ["-chest_wall", "-chest_wall_surfaces", "x0,z1"]


def refused(test, options, words, ranks=1):
    """A run that ends at once with one sentence."""
    case = pulmo.Case(options, ranks=ranks, timeout=120)
    test.assertEqual(case.code, 1, case.tail())
    errors = [line for line in case.err.splitlines() if line.startswith("pulmo: error:")]
    test.assertEqual(len(errors), 1, case.tail())
    for word in words:
        test.assertIn(word, errors[0])
    test.assertEqual(case.files(), [])


def warnings(case):
    return [line for line in (case.out + case.err).splitlines() if line.startswith("pulmo: warning:")]


def two_cubes(shift):
    """Two cubes of 50 mm, the second moved by a shift; nodes at one place are one. Surfaces of the first: x0 ... z1, of
    the second: other."""
    lengths = (50.0, 50.0, 50.0)
    points, tets = case_meshes.kuhn((2, 2, 2), lengths)
    facets = case_meshes.boundary(tets)
    names = case_meshes.faces_of_box(points, facets, lengths) + ["other"] * len(facets)
    both = np.vstack([points, points + shift])
    unique, number = np.unique(np.round(both, 9), axis=0, return_inverse=True)
    number = number.reshape(-1)
    n = len(points)
    tets, facets = number[np.vstack([tets, tets + n])], number[np.vstack([facets, facets + n])]
    outer = {tuple(f) for f in case_meshes.boundary(tets)}
    kept = [i for i, f in enumerate(np.sort(facets, axis=1)) if tuple(f) in outer]  # not where the cubes are joined
    return case_meshes.write(unique, tets, facets[kept], [names[i] for i in kept])


class FreeMotions(unittest.TestCase):
    def test_a_roller_is_too_little(self):
        for ranks in (1, 3):
            refused(self, BLOCK + ROLLER, ["(50, 50, 50) mm", "translation along x, translation along y",
                                           "rotation about the axis along z through (50, 50, 50) mm", "-support_rigid"], ranks)

    def test_normal_springs_on_two_faces_leave_a_translation(self):
        for direction in ("normal", "current_normal"):
            refused(self, BLOCK + SPRINGS + ["-chest_wall_direction", direction], ["free to move: translation along y;"])

    def test_a_body_that_hangs_on_a_vertex_or_an_edge(self):
        springs = ["-chest_wall", "-chest_wall_surfaces", "x0,y0,z0"]
        for shift in ([50, 50, 50], [50, 50, 0]):
            for ranks in (1, 2):
                refused(self, SCENE + two_cubes(np.array(shift)) + springs,
                        ["the body around (75, 75,", "is held in place by nothing"], ranks)
            refused(self, SCENE + two_cubes(np.array(shift)) + springs + pulmo.PINS, ["-support_rigid", "hang together at (50, 50,"])
        # and air gets into one of them only
        refused(self, SCENE + two_cubes(np.array([50, 50, 50])) + ["-airflow", "-airflow_surfaces", "x0"],
                ["the body around (75, 75, 75)", "no air gets in"])
        # a joint by facets is none of that
        pulmo.finished(SCENE + two_cubes(np.array([50, 0, 0])) + ["-chest_wall", "-chest_wall_surfaces", "y0"])

    def test_springs_that_hardly_hold_a_turn(self):
        sphere = SCENE + ["-dm_plex_filename", pulmo.mesh("hollow_sphere.msh")]
        springs = ["-chest_wall", "-chest_wall_surfaces", "pleura"]
        for direction in ("normal", "current_normal"):
            told, = warnings(pulmo.finished(sphere + springs + ["-chest_wall_direction", direction]))
            self.assertIn("barely against rotation about", told)
            share, least = map(float, re.search(r"by (\S+) of what they hold best \(smallest eigenvalue (\S+) kPa mm\)", told).groups())
            self.assertLess(share, 0.025)
            # the best they hold is a translation: K_s times a third of the surface, of a sphere with radius 74.7 mm
            self.assertAlmostEqual(least / share / (0.08 * 4 * np.pi * 74.7 ** 2 / 3), 1, delta=0.08)
        self.assertEqual(warnings(pulmo.finished(sphere + springs)), [])


class Pins(unittest.TestCase):
    def test_they_hold_what_nothing_else_does(self):
        """The same volume as without any other hold, and no force, on any ranks."""
        free = pulmo.finished(BLOCK + pulmo.PINS).signals()["volume_ml"]
        for holds in (ROLLER, pulmo.ROLLERS, ["-support", "-support_surfaces", "x1", "-support_components_x1", "x"]):
            for ranks in (1, 2):
                case = pulmo.finished(BLOCK + holds + ["-support_rigid"], ranks=ranks)
                np.testing.assert_allclose(case.signals()["volume_ml"], free, rtol=1e-10)
                self.assertLess(case.json().get("pin_force_n", 0), 1e-10)
                self.assertEqual(warnings(case), [])

    def test_springs_leave_nothing_to_pin(self):
        alone, pinned = (pulmo.finished(BLOCK + SPRINGS + more) for more in ([], pulmo.PINS))
        np.testing.assert_array_equal(pinned.signals()["volume_ml"], alone.signals()["volume_ml"])
        self.assertNotIn("pin_force_n", pinned.json())

    def test_prescribed_values_stay(self):
        case = pulmo.finished(BLOCK + ["-support", "-support_surfaces", "x0", "-support_components_x0", "x",
                                       "-support_displacement_x0", "2,0,0", "-support_rigid"])
        x, _, values = pulmo.fields(case)
        u = values["displacement_mm"].reshape(-1, 3)
        np.testing.assert_array_equal(u[x.reshape(-1, 3)[:, 0] < 1e-9, 0], 2)
        self.assertLess(case.json()["pin_force_n"], 1e-10)

    def test_a_load_along_a_pinned_motion_is_told(self):
        traction = np.array([0.02, -0.01, 0.03])  # kPa on 1e4 mm^2
        for holds, borne in (([], [1, 1, 1]), (ROLLER[1:], [1, 1, 0])):
            case = pulmo.finished(BLOCK + ["-support", "-support_rigid", "-traction", "-traction_surfaces", "x1",
                                           "-traction_value", ",".join(map(str, traction))] + holds)
            told, = warnings(case)
            force = re.search(r"bear \((.*?), (.*?), (.*?)\) N in all", told)
            np.testing.assert_allclose([float(f) for f in force.groups()], traction * 10 * borne, rtol=2e-3, atol=1e-6)
            self.assertGreater(case.json()["pin_force_n"], 0.1)


class Prescribed(unittest.TestCase):
    BOTH = ["-support", "-support_surfaces", "x0,y0,z0", "-support_components_z0", "z", "-support_displacement_x0", "1,0,0"]

    def test_two_values_at_one_place(self):
        swapped = [o.replace("x0,y0,z0", "y0,x0,z0") for o in self.BOTH]
        for options in (self.BOTH, swapped):
            for ranks in (1, 3):
                refused(self, BLOCK + options, ["'x0'", "'y0'", "at (0, 0, ", "along x is prescribed twice",
                                                "-support_displacement_x0", "-support_displacement_y0"], ranks)

    def test_equal_values(self):
        one, other = (pulmo.finished(BLOCK + [str(o).replace("x0,y0,z0", order) for o in self.BOTH] +
                                     ["-support_displacement_y0", "1,0,0"]).signals()["volume_ml"]
                      for order in ("x0,y0,z0", "z0,y0,x0"))
        np.testing.assert_array_equal(one, other)

    def test_values_of_components_that_are_not_held(self):
        told = warnings(pulmo.finished(BLOCK + pulmo.ROLLERS + ["-support_displacement_x0", "1,2,0"]))
        self.assertEqual(len(told), 1)
        for word in ("-support_displacement_x0 gives 2 mm along y", "-support_components_x0 x"):
            self.assertIn(word, told[0])


class Boundary(unittest.TestCase):
    def test_what_no_effect_uses_is_told(self):
        for ranks in (1, 2):
            case = pulmo.finished(BLOCK + ["-chest_wall", "-chest_wall_surfaces", "x0,y0,y1,z0,z1"], ranks=ranks)
            told, = [line for line in case.out.splitlines() if "no effect uses" in line]
            for word in ("'x1' (1e+04 mm^2, 16.7 %", "around (100, 50, 50)"):
                self.assertIn(word, told)
            part, = case.json()["free_boundary"]
            self.assertEqual(part["name"], "x1")
            self.assertAlmostEqual(part["share"], 1 / 6, delta=1e-12)
            np.testing.assert_allclose(part["centroid_mm"], [100, 50, 50], rtol=1e-12)

    def test_a_lung_of_no_animal(self):
        for scale, size in ((1, "less"), (1000, "more")):
            case = pulmo.finished(SCENE + ["-dm_plex_filename", pulmo.mesh("cube_coarse.msh"), "-mesh_scale", scale,
                                           "-chest_wall", "-chest_wall_surfaces", "x0"])
            told = [line for line in warnings(case) if "-mesh_scale" in line]
            self.assertEqual(len(told), 1, case.tail())
            self.assertIn(size + " than any animal's", told[0])


if __name__ == "__main__":
    pulmo.main()
