"""`tools/benchmark effects`: what each effect changes and costs on a built-in lung, alone and all at once.

The effects are those of `pulmo -list`: a new one shows up with the options of its example, until it has some of a patient's here. An effect
that the scene has already is turned off instead. Then the static pressure-volume curve with and without airflow, and what
effects cost that are off: a program that has them all against one that has only those that are on, in turns in one process.
Words after -- go to every run.
"""
import json
import shlex
import subprocess
from pathlib import Path

from shared.common import KPA_PER_CMH2O, SCENES, SOURCE, environment, examples, fail, markdown, offered, processor, require, write_table

from . import plots, runs
from .plots import plt
from .strategies import measure, mesh_sentence, solver_words

# a short breath of tissue that keeps a lung's volume at these pressures, of the weight of a lung, on springs that let it slide
SCENE = ("-tissue patte -tissue_porosity 0.75 -elements P1-P1 -chest_wall_direction normal -ventilator_pip 15 -ventilator_peep 5 "
         "-ventilator_inspiration 0.8 -ventilator_expiration 1.2 -ventilator_ramp_down 0.1 -ventilator_settle_duration 2")
# a patient's numbers in place of those of the examples, which are made for tests
ON = {"airway_tree": "-airway_tree star -airway_tree_resistance 3",
      "breathing_effort": "-breathing_effort -breathing_effort_pressure 5 -breathing_effort_rise 0.6 -breathing_effort_hold 0.1 "
                          "-breathing_effort_fall 0.3 -breathing_effort_period 2",
      "cavity": "-cavity -cavity_gap 8 -snes_linesearch_type l2",
      "gravity": "-gravity",
      "inertia": "-inertia",
      "prestress": "-prestress",
      "recruitment": "-recruitment",
      "surfactant": "-surfactant",
      "tube": "-tube -tube_k1 4 -tube_k2 6"}
# how the scene does without what it has
OFF = {"chest_wall": "-chest_wall off -lumen_pressure off -support -support_rigid"}
NEEDED = {"tissue", "ventilator"}  # no breath without them
OFF_TIME, OFF_REPEATS = 0.8, 6  # s of the breath; runs for each of --repeat
SYRINGE = "-tissue patte -elements P1-P1 -ventilator_steps 4 -ventilator_step_volume 150"
STATIC = {"supersyringe": "-ventilator_pause 1.5", "the same without airflow": "-airflow off -ventilator_pause 0 -ts_dt 0.3"}
ALL = "+ all of these"
HEADER = ["scene", "CPU s", "slowest", "over the first", "peak MB", "Newton", "Krylov", "V_T ml", "C_rs ml/cmH2O", "R cmH2O s/l",
          "loop mJ", "of it flow", "of it steps", "low/high", "remark"]
MJ_PER_CMH2O_ML = KPA_PER_CMH2O  # 1 kPa ml is 1 mJ
MUSCLES = "muscle_pressure_cmH2O"
THIRD, SAME = 1 / 3, 1e-9  # s


def arguments(parser):
    parser.usage = "tools/benchmark effects [options] [-- WORDS for every run]"
    parser.add_argument("--mesh", type=Path, default=SOURCE / "meshes/lung_test.msh", help="default: meshes/lung_test.msh")
    parser.add_argument("--effects", nargs="+", metavar="EFFECT", help="default: all that the program offers")
    parser.add_argument("--solver", default="@iterative", help="flags of the solver (default: @iterative)")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each scene, in turns (default 3)")
    parser.add_argument("--timeout", type=float, default=600, help="seconds after which a run is ended (default 600)")
    parser.add_argument("--results", type=Path, default=SOURCE / "results/effects", help="where runs are kept (default: results/effects)")
    parser.add_argument("--output", type=Path, default=SOURCE / "docs/effects", help="of the page (default: docs/effects)")
    parser.set_defaults(ranks=1, launcher="")


def entries_of(active, found, wanted):
    """{label: options} of the scenes: as it is, each effect more or less, all at once. `active`: those of the scene; `found`: examples by effect."""
    more = {effect: ON.get(effect, example) for effect, example in found.items()
            if effect not in active and (not wanted or effect in wanted)}
    less = {effect: OFF.get(effect, f"-{effect} off") for effect in active
            if effect not in NEEDED and (not wanted or effect in wanted)}
    entries = {"the scene": ""}
    entries |= {f"+ {effect}": words for effect, words in more.items()}
    if len(more) > 1:
        entries[ALL] = " ".join(more.values())
    return entries | {f"− {effect}": words for effect, words in less.items()}


def loop(result):
    """Area of the loop of pressure over volume in the last breath, mJ: of all that moves the gas, ventilator and muscles. By the
    pressure at the end of each step, which is the work that backward Euler does."""
    breath = result["summary"]["breaths"][-1]
    rows = [r for r in runs.signals(result) if breath["start_s"] - SAME <= float(r["time_s"]) <= breath["end_s"] + SAME]
    machine = "ventilator_pressure_cmH2O" if "ventilator_pressure_cmH2O" in rows[0] else "airway_pressure_cmH2O"
    p, v = [float(r[machine]) + float(r.get(MUSCLES) or 0) for r in rows], [float(r["volume_ml"]) for r in rows]
    return MJ_PER_CMH2O_ML * sum(p[i] * (v[i] - v[i - 1]) for i in range(1, len(p)))


def low_to_high(result):
    """Gas that came per volume in the lowest third of somebody on the back, over that in the highest third."""
    import h5py
    import numpy as np
    from accuracy.fields import snapshots

    folder, end = result["folder"] / "run", result["summary"]["breaths"][-1]["end_of_inspiration_s"]
    if end is None:
        return None
    _, values, mesh = min(snapshots(folder), key=lambda s: abs(s[0] - end))
    with h5py.File(mesh) as file:
        corners = file["geometry"][:][file["topology"][:].reshape(-1, 10)[:, :4]]
    with h5py.File(values) as file:
        came = file["ventilation_since_breath_start"][:].ravel()
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    height = corners.mean(axis=1)[:, 1]
    height = (height - height.min()) / (height.max() - height.min())

    def mean(where):
        return (came * volume)[where].sum() / volume[where].sum()

    return mean(height < THIRD) / mean(height > 1 - THIRD)


def fastest(results):
    """Least and largest CPU seconds."""
    return min(r["cpu"] for r in results), max(r["cpu"] for r in results)


def number(value, form=".4g"):
    return "-" if value is None else f"{value:{form}}"


def row(label, results, reference):
    first, (least, most) = results[0], fastest(results)
    summary, failed = first.get("summary", {}), first["code"] != 0
    # C_rs and R are fitted to the pressure of the airway, which is not alone where muscles pull
    keys = ["tidal_volume_ml", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"]
    pulled = not failed and MUSCLES in runs.signals(first)[0]
    clinical = [None if failed or (pulled and key != keys[0]) else summary.get(key) for key in keys]
    energy = {} if failed else summary["breaths"][-1].get("energy_j") or {}
    flow = [v for name, v in energy.items() if name.startswith("resistive")]
    return [label, f"{least:.2f}", f"{most:.2f}", "-" if failed else f"{least / reference:.2f}", f"{max(r['memory'] for r in results):.0f}",
            summary.get("newton_iterations", "-"), summary.get("krylov_iterations", "-"), *map(number, clinical),
            "-" if failed else f"{loop(first):.0f}", f"{1e3 * sum(flow):.0f}" if flow else "-",
            f"{1e3 * energy['numerical_dissipation']:.0f}" if "numerical_dissipation" in energy else "-",
            "-" if failed else number(low_to_high(first), ".2f"), first["reason"]]


def static_points(result):
    """Volume and pressure at the end of each step of a supersyringe, in order."""
    rows = [r for r in runs.signals(result) if float(r["dt_s"]) > 0]
    if any(r["phase"] == "pause" for r in rows):
        ends = [r for r, after in zip(rows, [*rows[1:], None]) if r["phase"] == "pause" and (not after or after["phase"] != "pause")]
    else:  # a step each
        ends = rows
    return [(float(r["volume_ml"]), float(r["airway_pressure_cmH2O"])) for r in ends]


def static_lines(results):
    """Lines of the page on the static curve."""
    if any(group[0]["code"] for group in results.values()):
        return ["", "## The cheapest scene", "", "It did not finish here: " +
                "; ".join(f"{label}: {group[0]['reason']}" for label, group in results.items() if group[0]["code"])]
    (slow, moving), (quick, still) = ((label, static_points(group[0])) for label, group in results.items())
    times = {label: fastest(group) for label, group in results.items()}
    largest = max(p for _, p in moving)
    if [round(v, 3) for v, _ in moving] != [round(v, 3) for v, _ in still]:
        fail("the static curves with and without airflow are not of the same volumes")
    apart = max(abs(a[1] - b[1]) for a, b in zip(moving, still))
    table = [[label, group[0]["summary"]["steps"], group[0]["summary"]["newton_iterations"], f"{times[label][0]:.2f}",
              f"{times[label][1]:.2f}", f"{max(r['memory'] for r in group):.0f}"] for label, group in results.items()]
    return ["", "## The cheapest scene", "",
            f"The static pressure–volume curve, {len(still)} points (`scenes/supersyringe.opts {SYRINGE}`): without airflow each is one "
            f"step, and the curve takes {100 * times[quick][0] / times[slow][0]:.0f} % of the supersyringe's time (start of the program "
            f"included). Its pressures and those at the ends of the pauses are at most {apart:.2g} cmH2O apart, of {largest:.3g}: what "
            "is still flowing after 1.5 s.", "",
            *markdown(["scene", "steps", "Newton", "CPU s", "slowest", "peak MB"], table)]


def off_lines(options, scene):
    """Lines of the page on what is off."""
    command = [options.build / "pulmo_off_benchmark", *scene, "-progress", "off", "-ts_max_time", f"{OFF_TIME:g}", "-benchmark_repeats", str(OFF_REPEATS * options.repeat)]
    run = subprocess.run([str(c) for c in command], capture_output=True, text=True, env=environment(), cwd=SOURCE)
    if run.returncode:
        fail(f"pulmo_off_benchmark: {(run.stderr or run.stdout).strip().splitlines()[-1]}")
    found = json.loads(run.stdout.splitlines()[-1])
    every, few = found["all"], found["few"]
    counts = [[name, every[name], few[name]] for name in every if name not in ("seconds", "slowest", "heap")]
    times = [["CPU s, fastest", f"{every['seconds']:.3f}", f"{few['seconds']:.3f}"],
             ["slowest", f"{every['slowest']:.3f}", f"{few['slowest']:.3f}"],
             ["heap at the end, bytes", every["heap"], few["heap"]]]
    differ = [name for name, a, b in counts if a != b and name != "effects"]
    share = 100 * (every["seconds"] / few["seconds"] - 1)
    noise = 100 * max(x["slowest"] / x["seconds"] - 1 for x in (every, few))
    said = "the same" if not differ else "**not the same**: " + ", ".join(differ)
    return ["", "## What is off", "",
            f"The first {OFF_TIME:g} s of the scene, by a program with all effects ({every['effects']}) and by one that has only those of the scene "
            f"({few['effects']}), in turns in one process, {found['repeats']} times each. Counts: {said}. States and signals: "
            f"{'the same bit for bit' if found['same'] else '**not the same**'}. Seconds: {share:+.1f} % between the fastest runs, where "
            f"runs of one program differ by up to {noise:.0f} %. Heap: {(every['heap'] - few['heap']) / 1024:+.0f} kB, which are the effects "
            "themselves and the list of their options, whatever the mesh.", "",
            *markdown(["", "all effects", "only those that are on"], counts + times)]


def draw(path, rows):
    """Seconds, V_T, C_rs and low/high of each scene over those of the first."""
    shown = [r for r in rows if r[3] != "-"]
    panels = [("CPU time", 1), ("V_T", 7), ("C_rs", 8), ("R", 9), ("low/high", 13)]
    figure, axes = plt.subplots(1, len(panels), figsize=(13, 1.2 + 0.32 * len(shown)), sharey=True, layout="constrained")
    for axis, (name, column) in zip(axes, panels):
        values = [None if r[column] == "-" or shown[0][column] == "-" else float(r[column]) / float(shown[0][column]) for r in shown]
        for place, value in enumerate(values):
            if value is not None:
                axis.barh(place, value - 1, left=1, color="#b5403a" if value > 1 else "#2f6c9e")
                axis.text(max(value, 1), place, f" {value:.2f}", va="center", fontsize=7)
        axis.axvline(1, color="#444444", lw=0.8)
        axis.margins(x=0.25)
        axis.set_xlabel(f"{name} over that of the scene", fontsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yticks(range(len(shown)), [r[0] for r in shown], fontsize=8)
    axes[0].invert_yaxis()
    plots.save(figure, path, "What each effect changes and costs")


def run(options):
    require(options.build, [options.mesh])
    if options.repeat < 1:
        fail("--repeat must be at least 1")
    there = set(offered(options.build / "pulmo", "effect")) - NEEDED
    for effect in options.effects or []:
        if effect not in there:
            fail(f"--effects {effect} is not offered; there are {', '.join(sorted(there))}")
    own = [word for flags in options.flags for word in shlex.split(flags)]
    common = ["-dm_plex_filename", options.mesh]
    solver = solver_words(options.solver)
    scene = ["-options_file", SCENES / "pcv.opts", *SCENE.split(), *solver, *own]
    page, options.output = options.output, options.results
    first = measure({"the scene": scene}, common, options)["the scene"][0]
    if first["code"]:
        fail(f"the scene itself does not finish: {first['reason']}")
    entries = entries_of(first["summary"]["effects"], examples(options.build / "pulmo"), options.effects)
    results = measure({label: [*scene, *words.split()] for label, words in entries.items()}, common, options)
    syringe = ["-options_file", SCENES / "supersyringe.opts", *SYRINGE.split(), *solver, *own]
    static = measure({label: [*syringe, *words.split()] for label, words in STATIC.items()}, common, options)

    reference = fastest(results["the scene"])[0]
    rows = [row(label, group, reference) for label, group in results.items()]
    everything = [r for group in [*results.values(), *static.values()] for r in group]
    noise = max(most / least - 1 for least, most in map(fastest, results.values()))
    notes = (f"`tools/benchmark effects` on {mesh_sentence(options.mesh, results)}. The scene: a breath of `scenes/pcv.opts {SCENE}`, "
             f"{options.solver} {' '.join(own)}".rstrip() + f". One rank on {processor()}, {runs.load_range(everything)}; CPU seconds of the whole "
             f"process, the fastest and the slowest of {options.repeat}; runs of one scene differ by up to {100 * noise:.0f} %, and what "
             "differs by less says nothing. One mesh, one element: no error bars. Loop: area of pressure over volume in the breath "
             "(pressure of ventilator and muscles together); of it flow: heat of the gas in tissue, tube and tree; of it steps: lost by "
             "backward Euler; the rest is hysteresis of tissue, of films and of what opens, and what is left in a lung that has not come back. C_rs and R are "
             "fitted to the pressure of the airway, and left out where muscles pull, too. Low/high: gas per volume in the lowest "
             "third of somebody who lies on the back over that in the highest third.")
    more = ["", "![each scene over the first](cost.png)", "", "What each line adds:", "",
            *markdown(["scene", "options"], [[label, "all of the above" if label == ALL else f"`{words}`"] for label, words in entries.items() if words]),
            *static_lines(static), *off_lines(options, [*common, *scene])]
    write_table(page, "cost", "What each effect costs and changes", HEADER, rows, notes, more)
    draw(page / "cost.png", rows)
