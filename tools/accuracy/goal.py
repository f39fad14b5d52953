"""Answers a question by sweeps: each run tells its error in time and in space, and what is cheapest to change comes next."""
import argparse
import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import runs
from shared.common import fail, processor
from shared.keys import make_mesh

from . import page, settings
from .numbers import SHORT, file_name, percent, short

FIRST_SIZE = 30                 # mm, of the built-in lungs
FIRST_STEP = 0.05               # s
FINER = (0.9, 0.82, 0.75, 0.68, 0.62, 0.56, 0.5, 0.45, 0.4, 0.35, 0.3, 0.25)  # what sizes of cells may be changed by at once
SHORTER = (0.9, 0.75, 0.6, 0.5, 0.35, 0.25, 0.18, 0.125)                       # and steps
ORDER_IN_SPACE = 1.5            # of a number in the size of the cells, until two meshes tell
ORDERS_BELIEVED = (1.0, 3.0)    # what two meshes may tell
ROWS, BDF2 = 1.0, 0.3           # order of the sums over rows; share of the steps' part that BDF2 leaves at first
COST_OF_BDF2 = 1.3              # of a step
GROWTH = 1.1                    # exponent of the cost of a step over cells
MARGIN = 0.8                    # a prediction aims at so much of what is allowed
TELLING = 0.76                  # sizes of cells that tell of their facets: of two nearer ones the difference is doubtful
STAKE = 0.6                     # of what the budget leaves, for a run that does not promise the answer
MOST_RUNS = 12
UNSTEADY = 0.25                 # of what is asked: more that further breaths change is told
# numbers that a sweep knows, and of its bars (pulmo/observers/error_bars.hpp): what richer elements see of the error in space, the bar of a
# corrected value over its parts, the largest share that is resolved
SWEPT = {**SHORT, "plateau_pressure_cmH2O": "P_plat", "peak_expiratory_flow_ml_per_s": "Q_exp", "work_j": "work"}
SEEN, FACTOR, LARGEST = 0.75, 0.5, 0.1
EARLY, FEW = "phase_ended_early", "few_steps_in_a_phase"  # of "not_resolved_because" (pulmo/observers/error_bars.hpp)


@dataclass(frozen=True)
class Choice:
    """A setting. size: of the cells, mm, or over that of a mesh from a file. field: errors.xdmf that they follow; mesh: a file that is there, or was
    the first; refined: as a whole."""
    size: float
    dt: float
    scheme: str = "beuler"
    field: str = ""
    mesh: str = ""
    refined: int = 0

    @property
    def name(self):
        if self.mesh:
            what = Path(self.mesh).stem + (f" refined {self.refined} x" if self.refined else "") + (
                f", cells cut to {self.size ** -3:.2g} times as many" if self.field else "")
        else:
            what = f"size {self.size:.3g} mm"
        what += ", by the errors of the run before" if self.field else ""
        return f"{what} | {settings.Steps(self.scheme, self.dt).name}"


@dataclass
class Outcome:
    choice: Choice
    run: dict
    parts: dict  # number -> what the sweep says of it
    mesh: str

    @property
    def cells(self):
        return self.run["summary"]["cells"]

    def corrected(self, key):
        """The value with all that it lacks, resolved or not."""
        part = self.parts[key]
        lacks = part["lacks"]
        return part["value"] + lacks["steps"] + lacks["rows"] + lacks["solver"] + (lacks["flow_in_space"] + lacks["tissue_in_space"]) / SEEN


def can_be_cut(path):
    """Whether tools/lung_mesh --refine keeps all of a mesh; if not, says why."""
    from meshing.mesh import MeshError  # gmsh takes its time
    from meshing.refine import named_mesh
    try:
        named_mesh(path)
    except MeshError as error:
        print(f"finer meshes are {path} refined as a whole: {error}", flush=True)
        return False
    return True


class Goal:
    """The search for a run whose corrected values have bars within what is asked: number -> share."""

    def __init__(self, asked, scene, options):
        self.asked, self.scene, self.options = asked, scene, options
        self.spent, self.outcomes, self.refused = 0.0, [], ""
        self.made, self.adapt = set(), options.adapt
        if unknown := [key for key in asked if key not in SWEPT]:
            fail(f"--method sweep has no error of {', '.join(map(short, unknown))}; it has {', '.join(map(short, SWEPT))}")

    # ------------------------------------------------------------ runs

    def words(self, choice, mesh):
        o = self.options
        start = [] if o.ranks == 1 else [*o.launcher.split(), str(o.ranks)]
        return [*start, o.build / "pulmo", *self.scene, "-options_file", str(self.solver()), *o.flags, *self.chosen(choice, mesh),
                "-error_estimate_method", "sweep"]

    def solver(self):
        return settings.solvers(self.options)[0].file

    def chosen(self, choice, mesh):
        """The options of a choice."""
        return ["-dm_plex_filename", str(mesh), *(["-dm_refine", str(choice.refined)] if choice.refined else []),
                *(["-elements", self.options.elements[0]] if self.options.elements[0] else []),
                *settings.Steps(choice.scheme, choice.dt).words(0, 0), "-error_estimate",
                "-error_estimate_numbers", ",".join(SWEPT[key] for key in self.asked)]

    def mesh(self, choice):
        if self.outcomes and replace(choice, dt=self.last.choice.dt, scheme=self.last.choice.scheme) == self.last.choice:
            return self.last.mesh
        if choice.mesh and not choice.field:
            return choice.mesh
        folder = self.options.results / "meshes"
        if not choice.field:
            path, seconds = settings.lung(choice.size, folder.parent, self.options.clock)
            self.spent += 0 if path in self.made else seconds
            self.made.add(path)
            return path
        cells = round(self.last.cells * (self.last.choice.size / choice.size) ** 3)
        path = folder / f"goal_{Path(choice.field).parent.parent.name}_{cells}.msh"
        with settings.Clock(self.options.clock) as clock:
            start = ["--refine", self.last.mesh] if choice.mesh else ["--side", "both"]
            make_mesh(path, "lung_mesh", [*start, "--size-field", choice.field, "--cells", cells])
        self.spent += clock.seconds
        return path

    def attempt(self, choice):
        """Runs a choice; True if it is done."""
        print(f"[{len(self.outcomes) + 1}] {choice.name}: " + (f"about {self.predict(choice):.0f} s, " if self.outcomes else "")
              + f"{max(0, self.options.budget - self.spent):.0f} of {self.options.budget:.0f} s left", flush=True)
        mesh = self.mesh(choice)
        longest = max(1.0, self.options.budget - self.spent) * (1 if self.options.clock == "wall" else 4)
        run = runs.measured([*self.words(choice, mesh), "-output_dir"], self.options.results / "runs", 0, self.options.ranks, longest)
        self.spent += run[self.options.clock]
        if run["code"]:
            self.refused = run["reason"]
            print(f"    failed: {run['reason']}", flush=True)
            return False
        estimate = run["summary"].get("error_estimate") or {}
        if lacking := [short(key) for key in self.asked if key not in estimate.get("numbers", {})]:
            fail(f"the scene has no {', '.join(lacking)}" + (f": {estimate['failure']}" if "failure" in estimate else ""))
        self.outcomes.append(Outcome(choice, run, estimate["numbers"], mesh))
        for key in self.asked:
            print(f"    {self.value(key)}", flush=True)
        return True

    @property
    def last(self):
        return self.outcomes[-1]

    def geometry(self, key):
        """What the shape of the cells' facets makes a number wrong by: meshes that follow the body anew differ in it, and their corrected
        values in nothing else. Of order 2; infinite after one mesh. Of a mesh from a file the facets are the body; but by what the
        corrected value of the mesh before differs, if that was resolved, the estimates that cells are cut by may be off."""
        now = self.last
        if now.choice.mesh:
            before = next((o for o in reversed(self.outcomes[:-1]) if o.choice.size > 1.05 * now.choice.size), None)
            told = now.choice.field and before and before.parts[key]["corrected"] is not None
            return abs(now.corrected(key) - before.corrected(key)) if told else 0.0
        before = next((o for o in reversed(self.outcomes[:-1]) if o.choice.size > 1.05 * now.choice.size), None)
        if not before:
            return math.inf
        ratio = (now.choice.size / before.choice.size) ** 2
        return abs(now.corrected(key) - before.corrected(key)) * ratio / (1 - ratio)

    def bar(self, key):
        """Of the corrected value, with the facets; infinite where a part is not resolved."""
        error = self.last.parts[key]["corrected_error"]
        return math.inf if error is None else math.hypot(error, self.geometry(key))

    def share(self, key):
        return self.bar(key) / abs(self.last.corrected(key))

    def value(self, key):
        """C_rs = 82.3 +- 0.6, in words."""
        part = self.last.parts[key]
        if part["corrected"] is None:
            return f"{short(key)} = {part['value']:.5g}, not resolved: {part['not_resolved']}"
        if math.isinf(self.bar(key)):
            return f"{short(key)} = {part['corrected']:.5g} ± {part['corrected_error']:.2g} on these facets; another mesh tells what they make of the body"
        return f"{short(key)} = {part['corrected']:.5g} ± {self.bar(key):.2g} ({100 * self.share(key):.2g} %; the run itself has {part['value']:.5g})"

    # ------------------------------------------------------------ what comes next

    def order_in_space(self, key):
        """Of a number in the size of the cells, by the last two runs that differ in it."""
        now = self.last
        before = next((o for o in reversed(self.outcomes[:-1]) if o.cells < 0.9 * now.cells), None)
        if not before:
            return ORDER_IN_SPACE
        a, b = (sum(abs(o.parts[key]["lacks"][part]) for part in ("flow_in_space", "tissue_in_space")) for o in (before, now))
        if min(a, b) <= 0:
            return ORDER_IN_SPACE
        return min(max(math.log(a / b) / math.log((now.cells / before.cells) ** (1 / 3)), ORDERS_BELIEVED[0]), ORDERS_BELIEVED[1])

    def promised(self, key, choice):
        """The share that the bar of a number would have by what the last run tells."""
        part, now = self.last.parts[key], self.last.choice
        lacks, finer, shorter = part["lacks"], choice.size / now.size, choice.dt / now.dt
        steps = abs(lacks["steps"]) * shorter ** settings.ORDERS[choice.scheme] * (1 if choice.scheme == now.scheme else BDF2)
        time = steps + abs(lacks["rows"]) * shorter ** ROWS
        space = (abs(lacks["flow_in_space"]) + abs(lacks["tissue_in_space"])) / SEEN * finer ** self.order_in_space(key)
        value, geometry = self.last.corrected(key), self.geometry(key)
        if math.isinf(geometry) and finer > TELLING:
            return math.inf
        geometry = 0 if math.isinf(geometry) else geometry * finer ** 2
        if FEW in part["not_resolved_because"] and shorter > 0.5:
            return math.inf
        if max(time, space) > LARGEST * abs(value):
            return math.inf
        error = FACTOR * (time + (1 + space / abs(value)) * space) + abs(lacks["solver"])
        return math.hypot(error, geometry) / abs(value)

    def predict(self, choice):
        """Seconds of a choice with its sweep, by the last run."""
        if not self.outcomes:
            return 0.0
        now = self.last
        work = (now.choice.size / choice.size) ** (3 * GROWTH) * now.choice.dt / choice.dt
        scheme = COST_OF_BDF2 if choice.scheme != now.choice.scheme else 1
        return now.run[self.options.clock] * work * scheme

    def next(self):
        """The cheapest choice that promises what is asked, or else the one that comes nearest to it; None: the budget has none."""
        now = self.last.choice
        field = ""
        if self.adapt:
            field = str(self.last.run["folder"] / "run" / "errors.xdmf")
        found = []
        for finer in (1, *FINER):
            if now.mesh and not self.adapt:
                level = round(-math.log2(finer))
                if abs(2.0 ** -level - finer) > 1e-9:
                    continue
                there = replace(now, refined=now.refined + level, size=now.size * finer)
            else:
                there = replace(now, size=now.size * finer, field=field if finer < 1 else now.field)
            for shorter in (1, *SHORTER):
                for scheme in dict.fromkeys((now.scheme, "bdf")):
                    choice = replace(there, dt=now.dt * shorter, scheme=scheme)
                    if choice != now:
                        found.append(choice)
        left = self.options.budget - self.spent
        found = [c for c in found if self.predict(c) <= left]
        worst = {c: max(self.promised(key, c) / (MARGIN * share) for key, share in self.asked.items()) for c in found}
        if met := [c for c in found if worst[c] <= 1]:
            return min(met, key=self.predict)
        near = [c for c in found if self.predict(c) <= STAKE * left]
        if told := [c for c in near if math.isfinite(worst[c])]:
            return min(told, key=lambda c: worst[c])
        # what is not resolved tells no more than that both have to be finer
        return min((c for c in near if c.size >= now.size / 2 - 1e-9 and c.dt >= now.dt / 2 - 1e-9),
                   key=lambda c: (max(c.size / now.size, c.dt / now.dt), c.size * c.dt), default=None)

    def met(self):
        return bool(self.outcomes) and all(self.share(key) <= share for key, share in self.asked.items())

    def solve(self):
        """Runs until the bars are within what is asked, or the budget is used. False: no sweep is possible here."""
        o = self.options
        dt = o.dt or max(FIRST_STEP, float(settings.of_files([*self.scene, *o.flags], "-ts_dt", "0")))
        if o.meshes or settings.of_files([*self.scene, *o.flags], "-dm_plex_filename") and not o.lung:
            path = str((o.meshes or [settings.of_files([*self.scene, *o.flags], "-dm_plex_filename")])[0])
            choice = Choice(1.0, dt, mesh=path)
            self.adapt = self.adapt and can_be_cut(path)
        else:
            choice = Choice(max(o.lung or [FIRST_SIZE]), dt)
        while self.attempt(choice):
            if any(EARLY in self.last.parts[key]["not_resolved_because"] for key in self.asked):
                self.refused = "-error_estimate_method sweep has no error in time where a phase ends early; ladders may take over (--method ladder)"
                return False
            if self.met() or len(self.outcomes) >= MOST_RUNS:
                return True
            choice = self.next()
            if not choice:
                print("what is finer would take more than the budget leaves", flush=True)
                return True
        return bool(self.outcomes)

    def sentences(self):
        texts = []
        for key, share in self.asked.items():
            texts.append(f"{'' if self.met() else 'NOT within ' + percent(share) + ': '}{self.value(key)}; {self.last.run[self.options.clock]:.3g} s "
                         f"with its sweep, {self.spent:.3g} s in all ({self.options.clock})")
        return texts + self.unsteady() + self.cost_of_a_tenth()

    def unsteady(self):
        """What the bars do not count: breaths that are not periodic yet."""
        texts = []
        for key, share in self.asked.items():
            more = self.last.parts[key].get("more_breaths")
            if not more:
                continue
            change = more["next"] if more["periodic"] is None else more["periodic"]
            if abs(change) > UNSTEADY * share * abs(self.last.corrected(key)):
                until = "with one more breath" if more["periodic"] is None else "until breaths are periodic"
                texts.append(f"{short(key)} changes by {change:+.2g} {until}, which is in no bar: give the scene more breaths")
        return texts

    def cost_of_a_tenth(self):
        """What the tenth of each share would take."""
        further = copy.copy(self)
        further.asked = {key: share / 10 for key, share in self.asked.items()}
        further.options = argparse.Namespace(**{**vars(self.options), "budget": math.inf})
        choice = further.next()
        if not choice or any(further.promised(key, choice) > share for key, share in further.asked.items()):
            return []
        what = ", ".join(f"{short(key)} within {percent(share)}" for key, share in further.asked.items())
        return [f"{what} would take about {further.predict(choice):.2g} s ({choice.name})"]

    def write(self, command):
        """The folder: README.md and, where the question is answered, the options of the last run."""
        folder, share = self.options.output, max(self.asked.values())
        for old in folder.glob("recommended_*.opts"):
            old.unlink()
        sentences = self.sentences()
        lines = ["# What accuracy costs", "", f"    {command}", "", *(f"- {text}" for text in sentences), "",
                 "Each run was followed by one sweep back over it (-error_estimate_method sweep), which tells its errors; value ± bar is the corrected value, on the facets of its mesh.",
                 "", "| setting | cells | steps | s | " + " | ".join(short(k) for k in self.asked) + " |", "|" + "---|" * (4 + len(self.asked))]
        for o in self.outcomes:
            cells = []
            for key in self.asked:
                p = o.parts[key]
                cells.append(f"{p['corrected']:.5g} ± {p['corrected_error']:.2g}" if p["corrected"] is not None else f"{o.corrected(key):.5g}, {p['not_resolved']}")
            lines.append(f"| {o.choice.name} | {o.cells} | {o.run['summary']['steps']} | {o.run[self.options.clock]:.3g} | " + " | ".join(cells) + " |")
        (folder / "README.md").write_text("\n".join(lines) + "\n")
        if self.met():
            page.write_setting(folder / file_name(share), self.asked, [
                f"corrected value and bar of a run with its sweep, found by\n#   {command}", self.last.choice.name,
                f"{self.last.run['cpu']:.3g} s CPU, {self.last.run['wall']:.3g} s wall, {self.last.run['memory']:.0f} MB on {processor()}"],
                self.solver(), self.options.flags, self.chosen(self.last.choice, self.last.mesh))
        print(f"wrote {folder / 'README.md'}\n")
        return sentences

