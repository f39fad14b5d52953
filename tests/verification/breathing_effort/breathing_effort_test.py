#!/usr/bin/python3
"""Suction by muscles: exactly a pressure of the airway by Piola's identity; its work; breaths that it triggers.

By hand: tests/verification/breathing_effort/breathing_effort_test.py build/pulmo
"""
import os
import sys
import unittest

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import pulmo_case as pulmo  # noqa: E402

J_PER_CMH2O_ML = pulmo.KPA_PER_CMH2O * 1e-3
TISSUE = pulmo.TIGHT + pulmo.QUIET + ["-tissue", "birzle", "-chest_wall", "-chest_wall_surfaces", "pleura,airway",
                                      "-chest_wall_stiffness", "0.08", "-ts_dt", "0.05"]
LUNG, LITRE = TISSUE + pulmo.LUNG, TISSUE + pulmo.LITRE + ["-elements", "P1-P1"]
GAS = ["-airflow", "-airflow_permeability", "1e4"]
EFFORT = ["-breathing_effort"]
PULSES = EFFORT + ["-breathing_effort_pressure", "6", "-breathing_effort_rise", "0.3", "-breathing_effort_hold", "0.1",
                   "-breathing_effort_fall", "0.2", "-breathing_effort_period", "1"]
TOP = 4  # cmH2O


def table(rows):
    path = pulmo.scratch("effort.csv")
    with open(path, "w") as f:
        f.write("time_s,pressure_cmH2O\n" + "".join(f"{t},{p}\n" for t, p in rows))
    return ["-breathing_effort_file", path]


def breath(top):
    return pulmo.programme(f"inspiration 0.3 pressure {top} ramp 0.3\npause 0.2 pressure {top}\nexpiration 0.3 pressure 0 ramp 0.3\n"
                           "rest 0.2 pressure 0\n")


TRAPEZE = EFFORT + table([(0, 0), (0.3, TOP), (0.5, TOP), (0.8, 0), (1, 0)])


class AirwayPressure(unittest.TestCase):
    """Pressure p0(t) in the airway and an unloaded pleura, or none and suction p0(t)."""

    def both(self, options):
        return pulmo.finished(LUNG + options + breath(TOP)), pulmo.finished(LUNG + options + breath(0) + TRAPEZE)

    def test_the_same_at_every_point(self):
        for options in (GAS + ["-elements", "P2-P1"], GAS + ["-elements", "P1-P1", "-ts_type", "bdf"], ["-airflow", "off"]):
            blown, sucked = self.both(options)
            a, b = blown.signals(), sucked.signals()
            np.testing.assert_allclose(b["time_s"], a["time_s"], atol=1e-12)
            self.assertGreater(np.ptp(a["volume_ml"]), 50)
            np.testing.assert_allclose(b["volume_ml"], a["volume_ml"], rtol=0, atol=1e-10 * 1350)
            np.testing.assert_allclose(b["flow_ml_per_s"], a["flow_ml_per_s"], rtol=0, atol=1e-9 * 1350)
            np.testing.assert_allclose(b["min_J"], a["min_J"], rtol=0, atol=1e-10)
            np.testing.assert_allclose(b["max_J"], a["max_J"], rtol=0, atol=1e-10)
            np.testing.assert_allclose(b["transrespiratory_pressure_cmH2O"], a["airway_pressure_cmH2O"], rtol=0, atol=1e-12)
            for step, p0 in ((1, TOP), (2, TOP), (3, 0)):  # the ends of the phases
                x, y = pulmo.fields(blown, step)[2], pulmo.fields(sucked, step)[2]
                self.assertGreater(np.abs(x["displacement_mm"]).max(), 1e-3 if p0 else -1)
                np.testing.assert_allclose(y["displacement_mm"], x["displacement_mm"], rtol=0, atol=1e-9)
                np.testing.assert_allclose(y["J_mean"], x["J_mean"], rtol=0, atol=1e-10)
                if "-airflow_permeability" in options:
                    p, q = x["alveolar_pressure_cmH2O"], y["alveolar_pressure_cmH2O"]
                    np.testing.assert_allclose(q, p - p0, rtol=0, atol=1e-9)

    def test_not_so_where_the_gas_does_not_press_on_the_airway(self):
        blown, sucked = self.both(GAS + ["-elements", "P1-P1", "-lumen_pressure", "off"])
        self.assertGreater(np.abs(blown.signals()["max_J"] - sucked.signals()["max_J"]).max(), 1e-3)


class Course(unittest.TestCase):
    def pulse(self, t):
        if t < 0:
            return 0
        s = t % 1
        return 6 * (0.5 - 0.5 * np.cos(np.pi * s / 0.3) if s < 0.3 else 1 if s <= 0.4 else
                    0.5 + 0.5 * np.cos(np.pi * (s - 0.4) / 0.2) if s < 0.6 else 0)

    def test_pulses_begin_when_the_lung_has_settled(self):
        case = pulmo.finished(LITRE + GAS + PULSES + ["-breathing_effort_delay", "0.1"] + pulmo.programme(
            "settle 0.5 pressure 5 ramp 0.25\ninspiration 0.6 pressure 5\nexpiration 1 pressure 5\n"))
        rows = case.signals()
        wanted = [self.pulse(t - 0.6) for t in rows["time_s"]]
        np.testing.assert_allclose(rows["muscle_pressure_cmH2O"], wanted, rtol=0, atol=1e-9)
        self.assertGreater(case.json()["tidal_volume_ml"], 50)

    def test_the_muscles_do_the_work(self):
        case = pulmo.finished(LITRE + GAS + PULSES + ["-ts_max_time", "1"])  # no ventilator
        rows, energy = case.signals(), case.json()["energy_j"]
        self.assertNotIn("phase", rows)
        self.assertLess(energy["residual_relative"], 1e-9)
        self.assertEqual(energy["ventilator_work"], 0)
        # the airway hardly moves: the pleura sweeps the volume
        swept = (rows["muscle_pressure_cmH2O"][1:] * np.diff(rows["volume_ml"])).sum() * J_PER_CMH2O_ML
        self.assertGreater(swept, 1e-3)
        self.assertAlmostEqual(energy["muscles"] / swept, 1, delta=0.05)

    def test_order_in_time(self):
        """Of the volume at the end of the rise: second with BDF2, first with backward Euler."""
        for scheme, order in ((["-ts_type", "bdf"], 2), ([], 1)):
            volume = []
            for dt in 0.05, 0.025, 0.0125:
                rows = pulmo.finished(LITRE + GAS + PULSES + scheme + ["-ts_max_time", "0.3", "-ts_dt", dt]).signals()
                volume.append(rows["volume_ml"][-1])
            observed = np.log2((volume[0] - volume[1]) / (volume[1] - volume[2]))
            self.assertAlmostEqual(observed, order, delta=0.35)


class Support(unittest.TestCase):
    """Breaths that begin with an effort and end with the flow."""

    SCENE = LITRE + GAS + PULSES + ["-breathing_effort_period", "2", "-ts_dt", "0.02"]

    @staticmethod
    def phases(trigger="trigger 40"):
        return pulmo.programme(f"settle 1.5 pressure 4 ramp 0.25\nwait 3 pressure 4 {trigger}\nrepeat 2\n"
                               f"  inspiration 1 pressure 9 ramp 0.1 cycle 25\n  expiration 3 pressure 4 {trigger}\nend\n")

    @staticmethod
    def parts(rows):
        """Name, first and last row of each phase."""
        names, parts = rows["phase"], []
        for i in range(1, len(names)):
            if i == 1 or names[i] != names[i - 1]:
                parts.append([names[i], i, i])
            parts[-1][2] = i
        return parts

    def test_phases_end_with_the_first_row_that_says_so(self):
        case = pulmo.finished(self.SCENE + self.phases())
        rows = case.signals()
        time, flow = rows["time_s"], rows["flow_ml_per_s"]
        parts = self.parts(rows)
        self.assertEqual([p[0] for p in parts], ["settle", "wait"] + ["inspiration", "expiration"] * 2)
        for name, first, last in parts[1:]:
            q = flow[first:last + 1]
            over = q > 40 if name != "inspiration" else q < 0.25 * np.maximum.accumulate(np.maximum(q, 0))
            self.assertTrue(over[-1], name)
            self.assertFalse(over[:-1].any(), name)
            self.assertLess(time[last] - time[first], {"wait": 2.9, "inspiration": 0.95, "expiration": 2.9}[name])
        begin = [time[first - 1] for name, first, _ in parts if name == "inspiration"]
        self.assertAlmostEqual(begin[1] - begin[0], 2, delta=0.1)  # as the muscles do
        summary = case.json()
        self.assertEqual(len(summary["breaths"]), 2)
        self.assertLess(summary["energy_j"]["residual_relative"], 1e-9)
        self.assertGreater(summary["energy_j"]["muscles"], 0)

    def test_an_effort_that_is_too_weak_triggers_nothing(self):
        rows = pulmo.finished(self.SCENE + self.phases() + ["-breathing_effort_pressure", "0.3"]).signals()
        ends = [rows["time_s"][last] for name, _, last in self.parts(rows) if name != "inspiration"]
        self.assertAlmostEqual(ends[1], 4.5, places=9)
        lengths = [rows["time_s"][last] - rows["time_s"][first - 1] for name, first, last in self.parts(rows) if name == "expiration"]
        np.testing.assert_allclose(lengths, [3, 3], atol=1e-9)

    def test_a_closed_valve_feels_the_pressure_fall(self):
        rows = pulmo.finished(self.SCENE + pulmo.programme(
            "settle 1.5 pressure 4 ramp 0.25\nwait 3 hold trigger 1\ninspiration 0.5 pressure 8\n")).signals()
        name, first, last = self.parts(rows)[1]
        p = rows["airway_pressure_cmH2O"]
        top = np.maximum.accumulate(p[first - 1:last + 1])[1:]
        over = p[first:last + 1] < top - 1
        self.assertTrue(over[-1])
        self.assertFalse(over[:-1].any())
        self.assertLess(rows["time_s"][last], 2)
        np.testing.assert_allclose(rows["volume_ml"][first:last + 1], rows["volume_ml"][first - 1], rtol=0, atol=1e-7)

    def test_any_number_of_ranks_and_a_restart(self):
        for scheme in ([], ["-ts_type", "bdf"]):
            options = self.SCENE + self.phases() + scheme
            whole = pulmo.finished(options).signals()
            two = pulmo.finished(options, ranks=2).signals()
            self.assertEqual(two["phase"], whole["phase"])
            np.testing.assert_allclose(two["volume_ml"], whole["volume_ml"], rtol=0, atol=1e-6)
            parts = self.parts(whole)
            wait, inspiration, expiration = parts[1:4]
            # within each phase, and where one ended early
            for row in (wait[1] + 3, inspiration[1] + 4, inspiration[2], expiration[1] + 9):
                first = pulmo.finished(options + ["-ts_max_time", repr(whole["time_s"][row]), "-checkpoint_every", "100"])
                second = pulmo.finished(options + ["-restart", first.path("checkpoint.h5")]).signals()
                self.assertEqual(second["phase"], whole["phase"])
                for column in ("time_s", "volume_ml", "flow_ml_per_s", "airway_pressure_cmH2O"):
                    np.testing.assert_allclose(second[column], whole[column], rtol=0, atol=1e-8, err_msg=column)


class Words(unittest.TestCase):
    def refused(self, options, *words):
        case = pulmo.Case(LITRE + GAS + ["-ventilator", "pcv"] + options)
        self.assertEqual(case.code, 1, case.tail())
        lines = [line for line in case.err.splitlines() if line.startswith("pulmo: error: ")]
        self.assertEqual(len(lines), 1, case.tail())
        for word in words:
            self.assertIn(word, lines[0])

    def test_what_cannot_be_meant(self):
        self.refused(EFFORT + ["-breathing_effort_surfaces", "airway"], "-breathing_effort_surfaces", "'airway'")
        self.refused(EFFORT + ["-breathing_effort_surfaces", "pleura,skin"], "-breathing_effort_surfaces", "skin")
        self.refused(EFFORT + ["-breathing_effort_period", "1"], "-breathing_effort_period", "longer")
        self.refused(EFFORT + ["-breathing_effort_pressure", "-1"], "-breathing_effort_pressure")
        self.refused(EFFORT + table([(0, 0), (1, 2), (2, 1)]), "must be 0")
        self.refused(EFFORT + table([(0, 0), (1, 2), (1, 0)]), "effort.csv:4", "increase")
        self.refused(EFFORT + table([(0, 0), (1, -2), (2, 0)]), "effort.csv:3")
        self.refused(EFFORT + table([(0, 0), (1, 0)]), "at least three")
        for line, words in (("wait 1 flow 10 trigger 3", "'trigger'"), ("wait 1 hold cycle 3", "'cycle'"),
                            ("wait 1 pressure 3 trigger 0", "positive"), ("wait 1 pressure 3 cycle 100", "between 0 and 100"),
                            ("wait 1 pressure 3 cycle 10 trigger 3", "one of them")):
            self.refused(EFFORT + pulmo.programme(line + "\n"), "programme.txt:1", words)


if __name__ == "__main__":
    pulmo.main()
