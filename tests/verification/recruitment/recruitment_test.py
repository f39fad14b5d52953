#!/usr/bin/python3
"""Airspaces that open and close: the open share and the volume of free tissue in closed form, order in time, what is left at p = 0.

By hand: tests/verification/recruitment/recruitment_test.py build/pulmo
"""
import os
import sys
import unittest

import h5py
import numpy as np
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import pulmo_case as pulmo  # noqa: E402
from pulmo_case import gas_pressure  # noqa: E402

LAW = "ma"  # carries any pressure
OPENING, CLOSING, OPENING_RATE, CLOSING_RATE, GAIN = 8, 3, 0.2, 0.4, 0.5
NUMBERS = ["-recruitment_opening_pressure", OPENING, "-recruitment_closing_pressure", CLOSING, "-recruitment_opening_rate", OPENING_RATE,
           "-recruitment_closing_rate", CLOSING_RATE, "-recruitment_gain", GAIN]
FREE = pulmo.BLOCK + pulmo.ROLLERS + pulmo.STILL + pulmo.TIGHT + pulmo.QUIET + ["-tissue", LAW, "-recruitment", *NUMBERS]
UP_AND_DOWN = "rise 1 pressure 16 ramp 1\nhold 0.5 pressure 16\nfall 0.1 pressure 0 ramp 0.1\nrest 1.2 pressure 0\n"


def rate(p):
    return OPENING_RATE * max(p - OPENING, 0) - CLOSING_RATE * max(CLOSING - p, 0)


def elastic(p):
    """J of the law alone."""
    return brentq(lambda J: gas_pressure(LAW, J) - p, 0.8, 3, xtol=1e-14)


def backward_euler(rows, start=0.0):
    x = [start]
    for dt, p in zip(rows["dt_s"][1:], rows["airway_pressure_cmH2O"][1:]):
        x.append(min(max(x[-1] + dt * rate(p), 0), 1))
    return np.array(x)


class FreeTissue(unittest.TestCase):
    """J = J_r(x) J_e(p), as W'(J / J_r) = p."""

    @classmethod
    def setUpClass(cls):
        cls.rows = pulmo.finished(FREE + pulmo.programme(UP_AND_DOWN)).signals()

    def test_share_and_volume(self):
        rows, x = self.rows, backward_euler(self.rows)
        self.assertEqual((x.min(), x.max()), (0, 1))  # both ends are met
        np.testing.assert_allclose(rows["open_share"], x, atol=1e-12)
        J = [(1 + GAIN * s) * elastic(p) for s, p in zip(x, rows["airway_pressure_cmH2O"])]
        np.testing.assert_allclose(rows["volume_ml"], 1000 * (np.array(J) - 1), atol=1e-5)
        recruited = [1000 * j * GAIN * s / (1 + GAIN * s) for s, j in zip(x, J)]
        np.testing.assert_allclose(rows["recruited_volume_ml"], recruited, atol=1e-5)

    def test_volume_stays_at_no_pressure_until_airspaces_close(self):
        rows = self.rows
        at = rows["phase"].index("rest")
        self.assertAlmostEqual(rows["airway_pressure_cmH2O"][at], 0, places=12)
        self.assertGreater(rows["volume_ml"][at], 300)
        self.assertLess(abs(rows["volume_ml"][-1]), 1e-6)
        self.assertTrue((np.diff(rows["volume_ml"][at:]) <= 1e-6).all())

    def test_start_is_the_shape_of_the_mesh(self):
        """What is open there closes below the closing pressure and leaves less than the mesh."""
        run = pulmo.finished(FREE + ["-recruitment_start", "0.5", "-ventilator_settle", "off"] + pulmo.programme("rest 1 pressure 0\n"))
        rows = run.signals()
        x = backward_euler(rows, 0.5)
        np.testing.assert_allclose(rows["open_share"], x, atol=1e-12)
        np.testing.assert_allclose(rows["volume_ml"], 1000 * ((1 + GAIN * x) / (1 + GAIN * 0.5) - 1), atol=1e-5)
        self.assertEqual(x[-1], 0)

    def test_prestress_counts_for_the_thresholds(self):
        run = pulmo.finished(FREE + ["-prestress", "-prestress_pressure", OPENING] + pulmo.programme("up 0.2 pressure 2\n"))
        rows = run.signals()
        self.assertAlmostEqual(rows["open_share"][-1], 0.2 * OPENING_RATE * 2, delta=1e-12)

    def test_order_in_time(self):
        """x = s_o r (t - t_o)^2 / 2 on a ramp r t that crosses p_o within a step; BDF2 keeps its order."""
        exact = OPENING_RATE * 16 * (1 - OPENING / 16) ** 2 / 2
        for scheme, order in (([], 1), (["-ts_type", "bdf"], 2)):
            errors = []
            for dt in (0.07, 0.035, 0.0175):
                rows = pulmo.finished(FREE + scheme + ["-ts_dt", dt] + pulmo.programme("rise 1 pressure 16 ramp 1\n")).signals()
                errors.append(abs(rows["open_share"][-1] - exact))
            observed = np.log2(np.array(errors[:-1]) / errors[1:])
            print(f"\n{scheme or 'backward Euler'}: errors of x {errors}, orders {observed}")
            self.assertGreater(observed.min(), order - 0.3)


class Lung(unittest.TestCase):
    def test_parts_have_thresholds_of_their_own(self):
        """One lung opens, the other does not; air goes where it opens."""
        run = pulmo.finished(["-dm_plex_filename", pulmo.mesh("lung_pair.msh"), "-elements", "P1-P1", "-output_fields_memory", "all"] +
                             pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + pulmo.QUIET + [
            "-tissue", LAW, "-ventilator_pip", "5", "-ts_max_time", "0.8", "-recruitment", *NUMBERS, "-recruitment_closing_pressure", "1",
            "-recruitment_opening_pressure", "30,right_lung=2"])
        rows, whole = run.signals(), run.json()
        share = whole["regions"]["right_lung"]["reference_volume_ml"] / whole["reference_volume_ml"]
        self.assertGreater(rows["open_share"].max(), 0.02)
        self.assertLess(rows["open_share"].max(), share)
        _, _, values = pulmo.fields(run)
        names = [name for name in values if "open_share" in name]
        self.assertEqual(len(names), 1)
        with h5py.File(run.path("fields.h5")) as mesh:
            open_share, region = values[names[0]].ravel(), mesh["region_number"][()].ravel()
        numbers = np.unique(region)
        self.assertEqual(len(numbers), 2)
        most = sorted(open_share[region == n].max() for n in numbers)
        self.assertEqual(most[0], 0)
        self.assertGreater(most[1], 0.05)

    def test_thresholds_of_a_part_are_checked(self):
        run = pulmo.Case(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + [
            "-recruitment", "-recruitment_closing_pressure", "4,left_lung=20"])
        self.assertEqual(run.code, 1)
        self.assertIn("-recruitment_closing_pressure is above -recruitment_opening_pressure in some part", run.err)


if __name__ == "__main__":
    pulmo.main()
