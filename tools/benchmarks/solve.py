"""`tools/benchmark solve`: Krylov iterations per Newton step over meshes, permeabilities, steps, phases and stretches.

Each combination runs a few time steps with every Jacobian new and -ksp_rtol 1e-5 whatever the solver file lags or
relaxes, so that the counts tell of the preconditioner alone. Kinds of phase:

  pressure   6 cmH2O at once (scene pcv, no ramp)
  flow       the mean flow of that run, prescribed with the same flux per area on the whole airway
  common     the same flow at one common airway pressure
  stretch    no springs, rigid support: inflation by flow at a common pressure to a mean J of --stretch in ten steps,
             then released to 0 cmH2O for the steps of the others; where the permeability lets the gas reach the whole lung
"""
import re
from pathlib import Path

from . import plots, runs
from .assembly import LAWS
from .common import SCENES, SOURCE, blas, fail, processor, write_table
from .strategies import measure, solver_words

NEW = ["-snes_lag_jacobian", "1", "-snes_lag_preconditioner", "1", "-snes_ksp_ew", "0", "-ksp_rtol", "1e-5",
       "-ksp_converged_reason"]
PHASES = ["pressure", "flow", "common", "stretch"]
INFLATION_STEPS = 10
HEADER = ["solver", "law", "tetrahedra", "phase", "k mm²/(kPa s)", "dt s", "largest J", "Newton", "solves", "Krylov/solve",
          "largest", "solve s", "solve s/Newton", "CPU s", "memory MB", "remark"]


def arguments(parser):
    parser.usage = "tools/benchmark solve [options] [-- 'FLAGS' ...]"
    parser.add_argument("--mesh", type=Path, nargs="+", help="default: lung_test and lung_pair of meshes/")
    parser.add_argument("--mesh-scale", type=float, default=1, help="multiplies the coordinates to give mm (default 1)")
    parser.add_argument("--laws", nargs="+", default=["birzle"], choices=LAWS, help="default: birzle")
    parser.add_argument("--permeability", type=float, nargs="+", default=[1e4, 1e2, 1, 1e-2, 1e-4],
                        help="mm^2/(kPa s), default: 1e4 1e2 1 1e-2 1e-4")
    parser.add_argument("--dt", type=float, nargs="+", default=[1e-3, 0.05, 0.2], help="s, default: 0.001 0.05 0.2")
    parser.add_argument("--phases", nargs="+", default=PHASES, choices=PHASES, help="default: all")
    parser.add_argument("--steps", type=int, default=2, help="time steps of each phase (default 2)")
    parser.add_argument("--stretch", type=float, default=2.5, help="mean J of the inflation (default 2.5)")
    parser.add_argument("--stretch-permeability", type=float, default=1e2,
                        help="least permeability of the stretch, mm^2/(kPa s) (default 100)")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks (default: mpiexec -n)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--output", type=Path, default=SOURCE / "results/solve", help="default: results/solve")
    parser.set_defaults(repeat=1)


def solves(result):
    """Krylov iterations of each linear solve of a run, and how many solves did not converge."""
    text = (result["folder"] / "stdout.log").read_text(errors="replace")
    found = re.findall(r"Linear solve (converged|did not converge) due to \w+ iterations (\d+)", text)
    return [int(n) for _, n in found], sum(how != "converged" for how, _ in found)


def flow_of(result):
    """Mean flow of a run, ml/s."""
    t, (volume, _) = max(runs.waveform(result).items())
    return volume / t


def reference_volume(result):
    return result["summary"]["reference_volume_ml"]


def programme(options, name, lines):
    """The words of a programme of phases, written to the output folder."""
    path = options.output / "programmes" / f"{name}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return ["-options_file", SCENES / "programme.opts", "-ventilator_programme", path]


def scene(options, case, pressure_run):
    """The words of a combination; flows are measured by the run under pressure of the same mesh, law, k and dt."""
    _, law, mesh, phase, k, dt = case
    name = f"{mesh.stem}_{law}_{phase}_{k:g}_{dt:g}"
    time = options.steps * dt
    if phase == "pressure":
        words = ["-options_file", SCENES / "pcv.opts", "-ventilator_ramp", "0", "-ts_max_time", f"{time:g}"]
    elif phase == "stretch":
        inflation = INFLATION_STEPS * dt
        volume = (options.stretch - 1) * reference_volume(pressure_run)
        words = [*programme(options, name, [f"inflation {inflation:g} flow {volume / inflation:.6g}",
                                            f"release {time:g} pressure 0"]),
                 "-ventilator_flow_split", "common_pressure", "-chest_wall", "off", "-support", "-support_rigid"]
    else:
        words = [*programme(options, name, [f"inspiration {time:g} flow {flow_of(pressure_run):.6g}"]),
                 "-ventilator_flow_split", "uniform" if phase == "flow" else "common_pressure"]
    return ["-dm_plex_filename", mesh, "-mesh_scale", f"{options.mesh_scale:g}", *words, "-tissue", law,
            "-airflow_permeability", f"{k:g}"]


def row(case, result):
    """A line of the table."""
    solver, law, _, phase, k, dt = case
    summary, (counts, unsolved) = result.get("summary", {}), solves(result)
    remark = [f"{unsolved} solves did not converge"] * (unsolved > 0) + [result["reason"]] * (result["code"] != 0)
    if summary.get("rejected_steps"):
        remark.append(f"{summary['rejected_steps']} steps rejected")
    newton, seconds = summary.get("newton_iterations", 0), summary.get("wall_seconds", {}).get("solve")
    return [solver, law, summary.get("cells", "-"), phase, f"{k:g}", f"{dt:g}", largest_stretch(result), newton or "-",
            len(counts), f"{sum(counts) / len(counts):.1f}" if counts else "-", max(counts, default="-"),
            f"{seconds:.2f}" if seconds is not None else "-", f"{seconds / newton:.3f}" if newton and seconds is not None else "-",
            f"{result['cpu']:.2f}", f"{result['memory']:.0f}", "; ".join(remark)]


def largest_stretch(result):
    """Largest J of all accepted steps."""
    return max((f"{float(r['max_J']):.2f}" for r in runs.signals(result)), key=float, default="-")


def run(options):
    flags = options.flags or ["@iterative"]
    meshes = options.mesh or [SOURCE / "meshes/lung_test.msh", SOURCE / "meshes/lung_pair.msh"]
    words = {f: solver_words(f) for f in flags}
    for mesh in meshes:
        if not mesh.is_file():
            fail(f"there is no mesh {mesh}")
    if not (options.build / "pulmo").exists():
        fail(f"{options.build} holds no build; run tools/setup first")
    if options.steps < 1 or options.ranks < 1:
        fail("--steps and --ranks must be at least 1")
    if options.stretch <= 1:
        fail("--stretch must be above 1")
    cases = [(f, law, mesh, phase, k, dt) for mesh in meshes for law in options.laws for phase in PHASES
             for k in options.permeability for dt in options.dt for f in flags
             # the flow phases take their flow from the run under pressure with the first solver
             if phase in options.phases and (phase != "stretch" or k >= options.stretch_permeability)]
    results = {}

    def result_of(case):
        if case not in results:
            solver, law, mesh, phase, k, dt = case
            of_pressure = None if phase == "pressure" else result_of((flags[0], law, mesh, "pressure", k, dt))
            if of_pressure and of_pressure["code"]:
                results[case] = dict(of_pressure, reason=f"no flow to prescribe: under pressure, {of_pressure['reason']}")
            else:
                label = f"{solver}: {law}, {mesh.name}, {phase}, k {k:g}, dt {dt:g}"
                entry = {label: [*scene(options, case, of_pressure), *words[solver], *NEW, "-ts_dt", f"{dt:g}"]}
                results[case] = measure(entry, [], options)[label][0]
        return results[case]

    for i, case in enumerate(cases, 1):
        if sum(c in results for c in cases) < i:
            print(f"{i} of {len(cases)}", end=" ")
        result_of(case)
    rows = [row(case, results[case]) for case in cases]
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
