"""What accuracy costs in time, for a scene of your own.

  tools/accuracy_cost pcv --meshes a.msh b.msh c.msh --budget 10min
  tools/accuracy_cost my.opts --budget 30min -- -dm_plex_filename my.msh -tissue yoshihara
  tools/accuracy_cost pcv --lung 30 21 15 11 --question C_rs=1%

Runs a scene with ladders of meshes, of time steps (backward Euler, BDF2, steps by their error) and of solver tolerances, each
alone and then jointly, cheapest first, until the budget is used or the question is answered. Leaves in --output:
README.md (answers, reference, all runs, pictures), accuracy.csv, and for each tolerance that is met an option file
recommended_<p>percent.opts of the cheapest setting. Options of pulmo follow after --, but not those that the ladders set
(-dm_refine, -step_volume_tolerance, -step_pressure_tolerance) nor -error_estimate, -restart, -output_dir. A finished run with
the same command, program, environment and files (also those that option files name) is not repeated; its time counts for the budget
all the same. One call at a time works in --output and --results.

Meshes: --meshes FILE ... (one body, coarse to fine), or --refine N (each mesh cut N times, nested), or the built-in pair of
lungs at the sizes of --lung (the default if neither the scene nor the options after -- name a mesh).
"""
import argparse
import re
import signal
import sys
from pathlib import Path

from benchmarks.strategies import scene_file
from shared.common import RESULTS, SOURCE, fail, require
from shared.keys import lock

from . import page, settings
from .errors import Axes
from .goal import Goal
from .ladder import Ladder
from .numbers import ALIASES, LEVELS, question
from .search import Search

UNITS = {"": 1, "s": 1, "min": 60, "h": 3600}


def seconds(text):
    """Seconds of 90, 90s, 10min or 2h."""
    found = re.fullmatch(r"([0-9.]+)\s*(s|min|h|)", text)
    if not found or float(found[1]) <= 0:
        raise argparse.ArgumentTypeError(f"cannot read the time '{text}'; write it like 10min")
    return float(found[1]) * UNITS[found[2]]


def parse(words):
    cut = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(prog="tools/accuracy_cost", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="+", help="option files of the scene, or names in petsc_options/scenes")
    parser.add_argument("--budget", type=seconds, default=600.0, help="time for all runs, e.g. 90s, 10min, 2h (default 10min)")
    parser.add_argument("--clock", choices=["wall", "cpu"], default="wall",
                        help="what counts for the budget and as the cost: wall, or cpu on a machine that others use too")
    parser.add_argument("--question", action="append", default=[], metavar="NAME=1%",
                        help=f"a number and its tolerance (repeatable): {', '.join(ALIASES)} or a key of summary.json; the ladder ends "
                        "as soon as all are answered")
    parser.add_argument("--method", choices=["ladder", "sweep", "auto"], default="ladder", help=(
        "how a question is answered: by ladders; by the errors that one sweep back over each run tells, changing what is cheapest; or by "
        "sweeps where the scene lets them (default ladder)"))
    parser.add_argument("--no-adapt", dest="adapt", action="store_false", help=(
        "with sweeps: new meshes of built-in lungs have cells of one size, and a mesh from a file is refined as a whole (default: both by the "
        "errors of the run before)"))
    parser.add_argument("--numbers", nargs="+", metavar="NAME", help="without a question: the numbers that have to be met (default: those of "
                        f"{' '.join(ALIASES)} that the scene has)")
    parser.add_argument("--meshes", type=Path, nargs="+", help="meshes of one body, coarse to fine")
    parser.add_argument("--refine", type=int, default=None, metavar="N",
                        help="each mesh also cut in eight 1 ... N times (default: 1 if there is one mesh only, else 0)")
    parser.add_argument("--lung", type=float, nargs="+", metavar="MM", help="sizes of the built-in pair of lungs (default 30 21 15)")
    parser.add_argument("--elements", nargs="+", choices=settings.ELEMENTS, default=[""], metavar="PAIR",
                        help=f"element pairs, the base first: {' '.join(settings.ELEMENTS)} (default: the scene's alone)")
    parser.add_argument("--dt", type=float, help="the base's step, s (default: -ts_dt of the scene or solver file)")
    parser.add_argument("--dt-factors", type=float, nargs="+", default=[4, 2, 1, 0.5, 0.25, 0.125], help="default: 4 2 1 0.5 0.25 0.125")
    parser.add_argument("--schemes", nargs="+", choices=list(settings.SCHEMES), default=list(settings.SCHEMES))
    parser.add_argument("--adaptive", type=int, default=3, metavar="N", help="levels of steps by their error (default 3)")
    parser.add_argument("--solvers", nargs="+", default=["iterative", "direct", "reuse"],
                        help="solver files or names, the base first (default: iterative direct reuse)")
    parser.add_argument("--tolerances", type=float, nargs="*", default=[1e-4, 1e-12], metavar="RTOL",
                        help="-snes_rtol of further runs with the first solver (default 1e-4 1e-12)")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks (default: mpiexec -n)")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each setting; times are medians (default 1)")
    parser.add_argument("--build", type=Path, default=SOURCE / "build", help="build folder (default: build)")
    parser.add_argument("--output", type=Path, default=RESULTS / "accuracy", help="default: results/accuracy")
    parser.add_argument("--results", type=Path, help="folder of the runs and of meshes that are made (default: --output)")
    options = parser.parse_args(words[:cut])
    options.flags = words[cut + 1:]
    options.results = options.results or options.output
    try:
        options.asked = dict(map(question, options.question))
    except ValueError as error:
        fail(str(error))
    for name in ("lung", "dt_factors", "schemes", "solvers", "tolerances", "numbers", "elements"):
        given = getattr(options, name)
        setattr(options, name, given and list(dict.fromkeys(given)))
    options.meshes = options.meshes and list({path.resolve(): path for path in options.meshes}.values())
    if options.method == "sweep" and not options.asked:
        fail("--method sweep answers a --question; give one")
    if min(options.repeat, options.ranks) < 1 or min(options.dt_factors) <= 0 or options.adaptive < 0 or (options.refine or 0) < 0:
        fail("--repeat and --ranks must be at least 1, --dt-factors positive, --adaptive and --refine not negative")
    return options


def axes(options, scene):
    """The ladders, and the seconds that making meshes took."""
    solvers = settings.solvers(options)
    words = [*scene, "-options_file", str(solvers[0].file), *options.flags]
    if options.refine is None:
        alone = not options.lung and (len(options.meshes) == 1 if options.meshes else settings.of_files(words, "-dm_plex_filename"))
        options.refine = 1 if alone else 0
    meshes, spent = settings.meshes(options, words)
    dt = options.dt or float(settings.of_files(words, "-ts_dt", "0.05"))
    steps = settings.steps(options, dt)
    first = next((t for t in steps if t.dt == dt and not t.tolerance), None)
    if first is None:
        fail("--dt-factors must hold 1: the base's step")
    return Axes(meshes, steps, solvers, settings.Setting(meshes[0], first, solvers[0])), spent


def by_sweeps(options, words):
    """The answer to a question by sweeps, in sentences; None where the scene lets none and ladders may take over."""
    goal = Goal(options.asked, [word for name in options.scene for word in ("-options_file", str(scene_file(name)))], options)
    if goal.solve():
        sentences = goal.write(page.command_line(words))
        print("\n".join(sentences))
        return sentences
    if options.method == "sweep" or "-error_estimate_method sweep" not in goal.refused:
        fail(f"no answer by sweeps: {goal.refused}")
    print("no sweep is possible here: ladders", flush=True)
    return None


def guard(options):
    """The words of the scene, once it is known that its options are none of the tool's, and its folders are locked."""
    require(options.build, [])
    scene = [word for name in options.scene for word in ("-options_file", str(scene_file(name)))]
    settings.refuse_ours([*scene, *options.flags], options.elements)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("tools/accuracy_cost: ended; finished runs are kept"))
    for folder in (options.output, options.results):
        lock(folder)
    return scene


def prepare(words, origins=None):
    """The search that the words of a command ask for; no run is made. origins: commands that made the given meshes, by path."""
    options = parse(words)
    options.origins = origins or {}
    scene = guard(options)
    found, spent = axes(options, scene)
    named = list(options.asked) or [ALIASES.get(name, name) for name in options.numbers or []]
    ladder = Ladder(found, scene, options.flags, options, spent)
    return Search(ladder, named or list(ALIASES.values()), options.asked, LEVELS, named)


def explore(words, origins=None):
    """Makes the runs that the words of a command ask for and writes its folder; the search and its sentences."""
    try:
        options = parse(words)
        if options.method != "ladder" and options.asked:
            guard(options)
            if by_sweeps(options, words):
                return None
        search = prepare(words, origins)
        ladder = search.ladder
        search.explore()
    except KeyboardInterrupt:
        sys.exit("tools/accuracy_cost: interrupted; finished runs are kept")
    sentences = page.write(search, page.command_line(words))
    print("\n".join(sentences))
    print(f"{len(ladder.done) + len(ladder.failed)} runs, {ladder.new} of them new; {len(ladder.failed)} failed, {len(ladder.skipped)} left out")
    if not ladder.done:
        sys.exit(1)
    return search, sentences
