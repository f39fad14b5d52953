"""One run as the page needs it: what its directory holds, read once, finished or not."""
import functools
import os
import re

from shared.signals import whole_rows

from . import fields
from .read import Missing, fail, numbers_of, read_scene, read_summary, signals_path


class Run:
    """`name` and `id` tell the runs of a page, `of` in number, apart; `state` is finished, failed or unfinished."""

    def __init__(self, directory, name, number, of):
        self.directory, self.name, self.id, self.of = directory, name, f"run{number + 1}", of
        self.signals = numbers_of(signals_path(directory))
        self.time = self.signals["time_s"]
        self.summary, self.unfinished = read_summary(directory, self.time[-1])
        self.state = "failed" if self.unfinished and self.summary else "unfinished" if self.unfinished else "finished"
        self.scene = read_scene(directory)
        self.options = self.summary.get("options") or self.scene.get("options") or {}
        self.sources = self.summary.get("option_sources") or self.scene.get("option_sources") or {}

    @property
    def moving(self):
        """Whether there is a step to draw."""
        return len(self.time) > 1

    @property
    def failure(self):
        """Why the run failed, without the list of all that was tried."""
        return re.sub(r" Tried .*?\. (?=Where: )", " ", self.summary.get("failure") or "It gave no reason.", flags=re.DOTALL)

    @functools.cached_property
    def energy(self):
        """Sums since t = 0, J: name without `_j` -> list; raises Missing."""
        path = os.path.join(self.directory, "energy.csv")
        if not os.path.exists(path):
            raise Missing("The directory has no energy.csv: the audit was off (-energy_audit off), or the time scheme is not backward Euler.")
        rows = whole_rows(path)
        try:
            table = {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else ())}
        except (TypeError, ValueError):
            raise Missing("energy.csv is damaged: a value is missing or not a number.") from None
        if len(table.get("time_s", ())) < 2:
            raise Missing("energy.csv holds no step.")
        return {name.removesuffix("_j"): values for name, values in table.items()}

    @functools.cached_property
    def fields(self):
        """Snapshots of the run; raises Missing."""
        return fields.Fields(self.directory)

    @functools.cached_property
    def breath(self):
        """The breath that the overall numbers are of; None without a complete one."""
        number = self.summary.get("numbers_of_breath")
        return self.summary["breaths"][number - 1] if number else None

    @functools.cached_property
    def moments(self):
        """[(what, snapshot)]: start, end of inspiration, end, each once, in order of time; raises Missing."""
        times = self.fields.times
        if self.breath:
            wanted = [("start of the breath", self.breath["start_s"]),
                      ("end of inspiration", self.breath["end_of_inspiration_s"]), ("end of the breath", self.breath["end_s"])]
        else:
            fullest = self.time[max(range(len(self.time)), key=lambda i: self.signals["volume_ml"][i])]
            wanted = [("first snapshot", times[0]), ("near the largest volume", fullest), ("last snapshot", times[-1])]
        found = []
        for what, t in wanted:
            snapshot = min(range(len(times)), key=lambda i: abs(times[i] - t))
            if self.breath and abs(times[snapshot] - t) > 1e-6 * max(1, abs(t)):
                what = f"snapshot nearest to the {what} ({t:g} s)"
            if snapshot not in [s for _, s in found]:
                found.append((what, snapshot))
        return sorted(found, key=lambda pair: pair[1])

    @functools.cached_property
    def full(self):
        """(start, end of inspiration) as snapshots: what came in between them is the ventilation; raises Missing."""
        what = dict((s, w) for w, s in self.moments)
        volume = [self.fields.volume(s) for s in what]
        start, full = min(what), list(what)[volume.index(max(volume))]
        if full == start:
            raise Missing("The snapshots hold no moment with more air than at the start.")
        return start, full

    def moment(self, snapshot):
        return f"{dict((s, w) for w, s in self.moments)[snapshot]}, t = {self.fields.times[snapshot]:g} s"


def load(directories):
    """Runs with names that differ: the last folder, or the path as it was given."""
    directories = [os.fspath(d) for d in directories]
    last = [os.path.basename(os.path.abspath(d)) for d in directories]
    if len(set(map(os.path.abspath, directories))) < len(directories):
        fail("a directory is named twice")
    return [Run(d, name if last.count(name) == 1 else d, i, len(last)) for i, (d, name) in enumerate(zip(directories, last))]

