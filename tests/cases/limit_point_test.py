#!/usr/bin/python3
"""-ventilator_on_limit_point flow: where a cube that inflates freely holds no more of a prescribed pressure, a flow is prescribed. Each row
is then on the closed form p = dW/dJ, past the fold, too; the turns are at its extremes, and the pressure is held again where the closed form
allows."""
import unittest

import numpy as np
from scipy.optimize import brentq, minimize_scalar

import pulmo_case as pulmo

FREE = pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.STILL + pulmo.ROLLERS
FLOW = ["-ventilator_on_limit_point", "flow"]
# rises to 16.83 cmH2O at J = 2.534, and falls for good
CM4 = FREE + ["-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", "20", "-ventilator_ramp", "1", "-ts_dt", "0.05"]
# CM3 softened where it is wide: rises to 4.99 cmH2O at J = 2.23, falls to 4.52 at J = 4.83, and rises for good
C3 = 5e-4
LOOP = FREE + ["-tissue", "birzle", "-tissue_c3", C3, "-ventilator", "pcv", "-ventilator_pip", "6", "-ventilator_settle", "off",
               "-ventilator_ramp", "0.6", "-ventilator_ramp_down", "1.5", "-ts_dt", "0.05"]
FAST = ["-ventilator_limit_point_flow", "20000"]
SIGNALS = ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml", "dt_s", "min_J", "max_J")


def soft_birzle(J):
    """dW/dJ of free inflation, cmH2O; the constants but c3 are those of pulmo_case."""
    return pulmo.gas_pressure("birzle", J) - 4 * (5.766e-3 - C3) * (np.cbrt(J) ** 2 - 1) ** 5 / np.cbrt(J) / pulmo.KPA_PER_CMH2O


def extreme(law, low, high, sign):
    """J and p of the largest (sign 1) or least (-1) pressure in between."""
    J = minimize_scalar(lambda J: -sign * law(J), bounds=(low, high), method="bounded", options={"xatol": 1e-10}).x
    return J, law(J)


def cm4(J):
    return pulmo.gas_pressure("yoshihara", J)


class LimitPoint(unittest.TestCase):
    def expect_on_the_curve(self, case, law, within=1e-6):
        rows = case.signals()
        J = 1 + rows["volume_ml"] / 1000
        self.assertLess(np.abs(rows["airway_pressure_cmH2O"] - law(J)).max(), within)
        np.testing.assert_allclose([rows["min_J"], rows["max_J"]], [J, J], rtol=1e-6)
        return rows, J, rows["flow_past_limit_point"] == 1

    def test_past_the_fold_and_back(self):
        """CM4: the volume grows on as fast as it came, the pressure falls; the expiration lets it out over the fold until nothing is left."""
        J_top, p_top = extreme(cm4, 1, 6, 1)
        for name, options, ranks in (("backward Euler", [], 1), ("backward Euler", [], 2), ("BDF2", ["-ts_type", "bdf"], 1),
                                     ("by error", ["-ts_type", "bdf", "-step_volume_tolerance", "20", "-step_pressure_tolerance", "0.2"], 2),
                                     ("reuse.opts", pulmo.options_file("solvers/reuse.opts"), 1)):
            with self.subTest(name, ranks=ranks):
                case = pulmo.finished(CM4 + FLOW + options, ranks=ranks)
                rows, J, flows = self.expect_on_the_curve(case, cm4)
                first = int(flows.argmax())
                t, V, p = rows["time_s"], rows["volume_ml"], rows["airway_pressure_cmH2O"]
                # the fold: where the prescribed ramp of 20 cmH2O/s stops being held
                self.assertAlmostEqual(p[first - 1], p_top, delta=1e-3)
                self.assertLess(J[first - 1], J_top)
                self.assertAlmostEqual(p[first - 1], 20 * t[first - 1], places=9)
                Q = V[first - 1] / t[first - 1]
                inspiration = flows & (np.array(rows["phase"]) == "inspiration")
                np.testing.assert_allclose(V[inspiration], V[first - 1] + Q * (t[inspiration] - t[first - 1]), rtol=1e-9)
                self.assertGreater(J[inspiration][-1], J_top + 0.2)
                self.assertTrue((np.diff(p[inspiration][J[inspiration] > J_top]) < 0).all())
                self.assertLess(p[inspiration][-1], p_top - 0.05)
                # out: over the fold again, which pressure control could not
                out = flows & (np.array(rows["phase"]) == "expiration")
                np.testing.assert_allclose(V[out], V[inspiration][-1] - Q * (t[out] - 1), atol=1e-6 * V.max())
                self.assertEqual(flows[first:].argmin(), inspiration.sum() + out.sum())  # in one piece
                held = np.flatnonzero(out)[-1] + 1
                self.assertLess(held, len(t))
                np.testing.assert_allclose(p[held:], 0, atol=1e-9)
                self.assertLess(np.abs(V[held:]).max(), 1e-5)
                self.assertIn(f"pulmo: note: a limit point at t = {t[first - 1]:.6g} s (phase 'inspiration')", case.out)
                self.assertIn(f"a flow of {Q:.4g} ml/s is prescribed", case.out)
                self.assertIn(f"pulmo: note: from t = {t[held - 1]:.6g} s and", case.out)
                point, = case.json()["limit_points"]
                self.assertEqual(point["phase"], "inspiration")
                self.assertEqual(point["end_phase"], "expiration")
                for key, value in (("time_s", t[first - 1]), ("pressure_cmH2O", p[first - 1]), ("volume_ml", V[first - 1]),
                                   ("flow_ml_per_s", Q), ("end_s", t[held - 1]), ("end_volume_ml", V[held - 1])):
                    self.assertAlmostEqual(point[key], value, delta=1e-9 * max(1, abs(value)), msg=key)

    def test_until_the_pressure_is_held_again(self):
        """A law that stiffens again: in both directions the pressure is held again on the far side, and the loop encloses the folds."""
        top, bottom = extreme(soft_birzle, 1, 3, 1), extreme(soft_birzle, 3, 8, -1)
        for ranks in (1, 2):
            case = pulmo.finished(LOOP + FLOW + FAST, ranks=ranks)
            rows, J, flows = self.expect_on_the_curve(case, soft_birzle)
            t, p, V = rows["time_s"], rows["airway_pressure_cmH2O"], rows["volume_ml"]
            asked = np.where(t <= 1, np.minimum(10 * t, 6), np.maximum(6 - 4 * (t - 1), 0))
            np.testing.assert_allclose(p[~flows], asked[~flows], atol=1e-6)
            up, down = case.json()["limit_points"]
            self.assertAlmostEqual(up["pressure_cmH2O"], top[1], delta=2e-3)
            self.assertAlmostEqual(1 + up["volume_ml"] / 1000, top[0], delta=0.05)
            self.assertAlmostEqual(down["pressure_cmH2O"], bottom[1], delta=2e-3)
            self.assertAlmostEqual(1 + down["volume_ml"] / 1000, bottom[0], delta=0.1)
            self.assertEqual((up["end_phase"], down["end_phase"]), ("inspiration", "expiration"))
            for point, sign in ((up, 1), (down, -1)):
                inside = (t > point["time_s"]) & (t <= point["end_s"])
                self.assertTrue(flows[inside].all())
                np.testing.assert_allclose(V[inside], point["volume_ml"] + sign * 20000 * (t[inside] - point["time_s"]), rtol=1e-9)
                self.assertTrue((sign * (asked - p)[inside] > 0).all(), "the pressure of the phase is not held a step too late")
                after = int(np.flatnonzero(inside)[-1]) + 1
                full = V[after - 1] + sign * 20000 * (t[after] - t[after - 1])
                self.assertGreater(sign * (soft_birzle(1 + full / 1000) - asked[after]), 0, "nor too early")
            # the branches far from the folds
            self.assertAlmostEqual(J.max(), brentq(lambda J: soft_birzle(J) - 6, 4.9, 20), places=5)
            self.assertAlmostEqual(V[-1], 0, places=6)
            self.assertLess(abs(case.json()["energy_j"]["residual"]), 1e-8)
            self.assertIn("there is no equilibrium above 4.98", case.out)
            self.assertIn("there is no equilibrium below 4.51", case.out)

    def test_a_jump_across_is_seen_with_a_bound_on_J(self):
        """A jump of pressure finds the equilibrium on the far side in one step; -step_J_change does not let it."""
        jump = LOOP + FLOW + FAST + ["-ventilator_ramp", "0", "-ventilator_ramp_down", "0"]
        far = pulmo.finished(jump)
        self.assertEqual(far.json()["limit_points"], [])
        case = pulmo.finished(jump + ["-step_J_change", "0.3"])
        rows, J, flows = self.expect_on_the_curve(case, soft_birzle)
        self.assertLessEqual(np.abs(np.diff(np.log(J))).max(), 0.3 * (1 + 1e-6))
        up, down = case.json()["limit_points"]
        self.assertAlmostEqual(up["pressure_cmH2O"], extreme(soft_birzle, 1, 3, 1)[1], delta=2e-3)
        self.assertAlmostEqual(down["pressure_cmH2O"], extreme(soft_birzle, 3, 8, -1)[1], delta=2e-3)
        self.assertEqual(far.signals()["volume_ml"].max().round(3), rows["volume_ml"].max().round(3))

    def test_a_phase_of_flow_in_between(self):
        """What follows a phase that prescribes a flow past the limit point is let out over the fold, too: with the pressure prescribed
        the volume would grow as that falls."""
        case = pulmo.finished(FREE + ["-tissue", "yoshihara", "-ts_dt", "0.05"] + FLOW + pulmo.programme(
            "inflation 1 pressure 20 ramp 1\nmore 0.3 flow 500\nhold 0.2 hold\nout 1.5 pressure 3 ramp 0.5\n"))
        rows, J, past = self.expect_on_the_curve(case, cm4)
        phase, V, p = np.array(rows["phase"]), rows["volume_ml"], rows["airway_pressure_cmH2O"]
        top = V[phase == "inflation"][-1]
        np.testing.assert_allclose(V[phase == "hold"], top + 150, rtol=1e-9)
        self.assertTrue((np.diff(V[phase == "out"]) < 1e-6).all())
        self.assertTrue(past[(phase == "more") | (phase == "hold")].all())
        self.assertAlmostEqual(p[-1], 3, places=6)
        self.assertAlmostEqual(J[-1], brentq(lambda J: cm4(J) - 3, 1, 2), places=6)
        point, = case.json()["limit_points"]
        self.assertEqual((point["phase"], point["end_phase"]), ("inflation", "out"))

    def test_its_flow_ends_no_phase(self):
        """It is less than any share of what flowed just before the limit point, where there is no bound to the flow."""
        case = pulmo.finished(FREE + ["-tissue", "yoshihara", "-ts_dt", "0.05", "-ventilator_limit_point_flow", "1000"] + FLOW + pulmo.programme(
            "inspiration 1 pressure 20 ramp 1 cycle 25\nexpiration 2 pressure 0 ramp 0.5\n"))
        rows, _, past = self.expect_on_the_curve(case, cm4)
        t, phase = rows["time_s"], np.array(rows["phase"])
        self.assertTrue(past[phase == "inspiration"].any())
        self.assertAlmostEqual(t[phase == "inspiration"][-1], 1, places=9)
        self.assertLess(1000, 0.25 * rows["flow_ml_per_s"].max())

    def test_on_springs(self):
        """Springs along the normal of three faces: F = J^(1/3) I still, and they add K L (J^(1/3) - 1) / J^(2/3) to the pressure."""
        def law(J, K=2e-3, L=100):
            return cm4(J) + K * L * (np.cbrt(J) - 1) / np.cbrt(J) ** 2 / pulmo.KPA_PER_CMH2O

        springs = ["-chest_wall", "-chest_wall_surfaces", "x1,y1,z1", "-chest_wall_direction", "normal", "-chest_wall_stiffness", "2e-3"]
        case = pulmo.finished(CM4 + FLOW + springs + ["-ventilator_limit_point_flow", "8000"], ranks=2)
        rows, J, flows = self.expect_on_the_curve(case, law)
        J_top, p_top = extreme(law, 1, 6, 1)
        self.assertGreater(p_top, extreme(cm4, 1, 6, 1)[1] + 0.2)
        point, = case.json()["limit_points"]
        self.assertAlmostEqual(point["pressure_cmH2O"], p_top, delta=2e-3)
        self.assertGreater(J.max(), J_top + 0.5)
        self.assertLess(rows["airway_pressure_cmH2O"][J.argmax()], p_top - 0.05)

    def test_without_a_limit_point_nothing_changes(self):
        for name, scene in (("still", CM4 + ["-ventilator_pip", "15", "-ventilator_peep", "2"]),
                            ("airflow", pulmo.DIRECT + pulmo.PCV + pulmo.LITRE + pulmo.QUIET + ["-tissue", "patte", "-airflow_permeability", "1e4"])):
            with self.subTest(name):
                stop, flow = pulmo.finished(scene), pulmo.finished(scene + FLOW)
                self.assertEqual(flow.json()["limit_points"], [])
                self.assertNotIn("limit_points", stop.json())
                a, b = stop.signals(), flow.signals()
                self.assertEqual(set(b["flow_past_limit_point"]), {0})
                del b["flow_past_limit_point"]
                self.assertEqual(a.keys(), b.keys())
                self.assertEqual(a["phase"], b["phase"])
                for column in SIGNALS:
                    # without airflow the matrix has a row more: another order of sums
                    np.testing.assert_allclose(b[column], a[column], rtol=1e-12 if name == "still" else 0,
                                               atol=1e-10 if name == "still" else 0, err_msg=column)

    def test_until_there_it_is_what_stops(self):
        stop = pulmo.Case(CM4)
        self.assertEqual(stop.code, 2, stop.tail())
        self.assertIn("What to try: less pressure or volume, -ventilator_on_limit_point flow, or prescribed flow", stop.err)
        a, b = stop.signals("signals.csv.part"), pulmo.finished(CM4 + FLOW).signals()
        n = len(a["time_s"])
        self.assertEqual(b["flow_past_limit_point"].argmax(), n)
        for column in ("time_s", "airway_pressure_cmH2O", "volume_ml"):
            np.testing.assert_allclose(b[column][:n], a[column], rtol=1e-6, err_msg=column)

    def test_goes_on_as_if_it_had_never_stopped(self):
        for name, options in (("backward Euler", []), ("BDF2", ["-ts_type", "bdf"])):
            for when, phase in ((0.6, "inspiration"), (1.4, "expiration")):
                with self.subTest(name, phase=phase):
                    # on the way out of the first scene the flow is that of the phase before
                    scene = (LOOP + FLOW + FAST if phase == "inspiration" else CM4 + FLOW) + options
                    whole = pulmo.finished(scene + ["-checkpoint_every", when, "-ts_max_time", when + 0.5]).signals()
                    start = pulmo.finished(scene + ["-checkpoint_every", when, "-ts_max_time", when + 0.03])
                    from_there = start.path("checkpoint_previous.h5" if "checkpoint_previous.h5" in start.files() else "checkpoint.h5")
                    for ranks, within in ((1, 0), (2, 1e-9)):
                        part = pulmo.finished(scene + ["-ts_max_time", when + 0.5, "-restart", from_there], ranks=ranks)
                        rows = part.signals()
                        at = float(part.out.split("going on from ")[1].split("at t = ")[1].split()[0])
                        row = int(np.abs(rows["time_s"] - at).argmin())
                        self.assertEqual(rows["flow_past_limit_point"][row], 1)
                        self.assertEqual(rows["phase"][row], phase)
                        for column in SIGNALS + ("flow_past_limit_point",):
                            np.testing.assert_allclose(rows[column], whole[column], rtol=within, atol=within * np.abs(whole[column]).max(),
                                                       err_msg=column)

    def test_replay_goes_through_the_turn(self):
        """A flow that nothing can take: the attempts by pressure, the turn and the attempt by flow are repeated."""
        case = pulmo.Case(CM4 + FLOW + ["-ts_adapt_dt_min", "1e-3", "-ventilator_limit_point_flow", "1e20"])
        self.assertEqual(case.code, 2, case.tail())
        again = pulmo.Case(["-replay", case.directory], directory="-")
        self.assertEqual(again.code, 2, again.tail())
        self.assertIn("a limit point at t = ", again.out)
        self.assertEqual(again.out.count("as in the run, bit for bit"), 2, again.out)
        self.assertNotIn("not those of the run", again.out)
        # one that cannot be taken back out
        case = pulmo.Case(CM4 + FLOW + ["-ts_adapt_dt_min", "1e-3", "-ventilator_limit_point_flow", "1e12"])
        self.assertEqual(case.code, 2, case.tail())
        self.assertIn("A flow is prescribed here, past a limit point", case.err)
        self.assertIn("What to try: another -ventilator_limit_point_flow", case.err)

    def test_error_bars_come_from_more_runs(self):
        """And they hold: the limit point and the flow from there on have closed forms."""
        scene = CM4 + FLOW + ["-dm_plex_filename", pulmo.mesh("cube_coarse.msh"), "-ventilator_pip", "17.5", "-ts_dt", "0.01"]
        report = pulmo.finished(scene + ["-error_estimate"], timeout=600).json()["error_estimate"]
        self.assertEqual(report["method"], "runs")
        J_top, p_top = extreme(cm4, 1, 6, 1)
        exact = {"peak_inspiratory_pressure_cmH2O": p_top, "tidal_volume_ml": 1000 * (J_top - 1) / (p_top / 17.5)}  # by the mean flow
        for name, value in exact.items():
            number = report["numbers"][name]
            self.assertLess(abs(number["value"] - value), number["error"], name)
            self.assertLess(number["error"], 0.02 * value, name)

    def test_the_scene_in_words(self):
        for more, words in (([], "the mean flow of the phase until then is prescribed."), (FAST, "a flow of 2e+04 ml/s is prescribed.")):
            case = pulmo.Case(CM4 + FLOW + more + ["-scene_view_only"])
            self.assertEqual(case.code, 0, case.tail())
            self.assertIn("past a limit point, " + words, " ".join(case.out.split()))
        self.assertNotIn("past a limit point", pulmo.Case(CM4 + ["-scene_view_only"]).out)

    def test_what_is_refused(self):
        def refused(options, *words):
            case = pulmo.Case(options)
            self.assertEqual(case.code, 1, case.tail())
            for word in words:
                self.assertIn(word, case.err)

        refused(FREE + ["-tissue", "yoshihara", "-ventilator", "vcv"] + FLOW, "-ventilator_on_limit_point", "-ventilator pcv or programme")
        refused(FREE + ["-tissue", "yoshihara"] + FLOW + pulmo.programme("inspiration 1 flow 100\npause 1 hold\n"),
                "-ventilator_on_limit_point flow: no phase of ", "prescribes a pressure", "leave the option out")
        refused(CM4 + ["-ventilator_limit_point_flow", "100"], "-ventilator_limit_point_flow", "-ventilator_on_limit_point flow")
        refused(CM4 + FLOW + ["-sensitivities", "C_rs"], "-sensitivities knows no change from prescribed pressure to prescribed flow: "
                "leave -ventilator_on_limit_point out")
        refused(CM4 + FLOW + ["-error_estimate", "-error_estimate_method", "sweep"], "leave -ventilator_on_limit_point out")
        refused(CM4 + FLOW + ["-snes_type", "newtontr"], "-snes_type newtontr does not go with -ventilator_on_limit_point flow")
        start = pulmo.finished(CM4 + ["-ts_max_time", "0.5", "-checkpoint_every", "0.2"])
        refused(CM4 + FLOW + ["-restart", start.path("checkpoint.h5")], "is a checkpoint of another scene: there -ventilator_on_limit_point is '(not in use)', here 'flow'")
        there = pulmo.finished(CM4 + FLOW + ["-ts_max_time", "0.5", "-checkpoint_every", "0.2"])
        refused(CM4 + ["-restart", there.path("checkpoint.h5")], "there -ventilator_on_limit_point is 'flow', here 'stop'")


if __name__ == "__main__":
    pulmo.main()
