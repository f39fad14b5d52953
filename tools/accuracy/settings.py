"""What a run is set to: mesh, steps in time, solver; and the ladder of each."""
import contextlib
import io
import json
import math
import re
import resource
import shlex
import time
from dataclasses import dataclass
from pathlib import Path

import meshio

from shared.common import SOLVERS, fail
from shared.keys import make_mesh

from .numbers import percent

ADAPTIVE = 1e-2     # largest error that a step may make in the ladder of adaptive steps, of V_T and PIP
SCHEMES = {"beuler": "backward Euler", "bdf": "BDF2"}
ORDERS = {"beuler": 1, "bdf": 2}
ELEMENTS = ["P2-P1", "P1-P1", "P3-P2"]
AIRWAY = 5          # size of the lung's cells over that of the airway's (tools/lung_mesh: 15 and 3 mm)
ALIKE = 1.05        # meshes whose numbers of cells differ by less than this factor are no two levels
OURS = {"-dm_refine": "the ladder in space refines meshes itself; use --refine",
        "-step_volume_tolerance": "the ladder in time chooses the steps; use --adaptive",
        "-step_pressure_tolerance": "the ladder in time chooses the steps; use --adaptive",
        "-error_estimate": "it makes runs of its own, whose time would count as the setting's",
        "-restart": "each run of a ladder begins at rest",
        "-output_dir": "it is chosen by the tool; --output names the folder"}


@dataclass(frozen=True)
class Mesh:
    """A level in space. words: options that give it. cells: tetrahedra. origin: what makes its file, for the reader.
    elements: the pair, empty if it is the scene's."""
    name: str
    words: tuple
    cells: int
    origin: str = ""
    elements: str = ""

    def size(self):
        """Relative mean edge length."""
        return self.cells ** (-1 / 3)


@dataclass(frozen=True)
class Steps:
    """A level in time: integrator, size of the (first) step in s; with a tolerance (of V_T and of PIP) steps by their error."""
    scheme: str
    dt: float
    tolerance: float = 0

    @property
    def name(self):
        adaptive = f", error of a step {100 * self.tolerance:.2g} %" if self.tolerance else ""
        return f"{SCHEMES[self.scheme]} {'from ' if self.tolerance else ''}{self.dt:.6g} s{adaptive}"

    def words(self, volume, pressure):
        """Options; volume and pressure: V_T (ml) and PIP (cmH2O) that the tolerance refers to."""
        words = ["-ts_type", self.scheme, "-ts_dt", f"{self.dt:.10g}"]
        if self.tolerance:
            words += ["-step_volume_tolerance", f"{self.tolerance * volume:.3g}",
                      "-step_pressure_tolerance", f"{self.tolerance * pressure:.3g}"]
        return words


@dataclass(frozen=True)
class Solver:
    """A solver file and the options that follow it; tolerance: -snes_rtol if they set it."""
    name: str
    file: Path
    more: tuple = ()
    tolerance: float = math.inf


@dataclass(frozen=True)
class Setting:
    mesh: Mesh
    steps: Steps
    solver: Solver

    @property
    def name(self):
        return f"{self.mesh.name} | {self.steps.name} | {self.solver.name}"


def with_files(words):
    """Words, each option file among them followed by the words that it holds."""
    found = []
    for before, word in zip([None, *words], words):
        found.append(word)
        if before == "-options_file" and Path(word).is_file():
            found += with_files(plain_options(Path(word)))
    return found


def of_files(words, key, default=None):
    """Last value of an option among words and the option files that they name, as PETSc reads them."""
    words = with_files(words)
    for word, value in zip(words, [*words[1:], None]):
        if word == key:
            default = value
    return default


def names_of(words):
    """Names of all options among words and the option files that they name."""
    return {word for word in with_files(words) if word.startswith("-")}


def refuse_ours(words, elements):
    """Ends the program if the scene or the user's flags set what the ladders set."""
    ours = OURS | ({"-elements": "--elements names the pairs"} if any(elements) else {})
    for name in sorted(names_of(words) & ours.keys()):
        fail(f"{name} cannot be among the options of the scene or after --: {ours[name]}")


def plain_options(path):
    """Words of an option file."""
    return [word for line in path.read_text().splitlines() for word in shlex.split(re.sub(r"(^|\s)#.*", "", line))]


def cells_of(path):
    """Tetrahedra of a mesh file."""
    with contextlib.redirect_stdout(io.StringIO()):  # meshio prints empty lines
        return sum(len(block.data) for block in meshio.read(path).cells if block.type == "tetra")


def lung_words(size):
    """Words for tools/lung_mesh that make a pair of built-in lungs of a size (mm)."""
    return ["--side", "both", "--size", f"{size:g}", "--airway-size", f"{size / AIRWAY:g}"]


class Clock:
    """Seconds, wall or cpu of programs that were started, of what is done within `with`."""

    def __init__(self, kind):
        self.kind, self.seconds = kind, 0.0

    def now(self):
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.monotonic() if self.kind == "wall" else used.ru_utime + used.ru_stime

    def __enter__(self):
        self.begin = self.now()
        return self

    def __exit__(self, *_):
        self.seconds = self.now() - self.begin


def lung(size, folder, clock):
    """A pair of built-in lungs of a size (mm), made by tools/lung_mesh; and the seconds that took."""
    path = folder / f"pair_{size:g}.msh"
    seconds = folder / f"pair_{size:g}.json"
    if not seconds.exists():
        path.unlink(missing_ok=True)
    with Clock("wall") as wall, Clock("cpu") as cpu:
        made = make_mesh(path, "lung_mesh", lung_words(size))
    if made:
        seconds.write_text(json.dumps({"wall": wall.seconds, "cpu": cpu.seconds}) + "\n")
    return path, json.loads(seconds.read_text())[clock]


def meshes(options, scene):
    """The ladder in space, coarse to fine, and the seconds that making it took."""
    given, seconds, origins = list(options.meshes or []), 0, dict(options.origins)
    own = of_files(scene, "-dm_plex_filename")
    if options.lung or not (given or own):
        sizes = sorted(options.lung or [30, 21, 15], reverse=True)
        made = [lung(size, options.results / "meshes", options.clock) for size in sizes]
        given, seconds = [path for path, _ in made], sum(s for _, s in made)
        origins = {path: shlex.join(["tools/lung_mesh", *lung_words(size), "--output", str(path)]) for size, path in zip(sizes, given)}
    ladder = []
    for path in given or [Path(own)]:
        if not path.is_file():
            fail(f"there is no mesh {path}")
        words, cells = (("-dm_plex_filename", str(path)) if given else ()), cells_of(path)
        if not cells:
            fail(f"the mesh {path} has no tetrahedra")
        for level in range(options.refine + 1):
            refined = ("-dm_refine", str(level)) if level else ()
            for elements in options.elements:
                ladder.append(Mesh(" ".join([path.stem, *([f"refined {level} x"] if level else []), *([elements] if elements else [])]),
                                   words + refined + (("-elements", elements) if elements else ()), cells * 8 ** level,
                                   origins.get(path, ""), elements))
    ladder.sort(key=lambda mesh: (options.elements.index(mesh.elements), mesh.cells))
    for coarse, fine in zip(ladder, ladder[1:]):
        if fine.elements == coarse.elements and fine.cells < ALIKE * coarse.cells:
            fail(f"the meshes {coarse.name} and {fine.name} have {coarse.cells} and {fine.cells} tetrahedra: levels of the ladder in "
                 f"space have to differ by {percent(ALIKE - 1)} at least")
    return ladder, seconds


def steps(options, dt):
    """The ladder in time."""
    ladder = [Steps(scheme, dt * factor) for scheme in options.schemes for factor in options.dt_factors]
    for scheme in options.schemes:
        for k in range(options.adaptive):
            # the local error of a step goes with its size to the order + 1
            ladder.append(Steps(scheme, dt / 4 / 2 ** k, ADAPTIVE / 2 ** (k * (ORDERS[scheme] + 1))))
    return ladder


def solvers(options):
    """The solvers: the base first, then looser and tighter Newton tolerances, then other files."""
    ladder = []
    for name in options.solvers:
        path = Path(name) if Path(name).is_file() else SOLVERS / f"{name}.opts"
        if not path.is_file():
            fail(f"there is no solver file {name}; there are {', '.join(p.stem for p in sorted(SOLVERS.glob('*.opts')))}")
        if not any(path.samefile(other.file) for other in ladder):
            ladder.append(Solver(path.stem, path))
    base = ladder[0]
    for rtol in options.tolerances:
        more = ("-snes_rtol", f"{rtol:g}") + (("-snes_atol", "1e-12") if rtol < 1e-9 else ())
        ladder.append(Solver(f"{base.name}, snes_rtol {rtol:g}", base.file, more, rtol))
    return ladder
