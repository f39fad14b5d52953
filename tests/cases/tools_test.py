#!/usr/bin/python3
"""The tools beside the program: mesh generator, report, benchmark of assembly."""
import json
import os
import subprocess
import unittest

import pulmo_case as pulmo


def tool(name, *arguments):
    command = [os.path.join(pulmo.SOURCE, "tools", name), *map(str, arguments)]
    return subprocess.run(command, env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=300)


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


if __name__ == "__main__":
    pulmo.main()
