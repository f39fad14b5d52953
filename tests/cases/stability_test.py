#!/usr/bin/python3
"""A run never passes a state that is turned inside out: it gets past by smaller steps, or it stops and says why.

Also the small size of every case of the gallery (tools/hard_cases), which defines its scenes and demands once, and a slice of the
clinical envelope (tools/hard_cases --clinical).
"""
import os
import sys
import unittest

import numpy as np

import failure_test
import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from hardcases import envelope, gallery  # noqa: E402
from hardcases.lab import Lab  # noqa: E402

QUIET = ["-progress", "off"]
BERGER = pulmo.DIRECT + pulmo.PCV + QUIET + ["-tissue", "berger"]


class Stability(unittest.TestCase):
    def expect_stopped(self, case, *words):
        """Stopped with one clear sentence, the signals so far and the last good state; nothing looks finished."""
        self.assertEqual(case.code, 2, case.tail())
        self.assertEqual(case.err.count("pulmo: error:"), 1, case.err)
        self.assertNotIn("PETSC ERROR", case.err)
        for word in ("no step could be accepted after t =", "Tried dt ", "What to try: ", case.directory) + words:
            self.assertIn(word, case.err)
        files = case.files()
        for name in ("failure.json", "signals.csv.part", "fields.xdmf"):
            self.assertIn(name, files)
        for name in ("summary.json", "signals.csv"):
            self.assertNotIn(name, files)
        failure = case.json("failure.json")
        self.assertIs(failure["finished"], False)
        self.assertIn(failure["failure"], case.err)
        self.assert_sound(case, "signals.csv.part", "failure.json")
        self.assertGreater(failure["rejected_steps"], 0)

    def assert_sound(self, case, signals, summary):
        """No accepted row with J <= 0 or a number that is none."""
        rows = case.signals(signals)
        self.assertGreater(rows["min_J"].min(), 0)
        np.testing.assert_allclose(case.json(summary)["min_jacobian"], rows["min_J"].min(), rtol=1e-9)
        for name, column in rows.items():
            if name != "phase":
                self.assertTrue(np.isfinite(column).all(), name)

    def test_newton_that_converges_to_an_inside_out_state_is_not_believed(self):
        """The airway's rim folds; at the last steps Newton converges, but to J < 0."""
        for ranks in (1, 2):
            with self.subTest(ranks=ranks):
                case = pulmo.Case(BERGER + pulmo.CUBE + ["-ventilator_pip", "40", "-airflow_permeability", "10",
                                                         "-ts_max_time", "0.3"], ranks=ranks)
                self.expect_stopped(case, "converged to a state with J <= 0", "The tissue turned inside out: J = -",
                                    "-lumen_pressure", "berger")
                failure_test.expect_rim(self, case, 2.2)
                self.assertLess(case.signals("signals.csv.part")["time_s"][-1], 0.1)

    def test_berger_on_the_lung_at_high_pressure(self):
        case = pulmo.Case(BERGER + pulmo.LUNG + ["-ventilator_pip", "20", "-ts_adapt_dt_min", "1e-3",
                                                 "-ts_max_time", "0.3"])
        self.expect_stopped(case, "The tissue turned inside out: J = -")
        failure_test.expect_rim(self, case, 10)

    def test_steps_are_cut_and_grow_back(self):
        """The whole pressure in the first step is too much for the default step; later the step asked for returns.

        A jump is cut with the first step: it is a rise of pressure within that step. With twelve Newton steps at most:
        the whole step takes twice as many or more, and where among so many Newton ends hangs on rounding.
        """
        for law, pip, ramp in ("rausch", 40, 0), ("berger", 20, 0.1):
            with self.subTest(law):
                case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + QUIET + [
                    "-tissue", law, "-ventilator_pip", pip, "-ventilator_ramp", ramp, "-snes_max_it", "12", "-ts_max_time", "0.3"])
                self.assert_sound(case, "signals.csv", "summary.json")
                rows, summary = case.signals(), case.json()
                dt, time = rows["dt_s"][1:], rows["time_s"]
                self.assertGreater(summary["rejected_steps"], 0)
                self.assertLess(dt.min(), 0.05 * (1 - 1e-9), "a step was cut, whichever")
                self.assertAlmostEqual(dt[-1], 0.05, places=9)
                self.assertLess(dt.max(), 0.05 * (1 + 1e-9))
                grown = dt[1:] / dt[:-1]
                self.assertLess(grown.max(), 2 + 1e-6, "a step grows at most twofold")
                np.testing.assert_allclose(np.diff(time), dt, rtol=1e-9)
                self.assertEqual(summary["steps"], len(dt))
                self.assertAlmostEqual(time[-1], 0.3)
                np.testing.assert_allclose(rows["airway_pressure_cmH2O"], pip * np.minimum(1, time / (ramp or 0.05)),
                                           rtol=1e-9)

    def test_bordered_steps_at_very_high_permeability(self):
        """The airway pressure's column grows with k: the search along the step and the second solve must know of it."""
        for solver, ranks in ("direct", 1), ("iterative", 1), ("iterative", 2):
            with self.subTest(solver, ranks=ranks):
                case = pulmo.finished(pulmo.options_file(f"solvers/{solver}.opts") + pulmo.VCV + pulmo.LITRE + pulmo.COMMON + QUIET + [
                    "-tissue", "yoshihara", "-ventilator_tidal_volume", 250, "-airflow_permeability", 1e10, "-ts_max_time", 0.3],
                    ranks=ranks)
                rows, summary = case.signals(), case.json()
                self.assertEqual(summary["rejected_steps"], 0)
                self.assertLess(rows["newton_iterations"].max(), 10)
                self.assertLess(summary["krylov_iterations"], 15 * summary["newton_iterations"])
                np.testing.assert_allclose(rows["volume_ml"], 250 * rows["time_s"], rtol=1e-9, atol=1e-9)


class Envelope(unittest.TestCase):
    """A slice of tools/hard_cases --clinical."""

    def test_breaths_of_a_ward(self):
        for (setting, prestress, law), verdict in envelope.SLICE.items():
            with self.subTest(setting=setting, prestress=prestress, law=law):
                lab = Lab(pulmo.PROGRAM, True)
                row = envelope.run_one(lab, pulmo.mesh("lung_test.msh"), 1350, setting, prestress, law, checks=False)
                print(f"{row['cpu_s']:.1f} s CPU ... ", end="", file=sys.stderr, flush=True)
                self.assertEqual(row["verdict"], verdict, row)
                self.assertEqual("fault" in row, False, row)
                self.assertEqual(row["end"] == "finished", verdict == "finishes", row)


class Gallery(unittest.TestCase):
    """tools/hard_cases at the size of a test."""


def add(name):
    def test(self):
        result = gallery.run_case(name, pulmo.PROGRAM, small=True)
        print(f"{result['cpu_s']:.1f} s CPU ... ", end="", file=sys.stderr, flush=True)
        self.assertGreater(len(result["demands"]), 0)
        for demand in result["demands"]:
            with self.subTest(demand["what"]):
                self.assertTrue(demand["met"], f"{demand['measured']} for {demand['asked']}")

    test.__doc__ = gallery.CASES[name].title
    setattr(Gallery, "test_" + name, test)


for _name in gallery.CASES:
    add(_name)

if __name__ == "__main__":
    pulmo.main()
