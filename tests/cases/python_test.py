#!/usr/bin/python3
"""The Python module: a run as tables and arrays, scenes and sweeps, and the page docs/python.md, whose blocks are run."""
import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import unittest
from unittest import mock

import numpy as np

import pulmo_case as case

sys.path.insert(0, os.path.join(case.SOURCE, "tools/python"))
import pulmo  # noqa: E402

FAST = dict(solver="direct", elements="P1-P1", ts_dt=0.2)
CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Module(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        # the program under test, and MPI as all tests have it
        cls.environment = mock.patch.dict(os.environ, case.alone() | {"PULMO_PROGRAM": case.PROGRAM})
        cls.environment.start()
        cls.addClassCleanup(cls.environment.stop)
        cls.case = case.finished(case.DIRECT + case.options_file("scenes/pcv.opts") + case.LUNG +
                                 ["-elements", "P1-P1", "-ts_dt", "0.2", "-ventilator_breaths", "2"])
        cls.run_ = pulmo.load(cls.case.directory)

    def test_tables_are_the_files(self):
        run, summary = self.run_, self.case.json()
        self.assertEqual((run.state, run.why, run.summary), ("finished", "", summary))
        for table, name in ((run.signals, "signals.csv"), (run.energy, "energy.csv")):
            self.assertEqual(list(table.columns), self.case.columns(name))
            rows = self.case.signals(name)
            for column in table.columns:
                np.testing.assert_array_equal(table[column], rows[column], err_msg=column)
        self.assertEqual(list(run.breaths.index), [1, 2])
        for number, breath in enumerate(summary["breaths"], 1):
            for key, value in run.breaths.loc[number].items():
                self.assertTrue(value == breath[key] or breath[key] is None and np.isnan(value), key)
        self.assertGreater(len(run.numbers), 15)
        for key, value in run.numbers.items():
            self.assertTrue(value == summary[key] or summary[key] is None and np.isnan(value), key)
        self.assertEqual(run.regions.loc["right_lung", "ventilation_ml"], summary["regions"]["right_lung"]["ventilation_ml"])

    def test_fields_are_the_files(self):
        fields = self.run_.fields
        for step in (0, 1, -1):
            x, cells, values = case.fields(self.case, step)
            np.testing.assert_array_equal(fields.points, x)
            np.testing.assert_array_equal(fields.cells, cells)
            for name in values:
                np.testing.assert_array_equal(fields.values(name, step), values[name], err_msg=name)
        self.assertLessEqual(set(values), set(fields.names))
        rows = self.case.signals()
        gas = dict(zip(rows["time_s"].round(9), rows["volume_ml"]))
        for step, time in enumerate(fields.times):
            came = fields.volume(step) / 1e3 - fields.volumes.sum() / 1e3
            self.assertAlmostEqual(came, gas[round(time, 9)], delta=1e-6 * max(gas.values()))
        self.assertIsNone(fields.values("no_such_field", 0))

    def test_run_gives_what_the_command_gives(self):
        run = pulmo.run("pcv", "lung_test", ventilator_breaths=2, **FAST)
        self.assertEqual(run.numbers.dropna().to_dict(), self.run_.numbers.dropna().to_dict())
        self.assertIn("clinical numbers of breath 2", run.output)
        kept = os.path.join(case.scratch("kept"), "run")
        # later scenes and options count; True, False, None and lists are the words that pulmo takes
        other = pulmo.run(["pcv", os.path.join(case.SOURCE, "petsc_options/scenes/paper.opts")], case.mesh("cube_lung.msh"), directory=kept,
                          mesh_scale=10, energy_audit=False, chest_wall_surfaces=["pleura"], ventilator_peep=None, ts_max_time=0.4, **FAST)
        used = other.summary["options"]
        self.assertEqual([used["-energy_audit"], used["-chest_wall_surfaces"], used["-lumen_pressure"]], ["off", "pleura", "off"])
        self.assertEqual(other.directory, kept)
        with self.assertRaisesRegex(pulmo.Missing, "energy_audit off"):
            other.energy

    def test_a_run_without_a_whole_breath(self):
        run = pulmo.run("pcv", "lung_test", ts_max_time=0.4, **FAST)
        self.assertEqual(list(run.breaths.columns), list(self.run_.breaths.columns))
        self.assertEqual(set(run.numbers.index), set(self.run_.numbers.index))
        self.assertEqual(list(run.numbers.dropna().index), ["functional_residual_capacity_ml"])

    def test_ranks(self):
        with mock.patch.dict(os.environ, case.ENVIRONMENT):
            run = pulmo.run("pcv", "lung_test", ranks=2, ts_max_time=0.4, **FAST)
        self.assertEqual(run.summary["ranks"], 2)

    def test_failures_carry_the_programs_sentence(self):
        with self.assertRaises(pulmo.RunFailed) as wrong:
            pulmo.run("pcv", "lung_test", ventilator_pipp=8)
        self.assertEqual(str(wrong.exception), "unknown option -ventilator_pipp: did you mean -ventilator_pip?; pulmo -help lists all")
        self.assertEqual(wrong.exception.code, 1)
        with self.assertRaises(pulmo.RunFailed) as stuck:
            pulmo.run("pcv", "lung_test", snes_max_it=1, **FAST)
        self.assertEqual(stuck.exception.code, 2)
        self.assertTrue(str(stuck.exception).startswith("steps only crawl"), str(stuck.exception))
        left = pulmo.load(stuck.exception.directory)
        self.assertEqual(left.state, "failed")
        self.assertIn("steps only crawl", left.why)
        self.assertIn("failed", repr(left))
        for call, words in ((lambda: pulmo.run("pvc", "lung_test"), "there is no scene pvc: .* pcv,"),
                            (lambda: pulmo.run("pcv", "lungs"), "there is no mesh lungs: .* lung_test"),
                            (lambda: pulmo.load(case.scratch()), "there is no directory"),
                            (lambda: pulmo.sweep({}, "pcv", "lung_test"), "nothing to vary"),
                            (lambda: pulmo.sweep({"ts_dt": [1]}, "pcv", "lung_test", ts_dt=1), "both varied and given"),
                            (lambda: pulmo.sweep({"ventilator_pip": "68"}, "pcv", "lung_test"), "ventilator_pip has no list"),
                            (lambda: pulmo.sweep({"ventilator_pip": 6}, "pcv", "lung_test"), "ventilator_pip has no list"),
                            (lambda: pulmo.sweep({"mesh": ["a", "b"]}, "pcv", "lung_test"), "mesh is no option"),
                            (lambda: pulmo.run("pcv", "lung_test", output_dir="mine"), "argument directory"),
                            (lambda: pulmo.run("pcv", "lung_test", dry_run=True), "makes no run"),
                            (lambda: pulmo.run("pcv", "lung_test", ranks=0), "ranks is the number"),
                            (lambda: pulmo.run([], "lung_test"), "needs a scene")):
            with self.assertRaisesRegex(pulmo.PulmoError, words):
                call()

    def test_scenes_with_a_mesh_and_files_of_their_own(self):
        """The mesh of the call counts, and files are found from any folder; what the call names itself counts most."""
        rest = FAST | dict(ts_max_time=0.2)
        for place in (case.SOURCE, case.scratch("elsewhere")):
            os.makedirs(place, exist_ok=True)
            with contextlib.chdir(place):
                used = pulmo.run("peep_trial", "lung_pair", **rest).summary
                self.assertEqual(used["options"]["-dm_plex_filename"], case.mesh("lung_pair.msh"))
                self.assertAlmostEqual(used["reference_volume_ml"], 2600, delta=1)
                programme = case.programme("inspiration 0.2 pressure 5\n")[-1]
                used = pulmo.run("peep_trial", "lung_test", ventilator_programme=programme, **rest).summary
                self.assertEqual(used["options"]["-ventilator_programme"], programme)

    def test_arguments_of_numpy_and_wrong_ones(self):
        self.assertEqual(pulmo.run("pcv", "lung_test", ranks=np.int64(1), ts_max_time=np.float64(0.2), **FAST).state, "finished")
        fields = self.run_.fields
        np.testing.assert_array_equal(fields.values("J_mean", np.int64(-1)), fields.values("J_mean", -1))
        for wrong in (99, -99, 1.5, "last"):
            with self.assertRaisesRegex(pulmo.PulmoError, f"no snapshot '?{wrong}"):
                fields.values("J_mean", wrong)
        with self.assertRaisesRegex(pulmo.PulmoError, "sweep.json cannot be written"):
            pulmo.sweep({"ventilator_pip": [6]}, "pcv", "lung_test", directory=os.path.join(self.case.directory, "signals.csv"), **FAST)

    def test_a_cut_file_is_no_run(self):
        """One that ends before the summary does, and one that is no object."""
        cut = case.scratch("cut")
        shutil.copytree(self.case.directory, cut)
        with open(os.path.join(cut, "signals.csv")) as f:
            lines = f.readlines()
        with open(os.path.join(cut, "signals.csv"), "w") as f:
            f.writelines(lines[:len(lines) // 2])
        with self.assertRaisesRegex(pulmo.PulmoError, "it is cut"):
            pulmo.load(cut)
        with open(os.path.join(cut, "summary.json"), "w") as f:
            f.write("[]")
        with self.assertRaisesRegex(pulmo.PulmoError, "summary.json is damaged"):
            pulmo.load(cut)

    def test_sweep(self):
        table = pulmo.sweep({"ventilator_pip": [6, 8], "snes_max_it": [20, 1]}, "pcv", "lung_test", ts_max_time=None, **FAST)
        self.assertEqual(list(zip(table["ventilator_pip"], table["snes_max_it"])), [(6, 20), (6, 1), (8, 20), (8, 1)])
        self.assertEqual(list(table["failure"] == ""), [True, False, True, False])
        self.assertTrue(np.isnan(table["tidal_volume_ml"][1]))
        for row in (0, 2):
            run = pulmo.load(table["directory"][row])
            self.assertEqual(table["tidal_volume_ml"][row], run.summary["tidal_volume_ml"])
            self.assertEqual(run.numbers["peak_inspiratory_pressure_cmH2O"], table["ventilator_pip"][row])

    def test_a_sweep_is_taken_up(self):
        """What is done is not done again, what was cut off begins anew; a changed one is refused, and so are folders of the user's own."""
        where, mesh = case.scratch("sweep"), case.scratch("mine.msh")
        shutil.copyfile(case.mesh("lung_test.msh"), mesh)
        values, rest = {"ventilator_pip": [6, 8], "snes_max_it": [20, 1]}, dict(ts_max_time=0.4, directory=where, **FAST)
        real, calls = subprocess.run, []

        def run(words, **more):
            if "-output_dir" in words:  # Python's own modules start programs, too
                calls.append(words)
            if len(calls) == 3 and not os.path.exists(calls[2][-1]):  # cut off at work
                os.makedirs(words[-1])
                shutil.copyfile(os.path.join(where, "run_001/signals.csv"), os.path.join(words[-1], "signals.csv.part"))
                raise KeyboardInterrupt
            return real(words, **more)

        with mock.patch.object(subprocess, "run", run):
            with self.assertRaises(KeyboardInterrupt):
                pulmo.sweep(values, "pcv", mesh, **rest)
            table = pulmo.sweep(values, "pcv", mesh, **rest)
            self.assertEqual([os.path.basename(words[-1]) for words in calls[3:]], ["run_003", "run_004"])
            again = pulmo.sweep(values, "pcv", mesh, **rest)
            self.assertEqual(len(calls), 5)
            self.assertTrue(again.equals(table))
            self.assertEqual(list(table["failure"] == ""), [True, False, True, False])
            for other, more, said in (({"ventilator_pip": [6]} | {"snes_max_it": [20, 1]}, {}, "had 4 runs, and this one has 2"),
                                      (values | {"ventilator_pip": [6, 9]}, {}, "-ventilator_pip 8 where this one has -ventilator_pip 9"),
                                      (values, {"tissue": "ma"}, "-tissue ma")):
                with self.assertRaisesRegex(pulmo.PulmoError, said):
                    pulmo.sweep(other, "pcv", mesh, **rest | more)
            with open(mesh, "a") as f:
                f.write("\n")
            with self.assertRaisesRegex(pulmo.PulmoError, "mine.msh has changed since"):
                pulmo.sweep(values, "pcv", mesh, **rest)
            shutil.copyfile(case.mesh("lung_test.msh"), mesh)
            shutil.rmtree(os.path.join(where, "run_001"))
            pulmo.sweep(values, "pcv", mesh, **rest)
            self.assertEqual([os.path.basename(words[-1]) for words in calls[5:]], ["run_001"])
        own = case.scratch("own")
        shutil.copytree(self.case.directory, os.path.join(own, "run_001"))
        with self.assertRaisesRegex(pulmo.RunFailed, "output_overwrite"):
            pulmo.sweep(values, "pcv", mesh, **rest | {"directory": own})
        with open(os.path.join(where, "sweep.json"), "w") as f:
            f.write("[")
        with self.assertRaisesRegex(pulmo.PulmoError, "sweep.json is damaged"):
            pulmo.sweep(values, "pcv", mesh, **rest)

    def test_a_run_at_work(self):
        folder = case.scratch("work")
        shutil.copytree(self.case.directory, folder)
        os.remove(os.path.join(folder, "summary.json"))
        run = pulmo.load(folder)
        self.assertEqual((run.state, run.summary, len(run.numbers), len(run.breaths)), ("unfinished", {}, 0, 0))
        self.assertTrue(run.why.startswith("NOT FINISHED"))

    def test_the_page(self):
        with open(os.path.join(case.SOURCE, "docs/python.md"), encoding="utf-8") as file:
            text = file.read()
        blocks = CODE.findall(text)
        self.assertEqual(len(blocks), text.count("```python"))
        self.assertGreaterEqual(len(blocks), 5)
        said, names = io.StringIO(), {}
        with contextlib.redirect_stdout(said):
            for block in blocks:
                exec(compile(block, "docs/python.md", "exec"), names)
        promised = re.search(r"This prints `(.*?)`", text)[1]
        self.assertEqual(said.getvalue().splitlines()[-1], promised)
        volume = names["run"].signals["volume_ml"].iloc[list(names["run"].signals["time_s"].round(9)).index(1.0)]
        self.assertAlmostEqual(names["gas"], volume, delta=1e-6 * volume)
        self.assertEqual(len(names["table"]), 4)
        self.assertTrue((names["table"]["failure"] == "").all())

    def test_it_brings_no_names_but_its_own(self):
        """A user's own modules `shared` or `reports` stay his."""
        words = "import sys, pulmo; print([n for n in ('shared', 'reports', 'exports', 'meshing') if n in sys.modules])"
        said = subprocess.run([sys.executable, "-c", words], env=os.environ | {"PYTHONPATH": os.path.join(case.SOURCE, "tools/python"),
                              "PYTHONDONTWRITEBYTECODE": "1"}, capture_output=True, text=True)
        self.assertEqual(said.stdout, "[]\n", said.stderr)


if __name__ == "__main__":
    case.main()
