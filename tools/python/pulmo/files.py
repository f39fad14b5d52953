"""What a run left in its directory, finished or not: signals and numbers, or one sentence on why there are none."""
import functools
import json
import os
import re

from .errors import Missing, PulmoError
from .snapshots import Snapshots
from .tables import whole_rows


def signals_path(directory):
    """signals.csv, or signals.csv.part of a run that is at work, was stopped or failed."""
    path = os.path.join(directory, "signals.csv")
    if not os.path.isdir(directory):
        raise PulmoError(f"there is no directory {directory}; name the -output_dir of a run")
    if not os.path.exists(path):
        path += ".part"
    if not os.path.exists(path):
        raise PulmoError(f"neither signals.csv nor signals.csv.part is in {directory}; this is no directory of a run")
    return path


def numbers_of(path):
    """Columns of a table of signals: name -> list (numbers, but text for the phase)."""
    rows = whole_rows(path)
    if not rows or "time_s" not in rows[0] or "volume_ml" not in rows[0]:
        raise PulmoError(f"{path} holds no steps of pulmo")
    try:
        return {name: [row[name] if name == "phase" else float(row[name]) for row in rows] for name in rows[0]}
    except (TypeError, ValueError):
        raise PulmoError(f"{path} is damaged: a value is missing or not a number") from None


def of_json(directory, name):
    """What a file of the run says; None if it is not there."""
    path = os.path.join(directory, name)
    try:
        with open(path) as f:
            said = json.load(f)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise PulmoError(f"{path} is damaged: {error}") from None
    if not isinstance(said, dict) or not isinstance(said.get("options", {}), dict):
        raise PulmoError(f"{path} is damaged: it is not what pulmo writes there")
    return said


def read_summary(directory, end):
    """What summary.json says, or failure.json, and why the run is not finished (empty if it is). `end`: of its rows, s."""
    for name in "summary.json", "failure.json":
        summary = of_json(directory, name)
        if summary is not None:
            return summary, f"FAILED: {summary.get('failure', 'no reason given')}" if name == "failure.json" else ""
    return {}, f"NOT FINISHED: at work, stopped or killed; rows up to {end:g} s"


class RunFiles:
    """The directory of one run, read once. `state` is finished, failed or unfinished; `signals`: name -> list; `scene`: what it said
    of itself when it began (empty where an older version of pulmo made it); `options`, `sources`: of the summary, else of the scene."""

    def __init__(self, directory):
        self.directory = os.fspath(directory)
        self.signals = numbers_of(signals_path(self.directory))
        self.time = self.signals["time_s"]
        self.summary, self.unfinished = read_summary(self.directory, self.time[-1])
        if "end_time_s" in self.summary and abs(self.time[-1] - self.summary["end_time_s"]) > 1e-6 * max(1, abs(self.summary["end_time_s"])):
            raise PulmoError(f"{signals_path(self.directory)} ends at {self.time[-1]:g} s and the run at {self.summary['end_time_s']:g} s: it is cut, "
                             "or of another run")
        self.state = "failed" if self.unfinished and self.summary else "unfinished" if self.unfinished else "finished"
        self.scene = of_json(self.directory, "scene.json") or {}
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
        return Snapshots(self.directory)

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
