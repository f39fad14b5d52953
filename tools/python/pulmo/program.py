"""Runs the program and varies its options."""
import atexit
import contextlib
import hashlib
import itertools
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from .errors import PulmoError, RunFailed
from .run import Run
from .tables import pandas

SOURCE = Path(__file__).resolve().parents[3]  # of the project, or share/pulmo of an installation
OURS = {"output_dir": "directory", "dm_plex_filename": "mesh", "options_file": "scene"}  # options that arguments stand for
OTHER_THAN_RUNS = ("dry_run", "scene_view_only", "help", "list", "version")
_kept = []  # the folder of runs that no directory was given for


def _program():
    """Path of the program: PULMO_PROGRAM, the one that belongs to these modules, or that on the PATH."""
    for path in (os.environ.get("PULMO_PROGRAM"), SOURCE / "build/pulmo", shutil.which("pulmo")):
        if path and os.access(path, os.X_OK):
            return str(path)
    raise PulmoError("the program is not there: build it (tools/setup), or give its path in the environment variable PULMO_PROGRAM")


def _new_directory():
    """A folder that goes away when Python ends."""
    if not _kept:
        _kept.append(tempfile.mkdtemp(prefix="pulmo_"))
        atexit.register(shutil.rmtree, _kept[0], ignore_errors=True)
    return os.path.join(tempfile.mkdtemp(dir=_kept[0]), "run")


def _file(name, folder, ending, what):
    """The path of a file, or of one that comes with pulmo by its short name."""
    own = SOURCE / folder / f"{name}{ending}"
    path = Path(name) if os.path.isfile(name) else own
    if not path.is_file():
        there = ", ".join(sorted(p.name.removesuffix(ending) for p in (SOURCE / folder).glob("*" + ending)))
        raise PulmoError(f"there is no {what} {name}: give a file, or one of {there}")
    return str(path)


def _files_named(option_files):
    """Words for options of files that name a file from pulmo's top folder, as its scenes do, where it is not there from here."""
    named = {}
    for path in option_files:
        for line in Path(path).read_text(errors="replace").splitlines():
            found = re.match(r"\s*(-[A-Za-z_]\S*)\s*(.*?)\s*(?:(?<=\s)#.*)?$", line)
            if found:
                named[found[1]] = found[2]
    words = []
    for name, value in named.items():
        for file, rest in ((value, ""), (value.rpartition(":")[0], ":" + value.rpartition(":")[2])):
            if "/" in file and name != "-dm_plex_filename" and not os.path.exists(file) and (SOURCE / file).is_file():
                words += [name, str(SOURCE / file) + rest]
    return words


def _words(options):
    """Words of the command line for {name: value}: True and False are on and off, None leaves an option out, lists get commas."""
    words = []
    for name, value in options.items():
        own = name.lstrip("-")
        if own in OURS:
            raise PulmoError(f"{own} is the argument {OURS[own]}: give it there")
        if own in OTHER_THAN_RUNS:
            raise PulmoError(f"{own} makes no run: call the program itself for it")
        if hasattr(value, "tolist"):  # of numpy
            value = value.tolist()
        if value is None:
            continue
        if isinstance(value, bool):
            value = "on" if value else "off"
        elif isinstance(value, (list, tuple)):
            value = ",".join(map(str, value))
        words += ["-" + name.lstrip("-"), str(value)]
    return words


def _reason(error, output, code):
    """The program's own sentence, or the first one of who started it."""
    found = re.search(r"^pulmo: error: (.*?)(?=^-{20}|^=+ *$|^\[|\Z)", error, re.MULTILINE | re.DOTALL)
    if found:
        return found[1].strip()
    said = [line for line in (error + "\n" + output).splitlines() if re.search(r"\w", line)]
    return said[0] if said else f"the program ended with code {code} and said nothing"


def command(scene, mesh, solver="iterative", ranks=1, directory=None, **options):
    """The words of the command that run() runs: a list of str."""
    scenes = [scene] if isinstance(scene, (str, os.PathLike)) else list(scene or [])
    if not scenes or not isinstance(mesh, (str, os.PathLike)):
        raise PulmoError("a run needs a scene (a name, a file or a list of them) and a mesh (a name or a file)")
    if isinstance(ranks, bool) or not hasattr(ranks, "__index__") or ranks < 1:
        raise PulmoError(f"ranks is the number of processes, 1 or more, not {ranks!r}")
    words = ["mpiexec", "-n", str(ranks)] if ranks > 1 else []
    files = [_file(name, "petsc_options/" + folder, ".opts", what)
             for name, folder, what in [(solver, "solvers", "solver")] + [(name, "scenes", "scene") for name in scenes]]
    words += [_program(), *(word for file in files for word in ("-options_file", file))]
    # the mesh after the scenes, some of which name one of their own
    words += [*_files_named(files), "-dm_plex_filename", _file(mesh, "meshes", ".msh", "mesh")]
    return words + _words(options) + (["-output_dir", os.fspath(directory)] if directory else [])


def run(scene, mesh, *, solver="iterative", ranks=1, directory=None, **options):
    """Runs a scene to its end and returns the Run.

    scene: name of a file in petsc_options/scenes ("pcv"), path of an option file, or a list of these; the last one counts most.
    mesh: name of a mesh that comes with pulmo ("lung_test"), or path of a mesh. solver: name in petsc_options/solvers, or path.
    ranks: of MPI. directory: where the run goes; None: a folder that goes away when Python ends.
    options: any other options without their dash, in the units that `pulmo -help` tells: ventilator_pip=8, tissue="yoshihara".
    True and False are on and off. Names that are no words of Python go as **{"name": value}.

    Raises RunFailed with the program's own sentence if it does not end with code 0.
    """
    directory = os.fspath(directory) if directory else _new_directory()
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"} | os.environ
    done = subprocess.run(command(scene, mesh, solver, ranks, directory, **options), env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RunFailed(_reason(done.stderr, done.stdout, done.returncode), done.returncode, directory, done.stdout + done.stderr)
    return Run(directory, done.stdout)


def _contents(words, known):
    """{path: hash of what is in it} of the files that words of a command or of an option file name, those in option files with them."""
    for word in words:
        if word not in known and os.path.isfile(word):
            with open(word, "rb") as file:
                known[word] = hashlib.file_digest(file, "sha256").hexdigest()
            if word.endswith(".opts"):
                _contents(Path(word).read_text(errors="replace").split(), known)
    return known


class _Record:
    """sweep.json in the directory of a sweep: what it was asked for, and how the runs ended that need not be made again.

    `ended`: {run: "" or why it could not go on}.
    """

    def __init__(self, directory, commands, again):
        directory = os.fspath(directory)
        self.path = os.path.join(directory, "sweep.json")
        files = {}
        for words in commands:
            _contents(words, files)
        self.asked = {"commands": commands, "files": files}
        self.ended, self.begun = {}, []
        if not os.path.exists(self.path):
            return
        try:
            with open(self.path) as file:
                known = json.load(file)
            asked, ended, self.begun = known["asked"], dict(known["ended"]), list(known["begun"])
            change = self._change(asked)
        except (ValueError, KeyError, TypeError, OSError) as error:
            raise PulmoError(f"sweep: {self.path} is damaged ({error}): name another directory") from None
        if change and not again:
            raise PulmoError(f"sweep: {directory} holds the runs of another sweep: {change}; name another directory, or call it as it was")
        if not again:
            self.ended = ended

    def _change(self, asked):
        """What is not as it was, in words; "" if nothing."""
        before, now = asked["commands"], self.asked["commands"]
        for old, new in zip(before, now):
            if old != new:
                at = next((i for i, (a, b) in enumerate(zip(old, new)) if a != b), min(len(old), len(new)))
                at -= at > 0 and at < len(new) and not new[at].startswith("-")
                return f"it had {' '.join(old[at:at + 2]) or 'nothing'} where this one has {' '.join(new[at:at + 2]) or 'nothing'}"
        if len(before) != len(now):
            return f"it had {len(before)} runs, and this one has {len(now)}"
        changed = sorted(name for name in asked["files"].keys() | self.asked["files"].keys() if asked["files"].get(name) != self.asked["files"].get(name))
        return f"{changed[0]} has changed since" if changed else ""

    def made(self, name):
        """The Run of a name that need not be made again; None if there is none."""
        if name in self.ended:
            with contextlib.suppress(PulmoError):
                run = Run(os.path.join(os.path.dirname(self.path), name))
                if run.state == ("failed" if self.ended[name] else "finished"):
                    return run
        self.ended.pop(name, None)
        return None

    def ours(self, name):
        """Whether the sweep has begun a run here before. Notes that it does now."""
        before = name in self.begun
        if not before:
            self.begun.append(name)
            self._write()
        return before

    def note(self, name, failure):
        self.ended[name] = failure
        self._write()

    def _write(self):
        part = f"{self.path}.{os.getpid()}.part"
        try:
            os.makedirs(os.path.dirname(self.path) or ".", exist_ok=True)
            with open(part, "w") as file:
                json.dump({"asked": self.asked, "begun": self.begun, "ended": self.ended}, file, indent=1)
            os.replace(part, self.path)
        except OSError as error:
            raise PulmoError(f"sweep: {self.path} cannot be written ({error.strerror}); choose another directory or free the disk") from None


def sweep(values, scene, mesh, *, directory=None, **arguments):
    """Runs all combinations of some values, one after the other, and returns a DataFrame: a row for each run.

    values: {name of an option without its dash: list of values}. directory: folder for the runs, one folder for each (run_001, ...);
    None: they go away when Python ends. All else as in run(). Called again with a directory, the same sweep keeps the runs that came to
    their end there, or could not go on, and makes the others; a sweep that is not the same is refused.

    Columns: the options that vary, the overall clinical numbers (Run.numbers), `directory`, and `failure`: "" or why that run did
    not reach its end; its numbers are NaN then, and the others go on. A combination that is wrong input raises RunFailed at once.
    """
    one = next((name for name, some in values.items() if isinstance(some, str) or not hasattr(some, "__len__")), None) if isinstance(values, dict) else ""
    if one is not None:
        raise PulmoError("sweep: give {option: [value, value, ...]}" + (f"; {one} has no list of values" if one else ""))
    values = {name: some.tolist() if hasattr(some, "tolist") else list(some) for name, some in values.items()}
    if not values or not all(values.values()):
        raise PulmoError("sweep: there is nothing to vary; give {option: [value, value, ...]}")
    ours = sorted(set(values) & {"scene", "mesh", "directory", "solver", "ranks"})
    if ours:
        raise PulmoError(f"sweep: {ours[0]} is no option of the program; call sweep once for each")
    both = sorted(set(values) & set(arguments))
    if both:
        raise PulmoError(f"sweep: {both[0]} is both varied and given")
    combinations = [dict(zip(values, combination)) for combination in itertools.product(*values.values())]
    again = arguments.get("output_overwrite") not in (None, False, "off")  # all of it, and as the caller says
    record = _Record(directory, [command(scene, mesh, **arguments | chosen) for chosen in combinations], again) if directory else None
    rows = []
    for number, chosen in enumerate(combinations, 1):
        name = f"run_{number:03d}"
        where = os.path.join(os.fspath(directory), name) if directory else _new_directory()
        made = record and record.made(name)
        more = {"output_overwrite": True} if record and record.ours(name) and not again else {}
        try:
            failure = "" if not made else record.ended[name]
            numbers = {} if failure else dict((made or run(scene, mesh, directory=where, **arguments | chosen | more)).numbers)
        except RunFailed as error:
            if error.code == 1:
                raise
            numbers, failure = {}, str(error)
            if record and error.code == 2:  # it would fail again
                record.note(name, failure)
        else:
            if record:
                record.note(name, failure)
        rows.append(chosen | numbers | {"directory": where, "failure": failure})
    table = pandas().DataFrame(rows)
    return table[[name for name in table.columns if name not in ("directory", "failure")] + ["directory", "failure"]]
