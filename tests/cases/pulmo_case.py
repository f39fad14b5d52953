"""Runs the program for the case tests and reads what it leaves.

A test script is called with the program and the launcher: SCRIPT PULMO [MPIEXEC ARGUMENTS... -n].
By hand: tests/cases/output_test.py build/pulmo
"""
import contextlib
import csv
import io
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import unittest
from unittest import mock

import h5py
import numpy as np

SOURCE = os.environ.get("PULMO_SOURCE_DIR", os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))
sys.path.insert(0, os.path.join(SOURCE, "tools"))
from shared import common  # noqa: E402
from shared.common import KPA_PER_CMH2O  # noqa: E402, F401: of the tests
from shared.signals import columns  # noqa: E402

PROGRAM, LAUNCHER = None, ["mpiexec", "--oversubscribe", "-n"]
_scratch = tempfile.TemporaryDirectory(prefix="pulmo_case_")

# several tests share the cores; one machine need not look for fast networks (0.2 s at each start)
ENVIRONMENT = common.environment() | {"OMPI_MCA_hwloc_base_binding_policy": "none", "OMPI_MCA_mpi_yield_when_idle": "1",
                                      "OMPI_MCA_pml": "ob1"}


def mesh(name):
    return os.path.join(SOURCE, "meshes", name)


def options_file(name):
    return ["-options_file", os.path.join(SOURCE, "petsc_options", name)]


TIGHT = options_file("solvers/tight.opts")
DIRECT = options_file("solvers/direct.opts")
PAPER = options_file("scenes/paper.opts")  # the paper's readings: no gas on the airway wall, flow shared by area
PCV = options_file("scenes/pcv.opts") + PAPER
VCV = options_file("scenes/vcv.opts") + PAPER
CUBE = ["-dm_plex_filename", mesh("cube_lung.msh"), "-mesh_scale", "1"]
LUNG = ["-dm_plex_filename", mesh("lung_test.msh")]
LITRE = ["-dm_plex_filename", mesh("cube_lung.msh"), "-mesh_scale", "10"]  # a cube of 1000 ml, one face airway
BLOCK = ["-dm_plex_filename", mesh("cube_coarse.msh"), "-mesh_scale", "100"]  # the same volume, faces x0 ... z1
# supports that leave the block free to inflate: F = J^(1/3) I
PINS = ["-support", "-support_rigid"]
ROLLERS = ["-support", "-support_surfaces", "x0,y0,z0", "-support_components_x0", "x", "-support_components_y0", "y",
           "-support_components_z0", "z"]
SCENE = PAPER + ["-tissue", "birzle", "-airflow", "-airflow_permeability", "1e4", "-chest_wall"]  # all but a ventilator
STILL = ["-airflow", "off"]
UNIFORM, COMMON = ["-ventilator_flow_split", "uniform"], ["-ventilator_flow_split", "common_pressure"]
# 40 ml into case_meshes.bodies, a pause in which they exchange gas
FLOW_OF_TWO = ["-ventilator", "vcv", "-ventilator_tidal_volume", "40", "-ventilator_inspiration", "0.3",
               "-ventilator_pause", "0.2", "-ventilator_expiration", "0.3", "-airflow_permeability", "2e3"]
QUIET = ["-progress", "off"]


def tool_called(name, *arguments):
    """What a call of a tool gives (a CompletedProcess), made within this process: a start of Python costs more than most of them."""
    out, err = io.StringIO(), io.StringIO()
    command = [os.path.join(SOURCE, "tools", name), *map(str, arguments)]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), mock.patch.object(sys, "argv", command), \
            mock.patch.object(sys, "path", [os.path.join(SOURCE, "tools"), *sys.path]):
        try:
            runpy.run_path(command[0], run_name="__main__")
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
            err.write("" if isinstance(end.code, (int, type(None))) else f"{end.code}\n")
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def scratch(name=""):
    """A path that does not exist yet, in a folder that goes away with the test."""
    return os.path.join(tempfile.mkdtemp(dir=_scratch.name), name or "run")


def alone():
    """The environment of a run that no launcher starts. Open MPI starts no daemon beside it (half of what a start costs);
    it then gives the folder of every such process the same name, so that each needs a place of its own."""
    return ENVIRONMENT | dict(OMPI_MCA_ess_singleton_isolated="1", OMPI_MCA_orte_tmpdir_base=os.path.dirname(scratch()))


def programme(text):
    path = scratch("programme.txt")
    with open(path, "w") as f:
        f.write(text)
    return ["-ventilator", "programme", "-ventilator_programme", path]


def replay(rows):
    """A programme that prescribes the airway pressure of each row at the row's time."""
    return programme("".join(f"step {dt:.17g} pressure {p:.17g}\n"
                             for dt, p in zip(rows["dt_s"][1:], rows["airway_pressure_cmH2O"][1:])))


def tissue_laws():
    """Names of the tissue laws that the program offers, CM1 to CM5 first."""
    return common.tissue_laws(PROGRAM)


# p = dW/dJ (kPa) of F = J^(1/3) I for J, s = J^(2/3) and t = J^(-1/3), with the parameters of Table 1, the others' of their headers (not pulmo's code)
CLOSED_FORMS = {
    "berger": lambda J, s, t: 0.2808 * t + 0.4212 / 2 * J - (0.2808 + 0.4212 / 2) / (J - 1 + 0.99),
    "ma": lambda J, s, t: 2 * np.exp(G_MA * (s - 1) ** 2) * 2 * G_MA * (s - 1) * 2 / 3 * t,
    "birzle": lambda J, s, t: 2 * 0.3567 * (t - J ** (-2 * 1.075 - 1)) + 4 * 5.766e-3 * (s - 1) ** 5 * t,
    "yoshihara": lambda J, s, t: 2 * 1.298 * (t - J ** (-2 * 0.75 - 1)),
    "rausch": lambda J, s, t: 16.5 / 2 * (J - 1 / J),
    "patte": lambda J, s, t: 2 * 0.2 * (t - 1 / J) + 4 * 0.4 * (1 / t - 1 / J) + 0.16 * (J - 1 / J) * np.exp(0.5 * (J**2 - 1) - np.log(J)),
    "concha": lambda J, s, t: 4 * (1 - 0.69) * 10.33 / (12 - 9 * 0.56) * (t - t**4),
}
G_MA = 3 * (3 * 0.43 - 0.6) / 4


def gas_pressure(law, J):
    """p = dW/dJ of F = J^(1/3) I, cmH2O, of a law with a closed form."""
    return CLOSED_FORMS[law](J, np.cbrt(J) ** 2, 1 / np.cbrt(J)) / KPA_PER_CMH2O


class Case:
    """One run of the program: exit code, what it said, what it left. `process`: of Popen."""

    def __init__(self, options, ranks=1, directory=None, timeout=300, launch=False, **process):
        self.directory = directory or scratch()
        command = [PROGRAM] + [str(o) for o in options]
        # another user may not write into our folders
        environment = ENVIRONMENT if "user" in process else alone()
        if self.directory != "-":  # "-": the options tell
            command += ["-output_dir", self.directory]
        if ranks > 1 or launch:
            command, environment = LAUNCHER + [str(ranks)] + command, ENVIRONMENT
        self.command = " ".join(command)
        start = time.monotonic()
        run = subprocess.Popen(command, **({"cwd": SOURCE} | process), env=environment, text=True, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, start_new_session=True)
        try:
            self.out, self.err = run.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            self.out, self.err = run.communicate()
            raise AssertionError(f"no end after {timeout} s: {self.command}\n{self.tail()}") from None
        self.seconds = time.monotonic() - start
        self.code = run.returncode

    def tail(self):
        return f"stdout: ...{self.out[-1500:]}\nstderr: {self.err[-3000:]}"

    def path(self, name):
        return os.path.join(self.directory, name)

    def files(self):
        return sorted(os.listdir(self.directory)) if os.path.isdir(self.directory) else []

    def columns(self, name="signals.csv"):
        with open(self.path(name), newline="") as f:
            return next(csv.reader(f))

    def signals(self, name="signals.csv"):
        """Column -> array; the phase as a list of names."""
        return {c: list(map(str, v)) if c == "phase" else v for c, v in columns(self.path(name)).items()}

    def json(self, name="summary.json"):
        with open(self.path(name)) as f:
            return json.load(f)


def fields(case, step=-1):
    """Of a snapshot: mid-nodes included coordinates, cells (10 nodes each) and a reader of its values by name."""
    names = sorted(n for n in case.files() if re.fullmatch(r"fields_\d+\.h5", n))
    with h5py.File(case.path("fields.h5")) as file:
        x, cells = file["geometry"][:], file["topology"][:].reshape(-1, 10)
    with h5py.File(case.path(names[step])) as file:
        values = {name: file[name][()] for name in file if isinstance(file[name], h5py.Dataset)}
    return x, cells, values


def finished(options, **arguments):
    """A run that has to reach its end."""
    case = Case(options, **arguments)
    if case.code != 0:
        raise AssertionError(f"exit code {case.code}: {case.command}\n{case.tail()}")
    return case


def has_ml():
    """Whether this PETSc was built with ML: Debian 12's was, that of Debian 13 and later ones were not."""
    said = Case(options_file("solvers/iterative_ml.opts") + ["-dm_plex_filename", scratch("none.msh")]).err
    return "knows no 'ml'" not in said


def main():
    """Takes the program and the launcher from the command line and runs the tests of the script."""
    global PROGRAM, LAUNCHER
    if len(sys.argv) < 2 or not os.path.exists(sys.argv[1]):
        sys.exit(f"usage: {sys.argv[0]} PULMO [MPIEXEC ARGUMENTS... -n]")
    PROGRAM = os.path.abspath(sys.argv[1])
    LAUNCHER = sys.argv[2:] or LAUNCHER
    unittest.main(module="__main__", argv=sys.argv[:1], verbosity=2)
