#!/usr/bin/python3
"""The ventilator's modes: volumes that are prescribed are delivered, pressures are those of closed forms, programmes do
what their files say."""
import os
import re
import unittest

import numpy as np

import pulmo_case as pulmo

DT = 0.05
SUPERSYRINGE = pulmo.options_file("scenes/supersyringe.opts") + pulmo.PAPER


class Delivery(unittest.TestCase):
    """Volume control: 1e-9 of the tidal volume, ends of phases, switches between flow and pressure."""
    V_T, PEEP, INSPIRATION, PAUSE, EXPIRATION, RAMP, RAMP_DOWN, BREATHS = 210, 3, 0.42, 0.23, 0.6, 0.13, 0.17, 2
    OPTIONS = pulmo.VCV + pulmo.LITRE + pulmo.QUIET + [
        "-ventilator_tidal_volume", V_T, "-ventilator_peep", PEEP, "-ventilator_inspiration", INSPIRATION,
        "-ventilator_pause", PAUSE, "-ventilator_expiration", EXPIRATION, "-ventilator_ramp", RAMP,
        "-ventilator_ramp_down", RAMP_DOWN, "-ventilator_breaths", BREATHS]

    def schedule(self):
        """(name, begin, end) and, for each phase, what it delivers by time since its begin (None: pressure)."""
        def inspired(s):
            plateau = self.V_T / (self.INSPIRATION - self.RAMP / 2)
            return plateau * np.where(s < self.RAMP, s * s / (2 * self.RAMP), s - self.RAMP / 2)

        t = 0.0
        for name, duration, delivered in [("settle", self.RAMP + self.EXPIRATION, None)] + self.BREATHS * [
                ("inspiration", self.INSPIRATION, inspired), ("pause", self.PAUSE, np.zeros_like),
                ("expiration", self.EXPIRATION, None)]:
            yield name, t, t + duration, delivered
            t += duration

    def expect_delivered(self, case, sum_tolerance):
        rows = case.signals()
        t, P, Q, V, dt = (rows[c] for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml", "dt_s"))
        phase = np.array(rows["phase"])
        covered = 1
        for name, begin, end, delivered in self.schedule():
            first, last = int(np.abs(t - begin).argmin()), int(np.abs(t - end).argmin())
            self.assertLess(max(abs(t[first] - begin), abs(t[last] - end)), 1e-13 * t[-1] * 10, "phases end on time")
            mine = slice(first + 1, last + 1)
            self.assertEqual(set(phase[mine]), {name})
            covered += last - first
            since = t[mine] - begin
            if delivered is None:
                start = P[first] if name == "expiration" else 0
                ramp = self.RAMP_DOWN if name == "expiration" else self.RAMP
                np.testing.assert_allclose(
                    P[mine], start + (self.PEEP - start) * np.minimum(since / ramp, 1), atol=1e-12 * P.max(),
                    err_msg="pressure goes from what the airway had to what is set")
            else:
                np.testing.assert_allclose(V[mine] - V[first], delivered(since), rtol=0, atol=1e-9 * self.V_T)
                flow = np.diff(delivered(np.concatenate([[0], since]))) / dt[mine]
                np.testing.assert_allclose(Q[mine], flow, rtol=0, atol=1e-9 * self.V_T / DT)
        self.assertEqual(covered, len(t))
        total = np.cumsum(dt * Q)
        self.assertLess(np.abs(total - V).max(), sum_tolerance * self.V_T, "flow and volume tell the same")
        self.assertEqual(case.json()["rejected_steps"], 0)
        return rows

    def test_tight(self):
        for scene, options in (("uniform", pulmo.UNIFORM), ("common", pulmo.COMMON), ("still", pulmo.STILL)):
            with self.subTest(scene):
                rows = self.expect_delivered(pulmo.finished(pulmo.TIGHT + self.OPTIONS + options), 1e-9)
                self.assertGreater(np.ptp(rows["airway_pressure_cmH2O"]), 3)

    def test_direct(self):
        """Newton to 1e-8 only: volumes that are prescribed are met all the same."""
        for scene, options in (("uniform", pulmo.UNIFORM), ("common", pulmo.COMMON), ("still", pulmo.STILL)):
            with self.subTest(scene):
                self.expect_delivered(pulmo.finished(pulmo.DIRECT + self.OPTIONS + options), 1e-9)

    def test_whole_lung(self):
        """The paper's VCV on the test lung: 250 ml, half of the pair's."""
        options = pulmo.DIRECT + pulmo.VCV + pulmo.LUNG + pulmo.QUIET + ["-ventilator_tidal_volume", 250, "-ts_dt", "0.25",
                                                             "-ts_max_time", "1.25"]
        for split in (pulmo.UNIFORM, pulmo.COMMON):
            rows = pulmo.finished(options + split).signals()
            self.assertAlmostEqual(rows["time_s"][-1], 1.25, places=12)
            inspiration = np.array(rows["phase"]) == "inspiration"
            np.testing.assert_allclose(rows["volume_ml"][inspiration], 250 * rows["time_s"][inspiration], rtol=0,
                                       atol=1e-9 * 250)
            np.testing.assert_allclose(rows["volume_ml"][~inspiration], 250, rtol=1e-9)
            plateau = rows["airway_pressure_cmH2O"][-1]
            self.assertLess(plateau, rows["airway_pressure_cmH2O"][inspiration][-1])


class ClosedForms(unittest.TestCase):
    """Free inflation by volume, without airflow: J = 1 + V/V0 and the pressure is dW/dJ."""

    @staticmethod
    def options(law, support, J, dt):
        return pulmo.TIGHT + pulmo.BLOCK + pulmo.PAPER + pulmo.QUIET + support + [
            "-tissue", law, "-ventilator", "vcv", "-ventilator_tidal_volume", 1000 * (J - 1), "-ts_dt", dt,
            "-ventilator_pause", "0.1", "-ts_max_time", "1.1"]

    def test_pressure_of_a_volume(self):
        # rausch has no shear stiffness in pure dilatation: few, large steps
        for law, support, J, dt in (
                ("berger", pulmo.PINS, 3, 0.1), ("ma", pulmo.PINS, 2, 0.1), ("birzle", pulmo.ROLLERS, 4.3, 0.1),
                ("yoshihara", pulmo.PINS, 4, 0.1), ("rausch", pulmo.ROLLERS, 1.1, 0.25)):
            with self.subTest(law):
                rows = pulmo.finished(self.options(law, support, J, dt)).signals()
                V, P = rows["volume_ml"], rows["airway_pressure_cmH2O"]
                t = rows["time_s"]
                np.testing.assert_allclose(V, 1000 * (J - 1) * np.minimum(t, 1), rtol=0, atol=1e-9 * V[-1])
                np.testing.assert_allclose(P[1:], pulmo.gas_pressure(law, 1 + V[1:] / 1000), rtol=1e-11)
                np.testing.assert_allclose([rows["min_J"], rows["max_J"]], [1 + V / 1000] * 2, rtol=1e-6)

    def test_beyond_the_limit_point(self):
        """yoshihara: 16.83 cmH2O at J = 2.534 is all it holds. By volume pulmo goes over the top and down again."""
        rows = pulmo.finished(self.options("yoshihara", pulmo.ROLLERS, 4, 0.02)).signals()
        J, P = 1 + rows["volume_ml"] / 1000, rows["airway_pressure_cmH2O"]
        top = P.argmax()
        self.assertAlmostEqual(P[top], 16.83, delta=0.01)
        self.assertAlmostEqual(J[top], 2.534, delta=0.06)
        self.assertTrue((np.diff(P[:top + 1]) > 0).all())
        falls = P[top:np.argmax(rows["time_s"] > 1 - 1e-9) + 1]
        self.assertTrue((np.diff(falls) < 0).all())
        self.assertLess(falls[-1], 16)

    def test_no_equilibrium_above_the_limit_pressure(self):
        below, above = (pulmo.Case(pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.ROLLERS + [
            "-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", pip, "-ventilator_ramp", "1",
            "-ts_max_time", "1"]) for pip in (16.7, 17.2))
        self.assertEqual(below.code, 0, below.tail())
        self.assertAlmostEqual(pulmo.gas_pressure("yoshihara", 1 + below.signals()["volume_ml"][-1] / 1000), 16.7, places=6)
        self.assertNotEqual(above.code, 0)
        self.assertIn("There is no equilibrium above 16.82", above.err)
        self.assertLess(above.signals("signals.csv.part")["airway_pressure_cmH2O"][-1], 16.84)


class Supersyringe(unittest.TestCase):
    STEPS, VOLUME = 3, 80.0
    OPTIONS = pulmo.TIGHT + SUPERSYRINGE + pulmo.LITRE + pulmo.QUIET + [
        "-ventilator_steps", STEPS, "-ventilator_step_volume", VOLUME]

    def static(self, case):
        """Volumes and pressures at the ends of the pauses."""
        rows = case.signals()
        ends = [int(np.abs(rows["time_s"] - 2.3 * (k + 1)).argmin()) for k in range(2 * self.STEPS)]
        np.testing.assert_allclose(rows["time_s"][ends], 2.3 * np.arange(1, 2 * self.STEPS + 1), rtol=1e-12)
        self.assertEqual({rows["phase"][i] for i in ends}, {"pause"})
        return rows["volume_ml"][ends], rows["airway_pressure_cmH2O"][ends]

    def test_static_curves(self):
        """Up and down coincide, and are what the scene without airflow has, which is what PCV gives there: to 1e-8."""
        expected = self.VOLUME * np.array([1, 2, 3, 2, 1, 0])
        curves = {}
        for name, options in (("uniform", pulmo.UNIFORM + ["-ts_dt", "0.1"]), ("common", pulmo.COMMON + ["-ts_dt", "0.1"]),
                              ("still", pulmo.STILL + ["-ts_dt", "0.3"])):
            V, P = self.static(pulmo.finished(self.OPTIONS + options))
            np.testing.assert_allclose(V, expected, rtol=0, atol=1e-9 * self.VOLUME * self.STEPS)
            curves[name] = P
            top = P.max()
            self.assertGreater(top, 4)
            for up, down in ((0, 4), (1, 3)):
                self.assertAlmostEqual(P[up], P[down], delta=1e-8 * top, msg=name)
            self.assertAlmostEqual(P[-1], 0, delta=1e-8 * top, msg=name)
        for name in ("uniform", "common"):
            np.testing.assert_allclose(curves[name], curves["still"], rtol=0, atol=1e-8 * top, err_msg=name)
        pressures = pulmo.programme("".join(f"step 0.1 pressure {p:.17g}\n" for p in curves["still"][:3]))
        V = pulmo.finished(pulmo.TIGHT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + pulmo.STILL + pressures).signals()["volume_ml"]
        volumes = [V[2 * k] for k in (1, 2, 3)]
        np.testing.assert_allclose(volumes, expected[:3], rtol=0, atol=1e-8 * self.VOLUME)


class Programmes(unittest.TestCase):
    def test_pressure_limit(self):
        """Nothing changes until the limit is reached; then it is held and the flow falls, never above the set one.

        A phase with a limit has one common airway pressure, so that is what it is compared with.
        """
        def run(limit, options):
            text = f"inspiration 0.6 flow 400 {limit}\npause 0.15 hold\nexpiration 0.2 pressure 0\n"
            return pulmo.finished(pulmo.TIGHT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + pulmo.programme(text) +
                                  options).signals()

        for name, options in (("uniform", pulmo.UNIFORM), ("common", pulmo.COMMON), ("still", pulmo.STILL),
                              ("tube", pulmo.UNIFORM + ["-tube", "-tube_k1", "2", "-tube_k2", "3"])):
            with self.subTest(name):
                column = ("ventilator" if name == "tube" else "airway") + "_pressure_cmH2O"
                common = [] if name == "still" else ["-ventilator_flow_split", "common_pressure"]
                free, limited = run("", options + common), run("limit 5", options)
                above = int(np.argmax(free[column] > 5))
                self.assertGreater(above, 2)
                self.assertLess(limited[column].max(), 5 + 1e-9)
                for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"):
                    np.testing.assert_array_equal(free[c][:above], limited[c][:above])
                inspiration = np.array([p == "inspiration" for p in limited["phase"]])
                held = slice(above, int(inspiration.sum()))
                np.testing.assert_allclose(limited[column][held], 5, atol=1e-9)
                self.assertLess(limited["flow_ml_per_s"].max(), 400 * (1 + 1e-8))
                self.assertTrue((np.diff(limited["flow_ml_per_s"][held]) < 1e-6).all())
                self.assertEqual(limited["time_s"][held][0], free["time_s"][above])
                pause = np.array([p == "pause" for p in limited["phase"]])
                np.testing.assert_allclose(limited["volume_ml"][pause], limited["volume_ml"][held][-1], rtol=1e-9)

    def test_without_a_breath(self):
        """A programme without `inspiration` has no numbers of a breath, but its static curve."""
        case = pulmo.finished(pulmo.options_file("scenes/programme.opts") + pulmo.PAPER + pulmo.DIRECT + pulmo.CUBE +
                              pulmo.programme("inflation 0.1 flow 0.05\npause 0.1 hold\n"))
        numbers = case.json()
        for key in ("peak_inspiratory_pressure_cmH2O", "tidal_volume_ml", "work_j", "compliance_ml_per_cmH2O"):
            self.assertIsNone(numbers[key], key)
        self.assertEqual(numbers["breaths"], [])
        self.assertEqual(len(numbers["static_curve"]), 1)
        self.assertNotIn("clinical numbers", case.out)

    def test_the_unknown_pressure_needs_the_assembled_jacobian(self):
        case = pulmo.Case(pulmo.VCV + pulmo.DIRECT + pulmo.CUBE +
                          ["-ventilator_flow_split", "common_pressure", "-snes_mf_operator"])
        self.assertNotEqual(case.code, 0)
        self.assertIn("-snes_mf_operator", case.err)
        self.assertEqual(case.files(), [])

    def test_a_limit_that_is_not_reached_changes_nothing(self):
        text = "inspiration 0.3 flow 300 {}\npause 0.1 hold\n"
        a, b = (pulmo.finished(pulmo.DIRECT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + pulmo.programme(text.format(limit)) +
                               ["-ventilator_flow_split", "common_pressure"])
                for limit in ("", "limit 60"))
        for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"):
            np.testing.assert_array_equal(a.signals()[c], b.signals()[c])

    def test_a_limit_after_a_flow_without_one(self):
        """Nodes of a free airway have pressures of their own, and so have the past increments that reuse.opts guesses from;
        a phase with a limit has one pressure for them all."""
        scene = pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + pulmo.UNIFORM + ["-airflow_permeability", "100"] + pulmo.programme(
            "inspiration 0.3 flow 300\ninspiration 0.2 flow 300 limit 1000\n")
        a, b = (pulmo.finished(pulmo.options_file(f"solvers/{solver}.opts") + scene) for solver in ("direct", "reuse"))
        self.assertEqual(b.json()["rejected_steps"], 0)
        for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"):
            np.testing.assert_allclose(a.signals()[c], b.signals()[c], rtol=1e-6, atol=1e-6)

    def test_same_breath_as_the_mode(self):
        """VCV with PEEP, written as a file."""
        V_T, common = 180, pulmo.TIGHT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET
        text = "settle 0.5 pressure 3 ramp 0.1\nrepeat 2\n inspiration 0.4 flow {:.17g} ramp 0.1\n pause 0.2 hold\n" \
               " expiration 0.4 pressure 3 ramp 0.2\nend\n"
        a = pulmo.finished(common + pulmo.programme(text.format(V_T / 0.35))).signals()
        b = pulmo.finished(common + ["-ventilator", "vcv", "-ventilator_peep", 3, "-ventilator_tidal_volume", V_T,
                                     "-ventilator_inspiration", 0.4, "-ventilator_pause", 0.2,
                                     "-ventilator_expiration", 0.4, "-ventilator_ramp", 0.1,
                                     "-ventilator_ramp_down", 0.2, "-ventilator_breaths", 2]).signals()
        self.assertEqual(a["phase"], b["phase"])
        for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"):
            np.testing.assert_allclose(a[c], b[c], rtol=0, atol=1e-9 * np.abs(b[c]).max())

    def test_the_guide(self):
        """Every programme in docs/ventilator.md runs as it stands there."""
        with open(os.path.join(pulmo.SOURCE, "docs", "ventilator.md")) as f:
            examples = re.findall(r"```programme\n(.*?)```", f.read(), re.S)
        self.assertGreaterEqual(len(examples), 5)
        for text in examples:
            with self.subTest(text):
                options = pulmo.DIRECT + pulmo.SCENE + pulmo.LITRE + pulmo.STILL + pulmo.QUIET + [
                    "-ts_dt", "0.5", "-output_fields_every", "1000"]
                case = pulmo.finished(options + pulmo.programme(text))
                self.assertGreater(case.signals()["volume_ml"].max(), 50)


if __name__ == "__main__":
    pulmo.main()
