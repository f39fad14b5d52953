#!/usr/bin/python3
"""A lung that is under pressure in the shape of the mesh: in equilibrium there, and as stiff as the lung it was inflated from.

By hand: tests/verification/prestress/prestress_test.py build/pulmo
"""
import os
import subprocess
import sys
import unittest

import numpy as np
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases"), os.path.join(HERE, "..", "hollow_sphere")]

import pulmo_case as pulmo  # noqa: E402
from pulmo_case import gas_pressure  # noqa: E402
from radial import Birzle, Pressure, Shell, breathe  # noqa: E402

PRESTRESS = 2  # cmH2O: all five laws carry it
ON = ["-prestress", "-prestress_pressure", PRESTRESS]
# what rounding, and a solve to 1e-9, leave of nothing
NOTHING_ML = 1e-9


def inflation(law, pressure, most=6):
    """J of free tissue of a law under a pressure, cmH2O, on the branch from rest."""
    grid = np.linspace(0.5, most, 20000)
    p = np.array([gas_pressure(law, J) for J in grid])
    start = np.searchsorted(grid, 1)
    first = start + np.argmax(p[start:] > pressure) if pressure > p[start] else start - np.argmax(p[start::-1] < pressure) + 1
    return brentq(lambda J: gas_pressure(law, J) - pressure, grid[first - 1], grid[first], xtol=1e-14)


class Prestressed:
    """A law of the radial solver for a shell that was inflated by J0 to its shape at hand: W(s l) / J0 less the work of p_tp."""

    def __init__(self, law, pressure):
        self.law, self.pressure = law, pressure
        J0 = brentq(lambda J: law.stress(np.cbrt(J), np.cbrt(J))[0] / np.cbrt(J) ** 2 - pressure, 1, 2.5, xtol=1e-15)
        self.s = np.cbrt(J0)

    def stress(self, r, t):
        Pr, Pt = self.law.stress(self.s * r, self.s * t)
        return Pr / self.s**2 - self.pressure * t**2, Pt / self.s**2 - self.pressure * r * t

    tangent = Birzle.tangent


class Block(unittest.TestCase):
    """A litre of tissue on rollers inflates freely: J0 J is what p_tp + p makes of tissue at rest."""

    def test_inflation_goes_on_from_the_prestress(self):
        for law in pulmo.CLOSED_FORMS:
            with self.subTest(law=law):
                run = pulmo.finished(pulmo.BLOCK + pulmo.ROLLERS + pulmo.STILL + pulmo.TIGHT + ON + [
                    "-tissue", law] + pulmo.programme("step 0.1 pressure 0\nstep 0.1 pressure 1\nstep 0.1 pressure -1\n") + pulmo.QUIET)
                rows, J0 = run.signals(), inflation(law, PRESTRESS)
                for p, V in zip(rows["airway_pressure_cmH2O"], rows["volume_ml"]):
                    self.assertAlmostEqual(V, 1000 * (inflation(law, PRESTRESS + p) / J0 - 1), delta=1e-6)
                self.assertEqual({*np.round(rows["airway_pressure_cmH2O"], 12)}, {0, 1, -1})
                found = run.json()["prestress"]
                self.assertAlmostEqual(found["unloaded_volume_ml"], 1000 / J0, delta=1e-8)
                self.assertAlmostEqual(found["unloaded_volume_ratio"], 1 / J0, delta=1e-11)

    def test_the_ways_that_are_wrong(self):
        """Deflation by p_tp is not the inverse of inflation; stress without stretch has another compliance."""
        J0 = inflation("birzle", PRESTRESS)
        self.assertGreater(abs(inflation("birzle", -PRESTRESS) * J0 - 1), 0.02)
        slope = (inflation("birzle", PRESTRESS + 1e-3) - inflation("birzle", PRESTRESS - 1e-3)) / 2e-3 / J0
        at_rest = (inflation("birzle", 1e-3) - inflation("birzle", -1e-3)) / 2e-3
        self.assertGreater(slope / at_rest, 1.2)

    def test_parts_of_other_tissue_have_another_stretch(self):
        c = "0.36,left_lung=0.72"
        run = pulmo.finished(["-dm_plex_filename", pulmo.mesh("lung_pair.msh"), "-elements", "P1-P1"] + pulmo.PCV + pulmo.DIRECT + ON +
                             ["-tissue", "yoshihara", "-tissue_c", c, "-ts_max_time", "0.1", "-ventilator_pip", "0"] + pulmo.QUIET)
        regions = run.json()["regions"]

        def unloaded(c):  # p = 2 c (J^-1/3 - J^(-2 beta - 1))
            return 1 / brentq(lambda J: 2 * c * (J ** (-1 / 3) - J ** (-2.5)) / pulmo.KPA_PER_CMH2O - PRESTRESS, 1, 1.7)

        expected = (regions["right_lung"]["reference_volume_ml"] * unloaded(0.36)
                    + regions["left_lung"]["reference_volume_ml"] * unloaded(0.72))
        self.assertAlmostEqual(run.json()["prestress"]["unloaded_volume_ml"], expected, delta=1e-7)
        self.assertLess(np.abs(run.signals()["volume_ml"]).max(), NOTHING_ML)


class Equilibrium(unittest.TestCase):
    """u = 0 of any mesh, with any boundary, law and effect that lets tissue be."""

    def test_nothing_moves(self):
        for law in pulmo.tissue_laws():
            for more in ([], ["-viscoelastic"] if law != "rausch" else [], ["-airflow", "off"]):
                with self.subTest(law=law, more=more):
                    run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ON + ["-tissue", law, "-elements", "P1-P1", "-ventilator_pip", "0",
                                         "-ts_max_time", "0.1", *more] + pulmo.QUIET)
                    rows = run.signals()
                    self.assertLess(np.abs(rows["volume_ml"]).max(), NOTHING_ML)
                    self.assertLess(np.abs(rows["max_J"] - 1).max(), 1e-11)
                    self.assertNotIn("settle", rows["phase"])

    def test_too_much_is_refused(self):
        run = pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "yoshihara", "-prestress", "-prestress_pressure", "40"])
        self.assertEqual(run.code, 1)
        self.assertIn("-prestress_pressure 40", run.err)
        self.assertIn("takes no more than", run.err)
        region = pulmo.Case(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.PCV + pulmo.DIRECT + ON +
                            ["-tissue", "yoshihara", "-tissue_c", "1.3,left_lung=0.01"])
        self.assertEqual(region.code, 1)
        self.assertIn("some part of the lung", region.err)

    def test_nearly_neutral_is_told(self):
        run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "birzle", "-prestress", "-elements", "P1-P1", "-ventilator_pip",
                             "0", "-ts_max_time", "0.1"] + pulmo.QUIET)
        self.assertIn("nearly neutral at -prestress_pressure 5", run.out)
        quiet = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "ma", "-prestress", "-elements", "P1-P1", "-ventilator_pip",
                               "0", "-ts_max_time", "0.1"] + pulmo.QUIET)
        self.assertNotIn("neutral", quiet.out)


class HollowSphere(unittest.TestCase):
    """A breath of a prestressed hollow sphere against the radial solver, at equal steps."""

    def test_breath(self):
        scene = pulmo.options_file("scenes/hollow_sphere.opts") + pulmo.DIRECT + pulmo.ROLLERS + ON + pulmo.QUIET
        levels, volumes = (4, 6), []
        for divisions in levels:
            mesh = pulmo.scratch("octant.msh")
            subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", str(divisions), "--layers", str(3 * divisions),
                            "--octant", "--output", mesh], check=True, capture_output=True)
            rows = pulmo.finished(scene + ["-dm_plex_filename", mesh, "-ts_dt", "0.2", "-ts_max_time", "1", "-ventilator_pip", "4"]).signals()
            volumes.append(8 * rows["volume_ml"])
        shell = Shell(law=Prestressed(Birzle(), PRESTRESS * pulmo.KPA_PER_CMH2O))
        pressure = Pressure(4 * pulmo.KPA_PER_CMH2O)
        np.testing.assert_allclose(rows["airway_pressure_cmH2O"] * pulmo.KPA_PER_CMH2O, [pressure(t) for t in rows["time_s"]], atol=1e-12)
        exact, plain = (breathe(s, rows["time_s"], pressure, n=32)["V"] for s in (shell, Shell()))
        errors = [np.abs(V - exact).max() / exact.max() for V in volumes]
        print("\nprestressed sphere: V off by", ", ".join(f"{e:.2e}" for e in errors), f"; without prestress by {abs(plain[-1] / exact[-1] - 1):.2f}")
        self.assertGreater(np.log(errors[0] / errors[1]) / np.log(levels[1] / levels[0]), 1.7)
        limit = volumes[1] + (volumes[1] - volumes[0]) / ((levels[1] / levels[0]) ** 2 - 1)
        self.assertLess(np.abs(limit - exact).max() / exact.max(), 2e-3)
        self.assertGreater(abs(plain[-1] / exact[-1] - 1), 0.1)  # it matters


if __name__ == "__main__":
    pulmo.main()
