#!/usr/bin/python3
"""tools/reproduce_paper: the quick plan from runs to page, resuming, stopped runs, and its own arithmetic."""
import json
import math
import os
import re
import stat
import subprocess
import sys
import unittest
from pathlib import Path

import numpy as np

import pulmo_case as pulmo

sys.dont_write_bytecode = True
sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from paper import compartment, laws, sections  # noqa: E402

TOOL = os.path.join(pulmo.SOURCE, "tools", "reproduce_paper")
FIGURES = [f"figure{n}" for n in range(3, 10)]


def tool(*arguments, program=None):
    command = [TOOL, "--program", program or pulmo.PROGRAM, *map(str, arguments)]
    return subprocess.run(command, env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=500)


def fake_program(body):
    """A program that does `body` (Python) in its -output_dir, called `out`, and lists one law."""
    path = pulmo.scratch("fake")
    with open(path, "w") as f:
        f.write("#!/usr/bin/python3\nimport os, sys\n"
                "if '-list' in sys.argv: sys.exit(print('tissue mine by me'))\n"
                "out = sys.argv[sys.argv.index('-output_dir') + 1]\n" + body)
    os.chmod(path, os.stat(path).st_mode | stat.S_IXUSR)
    return path


class Quick(unittest.TestCase):
    """One quick reproduction, looked at from several sides."""

    @classmethod
    def setUpClass(cls):
        cls.runs = Path(pulmo.scratch())
        cls.made = tool("--quick", "--runs", cls.runs, "--jobs", 2)
        cls.page = cls.runs / "page"

    def test_everything_is_there(self):
        self.assertEqual(self.made.returncode, 0, self.made.stdout + self.made.stderr)
        for name in FIGURES:
            png = (self.page / f"{name}.png").read_bytes()
            self.assertEqual(png[:8], b"\x89PNG\r\n\x1a\n", name)
            self.assertLess(len(png), 200e3, name)
        for name in FIGURES + ["table2", "table3", "tried"]:
            self.assertGreater(len((self.page / f"{name}.csv").read_text().splitlines()), 1, name)
        self.assertNotRegex((self.page / "README.md").read_text(), r"\bnan\b|None|\{\w+\}")
        self.assertRegex(self.made.stdout, r"run \d+: pcv_birzle")

    def test_the_page_tells_what_the_runs_left(self):
        page = (self.page / "README.md").read_text()
        row = re.search(r"^\| CM3 \| 84 \| ([0-9.]+) \|", page, re.M)
        summary = json.loads((self.runs / "pcv_birzle/summary.json").read_text())
        self.assertAlmostEqual(float(row[1]), summary["compliance_ml_per_cmH2O"], delta=0.051)
        free = json.loads((self.runs / "ks0_birzle/summary.json").read_text())["compliance_ml_per_cmH2O"]
        held = json.loads((self.runs / "ks0.08_birzle/summary.json").read_text())["compliance_ml_per_cmH2O"]
        rows = [line.split(",") for line in (self.page / "figure9.csv").read_text().splitlines()]
        wall = next(float(r[3]) for r in rows if r[:2] == ["CM3", "0.08"])
        self.assertAlmostEqual(1 / wall + 1 / free, 1 / held, delta=1e-6)

    def test_done_runs_are_not_repeated(self):
        before = {p: p.stat().st_mtime_ns for p in self.runs.glob("*/signals.csv")}
        (self.runs / "pcv_birzle/summary.json").unlink()  # as if it had been interrupted
        again = tool("--quick", "--runs", self.runs, "--only", "figure4,table3")
        self.assertEqual(again.returncode, 0, again.stdout + again.stderr)
        self.assertEqual(re.findall(r"run \d+: (\w+)", again.stdout), ["pcv_birzle"])
        after = {p: p.stat().st_mtime_ns for p in self.runs.glob("*/signals.csv")}
        self.assertEqual([p.parent.name for p in before if before[p] != after[p]], ["pcv_birzle"])


class Outcomes(unittest.TestCase):
    def test_a_run_that_the_model_stops_is_an_outcome(self):
        program = fake_program(
            "open(out + '/failure.json', 'w').write('{\"failure\": \"steps only crawl. Tried dt 1 s\", \"end_time_s\": 0.5}')\n"
            "open(out + '/signals.csv.part', 'w').write('time_s,airway_pressure_cmH2O,flow_ml_per_s,volume_ml\\n0,0,0,0\\n')\n"
            "sys.exit(1)\n")
        done = tool("--quick", "--runs", pulmo.scratch(), "--only", "table3", program=program)
        self.assertEqual(done.returncode, 0, done.stdout + done.stderr)
        self.assertIn("ks0_birzle stopped: steps only crawl.", done.stdout)
        self.assertIn("not of the paper and left out: mine\n", done.stdout)

    def test_a_run_that_goes_wrong_is_an_error(self):
        done = tool("--quick", "--runs", pulmo.scratch(), "--only", "figure4", program=fake_program("sys.exit('no licence')\n"))
        self.assertEqual(done.returncode, 1)
        self.assertIn("pcv_birzle FAILED with exit code 1: no licence", done.stdout)
        self.assertIn("figure4 is not drawn", done.stdout)

    def test_list_and_refusals(self):
        listed = tool("--quick", "--list", "--runs", pulmo.scratch())
        self.assertEqual(listed.returncode, 0, listed.stderr)
        for part in FIGURES + ["table2", "table3", "tried", "vcv_berger_lumen"]:
            self.assertIn(part, listed.stdout)
        for wrong in (["--only", "figure1"], ["--jobs", "0"], ["--quick", "--runs", pulmo.scratch()]):
            done = tool(*wrong, program="/no/such/program")
            self.assertNotEqual(done.returncode, 0)
            self.assertNotIn("Traceback", done.stderr)
            self.assertIn("reproduce_paper: error:", done.stderr)


class Arithmetic(unittest.TestCase):
    """Pieces of the tool against closed forms."""

    def test_single_compartment_under_constant_pressure_and_ramp(self):
        C, R, P = 80.0, 0.0045, 6.0
        t = np.linspace(0, 2, 41)
        volume, flow = compartment.compartment(t, np.full(41, P), C, R)
        np.testing.assert_allclose(volume, P * C * (1 - np.exp(-t / (R * C))), rtol=1e-12)
        np.testing.assert_allclose(flow, P / R * np.exp(-t / (R * C)), rtol=1e-10)
        volume, _ = compartment.compartment(t, P * t, C, R)
        np.testing.assert_allclose(volume, P * C * (t - R * C * (1 - np.exp(-t / (R * C)))), rtol=1e-10, atol=1e-12)

    def test_section_of_a_box(self):
        """Area and mean of a linear field over the cut of a box of quadratic cells, whatever the height."""
        import meshio
        mesh = meshio.read(pulmo.mesh("cube_coarse.msh"))
        tets = mesh.cells_dict["tetra"]
        nodes, cells = list(mesh.points), []
        middle = {}
        for tet in tets:
            row = list(tet)
            for a, b in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)):
                key = tuple(sorted((tet[a], tet[b])))
                if key not in middle:
                    middle[key] = len(nodes)
                    nodes.append((mesh.points[tet[a]] + mesh.points[tet[b]]) / 2)
                row.append(middle[key])
            cells.append(row)
        nodes, cells = np.array(nodes), np.array(cells)
        field = 1 + 2 * nodes[:, 0] + 3 * nodes[:, 1] - nodes[:, 2]
        for height in (0.1, 0.37, 0.81):
            corners, (values,) = sections.section(nodes, cells, field[None], height)
            a, b, c = corners.reshape(-1, 3, 2).transpose(1, 0, 2)
            area = np.abs(np.cross(b - a, c - a)) / 2
            self.assertAlmostEqual(area.sum(), 1, places=12)
            self.assertAlmostEqual((area * values.reshape(-1, 3).mean(axis=1)).sum(), 1 + 1 + 3 * height - 0.5, places=12)

    def test_free_inflation_of_the_table(self):
        """dW/dJ of Table 1 at F = J^(1/3) I is 6 cmH2O at the J that the page uses."""
        energies = {
            "CM1": lambda s, J: 0.2808 / 2 * (3 * s - 3) + 0.4212 / 4 * (J * J - 1) - (0.2808 + 0.2106) * math.log(J - 0.01),
            "CM2": lambda s, J: 2 * math.exp(0.43 * (1.5 * s - 1.5) ** 2 - 0.6 * (0.75 * s * s - 1.5 * s + 0.75)),
            "CM3": lambda s, J: 0.3567 * (3 * s - 3) + 0.3567 / 1.075 * (J ** -2.15 - 1) + 5.766e-3 * (s - 1) ** 6,
            "CM4": lambda s, J: 1.298 * (3 * s - 3) + 1.298 / 0.75 * (J ** -1.5 - 1),
            "CM5": lambda s, J: 16.5 / 4 * (J * J - 1 - 2 * math.log(J))}
        for law in laws.LAWS:
            W, J, h = energies[law.label], law.inflation, 1e-5
            slope = (W((J + h) ** (2 / 3), J + h) - W((J - h) ** (2 / 3), J - h)) / (2 * h)
            self.assertAlmostEqual(slope / pulmo.KPA_PER_CMH2O, 6, delta=0.003, msg=law.label)


if __name__ == "__main__":
    pulmo.main()
