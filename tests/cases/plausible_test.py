#!/usr/bin/python3
"""Input that runs to its end and cannot be right, or may be wrong: refused, or told. Silence means right."""
import re
import shutil
import unittest

import h5py
import numpy as np

import pulmo_case as pulmo

CUBE = ["-dm_plex_filename", pulmo.mesh("cube_msh22_ascii.msh"), "-mesh_scale", "10", "-elements", "P1-P1"]  # 1 ml
PCV = pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + [
    "-ventilator_pip", "3", "-ventilator_inspiration", "0.2", "-ventilator_expiration", "0.2"] + pulmo.QUIET
BASE = CUBE + PCV


def words(case):
    """Notes and warnings."""
    return re.findall(r"^pulmo: (?:note|warning): .*$", case.out, re.M)


class Plausible(unittest.TestCase):
    def refused(self, options, *expected, ranks=1):
        case = pulmo.Case(options, ranks=ranks)
        self.assertEqual(case.code, 1, f"{case.command}\n{case.tail()}")
        lines = [line for line in case.err.splitlines() if line.startswith("pulmo: error: ")]
        self.assertEqual(len(lines), 1, case.tail())
        for word in expected:
            self.assertIn(word, lines[0])
        self.assertNotIn("PETSC ERROR", case.err)
        self.assertEqual(case.files(), [])

    def told(self, options, *expected):
        case = pulmo.finished(options)
        found = [w for w in words(case) if all(e in w for e in expected)]
        self.assertEqual(len(found), 1, f"{expected}\n{case.command}\n{case.out}")
        return case


class Tissue(Plausible):
    def test_a_law_that_is_not_stable_at_rest(self):
        for law, parameters in (("ma", ["-tissue_a", "-0.1"]), ("ma", ["-tissue_a", "0.043"]), ("ma", ["-tissue_b", "0.1"])):
            self.refused(BASE + ["-tissue", law] + parameters, "-tissue ma", *parameters[:1], "not stable at rest")

    def test_in_one_region_of_the_mesh(self):
        path = pulmo.scratch("two.msh")
        with open(pulmo.mesh("cube_msh22_ascii.msh")) as f, open(path, "w") as g:
            text = f.read().replace('3\n2 1 "airway"', '4\n2 1 "airway"').replace('3 3 "body"', '3 3 "left"\n3 4 "right"')
            g.write(re.sub(r"(?m)^(4\d|36) 4 2 3 3 ", r"\1 4 2 4 4 ", text))  # the last cells
        scene = BASE + ["-dm_plex_filename", path, "-tissue", "ma"]
        for ranks in (1, 2):
            self.refused(scene + ["-tissue_a", "0.43,right=0.1"], "-tissue_a 0.43,right=0.1", " at (", ranks=ranks)
        # what no cell has does not matter
        pulmo.finished(scene + ["-tissue_a", "0.1,right=0.43,left=0.43", "-ts_max_time", "0.05"])


class Checkpoints(Plausible):
    def test_a_state_that_does_not_belong_to_its_signals(self):
        run = pulmo.Case(BASE + ["-checkpoint_every", "0.1", "-ts_max_time", "0.2"])
        self.assertEqual(run.code, 0, run.tail())
        path = run.path("checkpoint.h5")
        pulmo.finished(BASE + ["-restart", path, "-ts_max_time", "0.3"])
        for name in "displacement", "pressure":
            other = pulmo.scratch("changed.h5")
            shutil.copy(path, other)
            with h5py.File(other, "r+") as f:  # which makes the checksums anew
                f["state/" + name][...] *= 1.05
            self.refused(BASE + ["-restart", other, "-ts_max_time", "0.3"], "-restart", "does not belong to its signals")

    def test_gas_that_the_run_lost(self):
        """What is missing at the end counts as what a step leaves: a hundredth ends the run, a ten thousandth is told."""
        first = pulmo.finished(BASE + ["-checkpoint_every", "0.1", "-ts_max_time", "0.2"])
        swing = np.ptp(first.signals()["volume_ml"])
        for share, code in ((0.05, 2), (1e-3, 0)):
            path = pulmo.scratch("lost.h5")
            shutil.copy(first.path("checkpoint.h5"), path)
            with h5py.File(path, "r+") as f:
                names = bytes(f["scalar_names"][...]).decode().split("\n")
                f["scalars"][names.index("delivered_mm3"), 0] += 1000 * share * swing
            case = pulmo.Case(BASE + ["-restart", path, "-ts_max_time", "0.3"])
            self.assertEqual(case.code, code, case.tail())
            said = re.search(r"leaves ([\d.e-]+) ml of gas, ([\d.e-]+) of what", case.err if code else case.out)
            self.assertAlmostEqual(float(said[2]) / share, 1, delta=0.2)


class Breaths(Plausible):
    def test_a_breath_below_its_start(self):
        scene = CUBE + pulmo.options_file("scenes/programme.opts") + pulmo.DIRECT + pulmo.QUIET + ["-ts_dt", "0.02"]
        for text, fall in (("inspiration 0.5 flow -0.3\nexpiration 0.3 pressure 0\n", 0.15),
                           ("settle 0.5 pressure 5 ramp 0.1\ninspiration 0.3 flow -0.2\nexpiration 0.3 pressure 5\n", 0.06)):
            case = self.told(scene + pulmo.programme(text), "note", "falls below that of the breath's start")
            numbers = case.json()
            self.assertIsNone(numbers["tidal_volume_ml"])
            self.assertIsNone(numbers["strain"])
            self.assertIsNone(numbers["breaths"][0]["end_of_inspiration_s"])
            self.assertIsNone(numbers["steady"])
            for key in "resistance_cmH2O_s_per_l", "resistance_equal_weights_cmH2O_s_per_l":
                self.assertTrue(numbers[key] is None or numbers[key] > 0, key)
            rows = case.signals()
            begin = max([i for i, phase in enumerate(rows["phase"]) if phase == "settle"], default=0)
            said = float(re.search(r"by ([\d.]+) ml and rises", case.out)[1])
            self.assertAlmostEqual(said, rows["volume_ml"][begin] - rows["volume_ml"][begin:].min(), delta=1e-3 * fall)
            self.assertAlmostEqual(said, fall, delta=1e-3 * fall)
            self.assertNotIn("100 % of", case.out)
            self.assertNotIn("steady breath", case.out)

    def test_pressure_that_does_not_change(self):
        case = self.told(BASE + ["-ventilator_pip", "5", "-ventilator_peep", "5"], "note", "no breath")
        self.assertNotIn("inf", case.out)
        self.assertIsNone(case.json()["resistance_cmH2O_s_per_l"])

    def test_what_rounding_leaves_is_no_number(self):
        held = BASE + ["-support", "-support_surfaces", "pleura,airway"]
        case = self.told(held, "note", "moves no gas")
        self.assertEqual(len([w for w in words(case) if "springs of -chest_wall" in w]), 2, case.out)
        stiff = self.told(BASE + ["-chest_wall_stiffness", "1e12"], "note", "moves no gas")
        for run in case, stiff:
            numbers = run.json()
            for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "compliance_equal_weights_ml_per_cmH2O",
                        "resistance_equal_weights_cmH2O_s_per_l", "time_constant_s", "dynamic_compliance_ml_per_cmH2O"):
                self.assertIsNone(numbers[key], key)
            self.assertIsNone(numbers["energy_j"]["residual_relative"])

    def test_pressures_that_no_lung_sees(self):
        self.told(BASE + ["-ventilator_pip", "0.3"], "warning", "0.3 cmH2O", "kPa")
        self.told(BASE + ["-tissue", "berger", "-ventilator_pip", "80", "-ts_max_time", "0.01", "-ts_dt", "0.01"],
                  "warning", "80 cmH2O", "Pa")

    def test_a_phase_that_no_breath_has(self):
        self.told(BASE + ["-ventilator_inspiration", "1e-6", "-ventilator_ramp", "0"], "warning", "lasts 1e-06 s")


class Steps(Plausible):
    def test_what_is_right_leaves_no_word(self):
        case = pulmo.finished(BASE + ["-ts_dt", "0.02", "-ventilator_ramp_down", "0.1"])
        self.assertEqual(words(case), [])

    def test_steps_longer_than_phases(self):
        case = self.told(BASE + ["-ts_dt", "10", "-ventilator_ramp_down", "0.2"], "note", "longer than the ramp")
        self.assertEqual(len([w for w in words(case) if "too few" in w]), 1, case.out)

    def test_steps_longer_than_an_effort(self):
        effort = BASE + ["-breathing_effort", "-breathing_effort_fall", "0.04", "-ts_max_time", "0.05"]
        self.told(effort + ["-ts_dt", "0.05"], "note", "longer than the rise or fall of -breathing_effort (0.04 s)")
        self.assertNotIn("rise or fall", pulmo.finished(effort + ["-ts_dt", "0.025"]).out)

    def test_a_least_step_above_the_step(self):
        self.told(BASE + ["-ts_dt", "0.05", "-ts_adapt_dt_min", "0.2"], "warning", "-ts_adapt_dt_min")

    def test_what_a_step_moves_counts(self):
        """The first step takes in 0.06 ml and leaves 0.4 % of that: a warning, not the end."""
        case = pulmo.finished(BASE + ["-snes_rtol", "1e-3", "-ts_max_time", "0.05"])
        self.assertTrue(any("the step to t = 0.05 s is hardly solved" in w for w in words(case)), case.out)
        loss = float(re.search(r"the solver leaves ([\d.e-]+) ml of gas, ([\d.e-]+) of what", case.out)[1])
        share = float(re.search(r"the solver leaves ([\d.e-]+) ml of gas, ([\d.e-]+) of what", case.out)[2])
        self.assertAlmostEqual(share * case.signals()["volume_ml"][1] / loss, 1, delta=0.1)

    def test_damping_over_more_than_a_cell(self):
        self.told(BASE + ["-pressure_damping", "-pressure_damping_length", "30"], "warning", "-pressure_damping_length")
        self.refused(BASE + ["-pressure_damping", "-pressure_damping_length", "1000"], "-pressure_damping_length")
        self.refused(BASE + ["-pressure_damping", "-pressure_damping_modulus", "1e-9"], "-pressure_damping_modulus")
        self.assertNotIn("damped", pulmo.finished(BASE + ["-pressure_damping"]).out)

    def test_parameters_beyond_rounding(self):
        self.refused(BASE + ["-airflow_permeability", "1e15"], "-airflow_permeability")
        case = pulmo.Case(BASE + ["-airflow_permeability", "1e10"])
        self.assertEqual(case.code, 2, case.tail())
        self.assertIn("lower -airflow_permeability", case.err)
        pulmo.finished(BASE + ["-airflow_permeability", "1e10", "-snes_rtol", "1e-14"])  # as it says

    def test_options_that_petsc_stumbles_over(self):
        for option in (["-ksp_initial_guess_nonzero"], ["-ts_adapt_clip", "0.1,0.2"], ["-ts_adapt_clip", "5,1"],
                       ["-ts_adapt_clip", "2"], ["-ts_adapt_scale_solve_failed", "2"]):
            self.refused(BASE + option, option[0])


class Meshes(Plausible):
    def test_periodic_surfaces(self):
        path = pulmo.scratch("periodic.msh")
        with open(pulmo.mesh("cube_msh22_ascii.msh")) as f, open(path, "w") as g:
            g.write(f.read() + "$Periodic\n0\n$EndPeriodic\n")
        self.told(BASE + ["-dm_plex_filename", path, "-ts_max_time", "0.05"], "note", "$Periodic")


if __name__ == "__main__":
    pulmo.main()
