#!/usr/bin/python3
"""The tools beside the program: mesh generator, benchmarks."""
import contextlib
import csv
import io
import json
import os
import pathlib
import shutil
import subprocess
import sys
import unittest
from unittest import mock

import numpy as np

import case_meshes
import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
sys.path.insert(0, os.path.join(pulmo.SOURCE, "tests/support"))
import failed_tests  # noqa: E402
from benchmarks import assembly, effects, memory, operations, scaling  # noqa: E402
from hardcases import envelope, gallery, page  # noqa: E402
from meshing import lung_command, sphere_command  # noqa: E402
from shared import common, keys  # noqa: E402


def tool(name, *arguments):
    command = [os.path.join(pulmo.SOURCE, "tools", name), *map(str, arguments)]
    return subprocess.run(command, env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=300)


def called(name, *arguments):
    """What tool() gives, without a new Python: of a mesh maker."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = {"lung_mesh": lung_command, "sphere_mesh": sphere_command}[name].main([str(a) for a in arguments])
        except SystemExit as end:
            code = end.code
    return subprocess.CompletedProcess([name, *arguments], code, out.getvalue(), err.getvalue())


def benchmark(*arguments):
    return tool("benchmark", "--build", os.path.dirname(pulmo.PROGRAM), *arguments)


def tet_volumes(x, cells):
    return np.abs(np.linalg.det(x[cells[:, 1:4]] - x[cells[:, :1]])) / 6


def table(path):
    with open(path, newline="") as f:
        return list(csv.DictReader(f))


class TestTool(unittest.TestCase):
    """tools/test in a tree of its own, with a set-up that does nothing and tests that fail on purpose."""

    @classmethod
    def setUpClass(cls):
        cls.root = pathlib.Path(pulmo.scratch("tree"))
        for name in "tools", "tests/support", "build":
            (cls.root / name).mkdir(parents=True)
        for name in "tools/test", "tests/support/failed_tests.py":
            shutil.copy(os.path.join(pulmo.SOURCE, name), cls.root / name)
        (cls.root / "tools/setup").write_text('#!/bin/bash\necho "setup got $*"\n')
        (cls.root / "tools/setup").chmod(0o755)
        (cls.root / "script.py").write_text(
            "import unittest\nclass C(unittest.TestCase):\n"
            "    def test_one(self):\n        for law in 'berger', 'ma':\n            with self.subTest(law): self.assertEqual(law, 'ma')\n"
            "    def test_two(self): 'A line about it.'; 1 / 0\n    def test_three(self): pass\nunittest.main()\n")
        (cls.root / "build/CTestTestfile.cmake").write_text(
            f'add_test(good "/bin/true")\nadd_test(script "{sys.executable}" "{cls.root}/script.py")\n'
            'add_test(cpp "/bin/sh" "-c" "echo; echo \'[  FAILED  ] Suite.Name (3 ms)\'; echo \'[  FAILED  ] Suite.Name\'; exit 1")\n'
            'add_test(gone "/no/such/program")\n')

    def run_tests(self, *arguments):
        return subprocess.run([self.root / "tools/test", *arguments], capture_output=True, text=True, timeout=60)

    def test_names_what_failed_and_how_to_run_it(self):
        run = self.run_tests()
        self.assertEqual(run.returncode, 8, run.stdout + run.stderr)  # ctest's own
        self.assertIn("setup got -DPULMO_WERROR=ON", run.stdout)
        self.assertIn("25% tests passed, 3 tests failed out of 4", run.stdout)
        lines = run.stdout.splitlines()[-4:]
        self.assertEqual(set(lines[0].split()), set("test: 3 failed: script cpp gone".split()), run.stdout)
        self.assertEqual(set(lines[1:]), {
            "test: script (test_two, test_one [berger]); alone: tools/test -R '^script$'",
            "test: cpp (Suite.Name); alone: tools/test -R '^cpp$'",
            "test: gone; alone: tools/test -R '^gone$'"})

    def test_arguments_and_success(self):
        run = self.run_tests("-R", "^good$")
        self.assertEqual(run.returncode, 0, run.stdout + run.stderr)
        self.assertIn("100% tests passed, 0 tests failed out of 1", run.stdout)
        self.assertNotIn("test:", run.stdout)
        run = self.run_tests("-R", "^cpp$")
        self.assertEqual(run.returncode, 8)
        self.assertEqual(run.stdout.splitlines()[-2:], ["test: 1 failed: cpp", "test: cpp (Suite.Name); alone: tools/test -R '^cpp$'"])
        # what failed before is not said again
        (self.root / "started").touch()
        self.assertEqual(failed_tests.lines(self.root / "build", self.root / "started"),
                         ["test: ctest failed without naming a test; see above"])


class Tools(unittest.TestCase):
    def test_lung_mesh_feeds_the_program(self):
        mesh = pulmo.scratch("left.msh")
        made = tool("lung_mesh", "--side", "left", "--volume", "900", "--size", "26", "--airway", "hilum", "--output", mesh)
        self.assertEqual(made.returncode, 0, made.stderr)
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + ["-dm_plex_filename", mesh, "-ts_max_time", "0.05"])
        summary = case.json()
        self.assertAlmostEqual(summary["reference_volume_ml"], 900, delta=0.1)
        self.assertEqual(sorted(summary["surface_areas_mm2"]), ["airway", "pleura"])
        self.assertGreater(case.signals()["volume_ml"][-1], 0)

    def test_lung_mesh_follows_the_error_indicator(self):
        """On as many tetrahedra as before the cells with most error get smaller, the others larger."""
        lung = ["--side", "right", "--volume", "1350", "--bronchus-radius", "7"]  # that of lung_test.msh
        case = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.LUNG + [
            "-ts_max_time", "0.1", "-output_fields_error_indicator"])
        mesh = pulmo.scratch("adapted.msh")
        made = tool("lung_mesh", *lung, "--size-field", case.path("fields.xdmf"), "--output", mesh)
        self.assertEqual(made.returncode, 0, made.stderr)
        adapted = pulmo.finished(pulmo.DIRECT + pulmo.PCV + ["-dm_plex_filename", mesh, "-ts_max_time", "0.05"])
        self.assertAlmostEqual(adapted.json()["cells"] / case.json()["cells"], 1, delta=0.1)
        self.assertAlmostEqual(adapted.json()["reference_volume_ml"], 1350, delta=0.1)
        x, cells, values = pulmo.fields(case)
        centres, volume = x[cells[:, :4]].mean(axis=1), tet_volumes(x, cells)
        x, cells, _ = pulmo.fields(adapted)
        nearest = np.linalg.norm(centres[:, None] - x[cells[:, :4]].mean(axis=1), axis=2).argmin(axis=1)
        change = tet_volumes(x, cells)[nearest] / volume
        error = values["error_indicator_flux_W"] / volume
        self.assertLess(np.median(change[error > np.quantile(error, 0.9)]), 0.8)
        self.assertGreater(np.median(change[error < np.quantile(error, 0.5)]), 1)

    def test_lung_mesh_refuses_a_size_field(self):
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.05"])
        for path, word in ((case.path("fields.xdmf"), "-output_fields_error_indicator"), ("none.xdmf", "fields.xdmf")):
            made = tool("lung_mesh", "--size-field", path, "--output", pulmo.scratch("none.msh"))
            self.assertEqual(made.returncode, 1)
            self.assertIn(word, made.stderr)
            self.assertNotIn("Traceback", made.stderr)

    def test_lung_mesh_refuses(self):
        made = tool("lung_mesh", "--side", "left", "--volume", "-3", "--output", pulmo.scratch("none.msh"))
        self.assertNotEqual(made.returncode, 0)
        self.assertIn("volume", made.stderr)
        self.assertNotIn("Traceback", made.stderr)

    def test_meshes_of_absurd_sizes(self):
        """One sentence, at once, and no file."""
        fine = {"sphere_mesh": ["--divisions", "2", "--layers", "2"], "lung_mesh": []}
        for name, words, told in (("lung_mesh", ["--volume", "0"], "--volume"), ("lung_mesh", ["--volume", "nan"], "--volume"),
                                  ("lung_mesh", ["--volume", "1e-9"], "--volume 1e-09 ml"), ("lung_mesh", ["--volume", "1e12"], "--volume 1e+12 ml"),
                                  ("lung_mesh", ["--size", "1e-6"], "--size 1e-06 mm"), ("lung_mesh", ["--size", "1e6"], "--size 1e+06 mm"),
                                  ("lung_mesh", ["--airway-size", "1e-6"], "--airway-size 1e-06 mm"), ("lung_mesh", ["--size", "-1"], "--size"),
                                  ("lung_mesh", ["--cells", "1000000000"], "--cells 1000000000"), ("lung_mesh", ["--cells", "1"], "--cells 1 "),
                                  ("sphere_mesh", ["--divisions", "0"], "--divisions 0"), ("sphere_mesh", ["--layers", "-3"], "--layers -3"),
                                  ("sphere_mesh", ["--divisions", "100000"], "tetrahedra, which take"),
                                  ("sphere_mesh", ["--layers", "1000000000"], "tetrahedra, which take"),
                                  ("sphere_mesh", ["--inner", "1e-9", "--outer", "1e-8"], "--inner 1e-09"),
                                  ("sphere_mesh", ["--inner", "nan"], "--inner nan"), ("sphere_mesh", ["--outer", "inf"], "--outer inf"),
                                  ("sphere_mesh", ["--outer", "7.500001"], "as good as flat"), ("sphere_mesh", ["--divisions", "nan"], "--divisions")):
            with self.subTest(tool=name, words=words):
                folder = os.path.dirname(pulmo.scratch())
                # the first of each tool as a user calls it
                call = tool if words in (["--volume", "0"], ["--divisions", "0"]) else called
                refused = call(name, *fine[name], *words, "--output", os.path.join(folder, "made.msh"))
                self.assertIn(refused.returncode, (1, 2))
                self.assertTrue(refused.stderr.startswith(f"{name}: "), refused.stderr)
                self.assertIn(told, refused.stderr)
                self.assertEqual(len(refused.stderr.splitlines()), 1, refused.stderr)
                self.assertEqual(os.listdir(folder), [])

    def test_ranges_of_laws_are_those_of_the_page(self):
        run = subprocess.run([os.path.join(pulmo.SOURCE, "tools/law_ranges"), "--check", "--build", os.path.dirname(pulmo.PROGRAM)],
                             capture_output=True, text=True, timeout=60, check=False)
        self.assertEqual(run.returncode, 0, run.stderr)

    def test_benchmark_compares_integrators(self):
        """Both integrators give the same residual and Jacobian; only then are times worth comparing."""
        program = os.path.join(os.path.dirname(pulmo.PROGRAM), "pulmo_assembly_benchmark")
        for law in pulmo.tissue_laws():
            with self.subTest(law=law):
                run = subprocess.run([program] + pulmo.DIRECT + pulmo.PCV + pulmo.CUBE +
                                     ["-tissue", law, "-lumen_pressure", "-benchmark_repeats", "1"], env=pulmo.ENVIRONMENT,
                                     capture_output=True, text=True, timeout=120, check=True)
                result = json.loads(run.stdout.splitlines()[-1])
                self.assertLess(result["residual_difference"], 1e-12)
                self.assertLess(result["jacobian_difference"], 1e-12)
                self.assertGreater(result["stock_jacobian_us"], 0)

    def test_benchmark_puts_strategies_side_by_side(self):
        """What the table says is what the runs left; a finished run is kept, a failed one says why."""
        folder, few = pulmo.scratch(), ["strategies", "pcv", "--mesh", pulmo.mesh("cube_lung.msh"), "--time", "0.1"]
        strategies = ["@direct", "@iterative -ksp_rtol 1e-3 -blah 3", "@direct -pc_type nonsense"]
        first = benchmark(*few, "--output", folder, "--", *strategies[:2])
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        self.assertNotIn("kept", first.stdout)
        rows = table(os.path.join(folder, "strategies.csv"))
        self.assertEqual([row["flags"] for row in rows], strategies[:2])
        self.assertIn("-blah", rows[1]["remark"])
        self.assertGreater(float(rows[1]["memory MB"]), 10)

        twin = [pulmo.finished(options + pulmo.options_file("scenes/pcv.opts") + pulmo.CUBE + ["-ts_max_time", "0.1"])
                for options in (pulmo.DIRECT, pulmo.options_file("solvers/iterative.opts") + ["-ksp_rtol", "1e-3"])]
        for row, case in zip(rows, twin):
            summary = case.json()
            self.assertEqual((int(row["steps"]), int(row["Newton"]), int(row["Krylov"])),
                             (summary["steps"], summary["newton_iterations"], summary["krylov_iterations"]))
        volumes = [case.signals()["volume_ml"] for case in twin]
        difference = max(abs(volumes[1] - volumes[0])) / max(volumes[0])
        self.assertAlmostEqual(float(rows[1]["volume difference"]) / difference, 1, delta=0.1)
        with open(os.path.join(folder, "strategies.png"), "rb") as f:
            self.assertEqual(f.read(8), b"\x89PNG\r\n\x1a\n")

        again = benchmark(*few, "--output", folder, "--", *strategies)
        self.assertEqual(again.returncode, 0, again.stdout + again.stderr)
        self.assertEqual(again.stdout.count("kept"), 2)
        repeated = table(os.path.join(folder, "strategies.csv"))
        self.assertEqual(repeated[:2], rows)
        self.assertEqual(repeated[2]["outcome"], "failed")
        self.assertIn("nonsense", repeated[2]["remark"])

    def test_keys_cover_all_that_a_run_reads(self):
        """A key changes with each file, however deep it is named, and with what PETSc, MPI and BLAS listen to; not with the rest."""
        folder = pathlib.Path(pulmo.scratch())
        folder.mkdir()
        files = {"scene.opts": f'-options_file "{folder}/inner.opts"\n-progress off\n',
                 "inner.opts": f"# more\n-options_file_yaml {folder}/deep.yaml\n-ventilator_programme {folder}/breath.txt\n",
                 "deep.yaml": f"dm_plex_filename: {folder}/lung.msh\ntissue_porosity: {folder}/field.h5:porosity\n",
                 "breath.txt": "in 1 pressure 5\n", "lung.msh": "cells\n", "field.h5": "values\n", "cells.h5": "more\n", "asked.txt": "by PETSC_OPTIONS\n",
                 ".petscrc": f"-options_file {folder}/more.opts\n", "more.opts": "-snes_rtol 1e-3\n", "program": "#!/bin/sh\n",
                 "unasked.txt": ""}
        for name, text in files.items():
            (folder / name).write_text(text)
        (folder / "program").chmod(0o755)
        command = [folder / "program", "-options_file", folder / "scene.opts", "-tissue_c", f"{folder}/cells.h5:group/c", "-output_dir"]
        environment = {"PATH": os.environ["PATH"], "HOME": "/nowhere", "PETSC_OPTIONS": f"-x {folder}/asked.txt", "LANG": "C"}

        def key(**more):
            here = os.getcwd()
            os.chdir(folder)
            try:
                return keys.digest(command, {**environment, **more})
            finally:
                os.chdir(here)

        first = key()
        self.assertEqual(key(LANG="de"), first)
        for name, text in files.items():
            with self.subTest(name):
                (folder / name).write_text(text + " ")
                self.assertEqual(key() == first, name == "unasked.txt")
                (folder / name).write_text(text)
                self.assertEqual(key(), first)
        for name in ("OMPI_MCA_btl", "OPENBLAS_CORETYPE", "PETSC_OPTIONS", "LD_LIBRARY_PATH"):
            self.assertNotEqual(key(**{name: "1"}), first, name)
        self.assertNotEqual(keys.digest([*command[:-1], "-tissue", "ma", command[-1]], environment), key())
        self.assertGreater(len(keys.libraries(pulmo.PROGRAM)), 3)
        (folder / "inner.opts").write_text(f"-options_file {folder}/scene.opts\n")  # a circle ends
        self.assertNotEqual(key(), first)

    def test_benchmark_sees_what_option_files_name(self):
        """An edited programme, named by a file that a scene names, is a new run; so is another PETSC_OPTIONS. Unchanged it is kept."""
        folder = pathlib.Path(pulmo.scratch())
        folder.mkdir()
        (folder / "breath.txt").write_text("inspiration 0.1 pressure 4\n")
        (folder / "inner.opts").write_text(f"-ventilator programme\n-ventilator_programme {folder}/breath.txt\n")
        (folder / "scene.opts").write_text(f"-options_file {folder}/inner.opts\n-tissue birzle\n-airflow\n-chest_wall\n-dm_plex_filename "
                                           f"{pulmo.mesh('cube_lung.msh')}\n-mesh_scale 1\n")
        few = ["strategies", folder / "scene.opts", "--output", folder / "out", "--", "@direct"]

        def volume(kept, **environment):
            command = [os.path.join(pulmo.SOURCE, "tools/benchmark"), "--build", os.path.dirname(pulmo.PROGRAM), *map(str, few)]
            run = subprocess.run(command, env={**pulmo.ENVIRONMENT, **environment}, capture_output=True, text=True, timeout=300)
            self.assertEqual(run.returncode, 0, run.stdout + run.stderr)
            self.assertEqual("kept" in run.stdout, kept, run.stdout)
            newest = max((folder / "out/runs").glob("*/run/summary.json"), key=os.path.getmtime)
            return json.loads(newest.read_text())["tidal_volume_ml"]

        first = volume(False)
        volume(True)
        (folder / "breath.txt").write_text("inspiration 0.1 pressure 8\n")
        self.assertGreater(volume(False), 1.5 * first)
        volume(True)
        volume(False, PETSC_OPTIONS="-ts_dt 0.02")

    def test_meshes_are_made_anew_by_another_tool(self):
        """What tools/sphere_mesh made is kept until the words, the file or the tool change."""
        path = pathlib.Path(pulmo.scratch("sphere.msh"))
        words = ["--divisions", 1, "--layers", 1]
        self.assertEqual([keys.make_mesh(path, "sphere_mesh", words) for _ in range(2)], [True, False])
        self.assertTrue(keys.make_mesh(path, "sphere_mesh", ["--divisions", 2, "--layers", 1]))
        path.write_text("spoilt")
        self.assertTrue(keys.make_mesh(path, "sphere_mesh", words))
        self.assertEqual([f for f in os.listdir(path.parent) if f.startswith("part")], [])

    def test_a_script_is_known_by_its_modules(self):
        """What a script imports from folders beside it, also by way of one of them, is part of its key."""
        folder = pathlib.Path(pulmo.scratch())
        for name, text in (("door", "#!/usr/bin/python3\nfrom near import one\n"), ("near/one.py", "import os\nfrom far.two import x\n"),
                           ("far/two.py", "x = 1\n"), ("other/three.py", "")):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        (folder / "door").chmod(0o755)
        known = keys.digest([folder / "door"])
        (folder / "other/three.py").write_text("y = 1\n")
        self.assertEqual(keys.digest([folder / "door"]), known)
        (folder / "far/two.py").write_text("x = 2\n")
        self.assertNotEqual(keys.digest([folder / "door"]), known)
        made_by = [os.path.relpath(path, os.path.join(pulmo.SOURCE, "tools")) for path in keys.modules(
            os.path.join(pulmo.SOURCE, "tools/lung_mesh"))]
        self.assertIn("meshing/shape.py", made_by)

    def test_tools_lock_their_folders(self):
        """Two calls in one folder: the second ends and names the first."""
        folder = pulmo.scratch()
        keys.lock(folder)
        keys.lock(folder)  # the same call may, again
        scene = ["pcv", "--meshes", pulmo.mesh("cube_coarse.msh"), pulmo.mesh("cube.msh"), "--budget", "1s"]
        for refused in (benchmark("strategies", "pcv", "--mesh", pulmo.mesh("cube_lung.msh"), "--output", folder, "--", "@direct"),
                        benchmark("memory", "--mesh", pulmo.mesh("cube_lung.msh"), "--output", pulmo.scratch(), "--results", folder),
                        tool("accuracy_cost", *scene, "--build", os.path.dirname(pulmo.PROGRAM), "--output", folder),
                        tool("accuracy_cost", *scene, "--build", os.path.dirname(pulmo.PROGRAM), "--output", pulmo.scratch(),
                             "--results", folder)):
            self.assertEqual(refused.returncode, 1, refused.stderr)
            self.assertIn(f"another call is at work in {os.path.realpath(folder)} (", refused.stderr)
            self.assertIn(f"process {os.getpid()} on ", refused.stderr)
            self.assertNotIn("Traceback", refused.stderr)
        self.assertEqual(os.listdir(folder), [".lock"])

    def test_benchmark_counts_krylov_iterations(self):
        """The counts of the table are those of the program's own summary and signals."""
        folder = pulmo.scratch()
        few = ["solve", "--mesh", pulmo.mesh("cube_lung.msh"), "--laws", "yoshihara", "--permeability", "1e3", "--dt", "0.05",
               "--phases", "pressure", "flow", "common", "stretch", "--stretch", "1.2", "--output", folder, "--", "@iterative"]
        first = benchmark(*few)
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        rows = {row["phase"]: row for row in table(os.path.join(folder, "solve.csv"))}
        self.assertEqual(list(rows), ["pressure", "flow", "common", "stretch"])
        case = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.CUBE +
                              ["-tissue", "yoshihara", "-airflow_permeability", "1e3", "-ventilator_ramp", "0", "-ts_max_time", "0.1",
                               "-ksp_rtol", "1e-5", "-predictor_increments", "0", "-snes_lag_jacobian", "1",
                               "-snes_lag_preconditioner", "1"])
        summary, row = case.json(), rows["pressure"]
        self.assertEqual((int(row["Newton"]), int(row["solves"])), 2 * (summary["newton_iterations"],))
        self.assertAlmostEqual(float(row["Krylov/solve"]), summary["krylov_iterations"] / summary["newton_iterations"], delta=0.051)
        self.assertGreaterEqual(int(row["largest"]), float(row["Krylov/solve"]))
        self.assertEqual(int(rows["common"]["solves"]), 2 * int(rows["common"]["Newton"]))
        self.assertGreater(float(rows["stretch"]["largest J"]), 1.15)
        with open(os.path.join(folder, "solve.png"), "rb") as f:
            self.assertEqual(f.read(8), b"\x89PNG\r\n\x1a\n")
        self.assertEqual(benchmark(*few).stdout.count("kept"), 4)

    def test_benchmark_tells_which_breaths_finish(self):
        """A row per breath, law and flags with the run's own numbers; what stopped is run again as --checks says."""
        folder, mesh = pulmo.scratch(), case_meshes.scaled("cube_lung.msh", 10)[1]
        hasty = "@direct -snes_max_it 1 -snes_rtol 1e-14 -ts_adapt_dt_min 0.01"
        made = benchmark("breaths", "--mesh", mesh, "--laws", "yoshihara", "--breaths", "VCV 250 ml, PEEP 5", "--volume", "100",
                         "--checks", "direct", "--output", folder, "--", "@reuse", hasty)
        self.assertEqual(made.returncode, 0, made.stdout + made.stderr)
        self.assertIn("1 of 2 finished", made.stdout)
        whole, stopped = table(os.path.join(folder, "breaths.csv"))
        self.assertEqual((whole["law"], whole["flags"], whole["end"]), ("yoshihara", "@reuse", "0: finished"))
        self.assertEqual((whole["V_T ml"], whole["cut"]), ("100", "0"))
        self.assertGreater(float(whole["C_rs ml/cmH2O"]), 0)
        self.assertEqual(stopped["V_T ml"], "-")
        self.assertRegex(stopped["end"], r"^2: t = [0-9.]+ s, settle, [0-9.]+ cmH2O: in the solver$")
        with open(os.path.join(folder, "breaths.md")) as f:
            self.assertRegex(f.read(), r"run again:\n\n.*\n.*\n\| VCV 250 ml, PEEP 5 \| yoshihara \| @direct \| 0: finished \| 100 \|")

    def test_benchmark_tells_what_effects_cost(self):
        """One effect more and one less on a cube of a litre: the numbers of a run by hand; what is off costs nothing; runs are kept."""
        folder, results = pulmo.scratch("page"), pulmo.scratch("effects")
        few = ["effects", "--mesh", pulmo.mesh("cube_lung.msh"), "--effects", "tube", "airflow", "--repeat", "1", "--solver", "@direct",
               "--output", folder, "--results", results, "--", "-mesh_scale 10 -ts_dt 0.1"]
        made = benchmark(*few)
        self.assertEqual(made.returncode, 0, made.stderr)
        with open(os.path.join(folder, "cost.csv"), newline="") as f:
            rows = {r["scene"]: r for r in csv.DictReader(f)}
        self.assertEqual(list(rows), ["the scene", "+ tube", "− airflow"])
        by_hand = pulmo.finished(["-dm_plex_filename", pulmo.mesh("cube_lung.msh")] + pulmo.options_file("scenes/pcv.opts") +
                                 effects.SCENE.split() + pulmo.DIRECT + ["-mesh_scale", "10", "-ts_dt", "0.1"] +
                                 effects.ON["tube"].split()).json()
        tube, energy = rows["+ tube"], by_hand["breaths"][-1]["energy_j"]
        self.assertEqual(int(tube["Newton"]), by_hand["newton_iterations"])
        self.assertAlmostEqual(float(tube["V_T ml"]), by_hand["tidal_volume_ml"], delta=0.1)
        heat = sum(v for name, v in energy.items() if name.startswith("resistive"))
        self.assertAlmostEqual(float(tube["of it flow"]), 1e3 * heat, delta=0.6)
        self.assertAlmostEqual(float(tube["loop mJ"]), 1e3 * energy["ventilator_work"], delta=0.6)
        self.assertGreater(float(rows["+ tube"]["R cmH2O s/l"]), float(rows["the scene"]["R cmH2O s/l"]) + 3)
        with open(os.path.join(folder, "cost.md")) as f:
            page = f.read()
        self.assertIn("Counts: the same. States and signals: the same bit for bit.", page)
        self.assertRegex(page, r"static pressure–volume curve, 8 points")
        self.assertTrue(os.path.getsize(os.path.join(folder, "cost.png")))
        self.assertEqual(benchmark(*few).stdout.count("kept"), 6)

    def test_effects_show_up_by_themselves(self):
        """One that the tool does not know comes by its example, one that the scene has goes off."""
        entries = effects.entries_of(["tissue", "airflow", "ventilator", "chest_wall"],
                                     {"bellows": "-bellows -bellows_depth 3", "chest_wall": "-chest_wall", "tube": "-tube -tube_k1 20"}, None)
        self.assertEqual(entries["+ bellows"], "-bellows -bellows_depth 3")
        self.assertEqual(entries["+ tube"], effects.ON["tube"])
        self.assertEqual(entries[effects.ALL], "-bellows -bellows_depth 3 " + effects.ON["tube"])
        self.assertEqual(entries["− airflow"], "-airflow off")
        self.assertNotIn("+ chest_wall", entries)
        self.assertNotIn("− tissue", entries)
        every = pulmo.common.examples(pulmo.PROGRAM)
        self.assertGreater(len(every), 10)
        self.assertTrue(set(effects.ON) | set(effects.OFF) <= set(every))

    def test_benchmark_refuses(self):
        few = ["strategies", "pcv", "--mesh", pulmo.mesh("cube_lung.msh"), "--output", pulmo.scratch()]
        made = ["--output", pulmo.scratch(), "--results", pulmo.scratch()]
        for arguments, named in ((few, "--"),
                                 (few + ["--", "@nothing"], "@direct"),
                                 (few + ["--", "direct"], "@"),
                                 (few + ["--", "@direct '"], "quotation"),
                                 (few + ["--", "@direct", "@direct"], "twice"),
                                 (few + ["--", "@direct -output_dir here"], "-output_dir"),
                                 (["strategies", "nowhere.opts", "--", "@direct"], "nowhere.opts"),
                                 (["strategies", "pcv", "--mesh", "none.msh", "--", "@direct"], "none.msh"),
                                 (["breath", "--time", "0.07"], "multiple"),
                                 (["memory", "--mesh", "none.msh"], "none.msh"),
                                 (["scaling", "--ranks", "2"], "begin with 1"),
                                 (["scaling", "--ranks", "1", "--count-ranks"], "several ranks"),
                                 (["scaling", "--", "@direct", "@iterative"], "one string"),
                                 (["effects", "--mesh", "none.msh"], "none.msh"),
                                 (["effects", "--effects", "blood", *made], "chest_wall"),
                                 (["solve", "--mesh", "none.msh"], "none.msh"),
                                 (["solve", "--stretch", "0.9"], "--stretch"),
                                 (["solve", "--dt", "2"], "--dt"),
                                 (["assembly", "--", "@direct"], "no flags")):
            with self.subTest(arguments=arguments):
                refused = benchmark(*arguments)
                self.assertNotEqual(refused.returncode, 0)
                self.assertIn(named, refused.stderr)
                self.assertNotIn("Traceback", refused.stderr)

    def test_benchmark_measures_memory(self):
        """One step per entry; shares are of the first entry, and the parts and the rest are the whole."""
        folder = pulmo.scratch()
        few = ["memory", "--mesh", pulmo.mesh("cube_lung.msh"), "--output", folder, "--results", os.path.join(folder, "runs")]
        first = benchmark(*few)
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        rows = table(os.path.join(folder, "memory.csv"))
        self.assertEqual([row["flags"] for row in rows], memory.ENTRIES)
        for row in rows:
            peak = float(row["peak MB"])
            self.assertGreater(peak, 10)
            self.assertAlmostEqual(sum(float(row[f"{part} MB"]) for part in [*memory.PARTS, "rest"]), peak, delta=2.1)
            self.assertAlmostEqual(float(row["share of the first"]), peak / float(rows[0]["peak MB"]), delta=0.02)
        twin = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.05"]).json()
        self.assertEqual((int(rows[1]["dofs"]), int(rows[1]["Newton"])), (twin["dofs"], twin["newton_iterations"]))
        self.assertEqual(benchmark(*few).stdout.count("kept"), 2)

    def test_memory_log(self):
        """The last column of PETSc's table, of the first stage; lines that are no events are none."""
        numbers = " ".join(["1"] * 24)
        log = f"Event Count Time (sec) Mbytes RMI\n   Max Ratio\n------\nPCSetUp {numbers} 86 11 88 99\nPCSetUp {numbers} 0 0 0 3\n"
        self.assertEqual(memory.resident_growth(log + f"Object Type\nKSPSolve {numbers} 1 1 1 7\n"), {"PCSetUp": 99})
        self.assertAlmostEqual(memory.growth_exponent([(8e3, 30), (1e3, 4), (64e3, 480)]), 4 / 3)

    def test_benchmark_scales(self):
        """A run per mesh and number of ranks; counts are those of the run, and one run on two ranks fits its own model."""
        folder = pulmo.scratch()
        few = ["scaling", "--mesh", pulmo.mesh("cube_lung.msh"), "--time", "0.05", "--count-ranks", "--predict-ranks", "2", "4",
               "--output", folder, "--results", os.path.join(folder, "runs")]
        first = benchmark(*few)
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        one, two = table(os.path.join(folder, "scaling.csv"))
        twin = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + common.PLAIN.split() + pulmo.PCV + pulmo.CUBE
                              + ["-ts_max_time", "0.05"]).json()
        self.assertEqual([int(one[key]) for key in ("dofs", "Newton", "Krylov")],
                         [twin[key] for key in ("dofs", "newton_iterations", "krylov_iterations")])
        self.assertEqual((one["ranks"], one["messages/rank/step"], one["efficiency"]), ("1", "0", "1.00"))
        self.assertGreater(int(two["messages/rank/step"]), 10)
        with open(os.path.join(folder, "scaling.md")) as f:
            checks = [line for line in f if "/rank/step |" in line and line.startswith("| cube_lung | 2 |")]
        self.assertEqual([line.split("|")[-2].strip() for line in checks], ["1.00", "1.00"])
        self.assertEqual(len(table(os.path.join(folder, "scaling_model.csv"))), 6)
        self.assertEqual(benchmark(*few).stdout.count("kept"), 2)

    def test_scaling_log(self):
        """PETSc counts a message at both ends; stages are summed, ranks are not."""
        log = ("noise\nStage Name,Event Name,Rank,Count,Time,Num Messages,Message Length,Num Reductions,FLOP,dof0\n"
               "Main Stage,summary,0,9.,20.,300.,7.,8.\nMain Stage,KSPSolve,0,2,1.5,10.,800.,6.,100.,\n"
               "Main Stage,KSPSolve,1,2,2.5,14.,1000.,6.,300.,\nother,KSPSolve,1,1,1.,2.,8.,0.,0.,\n"
               "Main Stage,TSStep,0,1,4.,20.,1000.,9.,100.,\nMain Stage,TSStep,1,1,4.,20.,2000.,9.,300.,\n")
        events = scaling.parse_log(log)
        self.assertEqual([rank["messages"] for rank in events["KSPSolve"]], [5, 8])
        self.assertEqual(scaling.mean(events, "KSPSolve", "bytes"), (400 + 504) / 2)
        self.assertEqual(scaling.mean(events, "absent", "bytes"), 0)
        self.assertEqual(scaling.imbalance(events), 1.5)
        newton, krylov = scaling.split(events, {"newton_iterations": 3, "krylov_iterations": 13})
        self.assertAlmostEqual(krylov["messages"], 0.5)
        self.assertAlmostEqual(newton["messages"], 3.5 / 3)
        self.assertEqual(scaling.parse_log("no log"), {})

    def test_scaling_model(self):
        """The model by hand; and parts of a row of cubes of six tetrahedra, whose cut is known."""
        lines = scaling.fit([{"neighbours": n, "faces": 10 * n, "newton": {"messages": 2 + 3 * n, "bytes": 50 * n, "reductions": 7},
                              "krylov": {"messages": 4 * n, "bytes": 1 + 20 * n, "reductions": 2}} for n in (1, 2, 5)])
        np.testing.assert_allclose(lines["newton"]["messages"] + lines["krylov"]["bytes"], [2, 3, 1, 2], rtol=1e-12)
        model = {which: dict(lines[which], seconds=seconds) for which, seconds in (("newton", 1e-4), ("krylov", 1e-5))}
        model.update(newton_per_step=3, krylov_per_step=30)
        cut = {"faces": 100, "neighbours": 6, "imbalance": 1.1}
        parts = scaling.predict(model, 8000, 8, cut, 1e-6, 1e8)
        expected = {"computing": 1000 * 1.1 * (3e-4 + 3e-4), "surfaces": (3 * 500 + 30 * 201) / 1e8,
                    "latency": (3 * 20 + 30 * 24) * 1e-6, "reductions": (3 * 7 + 30 * 2) * 2e-6 * 3}
        for name, value in expected.items():
            self.assertAlmostEqual(parts[name] / value, 1, places=9, msg=name)
        alone = scaling.predict(model, 8000, 1, scaling.surfaces(None, None, 1), 1e-6, 1e8)
        self.assertAlmostEqual(sum(alone.values()), 8000 * 6e-4)
        self.assertAlmostEqual(scaling.scaled_cut(cut, 8e6, 8, 1e6)["faces"], 400)

        corner = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]  # a cube by its bits
        node = [[4 * (cube + (n & 1)) + (n >> 1) for n in range(8)] for cube in range(12)]
        tets = np.array([[node[cube][n] for n in tet] for cube in range(12) for tet in corner])
        pairs = scaling.face_pairs(tets)
        self.assertEqual(len(pairs), 6 * 12 + 2 * 11)  # inside each cube, and between two
        self.assertEqual(scaling.surfaces(tets, pairs, 2), {"faces": 2, "neighbours": 1, "imbalance": 1})

    def test_hard_cases_are_listed(self):
        listed = tool("hard_cases", "--list")
        self.assertEqual(listed.returncode, 0, listed.stderr)
        self.assertEqual([line.split()[0] for line in listed.stdout.splitlines()], list(gallery.CASES))

    def test_page_of_hard_cases(self):
        """A row per case, a line per demand, what was missed and what is old or absent; the figure of what a case left."""
        folder = pathlib.Path(pulmo.scratch())
        limit, plateau = (gallery.run_case(name, pulmo.PROGRAM, small=True) for name in ("limit", "plateau"))
        limit["state"], plateau["state"] = "new", "old"
        plateau["demands"].append({"what": "pressure | volume", "measured": "2", "asked": "< 1", "met": False})
        page.write(folder, [limit, plateau], ["Another case"], "a machine", True, "new")
        text = (folder / "README.md").read_text()
        asked, met = (sum(f(d) for r in (limit, plateau) for d in r["demands"]) for f in (bool, lambda d: d["met"]))
        self.assertIn(f"**{met} of {asked} demands are met", text)
        self.assertRegex(text, r"Without a result.*Another case\.")
        self.assertRegex(text, rf"Of another program.*: {plateau['title']}\.")
        row, = (line for line in text.splitlines() if line.startswith(f"| [{plateau['title']}](#plateau) (old) |"))
        self.assertIn("<br>**missed** pressure / volume: 2 (< 1) |", row)
        self.assertEqual(row.count("|"), 9)
        for case in (limit, plateau):
            self.assertIn(f"The size of the tests leaves out: {case['left_out']}.", text)
        self.assertIn("![Limit point](limit_point.png)", text)
        self.assertGreater((folder / "limit_point.png").stat().st_size, 1000)
        self.assertEqual([(row["case"], row["demand"], row["met"]) for row in table(folder / "hard_cases.csv")],
                         [(r["name"], d["what"], str(d["met"])) for r in (limit, plateau) for d in r["demands"]])

    def test_clinical_envelope(self):
        """What has run is not run again, of another lung or law it is; the page counts, shows why what misses does, and keeps what stands in it by hand."""
        folder, ran = pathlib.Path(pulmo.scratch()), []

        def one(lab, mesh, volume, setting, prestress, law, checks):
            ran.append((setting, prestress, law))
            cost = {"steps": 100, "cut": 1, "newton": 5.25, "krylov": 8.0, "least_J": 0.5, "V_T": 300.0, "C_rs": 30.0, "R": 7.0, "cpu_s": 2.0}
            row = {"end": "finished", "limit": False, "said": "", "verdict": "costs more" if law == "birzle" else "finishes"} | cost
            return row | ({"checks": {name: {"end": "finished"} | cost | {"newton": 1.5} for name in envelope.CHECKS}} if checks and law == "birzle" else {})

        def told(lungs, laws):
            with mock.patch.object(envelope, "run_one", one), contextlib.redirect_stdout(io.StringIO()):
                return envelope.told(pathlib.Path(pulmo.PROGRAM), lungs, laws, folder / "kept/clinical.jsonl", folder, "a machine")

        self.assertEqual(told(["lung_test"], ["ma"]), 0)
        self.assertEqual(ran, [(setting, prestress, "ma") for setting in envelope.SETTINGS for prestress in (False, True)])
        ran.clear()
        self.assertEqual(told(["lung_test"], ["ma"]), 0)
        self.assertEqual(ran, [])
        page_of, own = folder / "clinical_envelope.md", "What was found by hand."
        page_of.write_text(page_of.read_text().replace(envelope.BEGIN, f"{envelope.BEGIN}\n{own}"))
        self.assertIn("with a windpipe (not made yet", page_of.read_text())
        shutil.copy(pulmo.mesh("lung_test.msh"), folder / "kept/clinical_mask.msh")
        self.assertEqual(told(["lung_test"], ["birzle"]), 1)
        self.assertIn("with a windpipe (1,324 tetrahedra)", page_of.read_text())
        self.assertEqual(len(ran), 8)
        text = page_of.read_text()
        self.assertEqual(text.count(own), 1)
        self.assertIn("| lung_test | 16 of 56 | 8 | 0 | 8 | 0 |", text)
        self.assertEqual(text.count("| finished, 5.25 Newton, 8.0 Krylov | finished, 1.50 Newton, 8.0 Krylov |"), 8)
        rows = table(folder / "clinical_envelope.csv")
        self.assertEqual([row["verdict"] for row in rows].count("costs more"), 8)
        self.assertEqual({row["mesh"] for row in rows}, {"lung_test"})

    def test_own_limits_of_the_envelope(self):
        """CM4's and the plateau of CM3 by their derivatives; none where dp/dJ stays."""
        J = 7.5 ** (1 / (1.5 + 2 / 3))
        self.assertAlmostEqual(envelope.own_limit("yoshihara", False)[0], J, places=6)
        below, at, above = (pulmo.gas_pressure("birzle", envelope.own_limit("birzle", False)[0] * f) for f in (0.99, 1, 1.01))
        self.assertLess(above - below, 1e-3)
        self.assertLess(abs(at - 5.028), 1e-3)
        for law in ("berger", "rausch", "patte"):
            self.assertIsNone(envelope.own_limit(law, True))

    def test_operations_are_counted(self):
        for mnemonic, operands, expected in (("vfmadd231pd", "%ymm1,%ymm2,%ymm3", (8, False)), ("vfnmadd213sd", "(%rax),%xmm1,%xmm2", (2, False)),
                                             ("vaddpd", "%xmm1,%xmm2,%xmm3", (2, False)), ("vdivpd", "%ymm1,%ymm2,%ymm3", (4, True)),
                                             ("mulsd", "%xmm1,%xmm2", (1, False)), ("vsqrtsd", "%xmm1,%xmm2,%xmm3", (1, True)),
                                             ("vmovapd", "%ymm1,%ymm2", (0, False)), ("vaddps", "%ymm1,%ymm2,%ymm3", (0, False))):
            with self.subTest(mnemonic=mnemonic):
                self.assertEqual(operations.flops(mnemonic, operands), expected)
        dump = ["events: Ir DLmr DLmw DLdmr DLdmw\n", f"ob={__file__}\n", "fn=kernel\n", "0x10 0 5 1 0 0 0\n", "0x14 0 3\n",
                "calls=2 0x10 0\n", "0x18 0 1000 9 9 9 9\n", "0x1c 0 1 0 1 1 1\n"]
        self.assertEqual(operations.totals(dump, lambda path: {0x10: (8, False), 0x14: (4, True)}),
                         {"flops": 52, "divisions": 3, "bytes": 4 * 64})
        row = assembly.roofline(20, {"flops": 120e3, "divisions": 40, "bytes": 30e3}, {"gflops": 60, "triad_gb": 10})
        self.assertEqual(dict(zip(assembly.ROOFLINE[2:], row))["attainable µs"], "3.00")
        self.assertEqual(row[-2:], ["6.7", "6.0"])
        found = operations.shares(" 30.00%  [.] pulmo::MatrixMap::add\n 10.00%  [.] product_tile<5, 3>\n  5.00%  [k] idle\n")
        self.assertAlmostEqual(found["insertion into the matrix"], 0.75)

    def test_machine_is_measured(self):
        program = os.path.join(os.path.dirname(pulmo.PROGRAM), "pulmo_machine_benchmark")
        told = assembly.measure([program, "8"])
        self.assertEqual((told["ranks"], told["array_mb"]), (1, 8))
        for key in ("gflops", "triad_gb", "read_gb"):
            self.assertGreater(told[key], 0)

    def test_breath_agrees_with_the_peer(self):
        """All solver files, and FEniCS where it is installed, breathe alike."""
        folder = pulmo.scratch()
        breath = benchmark("breath", "--mesh", pulmo.mesh("cube_lung.msh"), "--mesh-scale", "1", "--time", "0.2", "--peer",
                           "--output", folder)
        self.assertEqual(breath.returncode, 0, breath.stdout + breath.stderr)
        rows = table(os.path.join(folder, "breath.csv"))
        if "left out" not in breath.stdout:
            self.assertEqual(rows[-1]["solver"], "FEniCS")
            self.assertEqual(rows[-1]["Newton"], rows[0]["Newton"])
        for row in rows:
            self.assertLess(float(row["volume difference"]), 1e-6, row["solver"])


if __name__ == "__main__":
    pulmo.main()
