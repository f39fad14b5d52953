"""Where a hard case runs: it starts pulmo, reads what it leaves, and writes down each demand with the number measured.

Every run is held to what is asked of all of them, whatever the case: it ends in time; it finishes, or it stops with one
sentence; no accepted state has J <= 0; no file holds a number that is none.
"""
import math
import re
import resource
import sys
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent / "tests/cases"))
import case_meshes  # noqa: E402, F401: of the cases
import pulmo_case as pulmo  # noqa: E402

CASES = {}  # name -> function, in the order of the page


def case(title, asked, left_out="nothing"):
    """Makes a function of a Lab a case of the gallery; its docstring says why the case is hard.

    asked: what is demanded, in short; left_out: what the size of the tests leaves out.
    """
    def add(function):
        function.title, function.asked, function.left_out = title, asked, left_out
        CASES[function.__name__] = function
        return function
    return add


def number(v):
    """A measured number, short."""
    return f"{v:.6g}" if isinstance(v, (float, np.floating)) else str(v)


def children_cpu():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def first_sentence(text):
    """What pulmo said when it stopped, without the list of attempts."""
    said = re.search(r"pulmo: error: (.*)", text)
    return re.split(r"\.\s+(?=[A-Z])", said.group(1))[0] if said else ""


# of summary.json and failure.json: numbers that every run defines. NaN is written as null there, as is a clinical number
# that a breath does not define, and a residual over a work that is too small to divide by
DEFINED = {"reference_volume_ml", "surface_area_mm2", "min_jacobian", "min_porosity", "mass_balance_error_ml", "end_time_s", "steps",
           "rejected_steps", "newton_iterations", "krylov_iterations", "ventilation_ml", "jacobian_mean", "jacobian_sd",
           "ventilator_work", "external", "elastic_tissue", "elastic_springs", "resistive", "resistive_tube",
           "numerical_dissipation", "residual"}


def undefined(value, key=""):
    """Keys within a JSON value that hold no number where there always is one."""
    if isinstance(value, dict):
        return [bad for k, v in value.items() for bad in undefined(v, k)]
    if isinstance(value, list):
        return [bad for v in value for bad in undefined(v, key)]
    none = value is None and key in DEFINED or isinstance(value, float) and not math.isfinite(value)
    return [key] if none else []


def broken_numbers(run):
    """Names of the files of a run that hold NaN or infinity (fields: of what its mesh has)."""
    bad = []
    for name in run.files():
        path = run.path(name)
        if name.endswith(".json"):
            bad += [f"{name} ({key})" for key in undefined(run.json(name))]
        elif name.endswith((".csv", ".csv.part")):
            if re.search(r"(^|,)-?(nan|inf)(?=,|$)", Path(path).read_text(), re.I | re.M):
                bad.append(name)
        elif re.fullmatch(r"fields_\d+\.h5", name):
            with h5py.File(path) as file:
                if not all(np.isfinite(values[()]).all() for values in file.values() if isinstance(values, h5py.Dataset)):
                    bad.append(name)
    return bad


class Lab:
    """One case: its runs, its demands."""

    def __init__(self, program, small):
        pulmo.PROGRAM = str(program)
        self.small, self.build = small, Path(program).parent
        self.demands, self.curves = [], {}
        self.steps = self.cut = self.runs = self.stops = self.most_newton = 0
        self.cpu, self.min_J, self.said = 0.0, math.inf, []

    # ---- runs

    def counted(self, call):
        """What a call returns; the CPU time of the programs that it ran goes to the case."""
        before = children_cpu()
        try:
            return call()
        finally:
            self.cpu += children_cpu() - before

    def run(self, options, ranks=1, timeout=300, sound=True):
        """A run that may finish or stop; `sound`: held to what is asked of every run."""
        run = self.counted(lambda: pulmo.Case(pulmo.QUIET + list(options), ranks=ranks, timeout=timeout))
        self.runs += 1
        run.finished = run.code == 0
        run.sentence = first_sentence(run.err)
        run.summary_file = "summary.json" if run.finished else "failure.json"
        run.signals_file = "signals.csv" if run.finished else "signals.csv.part"
        if run.summary_file in run.files():
            numbers, rows = run.json(run.summary_file), run.signals(run.signals_file)
            self.steps += numbers["steps"]
            self.cut += numbers["rejected_steps"]
            self.min_J = min(self.min_J, float(rows["min_J"].min()))
            self.most_newton = max(self.most_newton, int(rows["newton_iterations"].max()))
        if not run.finished:
            self.stops += 1
            self.said.append(run.sentence)
        if sound:
            fault = self.fault(run)
            if fault:
                self.demand("every run ends well or says why", fault, "no fault", False)
        return run

    @staticmethod
    def fault(run):
        """What is wrong with how a run ended; empty if it finished, or stopped as it should."""
        if "PETSC ERROR" in run.err:
            return "PETSc trace: " + next(line for line in run.err.splitlines() if "PETSC ERROR" in line)
        if run.code is None or run.code not in (0, 1, 2, 3):
            return f"ended with code {run.code}"
        if not run.finished and run.err.count("pulmo: error:") != 1:
            return f"code {run.code} without one sentence: {run.err[-200:]}"
        if not run.finished and not run.files():
            return ""  # refused before any work
        for name in (run.summary_file, run.signals_file):
            if name not in run.files():
                return f"no {name}"
        bad = broken_numbers(run)
        if bad:
            return "no number in " + ", ".join(bad)
        if not run.signals(run.signals_file)["min_J"].min() > 0:
            return "a row with J <= 0"
        no_air = run.json(run.summary_file).get("min_porosity", 0) < 0
        if no_air != ("the porosity falls below zero" in run.out):
            return "porosity < 0 without a warning" if no_air else "a warning of porosity < 0 that is not"
        return ""

    def finished(self, options, what="runs to its end", **arguments):
        """A run that is asked to finish; None (and a demand missed) if it does not."""
        run = self.run(options, **arguments)
        if not run.finished:
            self.demand(what, f"stopped: {run.sentence}", "finished", False)
            return None
        return run

    def stopped(self, options, *words, what="stops and says why", **arguments):
        """A run that is asked to stop with a sentence that holds `words`, keeping the last good state."""
        run = self.run(options, **arguments)
        missing = [w for w in words if w not in run.err]
        kept = all(name in run.files() for name in ("failure.json", "signals.csv.part", "fields.xdmf"))
        self.demand(what, "it finished" if run.finished else f"lacks {missing}" if missing else
                    "kept no state" if not kept else "said so", "said so", not run.finished and not missing and kept)
        return None if run.finished else run

    # ---- demands

    def demand(self, what, measured, asked, met):
        self.demands.append({"what": what, "measured": number(measured), "asked": str(asked), "met": bool(met)})

    def within(self, what, measured, expected, share):
        """Relative to what is expected."""
        self.demand(what, measured, f"{number(float(expected))} ± {number(100.0 * share)} %",
                    abs(measured - expected) <= share * abs(expected))

    def below(self, what, measured, limit):
        self.demand(what, float(measured), f"< {number(limit)}", measured < limit)

    def above(self, what, measured, limit):
        self.demand(what, float(measured), f"> {number(limit)}", measured > limit)

    def true(self, what, met):
        self.demand(what, "yes" if met else "no", "yes", met)

    def met(self):
        return all(d["met"] for d in self.demands)

    def recovery(self):
        """What the program did to get through, or that it did not."""
        if not self.runs:
            return "a test program of its own"
        parts = [f"{self.cut} steps cut and grown back" if self.cut else "no step cut",
                 f"up to {self.most_newton} Newton steps in one"]
        if self.stops:
            parts.append(f"{self.stops} of {self.runs} runs stopped")
            parts += [f"“{s[:120]}”" for s in dict.fromkeys(self.said)][:2]
        return "; ".join(parts)

    def result(self, name, function):
        return {"name": name, "title": function.title, "why": " ".join((function.__doc__ or "").split()), "asked": function.asked,
                "left_out": function.left_out, "demands": self.demands, "met": self.met(), "runs": self.runs,
                "steps": self.steps, "cut": self.cut, "min_J": self.min_J if math.isfinite(self.min_J) else None,
                "recovery": self.recovery(), "cpu_s": self.cpu, "curves": self.curves}


def run_case(name, program, small):
    """The result of one case; an exception of the case itself is a demand missed."""
    function, lab = CASES[name], Lab(program, small)
    try:
        function(lab)
    except Exception as error:  # noqa: BLE001: whatever went wrong belongs on the page
        lab.demand("the case itself runs", f"{type(error).__name__}: {error}"[:400], "no exception", False)
    return lab.result(name, function)


def resident(pid):
    """Resident memory of a process without that of files (programs, libraries), bytes; 0 if it has ended."""
    try:
        return 1024 * int(re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())[1])
    except (OSError, TypeError):
        return 0

