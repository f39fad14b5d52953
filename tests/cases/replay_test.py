#!/usr/bin/python3
"""A run that could not go on leaves a folder, and -replay repeats its last attempts from there: the same residuals in all digits, the
same message, the same exit code; it writes nothing, and it refuses what it could not repeat."""
import json
import os
import pathlib
import re
import shutil
import unittest

import pulmo_case as pulmo

LIMIT = pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.STILL + pulmo.ROLLERS + [
    "-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", "20", "-ventilator_ramp", "1", "-ts_max_time", "1", "-ts_dt", "0.1"]
# Newton keeps Jacobians over steps, and first guesses come of the steps before
RIM = pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.CUBE + pulmo.QUIET + [
    "-tissue", "berger", "-ventilator_pip", "40", "-airflow_permeability", "10", "-ts_max_time", "0.3"]
SOLVER = pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.CUBE + pulmo.QUIET + [
    "-tissue", "yoshihara", "-ts_adapt_dt_min", "0.01", "-snes_max_it", "1", "-snes_rtol", "1e-14", "-snes_stol", "0"]
# a first Jacobian whose coarse spaces are kept to the end
LUNG = pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.LUNG + pulmo.QUIET + [
    "-tissue", "berger", "-ventilator_pip", "20", "-ts_adapt_dt_min", "1e-3", "-ts_max_time", "0.3"]
SAME = "as in the run, bit for bit"


def failed(options, ranks=1):
    case = pulmo.Case(options, ranks=ranks)
    if case.code != 2:
        raise AssertionError(f"exit code {case.code}: {case.command}\n{case.tail()}")
    return case


def repeated(directory, *more, ranks=1, **arguments):
    return pulmo.Case(["-replay", directory, *more], ranks=ranks, directory="-", **arguments)


def error(case):
    return next(line for line in case.err.splitlines() if line.startswith("pulmo: error: "))


def contents(directory):
    """Path -> bytes and time of all files below it."""
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in pathlib.Path(directory).rglob("*") if path.is_file()}


class Replay(unittest.TestCase):
    def expect_same(self, options, ranks=1):
        case = failed(options, ranks)
        self.assertIn(f" To see its last attempts again: -replay {case.directory}.", case.err)
        before, kept = contents(case.directory), case.json("replay/replay.json")
        again = repeated(case.directory, "-snes_monitor", ranks=ranks)
        self.assertEqual(again.code, 2, again.tail())
        attempts = re.findall(r"attempt (\d+): .*", again.out)
        self.assertEqual([int(i) for i in attempts], list(range(kept["first_attempt"] + 1, len(kept["attempts"]) + 1)), again.out)
        self.assertEqual(again.out.count(SAME), len(attempts), again.out)
        self.assertNotIn("not those of the run", again.out)
        self.assertTrue(error(case).startswith(error(again)), f"{error(case)}\n{error(again)}")
        # SNES prints for itself what it met
        norms = [float(n) for n in re.findall(r"SNES Function norm (\S+)", again.out)]
        stored = [float(n) for a in kept["attempts"][kept["first_attempt"]:] for n in a["residual_norms"]]
        self.assertGreater(len(stored), 0)
        for norm in stored:
            self.assertTrue(any(abs(norm - n) <= 1e-11 * abs(norm) for n in norms), f"{norm} not in {norms[-20:]}")
        self.assertEqual(contents(case.directory), before)
        return case

    def test_limit_point(self):
        # one rank: on several MUMPS adds in the order in which messages come, and where the matrix is all but singular two runs of the
        # same scene part (docs/restart.md)
        self.expect_same(LIMIT)

    def test_fold_at_the_rim(self):
        for ranks in (1, 2):
            with self.subTest(ranks=ranks):
                self.expect_same(RIM, ranks)

    def test_rim_with_two_steps_back(self):
        self.expect_same(pulmo.DIRECT + RIM[2:] + ["-ts_type", "bdf"])

    def test_solver_that_may_not_work(self):
        for ranks in (1, 2):
            with self.subTest(ranks=ranks):
                self.expect_same(SOLVER, ranks)

    def test_coarse_spaces_of_the_first_step(self):
        self.expect_same(LUNG)

    def test_other_options(self):
        """Options after it replace those of the run: the step is accepted, and that ends it. Nothing is written anywhere."""
        case = failed(SOLVER)
        before = contents(case.directory)
        place = os.path.dirname(pulmo.scratch())
        again = repeated(os.path.join(case.directory, "replay"), "-snes_max_it", "30", cwd=place)
        self.assertEqual(again.code, 0, again.tail())
        self.assertIn("with other options: -snes_max_it", again.out)
        self.assertIn("the step to t = 0.05 s was accepted", again.out)
        self.assertFalse(os.path.exists(case.path("checkpoint.h5")))
        self.assertNotIn("-restart", again.out)
        self.assertEqual(contents(case.directory), before)
        self.assertEqual(os.listdir(place), [])

    def test_a_finished_run_leaves_none(self):
        case = failed(SOLVER)
        self.assertTrue(os.path.isdir(case.path("replay")))
        good = pulmo.finished(SOLVER + ["-snes_max_it", "30", "-ts_max_time", "0.05", "-output_overwrite"], directory=case.directory)
        self.assertNotIn("replay", good.files())

    def test_a_file_of_that_name_stays(self):
        directory = pulmo.scratch()
        os.mkdir(directory)
        mine = os.path.join(directory, "replay")
        with open(mine, "w") as f:
            f.write("mine")
        case = pulmo.Case(SOLVER, directory=directory)
        self.assertEqual(case.code, 2, case.tail())
        self.assertIn("No folder for -replay (", case.err)
        with open(mine) as f:
            self.assertEqual(f.read(), "mine")

    def test_what_is_refused(self):
        mesh = pulmo.scratch("mesh.msh")
        shutil.copy(pulmo.mesh("cube_lung.msh"), mesh)
        case = failed(SOLVER + ["-dm_plex_filename", mesh])
        file = case.path("replay/replay.json")
        kept = case.json("replay/replay.json")

        def refuse(*words, options=("-replay", case.directory), ranks=1):
            wrong = pulmo.Case(list(options), ranks=ranks, directory="-")
            self.assertEqual(wrong.code, 1, wrong.tail())
            for word in words:
                self.assertIn(word, wrong.err)

        def rewritten(**changes):
            with open(file, "w") as f:
                json.dump(kept | changes, f)

        refuse("must be the first word on the command line", options=["-ts_dt", "0.1", "-replay", case.directory])
        refuse("-replay needs the directory of a run that failed", options=["-replay"])
        refuse("no replay.json is there", options=["-replay", os.path.dirname(case.directory)])
        refuse("the run had 1 rank, this one has 2", ranks=2)
        refuse("there -tissue is 'yoshihara', here 'birzle'", options=["-replay", case.directory, "-tissue", "birzle"])
        for name, value in (("-restart", file), ("-dry_run", "on"), ("-scene_view_only", "on")):
            refuse(f"{name} does not go with -replay", options=["-replay", case.directory, name, value])
        for changes in (dict(options=[]), dict(options=[dict(name="tissue", value="x", source="")]), dict(ranks=-1), dict(mesh="")):
            rewritten(**changes)
            refuse("replay.json is damaged; run the scene again")
        rewritten()
        state = pathlib.Path(case.path("replay/state.h5"))
        whole = state.read_bytes()
        for damaged in (b"", whole[:len(whole) // 2]):
            state.write_bytes(damaged)
            refuse("state.h5: th", "; run the scene again")
        state.write_bytes(whole)
        rewritten(version="0.1")
        refuse("the run was one of pulmo 0.1")
        rewritten(format=99)
        refuse("the folder has format 99")
        with open(file, "w") as f:
            f.write("{")
        refuse("replay.json is damaged")
        rewritten()
        with open(mesh, "a") as f:
            f.write("\n")
        refuse("has changed since the run")
        os.remove(mesh)
        refuse("cannot be read")
        os.remove(case.path("replay/state.h5"))
        refuse("is incomplete: state.h5 is missing")


if __name__ == "__main__":
    pulmo.main()
