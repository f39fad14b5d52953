"""`tools/benchmark breaths`: ordinary breaths with every tissue law: which finish, their clinical numbers and their cost.

Pressure control 15/5 and 25/10 cmH2O (peak, PEEP), volume control of 250 ml at PEEP 5 and 10, every law, pulmo's default readings,
springs on pleura and airway: twenty breaths. The solver is the iterative file, for rausch the reuse file; strings of flags after --
run instead, each for every law. A breath that does not finish is run again as --checks says, to tell whether lung or solver is at
its end.
"""
import re
from pathlib import Path

from shared.common import SCENES, SOURCE, blas, laws_of, markdown, processor, require, show, write_table

from . import runs
from .strategies import measure, mesh_sentence, solver_words

BREATHS = {"PCV 15/5": ("pcv", "-ventilator_pip 15 -ventilator_peep 5"), "PCV 25/10": ("pcv", "-ventilator_pip 25 -ventilator_peep 10"),
           "VCV 250 ml, PEEP 5": ("vcv", "-ventilator_tidal_volume 250 -ventilator_peep 5"),
           "VCV 250 ml, PEEP 10": ("vcv", "-ventilator_tidal_volume 250 -ventilator_peep 10")}
CHECKS = {"direct": "@direct", "quarter of the step": "@reuse -ts_dt 0.0125", "no gas on the airway wall": "@reuse -lumen_pressure off"}
HEADER = ["breath", "law", "flags", "end", "V_T ml", "C_rs ml/cmH2O", "R cmH2O s/l", "least J", "steps", "cut", "Newton", "Krylov",
          "wall s", "CPU s"]


def arguments(parser):
    parser.usage = "tools/benchmark breaths [options] [-- 'FLAGS' ...]"
    parser.add_argument("--mesh", type=Path, default=SOURCE / "meshes/lung_test.msh", help="default: meshes/lung_test.msh")
    parser.add_argument("--laws", nargs="+", metavar="LAW", help="default: all that the program offers")
    parser.add_argument("--breaths", nargs="+", choices=BREATHS, default=list(BREATHS), help="default: all four")
    parser.add_argument("--volume", type=float, default=250, help="tidal volume of volume control, ml (default 250)")
    parser.add_argument("--checks", nargs="*", choices=CHECKS, default=list(CHECKS),
                        help="how a breath that does not finish is run again (default: all; none: --checks)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--output", type=Path, default=SOURCE / "results/breaths", help="default: results/breaths")
    parser.set_defaults(repeat=1, ranks=1, launcher="")


def words(options, breath, law, flags):
    """All words of a run: scene, solver, then what is the breath's own."""
    scene, own = BREATHS[breath]
    solver = solver_words(flags)
    return ["-options_file", SCENES / f"{scene}.opts", "-tissue", law, *own.replace("250", f"{options.volume:g}").split(), *solver]


def number(value):
    return "-" if value is None else f"{value:.4g}"


def end(result):
    """Exit code, and for a run that did not finish when and where, as pulmo says it."""
    said = result.get("summary", {}).get("failure")
    if result["code"] == 0:
        return "0: finished"
    if not said:
        return f"{result['code']}: {result['reason']}"
    where, when = re.search(r"Where: (.*?)\. ", said), re.search(r"(after t|at t) = (\S+) s \(phase (\w+), airway pressure (\S+) cmH2O", said)
    return (f"{result['code']}: " + (f"t = {float(when[2]):.3f} s, {when[3]}, {float(when[4]):.1f} cmH2O: " if when else "")
            + (where[1] if where else said.split(".")[0]))


def row(label, result):
    summary = result.get("summary", {})
    clinical = [summary.get(key) for key in ("tidal_volume_ml", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "min_jacobian")]
    counts = [summary.get(key, "-") for key in ("steps", "rejected_steps", "newton_iterations", "krylov_iterations")]
    return [*label, end(result), *map(number, clinical), *counts, f"{result['wall']:.1f}", f"{result['cpu']:.1f}"]


def run(options):
    require(options.build, [options.mesh])
    options.laws = laws_of(options)
    common = ["-dm_plex_filename", options.mesh]

    def results_of(entries):
        made = measure({" | ".join(label): words(options, *label) for label in entries}, common, options)
        return {label: made[" | ".join(label)][0] for label in entries}

    results = results_of([(breath, law, flags) for breath in options.breaths for law in options.laws
                          for flags in options.flags or ["@reuse" if law == "rausch" else "@iterative"]])
    stopped = list(dict.fromkeys(label[:2] for label, result in results.items() if result["code"]))
    again = results_of([(*label, CHECKS[check]) for label in stopped for check in options.checks
                        if (*label, CHECKS[check]) not in results])
    everything = [*results.values(), *again.values()]
    finished = sum(result["code"] == 0 for result in results.values())
    notes = (f"{finished} of {len(results)} finished. One rank on {processor()}, {blas(options.build / 'pulmo')} with one thread, "
             f"{runs.load_range(everything)}; one run each. Springs on pleura and airway and all else as in scenes/pcv.opts and "
             "scenes/vcv.opts. End: exit code, and where the run stopped, as it says itself. Cut: steps that were taken again with a "
             "smaller dt. Of a run that stopped the least J is that of its accepted steps.")
    more = ["", "Those that stopped, run again:", "", *markdown(HEADER, [row(*item) for item in again.items()])] if again else []
    write_table(options.output, "breaths", f"Ordinary breaths on {mesh_sentence(options.mesh, {0: everything})}", HEADER,
                [row(*item) for item in results.items()], notes, more)
    if again:
        show(HEADER, [row(*item) for item in again.items()])
