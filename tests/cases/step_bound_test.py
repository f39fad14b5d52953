#!/usr/bin/python3
"""-step_J_change, -step_p_change: no accepted step changes J, or the pressure p of the gas, by more than it may. A cube that fills by a
prescribed flow has J = 1 + V / V0 everywhere, so that the volumes of the rows tell ln J of each step, and the closed form of its law p; and
so the steps that there must be. With airflow p is read at all nodes from the fields of each step."""
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

    def test_no_step_changes_the_pressure_more(self):
        """p of all gas follows from the volumes by the closed form; the jump to nothing at the end is cut with its first step."""
        bound = 3.0
        scene = CUBE + pulmo.programme("inflation 1 flow 1000\nhold 0.5 hold\ndeflation 1 pressure 0\n")
        for name, options, ranks in (("backward Euler", [], 1), ("backward Euler", [], 2), ("BDF2", ["-ts_type", "bdf"], 1),
                                     ("by error", ["-step_volume_tolerance", "5", "-ts_adapt_dt_max", "0.5"], 1)):
            with self.subTest(name, ranks=ranks):
                case = pulmo.finished(scene + options + ["-step_p_change", str(bound)], ranks=ranks)
                p = pulmo.gas_pressure("rausch", 1 + case.signals()["volume_ml"] / 1000)
                steps = np.abs(np.diff(p))
                self.assertLessEqual(steps.max(), bound * (1 + 1e-6))
                top = pulmo.gas_pressure("rausch", 2.0)
                self.assertAlmostEqual(p.max(), top, places=5)
                self.assertAlmostEqual(p[-1], 0, places=5)
                least = 2 * math.ceil(top / bound)
                self.assertGreaterEqual(len(steps), least)
                self.assertLess(len(steps), 2 * least)
                self.assertGreater(case.json()["rejected_steps"], 0)
        self.assertGreater(np.abs(np.diff(pulmo.gas_pressure("rausch", 1 + pulmo.finished(scene).signals()["volume_ml"] / 1000))).max(), bound)

    def test_the_pressure_of_every_node(self):
        """With airflow: the fields of all steps have p at all nodes. Where little gets through, the most of a step is in the middle of
        the lung and not at its airway."""
        bound = 0.4
        scene = pulmo.DIRECT + pulmo.PCV + pulmo.LITRE + pulmo.QUIET + [
            "-tissue", "patte", "-airflow_permeability", "1e3", "-ts_dt", "0.1", "-ventilator_pip", "4", "-ventilator_ramp", "0.2",
            "-ventilator_inspiration", "0.5", "-ventilator_expiration", "0.5", "-output_fields_every", "1e-6"]

        def largest(case):
            steps = len([n for n in case.files() if n.startswith("fields_") and n.endswith(".h5")])
            self.assertEqual(steps, len(case.signals()["time_s"]))
            p = np.array([pulmo.fields(case, k)[2]["alveolar_pressure_cmH2O"] for k in range(steps)])
            return np.abs(np.diff(p, axis=0)).max(axis=1), np.abs(np.diff(case.signals()["airway_pressure_cmH2O"]))

        free = pulmo.finished(scene)
        self.assertGreater(largest(free)[0].max(), 1.5 * bound)
        for ranks in (1, 2):
            with self.subTest(ranks=ranks):
                case = pulmo.finished(scene + ["-step_p_change", str(bound)], ranks=ranks)
                anywhere, airway = largest(case)
                self.assertLessEqual(anywhere.max(), bound * (1 + 1e-6))
                # the bound is of all nodes: in some steps the airway alone would have allowed more
                self.assertTrue(((anywhere > 1.2 * airway) & (anywhere > 0.7 * bound)).any())
                self.assertGreaterEqual(len(anywhere), 2 * 4 / bound)
                self.assertGreater(case.json()["rejected_steps"], 0)
        far = pulmo.finished(scene + ["-step_p_change", "100"])
        for column, values in free.signals().items():
            self.assertEqual(list(values), list(far.signals()[column]), column)

    def test_both_bounds(self):
        """The tighter one of the two cuts: by p where the tissue is stiff, by J where it is soft."""
        case = pulmo.finished(CUBE + ["-tissue", "birzle", "-step_J_change", "0.1", "-step_p_change", "1"])
        J = 1 + case.signals()["volume_ml"] / 1000
        by_J, by_p = np.abs(np.diff(np.log(J))) / 0.1, np.abs(np.diff(pulmo.gas_pressure("birzle", J)))
        self.assertLessEqual(max(by_J.max(), by_p.max()), 1 + 1e-6)
        self.assertTrue(((by_J > 0.8) & (by_p < 0.6)).any())
        self.assertTrue(((by_p > 0.8) & (by_J < 0.6)).any())

    def test_a_pressure_bound_that_cannot_be_held_is_told(self):
        case = pulmo.Case(CUBE + ["-step_p_change", "1e-8"])
        self.assertEqual(case.code, 2, case.tail())
        self.assertIn("-step_p_change: p changed by ", case.err)
        self.assertIn("The bound of -step_p_change asks for shorter steps than there may be", case.err)
        self.assertIn("What to try: a larger -step_p_change", case.err)
        case = pulmo.Case(pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.STILL + pulmo.ROLLERS + ["-tissue", "rausch", "-step_p_change", "1"])
        self.assertEqual(case.code, 1, case.tail())
        self.assertIn("-step_p_change: this scene has no gas whose pressure could change; add -airflow or a -ventilator", case.err)


if __name__ == "__main__":
    pulmo.main()
