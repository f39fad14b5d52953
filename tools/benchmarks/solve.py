"""`tools/benchmark solve`: Krylov iterations per Newton step over meshes, permeabilities, steps, phases and stretches.

Each combination runs a few time steps with every Jacobian new and -ksp_rtol 1e-5 whatever the solver file lags or
relaxes, so that the counts tell of the preconditioner alone. Kinds of phase:

  pressure   6 cmH2O at once (scene pcv, no ramp)
  flow       the mean flow of that run, prescribed with the same flux per area on the whole airway
  common     the same flow at one common airway pressure
  stretch    no springs, rigid support: slow inflation by flow at a common pressure, then steps of that flow
  release    the same inflation, then steps at nine tenths of the airway pressure that it reached
Both stretch phases count only what follows the inflation, and leave out permeabilities below --stretch-permeability, where
the gas would not reach the whole lung in that time.
"""
import re
from pathlib import Path

from shared.common import PLAIN, PAPER, SCENES, SOURCE, blas, fail, laws_of, processor, require, write_table

from . import plots, runs
from .strategies import measure, solver_words

NEW = [*PLAIN.split(), "-snes_ksp_ew", "0", "-ksp_rtol", "1e-5", "-ksp_converged_reason", "-progress", "on"]
# what a phase takes from another: flows are those of the pressure phase, the released pressure that of the stretch
PHASES = {"pressure": None, "flow": "pressure", "common": "pressure", "stretch": "pressure", "release": "stretch"}
# mean J to which a lung without springs inflates with a regular tangent: yoshihara has a limit point at 2.53, birzle is
# almost neutral from 1.5 on, rausch is stiff
STRETCH = {"berger": 2.5, "ma": 2.5, "birzle": 1.4, "yoshihara": 2, "rausch": 1.3, "patte": 2, "concha": 1.4}
COMMON = ["-ventilator_flow_split", "common_pressure"]
INFLATION, INFLATION_STEPS = 10, 20  # s
HEADER = ["solver", "law", "tetrahedra", "phase", "k mm²/(kPa s)", "dt s", "largest J", "Newton", "solves", "Krylov/solve",
          "largest", "solve s", "CPU s", "memory MB", "remark"]


def arguments(parser):
    parser.usage = "tools/benchmark solve [options] [-- 'FLAGS' ...]"
    parser.add_argument("--mesh", type=Path, nargs="+", help="default: lung_test and lung_pair of meshes/")
    parser.add_argument("--mesh-scale", type=float, default=1, help="multiplies the coordinates to give mm (default 1)")
    parser.add_argument("--laws", nargs="+", default=["birzle"], metavar="LAW", help="default: birzle")
    parser.add_argument("--permeability", type=float, nargs="+", default=[1e4, 1e2, 1, 1e-2, 1e-4],
                        help="mm^2/(kPa s), default: 1e4 1e2 1 1e-2 1e-4")
    parser.add_argument("--dt", type=float, nargs="+", default=[1e-3, 0.05, 0.2], help="s, default: 0.001 0.05 0.2")
    parser.add_argument("--phases", nargs="+", default=list(PHASES), choices=list(PHASES), help="default: all")
    parser.add_argument("--steps", type=int, default=2, help="time steps of each phase (default 2)")
    parser.add_argument("--stretch", type=float, help="mean J of the inflation (default by law: "
                        + ", ".join(f"{law} {J:g}" for law, J in STRETCH.items()) + ")")
    parser.add_argument("--stretch-permeability", type=float, default=1e2,
                        help="least permeability of the stretch, mm^2/(kPa s) (default 100)")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks (default: mpiexec -n)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--output", type=Path, default=SOURCE / "results/solve", help="default: results/solve")
    parser.set_defaults(repeat=1)


def solves(result):
    """Krylov iterations of each linear solve, how many of them did not converge, and Newton steps, of the phases measured."""
    counts, unsolved, of_step = [], 0, []
    for line in (result["folder"] / "stdout.log").read_text(errors="replace").splitlines():
        solve = re.search(r"Linear solve (converged|did not converge) due to \w+ iterations (\d+)", line)
        if solve:
            of_step.append((int(solve[2]), solve[1] != "converged"))
        elif re.match(r"\s+[0-9.]+\s.*\s[a-z]+$", line):  # a step was accepted
            if not line.endswith(" inflation"):
                counts += [n for n, _ in of_step]
                unsolved += sum(failed for _, failed in of_step)
            of_step = []
    newton = sum(int(r["newton_iterations"]) for r in runs.signals(result) if r["phase"] != "inflation")
    return counts + [n for n, _ in of_step], unsolved + sum(failed for _, failed in of_step), newton


def flow_of(result):
    """Mean flow of a run, ml/s."""
    t, (volume, _) = max(runs.waveform(result).items())
    return volume / t


def programme(options, name, lines):
    """The words of a programme of phases, written to the output folder."""
    path = options.output / "programmes" / f"{name}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return ["-options_file", SCENES / "programme.opts", *PAPER, "-ventilator_programme", path]


def scene(options, case, source):
    """The words of a combination; `source`: the run of the phase that it takes its flow or pressure from."""
    _, law, mesh, phase, k, dt = case
    name = f"{mesh.stem}_{law}_{phase}_{k:g}_{dt:g}"
    time = options.steps * dt
    if phase == "pressure":
        words = ["-options_file", SCENES / "pcv.opts", *PAPER, "-ventilator_ramp", "0", "-ts_max_time", f"{time:g}"]
    elif phase in ("stretch", "release"):
        volume = ((options.stretch or STRETCH[law]) - 1) * source["summary"]["reference_volume_ml"]
        flow = volume / INFLATION
        measured = f"flow {flow:.6g}"
        if phase == "release":
            measured = f"pressure {0.9 * list(runs.waveform(source).values())[-1][1]:.6g}"
        # a phase ends on time: each is one step, shorter than those of the inflation
        words = [*programme(options, name, [f"inflation {INFLATION} flow {flow:.6g}"] + [f"{phase} {dt:g} {measured}"] * options.steps),
                 *COMMON, "-chest_wall", "off", "-support", "-support_rigid"]
    else:
        words = programme(options, name, [f"inspiration {time:g} flow {flow_of(source):.6g}"])
        words += COMMON if phase == "common" else []
    return ["-dm_plex_filename", mesh, "-mesh_scale", f"{options.mesh_scale:g}", *words,
            "-tissue", law, "-airflow_permeability", f"{k:g}"]


def row(case, result):
    """A line of the table."""
    solver, law, _, phase, k, dt = case
    summary, (counts, unsolved, newton) = result.get("summary", {}), solves(result)
    remark = [f"{unsolved} solves did not converge"] * (unsolved > 0) + [result["reason"]] * (result["code"] != 0)
    if summary.get("rejected_steps"):
        remark.append(f"{summary['rejected_steps']} steps rejected")
    seconds = summary.get("wall_seconds", {}).get("solve")
    return [solver, law, summary.get("cells", "-"), phase, f"{k:g}", f"{dt:g}", largest_stretch(result), newton or "-",
            len(counts), f"{sum(counts) / len(counts):.1f}" if counts else "-", max(counts, default="-"),
            f"{seconds:.2f}" if seconds is not None else "-", f"{result['cpu']:.2f}", f"{result['memory']:.0f}", "; ".join(remark)]


def largest_stretch(result):
    """Largest J of all accepted steps."""
    return max((f"{float(r['max_J']):.2f}" for r in runs.signals(result)), key=float, default="-")


def run(options):
    flags = options.flags or ["@iterative"]
    meshes = options.mesh or [SOURCE / "meshes/lung_test.msh", SOURCE / "meshes/lung_pair.msh"]
    words = {f: solver_words(f) for f in flags}
    require(options.build, meshes)
    if options.steps < 1 or options.ranks < 1:
        fail("--steps and --ranks must be at least 1")
    if options.stretch is not None and options.stretch <= 1:
        fail("--stretch must be above 1")
    unknown = [law for law in laws_of(options) if law not in STRETCH]
    if unknown and options.stretch is None and {"stretch", "release"} & set(options.phases):
        fail(f"no stretch is known to which {unknown[0]} inflates with a regular tangent: give --stretch, or other --phases")
    if max(options.dt) > INFLATION / INFLATION_STEPS:
        fail(f"--dt must be at most {INFLATION / INFLATION_STEPS:g} s")
    cases = [(f, law, mesh, phase, k, dt) for mesh in meshes for law in options.laws for phase in options.phases
             for k in options.permeability for dt in options.dt for f in flags
             if phase not in ("stretch", "release") or k >= options.stretch_permeability]
    results = {}

    def result_of(case):
        if case not in results:
            solver, law, mesh, phase, k, dt = case
            source = PHASES[phase] and result_of((flags[0], law, mesh, PHASES[phase], k, dt))
            if source and source["code"]:
                results[case] = dict(source, reason=f"nothing to go on: {source['reason']}")
            else:
                label = f"{solver}: {law}, {mesh.name}, {phase}, k {k:g}, dt {dt:g}"
                step = INFLATION / INFLATION_STEPS if phase in ("stretch", "release") else dt
                entry = {label: [*scene(options, case, source), *words[solver], *NEW, "-ts_dt", f"{step:g}"]}
                results[case] = measure(entry, [], options)[label][0]
        return results[case]

    rows = [row(case, result_of(case)) for case in cases]
    title = "Krylov iterations per linear solve"
    notes = (f"{options.ranks} rank{'s' if options.ranks > 1 else ''} on {processor()}, {blas(options.build / 'pulmo')} with "
             f"one thread, {runs.load_range([results[c] for c in cases])}; {options.steps} steps of each phase. Every Jacobian "
             "and preconditioner new, `-ksp_rtol 1e-5`. Newton steps at a common pressure have two linear solves. Solve "
             "seconds are wall seconds of all but assembly and output, CPU seconds those of the whole process.")
    write_table(options.output, "solve", title, HEADER, rows, notes)
    worst = max((r[10] for r in rows if r[10] != "-"), default=0)
    print(f"largest count of any solve: {worst}; failed runs: {sum(results[c]['code'] != 0 for c in cases)}")
    plots.counts(options.output / "solve.png", title, [(case[0], case[1], r[2], case[3], case[4], case[5], r[10])
                                                       for case, r in zip(cases, rows) if r[10] != "-"])
