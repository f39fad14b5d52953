"""Which elements: what P2-P1, P1-P1 and P3-P2 cost for the same error in space, for the five laws on the built-in right lung."""
import statistics

from benchmarks.common import markdown, write_csv
from benchmarks.plots import plt, save

from . import command, laws, page
from .laws import LAWS
from .numbers import ALIASES, short
from .pictures import fill, logarithmic
from .settings import ELEMENTS
from .sphere import cost_at, text

KEYS = [ALIASES[name] for name in ("V_T", "Q_peak", "C_rs", "R")]
FINEST = {8: 1.77}  # mm: one more mesh than in the study of the laws
BUDGET = "5min"
WANTED = (0.05, 0.02)


def search_of(law, paths, results, build):
    """The ladder in space of one law with each pair of elements; one step in time."""
    search = command.prepare(["pcv", "--meshes", *map(str, paths), "--elements", *ELEMENTS, "--dt", "0.1", "--dt-factors", "1", "--schemes", "beuler",
                              "--adaptive", "0", "--tolerances", "--solvers", laws.SOLVER.get(law, "iterative"), "--clock", "cpu",
                              "--budget", BUDGET, "--output", str(results / law), "--results", str(results), *build,
                              "--", "-ventilator_ramp_down", "0.1", "-tissue", law, *LAWS[law][2]])
    if search.ladder.attempt(search.axes.base):
        search.singles(search.ladder.budget)
    return search


def in_space(search, key):
    """Mesh -> error in space, a share of the limit."""
    e = search.all_errors()[key]
    limit = e.limits["space"].value
    return {m: e.parts[m] / limit for m in search.axes.meshes if m in e.parts}


def runs_by_mesh(search):
    """The runs of the ladder in space."""
    base = search.axes.base
    return {s.mesh: run for s, run in search.ladder.done.items() if (s.steps, s.solver) == (base.steps, base.solver)}


def table(searches):
    """A row for each mesh and pair: errors of the numbers by law."""
    header = ["elements", "tets", "dofs", "CPU s", *(f"{LAWS[law][0]}: {', '.join(map(short, KEYS))} off by %" for law in searches)]
    rows = []
    first = next(iter(searches.values()))
    for mesh in first.axes.meshes:
        made = {law: runs_by_mesh(s).get(mesh) for law, s in searches.items()}
        some = [run for run in made.values() if run]
        if not some:
            continue
        row = [mesh.elements, mesh.cells, some[0].summary["dofs"], f"{statistics.median(run.cpu for run in some):.3g}"]
        for law, run in made.items():
            row.append(" ".join(f"{100 * in_space(searches[law], key)[mesh]:+.2g}" for key in KEYS) if run else "-")
        rows.append(row)
    return header, rows


def uncertainties(searches):
    """What the limits in space may be off, %, by law."""
    return "; ".join(f"{LAWS[law][0]} " + ", ".join(f"{short(key)} {100 * e.limits['space'].uncertainty / abs(e.limits['space'].value):.2g}"
                                                 for key in KEYS if (e := search.all_errors()[key]))
                     for law, search in searches.items())


def factors(searches):
    """Table: CPU seconds of each pair to an error in space, by number and law."""
    header = ["law", "number", "error in space", *(f"{pair}: CPU s" for pair in ELEMENTS), "P2-P1 over P1-P1"]
    rows = []
    for law, search in searches.items():
        runs = runs_by_mesh(search)
        for key in KEYS:
            errors = in_space(search, key)
            for wanted in WANTED:
                costs = {pair: cost_at([(runs[m].cpu, abs(error)) for m, error in errors.items() if m.elements == pair], wanted)
                         for pair in ELEMENTS}
                (two, bound), (one, other) = costs["P2-P1"], costs["P1-P1"]
                if two is None and one is None:
                    continue
                told = ["-" if cost is None else ("≤ " if at_most else "") + f"{cost:.2g}" for cost, at_most in costs.values()]
                ratio = None if None in (two, one) or bound or other else two / one
                rows.append([LAWS[law][0], short(key), f"{100 * wanted:g} %", *told, text(ratio, "{:.1f}")])
    return header, rows


def draw(path, searches):
    figure, axes = plt.subplots(1, len(KEYS), figsize=(14, 3.9), layout="constrained")
    for law, search in searches.items():
        label, colour, _ = LAWS[law]
        runs = runs_by_mesh(search)
        for axis, key in zip(axes, KEYS):
            for pair in ELEMENTS:
                points = sorted((runs[m].cpu, abs(error)) for m, error in in_space(search, key).items() if m.elements == pair and error)
                if points:
                    axis.plot(*zip(*points), "o-" if pair != "P3-P2" else "s--", ms=5, lw=0.7, color=colour, fillstyle=fill(pair),
                              label=f"{label}, {pair}" if law == "birzle" else label if pair == "P2-P1" else None)
    for axis, key in zip(axes, KEYS):
        logarithmic(axis, xlabel="CPU s", title=short(key))
    axes[0].set_ylabel("error in space")
    axes[0].legend(fontsize=6)
    save(figure, path, "Error in space over cost: full P2-P1, hollow P1-P1, squares P3-P2; built-in right lung, PCV")


def fields_table(search):
    """Errors of the fields of one law, against the run with the most unknowns."""
    found, reference = page.field_errors(search)
    rows = []
    for setting, run in search.ladder.done.items():
        if setting in found:
            rows.append([setting.mesh.elements, setting.mesh.cells, run.summary["dofs"], f"{run.cpu:.3g}",
                         *(f"{100 * found[setting][k]:.2g}" for k in ("u L2", "u H1", "p L2"))])
    return ["elements", "tets", "dofs", "CPU s", "u: L2 %", "u: H1 %", "p: L2 %"], rows, reference


def run(folder, results, build):
    paths = laws.meshes(results / "meshes", laws.MESHES | FINEST)
    searches = {law: search_of(law, paths, results, build) for law in LAWS}
    folder.mkdir(parents=True, exist_ok=True)
    made = {law: s for law, s in searches.items() if s.ladder.done}
    header, rows = table(made)
    write_csv(folder / "elements.csv", header, rows)
    f_header, f_rows = factors(made)
    write_csv(folder / "factors.csv", f_header, f_rows)
    draw(folder / "elements.png", made)
    u_header, u_rows, reference = fields_table(made["birzle"])
    ratios = sorted(float(row[-1]) for row in f_rows if row[-1] != "-")
    left_out = [f"- {LAWS[law][0]}, {setting.name}: {why}" for law, s in searches.items() for setting, why in
                [*((t, why) for t, (why, _) in s.ladder.failed.items()), *s.ladder.skipped.items()]]
    lines = ["# Elements: error in space over cost", "", "    tools/accuracy_study elements", "",
             "PCV with `-ventilator_ramp_down 0.1`, built-in right lung, backward Euler with Δt 0.1 s; CM1 with `-lumen_pressure`, CM5 with `reuse.opts`, the "
             "others with `iterative.opts`. Errors against the limit of the surest ladder; CPU seconds of one core, the median of the laws.",
             "", "![elements](elements.png)", "", *markdown(header, rows), "", f"What the limits may be off, %: {uncertainties(made)}.", "",
             "## CPU seconds to an error", "", "Interpolated between runs; ≤: the cheapest level meets it already, no ratio is given then; -: not reached.", "",
             *markdown(f_header, f_rows), "",
             (f"P2-P1 over P1-P1: {ratios[0]:.1f} to {ratios[-1]:.1f}, median {statistics.median(ratios):.1f} ({len(ratios)} ratios)." if ratios
              else "No ratio is known."), "",
             "## Fields", "", f"CM3 at {reference[1]:g} s, relative errors against {reference[0].setting.mesh.name} ({reference[0].summary['dofs']} dofs), "
             "which has errors of its own.", "", *markdown(u_header, u_rows), "", "## Left out", "", *(left_out or ["Nothing."])]
    (folder / "README.md").write_text("\n".join(lines) + "\n")
