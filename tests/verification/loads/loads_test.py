#!/usr/bin/python3
"""Loads that are expressions of x, y, z, t: homogeneous states, resultants, the clock, refused words and values.

A homogeneous state under loads that vary in place is in tests/verification/chest_wall.
By hand: tests/verification/loads/loads_test.py build/pulmo
"""
import os
import sys
import unittest

import numpy as np
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import pulmo_case as pulmo  # noqa: E402

C, BETA = 1.298, 0.75  # CM4 (yoshihara), kPa
BASE = pulmo.TIGHT + pulmo.QUIET + ["-tissue", "yoshihara", "-snes_atol", "1e-13", "-lumen_pressure", "off"]
BLOCK = BASE + pulmo.BLOCK  # a cube of 100 mm
PULLED = ["-traction", "-traction_surfaces", "x1", "-traction_value"]
MOVED = ["-support", "-support_surfaces", "x0,x1,y0,z0", "-support_components_x0", "x", "-support_components_x1", "x",
         "-support_components_y0", "y", "-support_components_z0", "z", "-support_displacement_x1"]
STEPS = ["-ts_dt", "0.1", "-ts_max_time", "0.5"]


def sides(a):
    """Stretch across of a free bar that is stretched by a, 2 c (b - J^(-2 beta) / b) = 0."""
    return brentq(lambda b: b**2 - (a * b**2) ** (-2 * BETA), 0.2, 5, xtol=1e-15)


def pull(a):
    """Force on the end of the bar over its area at rest, kPa."""
    return 2 * C * (a - (a * sides(a) ** 2) ** (-2 * BETA) / a)


def volume(T):
    """J - 1 of a bar under that force, ml of 1000."""
    a = brentq(lambda a: pull(a) - T, 0.3, 3, xtol=1e-15)
    return 1000 * (a * sides(a) ** 2 - 1)


class Numbers(unittest.TestCase):
    def test_expressions_that_are_numbers_change_no_digit(self):
        for load, other in (("0.1,-0.2,0.05", "0.2/2,0-0.2,0.05"), ("0.1,-0.2,0.05", "0.1+0*x,0*t-0.2,0.05+0*y*t")):
            hold = ["-support", "-support_surfaces", "x0"] + STEPS
            a, b = (pulmo.finished(BLOCK + hold + PULLED + [text]) for text in (load, other))
            for name, column in a.signals().items():
                np.testing.assert_array_equal(column, b.signals()[name], name)
            with open(a.path("energy.csv")) as one, open(b.path("energy.csv")) as two:
                self.assertEqual(one.read(), two.read())
        a, b = (pulmo.finished(BLOCK + STEPS + MOVED + [text]).signals()["volume_ml"] for text in ("5,0,0", "5+0*z,0,0"))
        np.testing.assert_array_equal(a, b)


class Bar(unittest.TestCase):
    def test_a_pull_that_changes_in_time(self):
        for ranks, more in ((1, []), (2, ["-ts_type", "bdf"]), (1, ["-petscfe_type", "basic"])):
            rows = pulmo.finished(BLOCK + STEPS + pulmo.ROLLERS + PULLED + ["0.8*sin(pi*t),0,0"] + more, ranks=ranks).signals()
            wanted = [volume(0.8 * np.sin(np.pi * t)) for t in rows["time_s"]]
            np.testing.assert_allclose(rows["volume_ml"], wanted, rtol=0, atol=1e-8)
            self.assertGreater(max(wanted), 20)

    def test_an_end_that_moves(self):
        case = pulmo.finished(BLOCK + STEPS + MOVED + ["20*t*(t<0.35 ? 1 : 0.5),0,0"])
        rows, energy = case.signals(), pulmo.columns(case.path("energy.csv"))
        stretch = [1 + 0.2 * t * (1 if t < 0.35 else 0.5) for t in rows["time_s"]]
        np.testing.assert_allclose(rows["volume_ml"], [1000 * (a * sides(a) ** 2 - 1) for a in stretch], rtol=0, atol=1e-8)
        self.assertLess(np.abs(energy["residual_j"]).max(), 1e-9 * np.abs(energy["external_j"]).max())

    def test_a_boundary_that_moves_as_one_map(self):
        H = np.array([[0.1, 0.2, 0], [0, -0.05, 0.1], [0.3, 0, 0.02]])
        text = ",".join("t*(" + "+".join(f"({h})*{v}" for h, v in zip(row, "xyz")) + ")" for row in H)
        options = ["-support", "-support_surfaces", "x0,x1,y0,y1,z0,z1", "-ts_dt", "0.5", "-ts_max_time", "1"]
        for face in ("x0", "x1", "y0", "y1", "z0", "z1"):
            options += [f"-support_displacement_{face}", text]
        rows = pulmo.finished(BLOCK + options).signals()
        wanted = [1000 * (np.linalg.det(np.eye(3) + t * H) - 1) for t in rows["time_s"]]
        np.testing.assert_allclose(rows["volume_ml"], wanted, rtol=0, atol=1e-8)


class Resultants(unittest.TestCase):
    def test_force_and_moment_of_a_liquid(self):
        """Pressure a + b (100 - z) on a block of full springs: what these bear is its weight of liquid, at its centre."""
        a, b, K = 2e-5, 1e-6, 0.1
        faces = {"x0": (-1, 0, 0), "x1": (1, 0, 0), "y1": (0, 1, 0), "z0": (0, 0, -1), "z1": (0, 0, 1)}  # not y0
        options = ["-elements", "P1-P1", "-chest_wall", "-chest_wall_stiffness", K, "-chest_wall_surfaces", "x0,x1,y0,y1,z0,z1",
                   "-traction", "-traction_surfaces", ",".join(faces), "-ts_dt", "1", "-ts_max_time", "1", "-output_fields_every", "1"]
        for face, N in faces.items():
            options += [f"-traction_value_{face}", ",".join(f"({-n})*({a}+{b}*(100-z))" for n in N)]
        case = pulmo.finished(BLOCK + options)
        X, cells, values = pulmo.fields(case)
        u = values["displacement_mm"]
        force, moment = np.zeros(3), np.zeros(3)
        for corners in cells[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3):
            x = X[corners]
            if not any(np.all(np.abs(x[:, d] - end) < 1e-9) for d in range(3) for end in (0, 100)):
                continue
            area = np.linalg.norm(np.cross(x[1] - x[0], x[2] - x[0])) / 2
            for i, j in ((0, 1), (1, 2), (2, 0)):  # exact for what is quadratic
                at, bears = (x[i] + x[j]) / 2, K * (u[corners[i]] + u[corners[j]]) / 2
                force += area / 3 * bears
                moment += area / 3 * np.cross(at, bears)
        # x: the two faces cancel; y: the whole of y1; z: weight of the liquid
        P, lever = (a + 50 * b) * 1e4, 50 * 1e4 * a + b * 1e2 * (100**2 / 2 * 100 - 100**3 / 3)
        np.testing.assert_allclose(force, [0, -P, b * 1e6], rtol=0, atol=2e-5 * P)
        # x: y1 pushes along -y at z, z0 and z1 together along z at y = 50; y: the latter at x = 50; z: y1 at x = 50
        np.testing.assert_allclose(moment, [lever + 50 * b * 1e6, -50 * b * 1e6, -50 * P], rtol=0, atol=1e-4 * 50 * P)


class Clock(unittest.TestCase):
    """t counts from the end of the phase `settle`, and goes on after a restart."""

    SCENE = BLOCK + pulmo.ROLLERS + ["-ventilator", "pcv", "-ventilator_peep", "3", "-ventilator_pip", "3", "-ventilator_inspiration",
                                     "0.3", "-ventilator_expiration", "0.3", "-ts_dt", "0.1"]

    def test_settling_comes_first(self):
        rows = pulmo.finished(self.SCENE + PULLED + ["0.2+0.5*t,0,0"]).signals()
        end = max(t for t, phase in zip(rows["time_s"], rows["phase"]) if phase == "settle")
        self.assertGreater(end, 0.3)
        gas = 3 * pulmo.KPA_PER_CMH2O

        def J(T):
            """Of a block with gas: P_11 = T + p b^2, P_22 = p a b."""
            across = lambda a: brentq(lambda b: 2 * C * (b - (a * b * b) ** (-2 * BETA) / b) - gas * a * b, 0.5, 3, xtol=1e-15)  # noqa: E731
            a = brentq(lambda a: 2 * C * (a - (a * across(a) ** 2) ** (-2 * BETA) / a) - gas * across(a) ** 2 - T, 0.7, 2, xtol=1e-15)
            return a * across(a) ** 2
        for t, V, phase in zip(rows["time_s"][1:], rows["volume_ml"][1:], rows["phase"][1:]):
            if t >= end - 1e-9:  # while it settles the pressure rises
                self.assertAlmostEqual(V, 1000 * (J(0.2 + 0.5 * (t - end)) - 1), delta=1e-7, msg=f"{t} s, {phase}")

    def test_restart(self):
        scene = self.SCENE + PULLED + ["0.2*sin(5*t)+1e-3*y*t,0,0", "-checkpoint_every", "1"]
        whole = pulmo.finished(scene).signals()
        half = pulmo.finished(scene + ["-ts_max_time", whole["time_s"][-4]])
        rest = pulmo.finished(scene + ["-restart", half.path("checkpoint.h5")], ranks=2).signals()
        np.testing.assert_allclose(rest["volume_ml"], whole["volume_ml"], rtol=0, atol=1e-8 * 1000)


class Effort(unittest.TestCase):
    EFFORT = BASE + pulmo.LITRE + ["-airflow", "-airflow_permeability", "1e4", "-elements", "P1-P1", "-chest_wall", "-ts_dt", "0.1",
                                   "-breathing_effort"] + pulmo.programme("rest 1 pressure 0\n")

    def test_a_course(self):
        pulses = ["-breathing_effort_pressure", "6", "-breathing_effort_rise", "0.3", "-breathing_effort_hold", "0",
                  "-breathing_effort_fall", "0.3", "-breathing_effort_period", "0.6"]
        a, b = (pulmo.finished(self.EFFORT + more + ["-breathing_effort_delay", "0.1"]).signals()
                for more in (pulses, ["-breathing_effort_course", "3*(1-cos(2*pi*t/0.6))"]))
        self.assertGreater(np.ptp(a["volume_ml"]), 20)
        for name in ("volume_ml", "muscle_pressure_cmH2O"):
            np.testing.assert_allclose(b[name], a[name], rtol=0, atol=1e-9)


class Words(unittest.TestCase):
    def refused(self, options, *words, code=1, ranks=1):
        case = pulmo.Case(options, ranks=ranks)
        self.assertEqual(case.code, code, case.tail())
        error, = [line for line in case.err.splitlines() if line.startswith("pulmo: error:")]
        for word in words:
            self.assertIn(word, error)
        return case

    def test_wrong_expressions(self):
        hold = BLOCK + STEPS + ["-support", "-support_surfaces", "x0"] + PULLED
        for text, *words in (("0.1*foo,0,0", "column 5", "'foo' is not known"), ("0.1,2 y,0", "column 7", "'y' cannot stand there"),
                             ("0,sin(y,0", "column 10", "parenthesis is not closed"), ("x=3,0,0", "column 2", "'='"),
                             ("0,0,0*", "column 7", "more must follow"), ("0,sin(x,y),0", "column", "too many arguments"),
                             ("1/0,0,0", "column 1", "not a number"), ("nan,0,0", "column 1", "'nan'"), ("1,2", "three numbers", "'1,2'"),
                             ("-x,0,0", "write (-x)"), ("1,,2", "column 3", "empty"), ("0x10,0,0", "column 2", "'x10'")):
            self.refused(hold + [text], "-traction_value", *words)
        self.refused(BLOCK + STEPS + MOVED + ["5*q,0,0"], "-support_displacement_x1", "column 3", "'q'")

    def test_values_that_are_no_numbers(self):
        hold = BLOCK + ["-ts_dt", "0.1", "-ts_max_time", "0.5", "-support", "-support_surfaces", "x0"] + PULLED
        self.refused(hold + ["1/t,0,0"], "-traction_value (component x) is inf at t = 0 s")
        self.refused(hold + ["0,sqrt(y-50),0"], "component y) is not a number at t = 0 s, (100, ")
        self.refused(hold + ["0.01,0,0.01*sqrt(0.25-t)"], "component z) is not a number at t = 0.3 s", "last good state", code=2)
        # where one rank alone sees it
        case = self.refused(hold + ["0.01*(z>70 && t>0.25 ? 1/0 : 1),0,0"], "is inf at t = 0.3 s, (100, ", code=2, ranks=3)
        self.assertNotIn("-restart", case.err)  # another solver would meet it, too, and a restart keeps the load
        self.refused(BLOCK + STEPS + MOVED + ["log(0.25-t)-log(0.25),0,0"], "-support_displacement_x1 (component x)", "at t = 0.3 s", code=2)

    def test_values_that_are_never_used(self):
        pulmo.finished(BLOCK + ["-ts_dt", "0.1", "-ts_max_time", "0.2"] + MOVED + ["sqrt(0.25-t)-0.5,0,0"])

    def test_courses_of_an_effort(self):
        for course, *words in (("5*x", "x, y or z"), ("5+t", "5 cmH2O at t = 0"), ("5*", "column 3")):
            self.refused(Effort.EFFORT + ["-breathing_effort_course", course], "-breathing_effort_course", *words)
        self.refused(Effort.EFFORT + ["-breathing_effort_course", "3*sin(5*t)"], "-breathing_effort_course", "must be >= 0", code=2)
        self.refused(Effort.EFFORT + ["-breathing_effort_course", "t", "-breathing_effort_rise", "1"], "-breathing_effort_rise")


if __name__ == "__main__":
    pulmo.main()
