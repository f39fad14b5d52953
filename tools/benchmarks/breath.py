"""`tools/benchmark breath`: a breath (PCV, Birzle, dt 0.05 s) with each solver file, and by FEniCS on the same mesh.

The peer (--peer) is peer_fenics.py beside this file; it needs Debian's python3-dolfinx-real and is left out, with a
note, where that is not installed. Strings of flags after -- are measured too, as in `strategies`.
"""
import json
import statistics
import subprocess
from pathlib import Path

from shared.common import KPA_PER_CMH2O, PAPER, SCENES, SOLVERS, SOURCE, blas, environment, fail, processor, require, write_table

from . import plots, runs
from .strategies import measure, mesh_sentence, solver_words

PEER = Path(__file__).parent / "peer_fenics.py"
PACKAGE = "python3-dolfinx-real"
AGREEMENT = 1e-6  # volumes of pulmo and peer, relative to the largest
DT = 0.05  # s
HEADER = ["solver", "steps", "Newton", "Krylov", *(f"{s} s" for s in runs.STAGES), "wall s", "CPU s", "memory MB",
          "volume difference"]


def arguments(parser):
    parser.usage = "tools/benchmark breath [options] [-- 'FLAGS' ...]"
    parser.add_argument("--mesh", type=Path, default=SOURCE / "meshes/lung_pair.msh", help="default: meshes/lung_pair.msh")
    parser.add_argument("--mesh-scale", type=float, default=1, help="multiplies the coordinates to give mm (default 1)")
    parser.add_argument("--time", type=float, default=3, help="end of the run, s (default 3: the whole breath)")
    parser.add_argument("--solvers", nargs="+", help="solver files (default: direct, iterative, and reuse if there is one)")
    parser.add_argument("--repeat", type=int, default=1, help="runs of each; times are medians (default 1)")
    parser.add_argument("--peer", action="store_true", help=f"also run the FEniCS script (apt-get install {PACKAGE})")
    parser.add_argument("--peer-steps", type=int, help="the peer solves only so many steps; its time is scaled")
    parser.add_argument("--peer-newton", type=int, help="Newton iterations of the peer's whole breath, to scale by where direct "
                        "is not run (default: those of direct)")
    parser.add_argument("--output", type=Path, default=SOURCE / "results/breath", help="default: results/breath")
    parser.set_defaults(ranks=1, timeout=None, launcher="")


def peer_is_there():
    """Whether /usr/bin/python3 can import DOLFINx."""
    return subprocess.run(["/usr/bin/python3", "-c", "import dolfinx, gmsh"], env=environment(), capture_output=True).returncode == 0


def peer_scene(options, summary):
    """What the peer has to know, from the options that pulmo says it used."""
    used = summary["options"]

    def number(name):
        return float(used[name])

    steps = round(options.time / DT)
    if options.peer_steps:
        steps = min(steps, options.peer_steps)
    return {"mesh_scale": options.mesh_scale, "dt": DT, "stop": steps * DT,
            "pressure": number("-ventilator_pip") * KPA_PER_CMH2O, "ramp": number("-ventilator_ramp"),
            "inspiration": number("-ventilator_inspiration"), "permeability": number("-airflow_permeability"),
            "springs": {name: number(f"-chest_wall_stiffness_{name}") for name in used["-chest_wall_surfaces"].split(",")},
            "tissue": {name: number(f"-tissue_{name}") for name in ("c", "beta", "c1", "c3", "d1", "d3")}}


def measure_peer(options, reference):
    """Results of the FEniCS script; it reads the scene that the run `reference` of pulmo had."""
    scene = options.output / "peer_scene.json"
    scene.write_text(json.dumps(peer_scene(options, reference["summary"]), indent=1) + "\n")
    results = []
    for repeat in range(options.repeat):
        print(f"[peer {repeat + 1}/{options.repeat}] FEniCS", flush=True)
        result = runs.measured([PEER, scene, options.mesh, SOLVERS / "direct.opts"], options.output / "runs", repeat)
        if result["code"]:
            fail(f"the FEniCS script failed: {result['reason']} (see {result['folder']}/stderr.log)")
        print(f"    finished, {result['wall']:.1f} s, {result['memory']:.0f} MB"
              + (" (kept from an earlier call)" if result["kept"] else ""), flush=True)
        # the forms are compiled once for all meshes: no part of a breath
        result["cpu"] = result["summary"]["cpu_seconds"]
        results.append(result)
    return results


def scaled(seconds, peer, reference, newton):
    """Seconds of a peer that stopped before `reference`, at the `newton` iterations of the whole breath, and the factor.

    All but the setup is taken to grow with Newton iterations.
    """
    factor = newton / peer["summary"]["newton_iterations"] if peer["summary"]["steps"] < reference["summary"]["steps"] else 1
    return {stage: value if stage == "setup" else seconds["setup"] + factor * (value - seconds["setup"])
            if stage == "total" else factor * value for stage, value in seconds.items()}, factor


def run(options):
    require(options.build, [options.mesh])
    if options.repeat < 1 or (options.peer_steps is not None and options.peer_steps < 1):
        fail("--repeat and --peer-steps must be at least 1")
    if abs(options.time / DT - round(options.time / DT)) > 1e-9 or not 0 < options.time <= 3:
        fail(f"--time must be a multiple of {DT} s, at most 3 s")
    names = options.solvers or ["direct", "iterative", *(p.stem for p in SOLVERS.glob("reuse.opts"))]
    if options.peer and "direct" not in names and not options.peer_newton:
        fail("--peer needs the solver direct, which takes the same Newton iterations, or --peer-newton")
    options.output.mkdir(parents=True, exist_ok=True)
    common = ["-dm_plex_filename", options.mesh, "-mesh_scale", f"{options.mesh_scale:g}", "-options_file", SCENES / "pcv.opts", *PAPER]
    flags = {name: f"@{name}" for name in names} | {flags: flags for flags in options.flags}
    entries = {label: [*solver_words(f), "-ts_dt", f"{DT:g}", "-ts_max_time", f"{options.time:g}"] for label, f in flags.items()}
    results = measure(entries, common, options)
    for name, group in results.items():
        if group[0]["code"]:
            fail(f"solver {name} failed: {group[0]['reason']}")

    with_peer, remark = options.peer, ""
    if options.peer and not peer_is_there():
        print(f"the peer is left out: DOLFINx is not installed (apt-get install {PACKAGE})")
        with_peer, remark = False, " Peer left out: DOLFINx is not installed."
    peers = measure_peer(options, results[names[0]][0]) if with_peer else []
    reference = peers[0] if peers else results[names[0]][0]

    header, rows, bars, disagree = [*HEADER], [], [], []
    if peers:
        newton = options.peer_newton or results["direct"][0]["summary"]["newton_iterations"]
        seconds, factor = scaled(runs.stage_seconds(peers), peers[0], results[names[0]][0], newton)
        setup_cpu = statistics.median(r["summary"]["setup_cpu_seconds"] for r in peers)
        peer_cpu = setup_cpu + factor * (statistics.median(r["cpu"] for r in peers) - setup_cpu)
        peer_memory = max(r["memory"] for r in peers)
        header += ["peer/this wall", "peer/this CPU", "peer/this memory"]
        s = peers[0]["summary"]
        remark = (f" FEniCS: DOLFINx {s['dolfinx']}, MUMPS, direct.opts, P2-P1, same quadrature in the cells, same scaling "
                  f"of rows; its {s['wall_seconds']['compile']:.0f} s of compiling forms (and Python's imports) are not counted.")
        if factor != 1:
            remark += (f" It solved {s['steps']} steps with {s['newton_iterations']} Newton iterations (the whole breath takes "
                       f"{newton}); its seconds, but for the setup, are scaled by {factor:.2f}.")
    for name, group in results.items():
        stages, summary = runs.stage_seconds(group), group[0]["summary"]
        cpu, memory = statistics.median(r["cpu"] for r in group), max(r["memory"] for r in group)
        difference = runs.differences(group[0], reference)[0]
        row = [name, summary["steps"], summary["newton_iterations"], summary["krylov_iterations"],
               *(f"{stages[stage]:.2f}" for stage in runs.STAGES), f"{stages['total']:.2f}", f"{cpu:.2f}", f"{memory:.0f}",
               f"{difference:.1e}"]
        if peers:
            row += [f"{seconds['total'] / stages['total']:.1f}", f"{peer_cpu / cpu:.1f}", f"{peer_memory / memory:.1f}"]
            if difference > AGREEMENT:
                disagree.append(f"{name} by {difference:.1e}")
        rows.append(row)
        bars.append((name, stages, memory, group[0], False))
    if peers:
        s = peers[0]["summary"]
        rows.append(["FEniCS", s["steps"], s["newton_iterations"], s["krylov_iterations"],
                     *(f"{seconds[stage]:.2f}" for stage in runs.STAGES), f"{seconds['total']:.2f}", f"{peer_cpu:.2f}",
                     f"{peer_memory:.0f}", "0", "1", "1", "1"])
        bars.append(("FEniCS" + (" (scaled)" if factor != 1 else ""), seconds, peer_memory, peers[0], False))
    everything = [r for group in results.values() for r in group] + peers
    title = f"One breath: PCV, birzle, dt {DT:g} s, {options.time:g} s on {mesh_sentence(options.mesh, results)}"
    notes = (f"One rank on {processor()}, {blas(options.build / 'pulmo')} with one thread, {runs.load_range(everything)}; "
             f"{'one run each' if options.repeat == 1 else f'medians of {options.repeat} runs'}. Volume difference: largest over "
             f"all common times, relative to the largest volume of {'FEniCS' if peers else names[0]}.{remark}")
    write_table(options.output, "breath", title, header, rows, notes)
    plots.side_by_side(options.output / "breath.png", title, bars)
    if disagree:
        fail(f"volumes differ from FEniCS by more than {AGREEMENT:g}: {', '.join(disagree)}")
    if peers:
        print(f"volumes agree with FEniCS to {AGREEMENT:g}")
