#!/usr/bin/python3
"""Airspaces that open and close: the open share and the volume of free tissue in closed form, order in time, what is left at p = 0.

By hand: tests/verification/recruitment/recruitment_test.py build/pulmo
"""
import os
import re
import subprocess
import sys
import unittest

import h5py
import meshio
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


class ManyUnits(unittest.TestCase):
    """Each cell of a block opens at a pressure of its own while the pressure rises: the mean share in closed form."""

    @classmethod
    def setUpClass(cls):
        mesh = meshio.read(pulmo.mesh("cube_coarse.msh"))
        corners = mesh.points[mesh.cells_dict["tetra"]]
        cls.volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        cls.opening = np.linspace(4, 12, len(cls.volume))
        cls.file = pulmo.scratch("opening.h5")
        with h5py.File(cls.file, "w") as file:
            file["p"] = cls.opening

    def orders(self, scheme, rate):
        """Errors of the mean share at the end of a ramp to 16 cmH2O in 1 s, and their orders."""
        share = np.minimum(rate * 16 * (1 - self.opening / 16) ** 2 / 2, 1)
        exact, errors = np.average(share, weights=self.volume), []
        for dt in (0.07, 0.035, 0.0175):
            rows = pulmo.finished(FREE + scheme + ["-recruitment_opening_pressure", self.file + ":p", "-recruitment_opening_rate", rate,
                                                   "-ts_dt", dt] + pulmo.programme("rise 1 pressure 16 ramp 1\n")).signals()
            errors.append(abs(rows["open_share"][-1] - exact))
        orders = np.log2(np.array(errors[:-1]) / errors[1:])
        print(f"\nrate {rate}, {scheme or 'backward Euler'}: errors of the mean share {errors}, orders {orders}, open at the end {np.sum(share == 1)} of {len(share)}")
        return orders

    def test_order_while_many_open(self):
        self.assertGreater(self.orders([], 0.2).min(), 0.7)
        self.assertGreater(self.orders(["-ts_type", "bdf"], 0.2).min(), 1.7)

    def test_order_where_many_have_opened(self):
        self.assertGreater(self.orders(["-ts_type", "bdf"], 0.6).min(), 1.7)  # 14 of 24 cells


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
        left, right = (whole["regions"][name] for name in ("left_lung", "right_lung"))
        self.assertEqual((left["open_share"], left["recruited_volume_ml"]), (0, 0))
        at = np.abs(rows["recruited_volume_ml"] - right["recruited_volume_ml"]).argmin()  # the whole is the sum of its parts, at one time
        self.assertAlmostEqual(right["recruited_volume_ml"], rows["recruited_volume_ml"][at], delta=1e-9)
        self.assertAlmostEqual(share * right["open_share"], rows["open_share"][at], delta=1e-12)
        self.assertGreater(right["recruited_volume_ml"], 1)

    def test_thresholds_of_a_part_are_checked(self):
        run = pulmo.Case(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + [
            "-recruitment", "-recruitment_closing_pressure", "4,left_lung=20"])
        self.assertEqual(run.code, 1)
        self.assertIn("-recruitment_closing_pressure is above -recruitment_opening_pressure in some part", run.err)


class ClosedAirspacesResist(unittest.TestCase):
    """-recruitment_permeability in a breath in which airspaces open and close, with weight: the gas bears a force then."""
    SCENE = (pulmo.options_file("scenes/pcv.opts") + pulmo.TIGHT + pulmo.QUIET + pulmo.LUNG + [
        "-elements", "P1-P1", "-quadrature_degree", "2", "-tissue", "patte", "-airflow_permeability", "1e4", "-airflow_permeability_law", "exponential", "-gravity",
        "-tissue_porosity", "0.75", "-chest_wall_direction", "normal", "-ventilator_pip", "8", "-ventilator_inspiration", "0.2",
        "-ventilator_expiration", "0.2", "-ventilator_settle", "off", "-ventilator_ramp_down", "0.1", "-ts_dt", "0.05", "-recruitment",
        "-recruitment_opening_pressure", "1.5", "-recruitment_closing_pressure", "1", "-recruitment_opening_rate", "4", "-recruitment_start", "0.2"])
    SLOW = ["-recruitment_permeability", "0.1"]

    def test_energy_gas_restart_ranks(self):
        whole = pulmo.finished(self.SCENE + self.SLOW + ["-checkpoint_every", "0.2"])
        rows, numbers = whole.signals(), whole.json()
        self.assertGreater(np.ptp(rows["open_share"]), 0.1)
        self.assertLess(abs(numbers["energy_j"]["residual_relative"]), 1e-9)
        self.assertLess(abs(numbers["mass_balance_error_ml"]), 1e-6)
        self.assertLess(numbers["newton_iterations"], 6 * numbers["steps"])  # the tangent knows dx/dp
        others = [pulmo.finished(self.SCENE + self.SLOW, ranks=2), pulmo.finished(self.SCENE + self.SLOW + ["-petscfe_type", "basic"]),
                  pulmo.finished(self.SCENE + self.SLOW + ["-restart", whole.path("checkpoint_previous.h5")])]
        for other in others:
            for name in ("volume_ml", "open_share"):
                np.testing.assert_allclose(other.signals()[name], rows[name], atol=1e-8 * np.abs(rows[name]).max())
        bdf = pulmo.finished(self.SCENE + self.SLOW + ["-ts_type", "bdf"]).signals()
        self.assertLess(abs(bdf["volume_ml"].max() / rows["volume_ml"].max() - 1), 0.15)
        # the flow is slower, and with all open it is what it was
        free = pulmo.finished(self.SCENE).signals()
        self.assertLess(rows["volume_ml"].max(), 0.95 * free["volume_ml"].max())
        still = ["-recruitment_opening_pressure", "1e3", "-recruitment_closing_pressure", "-1e3", "-recruitment_start", "1"]
        a, b = (pulmo.finished(self.SCENE + still + more).signals() for more in (self.SLOW, []))
        np.testing.assert_allclose(a["volume_ml"], b["volume_ml"], atol=1e-9 * b["volume_ml"].max())

    def test_needs_gas_that_flows(self):
        run = pulmo.Case(FREE + self.SLOW + pulmo.programme(UP_AND_DOWN))
        self.assertEqual(run.code, 1)
        self.assertIn("-recruitment_permeability needs gas that flows: give -airflow", run.err)


class Trial(unittest.TestCase):
    """A short form of scenes/ards_peep_trial.opts: on lung_test.msh, with its formulas, one breath at each of three levels."""
    SCENE = os.path.join(pulmo.SOURCE, "petsc_options", "scenes", "ards_peep_trial.opts")
    LEVELS = (20, 11, 2)

    @classmethod
    def values_for(cls, mesh, file):
        with open(cls.SCENE) as scene:
            formulas = re.findall(r'"(\w+=[^"]*)"', scene.read())
        subprocess.run([os.path.join(pulmo.SOURCE, "tools", "cell_values"), mesh, file, *formulas], check=True, stdout=subprocess.DEVNULL)
        return [formula.partition("=")[0] for formula in formulas]

    @classmethod
    def setUpClass(cls):
        values = pulmo.scratch("values.h5")
        cls.values_for(pulmo.mesh("lung_test.msh"), values)

        def run(*phases):
            return pulmo.finished(pulmo.options_file("solvers/reuse.opts") + pulmo.options_file("scenes/ards_peep_trial.opts") + pulmo.QUIET + [
                *pulmo.LUNG, "-elements", "P1-P1", "-ts_dt", "0.5", "-airflow_permeability", values + ":k",
                "-recruitment_opening_pressure", values + ":opening", "-recruitment_closing_pressure", values + ":closing",
                "-recruitment_start", values + ":start"] + pulmo.programme("".join(phases)))

        def level(p):
            return (f"expiration 2.5 pressure {p} ramp 0.5\ninspiration 1 pressure {p + 10} ramp 0.5\n"
                    f"expiration 1.5 pressure {p} ramp 0.5\n")
        cls.down = run("settle 0.5 pressure 0\n", "recruit 3 pressure 35 ramp 1\n", *map(level, cls.LEVELS))
        cls.up = run("settle 0.5 pressure 0\n", *map(level, cls.LEVELS[::-1]))

    def test_values_of_the_scene_are_those_of_its_formulas(self):
        made = pulmo.scratch("values.h5")
        names = self.values_for(pulmo.mesh("lung_pair.msh"), made)
        self.assertEqual(names, ["k", "opening", "closing", "start"])
        with h5py.File(made) as a, h5py.File(pulmo.mesh("lung_pair_ards.h5")) as b:
            for name in names:
                np.testing.assert_array_equal(a[name][()], b[name][()])

    def test_best_compliance_lies_between_the_levels(self):
        """Below, airspaces are closed; above, tissue is stretched until it stiffens."""
        trial = self.down.json()["peep_trial"]
        levels = trial["levels"]
        np.testing.assert_allclose([level["peep_cmH2O"] for level in levels], self.LEVELS, atol=1e-9)
        self.assertAlmostEqual(trial["peep_of_best_compliance_cmH2O"], self.LEVELS[1], delta=1e-9)
        best = trial["best_compliance_ml_per_cmH2O"]
        for level in (levels[0], levels[2]):
            self.assertLess(level["compliance_ml_per_cmH2O"], 0.95 * best)
        shares = [level["open_share"] for level in levels]
        self.assertGreater(shares[1], 0.9 * shares[0])  # what closes, closes below the best level
        self.assertLess(shares[2], 0.6 * shares[1])

    def test_more_is_open_on_the_way_down(self):
        down = self.down.json()["peep_trial"]["levels"]
        up = self.up.json()["peep_trial"]["levels"][::-1]
        for p, after, before in zip(self.LEVELS, down, up):
            self.assertAlmostEqual(before["peep_cmH2O"], p, delta=1e-9)
            self.assertGreaterEqual(after["open_share"], before["open_share"] - 1e-12)
        for level in range(2):
            self.assertGreater(down[level]["recruited_volume_ml"], 1.1 * up[level]["recruited_volume_ml"])

    def test_levels_by_region(self):
        for level in self.down.json()["peep_trial"]["levels"]:
            for name in ("open_share", "recruited_volume_ml"):
                self.assertAlmostEqual(sum(r[name] for r in level["regions"].values()), level[name], delta=1e-9)  # one body


if __name__ == "__main__":
    pulmo.main()
