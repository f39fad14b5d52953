"""From a segmented CT, or a mesh, to a page about a ventilated breath.

  tools/breathe labels.nii.gz --volume 2500ml --mode vcv --tidal-volume 500 --peep 5
  tools/breathe my.msh --mode pcv --pip 12 --effects supine,recruitment -- -tissue yoshihara
  tools/breathe results/labels-vcv            # goes on with what an earlier call began

Stages: mesh (made by tools/lung_mesh from a mask, checked if it is a file), dry run (the scene in words, memory and time),
run, report. All of it goes into one folder, --case, which also holds the options, the files that they name, and versions, so that
`run.sh` there does the run again. A call that was interrupted goes on where it stopped when it is given again. Options of pulmo follow
after --; they count in the end.
"""
import argparse
import os
import shlex
import sys
from pathlib import Path

from shared.common import SCENES, SOLVERS, SOURCE, fail, listed, offered, require
from shared.keys import LOCK, lock

from . import stages
from .case import Case, digest_of_source

NUMBERS = {"tidal_volume": "ml", "pip": "cmH2O", "peep": "cmH2O", "inspiration": "s", "expiration": "s", "breaths": ""}
CELLS_FOR_A_RANK = 4000  # fewer cells are not worth a second process
MOST_PER_CORE = 32  # processes: they wait for each other, and memory grows with them


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence."""

    def error(self, message):
        self.exit(1, f"tools/breathe: error: {message}; see --help\n")


def parse(words):
    cut = words.index("--") if "--" in words else len(words)
    parser = Parser(prog="tools/breathe", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, metavar="MASK, MESH or CASE", help=(
        "label image (.nii, .nii.gz), folder of label images, mesh (.msh), or the folder of an earlier call"))
    parser.add_argument("--case", type=Path, metavar="DIR", help="folder for all of it (default: results/<name>-<mode>)")
    parser.add_argument("--mode", default="pcv", help="a scene of petsc_options/scenes, as pcv, vcv, supersyringe, or an option file (default: pcv)")
    for name, unit in NUMBERS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", metavar=unit.upper() or "N", help=f"-ventilator_{name} of pulmo{', ' + unit if unit else ''}")
    parser.add_argument("--tissue", metavar="LAW", help="law of the tissue (default: the scene's)")
    parser.add_argument("--effects", default="", metavar="NAME,...", help=(
        "effects to add, by their names (pulmo -list), or pieces of scenes in petsc_options/scenes, as supine, obesity"))
    parser.add_argument("--elements", choices=["P2-P1", "P1-P1"], help="P1-P1: a quarter of the time (default: P2-P1)")
    parser.add_argument("--solver", default="iterative", help="a file of petsc_options/solvers (default: iterative)")
    parser.add_argument("--within", metavar="NAME=1%", help=(
        "look first for mesh, steps and elements that give a number to this accuracy (tools/accuracy_cost), and run with them"))
    parser.add_argument("--budget", help="time that this search may take (default: 30min)")
    mask = parser.add_argument_group("of a mask (tools/lung_mesh)")
    mask.add_argument("--volume", metavar="ML", help="volume of the lungs at rest, as 2500ml (default: the scan's)")
    mask.add_argument("--size", metavar="MM", help="edge of the cells")
    mask.add_argument("--cells", metavar="N", help="number of cells to aim at")
    mask.add_argument("--labels", metavar="PART=NUMBER,...", help="what the labels are, as right=1,left=2,airway=3")
    parser.add_argument("--ranks", type=int, help=f"processes (default: one for every {CELLS_FOR_A_RANK} cells, at most one for each core)")
    parser.add_argument("--dry-run", action="store_true", help="stop after mesh and dry run")
    parser.add_argument("--overwrite", action="store_true", help="replace what an earlier call with other words left in the folder (files of yours stay)")
    parser.add_argument("--build", type=Path, default=SOURCE / "build", help="build folder (default: build)")
    given = parser.parse_args(words[:cut])
    given.flags = words[cut + 1:]
    if given.ranks is not None and given.ranks < 1:
        fail("--ranks must be at least 1")
    if given.ranks and given.ranks > MOST_PER_CORE * len(os.sched_getaffinity(0)):
        fail(f"--ranks {given.ranks} is more than {MOST_PER_CORE} for each of the {len(os.sched_getaffinity(0))} cores at hand, which would stop the machine; lower it")
    if given.budget and not given.within:
        fail("--budget limits the search of --within: give both, or neither")
    return given


def option_file(option, name, folder):
    """The option file that an option of the call names: one of a folder of petsc_options by its short name, or a path."""
    for path in (folder / f"{name}.opts", Path(name)):
        if path.is_file():
            return path
    fail(f"{option} {name} is no option file, and none of petsc_options/{folder.name}: {', '.join(sorted(p.stem for p in folder.glob('*.opts')))}")


def scene_file(name):
    return option_file("--mode", name, SCENES)


def solver_file(name):
    return option_file("--solver", name, SOLVERS)


def scene_words(given):
    """The words of the scene: mode and effects."""
    words = ["-options_file", str(scene_file(given.mode))]
    program = given.build / "pulmo"
    for name in filter(None, given.effects.split(",")):
        if (SCENES / f"{name}.opts").is_file():
            words += ["-options_file", str(SCENES / f"{name}.opts")]
        elif name in offered(program, "effect"):
            words.append(f"-{name}")
        else:
            fail(f"--effects {name} is neither an effect ({', '.join(offered(program, 'effect'))}) nor a piece of a scene in petsc_options/scenes")
    return words


def own_words(given):
    """What overrides scene and solver: numbers, law, elements, pulmo's own options."""
    words = []
    for name in NUMBERS:
        if getattr(given, name) is not None:
            words += [f"-ventilator_{name}", getattr(given, name)]
    for option in ("tissue", "elements"):
        if getattr(given, option):
            words += [f"-{option}", getattr(given, option)]
    return words + given.flags


def stem(path):
    """'labels' of a/labels.nii.gz."""
    name = path.resolve().name
    return name[:name.index(".", 1)] if "." in name[1:] else name


def begin(words):
    """The case that the words of a call ask for, made or taken up again."""
    given = parse(words)
    if (given.source / "case.json").is_file():
        case, dry = Case(given.source), given.dry_run
        more = [word for word in words if word != "--dry-run" and Path(word) != given.source]
        if more:
            fail(f"{given.source} is the folder of an earlier call, which goes on as it was called: leave out {' '.join(more)}, or give the mask or mesh again")
        lock(case.folder)
        given = parse(case.call)
        require(given.build, [])
        if "mesh" not in case.done and not (given.source.exists() and digest_of_source(given.source) == case.made_of["source"]):
            fail(f"{given.source}, which {case.folder} is to be made of, is not there any more, or has changed: give it again with --overwrite")
        return case, given, dry
    if not given.source.exists():
        fail(f"there is no {given.source}: give a label image, a folder of them, a mesh (.msh) or the folder of an earlier call")
    require(given.build, [])
    is_mesh = given.source.suffix == ".msh"
    if not is_mesh and not given.source.is_dir() and not given.source.name.endswith((".nii", ".nii.gz")):
        fail(f"{given.source} is no label image (.nii, .nii.gz) and no mesh (.msh); tools/lung_mesh --convert makes one of other formats")
    if is_mesh:
        for option in stages.FOR_MASKS:
            if getattr(given, option):
                fail(f"--{option} makes a mesh of a mask, and {given.source} is a mesh already: leave it out")
    listed(given.build / "pulmo")  # before any folder is made
    words_of = {"scene": scene_words(given), "solver": ["-options_file", str(solver_file(given.solver))], "own": own_words(given)}
    mode = given.mode if (SCENES / f"{given.mode}.opts").is_file() else stem(Path(given.mode))
    folder = given.case or Path("results") / f"{stem(given.source)}-{mode}"
    if folder.exists() and not folder.is_dir():
        fail(f"--case {folder} is a file: name a folder")
    if folder.exists() and not (folder / "case.json").exists() and any(path.name != LOCK for path in folder.iterdir()):
        fail(f"--case {folder} holds other files: name a new folder")
    lock(folder)
    places = {given.source, given.build}
    absolute = [str(Path(word).resolve()) if Path(word) in places else word for word in words if word not in ("--dry-run", "--overwrite")]
    return Case.take(folder, absolute, given.source, words_of, given.overwrite), given, given.dry_run


def main(words):
    try:
        with stages.handled(stages.interrupt):
            return make(words)
    except KeyboardInterrupt:
        sys.exit("\nbreathe: interrupted before anything was done")
    except OSError as error:
        fail(f"{error.filename or 'a file'} cannot be read or written ({error.strerror}); what was finished is kept")


def make(words):
    """Carries out a call; returns the exit code."""
    case, given, only_dry = begin(words)
    print(f"breathe: all of it goes into {case.folder}", flush=True)
    try:
        stages.mesh(case, given)
        if given.within:
            stages.accuracy(case, given)
        ranks = given.ranks or stages.ranks_for(case, CELLS_FOR_A_RANK)
        cores = len(os.sched_getaffinity(0))
        if ranks > cores:
            stages.say(f"--ranks {ranks} is more than the {cores} core{'s' * (cores > 1)} at hand: they wait for each other, and memory grows with them")
        stages.dry_run(case, given, ranks)
        if only_dry:
            print(f"breathe: that was the dry run; {shlex.join(['tools/breathe', str(case.folder)])} goes on")
            return 0
        code = stages.run(case, given, ranks)
        stages.report(case)
    except KeyboardInterrupt:
        sys.exit(f"\nbreathe: interrupted; {shlex.join(['tools/breathe', str(case.folder)])} goes on from what is there")
    stages.tell(case, code)
    return code
