#!/usr/bin/python3
"""tools/breathe: from a mask or a mesh to a page, again, interrupted, and with what users get wrong; -dry_run."""
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import time
import unittest
from pathlib import Path

import nibabel
import numpy as np

import pulmo_case as pulmo

TOOL = os.path.join(pulmo.SOURCE, "tools/breathe")
LUNG = os.path.join(pulmo.SOURCE, "meshes/lung_test.msh")
QUICK = ["--elements", "P1-P1", "--ranks", "1"]
STEPS = ["--", "-ts_dt", "0.1"]


def folder():
    """An empty one."""
    path = Path(pulmo.scratch())
    path.mkdir(parents=True)
    return path


def with_build(words):
    """The words of a call with the build folder, unless they name one or go on with a folder."""
    words = [str(word) for word in words]
    known = "--build" in words or len(words) == 1 and not words[0].endswith((".msh", ".py"))
    return words if known else [words[0], "--build", os.path.dirname(pulmo.PROGRAM), *words[1:]]


def called(*words, cwd=None):
    """A call with the program at hand, in a folder of its own unless one is named."""
    return subprocess.run([TOOL, *with_build(words)], capture_output=True, text=True, timeout=300, env=pulmo.ENVIRONMENT, cwd=cwd or folder())


def rows(folder):
    """Time and volume of a run's rows."""
    with open(Path(folder) / "signals.csv") as f:
        return [(float(row["time_s"]), float(row["volume_ml"])) for row in csv.DictReader(f)]


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.02)


class Mesh(unittest.TestCase):
    """A mesh, weight and a programme of the user's own."""

    @classmethod
    def setUpClass(cls):
        cls.place = folder()
        (cls.place / "bt").write_text("a file that is called like a line search\n")
        (cls.place / "mine.txt").write_text("inspiration 0.6 pressure 5 ramp 0.1\nexpiration 1.4 pressure 0\n")
        cls.words = [LUNG, "--mode", "programme", "--effects", "supine", "--case", "case", *QUICK, *STEPS,
                     "-ventilator_programme", "mine.txt", "-snes_linesearch_type", "bt"]
        cls.made = called(*cls.words, cwd=cls.place)
        cls.case = cls.place / "case"

    def test_the_run_is_that_of_its_options(self):
        self.assertEqual(self.made.returncode, 0, self.made.stderr)
        direct = pulmo.finished(["-dm_plex_filename", LUNG, "-options_file", os.path.join(pulmo.SOURCE, "petsc_options/scenes/programme.opts"),
                                 "-options_file", os.path.join(pulmo.SOURCE, "petsc_options/scenes/supine.opts"), "-options_file",
                                 os.path.join(pulmo.SOURCE, "petsc_options/solvers/iterative.opts"), "-elements", "P1-P1", "-ts_dt", "0.1",
                                 "-ventilator_programme", str(self.place / "mine.txt")])
        self.assertEqual(rows(self.case / "run"), rows(direct.directory))
        said = f"tidal volume {direct.json()['tidal_volume_ml']:.4g} ml"
        self.assertIn(said, self.made.stdout)
        self.assertIn(f"peak pressure {direct.json()['peak_inspiratory_pressure_cmH2O']:.4g} cmH2O", self.made.stdout)

    def test_the_folder_is_whole(self):
        """It goes elsewhere, without the files that the call named, and run.sh does the same run."""
        self.assertTrue((self.case / "report.html").stat().st_size > 10000)
        self.assertIn("<title>pulmo: case</title>", (self.case / "report.html").read_text())
        self.assertIn("The mesh lung.msh has 1350 ml", (self.case / "dry_run.txt").read_text())
        elsewhere = Path(pulmo.scratch()) / "moved"
        shutil.copytree(self.case, elsewhere)
        environment = dict(pulmo.ENVIRONMENT, PATH=os.path.dirname(pulmo.PROGRAM) + ":" + os.environ["PATH"])
        again = subprocess.run([elsewhere / "run.sh", "-progress", "off"], capture_output=True, text=True, env=environment, cwd="/", timeout=300)
        self.assertEqual(again.returncode, 0, again.stderr)
        self.assertEqual(rows(elsewhere / "again"), rows(self.case / "run"))
        self.assertNotIn(str(self.place), (self.case / "own.opts").read_text())

    def test_the_surroundings_do_not_count(self):
        """Options of the environment are in no file of the case."""
        place = folder()
        shutil.copytree(self.place, place, dirs_exist_ok=True)
        shutil.rmtree(place / "case/run")
        made = subprocess.run([TOOL, "case"], capture_output=True, text=True, timeout=300, cwd=place,
                              env=dict(pulmo.ENVIRONMENT, PETSC_OPTIONS="-tissue ma"))
        self.assertEqual(made.returncode, 0, made.stderr)
        self.assertEqual(rows(place / "case/run"), rows(self.case / "run"))

    def test_again_does_nothing_twice(self):
        before = os.stat(self.case / "run/summary.json").st_mtime_ns
        for words in (self.words, ["case"]):
            again = called(*words, cwd=self.place)
            self.assertEqual(again.returncode, 0, again.stderr)
            self.assertIn("the run is there already", again.stdout)
        self.assertEqual(os.stat(self.case / "run/summary.json").st_mtime_ns, before)

    def test_what_changed_is_told(self):
        place = Path(pulmo.scratch())
        shutil.copytree(self.place, place)
        (place / "mine.txt").write_text("inspiration 0.6 pressure 4 ramp 0.1\nexpiration 1.4 pressure 0\n")
        shutil.copyfile(LUNG, place / "lung.msh")
        for words, said in ((self.words, "has changed since"), ([*self.words, "-tissue", "ma"], "called otherwise")):
            refused = called(*words, cwd=place)
            self.assertEqual((refused.returncode, len(refused.stderr.splitlines())), (1, 1), refused.stderr)
            self.assertIn(said, refused.stderr)
        with open(place / "case/own.opts", "a") as f:  # by hand
            f.write("-tissue ma\n")
        told = called("case", cwd=place)
        self.assertEqual(told.returncode, 0, told.stderr)
        self.assertEqual(json.loads((place / "case/run/summary.json").read_text())["tissue"], "ma")
        self.assertEqual(rows(place / "case/run_before_1"), rows(self.case / "run"))

    def test_option_files_mean_what_they_say(self):
        """Comments, quotes, aliases, files within files, YAML."""
        place = folder()
        (place / "more.opts").write_text("-chest_wall_stiffness 0.1 # kPa/mm\n")
        (place / "last.yaml").write_text("ts_max_time: 0.2\n")
        (place / "mine.opts").write_text('# mine\nalias -pip -ventilator_pip\n-options_file more.opts\n-pip 5\n-ventilator pcv\n-tissue "ma" # a law\n'
                                         "-airflow\n-airflow_permeability 1e4\n-chest_wall\n-options_file last.yaml\n")
        made = called(LUNG, "--mode", "mine.opts", *QUICK, "--case", "c", *STEPS, "-prestress_pressure", "-0.5", cwd=place)
        self.assertEqual((made.returncode, made.stderr.count("-prestress_pressure")), (1, 1), made.stderr)
        made = called(LUNG, "--mode", "mine.opts", *QUICK, "--case", "c2", *STEPS, cwd=place)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        options = json.loads((place / "c2/run/summary.json").read_text())["options"]
        self.assertEqual([options[name] for name in ("-tissue", "-ventilator_pip", "-chest_wall_stiffness", "-ts_max_time")], ["ma", "5", "0.1", "0.2"])

    def test_scenes_with_a_mesh_of_their_own(self):
        """The mesh of the call counts."""
        place = folder()
        made = called(LUNG, "--mode", "ards_peep_trial", *QUICK, "--case", "c", "--", "-ts_max_time", "0.1", "-dm_plex_filename", "x.msh", cwd=place)
        self.assertEqual((made.returncode, "-dm_plex_filename is given" in made.stderr), (1, True), made.stderr)
        made = called(LUNG, "--mode", "peep_trial", *QUICK, "--case", "c", "--", "-ts_max_time", "0.2", cwd=place)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        self.assertIn("peep_trial.opts names the mesh meshes/lung_test.msh; the one of the call counts", made.stdout)
        self.assertEqual(json.loads((place / "c/run/summary.json").read_text())["options"]["-dm_plex_filename"], "lung.msh")
        self.assertTrue((place / "c/inputs/peep_trial.txt").exists())

    def test_more_ranks_than_cores_are_told(self):
        cores = len(os.sched_getaffinity(0))
        made = called(LUNG, "--elements", "P1-P1", "--ranks", str(cores + 1), "--dry-run", *STEPS, "-dry_run_seconds", "1")
        self.assertEqual(made.returncode, 0, made.stderr)
        self.assertIn(f"--ranks {cores + 1} is more than the {cores} core", made.stdout)

    def test_overwriting_leaves_the_users_files(self):
        place = folder()
        shutil.copytree(self.place, place, dirs_exist_ok=True)
        (place / "case/notes.txt").write_text("mine")
        made = called(LUNG, "--overwrite", "--dry-run", *self.words[1:], cwd=place)
        self.assertEqual(made.returncode, 0, made.stderr)
        self.assertEqual((place / "case/notes.txt").read_text(), "mine")
        self.assertFalse((place / "case/run").exists())

    def test_interrupted_it_goes_on(self):
        place = folder()
        shutil.copyfile(self.place / "mine.txt", place / "mine.txt")
        words = [word if word != "bt" else "basic" for word in self.words]
        process = subprocess.Popen([TOOL, *with_build(words)], cwd=place, env=pulmo.ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                                   start_new_session=True)
        signals = place / "case/run/signals.csv.part"
        wait_for(lambda: signals.exists() and signals.read_text().count("\n") > 3)
        os.killpg(process.pid, signal.SIGINT)
        out = process.communicate(timeout=120)[0]
        self.assertEqual(process.returncode, 3, out)
        self.assertIn("goes on from its checkpoint", out)
        gone_on = called("case", cwd=place)
        self.assertEqual(gone_on.returncode, 0, gone_on.stderr)
        self.assertIn("going on from the checkpoint", gone_on.stdout)
        whole = rows(self.case / "run")
        np.testing.assert_allclose(rows(place / "case/run"), whole, rtol=0, atol=1e-5 * max(v for _, v in whole))


class Stopped(unittest.TestCase):
    """What a stopped run was asked for beside its numbers."""

    def gone_on(self, *more):
        """Output and summary of the second call for a case whose run ended after a checkpoint, without results."""
        place = folder()
        made = called(os.path.join(pulmo.SOURCE, "meshes/cube_lung.msh"), "--case", "c", *QUICK, "--", "-mesh_scale", "10", "-ts_dt", "0.1",
                      "-checkpoint_every", "1", *more, cwd=place)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        (place / "c/run/checkpoint_previous.h5").rename(place / "c/run/checkpoint.h5")  # the last one is at the end
        (place / "c/run/summary.json").unlink()
        told = json.loads((place / "c/case.json").read_text())
        told["done"]["run"]["code"] = 3
        (place / "c/case.json").write_text(json.dumps(told))
        again = called("c", cwd=place)
        self.assertEqual(again.returncode, 0, again.stdout + again.stderr)
        return again.stdout, json.loads((place / "c/run/summary.json").read_text())

    def test_sensitivities(self):
        """They need the states from the start: the run begins again."""
        out, summary = self.gone_on("-sensitivities", "C_rs")
        self.assertIn("begins again: -sensitivities", out)
        self.assertIn("compliance_ml_per_cmH2O", summary["sensitivities"]["numbers"])

    def test_error_bars(self):
        """A sweep, which needs them too, gives way to more runs."""
        out, summary = self.gone_on("-error_estimate", "-error_estimate_numbers", "C_rs")
        self.assertIn("going on from the checkpoint", out)
        self.assertEqual(summary["error_estimate"]["method"], "runs")
        self.assertIn("compliance_ml_per_cmH2O", summary["error_estimate"]["numbers"])


class Mask(unittest.TestCase):
    def test_from_two_ellipsoids_to_a_page(self):
        x = np.stack(np.meshgrid(*(np.arange(n) * 4.0 for n in (60, 40, 56)), indexing="ij"), axis=-1)
        labels = np.zeros(x.shape[:-1], np.uint8)
        half = np.array([40.0, 52.0, 80.0])
        for label, middle in ((1, (178, 78, 110)), (2, (58, 78, 110))):  # x grows to the right of the body
            labels[np.sum(((x - middle) / half) ** 2, axis=-1) < 1] = label
        place = folder()
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([4.0, 4, 4, 1])), place / "two.nii.gz")
        made = called("two.nii.gz", "--size", "24", "--mode", "vcv", "--tidal-volume", "300", *QUICK, *STEPS, cwd=place)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        case = place / "results/two-vcv"
        summary = json.loads((case / "run/summary.json").read_text())
        self.assertAlmostEqual(summary["tidal_volume_ml"], 300, delta=0.3)
        self.assertAlmostEqual(summary["reference_volume_ml"], 2 * 4 / 3 * np.pi * half.prod() / 1e3, delta=0.015 * summary["reference_volume_ml"])
        self.assertAlmostEqual(summary["regions"]["left_lung"]["ventilation_share"], 0.5, delta=0.02)  # alike, so half each
        self.assertTrue((case / "mesh.html").exists() and (case / "report.html").exists())


class Ended(unittest.TestCase):
    """A signal to tools/breathe alone ends what it has at work, too, in each stage; the case can be taken up again."""

    def ended(self, number, stage, source, *words):
        """The folder of a case that a signal ended while a program of a name was at work in it."""
        place = folder()
        process = subprocess.Popen([TOOL, *with_build([source, "--case", "c", *words])], cwd=place, env=pulmo.ENVIRONMENT, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True)

        def at_work():
            self.assertIsNone(process.poll(), stage)
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            return [int(child) for child in children if stage in Path(f"/proc/{child}/cmdline").read_text().split("\0")]

        wait_for(at_work)
        child, = at_work()
        process.send_signal(number)
        said = process.communicate(timeout=30)
        self.assertEqual((process.returncode, "Traceback" in said[1]), (1, False), said)
        self.assertIn("interrupted; tools/breathe c goes on", said[1])
        self.assertFalse(Path(f"/proc/{child}").exists(), stage)
        return place

    def test_the_mesh_of_a_mask(self):
        labels = np.zeros((90, 90, 120), np.uint8)
        labels[5:40, 10:80, 10:110], labels[50:85, 10:80, 10:110] = 1, 2
        place = folder()
        nibabel.save(nibabel.Nifti1Image(labels, np.diag([2.0, 2, 2, 1])), place / "boxes.nii.gz")
        self.assertFalse((self.ended(signal.SIGTERM, "--mask", place / "boxes.nii.gz", *QUICK) / "c/lung.msh").exists())

    def test_a_check_and_a_dry_run(self):
        self.ended(signal.SIGINT, "--check", LUNG, *QUICK)
        place = self.ended(signal.SIGHUP, "-dry_run", LUNG, *QUICK, "--dry-run", "--", "-dry_run_seconds", "20")
        self.assertTrue((place / "c/lung.msh").exists())


class Within(unittest.TestCase):
    def test_the_run_takes_what_the_search_found(self):
        """The setting that tools/accuracy_cost found by sweeps, though a step of the call's own scene is smaller; the run has its bars."""
        place = folder()
        made = called(os.path.join(pulmo.SOURCE, "meshes/cube_lung.msh"), "--case", "c", *QUICK, "--within", "C_rs=20%", "--budget", "5min", "--",
                      "-mesh_scale", "10", "-ts_dt", "0.01", cwd=place)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        value, bar = map(float, re.findall(r"^ *C_rs = ([\d.]+) ± ([\d.]+)", made.stdout, re.MULTILINE)[-1])
        self.assertLess(bar, 0.2 * value)
        found = (place / "c/accuracy/recommended_20percent.opts").read_text()
        summary = json.loads((place / "c/run/summary.json").read_text())
        self.assertEqual(float(summary["options"]["-ts_dt"]), float(re.search(r"^-ts_dt (.*)$", found, re.MULTILINE)[1]))
        self.assertGreater(float(summary["options"]["-ts_dt"]), 0.01)
        self.assertAlmostEqual(summary["error_estimate"]["numbers"]["compliance_ml_per_cmH2O"]["corrected"], value, delta=1e-3 * value)


class Mistakes(unittest.TestCase):
    """One sentence that names it, exit code 1, nothing of the user's touched."""

    def refused(self, *words, said, code=1, **more):
        run = called(*words, **more)
        self.assertEqual(run.returncode, code, run.stdout + run.stderr)
        lines = [line for line in run.stderr.splitlines() if line.strip()]
        self.assertEqual(len(lines), 1, run.stderr)
        self.assertIn(said, lines[0])

    def test_words(self):
        for words, said in ((["none.msh"], "there is no none.msh"), ([LUNG, "--mode", "pvc"], "pcv"), ([LUNG, "--effects", "gravty"], "gravity"),
                            ([LUNG, "--volume", "2500ml"], "--volume"), ([LUNG, "--ranks", "0"], "--ranks"), ([LUNG, "--ranks", "100000", *QUICK[:2]], "--ranks 100000"), ([LUNG, "--solver", "x"], "iterative"),
                            ([LUNG, "--pip"], "--pip"), ([__file__], "label image"), ([LUNG, "--build", "nowhere"], "tools/setup"),
                            ([LUNG, "--", "tissue"], "belongs to no option"), ([LUNG, "--", "-output_dir", "x"], "-output_dir"), ([LUNG, "--", "-options_file", "no.opts"], "no.opts")):
            with self.subTest(words=words):
                self.refused(*words, said=said)

    def test_folders(self):
        place = folder()
        (place / "full").mkdir()
        (place / "full/thesis.txt").write_text("mine")
        (place / "broken").mkdir()
        (place / "broken/case.json").write_text("{")
        self.refused(LUNG, "--case", "full", said="holds other files", cwd=place)
        self.refused(LUNG, "--case", "full/thesis.txt", said="is a file", cwd=place)
        self.refused(LUNG, "--case", "broken", "--overwrite", said="damaged", cwd=place)
        (place / "self.opts").write_text("-options_file self.opts\n")
        (place / "two.opts").write_text("-tissue birzle -airflow\n")
        (place / "latin.opts").write_bytes(b"-tissue birzle # \xe4\n")
        for name, said in (("self.opts", "names itself"), ("two.opts", "holds two options"), ("latin.opts", "UTF-8")):
            self.refused(LUNG, "--mode", name, said=said, cwd=place)
        (place / "old").mkdir()
        made = called(LUNG, *QUICK, "--case", "old", "--dry-run", cwd=place)
        self.assertEqual(made.returncode, 0, made.stderr)
        self.refused("old/lung.msh", "--case", "old", "--overwrite", said="lies in", cwd=place)
        self.assertTrue((place / "old/lung.msh").exists())
        with open(place / "old/own.opts", "a") as f:  # what no call would write
            f.write("-scene_view_only\n")
        ended = called("old", cwd=place)
        self.assertEqual((ended.returncode, "without a result" in ended.stderr), (1, True), ended.stderr)
        self.refused("broken", said="damaged", cwd=place)
        self.assertEqual((place / "full/thesis.txt").read_text(), "mine")

    def test_what_pulmo_refuses(self):
        """The sentence is pulmo's."""
        self.refused(LUNG, *QUICK, "--", "-tisue", "ma", said="-tissue")
        self.refused(LUNG, "--mode", "vcv", "--pip", "10", *QUICK, said="-ventilator_pip")

    def test_an_empty_mask(self):
        place = folder()
        nibabel.save(nibabel.Nifti1Image(np.zeros((20, 20, 20), np.uint8), np.eye(4)), place / "empty.nii.gz")
        run = called("empty.nii.gz", *QUICK, cwd=place)
        self.assertEqual(run.returncode, 1)
        self.assertIn("empty", run.stdout)
        self.assertFalse((place / "results/empty-pcv/lung.msh").exists())


class DryRun(unittest.TestCase):
    SCENE = pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + ["-ts_dt", "0.1"]

    def foreseen(self, *more):
        case = pulmo.Case([*self.SCENE, "-dry_run", *more])
        self.assertEqual(case.code, 0, case.tail())
        self.assertFalse(os.path.exists(case.directory) and os.listdir(case.directory))
        return case.out

    def test_steps_iterations_and_unknowns_are_foreseen(self):
        """From three steps and the rehearsal with P1-P1 elements; of the run itself nothing is known then."""
        said = self.foreseen("-dry_run_seconds", "1000")
        run = pulmo.finished(self.SCENE).json()
        steps, newton, krylov = map(int, re.search(r"about (\d+) steps with (\d+) Newton steps and (\d+) Krylov", said).groups())
        self.assertEqual(steps, run["steps"])
        self.assertIn("The first steps: 3 steps", said)
        self.assertLess(abs(newton / run["newton_iterations"] - 1), 0.3)
        self.assertLess(abs(krylov / run["krylov_iterations"] - 1), 0.3)
        self.assertIn(f"{run['dofs']} unknowns", said)

    def test_the_cheapest_elements_are_run_through(self):
        self.assertIn("as it just did", self.foreseen("-dry_run_seconds", "1000", "-elements", "P1-P1"))

    def test_without_time_the_first_step_speaks_for_all(self):
        said = self.foreseen("-dry_run_seconds", "1e-6")
        self.assertIn("The first steps: 1 steps", said)
        self.assertIn("The run has about 30 steps", said)

    def test_it_refuses_what_the_run_refuses(self):
        for more, said in ((["-tisue", "ma"], "-tissue"), (["-restart", "x.h5"], "x.h5")):
            case = pulmo.Case([*self.SCENE, "-dry_run", *more])
            self.assertEqual(case.code, 1, case.tail())
            self.assertIn(said, case.err)


if __name__ == "__main__":
    pulmo.main()
