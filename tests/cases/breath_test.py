#!/usr/bin/python3
"""What is counted as breath: loads that act at rest come before it, a breath that was cut gives no numbers, the end of
inspiration is one instant on any number of ranks, and a programme says which of its phases are breaths."""
import unittest

import numpy as np

import case_meshes
import pulmo_case as pulmo

SETTLE = "-ventilator_settle"
PULL = ["-traction", "-traction_surfaces", "pleura", "-traction_value", "0.2,0,0"]
SCENE = pulmo.SCENE + [SETTLE, "auto"]
CUBE = pulmo.DIRECT + SCENE + pulmo.LITRE + pulmo.QUIET
SHORT = ["-ventilator", "pcv", "-ventilator_inspiration", "0.5", "-ventilator_expiration", "0.5"]
MOVED = ["-chest_wall_surfaces", "airway", "-support", "-support_surfaces", "z0,z1", "-support_components_z0", "z",
         "-support_components_z1", "z", "-support_displacement_z1", "0,0,3"]
BERGER = ["-tissue", "berger"]


def row_at(rows, time):
    return int(np.abs(rows["time_s"] - time).argmin())


class Rest(unittest.TestCase):
    """Loads that act before the ventilator does."""

    def check(self, case):
        """The breath against the resting state under the loads, found by another run: a load held for a very long time."""
        rows, summary = case.signals(), case.json()
        breath = summary["breaths"][-1]
        V = rows["volume_ml"]
        self.assertEqual(rows["phase"][0], "settle")
        self.assertEqual(set(rows["phase"]), {"settle", "inspiration", "expiration"})
        start = row_at(rows, breath["start_s"])
        self.assertEqual(rows["phase"][start], "settle")
        self.assertEqual(rows["phase"][start + 1], "inspiration")
        self.assertAlmostEqual(breath["tidal_volume_ml"], V[start:].max() - V[start], places=9)
        self.assertAlmostEqual(breath["trapped_volume_ml"], V[-1] - V[start], places=9)
        return V[start], breath

    def volume_at_rest(self, options, pressure):
        """The volume at rest under the loads at a pressure of the airway: no gas flow that could be unfinished."""
        rows = pulmo.finished(pulmo.TIGHT + SCENE + pulmo.QUIET + options + pulmo.STILL + pulmo.programme(
            f"load 1 pressure 0\nrise 1 pressure {pressure} ramp 1\n")).signals()
        ends = [row_at(rows, t) for t in (1, 2)]
        return rows["volume_ml"][ends]

    def test_a_load_is_not_breathed(self):
        for name, options in (("a pull", pulmo.LITRE + PULL),
                              ("a stretch", pulmo.BLOCK + ["-airflow_surfaces", "x1"] + MOVED[2:] + [
                                  "-chest_wall_surfaces", "x0,x1,y0,y1", "-lumen_pressure", "off"]),
                              ("the law's own stress", pulmo.LITRE + BERGER)):
            with self.subTest(name):
                # long enough for the gas to come to rest in each phase
                case = pulmo.finished(pulmo.TIGHT + SCENE + pulmo.QUIET + options + [
                    "-ventilator", "pcv", "-ventilator_pip", "3", "-ventilator_inspiration", "3", "-ventilator_expiration", "3",
                    SETTLE + "_duration", "4"])
                loaded, full = self.volume_at_rest(options, 3)
                start, breath = self.check(case)
                self.assertGreater(abs(loaded), 0.2)
                self.assertAlmostEqual(start / loaded, 1, delta=1e-5)
                self.assertAlmostEqual(breath["tidal_volume_ml"] / (full - loaded), 1, delta=1e-4)
                self.assertLess(abs(breath["trapped_volume_ml"]), 1e-4 * breath["tidal_volume_ml"])
                self.assertIn("pulmo: note: ", case.out)
                self.assertIn("'settle' of 4 s", case.out)
                self.assertIs(case.json()["steady"], True)
                self.assertNotIn("warning", case.out)

    def test_every_mode_settles(self):
        text = "inspiration 0.3 pressure 5 ramp 0.1\nexpiration 0.3 pressure 0\n"
        for name, ventilator, duration in (
                ("pcv", SHORT, 0.6), ("vcv", SHORT + ["-ventilator", "vcv", "-ventilator_tidal_volume", "50"], 0.5),
                ("supersyringe", [
                    "-ventilator", "supersyringe", "-ventilator_steps", "1", "-ventilator_step_volume", "50", "-ventilator_pause", "0.2"], 2),
                ("programme", pulmo.programme(text), 2)):
            with self.subTest(name):
                rows = pulmo.finished(CUBE + PULL + ventilator + ["-ts_dt", "0.1"]).signals()
                settle = np.array(rows["phase"]) == "settle"
                self.assertAlmostEqual(rows["time_s"][settle][-1], duration, places=9)
                self.assertTrue((rows["airway_pressure_cmH2O"][settle] == 0).all())
                off = pulmo.finished(CUBE + PULL + ventilator + ["-ts_dt", "0.1", SETTLE, "off"])
                self.assertNotIn("settle", off.signals()["phase"])
                self.assertIn("counts as breath", off.out)

    def test_nothing_settles_where_nothing_moves(self):
        for options in ([], ["-traction", "-traction_surfaces", "pleura"], ["-tissue", "yoshihara"], BERGER + ["-tissue_phi0", "1"],
                        ["-support", "-support_surfaces", "airway"], pulmo.STILL):
            case = pulmo.finished(CUBE + SHORT + ["-ts_dt", "0.25"] + options)
            self.assertNotIn("settle", case.signals()["phase"], options)
            self.assertNotIn("pulmo: note: forces", case.out)
        for more in ([SETTLE, "on"], ["-ventilator_peep", "2", SETTLE, "off"]):  # PEEP is no load
            self.assertEqual(pulmo.finished(CUBE + SHORT + ["-ts_dt", "0.25"] + more).signals()["phase"][0], "settle")

    def test_phases_of_the_users_own_come_first_instead(self):
        text = "load 0.5 pressure 0\ninspiration 0.3 pressure 5 ramp 0.1\nexpiration 0.3 pressure 0\n"
        rows = pulmo.finished(CUBE + PULL + pulmo.programme(text)).signals()
        self.assertNotIn("settle", rows["phase"])
        self.assertAlmostEqual(rows["time_s"][-1], 1.1, places=9)

    def test_off_is_the_run_as_it_was(self):
        """The paper's reading: CM1's own stress is part of the first breath, step by step as if nothing settled."""
        options = CUBE + BERGER + SHORT
        off, auto = (pulmo.finished(options + more).signals() for more in ([SETTLE, "off"], []))
        self.assertAlmostEqual(off["time_s"][-1], 1, places=9)
        self.assertAlmostEqual(auto["time_s"][-1], 1.6, places=9)
        self.assertEqual(off["phase"][:11], ["inspiration"] * 11)
        written = pulmo.finished(CUBE + BERGER + [SETTLE, "off"] + pulmo.programme(
            "inspiration 0.5 pressure 6 ramp 0.1\nexpiration 0.5 pressure 0\n")).signals()
        np.testing.assert_allclose(off["volume_ml"], written["volume_ml"], rtol=0, atol=1e-9)

    def test_too_short_a_settling_is_told(self):
        slow = CUBE + PULL + SHORT + ["-airflow_permeability", "300", SETTLE + "_duration", "0.5"]
        case = pulmo.finished(slow)
        self.assertIn("before the lung is at rest", case.out)
        self.assertIn(SETTLE + "_duration", case.out)
        long = pulmo.finished(slow + [SETTLE + "_duration", "20", "-ts_dt", "0.1"])
        self.assertNotIn("before the lung is at rest", long.out)
        at = [row_at(c.signals(), c.json()["breaths"][0]["start_s"]) for c in (case, long)]
        missing = abs(long.signals()["volume_ml"][at[1]] - case.signals()["volume_ml"][at[0]])
        self.assertLess(case.json()["unsettled_volume_ml"], missing, "at least so much is still to come")
        self.assertGreater(case.json()["unsettled_volume_ml"], 0.25 * missing)

    def test_restart_within_the_settling(self):
        options = CUBE + PULL + SHORT + ["-checkpoint_every", "0.1"]
        whole, part = pulmo.finished(options), pulmo.finished(options + ["-ts_max_time", "0.3"])
        rest = pulmo.finished(options + ["-restart", part.path("checkpoint.h5")])
        for column in ("time_s", "volume_ml"):
            np.testing.assert_allclose(rest.signals()[column], whole.signals()[column], rtol=0, atol=1e-8)


class Breaths(unittest.TestCase):
    def test_a_cut_breath_is_marked_and_gives_no_numbers(self):
        options = CUBE + SHORT + ["-ventilator_breaths", "2"]
        whole, cut, within = (pulmo.finished(options + more) for more in ([], ["-ts_max_time", "1.3"], ["-ts_max_time", "0.3"]))
        first, second = cut.json()["breaths"]
        self.assertTrue(first["complete"])
        self.assertEqual(first, whole.json()["breaths"][0])
        self.assertFalse(second["complete"])
        self.assertAlmostEqual(second["end_s"], 1.3, places=9)
        for key in set(first) - {"complete", "start_s", "end_s"}:
            self.assertIsNone(second[key], key)
        self.assertEqual(cut.json()["numbers_of_breath"], 1)
        for key in set(first) - {"complete", "start_s", "end_s", "end_of_inspiration_s", "energy_j", "inspiratory_energy_j"}:
            self.assertEqual(cut.json()[key], first[key], key)
        self.assertIn("clinical numbers of breath 1", cut.out)
        self.assertIn("within breath 2, which would end at 2 s", cut.out)
        self.assertNotIn("within breath", whole.out)

        summary = within.json()
        self.assertIsNone(summary["numbers_of_breath"])
        self.assertIsNone(summary["steady"])
        self.assertEqual(summary["why_no_numbers"], "the run ends within its first breath")
        for key in set(first) - {"complete", "start_s", "end_s", "end_of_inspiration_s", "energy_j", "inspiratory_energy_j"}:
            self.assertIsNone(summary[key], key)
        fit = summary["breaths"][0]["fit_until_cut"]
        self.assertGreater(fit["compliance_ml_per_cmH2O"], 0)
        self.assertNotIn("clinical numbers", within.out)

    def test_unsteady_breaths_are_told(self):
        trapping = CUBE + ["-airflow_permeability", "1e3", "-ventilator", "pcv", "-ventilator_inspiration", "0.4", "-ventilator_expiration", "0.4"]
        one, many = pulmo.finished(trapping), pulmo.finished(trapping + ["-ventilator_breaths", "8"])
        self.assertIs(one.json()["steady"], False)
        self.assertIn("not a steady breath yet", one.out)
        self.assertIs(many.json()["steady"], True)
        self.assertNotIn("not a steady breath yet", many.out)
        last, before = many.json()["breaths"][-1], many.json()["breaths"][-2]
        self.assertAlmostEqual(last["tidal_volume_ml"] / before["tidal_volume_ml"], 1, delta=0.01)
        self.assertGreater(last["auto_peep_cmH2O"], 0.05)
        # one breath: the same fit as its own
        for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"):
            self.assertEqual(one.json()[key], one.json()["breaths"][0][key])
        # several: the last one's rows, counted from where the first one starts
        rows = many.signals()
        mine = slice(row_at(rows, last["start_s"]) + 1, None)
        w = np.sqrt(rows["dt_s"][mine])
        A = np.column_stack([rows["volume_ml"][mine] * w, rows["flow_ml_per_s"][mine] * w])
        (E, R), *_ = np.linalg.lstsq(A, rows["airway_pressure_cmH2O"][mine] * w, rcond=None)
        self.assertAlmostEqual(many.json()["compliance_ml_per_cmH2O"] * E, 1, places=9)
        self.assertAlmostEqual(many.json()["resistance_cmH2O_s_per_l"] / (1000 * R), 1, places=9)

    def test_no_resistance_without_airflow(self):
        still = CUBE + pulmo.STILL + SHORT + ["-ventilator", "vcv", "-ventilator_tidal_volume", "100", "-ventilator_pause", "0.1"]
        numbers = pulmo.finished(still).json()
        for key in ("resistance_cmH2O_s_per_l", "time_constant_s", "pause_resistance_cmH2O_s_per_l"):
            self.assertIsNone(numbers[key], key)
            self.assertIsNone(numbers["breaths"][0][key], key)
        self.assertGreater(numbers["compliance_ml_per_cmH2O"], 0)
        tube = pulmo.finished(still + ["-tube", "-tube_k1", "7"]).json()
        self.assertAlmostEqual(tube["pause_resistance_cmH2O_s_per_l"], 7, places=6)
        self.assertIsNotNone(tube["resistance_cmH2O_s_per_l"])


class EndOfInspiration(unittest.TestCase):
    """Flow into two bodies of different stiffness, which go on exchanging gas in the pause."""

    def test_any_number_of_ranks(self):
        mesh = case_meshes.bodies("stiff", "soft")
        scene = pulmo.options_file("scenes/vcv.opts") + pulmo.FLOW_OF_TWO + pulmo.COMMON + pulmo.QUIET + [
            "-chest_wall_surfaces", "stiff,soft", "-chest_wall_stiffness_stiff", "0.2", "-chest_wall_stiffness_soft", "0.02"]
        one, *others = (pulmo.finished(pulmo.options_file("solvers/iterative.opts") + scene + mesh, ranks=ranks) for ranks in (1, 2, 3))
        summary, rows = one.json(), one.signals()
        breath = summary["breaths"][0]
        pause = [i for i, p in enumerate(rows["phase"]) if p == "pause"]
        self.assertAlmostEqual(breath["end_of_inspiration_s"], rows["time_s"][pause[-1]], places=12)
        self.assertAlmostEqual(breath["plateau_pressure_cmH2O"], rows["airway_pressure_cmH2O"][pause[-1]], places=12)
        self.assertLess(np.ptp(rows["volume_ml"][pause]), 1e-8 * breath["tidal_volume_ml"], "rounding alone tells the rows apart")
        for other in others:
            for name, region in summary["regions"].items():
                for key, value in region.items():
                    self.assertAlmostEqual(other.json()["regions"][name][key], value, delta=1e-5 * max(1, abs(value)),
                                           msg=f"{name} {key}")
            for key, value in breath["inspiratory_energy_j"].items():
                self.assertAlmostEqual(other.json()["breaths"][0]["inspiratory_energy_j"][key], value,
                                       delta=1e-5 * breath["inspiratory_energy_j"]["ventilator_work"], msg=key)

    def test_regions_are_those_of_the_end_of_the_pause(self):
        mesh = case_meshes.bodies("stiff", "soft")
        scene = pulmo.TIGHT + pulmo.options_file("scenes/vcv.opts") + pulmo.FLOW_OF_TWO + pulmo.COMMON + pulmo.QUIET + mesh + [
            "-chest_wall_surfaces", "stiff,soft", "-chest_wall_stiffness_stiff", "0.2", "-chest_wall_stiffness_soft", "0.02"]
        whole = pulmo.finished(scene).json()["regions"]
        paused = pulmo.finished(scene + ["-ts_max_time", "0.5"]).json()["regions"]  # its last row is the end of the pause
        filled = pulmo.finished(scene + ["-ts_max_time", "0.3"]).json()["regions"]
        for name in whole:
            key = "alveolar_pressure_sd_cmH2O"
            self.assertAlmostEqual(whole[name][key], paused[name][key], places=9)
            self.assertGreater(abs(filled[name][key] / paused[name][key] - 1), 0.05)


class Programmes(unittest.TestCase):
    def test_any_phase_may_begin_a_breath(self):
        named, tagged, bare = (pulmo.finished(CUBE + pulmo.programme(text)) for text in (
            "inspiration 0.3 pressure 5 ramp 0.1\nexpiration 0.3 pressure 0\n",
            "rise 0.3 pressure 5 ramp 0.1 breath\nexpiration 0.3 pressure 0\n",
            "rise 0.3 pressure 5 ramp 0.1\nexpiration 0.3 pressure 0\n"))
        self.assertEqual(named.json()["breaths"], tagged.json()["breaths"])
        summary = bare.json()
        self.assertEqual(summary["breaths"], [])
        self.assertIsNone(summary["tidal_volume_ml"])
        for text in (summary["why_no_numbers"], bare.out):
            self.assertIn("no phase of the programme begins a breath", text)
            self.assertIn("'breath'", text)
        self.assertNotIn("begins a breath", named.out + tagged.out)

    def test_a_limit_below_the_pressure_before_it(self):
        text = "hold_up 0.2 pressure 8 ramp 0.1\ninspiration 0.2 flow 100 limit {}\nrest 0.2 pressure 0\n"
        low, fine = (pulmo.finished(CUBE + pulmo.programme(text.format(limit))) for limit in (5, 30))
        self.assertRegex(low.out, r"pulmo: warning: \S+:2: phase 'inspiration' begins at 8 cmH2O, above its own limit of 5 cmH2O")
        self.assertLess(low.out.index("warning"), low.out.index("clinical numbers"))
        self.assertNotIn("limit", fine.out)
        # after a phase of flow the pressure is known only when it has run; a repeat is told once
        text = "repeat 3\ninspiration 0.2 flow 400\nsigh 0.2 flow 10 limit 1\nexpiration 0.2 pressure 0\nend\n"
        case = pulmo.finished(CUBE + pulmo.programme(text))
        self.assertEqual(case.out.count("above its own limit"), 1)
        self.assertIn(":3: phase 'sigh'", case.out)
        held = "inspiration 0.3 flow 900 limit 4\nmore 0.3 flow 900 limit 4\nexpiration 0.2 pressure 0\n"
        self.assertNotIn("above its own limit", pulmo.finished(CUBE + pulmo.programme(held)).out)

    TEXT = ("inspiration 0.2 pressure 5 ramp 0.1 dt 0.01\nplateau 0.4 pressure 5 dt 0.1\n"
            "expiration 0.4 pressure 0 ramp 0.04\nslow 1 pressure 0 dt 0.25\n")

    def test_a_phase_has_its_own_steps(self):
        rows = pulmo.finished(CUBE + pulmo.programme(self.TEXT) + ["-ts_dt", "0.05"]).signals()
        for name, dt in (("inspiration", 0.01), ("plateau", 0.1), ("expiration", 0.05), ("slow", 0.25)):
            steps = [h for h, p in zip(rows["dt_s"], rows["phase"]) if p == name and h > 0]
            whole = [h for h in steps if abs(h - dt) < 1e-9]
            self.assertGreaterEqual(len(whole), len(steps) - 3, name)  # but for those that land on ends
            self.assertLessEqual(max(steps), dt * 1.011, name)
        scaled = pulmo.finished(CUBE + pulmo.programme(self.TEXT) + ["-ts_dt", "0.1", "-ventilator_dt_scale", "2"]).signals()
        steps = [h for h, p in zip(scaled["dt_s"], scaled["phase"]) if p == "inspiration" and h > 0]
        np.testing.assert_allclose(steps, 0.02, rtol=1e-9)

    def test_own_steps_after_a_restart(self):
        options = CUBE + pulmo.TIGHT + pulmo.programme(self.TEXT) + ["-checkpoint_every", "0.3"]
        whole = pulmo.finished(options)
        part = pulmo.finished(options + ["-ts_max_time", "0.35"])  # its checkpoint is of 0.3 s, before the step that is cut
        rest = pulmo.finished(options + ["-restart", part.path("checkpoint.h5")])
        for column in ("time_s", "dt_s", "volume_ml", "airway_pressure_cmH2O"):
            np.testing.assert_allclose(rest.signals()[column], whole.signals()[column], rtol=0, atol=1e-9)
        # -ts_dt may change; steps of a phase that began before the checkpoint are part of the scene
        faster = pulmo.finished(options + ["-restart", part.path("checkpoint.h5"), "-ts_dt", "0.02"]).signals()
        dts = {p: max(h for h, q in zip(faster["dt_s"], faster["phase"]) if q == p) for p in ("plateau", "expiration")}
        self.assertAlmostEqual(dts["plateau"], 0.1, places=9)
        self.assertAlmostEqual(dts["expiration"], 0.02, places=9)
        other = pulmo.Case(options + pulmo.programme(self.TEXT.replace("dt 0.01", "dt 0.02")) + [
            "-restart", part.path("checkpoint.h5")])
        self.assertNotEqual(other.code, 0)
        self.assertIn("phase 1 of the ventilator", other.err)

    def test_the_error_estimate_scales_them(self):
        text = "inspiration 0.4 pressure 5 ramp 0.1 dt 0.02\nexpiration 0.8 pressure 0 ramp 0.1 dt 0.02\n"
        case = pulmo.finished(CUBE + pulmo.programme(text) + ["-ts_dt", "0.5", "-error_estimate", "-error_estimate_mesh",
                                                                case_meshes.coarse_cube_lung()])
        runs = case.json()["error_estimate"]["runs"]
        self.assertEqual([run["steps"] for run in runs[:1] + runs[2:]], [60, 32, 17, 17])  # steps that end with ramp and phase
        self.assertIsNotNone(case.json()["error_estimate"]["numbers"]["tidal_volume_ml"]["time"])


if __name__ == "__main__":
    pulmo.main()
