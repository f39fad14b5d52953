"""Makes the runs that are not there yet: meshes, the program, progress, keys of what is done."""
import math
import os
import subprocess
import time

from shared import keys
from shared.common import SOURCE, environment

from .messages import say
from .outcome import read_json, reason

SOLVER = "petsc_options/solvers/reuse.opts"


class Workshop:
    """Carries out runs: makes meshes, starts the program, remembers what is done."""

    def __init__(self, folder, program, plan, jobs):
        self.folder, self.program, self.plan, self.jobs = folder, program, plan, jobs

    def directory(self, run):
        return self.folder / run.name

    def mesh(self, name):
        """Path of a mesh of the plan, made by tools/lung_mesh where the plan gives its arguments."""
        what = self.plan.meshes[name]
        if not what.startswith("--"):
            return SOURCE / what
        path = self.folder / f"lung_{name}.msh"
        keys.make_mesh(path, "lung_mesh", what.split())
        return path

    def fingerprint(self, run):
        """Of all that a run depends on: program, options, mesh, what the option files say and name, environment."""
        return keys.digest(self.command(run), directory=SOURCE)

    def done(self, run):
        """Whether the run has an outcome: finished, or stopped by the model."""
        where = self.directory(run)
        return (any((where / name).exists() for name in ("summary.json", "failure.json"))
                and (where / "run.json").exists() and (where / "run.json").read_text() == self.fingerprint(run))

    def command(self, run):
        return [str(self.program), "-dm_plex_filename", str(self.mesh(run.mesh)),
                "-options_file", SOLVER, *run.options,
                "-output_dir", str(self.directory(run)), "-output_overwrite"]

    def start(self, run):
        where = self.directory(run)
        where.mkdir(parents=True, exist_ok=True)
        for old in ("summary.json", "failure.json"):
            (where / old).unlink(missing_ok=True)
        (where / "run.json").write_text(self.fingerprint(run))
        with open(where / "log.txt", "w") as log:
            return subprocess.Popen(self.command(run), cwd=SOURCE, env=environment(), stdout=log, stderr=subprocess.STDOUT)

    def effort(self, run):
        """Cost of a run in arbitrary units: steps times the size of the mesh."""
        return run.duration / run.dt * self.mesh(run.mesh).stat().st_size

    def reached(self, run):
        """Share of a running run that is done, from the signals so far."""
        try:
            with open(self.directory(run) / "signals.csv.part", "rb") as f:
                f.seek(max(0, f.seek(0, os.SEEK_END) - 400))
                return min(1, float(f.read().splitlines()[-1].split(b",")[0]) / run.duration)
        except (OSError, ValueError, IndexError):
            return 0

    def carry_out(self, runs):
        """Run what has no outcome yet; returns the runs that went wrong (neither finished nor stopped by the model)."""
        waiting = [run for run in runs if not self.done(run)]
        if waiting:
            keys.lock(self.folder)
        say(f"{len(runs)} runs, {len(runs) - len(waiting)} of them done before")
        total, begin, spoken = sum(map(self.effort, waiting)), time.monotonic(), time.monotonic()
        number, finished, active, wrong = 0, 0.0, {}, []
        try:
            while waiting or active:
                while waiting and len(active) < self.jobs:
                    run = waiting.pop(0)
                    number += 1
                    active[run] = self.start(run)
                    say(f"run {number}: {run.name} ({run.duration:g} s of breathing)")
                time.sleep(0.2)
                for run, process in [(r, p) for r, p in active.items() if p.poll() is not None]:
                    del active[run]
                    finished += self.effort(run)
                    say(self.verdict(run, process.returncode))
                    if not self.done(run):
                        wrong.append(run)
                if time.monotonic() - spoken > 30:
                    spoken = time.monotonic()
                    share = (finished + sum(self.effort(r) * self.reached(r) for r in active)) / total
                    left = (spoken - begin) * (1 - share) / share if share > 0 else math.nan
                    say(", ".join(f"{r.name} {100 * self.reached(r):.0f} %" for r in active)
                        + f"; all {100 * share:.0f} %, about {left / 60:.0f} min left")
        finally:
            for process in active.values():
                process.terminate()
        return wrong

    def verdict(self, run, code):
        where = self.directory(run)
        if (where / "summary.json").exists():
            numbers = read_json(where / "summary.json")
            return f"{run.name} finished in {numbers['wall_seconds']['total']:.0f} s"
        if (where / "failure.json").exists():
            return f"{run.name} stopped: {reason(read_json(where / 'failure.json'))}"
        tail = (where / "log.txt").read_text(errors="replace").strip().splitlines()[-3:]
        return f"{run.name} FAILED with exit code {code}: " + " / ".join(tail)
