"""The runs of a ladder: their order, their predicted cost, the budget, what was left out and why."""
import math
import shlex
import statistics
from dataclasses import dataclass, field

from benchmarks import runs

from .numbers import clinical
from .settings import Setting

START = 6e-5  # s per cell and step before anything is measured
SETUP = 0.2   # s of a run that do not go with its cells and steps, at most half of the run
GROWTH = {"iterative": 1.1, "iterative_ml": 1.1, "iterative_hypre": 1.1}  # exponent of the cost of a step over cells
DIRECT = 1.5                                                             # of a factorisation
OF_ELEMENTS = {"P1-P1": 0.25, "P3-P2": 7}  # cost of a cell over that of P2-P1


@dataclass
class Run:
    """A finished run: results of its repeats, and what is taken of them."""
    setting: Setting
    results: list
    numbers: dict = field(default_factory=dict)

    @property
    def summary(self):
        return self.results[0]["summary"]

    @property
    def wall(self):
        return statistics.median(r["wall"] for r in self.results)

    @property
    def cpu(self):
        return statistics.median(r["cpu"] for r in self.results)

    @property
    def memory(self):
        return max(r["memory"] for r in self.results)

    @property
    def folder(self):
        return self.results[0]["folder"] / "run"


class Ladder:
    """Runs settings of a scene within a budget of seconds; finished ones by setting in `done`, others with the reason."""

    def __init__(self, axes, scene, flags, options, spent=0.0):
        self.axes, self.scene, self.flags, self.options = axes, scene, flags, options
        self.budget, self.spent = options.budget, spent
        self.done, self.failed, self.skipped = {}, {}, {}
        self.new = 0

    # ------------------------------------------------------------ cost

    def seconds(self, run):
        """What the budget counts of a run."""
        return getattr(run, self.options.clock)

    def steps_of(self, steps):
        """Steps of a level in time, measured or from the nearest level of its kind."""
        runs_of = {s.steps: run.summary["steps"] for s, run in self.done.items()}
        if steps in runs_of:
            return runs_of[steps]
        alike = [t for t in runs_of if bool(t.tolerance) == bool(steps.tolerance)]
        same = [t for t in alike if t.scheme == steps.scheme] or alike
        if not same:
            return runs_of[self.axes.base.steps] if runs_of else 3 / steps.dt
        near = min(same, key=lambda t: abs(math.log(t.dt / steps.dt)))
        return runs_of[near] * near.dt / steps.dt

    def predict(self, setting):
        """Seconds that a setting takes: what a cell and step took in the run nearest to it, growing with the cells."""
        work = self.steps_of(setting.steps) * setting.mesh.cells
        alike = [run for s, run in self.done.items() if s.solver == setting.solver] or list(self.done.values())
        alike = [run for run in alike if run.setting.mesh.elements == setting.mesh.elements] or alike
        if not alike:
            return START * work * self.options.repeat
        near = min(alike, key=lambda run: abs(math.log(run.setting.mesh.cells / setting.mesh.cells)) +
                   abs(math.log(run.summary["steps"] * setting.mesh.cells / work)))
        took = self.seconds(near)
        setup = min(SETUP, took / 2)
        rate = (took - setup) / near.summary["steps"] / near.setting.mesh.cells
        rate *= OF_ELEMENTS.get(setting.mesh.elements, 1) / OF_ELEMENTS.get(near.setting.mesh.elements, 1)
        exponent = GROWTH.get(setting.solver.file.stem, DIRECT) - 1
        return (setup + rate * work * (setting.mesh.cells / near.setting.mesh.cells) ** exponent) * self.options.repeat

    def left(self):
        return self.budget - self.spent

    # ------------------------------------------------------------ runs

    def command(self, setting):
        """Words of a run but for -output_dir; the same order as in the recommended file: scene, solver, flags, mesh, steps."""
        numbers = self.done[self.axes.base].numbers if setting.steps.tolerance else {}
        start = [] if self.options.ranks == 1 else [*shlex.split(self.options.launcher), str(self.options.ranks)]
        return [*start, self.options.build / "pulmo", *self.scene, "-options_file", str(setting.solver.file), *self.flags,
                *self.choice(setting, numbers)]

    def choice(self, setting, numbers):
        """The options of a setting beyond its solver file."""
        steps = setting.steps.words(numbers.get("tidal_volume_ml", 0), numbers.get("peak_inspiratory_pressure_cmH2O", 0))
        return [*setting.solver.more, *setting.mesh.words, *steps]

    def attempt(self, setting):
        """Runs a setting unless it was tried before; True if it is done."""
        if setting in self.done or setting in self.failed:
            return setting in self.done
        expected = self.predict(setting)
        print(f"[{len(self.done) + len(self.failed) + 1}] {setting.name}: about {expected:.0f} s, {max(0, self.left()):.0f} of "
              f"{self.budget:.0f} s left", flush=True)
        self.skipped.pop(setting, None)
        results = []
        for repeat in range(self.options.repeat):
            # a loaded machine's wall time may be several times the CPU time that is counted
            longest = max(1.0, self.left()) * (1 if self.options.clock == "wall" else 4)
            result = runs.measured([*self.command(setting), "-output_dir"], self.options.results / "runs", repeat,
                                   self.options.ranks, longest)
            self.new += not result["kept"]
            self.spent += result[self.options.clock]
            results.append(result)
            if result["code"]:
                self.failed[setting] = (result["reason"], sum(r[self.options.clock] for r in results))
                print(f"    failed: {result['reason']}", flush=True)
                return False
        numbers = clinical(results[0]["summary"])
        self.done[setting] = run = Run(setting, results, numbers)
        print(f"    {run.cpu:.1f} s CPU, {run.wall:.1f} s wall, {run.memory:.0f} MB"
              + (" (kept from an earlier call)" if results[0]["kept"] else ""), flush=True)
        return True

    def fits(self, setting, allowed=None):
        """Whether a setting is expected to end within what is left; else it is noted as skipped, for the page."""
        expected, left = self.predict(setting), self.left() if allowed is None else allowed - self.spent
        if expected <= left:
            return True
        self.skipped[setting] = f"predicted {expected:.0f} s, {max(0, left):.0f} s were left"
        return False

    def values(self, key):
        """A clinical number by setting."""
        return {setting: run.numbers[key] for setting, run in self.done.items() if key in run.numbers}
