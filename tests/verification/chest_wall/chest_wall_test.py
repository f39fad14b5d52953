#!/usr/bin/python3
"""Springs of the chest wall in closed form: homogeneous states of a block, in which every direction of a spring is another
traction; stiffening, the pull of the wall, values by surface and by region.

By hand: tests/verification/chest_wall/chest_wall_test.py build/pulmo
"""
import os
import sys
import unittest

import numpy as np
from scipy.optimize import brentq, fsolve

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import case_meshes  # noqa: E402
import pulmo_case as pulmo  # noqa: E402

C, BETA = 1.298, 0.75  # CM4 (yoshihara), kPa
SIDE = 100.0  # mm
NORMAL = {"x0": (-1, 0, 0), "x1": (1, 0, 0), "y0": (0, -1, 0), "y1": (0, 1, 0), "z0": (0, 0, -1), "z1": (0, 0, 1)}
STATIC = pulmo.TIGHT + pulmo.QUIET + ["-tissue", "yoshihara", "-ts_dt", "1", "-ts_max_time", "1", "-snes_atol", "1e-13",
                                      "-snes_max_it", "60", "-lumen_pressure", "off", "-chest_wall"]


def stress(F):
    """First Piola stress of W = c (I1 - 3) + c / beta (I3^-beta - 1)."""
    return 2 * C * (F - np.linalg.det(F) ** (-2 * BETA) * np.linalg.inv(F).T)


def traction_of(F, N, direction, K, s, offset):
    """Expressions of the traction that, beside the springs, holds x = F X: P N + g(d) - p_o J F^-T N."""
    cof_N = np.linalg.det(F) * np.linalg.inv(F).T @ N
    n = {"normal": N, "current_normal": cof_N / np.linalg.norm(cof_N)}.get(direction)
    rest = stress(F) @ N - offset * pulmo.KPA_PER_CMH2O * cof_N
    H = F - np.eye(3)
    sum_of = lambda a: "({})".format("+".join(f"({c:.17g})*{v}" for c, v in zip(a, "xyz")))  # noqa: E731
    if direction == "full":
        u = [sum_of(row) for row in H]
        size = "sqrt({})".format("+".join(f"{v}^2" for v in u))
        return ",".join(f"({r:.17g})+{K}*(1+{s}*{size})*{v}" for r, v in zip(rest, u))
    u_n = sum_of(H.T @ n)
    return ",".join(f"({r:.17g})+{K}*(1+{s}*abs({u_n}))*{u_n}*({c:.17g})" for r, c in zip(rest, n))


class Homogeneous(unittest.TestCase):
    """Dead loads on the six faces of a block that, with springs on all of them, hold x = F X with stretch, shear and turn."""

    TURN = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    F = TURN @ np.array([[1.06, 0.03, 0], [0, 0.97, 0.05], [0.02, 0, 1.04]])
    K, S, OFFSET = 0.08, 0.05, 3.0

    def run_with(self, F, direction, springs=None, s=S, offset=OFFSET, ranks=1):
        loads = []
        for face, N in NORMAL.items():
            loads += [f"-traction_value_{face}", traction_of(F, np.array(N, float), direction, self.K, s, offset)]
        return pulmo.finished(STATIC + pulmo.BLOCK + [
            "-chest_wall_surfaces", ",".join(NORMAL), "-chest_wall_stiffness", self.K, "-chest_wall_direction", springs or direction,
            "-chest_wall_stiffening", s, "-chest_wall_offset", offset, "-traction", "-traction_surfaces", ",".join(NORMAL),
            "-output_fields_every", "1"] + loads, ranks=ranks)

    def error(self, case, F):
        x, _, values = pulmo.fields(case)
        return np.abs(values["displacement_mm"] - x @ (F - np.eye(3)).T).max()

    def test_the_exact_state_in_every_direction(self):
        for direction in ("full", "normal", "current_normal"):
            self.assertLess(self.error(self.run_with(self.F, direction), self.F), 1e-8, direction)
        self.assertLess(self.error(self.run_with(self.F, "current_normal", ranks=2), self.F), 1e-8)

    def test_the_directions_differ(self):
        for given, other in (("current_normal", "normal"), ("normal", "current_normal"), ("current_normal", "full")):
            self.assertGreater(self.error(self.run_with(self.F, given, springs=other), self.F), 0.1)

    def test_they_agree_where_nothing_turns(self):
        F = np.diag([1.1, 0.95, 1.04])
        self.assertLess(self.error(self.run_with(F, "normal", springs="current_normal"), F), 1e-8)

    def test_energy(self):
        """What springs store (K u_n^2 / 2 on each face), and a balance that closes with the work of turning."""
        for direction in ("normal", "current_normal"):
            case = self.run_with(self.F, direction, s=0)
            rows = pulmo.columns(case.path("energy.csv"))
            g = np.array([-1, 1]) * np.sqrt(0.6) * SIDE / 2
            points = SIDE / 2 + np.array([g[0], 0, g[1]])
            weights = np.array([5, 8, 5]) / 18
            stored = 0
            for N in NORMAL.values():
                N = np.array(N, float)
                n = np.linalg.inv(self.F).T @ N if direction == "current_normal" else N
                n /= np.linalg.norm(n)
                axis = np.abs(N).argmax()
                for a, wa in zip(points, weights):
                    for b, wb in zip(points, weights):
                        X = np.insert(np.array([a, b]), axis, SIDE if N[axis] > 0 else 0)
                        stored += wa * wb * SIDE**2 * self.K / 2 * (n @ (self.F - np.eye(3)) @ X) ** 2
            springs = rows["elastic_springs_j"][-1]
            self.assertAlmostEqual(springs / (stored * 1e-6), 1, delta=1e-9)  # kPa mm^3 = 1e-6 J
            self.assertLess(abs(rows["residual_j"][-1]), 1e-9 * rows["ventilator_work_j"][-1] + 1e-9 * springs)
            if direction == "current_normal":
                self.assertGreater(abs(rows["turning_springs_j"][-1]), 1e-3 * springs)
            else:
                self.assertNotIn("turning_springs_j", rows)


def rest_of(p, offset, K, s):
    """Stretch of a free block under gas of pressure p and a pull (cmH2O), springs on its outer faces: F = stretch I."""
    def force(a):
        u = (a - 1) * SIDE
        return stress(a * np.eye(3))[0, 0] - (p + offset) * pulmo.KPA_PER_CMH2O * a**2 + K * (1 + s * abs(u)) * u
    return brentq(force, 0.5, 2)


class Block(unittest.TestCase):
    """A third of a mirrored block: rollers on x0, y0, z0, springs on x1, y1, z1."""

    BLOCK = STATIC + pulmo.ROLLERS + ["-chest_wall_surfaces", "x1,y1,z1", "-ventilator", "pcv", "-ventilator_ramp", "0.5",
                                      "-ventilator_inspiration", "1", "-ventilator_settle", "off"]

    def test_pressure_and_pull(self):
        for direction in ("normal", "current_normal"):
            for p, offset, K, s in ((6, 0, 0.08, 0), (6, 0, 0.08, 0.2), (6, 4, 0.05, 0.1), (6, -9, 0.05, 0.1)):
                case = pulmo.finished(self.BLOCK + pulmo.BLOCK + [
                    "-ventilator_pip", p, "-chest_wall_direction", direction, "-chest_wall_stiffness", K, "-chest_wall_stiffening", s,
                    "-chest_wall_offset", offset])
                wanted = rest_of(p, offset, K, s) ** 3 - 1
                self.assertAlmostEqual(case.signals()["volume_ml"][-1] / (1000 * wanted), 1, delta=1e-8)
                self.assertEqual(wanted > 0, p + offset > 0)

    def test_the_pull_is_a_suction(self):
        """Without springs: an offset does what as much pressure of the gas does."""
        for offset, p in ((4, 2), (0, 6)):
            case = pulmo.finished(self.BLOCK + pulmo.BLOCK + ["-ventilator_pip", p, "-chest_wall_stiffness", "0",
                                                              "-chest_wall_offset", offset])
            self.assertAlmostEqual(case.signals()["volume_ml"][-1] / (1000 * (rest_of(6, 0, 0, 0) ** 3 - 1)), 1, delta=1e-8)

    def test_a_lung_that_the_wall_pulls_at_settles_first(self):
        case = pulmo.finished(STATIC + pulmo.ROLLERS + pulmo.BLOCK + [
            "-chest_wall_surfaces", "x1,y1,z1", "-chest_wall_direction", "normal", "-chest_wall_offset", "5", "-ventilator", "pcv",
            "-ventilator_pip", "3", "-ventilator_inspiration", "1", "-ts_max_time", "9"])
        self.assertIn("A phase 'settle'", case.out + case.err)
        rows = case.signals()
        settled = [i for i, phase in enumerate(rows["phase"]) if phase == "settle"][-1]
        self.assertAlmostEqual(rows["volume_ml"][settled] / (1000 * (rest_of(0, 5, 0.08, 0) ** 3 - 1)), 1, delta=1e-6)

    def test_values_by_surface(self):
        """F = diag(a): three equations that hang together by the tissue."""
        K, s, offset = np.array([0.05, 0.1, 0.2]), np.array([0.3, 0.0, 0.1]), np.array([6.0, -2.0, 0.0])
        p = 5

        def forces(a):
            F, u = np.diag(a), (a - 1) * SIDE
            pull = (p + offset) * pulmo.KPA_PER_CMH2O * a.prod() / a
            return np.diag(stress(F)) - pull + K * (1 + s * np.abs(u)) * u
        a = fsolve(forces, np.ones(3), xtol=1e-13)
        options = []
        for i, face in enumerate(("x1", "y1", "z1")):
            options += [f"-chest_wall_stiffness_{face}", K[i], f"-chest_wall_stiffening_{face}", s[i], f"-chest_wall_offset_{face}", offset[i]]
        for direction in ("normal", "current_normal"):
            case = pulmo.finished(self.BLOCK + pulmo.BLOCK + options + ["-ventilator_pip", p, "-chest_wall_direction", direction])
            self.assertAlmostEqual(case.signals()["volume_ml"][-1] / (1000 * (a.prod() - 1)), 1, delta=1e-8)
        by_list = self.BLOCK + pulmo.BLOCK + [
            "-ventilator_pip", p, "-chest_wall_direction", "normal", "-chest_wall_stiffness", "0.05,y1=0.1,z1=0.2",
            "-chest_wall_stiffening", "0.3,y1=0,z1=0.1", "-chest_wall_offset", "6,y1=-2,z1=0"]
        self.assertAlmostEqual(pulmo.finished(by_list).signals()["volume_ml"][-1] / (1000 * (a.prod() - 1)), 1, delta=1e-8)

    def test_values_by_region(self):
        """Two blocks in one mesh, each with a wall of its own."""
        points, tets = case_meshes.kuhn((2, 2, 2), (SIDE,) * 3)
        facets = case_meshes.boundary(tets)
        faces = case_meshes.faces_of_box(points, facets, (SIDE,) * 3)
        number = {name: i + 1 for i, name in enumerate(case_meshes.FACES)}
        n, tags = len(points), [number[f] for f in faces]
        mesh = case_meshes.save(np.vstack([points, points + [3 * SIDE, 0, 0]]), [
            ("triangle", np.vstack([facets, facets + n]), tags + tags),
            ("tetra", np.vstack([tets, tets + n]), np.repeat([7, 8], len(tets)))],
            {f: (i, 2) for f, i in number.items()} | {"left": (7, 3), "right": (8, 3)})
        case = pulmo.finished(STATIC + mesh + [
            "-support", "-support_surfaces", "x0,y0,z0", "-support_components_x0", "x", "-support_components_y0", "y",
            "-support_components_z0", "z", "-chest_wall_surfaces", "x1,y1,z1", "-chest_wall_direction", "current_normal",
            "-ventilator", "pcv", "-ventilator_pip", "5", "-ventilator_inspiration", "1", "-ventilator_settle", "off",
            "-chest_wall_stiffness", "0.05,right=0.1", "-chest_wall_stiffening", "0.1,right=0.2", "-chest_wall_offset", "4,right=-2",
            "-output_fields_every", "1"])
        x, _, values = pulmo.fields(case)
        right = x[:, 0] > 2 * SIDE
        left, right = (values["displacement_mm"][part].max() / SIDE + 1 for part in (~right, right))
        self.assertAlmostEqual(left, rest_of(5, 4, 0.05, 0.1), delta=1e-9)
        self.assertAlmostEqual(right, rest_of(5, -2, 0.1, 0.2), delta=1e-9)


class Words(unittest.TestCase):
    def test_nothing_to_stiffen(self):
        case = pulmo.Case(STATIC + pulmo.BLOCK + pulmo.PINS + ["-chest_wall_surfaces", "x1,y1", "-chest_wall_stiffness_y1", "0",
                                                               "-chest_wall_stiffening", "0.1"])
        self.assertEqual(case.code, 1)
        for word in ("-chest_wall_stiffening", "'y1'", "K_s is 0"):
            self.assertIn(word, case.err)


if __name__ == "__main__":
    pulmo.main()
