"""Random scenes over all that the program offers, each with two files of solvers: a run finishes, or it stops with a reason that the
other solver agrees with.

Scenes are those of fuzz.py, and on top any other effect, law of permeability, elements, time scheme and restarts. Seeds are
independent of each other: they can be run in parts, and a part goes on where it stopped.
"""
import collections
import json
import random
import re
import shutil
import time

import numpy as np

from . import fuzz
from .fuzz import between
from .lab import Lab, first_sentence, pulmo

common = pulmo.common

TISSUE = ("airway rim", "everywhere", "inside")  # of failure.json: reasons that lie in the tissue, and not in the solver
NO_ROWS = ("refused", "before the start")  # -prestress finds no unloaded lung
SAME = 2e-3  # of the largest value: two solvers, each with its own tolerance, over the same steps
SAME_STEPS = 1e-5  # the same solver, from a checkpoint
OTHER_STEPS = 0.05  # steps that were cut at other places
LONGEST = 120  # s of a run
RANDOM = 1000003  # scenes that are not those of fuzz.py


def airway_tree(dice, scene):
    split = "-ventilator_flow_split"  # uniform in paper.opts; a tree shares the flow itself
    if split in scene.options:
        scene.options[scene.options.index(split) + 1] = "common_pressure"
    else:
        scene.options += [split, "common_pressure"]
    return ["-airway_tree", "star", "-airway_tree_resistance", between(dice, 0.1, 50)]


def direction(dice):
    return ",".join(f"{dice.uniform(-1, 1):.3f}" for _ in range(3))


# what brings an effect into a scene; those of fuzz.scene bring themselves
DRAWN = {
    "airway_tree": airway_tree,
    "breathing_effort": lambda dice, scene: [
        "-breathing_effort", "-breathing_effort_pressure", between(dice, 0.3, 8), "-breathing_effort_rise", between(dice, 0.05, 0.3),
        "-breathing_effort_hold", 0.05, "-breathing_effort_fall", between(dice, 0.05, 0.2), "-breathing_effort_period", 0.7],
    "cavity": lambda dice, scene: ["-cavity", "-cavity_gap", between(dice, 0.01, 0.3) * scene.length, "-cavity_stiffness",
                                   between(dice, 1, 50) / scene.length, "-cavity_onset", 0.005 * scene.length],
    "gravity": lambda dice, scene: ["-gravity", "-gravity_direction", direction(dice)],
    "inertia": lambda dice, scene: ["-inertia"],
    "pressure_damping": lambda dice, scene: ["-pressure_damping"],
    "prestress": lambda dice, scene: ["-prestress", "-prestress_pressure", between(dice, 0.3, 5)],
    "recruitment": lambda dice, scene: [
        "-recruitment", "-recruitment_opening_pressure", between(dice, 2, 15), "-recruitment_closing_pressure", between(dice, 0.3, 2),
        "-recruitment_gain", between(dice, 0.05, 0.6), "-recruitment_start", f"{dice.random():.3f}"],
    "surfactant": lambda dice, scene: ["-surfactant", "-surfactant_area", between(dice, 1, 30)],
    "traction": lambda dice, scene: ["-traction", "-traction_surfaces", "airway", "-traction_value",
                                     ",".join(f"{dice.uniform(-0.1, 0.1):.3f}*t" for _ in range(3))],
    "viscoelastic": lambda dice, scene: ["-viscoelastic", "-viscoelastic_moduli", between(dice, 0.05, 1), "-viscoelastic_times",
                                         between(dice, 0.03, 3)],
}
OF_BASE = ("tissue", "airflow", "ventilator", "chest_wall", "lumen_pressure", "support", "tube")
NEED_AIRFLOW = ("airway_tree", "pressure_damping")


class Scene:
    """Options without those of the solver, two files of solvers, ranks, and whether a restart is tried."""

    def __init__(self, seed, laws, small):
        dice = random.Random(RANDOM + seed)
        options, self.ranks, _ = fuzz.scene(dice, laws)
        while small and any(str(o).endswith("lung_test.msh") for o in options):
            options, self.ranks, _ = fuzz.scene(dice, laws)
        self.seed, self.solver, self.options = seed, re.search(r"(\w+)\.opts", options[1]).group(1), options[2:]
        self.law = self.after("-tissue")
        self.length = 10 * float(self.after("-mesh_scale")) if not str(self.after("-dm_plex_filename")).endswith("lung_test.msh") else 100
        # iterative.opts is not made for a law without shear stiffness at rest
        self.other = "direct" if self.solver == "iterative" else "reuse" if self.law == "rausch" and self.solver == "direct" else \
            "direct" if self.law == "rausch" else "iterative"
        airflow, self.effects = "-airflow" in self.options, []
        for name in DRAWN:
            if dice.random() < 0.15 and (airflow or name not in NEED_AIRFLOW):
                self.options += DRAWN[name](dice, self)
                self.effects.append(name)
        if airflow and dice.random() < 0.4:
            self.options += ["-airflow_permeability_law", dice.choice(list(common.offered(pulmo.PROGRAM, "permeability")))]
        if dice.random() < 0.2:
            self.options += ["-elements", dice.choice(["P1-P1", "P1-P1", "P1-P1" if small else "P3-P2"])]
        if dice.random() < 0.2:
            self.options += ["-ts_type", "bdf"]
        if dice.random() < 0.1:
            self.options += ["-step_J_change", dice.choice([0.1, 0.3])]
        self.restarts, self.checkpoint = dice.random() < 0.2, 0.45  # s: one before the end
        if small:  # half of the time, and failures that try fewer steps
            self.options += ["-ts_max_time", 0.45, "-ts_adapt_dt_min", 1e-3]
            self.checkpoint = 0.25

    def after(self, name):
        return self.options[self.options.index(name) + 1]

    def called(self, solver):
        return pulmo.options_file(f"solvers/{solver}.opts") + self.options


class End:
    """How a run ended: kind is finished, refused, or of a run that stopped where it did."""

    def __init__(self, run):
        self.run, self.sentence = run, first_sentence(run.err)
        self.kind = "finished" if run.finished else "refused" if run.code == 1 else "before the start" if (
            "failure.json" not in run.files()) else run.json("failure.json")["diagnosis"]["where"]
        if self.kind not in NO_ROWS:
            self.rows = run.signals(run.signals_file)
            self.time = float(self.rows["time_s"][-1])

    def far(self, other):
        """By how much of the largest value volume and pressure differ: over the same steps, or else at the end; and whether the steps were
        the same."""
        same = len(self.rows["time_s"]) == len(other.rows["time_s"]) and np.allclose(self.rows["time_s"], other.rows["time_s"], rtol=1e-9)
        worst = 0.0
        for column in ("volume_ml", "airway_pressure_cmH2O"):
            a, b = self.rows[column], other.rows[column]
            difference = np.abs(a - b).max() if same else abs(a[-1] - b[-1])
            worst = max(worst, difference / max(np.abs(a).max(), 1e-9))
        return worst, same


def disagreement(a, b):
    """What two solvers do not agree on; empty if they do."""
    if a.kind == b.kind and a.kind in NO_ROWS:
        return "" if a.sentence.split(":")[0] == b.sentence.split(":")[0] else f"two reasons: {a.sentence[:100]} | {b.sentence[:100]}"
    if a.kind == b.kind == "finished":
        far, same = a.far(b)
        return "" if far < (SAME if same else OTHER_STEPS) else f"both finish, {far:.2g} apart ({'same' if same else 'other'} steps)"
    if a.kind != b.kind and {a.kind, b.kind} & {"finished", *NO_ROWS}:
        return f"{a.kind} | {b.kind}: {(a.sentence or b.sentence)[:120]}"
    if a.kind not in TISSUE or b.kind not in TISSUE:
        return f"stopped in the solver: {a.kind} at {a.time:.4g} s | {b.kind} at {b.time:.4g} s: {a.sentence[:100]}"
    apart = abs(a.time - b.time)
    return "" if apart < 0.05 + 0.1 * max(a.time, b.time) else f"{a.kind} at {a.time:.4g} s | {b.kind} at {b.time:.4g} s"


def run_seed(lab, seed, laws):
    """What became of a seed: a row for the table."""
    scene, start = Scene(seed, laws, lab.small), time.monotonic()
    row = {"seed": seed, "law": scene.law, "effects": scene.effects, "solvers": [scene.solver, scene.other], "ranks": scene.ranks,
           "kinds": [], "fault": "", "disagreement": ""}
    folders = []

    def run(solver, more=(), ranks=scene.ranks):
        done = lab.run(scene.called(solver) + list(more), ranks=ranks, timeout=LONGEST, sound=False)
        folders.append(done.directory)
        fault = lab.fault(done)
        if not fault and done.code == 2 and "What to try: " not in done.err:
            fault = "stopped without saying what to try: " + first_sentence(done.err)[:200]
        if fault:
            raise AssertionError(f"{solver}: {fault}")
        return End(done)

    try:
        first = run(scene.solver, ["-checkpoint_every", scene.checkpoint] if scene.restarts else [])
        row["kinds"].append(first.kind)
        row["said"] = first.sentence[:200]
        if not lab.small or first.kind != "finished":
            second = run(scene.other)
            row["kinds"].append(second.kind)
            row["disagreement"] = disagreement(first, second)
        if scene.restarts and first.kind == "finished":
            # where the end cuts the last step, the only one is of the state before
            name = "checkpoint_previous.h5" if "checkpoint_previous.h5" in first.run.files() else "checkpoint.h5"
            rest = run(scene.solver, ["-restart", first.run.path(name)], 3 - scene.ranks)
            if rest.kind != "finished":
                raise AssertionError(f"a restart ends otherwise: {rest.kind}: {rest.sentence[:150]}")
            row["restart"] = far = max(
                abs(rest.rows[c][-1] - first.rows[c][-1]) / max(np.abs(first.rows[c]).max(), 1e-9)
                for c in ("volume_ml", "airway_pressure_cmH2O"))
            if far > SAME_STEPS:
                row["fault"] = f"a restart on {3 - scene.ranks} ranks ends {far:.2g} away"
    except AssertionError as error:
        row["fault"] = str(error).split(": /")[0].splitlines()[0][:300]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    row["seconds"] = round(time.monotonic() - start, 2)
    return row


def not_drawn():
    """Effects of the program that no scene has."""
    return [e for e in common.offered(pulmo.PROGRAM, "effect") if e not in DRAWN and e not in OF_BASE]


def run_range(program, begin, end, kept, state, small=False):
    """Rows of the seeds from `begin` to before `end`; those that the file `kept` has of the same state are not made anew."""
    lab = Lab(program, small)
    rows = {}
    if kept and kept.exists():
        rows = {row["seed"]: row for row in map(json.loads, kept.read_text().splitlines()) if row["state"] == state}
    laws = [law for law in pulmo.tissue_laws() if not (small and law == "concha")]  # its failures take a minute
    for seed in range(begin, end):
        if seed not in rows:
            rows[seed] = run_seed(lab, seed, laws) | {"state": state}
            if kept:
                with open(kept, "a") as file:
                    file.write(json.dumps(rows[seed]) + "\n")
            for what in ("fault", "disagreement"):
                if rows[seed][what] and not small:
                    print(f"seed {seed}: {what}: {rows[seed][what]}", flush=True)
    return [rows[seed] for seed in range(begin, end)]


def told(program, begin, end, kept, state):
    """Runs seeds, prints what became of them, and gives the exit code: 1 if there is a fault or a disagreement."""
    pulmo.PROGRAM = str(program)
    kept.parent.mkdir(parents=True, exist_ok=True)
    rows = run_range(program, begin, end, kept, state)
    for kinds, count in collections.Counter(" | ".join(row["kinds"]) for row in rows).most_common():
        print(f"{count:6} {kinds or 'no end'}")
    restarts = [row["restart"] for row in rows if "restart" in row]
    faults, differ = (sum(bool(row[what]) for row in rows) for what in ("fault", "disagreement"))
    print(f"{len(rows)} seeds, {len(restarts)} with a restart; {faults} faults, {differ} on which two solvers do not agree; in {kept}")
    return int(faults + differ > 0)
