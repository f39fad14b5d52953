"""Runs of pulmo in Python: read what a run left, run a scene, vary its options.

    import pulmo
    run = pulmo.run("pcv", "lung_test", ventilator_pip=8, elements="P1-P1")
    run.signals.plot("time_s", "volume_ml")
    table = pulmo.sweep({"ventilator_pip": [6, 8, 10]}, "pcv", "lung_test")

Arrays are numpy's, tables pandas'. Units stand in the names of columns, keys and fields. Errors are PulmoError: one sentence.
"""
from .errors import Missing, PulmoError, RunFailed
from .program import run, sweep
from .run import Run, load
from .snapshots import Snapshots

__all__ = ["Missing", "PulmoError", "Run", "RunFailed", "Snapshots", "load", "run", "sweep"]
