#!/usr/bin/python3
"""The tools beside the program: mesh generator, report, benchmarks."""
import csv
import json
import os
import subprocess
import unittest

import pulmo_case as pulmo


def tool(name, *arguments):
    command = [os.path.join(pulmo.SOURCE, "tools", name), *map(str, arguments)]
    return subprocess.run(command, env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=300)


def benchmark(*arguments):
    return tool("benchmark", "--build", os.path.dirname(pulmo.PROGRAM), *arguments)


def table(path):
    with open(path, newline="") as f:
        return list(csv.DictReader(f))


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

    def test_lung_mesh_refuses(self):
        made = tool("lung_mesh", "--side", "left", "--volume", "-3", "--output", pulmo.scratch("none.msh"))
        self.assertNotEqual(made.returncode, 0)
        self.assertIn("volume", made.stderr)
        self.assertNotIn("Traceback", made.stderr)

    def test_report_draws(self):
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.1"])
        drawn = tool("report", case.directory)
        self.assertEqual(drawn.returncode, 0, drawn.stderr)
        with open(case.path("waveforms.png"), "rb") as f:
            self.assertEqual(f.read(8), b"\x89PNG\r\n\x1a\n")
        drawn = tool("report", pulmo.scratch())
        self.assertNotEqual(drawn.returncode, 0)
        self.assertNotIn("Traceback", drawn.stderr)

    def test_benchmark_compares_integrators(self):
        """Both integrators give the same residual and Jacobian; only then are times worth comparing."""
        program = os.path.join(os.path.dirname(pulmo.PROGRAM), "pulmo_assembly_benchmark")
        for law in ("berger", "ma", "birzle", "yoshihara", "rausch"):
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

        twin = [pulmo.finished(options + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.1"])
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
                               "-ksp_rtol", "1e-5", "-snes_lag_jacobian", "1", "-snes_lag_preconditioner", "1"])
        summary, row = case.json(), rows["pressure"]
        self.assertEqual((int(row["Newton"]), int(row["solves"])), 2 * (summary["newton_iterations"],))
        self.assertAlmostEqual(float(row["Krylov/solve"]), summary["krylov_iterations"] / summary["newton_iterations"], delta=0.051)
        self.assertGreaterEqual(int(row["largest"]), float(row["Krylov/solve"]))
        self.assertEqual(int(rows["common"]["solves"]), 2 * int(rows["common"]["Newton"]))
        self.assertGreater(float(rows["stretch"]["largest J"]), 1.15)
        with open(os.path.join(folder, "solve.png"), "rb") as f:
            self.assertEqual(f.read(8), b"\x89PNG\r\n\x1a\n")
        self.assertEqual(benchmark(*few).stdout.count("kept"), 4)

    def test_benchmark_refuses(self):
        few = ["strategies", "pcv", "--mesh", pulmo.mesh("cube_lung.msh"), "--output", pulmo.scratch()]
        for arguments, named in ((few, "--"),
                                 (few + ["--", "@nothing"], "@direct"),
                                 (few + ["--", "direct"], "@"),
                                 (few + ["--", "@direct '"], "quotation"),
                                 (few + ["--", "@direct", "@direct"], "twice"),
                                 (few + ["--", "@direct -output_dir here"], "-output_dir"),
                                 (["strategies", "nowhere.opts", "--", "@direct"], "nowhere.opts"),
                                 (["strategies", "pcv", "--mesh", "none.msh", "--", "@direct"], "none.msh"),
                                 (["breath", "--time", "0.07"], "multiple"),
                                 (["solve", "--mesh", "none.msh"], "none.msh"),
                                 (["solve", "--stretch", "0.9"], "--stretch"),
                                 (["solve", "--dt", "2"], "--dt"),
                                 (["assembly", "--", "@direct"], "no flags")):
            with self.subTest(arguments=arguments):
                refused = benchmark(*arguments)
                self.assertNotEqual(refused.returncode, 0)
                self.assertIn(named, refused.stderr)
                self.assertNotIn("Traceback", refused.stderr)

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
