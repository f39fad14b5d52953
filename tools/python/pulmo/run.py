"""A run as tables and arrays."""
import functools

from .files import RunFiles
from .tables import pandas

GROUPS = ("energy_j", "inspiratory_energy_j", "fit_until_cut")  # of numbers, also where a breath that was cut has none in them


class Run:
    """What a run left in its directory; tables are read when they are asked for.

    directory: path. state: "finished", "failed" or "unfinished" (at work, stopped or killed). why: one sentence on why it is not
    finished, else "". summary: dict, summary.json (of a failed run failure.json, of an unfinished one empty). output: what the program
    said, if run() ran it.
    """

    def __init__(self, directory, output=""):
        self._files = RunFiles(directory)
        self.directory, self.output = self._files.directory, output
        self.state, self.why, self.summary = self._files.state, self._files.unfinished, self._files.summary

    def __repr__(self):
        return f"<pulmo.Run {self.directory}: {self.state}, {len(self._files.time) - 1} steps, {self._files.time[-1]:g} s>"

    @functools.cached_property
    def signals(self):
        """DataFrame of signals.csv: a row for each accepted step, the first at t = 0; time_s, airway_pressure_cmH2O, flow_ml_per_s (mean
        over the step, into the lung positive), volume_ml (above rest), phase, ... and columns that effects add."""
        return pandas().DataFrame(self._files.signals)

    @functools.cached_property
    def energy(self):
        """DataFrame of energy.csv: sums since t = 0, J, a row for each step; raises Missing where the run kept no balance."""
        return pandas().DataFrame({name if name == "time_s" else name + "_j": values for name, values in self._files.energy.items()})

    @functools.cached_property
    def breaths(self):
        """DataFrame of the clinical numbers, a row for each breath, numbered from 1; NaN where a breath does not define one."""
        rows = [{key: value for key, value in breath.items() if key not in GROUPS and not isinstance(value, (dict, list))}
                for breath in self.summary.get("breaths") or []]
        table = pandas().DataFrame(rows, index=pandas().RangeIndex(1, len(rows) + 1, name="breath"))
        return table.astype({name: float for name in table.columns if name != "complete"})

    @functools.cached_property
    def numbers(self):
        """Series of the run's overall clinical numbers (docs/clinical.md): those of the last complete breath; NaN where not defined.
        Empty for a run without breaths."""
        names = [name for name in self.breaths.columns if name in self.summary]
        extra = [name for name in ("functional_residual_capacity_ml",) if name in self.summary]
        return pandas().Series({name: self.summary[name] for name in names + extra}, dtype=float)

    @functools.cached_property
    def regions(self):
        """DataFrame of the regions' numbers, a row for each by name."""
        return pandas().DataFrame.from_dict(self.summary.get("regions") or {}, orient="index")

    @property
    def fields(self):
        """Snapshots of the run: times, mesh and fields; raises Missing where it kept none."""
        return self._files.fields


def load(directory):
    """The Run that is in a directory (an -output_dir), finished or not; raises PulmoError if there is none."""
    return Run(directory)
