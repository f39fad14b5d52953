"""The hollow sphere: errors that are known, because a radial solver gives the solution, beside those that the tool estimates."""
import math
import shlex

from benchmarks import runs
from benchmarks.plots import plt, save
from shared.common import markdown, write_csv
from shared.keys import make_mesh

from . import command, truth
from .extrapolate import limit as limit_of
from .numbers import ALIASES, KEYS, short
from .pictures import logarithmic
from .settings import ELEMENTS, ORDERS, SCHEMES, Setting, Steps

LEVELS = (4, 6, 9, 13)  # divisions of an octant's edge; three times as many layers
STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125, 0.00625)
ROLLERS = ["-support", "-support_surfaces", "x0,y0,z0", "-support_components_x0", "x", "-support_components_y0", "y",
           "-support_components_z0", "z"]
OCTANT = {"resistance_cmH2O_s_per_l": 8}  # a sphere's numbers by those of its octant; volumes and flows: 1/8
UNSCALED = {"time_constant_s"}


def octant(folder, divisions):
    """An octant's mesh, made by tools/sphere_mesh: its path and the command that makes it."""
    path = folder / f"octant_{divisions}.msh"
    words = ["--divisions", str(divisions), "--layers", str(3 * divisions), "--octant"]
    make_mesh(path, "sphere_mesh", words)
    return path, shlex.join(["tools/sphere_mesh", *words, "--output", str(path)])


def exact(key, numbers):
    """A number of the radial solver for one octant."""
    return numbers[key] * (1 if key in UNSCALED else OCTANT.get(key, 1 / 8))


def volume_at(run, time):
    """V(t) of a run, ml; it has a row there."""
    rows = runs.waveform(run.results[0])
    return rows[min(rows, key=lambda t: abs(t - time))][0]


def order(errors):
    """Order between an error and that of the step twice as long."""
    return [None] + [math.log2(abs(a / b)) if a * b > 0 else None for a, b in zip(errors, errors[1:])]


def text(value, form="{:+.3g}"):
    return "-" if value is None else form.format(value)


def first_second(search):
    """Table of V(1 s): error of each scheme in % by step, of the radial solver and of pulmo's meshes against its own dt -> 0 limit
    of the radial solver."""
    limit, base = truth.limit_volume(), search.axes.base
    radial = {"beuler": truth.euler_volume, "bdf": truth.bdf2_volume}
    header = ["scheme", "dt s", "radial solver: V(1 s) of two spheres, ml", "error %", "order"]
    meshes = [mesh for mesh in search.axes.meshes if mesh.elements == base.mesh.elements]
    for mesh in meshes:
        header += [f"pulmo, {mesh.cells} tets: error %", "of it in time %"]
    table, points = [], {}
    for scheme in SCHEMES:
        errors = [100 * (radial[scheme](dt) / limit - 1) for dt in STEPS]
        points[f"radial, {SCHEMES[scheme]}"] = list(zip(STEPS, errors))
        made = {}
        for mesh in meshes:
            for dt in STEPS:
                run = search.ladder.done.get(Setting(mesh, Steps(scheme, dt), base.solver))
                if run:
                    made[mesh, dt] = 8 * volume_at(run, 1.0)
        for dt, error, observed in zip(STEPS, errors, order(errors)):
            row = [SCHEMES[scheme], f"{dt:g}", f"{2 * limit * (1 + error / 100):.4f}", f"{error:+.4f}", text(observed, "{:.2f}")]
            for mesh in meshes:
                ladder = [(d, v) for (m, d), v in sorted(made.items(), key=lambda item: -item[0][1]) if m == mesh]
                value = made.get((mesh, dt))
                if value is None:
                    row += ["-", "-"]
                    continue
                at_zero = limit_of(*zip(*ladder), ORDERS[scheme]).value if len(ladder) > 2 else None
                row += [f"{100 * (value / limit - 1):+.3f}", text(None if at_zero is None else 100 * (value - at_zero) / limit, "{:+.3f}")]
                if at_zero is not None:
                    points.setdefault(f"pulmo {mesh.cells} tets, {SCHEMES[scheme]}", []).append((dt, 100 * (value - at_zero) / limit))
            table.append(row)
    return header, table, points


def brackets(search, numbers):
    """Whether the estimated error of each run and number, with its uncertainty, holds the true one."""
    rows, met = [], []
    for setting, run in search.ladder.done.items():
        for key, e in search.all_errors().items():
            if key not in numbers or key not in run.numbers:
                continue
            true = run.numbers[key] / exact(key, numbers) - 1
            estimated = e.of(run.numbers[key])
            # both are shares of their own reference: compared in units of the number
            inside = abs(e.value - exact(key, numbers)) <= e.uncertainty
            met.append(abs(true) <= abs(estimated) + e.doubt)
            rows.append([setting.name, key, f"{true:.3e}", f"{estimated:.3e}", f"{e.doubt:.3e}",
                         f"{estimated / true:.3f}" if true else "", met[-1], inside])
    return ["setting", "number", "true_error", "estimated_error", "uncertainty", "effectivity", "bracketed", "limit_within_uncertainty"], rows


def limits(search, numbers):
    """Table of the tool's limits against the exact numbers."""
    header = ["number", "exact", "the tool's limit", "off by %", "its uncertainty %", "holds"]
    table = []
    for key, e in search.all_errors().items():
        if key in numbers:
            off = e.value / exact(key, numbers) - 1
            table.append([short(key), f"{exact(key, numbers):.5g}", f"{e.value:.5g}", f"{100 * off:+.3f}", f"{100 * e.doubt:.3f}",
                          "yes" if abs(off) <= e.doubt else "**no**"])
    return header, table


def by_elements(search):
    """Table: true errors in space and cost of each pair of elements, at the base's step."""
    base = search.axes.base
    true = truth.euler_numbers(base.steps.dt)
    header = ["elements", "tets", "dofs", "CPU s", *(f"{short(key)}: off by %" for key in KEYS), "steps taken again"]
    rows = []
    for mesh in search.axes.meshes:
        run = search.ladder.done.get(Setting(mesh, base.steps, base.solver))
        if run:
            rows.append([mesh.elements, mesh.cells, run.summary["dofs"], f"{run.cpu:.3g}",
                         *(f"{100 * (run.numbers[key] / exact(key, true) - 1):+.3f}" for key in KEYS), run.summary["rejected_steps"]])
    return header, rows


def cost_at(points, wanted):
    """Cost at which a ladder of (cost, error) falls below an error for good, interpolated in logarithms, and whether that is an upper
    bound only, because the cheapest level is good enough already; (None, False) if never."""
    points = sorted(points)
    for i in range(len(points)):
        if all(error <= wanted for _, error in points[i:]):
            if i == 0:
                return points[0][0], True
            (c0, e0), (c1, e1) = points[i - 1], points[i]
            share = math.log(e0 / wanted) / math.log(e0 / max(e1, 1e-12))
            return c0 * (c1 / c0) ** share, False
    return None, False


def factors(search, tolerances=(0.01, 0.001)):
    """Table: CPU seconds of each kind of steps on the base's mesh to an error in time, by number."""
    base, kinds = search.axes.base, [(s, a) for a in (False, True) for s in SCHEMES]
    header = ["number", "error in time", *(SCHEMES[s] + (", adaptive" if a else "") + ": CPU s" for s, a in kinds),
              "backward Euler / BDF2", "the same in Krylov iterations"]
    table = []

    def to_reach(key, wanted, scheme, adaptive, cost):
        e = search.errors()[key]
        return cost_at([(cost(search.ladder.done[s]), e.relative(t)) for t in search.axes.steps
                        if t.scheme == scheme and bool(t.tolerance) == adaptive
                        and (s := Setting(base.mesh, t, base.solver)) in search.ladder.done], wanted)

    def told(found):
        cost, bound = found
        return ("≤ " if bound else "") + text(cost, "{:.2g}")

    def ratio(a, b):
        """No number where one of the two is missing or a bound."""
        (cost_a, bound_a), (cost_b, bound_b) = a, b
        return "-" if cost_a is None or cost_b is None or bound_a or bound_b else f"{cost_a / cost_b:.2f}"

    for key, e in search.errors().items():
        for wanted in tolerances:
            costs = [to_reach(key, wanted, *kind, lambda run: run.cpu) for kind in kinds]
            counts = [to_reach(key, wanted, *kind, lambda run: run.summary["krylov_iterations"]) for kind in kinds]
            if max(e.relative(t) for t in e.parts if t in search.axes.steps) > wanted:
                doubtful = e.shares["time"] / abs(e.value) > wanted / 2
                table.append([short(key), f"{100 * wanted:g} %", *map(told, costs),
                              ratio(*costs[:2]) + (" (limit in doubt)" if doubtful else ""), ratio(*counts[:2])])
    return header, table


def run(folder, results, build):
    """Makes the runs, and writes the tool's page, truth.md, tables and a figure to the folder."""
    numbers = truth.numbers()
    made = dict(octant(results / "meshes", divisions) for divisions in LEVELS)
    search, _ = command.explore(["hollow_sphere", "--meshes", *map(str, made), "--elements", *ELEMENTS, "--budget", "20min", "--clock", "cpu", "--solvers", "iterative",
                                 "--numbers", *(a for a in ALIASES if a != "PIP"), "--output", str(folder), "--results", str(results), *build,
                                 "--", *ROLLERS], made)
    base = search.axes.base
    for scheme in SCHEMES:  # the table's middle mesh, as far as dt 0.025
        for dt in STEPS[:4]:
            search.ladder.attempt(Setting(search.axes.meshes[1], Steps(scheme, dt), base.solver))
    header, table, points = first_second(search)
    write_csv(folder / "first_second.csv", header, table)
    b_header, b_rows = brackets(search, numbers)
    write_csv(folder / "brackets.csv", b_header, b_rows)
    met = [row[6] for row in b_rows]
    effects = sorted(float(row[5]) for row in b_rows if row[5] and abs(float(row[2])) > float(row[4]))
    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    for label, line in points.items():
        axis.plot(*zip(*[(dt, abs(e)) for dt, e in line]), marker="o" if "Euler" in label else "s", ms=4, lw=0.8,
                  ls="-" if "radial" in label else "--", label=label)
    axis.axhline(1, color="#999999", lw=0.6, ls=":")
    logarithmic(axis, xlabel="Δt (s)", ylabel="error of V(1 s) in time (%)")
    axis.legend(fontsize=7)
    save(figure, folder / "first_second.png", "Hollow sphere: V(1 s) against the radial solver at dt -> 0")
    middle = f"median {effects[len(effects) // 2]:.2f}, 5 to 95 % {effects[len(effects) // 20]:.2f} to {effects[-1 - len(effects) // 20]:.2f}" \
        if effects else "none is larger than the uncertainty"
    limits_header, held = limits(search, numbers)
    lines = ["# The hollow sphere: true errors", "", f"V(1 s) of two spheres as dt -> 0: {2 * truth.limit_volume():.4f} ml "
             "(Radau IIA of three stages).", "", *markdown(header, table), "", "![V(1 s)](first_second.png)", "",
             "## The tool's limits against the exact numbers (one octant)", "", *markdown(limits_header, held), "",
             f"{sum(row[-1] == 'yes' for row in held)} of {len(held)} limits hold the true value; these are the independent facts, and where a "
             f"limit holds, the errors of all runs against it are bracketed: {sum(met)} of {len(met)} (brackets.csv). Effectivity (estimated over true error) where the true error is larger than the uncertainty: {middle}.", "",
             "## What first and second order cost", "", f"CPU seconds on {base.mesh.cells} tetrahedra at which the error in time falls below a "
             "tolerance for good (interpolated between runs). ≤: the cheapest level meets it already, so the ladder does not show how much "
             "cheaper it would be; no ratio is given then.", "", *markdown(*factors(search)), "", "## What elements cost", "",
             f"{base.steps.name}, against the radial solver with the same steps: the true error in space. Facets are flat, so that P3-P2 sees "
             "the sphere as a polyhedron. Where a step was taken again, shorter, part of the difference is in time.", "", *markdown(*by_elements(search))]
    (folder / "truth.md").write_text("\n".join(lines) + "\n")
    return search
