#!/usr/bin/python3
"""-error_estimate: error bars hold the numbers of a run far finer, on any number of ranks, and cost nothing of the run."""
import functools
import os
import shutil
import unittest

import pulmo_case as pc

# a block of 1000 ml, 24 cells, one face airway; a breath whose pressure rises and falls over 0.2 s
SCENE = (pc.BLOCK + pc.DIRECT + pc.QUIET + pc.PAPER +
         ["-tissue", "yoshihara", "-airflow", "-airflow_permeability", "100", "-airflow_surfaces", "x1", "-chest_wall",
          "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-ventilator", "pcv", "-ventilator_pip", "8", "-ventilator_inspiration", "0.8",
          "-ventilator_expiration", "0.8", "-ventilator_ramp", "0.2", "-ventilator_ramp_down", "0.2", "-energy_audit", "off"])
STEPS = ["-ts_dt", "0.05"]
ESTIMATE = ["-error_estimate"]
BDF2 = ["-ts_type", "bdf"]
NUMBERS = ["tidal_volume_ml", "peak_flow_ml_per_s", "peak_expiratory_flow_ml_per_s", "compliance_ml_per_cmH2O",
           "resistance_cmH2O_s_per_l", "time_constant_s", "work_j", "auto_peep_cmH2O",
           "trapped_volume_ml"]  # none is another one up to a factor


@functools.cache
def estimated(*scheme):
    """The scene's run with its bars, made once: the tests only read it."""
    return pc.finished(SCENE + STEPS + list(scheme) + ESTIMATE)


def bars(case):
    return case.json()["error_estimate"]["numbers"]


class ErrorEstimate(unittest.TestCase):
    def bracketed(self, estimate, true_run, part):
        """How many of the numbers lie within their bars of those of the true run; prints the effectivities."""
        truth, inside = true_run.json(), 0
        for key in NUMBERS:
            bar = estimate[key]
            error = abs(bar["value"] - truth[key])
            inside += bar[part] >= error
            print(f"  {key:34} {bar['value']:12.6g} error {error:9.3g} bar {bar[part]:9.3g} "
                  f"effectivity {bar[part] / error if error else float('inf'):6.3g}")
        return inside

    def test_bars_in_time(self):
        """Against steps 32 times as short with BDF2: one breath in 1024 steps."""
        fine = pc.finished(SCENE + BDF2 + ["-ts_dt", "0.0015625"])
        for name, scheme in (("backward Euler", []), ("BDF2", BDF2)):
            with self.subTest(scheme=name):
                print(f"\n{name}, 0.05 s, time:")
                self.assertGreaterEqual(self.bracketed(bars(estimated(*scheme)), fine, "time"), 0.9 * len(NUMBERS))

    def test_bars_in_space(self):
        """Against cells a quarter of the size, over two laws; steps are the same."""
        inside, laws = 0, ("birzle", "yoshihara")
        for law in laws:
            print(f"\nspace, 24 cells, {law}:")
            steps = ["-ts_dt", "0.2", "-tissue", law]
            run = pc.finished(SCENE + steps + ESTIMATE)
            inside += self.bracketed(bars(run), pc.finished(SCENE + steps + ["-dm_refine", "2"]), "space")
        self.assertGreaterEqual(inside, 0.9 * len(laws) * len(NUMBERS))

    def test_levels_and_the_run_itself(self):
        plain = pc.finished(SCENE + STEPS)
        with_bars = estimated()
        before, after = plain.json(), with_bars.json()
        for key in NUMBERS:
            self.assertEqual(after[key], before[key])
            self.assertEqual(bars(with_bars)[key]["value"], before[key])
        levels = after["error_estimate"]["runs"]
        self.assertEqual([level["dt_s"] for level in levels], [0.05, 0.2, 0.1, 0.2, 0.2])
        self.assertEqual([level["cells"] for level in levels], [24, 192, 24, 24, 24])
        # a level is what its options give by hand
        by_hand = pc.finished(SCENE + ["-ts_dt", "0.2", "-dm_refine", "1"]).json()
        for key in NUMBERS:
            self.assertAlmostEqual(levels[1]["numbers"][key], by_hand[key], delta=1e-9 * abs(by_hand[key]) + 1e-12)
        self.assertIn("± ", with_bars.out)
        self.assertEqual(plain.files(), with_bars.files())

    def test_another_mesh(self):
        """A coarser mesh of the same block: cells twice as large, so the bar is 1.25 times the difference."""
        other = ["-error_estimate_mesh", pc.mesh("cube_coarse.msh")]
        fine = [pc.mesh("cube.msh") if o == pc.mesh("cube_coarse.msh") else o for o in SCENE]
        run = pc.finished(fine + STEPS + ESTIMATE + other).json()["error_estimate"]
        self.assertEqual([run["runs"][i]["cells"] for i in (0, 1)], [192, 24])
        by_hand = [pc.finished(scene + ["-ts_dt", "0.2"]).json() for scene in (fine, SCENE)]
        for key in NUMBERS:
            difference = abs(by_hand[0][key] - by_hand[1][key])
            self.assertAlmostEqual(run["numbers"][key]["space"], 1.25 * difference, delta=1e-6 * difference + 1e-12)

    def test_refined_once_less(self):
        run = pc.finished(SCENE + ["-ts_dt", "0.2", "-dm_refine", "1"] + ESTIMATE).json()["error_estimate"]
        self.assertEqual([run["runs"][i]["cells"] for i in (0, 1)], [192, 24])

    def test_ranks(self):
        one, two = bars(estimated()), bars(pc.finished(SCENE + STEPS + ESTIMATE, ranks=2))
        for key in NUMBERS:
            for part in ("time", "space"):
                self.assertAlmostEqual(one[key][part], two[key][part], delta=1e-6 * abs(one[key]["value"]) + 1e-9)

    def test_steps_by_their_error(self):
        run = pc.finished(SCENE + BDF2 + ["-step_volume_tolerance", "0.5", "-ts_adapt_dt_max", "0.1"] + ESTIMATE).json()
        steps = [level["steps"] for level in run["error_estimate"]["runs"]]
        self.assertGreater(steps[0], 1.4 * steps[2])
        self.assertGreater(steps[2], 1.2 * steps[3])

    def test_a_level_that_fails(self):
        """Newton steps that suffice for 0.05 s, not for 0.2 s: the run is whole, its bars are empty and say why."""
        case = pc.finished(SCENE + STEPS + ["-snes_max_it", "3", "-ts_adapt_dt_min", "0.051"] + ESTIMATE)
        levels = case.json()["error_estimate"]["runs"]
        self.assertEqual(["failure" in level for level in levels], [False, True, False, True, True])
        self.assertIsNone(bars(case)["tidal_volume_ml"]["error"])
        self.assertIn("?: steps 4 times as long: no step could be accepted", case.out)

    def test_steps_that_cannot_be_longer(self):
        """Phases of one step: no error in time, and the reason."""
        case = pc.finished(pc.LITRE + pc.DIRECT + pc.QUIET + pc.SCENE + ESTIMATE +
                           ["-ventilator", "supersyringe", "-ventilator_inspiration", "0.2", "-ventilator_pause", "0.2",
                            "-ts_dt", "0.2"])
        self.assertIsNone(bars(case)["tidal_volume_ml"]["time"])
        self.assertIn("hardly longer", case.out)

    def test_no_breath(self):
        case = pc.finished(SCENE + ["-ventilator_peep", "5", "-ts_max_time", "0.2"] + STEPS + ESTIMATE)
        self.assertIn("ends before its first breath", case.out)
        self.assertNotIn("error_estimate", case.json())

    def test_names_and_viewers(self):
        """A mesh whose name has blanks and dashes; a level leaves the run's own monitor alone."""
        mesh = os.path.join(os.path.dirname(pc.scratch()), "a block  -v2.msh")
        shutil.copy(pc.mesh("cube_coarse.msh"), mesh)
        log = pc.scratch("newton.txt")
        scene = [mesh if o == pc.mesh("cube_coarse.msh") else o for o in SCENE] + ["-ts_dt", "0.2", "-snes_monitor", "ascii:" + log]
        lines = []
        for more in ([], ESTIMATE):
            pc.finished(scene + more)
            with open(log) as f:
                lines.append(f.read())
        self.assertEqual(*lines)

    def test_restart(self):
        """Asked for at the restart only: the bars of the whole run."""
        first = pc.finished(SCENE + STEPS + ["-checkpoint_every", "0.4"])
        again = pc.finished(SCENE + STEPS + ESTIMATE + ["-restart", first.path("checkpoint_previous.h5")])
        whole = bars(estimated())
        for key in NUMBERS:
            self.assertAlmostEqual(bars(again)[key]["error"], whole[key]["error"], delta=1e-6 * abs(whole[key]["value"]) + 1e-12)

    def test_refused(self):
        def said(options, *words):
            case = pc.Case(options)
            self.assertNotEqual(case.code, 0)
            for word in words:
                self.assertIn(word, case.err)
            return case

        said(SCENE + ["-error_estimate_mesh", "x.msh"], "-error_estimate_mesh x.msh", "-error_estimate")
        case = said(SCENE + ESTIMATE + ["-error_estimate_mesh", "none.msh"], "-error_estimate_mesh none.msh", "no such file")
        self.assertFalse(os.path.exists(case.directory))
        still = pc.BLOCK + pc.DIRECT + pc.QUIET + ["-tissue", "yoshihara", "-chest_wall", "-chest_wall_surfaces", "x0"]
        said(still + ESTIMATE, "-error_estimate", "-ventilator")
        for mesh, words in ((pc.mesh("cube_coarse.msh"), "as large as"), (pc.mesh("cube_msh22_ascii.msh"), "x1")):
            case = said(SCENE + ["-ts_dt", "0.2"] + ESTIMATE + ["-error_estimate_mesh", mesh], words)
            self.assertFalse(os.path.exists(case.directory), "known before the run")


if __name__ == "__main__":
    pc.main()
