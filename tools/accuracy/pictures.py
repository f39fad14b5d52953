"""Pictures of what accuracy costs: convergence of the ladders, errors over time, dofs and memory, Pareto front, digits."""
import numpy as np

from benchmarks.plots import plt, save

from .numbers import percent, short
from .settings import SCHEMES, Setting

FLOOR = 1e-9  # smallest error that is drawn
KINDS = {("beuler", False): ("backward Euler", "o", "#2f6c9e"), ("bdf", False): ("BDF2", "s", "#b5403a"),
         ("beuler", True): ("backward Euler, adaptive", "^", "#7fb2d6"), ("bdf", True): ("BDF2, adaptive", "v", "#e39a90")}


FILLS = {"P1-P1": "none", "P3-P2": "top"}  # of markers; others are full


def logarithmic(axis, **labels):
    """Both axes logarithmic, with few labels where x spans little."""
    axis.set(xscale="log", yscale="log", **labels)
    low, high = axis.get_xlim()
    axis.xaxis.set_major_locator(plt.LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(plt.NullFormatter())
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)


def kind(setting):
    return KINDS[setting.steps.scheme, bool(setting.steps.tolerance)]


def fill(elements):
    return FILLS.get(elements, "full")


def legend_handles(settings):
    """One handle for each kind of steps, and for each element pair if there are several, among settings."""
    pairs = dict.fromkeys(s.mesh.elements for s in settings)
    return [*(plt.Line2D([], [], lw=0, marker=marker, color=colour, label=label)
              for label, marker, colour in dict.fromkeys(map(kind, settings))),
            *(plt.Line2D([], [], lw=0, marker="o", color="#555555", fillstyle=fill(pair), label=pair)
              for pair in pairs if len(pairs) > 1)]


def point(axis, x, error, setting, shade=1.0):
    """An error that cannot be excluded."""
    _, marker, colour = kind(setting)
    axis.plot(x, max(error, FLOOR), marker=marker, color=colour, ms=5, alpha=shade, fillstyle=fill(setting.mesh.elements))


def shades(runs):
    """The finer the mesh, the darker."""
    sizes = sorted({run.setting.mesh.cells for run in runs})
    return {cells: 0.35 + 0.65 * (i + 1) / len(sizes) for i, cells in enumerate(sizes)}


def costs(path, search):
    """Error that cannot be excluded of each asked number over seconds, dofs and memory."""
    runs, errors = list(search.ladder.done.values()), search.errors()
    clock = search.ladder.options.clock
    shown = [key for key in errors if max((abs(errors[key].of(r.numbers[key])) for r in runs if key in r.numbers), default=0) > 1e-7]
    if not shown:
        return
    columns = [(f"{'CPU' if clock == 'cpu' else 'wall'} time (s)", search.ladder.seconds), ("dofs", lambda r: r.summary["dofs"]),
               ("peak memory (MB)", lambda r: r.memory)]
    figure, axes = plt.subplots(len(shown), 3, figsize=(11, 1 + 2.3 * len(shown)), squeeze=False, sharey="row", layout="constrained")
    dark = shades(runs)
    for row, key in zip(axes, shown):
        for axis, (label, value) in zip(row, columns):
            for run in runs:
                if key in run.numbers:
                    point(axis, value(run), surely(search, run, [key]), run.setting, dark[run.setting.mesh.cells])
            logarithmic(axis)
            if key == shown[-1]:
                axis.set_xlabel(label)
        low = min(max(surely(search, r, [key]), FLOOR) for r in runs if key in r.numbers)
        row[0].set_ylim(bottom=low / 2)
        row[0].set_ylabel(f"error of {short(key)}")
    axes[0][-1].legend(handles=legend_handles([r.setting for r in runs]), fontsize=7)
    save(figure, path, "Error that cannot be excluded over cost, the reference's uncertainty included (darker: finer mesh)")


def ladders(path, search):
    """Convergence of each asked number in time, space and with the solver, alone: errors against the ladder's own limit."""
    errors, axes_ = search.errors(), search.axes
    shown = [k for k, e in errors.items() if e.value and max(map(abs, e.parts.values())) > 1e-7 * abs(e.value)]
    if not shown:
        return
    figure, axes = plt.subplots(2, len(shown), figsize=(max(6.5, 1 + 2.7 * len(shown)), 5.4), squeeze=False, layout="constrained")
    for column, key in zip(axes.T, shown):
        e = errors[key]
        for scheme in SCHEMES:
            for adaptive in (False, True):
                steps = [t for t in axes_.steps if t.scheme == scheme and bool(t.tolerance) == adaptive and t in e.parts]
                made = [search.ladder.done[Setting(axes_.base.mesh, t, axes_.base.solver)].summary["steps"] for t in steps]
                points = sorted((n, max(abs(e.parts[t] / e.value), FLOOR)) for n, t in zip(made, steps))
                if points:
                    label, marker, colour = KINDS[scheme, adaptive]
                    column[0].plot(*zip(*points), marker=marker, ms=4, lw=0.8, color=colour, label=label)
        column[0].axhspan(FLOOR, np.clip(e.shares["time"] / abs(e.value), FLOOR, 1), color="#eeeeee", zorder=0)
        logarithmic(column[0], xlabel="steps", title=short(key))
        if "space" in e.unexamined():
            column[1].text(0.5, 0.5, "not examined", ha="center", transform=column[1].transAxes, fontsize=8)
        else:
            for pair in dict.fromkeys(m.elements for m in axes_.meshes):
                points = sorted((m.cells, max(abs(e.parts[m] / e.value), FLOOR))
                                for m in axes_.meshes if m.elements == pair and m in e.parts)
                if points:
                    column[1].plot(*zip(*points), marker="D", ms=4, lw=0.8, color="#3b7d4f", fillstyle=fill(pair), label=pair)
            column[1].axhspan(FLOOR, np.clip(e.shares["space"] / abs(e.value), FLOOR, 1), color="#eeeeee", zorder=0)
        logarithmic(column[1], xlabel="tetrahedra")
        for axis in column:
            drawn = [y for line in axis.lines for y in line.get_ydata()]
            axis.set_ylim(min(drawn, default=FLOOR) / 3, 3 * max(drawn, default=1))
    axes[0][0].set_ylabel("error in time")
    axes[1][0].set_ylabel("error in space")
    axes[0][0].legend(fontsize=7)
    if axes_.base.mesh.elements:
        axes[1][0].legend(fontsize=7)
    save(figure, path, "Each ladder alone, against its own limit (grey: the limit's uncertainty)")


def front(points):
    """Those of (cost, error, what) that no cheaper one beats, cheapest first."""
    best, found = np.inf, []
    for entry in sorted(points, key=lambda p: (p[0], p[1])):
        if entry[1] < best:
            best = entry[1]
            found.append(entry)
    return found


def surely(search, run, keys=None):
    """The largest error that a run may have in the numbers `keys` (default: all that are asked), by the sum of its single errors:
    what the recommendations go by; 100 % at most."""
    return min(1, search.worst(run, dict.fromkeys(keys or search.errors(), 1.0)))


def pareto(path, search):
    """What each run may be off over seconds, the front, and the recommended runs."""
    runs = list(search.ladder.done.values())
    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    dark = shades(runs)
    for run in runs:
        point(axis, search.ladder.seconds(run), surely(search, run), run.setting, dark[run.setting.mesh.cells])
    line = front([(search.ladder.seconds(r), surely(search, r), r) for r in runs])
    axis.step([p[0] for p in line], [p[1] for p in line], where="post", color="#555555", lw=0.8)
    for answer in search.answers():
        axis.axhline(answer.share, color="#999999", lw=0.6, ls="--")
        if answer.run:
            axis.annotate(percent(answer.share), (search.ladder.seconds(answer.run), surely(search, answer.run)),
                          xytext=(6, 6), textcoords="offset points", fontsize=8)
    logarithmic(axis, xlabel=f"{'CPU' if search.ladder.options.clock == 'cpu' else 'wall'} time (s)",
                ylabel="largest error of " + ", ".join(map(short, search.errors())) + " that cannot be excluded")
    axis.legend(handles=legend_handles([r.setting for r in runs]), fontsize=7)
    save(figure, path, "Pareto front of the error that cannot be excluded; marked: recommended")


def digits(path, search):
    """Time-Accuracy-Size spectrum (Chang, Fabien, Knepley & Mills 2018) of the error of the asked numbers that cannot be excluded."""
    runs = list(search.ladder.done.values())
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.6), layout="constrained")
    dark = shades(runs)
    for run in runs:
        error, seconds, dofs = max(surely(search, run), FLOOR), search.ladder.seconds(run), run.summary["dofs"]
        _, marker, colour = kind(run.setting)
        for axis, x, y in ((axes[0], np.log10(dofs), -np.log10(error)), (axes[1], np.log10(dofs), dofs / seconds),
                           (axes[2], np.log10(dofs), -np.log10(error * seconds)), (axes[3], seconds, -np.log10(error * seconds))):
            axis.plot(x, y, marker=marker, color=colour, alpha=dark[run.setting.mesh.cells], ms=5, fillstyle=fill(run.setting.mesh.elements))
    for axis, x, y in zip(axes, ["DoS = log10(dofs)"] * 3 + ["time (s)"],
                          ["DoA = -log10(error)", "dofs / s", "DoE = -log10(error x s)", "DoE = -log10(error x s)"]):
        axis.set(xlabel=x, ylabel=y)
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].set_yscale("log")
    axes[3].set_xscale("log")
    axes[0].legend(handles=legend_handles([r.setting for r in runs]), fontsize=7)
    save(figure, path, "Time-Accuracy-Size spectrum: digits of accuracy, size and efficacy")
