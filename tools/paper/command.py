"""Run the cases of Aviles-Rojas & Hurtado 2022 on the built-in lungs and redraw its tables and figures.

    tools/reproduce_paper                       # everything, into docs/paper
    tools/reproduce_paper --only table2,figure3
    tools/reproduce_paper --list

Runs are kept in results/paper; what is there and was made by the same program, files and environment is not run again, so the tool may
be stopped at any time. A run that the
model cannot finish (the tissue turns inside out) is an outcome and is reported with the program's reason.
Runs on Debian's python3-numpy, -matplotlib and -h5py; the meshes of the studies need python3-gmsh, -scipy and -skimage.
"""
import argparse
import os
import signal
import sys
from pathlib import Path

from shared.common import RESULTS, SOURCE, tissue_laws

from .breaths import table2, tried
from .cases import QUICK, Cases, Plan
from .compartment import figure4
from .laws import LAWS
from .messages import fail, say
from .outcome import Results
from .page import write_page
from .sections import figure5, figure6
from .springs import figure9, table3
from .syringe import figure8
from .waveforms import figure3, figure7
from .workshop import Workshop

PARTS = {
    "table2": "compliance and resistance of five laws under PCV",
    "table3": "lung compliance without springs",
    "figure3": "PCV waveforms",
    "figure4": "CM3 beside the single compartment",
    "figure5": "J and pressure in the coronal plane",
    "figure6": "effective hydrostatic and von Mises stress in the coronal plane",
    "figure7": "VCV waveforms",
    "figure8": "supersyringe: pressure over time, pressure-volume curves",
    "figure9": "compliances against the spring stiffness",
    "tried": "other readings of the boundary conditions, finer step and mesh",
}
DRAW = {"table2": table2, "table3": table3, "figure3": figure3, "figure4": figure4, "figure5": figure5, "figure6": figure6,
        "figure7": figure7, "figure8": figure8, "figure9": figure9, "tried": tried}


def parse(arguments):
    parser = argparse.ArgumentParser(prog="reproduce_paper", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="PART,...",
                        help="parts to do (see --list)")
    parser.add_argument("--list", action="store_true", help="list parts and runs, and whether they are done, and stop")
    parser.add_argument("--quick", action="store_true",
                        help="two laws on the small test lung with short breaths: a test of the tool")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="where the runs are kept (default results/paper)")
    parser.add_argument("--output", type=Path, metavar="DIR",
                        help="where figures and page go (default docs/paper; quick, or where pulmo is installed: RUNS/page)")
    parser.add_argument("--program", type=Path, default=SOURCE / "build/pulmo", help="the program (default build/pulmo)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="runs at a time (default 1)")
    given = parser.parse_args(arguments)
    given.runs = (given.runs or RESULTS / ("paper_quick" if given.quick else "paper")).absolute()
    given.output = (given.output or (given.runs / "page" if given.quick or RESULTS.parent != SOURCE else SOURCE / "docs/paper")).absolute()
    given.parts = given.only.split(",") if given.only else list(PARTS)
    unknown = [part for part in given.parts if part not in PARTS]
    if unknown:
        fail(f"--only {unknown[0]} is no part; the parts are {', '.join(PARTS)}")
    if given.jobs < 1:
        fail(f"--jobs {given.jobs} is less than one")
    if not (given.list or os.access(given.program, os.X_OK)):
        fail(f"--program {given.program} is missing; build it first (tools/setup)")
    return given


def main(arguments):
    given = parse(arguments)
    plan = QUICK if given.quick else Plan()
    cases = Cases(plan)
    workshop = Workshop(given.runs, given.program.absolute(), plan, given.jobs)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("reproduce_paper: stopped; call it again to go on"))
    signal.signal(signal.SIGINT, signal.getsignal(signal.SIGTERM))
    if given.list:
        for part in given.parts:
            print(f"{part:8} {PARTS[part]}")
            for run in cases.parts[part]:
                print(f"           {'done' if workshop.done(run) else '    '} {run.name}")
        return 0
    given.runs.mkdir(parents=True, exist_ok=True)
    others = [law for law in tissue_laws(workshop.program) if law not in {law.name for law in LAWS}]
    if others:
        say(f"not of the paper and left out: {', '.join(others)}")
    wanted = {run.name: run for part in given.parts for run in cases.parts[part]}
    wrong = {run.name for run in workshop.carry_out(list(wanted.values()))}
    results = Results(workshop, cases)
    given.output.mkdir(parents=True, exist_ok=True)
    for part in given.parts:
        missing = wrong & {run.name for run in cases.parts[part]}
        if missing:
            say(f"{part} is not drawn: {', '.join(sorted(missing))} failed")
        else:
            DRAW[part](results, given.output)
    if results.done("figure4"):
        write_page(results, given.output)
    else:
        say("the page waits for figure4 (--list)")
    return 1 if wrong else 0
