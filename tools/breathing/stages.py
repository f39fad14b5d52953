"""The stages of a case: mesh, accuracy, dry run, run, report. Each is left out where it was done already."""
import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

from shared.common import SOURCE, environment, fail

from .progress import Progress

BUDGET = "30min"
FOR_MASKS = ("volume", "size", "cells", "labels")  # options that go to tools/lung_mesh
PULMO_STOPPED = 3  # exit code: there is a checkpoint to go on from
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PATIENCE = 10  # s, for a program to end that was asked to


def say(text):
    print(f"breathe: {text}", flush=True)


def surroundings():
    """The environment without options of PETSc's: what counts is in the case."""
    return {name: value for name, value in environment().items() if not name.startswith("PETSC_OPTIONS")}


@contextlib.contextmanager
def handled(handler):
    """The signals that end a program go to a handler, but for those that are ignored (nohup)."""
    former = {s: signal.signal(s, handler) for s in SIGNALS if signal.getsignal(s) is not signal.SIG_IGN}
    try:
        yield
    finally:
        for s, one in former.items():
            signal.signal(s, one)


def interrupt(*_):
    raise KeyboardInterrupt


@contextlib.contextmanager
def started(command, **more):
    """A program at work, in a group of its own. It ends with this one, whatever ends it, and so does what it started in its group."""
    # a signal between the start of the program and the next line would leave it to itself
    former = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        process = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, text=True, start_new_session=True,
                                   preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_SETMASK, former), **more)
    except BaseException:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)
        raise
    try:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)  # what came meanwhile comes now
        yield process
        process.wait()
    except BaseException:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)
        raise


def done(command, **more):
    """What a program gives that has no long output (a CompletedProcess)."""
    with started(command, stderr=subprocess.PIPE, **more) as process:
        out, err = process.communicate()
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def told(command, log, what, **place):
    """Runs a command, its words shown and kept; ends the program if it fails."""
    with open(log, "w") as out, started(command, stderr=subprocess.STDOUT, env=surroundings(), **place) as process:
        for line in process.stdout:
            out.write(line)
            print("  " + line, end="", flush=True)
    if process.returncode:
        fail(f"{what} failed, see above")


def mesh(case, given):
    """lung.msh in the case: made of the mask, or a copy of the mesh, checked."""
    if "mesh" in case.done:
        return
    begun = time.monotonic()
    to, log = case.folder / "lung.msh", case.folder / "mesh.txt"
    tool = SOURCE / "tools/lung_mesh"
    page = ["--report", case.folder / "mesh.html"]
    if given.source.suffix == ".msh":
        say(f"checking {given.source}")
        check = done([tool, "--check", given.source.resolve(), *page], env=environment())
        log.write_text(check.stdout + check.stderr)
        print("".join(f"  {line}\n" for line in (check.stdout + check.stderr).splitlines()), end="")
        if check.returncode:
            say(f"the mesh would not pass as one of tools/lung_mesh (see above, and {log}); pulmo says itself what it cannot take")
        shutil.copyfile(given.source, to)
    else:
        say(f"making a mesh of {given.source}")
        more = [word for option in FOR_MASKS if getattr(given, option)
                for word in (f"--{option}", getattr(given, option))]
        told([tool, "--mask", given.source.resolve(), "--output", to, *page, *more], log, "tools/lung_mesh")
    case.save(mesh={"file": to.name, "seconds": round(time.monotonic() - begun, 1), "source": str(given.source)})


def cells_of(case):
    """Number of tetrahedra, as tools/lung_mesh told it."""
    found = re.search(r"^tetrahedra +(\d+)$", (case.folder / "mesh.txt").read_text(), re.MULTILINE)
    return int(found[1]) if found else 0


def ranks_for(case, cells_for_a_rank):
    return max(1, min(len(os.sched_getaffinity(0)), cells_of(case) // cells_for_a_rank))


def launched(given, ranks):
    program = [str((given.build / "pulmo").resolve())]
    return program if ranks == 1 else ["mpiexec", *(["--oversubscribe"] if ranks > len(os.sched_getaffinity(0)) else []), "-n", str(ranks), *program]


def accuracy(case, given):
    """accuracy.opts: mesh, steps and elements that give the number asked for, found by tools/accuracy_cost."""
    if "accuracy" in case.done:
        return
    begun = time.monotonic()
    say(f"looking for what gives {given.within}, in at most {given.budget or BUDGET}")
    folder = case.folder / "accuracy"
    command = [SOURCE / "tools/accuracy_cost", "scene.opts", "--meshes", case.done["mesh"]["file"], "--question", given.within, "--budget", given.budget or BUDGET,
               "--build", given.build.resolve(), "--output", "accuracy", "--solvers", "solver.opts",
               "--method", "auto", "--", "-options_file", "own.opts"]
    told(command, case.folder / "accuracy.txt", "tools/accuracy_cost", cwd=case.folder)
    recommended = sorted(folder.glob("recommended_*.opts"))
    if not recommended:
        say(f"no setting that was tried gives {given.within} for sure; the run goes on with the scene's own (see {folder / 'README.md'})")
    else:
        kept = [line for line in recommended[0].read_text().splitlines() if not line.startswith("-options_file")]
        (case.folder / "accuracy.opts").write_text("\n".join(kept) + "\n")
    case.save(accuracy={"seconds": round(time.monotonic() - begun, 1), "question": given.within, "found": bool(recommended)})


def dry_run(case, given, ranks):
    """The scene in words, what it takes; pulmo's checks. Ends the program if pulmo refuses it."""
    inputs = case.inputs(given.build / "pulmo")
    if case.done.get("dry_run", {}).get("inputs") == inputs:
        return
    begun = time.monotonic()
    log = case.folder / "dry_run.txt"
    run = done([*launched(given, ranks), *case.options, "-dry_run"], cwd=case.folder, env=surroundings())
    log.write_text(run.stdout + run.stderr)
    print(run.stdout, end="")
    if run.returncode:  # without what the launcher has to say
        errors = [line for line in run.stderr.splitlines() if line.startswith("pulmo: error")]
        print("\n".join(errors) or f"breathe: error: pulmo ended with code {run.returncode}; {log} has all that it said", file=sys.stderr)
        sys.exit(run.returncode)
    version = done([given.build / "pulmo", "-version"], env=environment()).stdout.strip()
    case.save(dry_run={"seconds": round(time.monotonic() - begun, 1), "inputs": inputs, "version": version})


def run(case, given, ranks):
    """The run in run/; its exit code. One that was stopped goes on from its checkpoint."""
    inputs, folder = case.inputs(given.build / "pulmo"), case.folder / "run"
    if case.done.get("run", {}).get("code") == 0 and case.done["run"]["inputs"] == inputs and (folder / "summary.json").exists():
        say("the run is there already")
        return 0
    begun = time.monotonic()
    command = [*launched(given, ranks), *case.options, "-output_dir", "run"]
    before = case.done.get("run", {}).get("inputs")
    if folder.exists() and before and before != inputs:
        number = next(n for n in range(1, 10000) if not (case.folder / f"run_before_{n}").exists())
        folder.rename(case.folder / f"run_before_{number}")
        say(f"what the run reads has changed: its earlier results are in {case.folder / f'run_before_{number}'} now")
    launcher = "pulmo" if ranks == 1 else f"mpiexec -n {ranks} pulmo"
    script = case.folder / "run.sh"
    script.write_text("#!/bin/sh\n# The run of this case again; pulmo must be in PATH.\ncd \"$(dirname \"$0\")\" &&\n"
                      f"exec {launcher} {shlex.join(case.options)} -output_dir again \"$@\"\n")
    script.chmod(0o755)
    there = (folder / "checkpoint.h5").exists()
    if there and not case.names("-sensitivities"):
        command += ["-restart", "run/checkpoint.h5"]
        say("going on from the checkpoint")
    else:
        if there:
            say("the run begins again: -sensitivities needs the states from its start, which no checkpoint has")
        command.append("-output_overwrite")
    case.save(run={"inputs": inputs, "code": None, "ranks": ranks})
    code = execute(command, case)
    case.save(run={"inputs": inputs, "code": code, "ranks": ranks, "seconds": round(time.monotonic() - begun, 1)})
    if code == 0 and not (folder / "summary.json").exists():
        fail(f"pulmo ended without a result: an option of {case.folder}/*.opts asks for something else than a run")
    if code == PULMO_STOPPED:
        say(f"stopped; {shlex.join(['tools/breathe', str(case.folder)])} goes on from its checkpoint")
    return code


def execute(command, case):
    """Runs pulmo with a bar; what it prints goes to pulmo.log. A signal is passed on, so that pulmo leaves a checkpoint."""
    progress = Progress()
    with open(case.folder / "pulmo.log", "a") as log, started(command, cwd=case.folder, stderr=subprocess.STDOUT, env=surroundings()) as process, \
            handled(lambda number, _: process.send_signal(signal.SIGTERM if number == signal.SIGHUP else number)):
        try:
            for line in process.stdout:
                log.write(line)
                log.flush()
                progress.take(line)
            return process.wait()
        finally:
            progress.end()


def report(case):
    """The page about the run, also of one that failed; nothing where not even a row is there."""
    folder = case.folder / "run"
    if not any((folder / name).exists() for name in ("signals.csv", "signals.csv.part")):
        return
    begun = time.monotonic()
    made = done([SOURCE / "tools/report", folder, "--output", case.folder / "report.html"], env=environment())
    if made.returncode:
        sys.stderr.write(made.stderr)
        fail("tools/report failed, see above")
    case.save(report={"seconds": round(time.monotonic() - begun, 1)})


def tell(case, code):
    """What is where, and how long the stages took."""
    say("seconds: " + ", ".join(f"{name.replace('_', ' ')} {stage['seconds']:g}" for name, stage in case.done.items() if "seconds" in stage))
    summary = case.folder / "run/summary.json"
    if code == 0 and summary.exists():
        numbers = json.loads(summary.read_text())
        shown = [("tidal volume", "tidal_volume_ml", "ml"), ("peak pressure", "peak_inspiratory_pressure_cmH2O", "cmH2O"),
                 ("compliance", "compliance_ml_per_cmH2O", "ml/cmH2O"), ("resistance", "resistance_cmH2O_s_per_l", "cmH2O s/l")]
        say("; ".join(f"{words} {numbers[key]:.4g} {unit}" for words, key, unit in shown if isinstance(numbers.get(key), (int, float))))
    if (case.folder / "report.html").exists():
        say(f"open {case.folder / 'report.html'} in a browser")
