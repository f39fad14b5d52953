"""Convergence of every clinical number in dt and in h for every tissue law, on the built-in right lung."""
from dataclasses import dataclass
from pathlib import Path

from benchmarks.plots import law_colours, plt, save
from shared.common import SOURCE, markdown, offered, tissue_laws, write_csv
from shared.keys import make_mesh

from . import command, page
from .extrapolate import limit, observed_order
from .numbers import KEYS, short
from .pictures import logarithmic
from .settings import ORDERS, SCHEMES, Setting

MESHES = {32: 7, 22.6: 4.95, 16: 3.5, 11.3: 2.5}  # mm: size and that of the airway; the first is meshes/lung_test.msh
FLAGS = {"berger": ["-lumen_pressure"]}  # without which a breath does not finish
SOLVER = {"rausch": "reuse"}
BUDGET = "100s"
SHOWN = (0.1, 0.025)  # s, steps of the table


@dataclass(frozen=True)
class Law:
    """A tissue law: its name, and its label and colour in the study."""

    name: str
    label: str
    colour: str

    def words(self):
        """Options of pulmo."""
        return ["-tissue", self.name, *FLAGS.get(self.name, [])]

    def solver(self):
        return SOLVER.get(self.name, "iterative")


def laws_of(build):
    """Every law that the program of a build offers; build: the words --build DIR, or none."""
    program = Path(build[1] if build else SOURCE / "build") / "pulmo"
    names, aliases = tissue_laws(program), offered(program, "tissue")
    colours = law_colours(names)
    return [Law(name, aliases[name].upper() or name, colours[name]) for name in names]


def meshes(folder, sizes):
    """Meshes of the right lung of 1350 ml, coarse to fine."""
    paths = []
    for size, airway in sizes.items():
        path = folder / f"right_{size:g}.msh"
        make_mesh(path, "lung_mesh", ["--side", "right", "--volume", "1350", "--bronchus-radius", "7", "--size", size, "--airway-size", airway])
        paths.append(path)
    return paths


def search_of(law, paths, results, build):
    """The runs of one law: each ladder alone."""
    search = command.prepare(["pcv", "paper", "--meshes", *map(str, paths), "--dt", "0.1", "--dt-factors", "2", "1", "0.5", "0.25", "--adaptive", "0",
                              "--tolerances", "--solvers", law.solver(), "--clock", "cpu", "--budget", BUDGET, "--output",
                              str(results / law.name), "--results", str(results), *build, "--", *law.words()])
    if search.ladder.attempt(search.axes.base):
        search.singles(search.ladder.budget)
    return search


def ladders(search, key):
    """(dt, value) by scheme and (size, value) of a number, coarse to fine."""
    values, axes = search.ladder.values(key), search.axes
    b = axes.base
    time = {scheme: [(t.dt, values[s]) for t in axes.steps if t.scheme == scheme and (s := Setting(b.mesh, t, b.solver)) in values]
            for scheme in SCHEMES}
    return time, [(m.size(), values[s]) for m in axes.meshes if (s := Setting(m, b.steps, b.solver)) in values]


def orders(found):
    return "-" if found.order is None else f"{found.order:.2f}"


def table(searches):
    """A row for each law and number."""
    header = ["law", "number", "limit", "± %", *(f"{SCHEMES[s]}: {what}" for s in SCHEMES for what in ("order", f"% at {SHOWN[0]:g} s", f"at {SHOWN[1]:g} s")),
              "h: order", "% on the coarse mesh", *(["next"] * (len(MESHES) - 1))]
    rows = []
    for law, search in searches.items():
        for key, e in search.all_errors().items():
            if not e.value or key in ("peep_cmH2O", "driving_pressure_cmH2O", "peak_inspiratory_pressure_cmH2O"):
                continue
            time, space = ladders(search, key)
            row = [law.label, short(key), f"{e.value:.5g}", f"{100 * e.doubt:.2g}"]
            for scheme, ladder in time.items():
                by_dt = {t.dt: e.parts[t] / e.value for t in search.axes.steps if t.scheme == scheme and t in e.parts}
                row.append(orders(limit(*zip(*ladder), ORDERS[scheme])) if len(ladder) > 2 else "-")
                row += [f"{100 * by_dt[dt]:+.2g}" if dt in by_dt else "-" for dt in SHOWN]
            seen = observed_order(*zip(*space[-3:])) if len(space) > 2 else None
            row.append(f"{seen:.2f}" if seen else "-")
            row += [f"{100 * e.parts[m] / e.value:+.2g}" if m in e.parts else "-" for m in search.axes.meshes]
            rows.append(row)
    return header, rows


def draw(path, searches):
    figure, axes = plt.subplots(2, len(KEYS), figsize=(13, 6), layout="constrained")
    for law, search in searches.items():
        for column, key in zip(axes.T, KEYS):
            e = search.errors().get(key)
            if e is None:
                continue
            for scheme, style in (("beuler", "o-"), ("bdf", "s--")):
                points = [(t.dt, abs(e.parts[t] / e.value)) for t in search.axes.steps if t.scheme == scheme and t in e.parts]
                if points:
                    column[0].plot(*zip(*points), style, ms=4, lw=0.8, color=law.colour, label=law.label if scheme == "beuler" else None)
            points = [(m.cells, abs(e.parts[m] / e.value)) for m in search.axes.meshes if m in e.parts]
            if points:
                column[1].plot(*zip(*points), "D-", ms=4, lw=0.8, color=law.colour)
    for column, key in zip(axes.T, KEYS):
        logarithmic(column[0], xlabel="Δt (s)", title=short(key))
        logarithmic(column[1], xlabel="tetrahedra")
    axes[0][0].set_ylabel("error in time")
    axes[1][0].set_ylabel("error in space")
    axes[0][0].legend(fontsize=7)
    save(figure, path, "Laws on the built-in right lung, PCV: o backward Euler, squares BDF2; each ladder against its own limit")


def run(folder, results, build):
    paths = meshes(results / "meshes", MESHES)
    searches = {law: search_of(law, paths, results, build) for law in laws_of(build)}
    folder.mkdir(parents=True, exist_ok=True)
    made = {law: s for law, s in searches.items() if s.ladder.done}
    rows = []
    for law, search in made.items():
        header, table_rows = page.rows(search, {})
        rows += [[law.name, *row] for row in table_rows]
    write_csv(folder / "runs.csv", ["law", *header], rows)
    draw(folder / "laws.png", made)
    header, rows = table(made)
    write_csv(folder / "convergence.csv", header, rows)
    cpu = sum(run.cpu for s in made.values() for run in s.ladder.done.values())
    left_out = [f"- {law.label}, {setting.name}: {why}" for law, s in searches.items() for setting, (why, _) in s.ladder.failed.items()]
    left_out += [f"- {law.label}, {setting.name}: {why}" for law, s in searches.items() for setting, why in s.ladder.skipped.items()]
    sizes = " / ".join(str(m.cells) for m in next(iter(made.values())).axes.meshes)
    lines = ["# Tissue laws: convergence in Δt and h", "", "    tools/accuracy_study laws", "",
             f"PCV of `petsc_options/scenes/pcv.opts`, right lung, {sizes} tetrahedra; time on the coarsest, space at Δt 0.1 s (backward Euler). CM1 "
             "with `-lumen_pressure`, CM5 with `reuse.opts`, the others with `iterative.opts`. "
             f"{cpu:.0f} s CPU in all. Errors in % of the limit, each ladder against its own limit; ±: uncertainty of the limit (time, space, "
             "coupling). Order `-`: the levels show none; an order in h above 3 is not believed, the limit is then a fit with order 2. PIP, PEEP and driving pressure are prescribed here and left out. The scene lets the pressure "
             "go at once (no `-ventilator_ramp_down`), and the flow then goes with 1/√t: the peak expiratory flow has no limit as Δt → 0, "
             "and what its rows call one means nothing.", "", "![convergence](laws.png)", "", *markdown(header, rows), "", "## Left out", "",
             *(left_out or ["Nothing."])]
    (folder / "README.md").write_text("\n".join(lines) + "\n")
