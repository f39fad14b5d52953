"""`tools/benchmark strategies`: one scene with several sets of solver flags, side by side."""
import shlex
import statistics
from pathlib import Path

from shared.common import SCENES, SOLVERS, SOURCE, blas, fail, processor, require, write_table

from . import plots, runs

HEADER = ["flags", "outcome", "steps", "rejected", "Newton", "Krylov", "Krylov/Newton", "wall s", *(f"{s} s" for s in runs.STAGES),
          "CPU s", "memory MB", "volume difference", "pressure difference", "remark"]


def arguments(parser):
    parser.usage = "tools/benchmark strategies SCENE [SCENE ...] [options] -- 'FLAGS' ['FLAGS' ...]"
    parser.add_argument("scene", nargs="+", help="option files of the scene, or names in petsc_options/scenes")
    parser.add_argument("--mesh", type=Path, default=SOURCE / "meshes/lung_test.msh", help="default: meshes/lung_test.msh")
    parser.add_argument("--time", type=float, help="end of the run, s (default: the scene's)")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks (default: mpiexec -n)")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each entry; times are medians (default 1)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--output", type=Path, default=SOURCE / "results/strategies", help="default: results/strategies")


def scene_file(name):
    """Path of an option file of a scene, given by path or by name."""
    for path in (Path(name), SCENES / f"{name}.opts"):
        if path.is_file():
            return path
    fail(f"there is no scene {name}; give an option file or one of {', '.join(sorted(p.stem for p in SCENES.glob('*.opts')))}")


def solver_words(flags):
    """The words of a string of flags; @name at its start is a file of petsc_options/solvers."""
    try:
        words = shlex.split(flags)
    except ValueError as error:
        fail(f"cannot read the flags '{flags}': {error}")
    if not words:
        fail("an empty string of flags; give at least a solver file, e.g. '@direct'")
    if words[0].startswith("@"):
        path = SOLVERS / f"{words[0][1:]}.opts"
        if not path.is_file():
            fail(f"'{flags}': there is no solver file {words[0]}; there are "
                 + ", ".join("@" + p.stem for p in sorted(SOLVERS.glob("*.opts"))))
        words[:1] = ["-options_file", str(path)]
    elif not words[0].startswith("-"):
        fail(f"'{flags}' starts neither with an option nor with @ and the name of a solver file")
    if "-output_dir" in words:
        fail(f"'{flags}': -output_dir is chosen by the benchmark")
    return words


def measure(entries, common, options):
    """Runs each of `entries` (label: words) `options.repeat` times, in turns; label: list of results."""
    results = {label: [] for label in entries}
    for repeat in range(options.repeat):
        for i, (label, words) in enumerate(entries.items()):
            print(f"[{repeat * len(entries) + i + 1}/{options.repeat * len(entries)}] {label}", flush=True)
            start = [] if options.ranks == 1 else [*shlex.split(options.launcher), str(options.ranks)]
            result = runs.measured([*start, options.build / "pulmo", *common, *words, "-output_dir"], options.output / "runs",
                                   repeat, options.ranks, options.timeout)
            outcome = f"failed: {result['reason']}" if result["code"] else "finished"
            print(f"    {outcome}, {result['wall']:.1f} s, {result['memory']:.0f} MB"
                  + (" (kept from an earlier call)" if result["kept"] else ""), flush=True)
            results[label].append(result)
    return results


def row(label, results, reference):
    """A line of the table; counts of the first run, medians of seconds, largest memory."""
    first, seconds = results[0], runs.stage_seconds(results)
    summary = first.get("summary", {})
    newton, krylov = summary.get("newton_iterations"), summary.get("krylov_iterations")
    counts = [summary.get(key, "-") for key in ("steps", "rejected_steps", "newton_iterations", "krylov_iterations")]
    remark = "; ".join(([first["reason"]] if first["code"] else []) + runs.warnings(first))
    return [label, "failed" if any(r["code"] for r in results) else "finished", *counts,
            f"{krylov / newton:.1f}" if newton else "-", f"{seconds['total']:.2f}",
            *(f"{seconds[s]:.2f}" if s in seconds else "-" for s in runs.STAGES),
            f"{statistics.median(r['cpu'] for r in results):.2f}", f"{max(r['memory'] for r in results):.0f}",
            *("-" if d is None else f"{d:.1e}" for d in runs.differences(first, reference)), remark]


def mesh_sentence(mesh, results):
    """Name and size of the mesh, from the first run that tells it."""
    for group in results.values():
        for r in group:
            if "cells" in r.get("summary", {}):
                return f"{mesh.name}: {r['summary']['cells']} tetrahedra, {r['summary']['dofs']} dofs"
    return mesh.name


def run(options):
    if not options.flags:
        fail("no strategies; give them after --, e.g. -- '@direct' '@iterative -ksp_rtol 1e-3'")
    if len(set(options.flags)) < len(options.flags):
        fail("a string of flags is given twice; --repeat measures again")
    if options.repeat < 1 or options.ranks < 1:
        fail("--repeat and --ranks must be at least 1")
    require(options.build, [options.mesh])
    scenes = [scene_file(name) for name in options.scene]
    common = ["-dm_plex_filename", options.mesh]
    for path in scenes:
        common += ["-options_file", path]
    if options.time is not None:
        common += ["-ts_max_time", f"{options.time:g}"]
    results = measure({flags: solver_words(flags) for flags in options.flags}, common, options)

    reference = results[options.flags[0]][0]
    rows = [row(label, group, reference) for label, group in results.items()]
    everything = [r for group in results.values() for r in group]
    title = f"Solver strategies: {' + '.join(p.stem for p in scenes)} on {mesh_sentence(options.mesh, results)}"
    notes = (f"{options.ranks} rank{'s' if options.ranks > 1 else ''} on {processor()}, {blas(options.build / 'pulmo')} with one "
             f"thread, {runs.load_range(everything)}; "
             f"{'one run each' if options.repeat == 1 else f'medians of {options.repeat} runs'}"
             + (f", up to t = {options.time:g} s" if options.time is not None else "") +
             ". Differences: largest over all common times, relative to the largest value of the first entry. Wall and stage "
             "seconds are the program's own, CPU seconds and memory those of the whole process"
             f"{'' if options.ranks == 1 else ' (all ranks)'}.")
    write_table(options.output, "strategies", title, HEADER, rows, notes)
    plots.side_by_side(options.output / "strategies.png", title,
                       [(label, runs.stage_seconds(group), max(r["memory"] for r in group), group[0], group[0]["code"] != 0)
                        for label, group in results.items()])
