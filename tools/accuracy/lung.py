"""The built-in pair of lungs: a question answered within ten minutes, and a run far finer that checks the answer."""
import math

from shared.common import markdown, write_csv

from . import command, settings
from .errors import in_time
from .extrapolate import limit
from .numbers import ALIASES, SHORT, short
from .settings import SCHEMES, Mesh, Setting, Steps

QUESTION = ["pcv", "paper", "--lung", "30", "21", "15", "11", "--elements", "P2-P1", "P1-P1", "--question", "C_rs=1%", "--clock", "cpu", "--budget", "10min"]
# without a ramp the flow after the release goes with 1/sqrt(t), and the integral of its square, which the fit of C_rs and R
# takes, has no limit as dt -> 0 but that of the mesh
FLAGS = ["-ventilator_ramp_down", "0.1"]
FINE, FINE_STEPS = 8.5, Steps("bdf", 0.05)
SIZES = (0.2, 0.1, 0.05, 0.025, 0.0125)  # s: steps on the coarsest mesh, for the check in time


IN_SPACE = {"P2-P1": (30, 21, 15, 11, 8.5), "P1-P1": (30, 21, 15, 11, 8.5, 6)}  # mm: meshes of each pair, for the check in space


def mesh_of(size, elements, results):
    path, _ = settings.lung(size, results / "meshes", "cpu")
    return Mesh(f"{path.stem} {elements}", ("-dm_plex_filename", str(path), "-elements", elements), settings.cells_of(path), "", elements)


def in_space(search, results):
    """Header and rows of C_rs at the base's step over the size of the cells, by pair of elements; and a sentence on the limits."""
    search.ladder.budget, key, base = math.inf, ALIASES["C_rs"], search.axes.base
    sizes = sorted({size for of in IN_SPACE.values() for size in of}, reverse=True)
    rows, limits = [], []
    for elements, meant in IN_SPACE.items():
        made = {}
        for size in meant:
            setting = Setting(mesh_of(size, elements, results), base.steps, base.solver)
            if search.ladder.attempt(setting):
                made[size] = search.ladder.done[setting].numbers[key]
        rows.append([elements, *(f"{made[size]:.3f}" if size in made else "-" for size in sizes)])
        found = limit(list(made), list(made.values()), 2)
        limits.append(f"{elements} {found.value:.3f} ± {found.uncertainty:.3f} ({found.how})")
    return ["elements", *(f"{size:g} mm" for size in sizes)], rows, "Limits at this step: " + "; ".join(limits) + "."


def in_steps(words, sizes):
    """Rows of C_rs on the coarsest mesh: scheme, then one column for each size; a sentence on the limits; and the relative error of
    the far finer run's steps."""
    search, rows = command.prepare(words), []
    base, key = search.axes.base, ALIASES["C_rs"]
    search.ladder.budget = math.inf
    for scheme in SCHEMES:
        made = [Setting(base.mesh, Steps(scheme, dt), base.solver) for dt in sizes]
        values = [search.ladder.done[s].numbers[key] if search.ladder.attempt(s) else math.nan for s in made]
        rows.append([SCHEMES[scheme], *(f"{v:.3f}" for v in values)])
    limits, chosen = in_time(search.ladder.values(key), search.axes)
    told = "; ".join(f"{SCHEMES[s]} {found.value:.3f} ± {found.uncertainty:.3f} ({found.how})" for s, found in limits.items())
    fine = search.ladder.done.get(Setting(base.mesh, FINE_STEPS, base.solver))
    return (rows, f"Limits: {told}. Taken: {chosen.value:.3f} ± {chosen.uncertainty:.3f}.",
            fine.numbers[key] / chosen.value - 1 if fine else math.nan)


def run(folder, results, build):
    places = ["--output", str(folder), "--results", str(results), *build]
    search, sentences = command.explore([*QUESTION, *places, "--", *FLAGS])
    spent, answer = search.ladder.spent, search.answers()[0]
    setting = Setting(mesh_of(FINE, search.axes.base.mesh.elements, results), FINE_STEPS, search.axes.base.solver)
    search.ladder.budget = math.inf
    runs = {s: r for s, r in search.ladder.done.items()}
    if not search.ladder.attempt(setting):
        return
    fine = search.ladder.done[setting]
    header = ["setting", "CPU s", "C_rs", "C_rs: off by %", "estimated error %", "± %", *(f"{SHORT[k]}: off by %" for k in ALIASES.values()
              if k != ALIASES["C_rs"] and k != ALIASES["PIP"])]
    key, rows = ALIASES["C_rs"], []
    e = search.all_errors()[key]
    for s, r in sorted(runs.items(), key=lambda item: item[1].cpu):
        name = s.name + (" **(the answer)**" if answer.run and s == answer.run.setting else "")
        off = {k: 100 * (r.numbers[k] / fine.numbers[k] - 1) for k in ALIASES.values()}
        rows.append([name, f"{r.cpu:.1f}", f"{r.numbers[key]:.3f}", f"{off[key]:+.2f}", f"{100 * e.of(r.numbers[key]):+.2f}",
                     f"{100 * e.doubt:.2f}", *(f"{off[k]:+.2f}" for k in ALIASES.values() if k != key and SHORT[k] != "PIP")])
    write_csv(folder / "check.csv", header, rows)
    ramp, ramp_limits, in_time_part = in_steps([*QUESTION, *places, "--", *FLAGS], SIZES)
    space = in_space(command.prepare([*QUESTION, *places, "--", *FLAGS]), results)
    jump, jump_limits, _ = in_steps([*QUESTION, *places], SIZES[:3])
    # the finest mesh of the ladder of the same elements, its error taken to fall with h^2
    near = max((m for m in search.axes.meshes if m in e.parts and m.elements == search.axes.base.mesh.elements), key=lambda m: m.cells)
    in_space_part = e.parts[near] / e.value * (setting.mesh.size() / near.size()) ** 2
    off = e.of(fine.numbers[key])
    lines = ["# The answer against a far finer run", "", "    tools/accuracy_study lung", "", *(f"- {text}" for text in sentences), "",
             f"The answer took {spent:.0f} s of CPU on one core, meshes included (CPU, since the machine had other work). "
             f"The check: {setting.name}, {fine.summary['cells']} tetrahedra, {fine.summary['dofs']} dofs, {fine.summary['steps']} steps, "
             f"{fine.cpu:.0f} s CPU; C_rs {fine.numbers[key]:.3f} ml/cmH2O, the tool's limit from the runs below is {e.value:.3f} ± "
             f"{e.uncertainty:.2f}.", "",
             f"So the finer run lies {100 * off:+.2f} % from the limit, {'inside' if abs(off) <= e.doubt else '**outside**'} its ± "
             f"{100 * e.doubt:.2f} %. It has errors of its own: about {100 * in_time_part:+.2f} % in time ({FINE_STEPS.name}, the first table "
             f"below) and {100 * in_space_part:+.2f} % in space (that of {near.name}, falling with h²). \"Off by\" is against that run, "
             "\"estimated\" against the limit.", "", *markdown(header, rows), ""]
    base = search.axes.base.mesh
    lines += ["## C_rs over Δt", "", f"ml/cmH2O, {base.cells} tetrahedra, pressure let go over 0.1 s:", "",
              *markdown(["scheme", *(f"{dt:g} s" for dt in SIZES)], ramp), "", ramp_limits, "",
              "Pressure let go at once, as `pcv.opts` has it:", "", *markdown(["scheme", *(f"{dt:g} s" for dt in SIZES[:3])], jump), "",
              jump_limits]
    lines += ["", "## C_rs over h", "", f"ml/cmH2O, {search.axes.base.steps.name}, pressure let go over 0.1 s; size of the cells away from the airway:", "",
              *markdown(space[0], space[1]), "", space[2]]
    (folder / "check.md").write_text("\n".join(lines) + "\n")
    print(f"{short(key)}: the answer is off by "
          + (f"{100 * (answer.run.numbers[key] / fine.numbers[key] - 1):+.2f} %" if answer.run else "nothing: there is none"))
