#!/usr/bin/python3
"""-step_J_change: no accepted step changes J by more than it may. A cube that fills by a prescribed flow has J = 1 + V / V0 everywhere,
so that the volumes of the rows tell ln J of each step, and the steps that there must be."""
import math
import unittest

import numpy as np

import pulmo_case as pulmo

# 1000 ml in one second, and back: J from 1 to 2 and to 1
CUBE = pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.STILL + pulmo.ROLLERS + ["-tissue", "rausch", "-ts_dt", "0.5"] + pulmo.programme(
    "inflation 1 flow 1000\nhold 0.5 hold\ndeflation 1 flow -1000\n")
BOUND = 0.05


def changes(case, name="signals.csv"):
    J = 1 + case.signals(name)["volume_ml"] / 1000
    return np.abs(np.diff(np.log(J)))


class StepBound(unittest.TestCase):
    def test_no_step_changes_more(self):
        for name, options, ranks in (("backward Euler", [], 1), ("backward Euler", [], 2), ("BDF2", ["-ts_type", "bdf"], 1),
                                     ("by error", ["-step_pressure_tolerance", "5", "-ts_adapt_dt_max", "0.5"], 1)):
            with self.subTest(name, ranks=ranks):
                case = pulmo.finished(CUBE + options + ["-step_J_change", str(BOUND)], ranks=ranks)
                steps = changes(case)
                self.assertLessEqual(steps.max(), BOUND * (1 + 1e-9))
                self.assertAlmostEqual(case.signals()["volume_ml"].max(), 1000, places=4)
                least = 2 * math.ceil(math.log(2) / BOUND) + 1
                self.assertGreaterEqual(len(steps), least)
                self.assertLess(len(steps), 2 * least)
                summary = case.json()
                self.assertGreater(summary["rejected_steps"], 0)
                # the step after a cut one is no longer than it may be: few of all are tried in vain
                self.assertLess(summary["rejected_steps"], 0.4 * len(steps))

    def test_off_and_far_off_are_the_same(self):
        off = pulmo.finished(CUBE)
        far = pulmo.finished(CUBE + ["-step_J_change", "10"])
        self.assertGreater(changes(off).max(), BOUND)
        for column, values in off.signals().items():
            self.assertEqual(list(values), list(far.signals()[column]), column)
        self.assertEqual(off.json()["rejected_steps"], 0)

    def test_goes_on_as_if_it_had_never_stopped(self):
        options = CUBE + ["-step_J_change", str(BOUND)]
        whole = pulmo.finished(options + ["-checkpoint_every", "0.37"])
        part = pulmo.finished(options + ["-restart", whole.path("checkpoint_previous.h5")])
        self.assertEqual(list(whole.signals()["time_s"]), list(part.signals()["time_s"]))
        self.assertEqual(whole.json()["rejected_steps"], part.json()["rejected_steps"])

    def test_a_bound_that_cannot_be_held_is_told(self):
        case = pulmo.Case(CUBE + ["-step_J_change", "1e-9"])
        self.assertEqual(case.code, 2, case.tail())
        self.assertIn("-step_J_change: |ln J| changed by ", case.err)
        self.assertIn("The bound of -step_J_change asks for shorter steps than there may be", case.err)
        self.assertIn("What to try: a larger -step_J_change", case.err)


if __name__ == "__main__":
    pulmo.main()
