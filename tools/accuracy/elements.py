"""Which elements: what P2-P1, P1-P1 and P3-P2 cost for the same error in space, for every tissue law on the built-in right lung."""
import statistics

from benchmarks.plots import plt, save
from shared.common import markdown, write_csv

from . import command, laws, page
from .numbers import KEYS, short
from .pictures import fill, logarithmic
from .settings import ELEMENTS
from .sphere import cost_at, text

FINEST = {8: 1.77}  # mm: one more mesh than in the study of the laws
BUDGET = "5min"
WANTED = (0.05, 0.02)


def search_of(law, paths, results, build):
    """The ladder in space of one law with each pair of elements; one step in time."""
    search = command.prepare(["pcv", "paper", "--meshes", *map(str, paths), "--elements", *ELEMENTS, "--dt", "0.1", "--dt-factors", "1", "--schemes", "beuler",
                              "--adaptive", "0", "--tolerances", "--solvers", law.solver(), "--clock", "cpu",
                              "--budget", BUDGET, "--output", str(results / law.name), "--results", str(results), *build,
                              "--", "-ventilator_ramp_down", "0.1", *law.words()])
    if search.ladder.attempt(search.axes.base):
        search.singles(search.ladder.budget)
    return search


def limit_of(search, key):
    """The limit in space; None if the scene lacks the number."""
    e = search.all_errors().get(key)
    return e and e.limits["space"]


def in_space(search, key):
    """Mesh -> error in space, a share of the limit."""
    e = search.all_errors().get(key)
    return {m: e.parts[m] / limit_of(search, key).value for m in search.axes.meshes if m in e.parts} if e else {}


def runs_by_mesh(search):
    """The runs of the ladder in space."""
    base = search.axes.base
    return {s.mesh: run for s, run in search.ladder.done.items() if (s.steps, s.solver) == (base.steps, base.solver)}


def rows(searches):
    """One for each law, mesh and pair: cells, dofs, CPU s, errors of the numbers in %, None where there is none."""
    return [[law.label, mesh.elements, mesh.cells, run.summary["dofs"], run.cpu, run.summary["rejected_steps"],
             *(100 * errors[mesh] if mesh in (errors := in_space(search, key)) else None for key in KEYS)]
            for law, search in searches.items() for mesh in search.axes.meshes if (run := runs_by_mesh(search).get(mesh))]


def table(searches):
    """A row for each mesh and pair: errors of the numbers by law."""
    laws_ = [law.label for law in searches]
    header = ["elements", "tets", "dofs", "CPU s", *(f"{law}: {', '.join(map(short, KEYS))} off by %" for law in laws_)]
    made = {}
    for law, pair, cells, dofs, cpu, _, *errors in rows(searches):
        made.setdefault((pair, cells, dofs), {})[law] = cpu, " ".join(text(error, "{:+.2g}") for error in errors)
    return header, [[*key, f"{statistics.median(cpu for cpu, _ in of.values()):.3g}" + (f" ({len(of)} laws)" if len(of) < len(laws_) else ""),
                     *(of[law][1] if law in of else "-" for law in laws_)]
                    for key, of in sorted(made.items(), key=lambda item: (ELEMENTS.index(item[0][0]), item[0][1]))]


def limits_table(searches):
    """Limits in space, what they may be off and whose they are."""
    return ["law", "number", "limit", "± %", "from"], [
        [law.label, short(key), f"{found.value:.5g}", f"{100 * found.uncertainty / abs(found.value):.2g}", found.how]
        for law, search in searches.items() for key in KEYS if (found := limit_of(search, key))]


def factors(searches):
    """Table: CPU seconds of each pair to an error in space, by number and law; no ratio where the limit is in doubt by half of that."""
    header = ["law", "number", "error in space", *(f"{pair}: CPU s" for pair in ELEMENTS), "P2-P1 over P1-P1"]
    made = []
    for law, search in searches.items():
        runs = runs_by_mesh(search)
        for key in KEYS:
            found, errors = limit_of(search, key), in_space(search, key)
            for wanted in WANTED:
                costs = {pair: cost_at([(runs[m].cpu, abs(error)) for m, error in errors.items() if m.elements == pair], wanted)
                         for pair in ELEMENTS}
                (two, bound), (one, other) = costs["P2-P1"], costs["P1-P1"]
                if two is None and one is None:
                    continue
                told = ["-" if cost is None else ("≤ " if at_most else "") + f"{cost:.2g}" for cost, at_most in costs.values()]
                doubtful = found.uncertainty > wanted / 2 * abs(found.value)
                ratio = None if None in (two, one) or bound or other else two / one
                made.append([law.label, short(key), f"{100 * wanted:g} %", *told, "limit in doubt" if doubtful else text(ratio, "{:.1f}")])
    return header, made


def draw(path, searches):
    figure, axes = plt.subplots(1, len(KEYS), figsize=(14, 3.9), layout="constrained")
    for law, search in searches.items():
        runs = runs_by_mesh(search)
        for axis, key in zip(axes, KEYS):
            for pair in ELEMENTS:
                points = sorted((runs[m].cpu, abs(error)) for m, error in in_space(search, key).items() if m.elements == pair and error)
                if points:
                    axis.plot(*zip(*points), "o-" if pair != "P3-P2" else "s--", ms=5, lw=0.7, color=law.colour, fillstyle=fill(pair),
                              label=f"{law.label}, {pair}" if law.name == "birzle" else law.label if pair == "P2-P1" else None)
    for axis, key in zip(axes, KEYS):
        logarithmic(axis, xlabel="CPU s", title=short(key))
    axes[0].set_ylabel("error in space")
    axes[0].legend(fontsize=6)
    save(figure, path, "Error in space over cost: full P2-P1, hollow P1-P1, squares P3-P2; built-in right lung, PCV")


def fields_lines(search):
    """Errors of the fields of one law, in words and a table."""
    found, reference = page.field_errors(search)
    if not found:
        return ["Not compared: a run left none."]
    run, time = reference
    table_ = [[s.mesh.elements, s.mesh.cells, r.summary["dofs"], f"{r.cpu:.3g}", *(f"{100 * found[s][k]:.2g}" for k in ("u L2", "u H1", "p L2"))]
              for s, r in search.ladder.done.items() if s in found]
    return [f"At {time:g} s, relative errors against {run.setting.mesh.name} ({run.summary['dofs']} dofs), which has errors of its own. Of P3 "
            "displacement the files hold the quadratic part.", "",
            *markdown(["elements", "tets", "dofs", "CPU s", "u: L2 %", "u: H1 %", "p: L2 %"], table_)]


def run(folder, results, build):
    paths = laws.meshes(results / "meshes", laws.MESHES | FINEST)
    searches = {law: search_of(law, paths, results, build) for law in laws.laws_of(build)}
    folder.mkdir(parents=True, exist_ok=True)
    made = {law: s for law, s in searches.items() if s.ladder.done}
    write_csv(folder / "elements.csv", ["law", "elements", "cells", "dofs", "cpu_s", "rejected_steps", *(f"error_{key}_percent" for key in KEYS)],
              [[*row[:4], f"{row[4]:.3g}", row[5], *(text(error, "{:.4g}") for error in row[6:])] for row in rows(made)])
    f_header, f_rows = factors(made)
    write_csv(folder / "factors.csv", f_header, f_rows)
    draw(folder / "elements.png", made)
    ratios = sorted(float(row[-1]) for row in f_rows if row[-1][0].isdigit())
    left_out = [f"- {law.label}, {setting.name}: {why}" for law, s in searches.items() for setting, why in
                [*((t, why) for t, (why, _) in s.ladder.failed.items()), *s.ladder.skipped.items()]]
    lines = ["# Elements: error in space over cost", "", "    tools/accuracy_study elements", "",
             "PCV with `-ventilator_ramp_down 0.1`, built-in right lung, backward Euler with Δt 0.1 s; CM1 with `-lumen_pressure`, CM5 with `reuse.opts`, the "
             "others with `iterative.opts`. CPU seconds of one core, the median of the laws (of those that finished where that is told). "
             "Errors against the limit of the surest ladder, below.",
             "", "![elements](elements.png)", "", *markdown(*table(made)), "", "## CPU seconds to an error", "",
             "Interpolated between runs; ≤: the cheapest level meets it already, no ratio is given then; -: not reached.", "",
             *markdown(f_header, f_rows), "",
             (f"P2-P1 over P1-P1: {ratios[0]:.1f} to {ratios[-1]:.1f}, median {statistics.median(ratios):.1f} ({len(ratios)} ratios)." if ratios
              else "No ratio is known."), "", "## The limits", "", *markdown(*limits_table(made)), "",
             "## Fields (CM3)", "", *next((fields_lines(s) for law, s in made.items() if law.name == "birzle"), ["No run finished."]), "",
             "## Left out", "", *(left_out or ["Nothing."])]
    (folder / "README.md").write_text("\n".join(lines) + "\n")
