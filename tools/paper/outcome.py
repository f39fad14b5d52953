"""What the runs left: numbers, signals, fields."""
import json
import re

import h5py
import numpy as np

from shared.signals import columns

from .cases import LUMEN


def read_json(path):
    with open(path) as f:
        return json.load(f)


def reason(numbers):
    """The program's reason for a stop, without its list of attempts and advice."""
    return numbers["failure"].split(" Tried ")[0]


class Outcome:
    """What a run left: `finished`, `numbers` (summary or failure) and `signals` (column -> array)."""

    def __init__(self, directory):
        self.directory = directory
        self.finished = (directory / "summary.json").exists()
        self.numbers = read_json(directory / ("summary.json" if self.finished else "failure.json"))
        path = directory / "signals.csv"
        self.signals = columns(path if path.exists() else directory / "signals.csv.part")
        self.time, self.volume = self.signals["time_s"], self.signals["volume_ml"]
        self.pressure, self.flow = self.signals["airway_pressure_cmH2O"], self.signals["flow_ml_per_s"]

    def __getitem__(self, key):
        return self.numbers[key]

    def snapshot_times(self):
        return [float(t) for t in re.findall(r'Time Value="([^"]+)"', (self.directory / "fields.xdmf").read_text())]

    def fields(self, t):
        """Reference nodes (n, 3), quadratic cells (m, 10) and fields of the snapshot nearest to t."""
        index = int(np.argmin(np.abs(np.array(self.snapshot_times()) - t)))
        with h5py.File(self.directory / "fields.h5") as f:
            nodes, cells = f["geometry"][()], f["topology"][()]
        with h5py.File(self.directory / f"fields_{index:05d}.h5") as f:
            return nodes, cells, {name: f[name][()] for name in f}

    def pauses(self):
        """Rows that end a pause."""
        phase = self.signals["phase"]
        last = np.append(phase[1:] != phase[:-1], True)
        return np.flatnonzero((phase == "pause") & last)


class Results:
    """The outcomes of the runs by name, and which of them stands for a law in a figure."""

    def __init__(self, workshop, cases):
        self.workshop, self.cases, self.plan = workshop, cases, workshop.plan
        self.known = {}

    def __getitem__(self, name):
        if name not in self.known:
            self.known[name] = Outcome(self.workshop.directory(self.cases.runs[name]))
        return self.known[name]

    def done(self, part):
        return all(self.workshop.done(run) for run in self.cases.parts[part])

    def best(self, start):
        """(law, outcome, label) of each law: the paper's traction where it gets through, else the gas on the airway wall."""
        for law in self.cases.laws:
            name, label = f"{start}_{law.name}", law.label
            if not self[name].finished and f"{name}_{LUMEN}" in self.cases.runs:
                name, label = f"{name}_{LUMEN}", f"{label}*"
            yield law, self[name], label

    def all(self, start):
        """(label, law, outcome) of all runs of a kind, stopped ones too; a star: the gas on the airway wall."""
        for law in self.cases.laws:
            for ending, mark in (("", ""), (f"_{LUMEN}", "*")):
                if f"{start}_{law.name}{ending}" in self.cases.runs:
                    yield law.label + mark, law, self[f"{start}_{law.name}{ending}"]
