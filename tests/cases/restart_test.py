#!/usr/bin/python3
"""A run that was stopped, killed or failed goes on from its checkpoint as if nothing had happened; a file that is no
checkpoint of the run is refused before anything is touched."""
import itertools
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import tempfile
import time
import unittest

import h5py
import numpy as np

import case_meshes
import pulmo_case as pulmo

SAME_RANKS, OTHER_RANKS = 1e-10, 1e-8
NOT_COMPARED = ("phase", "newton_iterations", "krylov_iterations")
BASE = pulmo.TIGHT + pulmo.SCENE + pulmo.QUIET
CUBE = BASE + pulmo.CUBE
BREATH = ["-ventilator_inspiration", "0.3", "-ventilator_expiration", "0.3"]
PCV = CUBE + ["-ventilator", "pcv", "-ventilator_pip", "6"] + BREATH
# two breaths; the second begins at 0.4 s with a ramp of 0.1 s
TWICE = ["-ventilator", "pcv", "-ventilator_pip", "6", "-ventilator_inspiration", "0.2", "-ventilator_expiration", "0.2",
         "-ventilator_breaths", "2"]
VCV = CUBE + ["-ventilator", "vcv", "-ventilator_tidal_volume", "0.2", "-ventilator_inspiration", "0.2",
              "-ventilator_pause", "0.05", "-ventilator_expiration", "0.1", "-ventilator_breaths", "2"]
LONG = PCV + ["-ventilator_breaths", "2000"]
LIMITED = ("settle 0.1 pressure 2 ramp 0.05\ninspiration 0.6 flow 900 limit 6\n"
           "expiration 0.3 pressure 0 ramp 0.2\n")
TUBE = ["-tube", "-tube_k1", "6", "-tube_k2", "9"]


def rows_so_far(directory, name="signals.csv.part"):
    """Whole lines of the signals of a run, without the header."""
    try:
        with open(os.path.join(directory, name)) as f:
            return [line.split(",") for line in f.read().split("\n")[1:-1]]
    except FileNotFoundError:
        return []


def checkpoint_time(path):
    with h5py.File(path) as f:
        names = bytes(f["scalar_names"][:]).decode().split()
        return dict(zip(names, f["scalars"][:, 0]))["time_s"]


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as f:
            return f.read().rsplit(")")[-1].split()[0] != "Z"
    except FileNotFoundError:
        return False


class Running:
    """A run at work in the background."""

    def __init__(self, options, directory, ranks=1):
        command = [pulmo.PROGRAM] + [str(o) for o in options] + ["-output_dir", directory]
        if ranks > 1:
            command = pulmo.LAUNCHER + [str(ranks)] + command

        self.directory = directory
        self.process = subprocess.Popen(command, cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT, text=True,
                                        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)

    def wait_for_rows(self, n, timeout=120):
        end = time.monotonic() + timeout
        while len(rows_so_far(self.directory)) < n:
            if self.process.poll() is not None:
                out, err = self.process.communicate()
                raise AssertionError(f"ended too early: {out[-500:]} {err[-1500:]}")
            if time.monotonic() > end:
                self.end()
                raise AssertionError(f"no {n} rows after {timeout} s")
            time.sleep(0.005)

    def workers(self):
        """Process ids of the ranks."""
        listed = subprocess.run(["ps", "-o", "pid=,comm=", "-g", str(os.getsid(self.process.pid))], text=True,
                                stdout=subprocess.PIPE).stdout.split("\n")
        name = os.path.basename(pulmo.PROGRAM)
        return [int(line.split()[0]) for line in listed if line.split()[1:] == [name]]

    def end(self, timeout=60):
        """What it said, once it ended by itself."""
        try:
            out, err = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
            raise AssertionError(f"no end after {timeout} s") from None
        return self.process.returncode, out, err


class RestartCase(unittest.TestCase):
    def expect_same(self, reference, other, tolerance, after=0.0):
        """Signals, energy balance and clinical numbers; rows are measured by what they are after a time."""
        for name in ("signals.csv", "energy.csv"):
            if name not in reference.files():
                self.assertNotIn(name, other.files())  # BDF2 keeps no energy balance
                continue
            a, b = reference.signals(name), other.signals(name)
            self.assertEqual(list(a), list(b))
            self.assertEqual(len(a["time_s"]), len(b["time_s"]), "number of steps")
            self.assertEqual(a.get("phase"), b.get("phase"))
            for column in a:
                if column in NOT_COMPARED or column == "residual_j":
                    continue
                scale = np.abs(a[column][a["time_s"] > after + 1e-9]).max()
                self.assertLessEqual(np.abs(a[column] - b[column]).max(), tolerance * scale, f"{name} {column}")
        rows = reference.signals()
        self.assertGreater(rows["volume_ml"][rows["time_s"] > after + 1e-9].max(),
                           0.01 * reference.json()["reference_volume_ml"], "the lung hardly moved")
        a, b = reference.json(), other.json()
        for key in ("steps", "effects", "cells", "dofs"):
            self.assertEqual(a[key], b[key])
        breaths = [a] + a["breaths"], [b] + b["breaths"]
        self.assertEqual(len(breaths[0]), len(breaths[1]))
        for x, y in zip(*breaths):
            for key in ("peak_inspiratory_pressure_cmH2O", "tidal_volume_ml", "peak_flow_ml_per_s", "work_j",
                        "plateau_pressure_cmH2O", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"):
                if x[key] is None:
                    self.assertIsNone(y[key])
                else: # fits divide by differences of the signals
                    self.assertLessEqual(abs(x[key] - y[key]), 1e3 * tolerance * abs(x[key]), key)
        self.assertLessEqual(abs(a["min_jacobian"] - b["min_jacobian"]), tolerance)
        self.assertLess(b.get("mass_balance_error_ml", 0), 1e-9 * a["reference_volume_ml"])
        for region, state in a["regions"].items():
            for key in ("jacobian_mean", "ventilation_ml"):
                if key in state:
                    self.assertLessEqual(abs(state[key] - b["regions"][region][key]), tolerance * abs(state[key]))

    def index(self, case):
        """Times of fields.xdmf; all that it names must be there."""
        with open(case.path("fields.xdmf")) as f:
            text = f.read()
        for name in set(re.findall(r">(fields[^:]*\.h5):", text)):
            self.assertIn(name, case.files())
        return [float(t) for t in re.findall(r'Time Value="([^"]*)"', text)]

    def fields(self, case, time_s):
        """Displacements at a time, by coordinates of the nodes."""
        with open(case.path("fields.xdmf")) as f:
            snapshots = f.read().split("<Grid Name=\"step\"")[1:]
        text = next(s for s in snapshots if abs(float(re.search(r'Time Value="([^"]*)"', s)[1]) - time_s) < 1e-9)
        with h5py.File(case.path(re.search(r">([^:>]*):/geometry", text)[1])) as f:
            x = f["geometry"][:]
        with h5py.File(case.path(re.search(r">([^:>]*):/displacement", text)[1])) as f:
            u = f["displacement_mm"][:].reshape(-1, 3)
        return u[np.lexsort(np.round(x, 6).T)]

    def expect_error(self, code, err, *words, ends_with=1):
        self.assertEqual(code, ends_with, err)
        self.assertEqual(err.count("pulmo: error:"), 1, err)
        for noise in ("PETSC ERROR", "HDF5-DIAG"):
            self.assertNotIn(noise, err)
        for word in words:
            self.assertIn(word, err)


class Agreement(RestartCase):
    """Each scene: a whole run that keeps a checkpoint at a time in the second half; from there once more."""
    SCENES = {
        # the second breath's rise of pressure
        "pcv": (CUBE + TWICE, 0.45),
        # the second breath's flow
        "vcv": (VCV, 0.45),
        "vcv, common pressure": (VCV + pulmo.COMMON, 0.45),
        "vcv, no airflow": (VCV + pulmo.STILL, 0.45),
        "pcv, no airflow, pins": (CUBE + TWICE + pulmo.STILL + pulmo.PINS +
                                  ["-chest_wall", "off", "-tissue", "ma", "-ventilator_pip", "4"], 0.45),
        # the limit is held
        "limit and tube": (BASE + pulmo.LITRE + TUBE + pulmo.programme(LIMITED), 0.55),
        # a ramp from what the ventilator had when the phase began
        "ramp": (BASE + pulmo.LITRE + pulmo.programme(LIMITED), 0.8),
        "predictor": (CUBE + TWICE + ["-predictor_increments", "2"], 0.45),
        "BDF2": (CUBE + TWICE + ["-ts_type", "bdf"], 0.45),
        "BDF2, flow": (VCV + ["-ts_type", "bdf"], 0.45),
        "BDF2, limit": (BASE + pulmo.LITRE + TUBE + pulmo.programme(LIMITED) + ["-ts_type", "bdf"], 0.55),
        "tissue that relaxes": (CUBE + TWICE + ["-viscoelastic"], 0.45),
        "tissue that relaxes, BDF2": (CUBE + TWICE + ["-viscoelastic", "-ts_type", "bdf"], 0.45),
        "P1-P1": (CUBE + TWICE + ["-elements", "P1-P1", "-pressure_damping"], 0.45),
        "P3-P2": (VCV + ["-elements", "P3-P2"], 0.45),
        "steps by their error": (CUBE + TWICE + ["-ts_type", "bdf", "-ts_dt", "0.01", "-step_volume_tolerance", "0.5"], 0.45),
        # steps were cut and grow again
        "cut steps": (PCV + ["-snes_max_it", "5", "-ventilator_ramp_down", "0.2"], 0.31),
    }

    def run_scene(self, name, first=1, then=(1, 2)):
        options, at = self.SCENES[name]
        reference = pulmo.finished(options + ["-checkpoint_every", at], ranks=first)
        self.assertLess(reference.json()["end_time_s"], 2 * at, "there is more than one checkpoint before the end")
        rows = reference.signals()
        kept = checkpoint_time(reference.path("checkpoint_previous.h5"))
        self.assertAlmostEqual(kept, rows["time_s"][rows["time_s"] >= at - 1e-9][0], 12, "the first step at or after")
        self.assertAlmostEqual(checkpoint_time(reference.path("checkpoint.h5")), rows["time_s"][-1], 12)
        for ranks in then:
            with self.subTest(name, ranks=ranks):
                other = pulmo.finished(options + ["-restart", reference.path("checkpoint_previous.h5")], ranks=ranks)
                self.assertIn(f"t = {kept:.6g} s", other.out)
                self.expect_same(reference, other, SAME_RANKS if ranks == first else OTHER_RANKS, kept)
                times = self.index(reference)
                self.assertEqual(self.index(other), times)
                u = self.fields(reference, times[-1]), self.fields(other, times[-1])
                np.testing.assert_allclose(*u, rtol=0, atol=OTHER_RANKS * np.abs(u[0]).max() + 1e-14)
        return reference

    def test_scenes(self):
        for name in self.SCENES:
            reference = self.run_scene(name, then=(1, 2) if name in ("vcv", "vcv, no airflow", "P3-P2") else (1,))
            if name == "cut steps":
                self.assertGreater(reference.json()["rejected_steps"], 0)
            if name == "limit and tube":
                rows = reference.signals()
                held = np.abs(rows["ventilator_pressure_cmH2O"] - 6) < 1e-9
                self.assertTrue(held[rows["time_s"] == 0.5].all() and held.sum() > 3, "the limit was reached")

    def test_from_two_ranks(self):
        self.run_scene("limit and tube", first=2, then=(1, 3))
        self.run_scene("vcv, common pressure", first=2, then=(2,))
        self.run_scene("tissue that relaxes, BDF2", first=2, then=(1, 3))

    def test_other_solvers(self):
        """A kept Jacobian is not in the file: agreement is that of the solver's tolerance."""
        tolerance = 1e-6 # -snes_rtol of the solver files is 1e-8, of a step's first residual: steps add up
        for solver, (control, scene) in itertools.product(("iterative", "reuse"), (("pressure", CUBE + TWICE), ("flow", VCV))):
            with self.subTest(solver, control=control):
                options = pulmo.options_file(f"solvers/{solver}.opts") + scene[len(pulmo.TIGHT):]
                reference = pulmo.finished(options + ["-checkpoint_every", "0.45"])
                other = pulmo.finished(options + ["-restart", reference.path("checkpoint_previous.h5")])
                a, b = reference.signals(), other.signals()
                self.assertGreater(a["volume_ml"][a["time_s"] > 0.45].max(), 0.3 * a["volume_ml"].max(), "there is something to compare")
                self.assertEqual(len(a["time_s"]), len(b["time_s"]))
                for column in ("volume_ml", "airway_pressure_cmH2O", "flow_ml_per_s"):
                    self.assertLess(np.abs(a[column] - b[column]).max(), tolerance * np.abs(a[column]).max(), column)

    def test_longer_run_in_the_same_directory(self):
        """Snapshots and rows after the checkpoint give way; a later end is no other scene."""
        every = ["-output_fields_every", "0.1", "-checkpoint_every", "0.25"]
        reference = pulmo.finished(PCV + every)
        short = pulmo.finished(PCV + every + ["-ts_max_time", "0.45"])
        self.assertAlmostEqual(checkpoint_time(short.path("checkpoint.h5")), short.signals()["time_s"][-1], 12)
        case = pulmo.Case(PCV + every + ["-restart", short.path("checkpoint_previous.h5")], directory=short.directory)
        self.expect_error(case.code, case.err, "holds a finished run", "-output_overwrite")
        longer = pulmo.finished(PCV + every + ["-restart", short.path("checkpoint_previous.h5"), "-output_overwrite"],
                                directory=short.directory, ranks=2)
        self.expect_same(reference, longer, OTHER_RANKS)
        self.assertEqual(self.index(longer), self.index(reference))
        for t in (0.2, 0.4):
            u = self.fields(reference, t), self.fields(longer, t)
            np.testing.assert_allclose(*u, rtol=0, atol=OTHER_RANKS * np.abs(u[0]).max())
        # snapshots that are gone are missed, no more
        alone = pulmo.scratch("alone.h5")
        shutil.copy(short.path("checkpoint.h5"), alone)
        rest = pulmo.Case(PCV + every + ["-restart", alone, "-ventilator_breaths", "2", "-ts_max_time", "0.7"])
        self.assertEqual(rest.code, 0, rest.tail())
        self.assertIn("earlier snapshots are not in", rest.out)
        self.assertEqual(self.index(rest), [t for t in (0.6, 0.7) if t > checkpoint_time(alone) + 1e-9])

    def test_an_end_between_steps(self):
        """-ts_max_time cuts the last step: the checkpoint is of the state before, and a longer run never took that step."""
        scenes = {
            # 0.23 s: within a phase, the last two steps are halves; 0.33 s: within its first step; 0.1 s: a step ends
            # there; 0.1003 s: it is stretched
            "pcv": (PCV, [(0.23, 0.15), (0.33, 0.3), (0.1, 0.1), (0.1003, 0.05)]),
            # two steps of 0.04 s end the phase from 0.32 s on
            "halves": (PCV[:-1] + ["0.28"], [(0.51, 0.45), (0.56, 0.5)]),
            # 0.02 s: the end of the ramp
            "steps by their error": (CUBE + TWICE + ["-ts_type", "bdf", "-ts_dt", "0.01", "-step_volume_tolerance", "0.5",
                                                     "-ventilator_ramp", "0.02"], [(0.02, 0.02), (0.123, None)]),
        }
        for scene, (options, ends) in scenes.items():
            reference = pulmo.finished(options)
            times = reference.signals()["time_s"]
            for end, kept in ends:
                with self.subTest(scene, end=end):
                    short = pulmo.finished(options + ["-ts_max_time", end, "-checkpoint_every", "10"])
                    self.assertAlmostEqual(short.signals()["time_s"][-1], end, 12)
                    at = checkpoint_time(short.path("checkpoint.h5"))
                    if kept is None:
                        self.assertLess(np.abs(times - at).min(), 1e-9)
                    else:
                        self.assertAlmostEqual(at, kept, 9)
                    self.assertEqual("pulmo: note: -ts_max_time" in short.out, at < end - 1e-9)
                    restart = ["-restart", short.path("checkpoint.h5")]
                    self.expect_same(reference, pulmo.finished(options + restart), SAME_RANKS)
                    self.expect_same(reference, pulmo.finished(options + restart + ["-output_overwrite"], directory=short.directory),
                                     SAME_RANKS)

    def test_an_end_within_the_first_step(self):
        short = pulmo.finished(PCV + ["-ts_max_time", "0.02", "-checkpoint_every", "10"])
        self.assertIn("pulmo: note: -ts_max_time 0.02 cuts the first step", short.out)
        rest = pulmo.finished(PCV + ["-restart", short.path("checkpoint.h5")]).signals()["time_s"]
        np.testing.assert_allclose(rest[:3], [0, 0.02, 0.07], atol=1e-12)

    def test_an_end_between_steps_twice(self):
        """Nothing is kept of a step that is cut again."""
        reference = pulmo.finished(PCV)
        short = pulmo.finished(PCV + ["-ts_max_time", "0.33", "-checkpoint_every", "0.01"])
        before = checkpoint_time(short.path("checkpoint.h5"))
        again = pulmo.finished(PCV + ["-ts_max_time", "0.34", "-checkpoint_every", "0.01", "-output_overwrite", "-restart",
                                      short.path("checkpoint.h5")], directory=short.directory)
        self.assertEqual(checkpoint_time(short.path("checkpoint.h5")), before)
        self.assertAlmostEqual(again.signals()["time_s"][-1], 0.34, 12)
        self.expect_same(reference, pulmo.finished(PCV + ["-restart", short.path("checkpoint.h5")]), SAME_RANKS)

    def test_later_phases_may_change(self):
        first = "in 0.2 pressure 5\nout 0.2 pressure 0\n"
        other = CUBE + pulmo.programme(first + "in 0.2 pressure 3\n")
        once = pulmo.finished(CUBE + pulmo.programme(first) + ["-checkpoint_every", "0.3"])
        reference = pulmo.finished(other)
        self.expect_same(reference, pulmo.finished(other + ["-restart", once.path("checkpoint_previous.h5")]),
                         SAME_RANKS)


class ErrorBars(RestartCase):
    """Bars are made of the steps and the solver of the last session: they have to be those of the whole run."""

    def refused(self, start, options, *words, ranks=1):
        case = pulmo.Case(PCV + ["-error_estimate", "-restart", start.path("checkpoint.h5")] + options, ranks=ranks)
        self.expect_error(case.code, case.err, "-error_estimate", "changed at a restart", "run from the start", *words)
        self.assertFalse(os.path.exists(case.directory), "something was touched")

    def test_changed_steps_and_solver(self):
        start = pulmo.finished(PCV + ["-checkpoint_every", "0.1", "-ts_max_time", "0.2"])
        for options, words in ((["-ts_dt", "0.025"], "-ts_dt was '0.05' until t = 0.2 s and '0.025' after it"),
                               (["-snes_rtol", "1e-6"], "-snes_rtol was '1e-14' until t = 0.2 s and '1e-6' after it"),
                               (["-ksp_type", "fgmres"], "-ksp_type was 'preonly' until"),
                               (["-step_volume_tolerance", "0.5"], "-step_volume_tolerance was '0' until"),
                               (["-snes_lag_jacobian", "2"], "-snes_lag_jacobian was not given until")):
            with self.subTest(words):
                self.refused(start, options, words, ranks=2 if options[0] == "-ts_dt" else 1)
        # it is remembered
        middle = pulmo.finished(PCV + ["-ts_dt", "0.025", "-ts_max_time", "0.3", "-checkpoint_every", "0.1",
                                       "-restart", start.path("checkpoint.h5")])
        self.refused(middle, [], "-ts_dt was '0.05' until t = 0.2 s and '0.025' after it")
        # what changes no number may change
        free = ["-ts_max_time", "0.6", "-snes_monitor", "-output_fields_every", "0.3", "-snes_rtol", "1.0e-14", "-mesh_scale", "1.0"]
        coarse = ["-error_estimate_mesh", case_meshes.coarse_cube_lung()]
        made = pulmo.finished(PCV + free + coarse + ["-error_estimate", "-restart", start.path("checkpoint.h5")])
        self.assertIsNotNone(made.json()["error_estimate"]["numbers"]["tidal_volume_ml"]["time"])


class Meshes(RestartCase):
    """Nodes are told apart by where they are, not by their numbers."""

    def setUp(self):
        self.points, self.blocks, self.names = case_meshes.blocks_of("cube_lung.msh")

    def test_renumbered(self):
        random_numbers = np.random.default_rng(1)
        new = random_numbers.permutation(len(self.points)) # [old number]
        points = np.empty_like(self.points)
        points[new] = self.points
        blocks = []
        for kind, cells, tags in self.blocks:
            order = random_numbers.permutation(len(cells))
            blocks.append((kind, new[cells][order], tags[order]))
        renumbered = case_meshes.save(points, blocks, self.names) + ["-mesh_scale", "1"]
        for pair in ("P2-P1", "P3-P2"): # P3: the two nodes of an edge change places with its ends
            with self.subTest(pair):
                options = CUBE + TWICE + ["-elements", pair, "-checkpoint_every", "0.45"]
                reference = pulmo.finished(options)
                other = pulmo.finished(options + renumbered + ["-restart", reference.path("checkpoint_previous.h5")])
                self.expect_same(reference, other, OTHER_RANKS, after=0.45)

    def test_nodes_at_one_place(self):
        """Two blocks that touch without being joined: there are two nodes at each place of the fissure."""
        mirrored = self.points * [-1, 1, 1]
        n = len(self.points)
        blocks = list(self.blocks)
        for kind, cells, tags in self.blocks:
            blocks.append((kind, cells[:, [1, 0] + list(range(2, cells.shape[1]))] + n, tags))
        mesh = case_meshes.save(np.vstack([self.points, mirrored]), blocks, self.names) + ["-mesh_scale", "1"]
        options = CUBE + TWICE + mesh + ["-checkpoint_every", "0.45"]
        cubic = options + ["-elements", "P3-P2"]
        once = pulmo.finished(cubic)
        self.expect_same(once, pulmo.finished(cubic + ["-restart", once.path("checkpoint_previous.h5")], ranks=2), OTHER_RANKS, after=0.45)
        reference = pulmo.finished(options)
        other = pulmo.finished(options + ["-restart", reference.path("checkpoint_previous.h5")], ranks=2)
        with h5py.File(reference.path("checkpoint.h5")) as f:
            self.assertEqual(len(f["state/pressure"]), 2 * n)
        with h5py.File(reference.path("fields.h5")) as f:
            fissure = f["geometry"][:][:, 0] == 0
        with h5py.File(reference.path("fields_00003.h5")) as f: # at 0.6 s
            u = f["displacement_mm"][:].reshape(-1, 3)[fissure, 0]
        self.assertGreater(u.max(), 0.1)
        self.assertLess(u.min(), -0.1, "the sides of the fissure move differently")
        self.expect_same(reference, other, OTHER_RANKS, after=0.45)

    def joined(self):
        """Cells and tags of a kind, of which the file may have several blocks."""
        return {kind: [np.concatenate([block[i] for block in self.blocks if block[0] == kind]) for i in (1, 2)]
                for kind in ("triangle", "tetra")}

    def mesh_with(self, tags=None, names=None):
        """Options for the cube with other tags of its facets ("triangle") or cells ("tetra"), and other names."""
        blocks = [(kind, cells, (tags or {}).get(kind, old)) for kind, (cells, old) in self.joined().items()]
        return case_meshes.save(self.points, blocks, names or self.names) + ["-mesh_scale", "1"]

    def test_names(self):
        """Which facets and cells a name marks is part of the scene, whatever the numbers of the file say."""
        airway, pleura, lung = (self.names[n][0] for n in ("airway", "pleura", "lung"))
        (facets, of_facet), (cells, of_cell) = self.joined().values()
        inside, elsewhere = (np.flatnonzero(of_facet == tag) for tag in (airway, pleura))

        def marked(chosen):
            return {"triangle": np.where(np.isin(np.arange(len(facets)), chosen), airway, pleura)}

        half = {"tetra": np.where(self.points[cells].mean(axis=1)[:, 1] < np.median(self.points[:, 1]), lung, 9)}
        two = {**self.names, "upper": [9, 3]}
        other_half = {"tetra": np.where(half["tetra"] == 9, lung, 9)}
        n, c = len(inside), len(cells)
        again = PCV + ["-ts_max_time", "0.2", "-checkpoint_every", "0.1"]
        reference = pulmo.finished(again)
        split = pulmo.finished(again + self.mesh_with(half, two))
        upper = int((half["tetra"] == 9).sum())
        wall = ["-chest_wall_surfaces", "wall"]
        for start, options, words, ranks in (
                (reference, self.mesh_with(marked(elsewhere[:n])), f"there the surface 'airway' has {n} facets, here as many, but others", 2),
                (reference, self.mesh_with(marked(inside[1:])), f"there the surface 'airway' has {n} facets, here {n - 1}", 1),
                (reference, self.mesh_with(names={"airway": [airway, 2], "wall": [pleura, 2], "lung": [lung, 3]}) + wall,
                 f"there the surface 'pleura' has {len(facets) - n} facets, here they are called 'wall'", 1),
                (reference, self.mesh_with(half, two), f"there the volume 'lung' has {c} cells, here {c - upper}", 2),
                (split, self.mesh_with(other_half, two), "there the volume 'lung' has", 1),
                (split, self.mesh_with(half, {**self.names, "right": [9, 3]}),
                 f"there the volume 'upper' has {upper} cells, here they are called 'right'", 1),
                (split, self.mesh_with(half), f"there the volume 'upper' has {upper} cells, here", 1)):
            with self.subTest(words):
                case = pulmo.Case(PCV + options + ["-restart", start.path("checkpoint.h5")], ranks=ranks)
                self.expect_error(case.code, case.err, "of a mesh with other names", words, "give the mesh of that run")
                self.assertFalse(os.path.exists(case.directory), "something was touched")
        # numbers of groups are free, and so is what the file names beside surfaces and volumes
        renamed = {"triangle": of_facet + 20, "tetra": of_cell + 20}
        free = self.mesh_with(renamed, {n: [t + 20, d] for n, (t, d) in self.names.items()} | {"edge": [50, 1]})
        for ranks in (1, 3):
            pulmo.finished(PCV + free + ["-ts_max_time", "0.25", "-restart", reference.path("checkpoint.h5")], ranks=ranks)


class Signals(RestartCase):
    """Asked to stop, a run leaves a checkpoint after the step at hand."""

    def expect_stopped(self, run, name):
        code, _, err = run.end()
        self.expect_error(code, err, f"stopped by {name}", "-restart " + os.path.join(run.directory, "checkpoint.h5"),
                          ends_with=3)
        rows = rows_so_far(run.directory)
        files = os.listdir(run.directory)
        for left in ("summary.json", "signals.csv", "checkpoint.h5.part"):
            self.assertNotIn(left, files)
        self.assertAlmostEqual(checkpoint_time(os.path.join(run.directory, "checkpoint.h5")), float(rows[-1][0]),
                               delta=1e-12)
        return float(rows[-1][0])

    def test_signals(self):
        for name in ("SIGTERM", "SIGINT"):
            with self.subTest(name):
                run = Running(LONG, pulmo.scratch())
                run.wait_for_rows(3)
                run.process.send_signal(getattr(signal, name))
                t = self.expect_stopped(run, name)
        # an accident does not replace it
        case = pulmo.Case(LONG, directory=run.directory)
        self.expect_error(case.code, case.err, "holds the checkpoint of an unfinished run", "-restart")
        # and on, in the same directory
        end = ["-ts_max_time", repr(t + 0.1)]
        restart = ["-restart", os.path.join(run.directory, "checkpoint.h5")]
        reference = pulmo.finished(LONG + end)
        other = pulmo.finished(LONG + end + restart, directory=run.directory)
        self.expect_same(reference, other, SAME_RANKS)

    def test_signals_under_mpiexec(self):
        def all_ranks(run, sig):
            for pid in run.workers():
                os.kill(pid, sig)

        for name, send in (("SIGTERM", all_ranks),
                           ("SIGTERM", lambda run, sig: os.kill(run.workers()[1], sig)),
                           ("SIGUSR1", lambda run, sig: run.process.send_signal(sig))): # mpiexec passes it on
            run = Running(LONG, pulmo.scratch(), ranks=2)
            run.wait_for_rows(2)
            self.assertEqual(len(run.workers()), 2)
            send(run, getattr(signal, name))
            self.expect_stopped(run, name)

    def test_signal_to_mpiexec(self):
        """mpiexec leaves its ranks a second or so; whatever is left is whole."""
        run = Running(LONG + ["-checkpoint_every", "0.05"], pulmo.scratch(), ranks=2)
        run.wait_for_rows(3)
        run.process.send_signal(signal.SIGTERM)
        code, _, _ = run.end()
        self.assertNotEqual(code, 0)
        self.assertGreaterEqual(checkpoint_time(os.path.join(run.directory, "checkpoint.h5")),
                                float(rows_so_far(run.directory)[-1][0]) - 0.05 - 1e-9)

    def test_second_signal(self):
        """A step that never ends does not keep the run from ending."""
        endless = ["-snes_rtol", "0", "-snes_atol", "0", "-snes_max_it", "100000000", "-snes_linesearch_type", "basic"]
        run = Running(LONG + endless, pulmo.scratch())
        run.wait_for_rows(1)
        time.sleep(0.3)
        run.process.send_signal(signal.SIGTERM)
        time.sleep(3.2)
        self.assertIsNone(run.process.poll(), "the step was to go on")
        run.process.send_signal(signal.SIGTERM)
        self.assertEqual(run.end(timeout=10)[0], -signal.SIGTERM)

    def test_killed_rank(self):
        run = Running(LONG, pulmo.scratch(), ranks=2)
        run.wait_for_rows(2)
        ranks = run.workers()
        os.kill(ranks[1], signal.SIGKILL)
        self.assertNotEqual(run.end()[0], 0)
        deadline = time.monotonic() + 10 # mpiexec kills the others, and need not wait until they are gone
        while any(alive(pid) for pid in ranks) and time.monotonic() < deadline:
            time.sleep(0.05)
        for pid in ranks:
            self.assertFalse(alive(pid), "a rank lives on")


class Locks(RestartCase):
    """One run at a time works in a directory."""

    def lock(self, directory):
        with open(os.path.join(directory, "pulmo.lock")) as f:
            return dict(line.split(" ", 1) for line in f.read().splitlines())

    def killed(self):
        """The lock of a run that was killed, and its directory."""
        run = Running(LONG, pulmo.scratch())
        run.wait_for_rows(1)
        run.process.kill()
        run.end()
        return self.lock(run.directory), run.directory

    def write(self, directory, text):
        with open(os.path.join(directory, "pulmo.lock"), "w") as f:
            f.write(text if isinstance(text, str) else "".join(f"{k} {v}\n" for k, v in text.items()))

    def test_second_run(self):
        run = Running(LONG, pulmo.scratch())
        run.wait_for_rows(2)
        lock = self.lock(run.directory)
        self.assertEqual((int(lock["process"]), lock["host"]), (run.process.pid, os.uname().nodename))
        link = pulmo.scratch("link")
        os.symlink(run.directory, link)
        for ranks, directory, options in ((1, run.directory, []), (2, run.directory, ["-output_overwrite"]), (1, link, [])):
            case = pulmo.Case(LONG + options, ranks=ranks, directory=directory)
            self.expect_error(case.code, case.err, f"-output_dir {directory} is in use by another run (process {run.process.pid} on "
                              f"{lock['host']}, started {lock['since']})")
            self.assertEqual(case.code, 1)
        self.assertEqual(self.lock(run.directory), lock)
        run.wait_for_rows(len(rows_so_far(run.directory)) + 2) # it is not disturbed
        run.process.send_signal(signal.SIGTERM)
        self.assertIn("stopped by SIGTERM", run.end()[2])
        steps = [float(row[5]) for row in rows_so_far(run.directory)]
        np.testing.assert_allclose(np.cumsum(steps), [float(row[0]) for row in rows_so_far(run.directory)], rtol=1e-9)
        self.assertNotIn("pulmo.lock", os.listdir(run.directory))

    def test_released(self):
        """However a run ends by itself."""
        case = pulmo.finished(PCV + ["-ts_max_time", "0.1"])
        self.assertEqual([f for f in case.files() if "lock" in f], [])
        failed = pulmo.Case(PCV + ["-snes_max_it", "1"])
        self.assertIn("failure.json", failed.files())
        self.assertEqual([f for f in failed.files() if "lock" in f], [])
        for sent in (["SIGHUP"], ["SIGSEGV"], ["SIGTERM", "SIGTERM"]):
            with self.subTest(sent):
                endless = ["-snes_rtol", "0", "-snes_atol", "0", "-snes_max_it", "100000000", "-snes_linesearch_type", "basic"]
                run = Running(LONG + endless, pulmo.scratch())
                run.wait_for_rows(1)
                for name in sent:
                    run.process.send_signal(getattr(signal, name))
                    time.sleep(3.2 if len(sent) > 1 else 0)
                self.assertNotEqual(run.end()[0], 0)
                self.assertEqual([f for f in os.listdir(run.directory) if "lock" in f], [])

    def test_left_behind(self):
        lock, directory = self.killed()
        on = ["-ts_max_time", "0.1"]
        taken = pulmo.finished(PCV + on, directory=directory, ranks=2)
        self.assertIn(f"was killed (process {lock['process']} on {lock['host']}, started {lock['since']})", taken.out)
        again = ["-output_overwrite"] + on
        for change, words in (({"host": "elsewhere"}, ["process {process} on elsewhere", "remove {lock}"]),
                              ({"namespace": "pid:[1]"}, ["process {process} on", "remove {lock}"]), # of another container
                              ({"boot": "2", "machine": "3"}, ["process {process} on", "remove {lock}"]), # another machine of that name
                              ({"process": str(os.getpid()), "start": ""}, [f"process {os.getpid()} on"])):
            self.write(directory, lock | change)
            case = pulmo.Case(PCV + again, directory=directory)
            known = {"process": lock["process"], "lock": os.path.join(directory, "pulmo.lock")}
            self.expect_error(case.code, case.err, "in use by another run", *(w.format(**known) for w in words))
            self.assertIn("summary.json", case.files(), "what is there stays")
        for text in ("", "none of pulmo's\n"):
            self.write(directory, text)
            case = pulmo.Case(PCV + again, directory=directory)
            self.expect_error(case.code, case.err, "does not say by whom", "remove " + os.path.join(directory, "pulmo.lock"))
        # its number belongs to another process by now; the machine was started anew
        for change in ({"process": str(os.getpid())}, {"boot": "2"} if lock["machine"] else {}):
            self.write(directory, lock | change)
            self.assertIn("was killed", pulmo.finished(PCV + again, directory=directory).out)
        self.assertEqual([f for f in os.listdir(directory) if "lock" in f], [])

    def test_same_instant(self):
        """In a new directory, and in one that a killed run left."""
        for i in range(6):
            directory = self.killed()[1] if i % 2 else pulmo.scratch()
            runs = [Running(LONG, directory) for _ in range(4)]
            end = time.monotonic() + 60
            while sum(run.process.poll() is None for run in runs) > 1 and time.monotonic() < end:
                time.sleep(0.05)
            time.sleep(0.2)
            alive_ones = [run for run in runs if run.process.poll() is None]
            self.assertEqual(len(alive_ones), 1)
            winner, = alive_ones
            self.assertEqual(int(self.lock(directory)["process"]), winner.process.pid)
            for run in runs:
                if run is not winner:
                    code, _, err = run.end()
                    self.expect_error(code, err, "in use by another run")
            winner.process.send_signal(signal.SIGTERM)
            winner.end()
            self.assertEqual([f for f in os.listdir(directory) if "lock" in f], [])


class Faults(RestartCase):
    def test_killed_again_and_again(self):
        """20 times kill -9 at a random moment and on from what is there: at most an interval is lost each time.

        Every other session first takes the three steps that hold a new checkpoint, however slow the machine is.
        """
        every, dt, kills = 0.1, 0.05, 20
        moments = random.Random(5)
        directory, options = tempfile.mkdtemp(dir=os.path.dirname(pulmo.scratch())), LONG + ["-checkpoint_every", every]
        restart, last = [], 0.0
        for kill in range(kills):
            run = Running(options + restart, directory)
            if kill % 2: # rows come with a session's first step: those of the checkpoint, t = 0 among them, and more
                run.wait_for_rows(round(last / dt) + 1 + 3)
            elif kill % 4: # after its first step; else perhaps even before
                run.wait_for_rows(1)
            time.sleep(moments.uniform(0, 0.4))
            self.assertIsNone(run.process.poll())
            run.process.kill()
            run.end()
            files = os.listdir(directory)
            rows = rows_so_far(directory)
            if rows:
                os.remove(os.path.join(directory, "signals.csv.part")) # the next session's first step brings it back
            if "checkpoint.h5" not in files:
                self.assertEqual(restart, [], "a checkpoint that was there is gone")
                self.assertLess(float(rows[-1][0]) if rows else 0, every + dt + 1e-9)
                continue
            kept = [checkpoint_time(os.path.join(directory, f)) for f in ("checkpoint.h5", "checkpoint_previous.h5")
                    if f in files]
            self.assertGreaterEqual(kept[0], last, "never back")
            self.assertEqual(kept, sorted(kept, reverse=True))
            self.assertGreaterEqual(kept[0], float(rows[-1][0]) - every - dt / 2 if rows else 0)
            last, restart = kept[0], ["-restart", os.path.join(directory, "checkpoint.h5")]
        self.assertGreater(last, (kills // 2 - 0.5) * every, "the run got on")
        end = ["-ts_max_time", repr(last + 0.1)]
        other = pulmo.finished(options + restart + end, directory=directory)
        self.expect_same(pulmo.finished(LONG + end), other, SAME_RANKS)

    def started(self):
        """A directory with two checkpoints of a run that may go on, and their bytes."""
        case = pulmo.finished(PCV + ["-checkpoint_every", "0.1", "-ts_max_time", "0.2"])
        for name in ("summary.json", "signals.csv"):
            os.remove(case.path(name))
        return case, self.contents(case.directory)

    def contents(self, directory):
        found = {}
        for name in ("checkpoint.h5", "checkpoint_previous.h5"):
            with open(os.path.join(directory, name), "rb") as f:
                found[name] = f.read()
        return found

    def test_full_disk(self):
        case, before = self.started()
        limit = 45 * 1024 # more than a snapshot, less than a checkpoint
        self.assertGreater(len(before["checkpoint.h5"]), limit)
        run = Running(LONG + ["-restart", case.path("checkpoint.h5"), "-checkpoint_every", "5"], case.directory)
        run.wait_for_rows(1) # the checkpoint at 5 s is a hundred steps away
        resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        code, _, err = run.end()
        self.expect_error(code, err, "cannot write " + case.path("checkpoint.h5"), "File too large", "free the disk",
                          ends_with=2)
        self.assertEqual(self.contents(case.directory), before)
        self.assertNotIn("checkpoint.h5.part", case.files())

    def test_full_disk_at_a_snapshot(self):
        """By a limit, and on a disk that is full, where a test may mount one: no half snapshot, no trace of HDF5."""
        limit = 5 * 1024 # more than the signals have by then, less than a snapshot
        for ranks in (1, 2):
            run = Running(LONG + ["-output_fields_every", "0.5"], pulmo.scratch(), ranks)
            run.wait_for_rows(2)
            for pid in run.workers():
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, limit))
            self.expect_unwritten(run, "fields_00001.h5", "(File too large)", "free the disk")
        disk = pulmo.scratch("disk")
        os.makedirs(disk)
        if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True).returncode != 0:
            self.skipTest("nothing can be mounted here")
        try:
            run = Running(LONG + ["-output_fields_every", "0.05"], os.path.join(disk, "run"), ranks=2)
            self.expect_unwritten(run, "fields", "(No space left on device)", "free the disk")
            with open(os.path.join(run.directory, "fields.xdmf")) as f:
                named = set(re.findall(r">(fields[^:]*\.h5):", f.read()))
            self.assertGreater(len(named), 2)
            for name in named:
                with h5py.File(os.path.join(run.directory, name)) as f:
                    self.assertTrue(all(np.isfinite(f[key][()]).all() for key in f), name)
        finally:
            subprocess.run(["umount", disk], check=True)

    def expect_unwritten(self, run, name, *words):
        code, _, err = run.end()
        self.expect_error(code, err, "cannot write " + os.path.join(run.directory, name), *words, ends_with=2)
        self.assertLess(len(err.split("---")[0].splitlines()), 3, "mpiexec's words aside")
        files = os.listdir(run.directory) if os.path.isdir(run.directory) else []
        self.assertEqual([f for f in files if f.endswith(".part") and f != "signals.csv.part"], [])
        for left in ("summary.json", "signals.csv", "pulmo.lock"):
            self.assertNotIn(left, files)

    def test_vanished_directory(self):
        """The directory is removed while the run is at work; another run takes its place."""
        for ranks in (1, 2):
            run = Running(LONG, pulmo.scratch(), ranks)
            run.wait_for_rows(2)
            shutil.rmtree(run.directory)
            self.expect_unwritten(run, "", "was removed while the run was at work", "-output_dir")
            self.assertFalse(os.path.exists(run.directory))
        run = Running(LONG + ["-output_fields_every", "100"], pulmo.scratch())
        run.wait_for_rows(2)
        os.rename(run.directory, run.directory + "_moved")
        pulmo.finished(PCV + ["-ts_max_time", "0.1"], directory=run.directory)
        code, _, err = run.end()
        self.expect_error(code, err, "was removed while the run was at work", ends_with=2)
        self.assertIn("summary.json", os.listdir(run.directory), "the other run's files stay")

    def test_unwritable(self):
        case, before = self.started()
        os.makedirs(case.path("checkpoint.h5.part/in_the_way"))
        for ranks in (1, 2):
            again = pulmo.Case(PCV + ["-restart", case.path("checkpoint.h5"), "-checkpoint_every", "0.1"], ranks=ranks,
                               directory=case.directory)
            self.expect_error(again.code, again.err, "cannot write " + case.path("checkpoint.h5"), ends_with=2)
            self.assertEqual(self.contents(case.directory), before)

    def test_read_only_directory(self):
        """As nobody if the tests run as root, who writes everywhere."""
        case, before = self.started()
        who = {"user": "nobody", "group": "nogroup", "extra_groups": []} if os.geteuid() == 0 else {}
        folders = [case.directory, os.path.dirname(case.directory), os.path.dirname(os.path.dirname(case.directory))]
        try:
            for folder in folders:
                os.chmod(folder, 0o555)
            for readable in (pulmo.PROGRAM, pulmo.mesh("cube_lung.msh"), case.path("checkpoint.h5")):
                if subprocess.run(["test", "-r", readable], **who).returncode != 0:
                    self.skipTest(f"nobody cannot read {readable}, and root writes everywhere")
            again = pulmo.Case(PCV + ["-restart", case.path("checkpoint.h5")], directory=case.directory, **who)
        finally:
            for folder in folders:
                os.chmod(folder, 0o700)
        self.expect_error(again.code, again.err, "cannot be written")
        self.assertEqual(self.contents(case.directory), before)

    def test_failed_run(self):
        """A run that no solver step gets on leaves its last good state; another solver goes on from there."""
        options = CUBE + pulmo.programme("rest 0.1 pressure 0\npush 0.2 pressure 5\n")
        failed = pulmo.Case(options + ["-snes_max_it", "1"])
        self.expect_error(failed.code, failed.err, "no step could be accepted",
                          "-restart " + failed.path("checkpoint.h5"), ends_with=2)
        other = pulmo.finished(options + ["-restart", failed.path("checkpoint.h5")])
        self.expect_same(pulmo.finished(options), other, SAME_RANKS)


    def test_failed_again_at_once(self):
        """A run that fails within its first breath, and once more with the first step after the restart: that breath is not whole."""
        scene = pulmo.BLOCK + pulmo.DIRECT + pulmo.QUIET + [
            "-tissue", "patte", "-airflow", "-airflow_permeability", "100", "-airflow_surfaces", "x1", "-chest_wall", "-chest_wall_surfaces",
            "x0,y0,y1,z0,z1", "-ventilator", "pcv", "-ventilator_pip", "400", "-ventilator_ramp", "0.3", "-ts_dt", "0.1", "-energy_audit", "off"]
        first = pulmo.Case(scene)
        again = pulmo.Case(scene + ["-restart", first.path("checkpoint.h5")])
        one, two = (case.json("failure.json") for case in (first, again))
        self.assertEqual(two["end_time_s"], one["end_time_s"], "no step was accepted")
        for key in ("why_no_numbers", "breaths", "tidal_volume_ml", "numbers_of_breath"):
            self.assertEqual(two.get(key), one.get(key), key)
        self.assertIn("within its first breath", one["why_no_numbers"])


class BadFiles(RestartCase):
    @classmethod
    def setUpClass(cls):
        cls.good = pulmo.finished(PCV + ["-checkpoint_every", "0.1", "-ts_max_time", "0.4"]).path("checkpoint.h5")
        with open(cls.good, "rb") as f:
            cls.image = f.read()

    def refused(self, path, *words, options=(), ranks=1):
        case = pulmo.Case(PCV + ["-restart", path] + list(options), ranks=ranks)
        self.expect_error(case.code, case.err, "-restart", *words)
        self.assertFalse(os.path.exists(case.directory), "something was touched")

    def file(self, content):
        path = pulmo.scratch("spoilt.h5")
        with open(path, "wb") as f:
            f.write(content)
        return path

    def changed(self, change):
        path = self.file(self.image)
        with h5py.File(path, "r+") as f:
            change(f)
        return path

    def test_no_checkpoint(self):
        self.refused("/nowhere/checkpoint.h5", "/nowhere/checkpoint.h5", "no such file")
        self.refused(pulmo.SOURCE, "no such file")
        for ranks in (1, 2):
            self.refused(self.file(b"volume_ml\n1\n"), "no HDF5 file", ranks=ranks)
        foreign = pulmo.scratch("foreign.h5")
        with h5py.File(foreign, "w") as f:
            f["state/displacement"] = np.zeros((231, 3))
        self.refused(foreign, "no checkpoint of pulmo")

    def test_truncated(self):
        for length in (0, 7, 100, len(self.image) // 2, len(self.image) - 1):
            with self.subTest(length):
                word = "no HDF5 file" if length < 8 else "truncated or damaged"
                self.refused(self.file(self.image[:length]), word, ranks=2 if length == 100 else 1)

    def test_spoilt(self):
        with h5py.File(self.good) as f:
            written = int(f.attrs["pulmo_checkpoint"])

        for other in (written - 1, written + 1):
            def reformat(f):
                f.attrs.modify("pulmo_checkpoint", np.int32(other))
            self.refused(self.changed(reformat), f"has format {other}", f"reads format {written}")
        for name in ("signals", "state/pressure", "scalars"):
            with self.subTest(name):
                def drop(f):
                    del f[name]
                self.refused(self.changed(drop), f"'{name}' is damaged or missing", ranks=2 if name == "signals" else 1)

        def shorten(f):
            values = f["state/displacement"][:-1]
            del f["state/displacement"]
            f["state/displacement"] = values
        self.refused(self.changed(shorten), "'state/displacement' is damaged or missing")
        with h5py.File(self.good) as f: # a bit of one displacement
            place = f["state/displacement"].id.get_chunk_info(0).byte_offset + 1000
        spoilt = bytearray(self.image)
        spoilt[place] ^= 4
        self.refused(self.file(bytes(spoilt)), "'state/displacement' is damaged or missing")

    def test_another_run(self):
        for options, words in (
                (["-mesh_scale", "1.0000001"], ["of another mesh", "-mesh_scale"]),
                (["-dm_plex_filename", pulmo.mesh("cube_msh41_ascii.msh"), "-mesh_scale", "10"],
                 ["of another mesh", "45 vertices", "14 vertices"]),
                (["-tissue", "ma"], ["of another scene", "-tissue is 'birzle', here 'ma'"]),
                (["-tissue_beta", "1.1"], ["of another scene", "-tissue_beta is '1.075', here '1.1'"]),
                (["-tube", "-tube_k1", "1"], ["of another scene", "-tube is 'off'"]),
                (["-airflow", "off"], ["of another scene", "-airflow"]),
                (["-energy_audit", "off"], ["of another scene", "-energy_audit"]),
                (["-elements", "P1-P1"], ["of another scene", "-elements is 'P2-P1', here 'P1-P1'"]),
                (["-quadrature_degree", "4"], ["of another scene", "-quadrature_degree"]),
                (["-ventilator_pip", "7"], ["of another scene", "phase 1", "inspiration"]),
                (["-ventilator_expiration", "0.4"], ["of another scene", "phase 2", "expiration", "0.3 to 0.6 s"]),
                (["-ventilator", "off"], ["of another scene", "-ventilator"]),
                (["-ts_max_time", "0.4"], ["nothing is left to run", "-ts_max_time"])):
            with self.subTest(" ".join(options)):
                self.refused(self.good, *words, options=options)
        # the same in other words
        same = ["-airflow_permeability", "10000.0", "-chest_wall", "true", "-ts_max_time", "0.45"]
        pulmo.finished(PCV + same + ["-restart", self.good])

    def test_options(self):
        case = pulmo.Case(PCV + ["-checkpoint_every", "-1"])
        self.expect_error(case.code, case.err, "-checkpoint_every", ">= 0")
        helped = pulmo.Case(["-help"], directory="-")
        for name in ("-checkpoint_every", "-restart"):
            self.assertIn(name, helped.out)


if __name__ == "__main__":
    pulmo.main()
