#!/usr/bin/python3
"""tools/accuracy_cost: limits and their uncertainty, errors of fields, the order of the runs, the budget, the answers."""
import argparse
import csv
import json
import os
import pathlib
import re
import subprocess
import sys
import unittest
from unittest import mock

import numpy as np

import case_meshes
import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from accuracy import (command, elements, extrapolate, fields, ladder, laws, manufactured, numbers, page, pictures, search, settings,  # noqa: E402
                      sphere, truth)
from accuracy.errors import Axes, estimate  # noqa: E402

SCENE = [*pulmo.PAPER, "-mesh_scale", "100", "-airflow_surfaces", "x1", "-chest_wall_surfaces", "x0,x1,y0,y1,z0,z1", "-ventilator_inspiration", "0.4",
         "-ventilator_ramp_down", "0.1", "-ventilator_expiration", "0.4"]


def tool(*arguments):
    run = [os.path.join(pulmo.SOURCE, "tools/accuracy_cost"), *map(str, arguments)]
    return subprocess.run(run, env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=300, cwd=pulmo.SOURCE)


def quadratic_nodes(points, tets):
    """Points and ten-node cells (VTK order) of straight tetrahedra."""
    edges = np.sort(np.stack([tets[:, list(e)] for e in fields.EDGES], axis=1), axis=2)
    unique, inverse = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    return (np.concatenate([points, points[unique].mean(axis=1)]),
            np.concatenate([tets, len(points) + inverse.reshape(-1, 6)], axis=1))


class Limits(unittest.TestCase):
    def test_order_and_limit_are_found(self):
        for order, sizes in ((1, [4, 2, 1]), (2, [3, 1.7, 1.1]), (1.6, [0.2, 0.13, 0.05, 0.02])):
            with self.subTest(order=order):
                values = [7 - 0.3 * h ** order for h in sizes]
                found = extrapolate.limit(sizes, values, 2)
                self.assertAlmostEqual(found.order, order, places=6)
                self.assertAlmostEqual(found.value, 7, places=8)
                self.assertGreaterEqual(found.uncertainty, 0.25 * abs(7 - values[-1]) * (1 - 1e-9))

    def test_uncertainty_holds_the_limit(self):
        """Also with terms of higher order, two levels, a wrong formal order and oscillating levels; known limit 5."""
        steps = 0.2 / 2.0 ** np.arange(5)
        for name, error in (("mixed", lambda h: h + 4 * h ** 2), ("mixed signs", lambda h: h - 2 * h ** 2), ("half", lambda h: h ** 0.5),
                            ("too good", lambda h: h ** 3), ("oscillating", lambda h: h * (-1) ** round(np.log2(0.2 / h)))):
            for count in (2, 3, 4, 5):
                sizes = steps[:count]
                found = extrapolate.limit(sizes, [5 + error(h) for h in sizes], 2 if name == "too good" else 1)
                with self.subTest(error=name, levels=count):
                    self.assertLessEqual(abs(found.value - 5), found.uncertainty * (1 + 1e-9))
        self.assertEqual(extrapolate.limit([1], [3], 1).uncertainty, np.inf)
        self.assertLess(extrapolate.limit([4, 2, 1], [6, 6, 6], 1).uncertainty, 1e-6)

    def test_pareto_front(self):
        random = np.random.default_rng(3)
        points = [(*random.random(2).round(1), i) for i in range(60)]
        front = pictures.front(points)
        for cost, error, _ in front:
            self.assertFalse(any(c <= cost and e <= error and (c, e) != (cost, error) for c, e, _ in points))
        for cost, error, _ in points:
            self.assertTrue(any(c <= cost and e <= error for c, e, _ in front))


class Fields(unittest.TestCase):
    def test_polynomials_on_two_meshes(self):
        """A known difference has its analytic norms on a mesh that is not nested in the other."""
        def made(counts, lengths, u, p):
            points, cells = quadratic_nodes(*case_meshes.kuhn(counts, lengths))
            return fields.Fields(points, cells, u(*points.T), p(*points.T))

        def u(x, y, z):
            return np.stack([x * x - y * z, 1 + 2 * x * y, z * z + x], axis=1)

        def off(x, y, z):
            return u(x, y, z) + np.stack([x * y, 0 * x, 0.5 * z], axis=1)

        fine = made((3, 4, 5), (1, 1, 1), u, lambda x, y, z: x + 2 * y)
        coarse = made((2, 2, 3), (1, 1, 1), off, lambda x, y, z: x + 2 * y + 3 * z)
        compare = fields.Comparison(fine)
        same, found = compare(fine), compare(coarse)
        for name in ("u L2", "u H1", "p L2"):
            self.assertLess(same[name], 1e-13)
        # squares over the cube: xy 1/9, z/2 1/12; gradients y, x: 2/3, 1/2: 1/4; 3 z: 3; x + 2 y: 1/3 + 1 + 4/3
        self.assertAlmostEqual(found["u L2"] * compare.norm(compare.values[0]), (1 / 9 + 1 / 12) ** 0.5, places=10)
        self.assertAlmostEqual(found["u H1"] * compare.norm(compare.values[1]), (2 / 3 + 1 / 4) ** 0.5, places=10)
        self.assertAlmostEqual(found["p L2"], (3 / (1 / 3 + 1 + 4 / 3)) ** 0.5, places=10)
        self.assertAlmostEqual(compare.norm(compare.values[1]) ** 2, 4 / 3 + 2 / 3 + 8 / 3 + 4 / 3 + 1, places=10)
        self.assertEqual(found["outside"], 0)
        smaller = compare(made((2, 2, 2), (0.9, 1, 1), u, lambda x, y, z: x + 2 * y))
        self.assertAlmostEqual(smaller["outside"], 0.1, delta=0.04)  # counted by points
        self.assertLess(smaller["u L2"], 1e-12)  # the same polynomial, extrapolated

    def test_snapshots_of_another_time_are_none(self):
        folder = pathlib.Path(pulmo.scratch())
        folder.mkdir()
        (folder / "fields.xdmf").write_text('<Time Value="0.5"/> fields.h5:/topology fields_000001.h5:/displacement')
        self.assertIsNone(fields.read(folder, 0.55))
        self.assertRaises(OSError, fields.read, folder, 0.50000001)  # this one is looked for


class Known:
    """Stands for the program: numbers with known limits, errors and costs."""
    LIMITS = {"tidal_volume_ml": 500.0, "compliance_ml_per_cmH2O": 80.0}

    def __init__(self, cells, fails=None):
        self.cells, self.fails, self.calls = cells, fails or (lambda words: False), []

    def true_error(self, words, key):
        options = dict(zip(words, words[1:]))
        h = self.cells[options["-dm_plex_filename"]] ** (-1 / 3)
        dt, order = float(options["-ts_dt"]), 1 if options["-ts_type"] == "beuler" else 2
        a = 2.0 if key == "tidal_volume_ml" else 0.7
        if options.get("-elements") == "P1-P1":
            return (1 - 0.9 * a * h ** 2 - h ** 3) * (1 - a * dt ** order / order) - 1
        return (1 + a * h ** 2 + h ** 3) * (1 - a * dt ** order / order) - 1

    def measured(self, words, folder, repeat, ranks, timeout):
        words = list(map(str, words))
        self.calls.append(words)
        options = dict(zip(words, words[1:]))
        steps = 3 / float(options["-ts_dt"])
        cells = self.cells[options["-dm_plex_filename"]]
        linear = options.get("-elements") == "P1-P1"
        spent = 1e-4 * steps * cells * (0.25 if linear else 1) * (1.3 if options["-ts_type"] == "bdf" else 1)
        values = {key: limit * (1 + self.true_error(words, key)) for key, limit in self.LIMITS.items()} | {"peep_cmH2O": 0.0}
        failed = self.fails(options)
        failed, spent = failed or spent > timeout, min(spent, timeout)
        return {"code": int(failed), "reason": "it was to fail", "cpu": spent, "wall": spent, "memory": cells / 100, "kept": False,
                "load": [0, 0], "folder": pathlib.Path("nowhere"),
                "summary": values | {"breaths": [values], "steps": steps, "cells": cells, "dofs": 6 * cells, "rejected_steps": 0}}


class Searching(unittest.TestCase):
    def explored(self, budget, asked=None, fails=None, tetrahedra=(1000, 2500, 6000, 15000), tolerances=(), named=(), pairs=("",)):
        cells = {f"{n}.msh": n for n in tetrahedra}
        options = argparse.Namespace(budget=budget, clock="wall", repeat=1, ranks=1, build=pathlib.Path("build"), output=pathlib.Path("nowhere"),
                                     results=pathlib.Path("nowhere"), schemes=["beuler", "bdf"], dt_factors=[4, 2, 1, 0.5, 0.25, 0.125],
                                     adaptive=0, solvers=["iterative"], tolerances=tolerances)
        meshes = [settings.Mesh(f"{name} {pair}".strip(), ("-dm_plex_filename", name, *(["-elements", pair] if pair else [])), n, "", pair)
                  for pair in pairs for name, n in cells.items()]
        steps, solvers = settings.steps(options, 0.05), settings.solvers(options)
        base = settings.Setting(meshes[0], next(t for t in steps if t.dt == 0.05), solvers[0])
        known = Known(cells, fails)
        with mock.patch.object(ladder.runs, "measured", known.measured), mock.patch("builtins.print"):
            made = search.Search(ladder.Ladder(Axes(meshes, steps, solvers, base), [], [], options),
                                 list(asked or named or [*Known.LIMITS, "peep_cmH2O", "strain"]), asked or {}, numbers.LEVELS,
                                 list(asked or named))
            made.explore()
        return made, known

    def true_errors(self, made, known, setting):
        words = [str(w) for w in made.ladder.command(setting)]
        return {key: abs(known.true_error(words, key)) for key in Known.LIMITS}

    def test_budget_and_answers(self):
        previous = 0
        for budget in (20, 100, 600, 3000):
            made, known = self.explored(budget)
            with self.subTest(budget=budget):
                spent = sum(r.wall for r in made.ladder.done.values()) + sum(seconds for _, seconds in made.ladder.failed.values())
                self.assertLessEqual(spent, budget * (1 + 1e-9))
                self.assertEqual(len(known.calls), len(made.ladder.done) + len(made.ladder.failed))
                self.assertGreaterEqual(len(made.ladder.done), previous)
                previous = len(made.ladder.done)
                left = {s for s in made.axes.singles() if s not in made.ladder.done}
                self.assertTrue(left <= {*made.ladder.skipped, *made.ladder.failed})
                for key, e in made.errors().items():
                    self.assertLessEqual(abs(e.value - Known.LIMITS[key]), e.uncertainty, key)
                for answer in made.answers():
                    if answer.run:
                        self.assertLessEqual(max(self.true_errors(made, known, answer.run.setting).values()), answer.share)
        answers = {a.share: a for a in made.answers()}
        self.assertIsNotNone(answers[0.01].run)
        self.assertIsNotNone(answers[0.05].run)
        self.assertLess(answers[0.05].run.cpu, answers[0.01].run.cpu)
        # nothing that was run is cheaper and as good, whatever cancels
        surely = [r.cpu for s, r in made.ladder.done.items()
                  if max(max(self.true_errors(made, known, s)[k], e.predicted(s)) + e.doubt for k, e in made.errors().items()) <= 0.0099]
        self.assertLessEqual(answers[0.01].run.cpu, min(surely))

    def test_question_ends_the_ladder(self):
        full, _ = self.explored(3000)
        made, known = self.explored(3000, {"compliance_ml_per_cmH2O": 0.02})
        answer, = made.answers()
        self.assertLess(len(made.ladder.done), len(full.ladder.done))
        self.assertLess(made.ladder.spent, 0.5 * full.ladder.spent)
        self.assertLessEqual(self.true_errors(made, known, answer.run.setting)["compliance_ml_per_cmH2O"], 0.02)
        self.assertIn("C_rs within 2 %", made.sentences()[0])
        hopeless, _ = self.explored(10, {"compliance_ml_per_cmH2O": 1e-6})
        self.assertIsNone(hopeless.answers()[0].run)
        self.assertIn("budget", hopeless.sentences()[0])

    def test_element_pairs(self):
        """Pairs have ladders of their own and one limit; a cheaper pair that is as good is found."""
        asked = {"compliance_ml_per_cmH2O": 0.005}
        (one, _), (both, known) = (self.explored(3000, asked, pairs=pairs) for pairs in (("P2-P1",), ("P2-P1", "P1-P1")))
        answer, = both.answers()
        self.assertEqual(answer.run.setting.mesh.elements, "P1-P1")
        self.assertLess(answer.run.cpu, 0.5 * one.answers()[0].run.cpu)
        self.assertLessEqual(self.true_errors(both, known, answer.run.setting)["compliance_ml_per_cmH2O"], 0.005)
        key = "compliance_ml_per_cmH2O"
        e = both.errors()[key]
        self.assertLessEqual(abs(e.value - Known.LIMITS[key]), e.uncertainty)
        signs = {m.elements: np.sign(part) for m, part in e.parts.items() if isinstance(m, settings.Mesh)}
        self.assertEqual(signs, {"P2-P1": 1, "P1-P1": -1}, "errors of either pair against the common limit")
        whole, _ = self.explored(3000, pairs=("P2-P1", "P1-P1"))
        values = {s: v * (1.05 if s.mesh.elements == "P1-P1" else 1) for s, v in whole.ladder.values(key).items()}
        self.assertGreater(estimate(key, values, whole.axes).shares["space"], 0.03 * Known.LIMITS[key], "limits that contradict one another")

    def test_cost_of_element_pairs(self):
        """A quarter of the cost a cell, 0.9 of the error: errors go with h^2, cost with h^-3."""
        made, _ = self.explored(3000, pairs=("P2-P1", "P1-P1"))
        law = laws.Law("birzle", "CM3", "C0")
        with mock.patch.object(elements, "KEYS", list(Known.LIMITS)), mock.patch.object(elements, "WANTED", (0.006, 0.01)):
            header, rows = elements.factors({law: made})
            self.assertEqual([(row[1], row[2]) for row in rows], [(name, share) for name in ("V_T", "C_rs") for share in ("0.6 %", "1 %")])
            *ratios, last = [row[-1] for row in rows]
            for ratio in ratios:
                self.assertAlmostEqual(float(ratio), 4 * (1 / 0.9) ** 1.5, delta=0.6)
            self.assertEqual(last, "-", "the coarsest meshes meet it already")
            header, rows = elements.table({law: made})
        self.assertEqual([(row[0], row[1]) for row in rows], [(pair, n) for pair in ("P2-P1", "P1-P1") for n in (1000, 2500, 6000, 15000)])
        for row, mesh in zip(rows, made.axes.meshes):
            h = mesh.size()
            true = 2 * h ** 2 + h ** 3 if mesh.elements == "P2-P1" else -1.8 * h ** 2 - h ** 3
            self.assertAlmostEqual(float(row[-1].split()[0]) / 100, true, delta=5e-4)

    def test_what_is_not_examined_is_said(self):
        made, _ = self.explored(3000, tetrahedra=[1000])
        e = made.errors()["tidal_volume_ml"]
        self.assertEqual(e.unexamined(), ["space", "solver"])
        self.assertTrue(np.isfinite(e.uncertainty))
        self.assertTrue(all("(space, solver not examined)" in text for text in made.sentences()), made.sentences())
        self.assertEqual("\n".join(page.reference_table(made)).count(" not examined |"), 2 * 3)  # two numbers: space, solver, "in space"
        asked, known = self.explored(3000, {"compliance_ml_per_cmH2O": 0.02}, tolerances=[1e-4, 1e-12])
        self.assertEqual(asked.errors()["compliance_ml_per_cmH2O"].unexamined(), [])
        self.assertEqual([s.solver.tolerance for s in asked.ladder.done if s.solver != asked.axes.base.solver], [1e-12])
        self.assertNotIn("not examined", asked.sentences()[0])

    def test_numbers_that_the_scene_lacks(self):
        for key, said in (("strain", "has no strain; it has V_T, C_rs"), ("peep_cmH2O", "is 0")):
            for words in ({"asked": {"tidal_volume_ml": 0.05, key: 0.01}}, {"named": [key]}):
                with self.subTest(key=key, words=words), self.assertRaisesRegex(SystemExit, said):
                    self.explored(100, **words)
        made, _ = self.explored(100)
        self.assertEqual((made.keys, made.dropped), (list(Known.LIMITS), ["peep_cmH2O", "strain"]))

    def test_errors_that_cancel_are_no_accuracy_in_pictures(self):
        made, _ = self.explored(3000)
        for setting, run in made.ladder.done.items():
            for key, e in made.errors().items():
                drawn = pictures.surely(made, run, [key])
                self.assertGreaterEqual(drawn, min(1, e.predicted(setting)))
                self.assertLessEqual(drawn, pictures.surely(made, run))

    def test_failures_are_kept_apart(self):
        made, _ = self.explored(3000, fails=lambda options: float(options["-ts_dt"]) == 0.2)
        self.assertEqual({s.steps.dt for s in made.ladder.failed}, {0.2})
        self.assertTrue(all(why == "it was to fail" for why, _ in made.ladder.failed.values()))
        self.assertIsNotNone(made.answers()[1].run)

    def test_steps_that_end_at_one_kink_are_no_limit(self):
        """Two long steps of BDF2 that agree do not speak for the limit while backward Euler moves."""
        made, _ = self.explored(3000)
        axes, key = made.axes, "tidal_volume_ml"
        moving = {settings.Steps("beuler", 0.2): 400, settings.Steps("beuler", 0.1): 400, settings.Steps("beuler", 0.05): 430,
                  settings.Steps("bdf", 0.2): 420, settings.Steps("bdf", 0.1): 420}
        values = {settings.Setting(axes.base.mesh, steps, axes.base.solver): v for steps, v in moving.items()}
        self.assertGreater(estimate(key, values, axes).shares["time"], 25)
        still = dict.fromkeys(values, 400.0)
        self.assertLess(estimate(key, still, axes).shares["time"], 1e-3)

    def test_coupling_widens_the_reference(self):
        """Without joint runs the product of the parts is in doubt; with them it is seen."""
        made, known = self.explored(3000)
        axes, key = made.axes, "tidal_volume_ml"
        alone = {s: v for s, v in made.ladder.values(key).items() if s in axes.singles()}
        for values in (alone, made.ladder.values(key)):
            e = estimate(key, values, axes)
            self.assertGreater(e.shares["coupling"], 0)
            self.assertLessEqual(abs(e.value - 500), e.uncertainty)


class Studies(unittest.TestCase):
    def test_cost_at(self):
        ladder_ = [(8.0, 1e-4), (1.0, 1e-1), (4.0, 1e-3), (2.0, 1e-2)]  # error 0.1 cost^-3.32
        cost, bound = sphere.cost_at(ladder_, 10 ** -2.5)
        self.assertAlmostEqual(cost, 2 ** 1.5)
        self.assertFalse(bound)
        self.assertEqual(sphere.cost_at(ladder_, 0.2), (1.0, True))      # cheaper may do, too
        self.assertEqual(sphere.cost_at(ladder_, 1e-5), (None, False))
        cost, _ = sphere.cost_at([(1, 1e-4), (2, 1e-1), (4, 1e-3)], 1e-2)  # falls below by luck first
        self.assertAlmostEqual(cost, 2 * 2 ** 0.5)

    def test_manufactured_is_read(self):
        text = ("[ RUN      ] ManufacturedRun/0.DiscretisationError\n"
                "  yoshihara cube_coarse J 0.87..1.36  u 2.460e-03  Grad u 9.320e-03  p 3.550e-02  Grad p 1.500e-01\n"
                "  yoshihara cube        J 0.87..1.36  u 7.130e-04  Grad u 2.690e-03  p 9.820e-03  Grad p 8.050e-02  orders 1.79 1.79 1.85 0.90\n"
                "[       OK ] ManufacturedRun/0.DiscretisationError (900 ms)\n"
                "[ RUN      ] ManufacturedRun/0.OrderInTime\n"
                "  backward Euler, yoshihara dt 1/8   J 0.98..1.20  u 7.300e-05  p 7.160e-04\n"
                "  backward Euler, yoshihara dt 1/16  J 0.98..1.20  u 3.720e-05  p 3.640e-04  orders u 0.973 p 0.976\n"
                "  BDF2, yoshihara dt 1/8   J 0.98..1.20  u 5.860e-06  p 5.750e-05\n"
                "[       OK ] ManufacturedRun/0.OrderInTime (90 ms)\n")
        ladders, formal = manufactured.read(text)
        key = ("h, u and p of waves", "yoshihara", "Grad p")
        self.assertEqual((ladders[key], formal[key]), ([(0.5, 0.15), (0.25, 0.0805)], 1))
        key = ("Δt, backward Euler", "yoshihara", "u")
        self.assertEqual((ladders[key], formal[key]), ([(1 / 8, 7.3e-5), (1 / 16, 3.72e-5)], 1))
        key = ("Δt, BDF2", "yoshihara", "p")
        self.assertEqual((ladders[key], formal[key]), ([(1 / 8, 5.75e-5)], 2))
        self.assertEqual(len(ladders), 4 + 2 + 2)
        self.assertRaisesRegex(SystemExit, "verification_mms", manufactured.read, "[ PASSED ] 0 tests.\n")

    def test_radial_bdf2_has_order_two(self):
        """Against Radau IIA of three stages, which shares the space but no formula in time."""
        coarse, fine = (truth.bdf2_volume(dt) - truth.limit_volume() for dt in (0.025, 0.0125))
        self.assertAlmostEqual(np.log2(coarse / fine), 2, delta=0.15)


class Tool(unittest.TestCase):
    def test_words(self):
        self.assertEqual(numbers.question("C_rs=1%"), ("compliance_ml_per_cmH2O", 0.01))
        self.assertEqual(numbers.question("work_j = 0.05"), ("work_j", 0.05))
        for text in ("C_rs", "C_rs=much", "C_rs=150%"):
            self.assertRaises(ValueError, numbers.question, text)
        self.assertEqual([command.seconds(t) for t in ("90", "90s", "10min", "2h")], [90, 90, 600, 7200])
        self.assertEqual(page.merged(["# a", "-x 1", "-y", "-x 2"]), ["# a", "-y", "-x 2"])
        self.assertEqual(settings.of_files(pulmo.DIRECT, "-ts_dt"), "0.05")
        self.assertEqual(settings.of_files(pulmo.DIRECT + ["-ts_dt", "0.1"], "-ts_dt"), "0.1")

    def test_recommended_setting_keeps_its_promise(self):
        """A question on a small block; a run that is far finer in space and time, by BDF2, confirms; a second call runs nothing."""
        folder = pathlib.Path(pulmo.scratch())
        call = ["pcv", "--build", os.path.dirname(pulmo.PROGRAM), "--solvers", "direct", "--output", folder, "--budget", "2min", "--clock",
                "cpu", "--adaptive", "1", "--dt-factors", "2", "1", "0.5", "--schemes", "beuler", "--question", "V_T=8%", "--question",
                "C_rs=8%", "--", "-dm_plex_filename", pulmo.mesh("cube_coarse.msh"), *SCENE]
        first = tool(*call)
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        text = (folder / "README.md").read_text()
        self.assertIn("**V_T within 8 %, C_rs within 8 %**: cube_coarse", text)
        with open(folder / "accuracy.csv", newline="") as f:
            rows = list(csv.DictReader(f))
        self.assertEqual({row["scheme"] for row in rows}, {"beuler"})
        self.assertGreater(float(rows[-1]["error_u_l2"] or rows[0]["error_u_l2"]), 0)
        for name in ("ladders", "pareto", "costs", "spectrum"):
            self.assertEqual((folder / f"{name}.png").read_bytes()[:8], b"\x89PNG\r\n\x1a\n")

        options = ["-options_file", str(folder / "recommended_8percent.opts")]
        mesh = ["-dm_plex_filename", pulmo.mesh("cube_coarse.msh")]
        cheap = pulmo.finished(pulmo.PCV + mesh + SCENE + options).json()
        fine = pulmo.finished(pulmo.PCV + pulmo.options_file("solvers/iterative.opts") + ["-dm_plex_filename", pulmo.mesh("cube_fine.msh")] +
                              SCENE + ["-ts_type", "bdf", "-ts_dt", "0.02"]).json()
        for key in ("tidal_volume_ml", "compliance_ml_per_cmH2O"):
            self.assertLess(abs(cheap[key] / fine[key] - 1), 0.08, key)
            self.assertIn(f"{cheap[key]:.8g}", [row[key] for row in rows])

        again = tool(*call)
        self.assertIn(" 0 of them new", again.stdout)
        with open(folder / "accuracy.csv", newline="") as f:
            self.assertEqual(list(csv.DictReader(f)), rows)
        self.assertEqual(re.search(r"\*\*V_T.*", (folder / "README.md").read_text())[0], re.search(r"\*\*V_T.*", text)[0])

    def test_answer_by_sweeps(self):
        """Each run tells its errors and what to change; the corrected values hold a run that is far finer. A second call runs nothing."""
        folder = pathlib.Path(pulmo.scratch())
        call = ["pcv", "--build", os.path.dirname(pulmo.PROGRAM), "--solvers", "direct", "--output", folder, "--budget", "3min", "--clock", "cpu",
                "--method", "sweep", "--question", "V_T=2%", "--question", "C_rs=2%", "--meshes", pulmo.mesh("cube_coarse.msh"), "--", *SCENE]
        first = tool(*call)
        self.assertEqual(first.returncode, 0, first.stdout + first.stderr)
        fine = pulmo.finished(pulmo.PCV + pulmo.options_file("solvers/iterative.opts") + ["-dm_plex_filename", pulmo.mesh("cube_fine.msh")] +
                              SCENE + ["-ts_type", "bdf", "-ts_dt", "0.02"]).json()
        last = first.stdout[first.stdout.index("wrote "):]
        for name, key, share in (("V_T", "tidal_volume_ml", 0.02), ("C_rs", "compliance_ml_per_cmH2O", 0.02)):
            value, bar = map(float, re.search(rf"^{name} = ([\d.]+) ± ([\d.]+)", last, re.MULTILINE).groups())
            print(f"{name} = {value} ± {bar}, finer {fine[key]:.6g}")
            self.assertLessEqual(bar, share * value)
            self.assertLessEqual(abs(value - fine[key]), bar + 0.01 * fine[key])  # that has errors of its own
        self.assertGreater(first.stdout.count("left\n"), 1, "the first run does not meet it")
        self.assertIn("cells cut to", first.stdout)
        reasons = [number["not_resolved_because"] for path in folder.glob("runs/*/run/summary.json")
                   for number in json.loads(path.read_text())["error_estimate"]["numbers"].values()]
        self.assertTrue(reasons and all(reason == [] for reason in reasons), reasons)
        run = pulmo.finished(pulmo.PCV + SCENE + ["-options_file", str(folder / "recommended_2percent.opts")])
        self.assertEqual(run.json()["error_estimate"]["method"], "sweep")
        again = tool(*call)
        self.assertEqual(again.stdout[again.stdout.index("wrote "):].split(";")[0], last.split(";")[0])

    def test_breaths_that_are_not_periodic(self):
        """Gas that is trapped: the answer says that further breaths change the number, which no bar counts."""
        call = ["pcv", "--build", os.path.dirname(pulmo.PROGRAM), "--output", pulmo.scratch(), "--method", "sweep", "--solvers", "direct", "--question",
                "V_T=30%", "--meshes", pulmo.mesh("cube.msh"), "--", *SCENE, "-airflow_permeability", "100", "-ventilator_expiration"]
        for expiration, told in (("0.2", True), ("4", False)):
            run = tool(*call, expiration)
            self.assertEqual(run.returncode, 0, run.stdout + run.stderr)
            self.assertEqual("V_T changes by" in run.stdout and "give the scene more breaths" in run.stdout, told, run.stdout)

    def test_no_answer_by_sweeps(self):
        air = pathlib.Path(pulmo.scratch() + ".opts")
        air.write_text("-airflow\n-airflow_surfaces x1\n-chest_wall\n-chest_wall_surfaces x0,y0,y1,z0,z1\n-mesh_scale 100\n")
        cycled = [*pulmo.PAPER, *pulmo.programme("inspiration 1.5 pressure 5 ramp 0.2 cycle 30\nexpiration 1 pressure 0 ramp 0.2\n")]
        call = ["--build", os.path.dirname(pulmo.PROGRAM), "--output", pulmo.scratch(), "--method", "sweep", "--solvers", "direct", "--meshes",
                pulmo.mesh("cube_coarse.msh")]
        for more, said in ((["--question", "V_T=4%", "--", *SCENE, "-viscoelastic"], "-viscoelastic"), (["--", *SCENE], "--question"),
                           (["--question", "auto_peep_cmH2O=1%", "--", *SCENE], "auto_peep"),
                           (["--question", "V_T=4%", "--", *cycled], "ends early")):
            run = tool(air if cycled[-1] in more else "pcv", *call, *more)
            self.assertNotEqual(run.returncode, 0)
            self.assertIn(said, run.stderr)
            self.assertNotIn("Traceback", run.stderr)

    def test_recommended_file_goes_after_the_flags(self):
        """It says how the mesh is made and keeps to what the user's flags set of the solver."""
        path = pathlib.Path(pulmo.scratch())
        made, _ = Searching().explored(3000)
        made.ladder.flags = ["-tube", "-ksp_rtol", "1e-3", "-ts_dt", "0.3"]
        answer = next(a for a in made.answers() if a.run)
        page.recommended(path, answer, made, "the command")
        lines = path.read_text().splitlines()
        self.assertIn("# Flags that go with it: -tube -ksp_rtol 1e-3 -ts_dt 0.3", lines)
        self.assertIn(f"# The mesh: {answer.run.setting.mesh.cells} tetrahedra, given as {answer.run.setting.mesh.name}", lines)
        self.assertIn(f"-ts_dt {answer.run.setting.steps.dt:.10g}", lines)
        self.assertIn("-ksp_type fgmres", lines)
        self.assertFalse([line for line in lines if line.startswith("-ksp_rtol")])

    def test_duplicate_levels_are_one(self):
        cube = pulmo.mesh("cube_lung.msh")
        made = command.prepare(["pcv", "--build", os.path.dirname(pulmo.PROGRAM), "--output", pulmo.scratch(), "--meshes", cube,
                                os.path.join(os.path.dirname(cube), ".", "cube_lung.msh"), "--refine", "1", "--dt-factors", "1", "2", "1", "--schemes",
                                "bdf", "bdf", "--adaptive", "0", "--solvers", "direct", "direct", "--tolerances", "1e-4", "1e-4"]).axes
        self.assertEqual([len(made.meshes), len(made.steps), len(made.solvers)], [2, 2, 2])

    def test_refuses(self):
        for arguments, named in ((["nowhere"], "nowhere"), (["pcv", "--question", "C_rs"], "C_rs=1%"), (["pcv", "--budget", "soon"], "soon"),
                                 (["pcv", "--meshes", "none.msh"], "none.msh"), (["pcv", "--solvers", "nothing"], "direct"),
                                 (["pcv", "--dt-factors", "2", "--meshes", pulmo.mesh("cube_lung.msh")], "--dt-factors"),
                                 (["pcv", "--", "-output_dir", "here"], "-output_dir")):
            with self.subTest(arguments=arguments):
                refused = tool("--build", os.path.dirname(pulmo.PROGRAM), "--output", pulmo.scratch(), *arguments)
                self.assertNotEqual(refused.returncode, 0)
                self.assertIn(named, refused.stderr)
                self.assertNotIn("Traceback", refused.stderr)

    def test_refuses_levels_and_options_of_the_ladders(self):
        folder = pathlib.Path(pulmo.scratch())
        folder.mkdir()
        cube, again, empty, options = pulmo.mesh("cube_lung.msh"), folder / "again.msh", folder / "empty.msh", folder / "mine.opts"
        again.write_bytes(pathlib.Path(cube).read_bytes())
        empty.write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n$Elements\n1\n"
                         "1 2 2 1 1 1 2 3\n$EndElements\n")
        options.write_text("-step_volume_tolerance 5 # ml\n")
        for arguments, said in ((["pcv", "--", "-dm_refine", "1"], "use --refine"), ([options, "--meshes", cube], "-step_volume_tolerance"),
                                (["pcv", "--", "-step_pressure_tolerance", "1"], "-step_pressure_tolerance"),
                                (["pcv", "--", "-error_estimate"], "-error_estimate"), (["pcv", "--", "-restart", "there"], "-restart"),
                                (["pcv", "--meshes", cube, again], "differ by 5 %"), (["pcv", "--meshes", empty], "no tetrahedra")):
            with self.subTest(arguments=arguments), self.assertRaisesRegex(SystemExit, said):
                command.prepare(["--build", os.path.dirname(pulmo.PROGRAM), "--output", str(folder), *map(str, arguments)])


if __name__ == "__main__":
    pulmo.main()
