"""`tools/benchmark scaling`: strong scaling over ranks, growth with the mesh, messages and bytes, and a model of larger machines.

Every mesh is run on every number of ranks (PCV scene, a few steps). Counts of messages, bytes and reductions are
PETSc's own (-log_view): they do not depend on how busy the machine is, nor on whether there is a core for each rank, so
that --count-ranks may exceed the cores. The model takes seconds per cell from the largest mesh on the most timed ranks, counts
from all runs on several ranks, the surfaces of the parts from METIS itself, and latency and bandwidth of a network from
the options.
"""
import csv
import ctypes
import math
import shlex
import statistics
from pathlib import Path

import numpy as np

from shared.common import PAPER, PLAIN, SCENES, SOURCE, blas, fail, markdown, processor, require, show, write_csv, write_table
from shared.keys import make_lung

from . import plots, runs
from .plots import plt
from .strategies import solver_words

READING = SOURCE / "docs/performance/reading.md.in"  # of a mesh of a million tetrahedra, measured by hand
COUNTS = ("messages", "bytes", "reductions")
HEADER = ["mesh", "tetrahedra", "dofs", "ranks", "steps", "Newton", "Krylov", "setup s", "residual s/step", "Jacobian s/step",
          "solve s/step", "s/step", "µs/step/tet", "speed-up", "efficiency", "imbalance", "messages/rank/step", "MB/rank/step",
          "reductions/step", "memory MB"]
MODEL_HEADER = ["tetrahedra", "ranks", "tetrahedra/rank", "s/step", "speed-up", "efficiency", "computing", "surfaces", "latency",
                "reductions", "memory GB/rank", "mesh reading s"]
CHECK_HEADER = ["mesh", "ranks", "what", "measured", "model", "model/measured"]


def arguments(parser):
    parser.usage = "tools/benchmark scaling [options] [-- 'FLAGS']"
    parser.add_argument("--cells", type=int, nargs="+", default=[4000, 15000],
                        help="tetrahedra of the lungs that are made (default 4000 15000)")
    parser.add_argument("--mesh", type=Path, nargs="+", help="meshes of your own instead")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2], help="timed (default 1 2); the first is the yardstick")
    parser.add_argument("--count-ranks", type=int, nargs="*", default=[4], help="only messages and bytes are used (default 4)")
    parser.add_argument("--launcher", default="mpiexec --oversubscribe -n",
                        help="words before the number of ranks (default: mpiexec --oversubscribe -n)")
    parser.add_argument("--time", type=float, default=0.1, help="end of the run, s (default 0.1: two steps)")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each; times are medians (default 1)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--predict-cells", type=float, nargs="+", default=[250e3, 1e6, 4e6])
    parser.add_argument("--predict-ranks", type=int, nargs="+", default=[8, 16, 32, 64, 128, 256])
    parser.add_argument("--latency", type=float, default=2e-6, help="of the network, s per message (default 2e-6)")
    parser.add_argument("--bandwidth", type=float, default=1e9, help="of the network, bytes/s per rank (default 1e9)")
    parser.add_argument("--results", type=Path, default=SOURCE / "results/scaling", help="where runs are kept (default: results/scaling)")
    parser.add_argument("--output", type=Path, default=SOURCE / "docs/performance", help="of the page (default: docs/performance)")


# --------------------------------------------------------------------------------------------------- what PETSc counts

def parse_log(text):
    """{event: [per rank: {count, seconds, messages, bytes, reductions, flops}]} of -log_view ::ascii_csv, stages summed.

    PETSc counts a message where it is sent and where it is received; here it is counted (with its bytes) where it is sent.
    """
    lines = text.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith("Stage Name,Event Name,")), None)
    if begin is None:
        return {}
    events = {}
    for words in csv.reader(lines[begin + 1:]):
        if len(words) < 9:
            continue
        _, event, rank, count, seconds, messages, length, reductions, flops = (word.strip() for word in words[:9])
        if event == "summary":  # of a stage: it has no count
            words = words[:3] + ["0"] + words[3:]
            rank, count, seconds, messages, length, reductions, flops = (word.strip() for word in words[2:9])
        ranks = events.setdefault(event, [])
        while len(ranks) <= int(rank):
            ranks.append(dict.fromkeys(("count", "seconds", "messages", "bytes", "reductions", "flops"), 0.0))
        for key, value in zip(ranks[int(rank)], (count, seconds, float(messages) / 2, float(length) / 2, reductions, flops)):
            ranks[int(rank)][key] += float(value)
    return events


def mean(events, event, key):
    """Mean over the ranks; 0 if the event did not happen."""
    found = [rank[key] for rank in events.get(event, [])]
    return statistics.mean(found) if found else 0.0


def imbalance(events):
    """Largest over mean floating-point operations of the ranks in the time steps."""
    flops = [rank["flops"] for rank in events.get("TSStep", [])]
    return max(flops) / statistics.mean(flops) if flops and sum(flops) else 1.0


def split(events, summary):
    """What a Newton iteration takes without the Krylov solver, and a Krylov iteration: seconds and counts, mean of ranks."""
    per_krylov, per_newton = {}, {}
    for key in ("seconds", *COUNTS):
        solve, step = mean(events, "KSPSolve", key), mean(events, "TSStep", key)
        per_krylov[key] = solve / summary["krylov_iterations"]
        per_newton[key] = (step - solve) / summary["newton_iterations"]
    return per_newton, per_krylov


# ------------------------------------------------------------------------------------------------- how METIS cuts a mesh

def tetrahedra(mesh):
    """(cells, 4) node numbers of the tetrahedra of a gmsh file."""
    import gmsh  # takes a second, and only this needs it

    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(mesh))
        return gmsh.model.mesh.getElementsByType(4)[1].astype(np.int64).reshape(-1, 4)
    finally:
        gmsh.finalize()


def face_pairs(tets):
    """(faces, 2) cells on both sides of each inner face."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2).reshape(-1, 3)
    order = np.lexsort(faces.T)
    same = np.all(faces[order][1:] == faces[order][:-1], axis=1)
    return np.stack([order[:-1][same], order[1:][same]], axis=1) // 4


def partition(pairs, cells, parts):
    """The part of each cell, by METIS as pulmo calls it."""
    metis = ctypes.CDLL("libmetis.so.5")
    settings = np.zeros(40, np.int32)  # METIS_NOPTIONS
    metis.METIS_SetDefaultOptions(settings.ctypes.data)
    settings[8] = 1  # METIS_OPTION_SEED, as in src/mesh/partitioner.cpp
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    begin = np.zeros(cells + 1, np.int32)
    np.cumsum(np.bincount(ends[:, 0], minlength=cells), out=begin[1:])
    neighbours = np.ascontiguousarray(ends[:, 1], np.int32)
    part = np.zeros(cells, np.int32)

    def number(value):
        return ctypes.byref(ctypes.c_int32(value))

    def array(values):
        return values.ctypes.data_as(ctypes.POINTER(ctypes.c_int32))

    code = metis.METIS_PartGraphKway(number(cells), number(1), array(begin), array(neighbours), None, None, None, number(parts),
                                     None, None, array(settings), number(0), array(part))
    if code != 1:
        fail(f"METIS could not cut the mesh into {parts} parts")
    return part


def surfaces(tets, pairs, parts):
    """Shared faces of a part, mean; parts it shares nodes with, mean; cells of the largest over the mean."""
    if parts == 1:
        return {"faces": 0.0, "neighbours": 0.0, "imbalance": 1.0}
    part = partition(pairs, len(tets), parts)
    faces = 2 * np.count_nonzero(part[pairs[:, 0]] != part[pairs[:, 1]]) / parts
    nodes, number = np.unique(tets, return_inverse=True)
    touched = np.zeros((len(nodes), parts), np.float32)
    touched[number.ravel(), np.repeat(part, 4)] = 1
    neighbours = np.count_nonzero(touched.T @ touched) / parts - 1
    return {"faces": faces, "neighbours": neighbours, "imbalance": np.bincount(part, minlength=parts).max() * parts / len(tets)}


# ------------------------------------------------------------------------------------------------------------- the model

def line_through(x, y):
    """(a, b) of y = a + b x by least squares, neither negative; b alone where x is always the same."""
    if max(x) - min(x) < 1e-9:
        return 0.0, statistics.mean(y) / x[0]
    design = np.stack([np.ones(len(x)), x], axis=1)
    a, b = np.linalg.lstsq(design, np.array(y, float), rcond=None)[0]
    if a < 0:
        return 0.0, float(np.dot(x, y) / np.dot(x, x))
    return (float(a), float(b)) if b >= 0 else (statistics.mean(y), 0.0)


def fit(runs_of_ranks):
    """What a rank sends in a Newton and in a Krylov iteration: messages over its neighbours, bytes over its shared faces.

    `runs_of_ranks`: [{neighbours, faces, newton: {...}, krylov: {...}}] of runs on several ranks. What is sent whatever
    the surface (coarse levels on few ranks) is the constant of the line.
    """
    return {which: {"messages": line_through([r["neighbours"] for r in runs_of_ranks], [r[which]["messages"] for r in runs_of_ranks]),
                    "bytes": line_through([r["faces"] for r in runs_of_ranks], [r[which]["bytes"] for r in runs_of_ranks]),
                    "reductions": statistics.mean(r[which]["reductions"] for r in runs_of_ranks)} for which in ("newton", "krylov")}


def counts(model, which, cut):
    """Messages, bytes and reductions of a rank in one iteration."""
    found = model[which]
    return {"messages": found["messages"][0] + found["messages"][1] * cut["neighbours"],
            "bytes": found["bytes"][0] + found["bytes"][1] * cut["faces"], "reductions": found["reductions"]}


def predict(model, cells, ranks, cut, latency, bandwidth):
    """Seconds of one step on a rank by cause: computing, surfaces (bytes), latency (messages), reductions.

    `model`: `fit`'s, with newton_per_step, krylov_per_step, and seconds (per cell) of a Newton and a Krylov iteration;
    `cut`: faces, neighbours and imbalance of a part. A reduction goes up and down a tree of ranks; one rank sends nothing.
    """
    parts = {"computing": 0.0, "surfaces": 0.0, "latency": 0.0, "reductions": 0.0}
    for which in ("newton", "krylov"):
        n = model[f"{which}_per_step"]
        parts["computing"] += n * model[which]["seconds"] * cells / ranks * cut["imbalance"]
        if ranks == 1:
            continue
        moved = counts(model, which, cut)
        parts["surfaces"] += n * moved["bytes"] / bandwidth
        parts["latency"] += n * moved["messages"] * latency
        parts["reductions"] += n * moved["reductions"] * 2 * latency * math.ceil(math.log2(ranks))
    return parts


def scaled_cut(cut, cells, ranks, measured_cells):
    """Surface of a part of a larger mesh: faces grow as (cells of the part)^(2/3), neighbours stay."""
    return dict(cut, faces=cut["faces"] * (cells / measured_cells) ** (2 / 3)) if ranks > 1 else cut


# ---------------------------------------------------------------------------------------------------------- measurements

def measure(options, mesh, ranks, flags):
    """Results of the repeats of one run, each with its events."""
    start = [] if ranks == 1 else [*shlex.split(options.launcher), str(ranks)]
    found = []
    for repeat in range(options.repeat if ranks in options.ranks else 1):
        print(f"{mesh.name} on {ranks} rank{'s' if ranks > 1 else ''} [{repeat + 1}]", flush=True)
        result = runs.measured([*start, options.build / "pulmo", "-dm_plex_filename", mesh, "-options_file", SCENES / "pcv.opts", *PAPER,
                                *solver_words(flags), "-ts_max_time", f"{options.time:g}", "-log_view", "::ascii_csv", "-output_dir"],
                               options.results / "runs", repeat, ranks, options.timeout)
        if result["code"]:
            fail(f"{mesh.name} on {ranks} ranks: {result['reason']} (see {result['folder']})")
        print(f"    {result['wall']:.1f} s" + (" (kept from an earlier call)" if result["kept"] else ""), flush=True)
        result["events"] = parse_log((result["folder"] / "stdout.log").read_text(errors="replace"))
        if not result["events"]:
            fail(f"no log of PETSc in {result['folder']}/stdout.log")
        found.append(result)
    return found


def row(mesh, ranks, results, yardstick, timed):
    """A line of the table. `yardstick`: (ranks, seconds of a step) on the same mesh."""
    summary, events, seconds = results[0]["summary"], results[0]["events"], runs.stage_seconds(results)
    steps = summary["steps"]
    step = (seconds["total"] - seconds["setup"]) / steps
    speed_up = yardstick[1] / step if yardstick else 1.0
    times = [f"{seconds['setup']:.2f}", *(f"{seconds[stage] / steps:.3f}" for stage in ("residual", "jacobian", "solve")), f"{step:.3f}",
             f"{1e6 * step / summary['cells']:.0f}", f"{speed_up:.2f}", f"{speed_up * (yardstick[0] if yardstick else ranks) / ranks:.2f}"]
    return [mesh.stem, summary["cells"], summary["dofs"], ranks, steps, summary["newton_iterations"], summary["krylov_iterations"],
            *(times if timed else ["-"] * len(times)), f"{imbalance(events):.3f}", f"{mean(events, 'TSStep', 'messages') / steps:.0f}",
            f"{mean(events, 'TSStep', 'bytes') / steps / 1e6:.2f}", f"{mean(events, 'TSStep', 'reductions') / steps:.0f}",
            f"{max(r['memory'] for r in results):.0f}"], step


def check(model, meshes, measured, cuts, options):
    """Rows that hold the model against every run on several ranks."""
    rows = []
    for (mesh, ranks), results in measured.items():
        if ranks == 1:
            continue
        summary, events, cut = results[0]["summary"], results[0]["events"], cuts[mesh, ranks]
        per_newton, per_krylov = split(events, summary)
        for key, unit in (("messages", "messages/rank/step"), ("bytes", "bytes/rank/step")):
            told, said = 0.0, 0.0
            for which, found in (("newton", per_newton), ("krylov", per_krylov)):
                n = summary[f"{which}_iterations"] / summary["steps"]
                told += n * found[key]
                said += n * counts(model, which, cut)[key]
            rows.append([mesh.stem, ranks, unit, f"{told:.4g}", f"{said:.4g}", f"{said / told:.2f}"])
        if ranks in options.ranks:
            own = dict(model, **{f"{which}_per_step": summary[f"{which}_iterations"] / summary["steps"] for which in ("newton", "krylov")})
            said = sum(predict(own, summary["cells"], ranks, cut, options.latency, options.bandwidth).values())
            told = statistics.median(mean(r["events"], "TSStep", "seconds") for r in results) / summary["steps"]
            rows.append([mesh.stem, ranks, "s/step", f"{told:.3f}", f"{said:.3f}", f"{said / told:.2f}"])
    return rows


def draw(path, title, table, predictions, options):
    figure, (strong, growth, model) = plt.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
    timed = [dict(zip(HEADER, line)) for line in table if line[HEADER.index("s/step")] != "-"]
    places = range(len(timed))
    left = [0.0] * len(timed)
    for stage, column in (("residual", "residual s/step"), ("jacobian", "Jacobian s/step"), ("solve", "solve s/step")):
        values = [float(line[column]) for line in timed]
        strong.barh(places, values, left=left, color=plots.COLOURS[stage], label=stage)
        left = [a + b for a, b in zip(left, values)]
    strong.set_yticks(places, [f"{line['mesh']}, {line['ranks']}" for line in timed], fontsize=7)
    strong.invert_yaxis()
    strong.set_xlabel("s per step (mesh, ranks)")
    strong.legend(fontsize=8)
    for ranks in options.ranks:
        found = sorted((int(line["tetrahedra"]), float(line["s/step"])) for line in timed if int(line["ranks"]) == ranks)
        growth.loglog(*zip(*found), "o-", label=f"{ranks} rank{'s' if ranks > 1 else ''}")
    growth.set_xlabel("tetrahedra")
    growth.set_ylabel("s per step")
    for cells in options.predict_cells:
        found = [(ranks, share) for n, ranks, share in predictions if n == cells]
        model.semilogx(*zip(*found), "o-", base=2, label=f"{cells / 1e6:g}M tetrahedra")
    model.set_xlabel("ranks (model)")
    model.set_ylabel("efficiency")
    model.set_ylim(0, 1.05)
    for axis in (growth, model):
        axis.grid(True, which="both", alpha=0.3)
        axis.legend(fontsize=8)
    plots.save(figure, path, title)


def run(options):
    if len(options.flags) > 1:
        fail("scaling takes one string of flags after --")
    if options.ranks[0] != 1:
        fail("--ranks must begin with 1, the yardstick of the efficiency")
    if options.repeat < 1 or min(options.ranks + options.count_ranks) < 1 or min(options.predict_ranks) < 2:
        fail("--repeat and all ranks must be at least 1, --predict-ranks at least 2")
    if max(options.ranks + options.count_ranks) == 1:
        fail("the model needs a run on several ranks: --ranks 1 2, or --count-ranks 4")
    require(options.build, options.mesh or [])
    flags = options.flags[0] if options.flags else f"@iterative {PLAIN}"
    meshes = options.mesh or [make_lung(cells, options.build) for cells in options.cells]
    measured, cuts, table = {}, {}, []
    for mesh in meshes:
        tets = tetrahedra(mesh)
        pairs = face_pairs(tets)
        yardstick = None
        for ranks in sorted({*options.ranks, *options.count_ranks}):
            measured[mesh, ranks] = measure(options, mesh, ranks, flags)
            cuts[mesh, ranks] = surfaces(tets, pairs, ranks)
            line, step = row(mesh, ranks, measured[mesh, ranks], yardstick, ranks in options.ranks)
            yardstick = yardstick or (ranks, step)
            table.append(line)

    largest = max(meshes, key=lambda m: measured[m, 1][0]["summary"]["cells"])
    alone = measured[largest, 1]
    summary, events = alone[0]["summary"], alone[0]["events"]
    if not any(cut["faces"] for cut in cuts.values()):
        fail("no run has parts that share a face (METIS cuts two lungs on two ranks between them): give --count-ranks 4")
    model = fit([{**cuts[mesh, ranks],
                  **dict(zip(("newton", "krylov"), split(results[0]["events"], results[0]["summary"])))}
                 for (mesh, ranks), results in measured.items() if ranks > 1])
    busy = max(options.ranks)  # cores that share a memory bus compute more slowly together
    single = dict(model, newton={}, krylov={})  # a rank that has the machine to itself
    for which, i in (("newton", 0), ("krylov", 1)):
        for target, ranks in ((model, busy), (single, 1)):
            target[which]["seconds"] = ranks / summary["cells"] * statistics.median(
                split(r["events"], r["summary"])[i]["seconds"] for r in measured[largest, ranks])
            target[f"{which}_per_step"] = summary[f"{which}_iterations"] / summary["steps"]
    reading = (mean(events, "DMPlexCrFromFile", "seconds") + mean(events, "DMPlexInterp", "seconds")) / summary["cells"]
    memory = max(r["memory"] for r in alone) / summary["cells"]  # MB per cell

    tets = tetrahedra(largest)
    pairs = face_pairs(tets)
    large_cuts = {ranks: surfaces(tets, pairs, ranks) for ranks in options.predict_ranks}
    predictions, lines = [], []
    for cells in options.predict_cells:
        serial = sum(predict(single, cells, 1, surfaces(tets, pairs, 1), options.latency, options.bandwidth).values())
        for ranks in options.predict_ranks:
            parts = predict(model, cells, ranks, scaled_cut(large_cuts[ranks], cells, ranks, len(tets)), options.latency, options.bandwidth)
            total = sum(parts.values())
            predictions.append((cells, ranks, serial / total / ranks))
            lines.append([f"{cells:.0f}", ranks, f"{cells / ranks:.0f}", f"{total:.3g}", f"{serial / total:.1f}", f"{serial / total / ranks:.2f}",
                          *(f"{100 * part / total:.1f} %" for part in parts.values()), f"{memory * cells / ranks / 1e3:.2f}",
                          f"{reading * cells:.0f}"])
    checks = check(model, meshes, measured, cuts, options)
    cut_header = ["ranks", "tetrahedra/part", "shared faces/part", "faces / (tetrahedra/part)^(2/3)", "neighbours", "largest/mean"]
    cut_rows = [[ranks, f"{len(tets) / ranks:.0f}", f"{cut['faces']:.0f}", f"{cut['faces'] / (len(tets) / ranks) ** (2 / 3):.2f}",
                 f"{cut['neighbours']:.1f}", f"{cut['imbalance']:.3f}"] for ranks, cut in large_cuts.items()]

    everything = [r for results in measured.values() for r in results]
    notes = (f"PCV scene (Birzle), `{flags}`, up to t = {options.time:g} s, {processor()}, {blas(options.build / 'pulmo')} with one thread, "
             f"{runs.load_range(everything)}; {'one run each' if options.repeat == 1 else f'medians of {options.repeat} runs'}. Seconds of a "
             "step are wall time without the setup. Efficiency: against one rank on the same mesh. Imbalance: largest over mean "
             "floating-point operations of the ranks. Messages and bytes are those that a rank sends, mean over the ranks, as PETSc counts "
             "them: what hypre and MUMPS send inside is not among them. Ranks without seconds were run for their counts only.")
    told = {which: [f"{model[which][key][0]:.3g} + {model[which][key][1]:.3g}" for key in ("messages", "bytes")] for which in ("newton", "krylov")}
    more = ["", "![scaling](scaling.png)", "", "## A model of larger machines", "",
            f"Seconds of a step on P ranks = Σ over Newton ({model['newton_per_step']:.1f} a step) and Krylov iterations "
            f"({model['krylov_per_step']:.1f} a step) of computing + bytes/bandwidth + messages × latency + reductions × 2 latency × "
            "⌈log₂ P⌉, none of it overlapped. Measured and put in:", "",
            f"- computing: {1e6 * model['newton']['seconds']:.1f} µs per tetrahedron and Newton iteration (residual, Jacobian, setup of the "
            f"preconditioner) and {1e6 * model['krylov']['seconds']:.1f} µs per tetrahedron and Krylov iteration, with {busy} ranks at work on "
            f"{largest.stem} (alone: {1e6 * single['newton']['seconds']:.1f} and {1e6 * single['krylov']['seconds']:.1f}, the yardstick of the "
            "efficiency), times the imbalance of METIS's parts;",
            f"- messages that a rank sends: {told['newton'][0]} × neighbours (Newton), {told['krylov'][0]} × neighbours (Krylov); the constants "
            "are what the coarse levels of multigrid send;",
            f"- bytes: {told['newton'][1]} × shared faces (Newton), {told['krylov'][1]} × shared faces (Krylov);",
            f"- reductions: {model['newton']['reductions']:.0f} (Newton), {model['krylov']['reductions']:.1f} (Krylov);",
            f"- parts: METIS on {largest.stem}, shared faces ∝ (tetrahedra of the part)^(2/3) beyond it:", "",
            *markdown(cut_header, cut_rows), "",
            f"Network: {1e6 * options.latency:g} µs, {options.bandwidth / 1e9:g} GB/s per rank (`--latency`, `--bandwidth`). The four shares are of the "
            f"time of a step. Every core is taken to be as fast as one of {busy} at work here, and iteration counts to stay as they are.", "",
            *markdown(MODEL_HEADER, lines), "", "### The model against the runs", "",
            "Messages and bytes are fitted to all of these runs at once: the spread says how far two constants serve them all. Seconds per "
            f"tetrahedron are those of {largest.stem} on {busy} ranks; on other meshes they are a prediction.", "", *markdown(CHECK_HEADER, checks), "",
            "### What breaks first", "",
            f"1. **Reading the mesh**: rank 0 reads the gmsh file and makes its faces and edges alone, {1e6 * reading:.0f} µs per tetrahedron "
            f"({reading * max(options.predict_cells):.0f} s and the whole serial mesh in its memory for {max(options.predict_cells) / 1e6:g}M), however many "
            "ranks there are. A [saved mesh](../meshes.md#large-meshes-a-file-that-ranks-read-together) is read by all of them "
            "([below](#reading-a-mesh-of-a-million-tetrahedra)).",
            "2. **Direct files**: MUMPS's factors grow faster than the mesh ([memory](memory.md)); its fronts near the root bound the "
            "speed-up. Beyond some 10⁵ tetrahedra only `iterative` is an option.",
            "3. **Coarse levels**: every level of multigrid sends messages to all neighbours however few rows it has left; that is the latency "
            "share above. `-fieldsplit_displacement_pmg_coarse_pc_gamg_process_eq_limit` gathers small levels on fewer ranks.",
            "4. **Reductions** grow with log₂ P only, and FGMRES makes one or two per iteration; they matter last.", "",
            *READING.read_text(encoding="utf-8").splitlines()]
    write_table(options.output, "scaling", "Scaling", HEADER, table, notes, more)
    print("\nmodel:")
    show(MODEL_HEADER, lines)
    print("\nmodel against the runs:")
    show(CHECK_HEADER, checks)
    write_csv(options.output / "scaling_model.csv", MODEL_HEADER, lines)
    draw(options.output / "scaling.png", f"{flags} on {processor()}", table, predictions, options)
