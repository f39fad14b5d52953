"""Pictures of benchmarks: runs side by side (seconds by stage, memory, Krylov iterations), iterations over permeability."""
import importlib
import textwrap

from shared.signals import whole_rows


class Pyplot:
    """matplotlib.pyplot, loaded with the first picture: that takes longer than a tool needs to refuse a call."""

    def __getattr__(self, name):
        importlib.import_module("matplotlib").use("Agg")
        return getattr(importlib.import_module("matplotlib.pyplot"), name)


plt = Pyplot()
COLOURS = {"setup": "#9a9a9a", "residual": "#e0a83a", "jacobian": "#3b7d4f", "solve": "#2f6c9e", "output": "#b5403a"}

LAW_COLOURS = {"berger": "#c1272d", "ma": "#e08a1e", "birzle": "#3b8f4a", "yoshihara": "#2a6fb0", "rausch": "#6a4c93", "patte": "#7a5c3a"}
OTHERS = ["#444444", "#8c564b", "#17a2b8", "#b8860b"]  # laws that came later


def law_colours(laws):
    """Colours of laws by name."""
    later = [law for law in dict.fromkeys(laws) if law not in LAW_COLOURS]
    return LAW_COLOURS | {law: OTHERS[i % len(OTHERS)] for i, law in enumerate(later)}


def save(figure, path, title):
    """Gives a figure its title and writes it."""
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f"wrote {path}")


def krylov_of_steps(result):
    """Times and Krylov iterations per Newton step of each time step."""
    path = result["folder"] / "run/signals.csv"
    if not path.exists():
        return [], []
    rows = [r for r in whole_rows(path) if float(r.get("krylov_iterations") or 0) > 0]
    return ([float(r["time_s"]) for r in rows],
            [float(r["krylov_iterations"]) / float(r["newton_iterations"]) for r in rows])


def side_by_side(path, title, entries):
    """`entries`: (label, seconds by stage, memory in MB, result, failed) of each run; numbered as they come."""
    height = 1.6 + 0.42 * len(entries)
    shades = plt.get_cmap("tab20").colors
    figure, (time, memory, krylov) = plt.subplots(1, 3, figsize=(14, max(3.4, height)), width_ratios=[2, 1, 1.4],
                                                  layout="constrained")
    places = range(len(entries))
    for place, (_, seconds, _, _, failed) in zip(places, entries):
        left = 0
        for stage, colour in COLOURS.items():
            if stage in seconds:
                time.barh(place, seconds[stage], left=left, color=colour)
                left += seconds[stage]
        time.barh(place, seconds["total"] - left, left=left, color="#dddddd")
        time.text(seconds["total"], place, f" {seconds['total']:.3g} s" + (" failed" if failed else ""), va="center", fontsize=8)
    time.set_yticks(places, [textwrap.fill(f"{i}  {entry[0]}", 70, max_lines=2, placeholder=" ...", break_on_hyphens=False)
                             for i, entry in enumerate(entries, 1)], fontsize=7)
    time.set_xlabel("wall time (s)")
    time.margins(x=0.15)
    time.legend([plt.Rectangle((0, 0), 1, 1, color=colour) for colour in COLOURS.values()], COLOURS, fontsize=8)
    memory.barh(places, [entry[2] for entry in entries], color="#6b5b95")
    memory.set_yticks(places, range(1, len(entries) + 1), fontsize=7)
    memory.set_xlabel("peak memory (MB)")
    for place, entry in zip(places, entries):
        memory.text(entry[2], place, f" {entry[2]:.0f}", va="center", fontsize=8)
    memory.margins(x=0.2)
    for axis in (time, memory):
        axis.invert_yaxis()
        axis.spines[["top", "right"]].set_visible(False)
    for place, (_, _, _, result, _) in zip(places, entries):
        times, iterations = krylov_of_steps(result)
        if times and max(iterations) > 1:
            krylov.plot(times, iterations, lw=1, color=shades[place % len(shades)], label=place + 1)
    krylov.set_xlabel("time (s)")
    krylov.set_ylabel("Krylov per Newton iteration")
    krylov.set_ylim(bottom=0)
    if krylov.lines:
        krylov.legend(fontsize=7, ncols=2)
    save(figure, path, title)


def counts(path, title, entries):
    """Panels by phase, largest Krylov count over permeability.

    `entries`: (solver, law, tetrahedra, phase, permeability, step, count) of each run. A line for each mesh, solver and law,
    coloured; its marker tells the step.
    """
    panels = list(dict.fromkeys(e[3] for e in entries))
    if not panels:
        return
    lines = list(dict.fromkeys((e[0], e[1], e[2]) for e in entries))
    steps = list(dict.fromkeys(e[5] for e in entries))
    shades, markers = plt.get_cmap("tab10").colors, "osv^Dx+"
    figure, axes = plt.subplots(1, len(panels), figsize=(2 + 3 * len(panels), 4), sharey=True, squeeze=False, layout="constrained")
    for axis, panel in zip(axes[0], panels):
        for i, line in enumerate(lines):
            for j, step in enumerate(steps):
                points = sorted((float(e[4]), e[6]) for e in entries if (e[0], e[1], e[2], e[3], e[5]) == (*line, panel, step))
                if points:
                    axis.plot(*zip(*points), color=shades[i % len(shades)], marker=markers[j % len(markers)], lw=0.8, ms=5, alpha=0.8)
        axis.axhline(15, color="#999999", lw=0.8, ls="--")
        axis.set(xscale="log", xlabel="k, mm²/(kPa s)", title=panel)
        axis.set_ylim(0, 1.1 * max(15, *(e[6] for e in entries)))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_ylabel("largest Krylov count of a solve")
    several = [len({line[i] for line in lines}) > 1 for i in range(3)]
    names = [" ".join(str(part) + (" tets" if i == 2 else "") for i, part in enumerate(line) if several[i] or i == 2) for line in lines]
    handles = [plt.Line2D([], [], color=shades[i % len(shades)], label=name) for i, name in enumerate(names)]
    handles += [plt.Line2D([], [], color="k", lw=0, marker=markers[j % len(markers)], label=f"Δt {step} s")
                for j, step in enumerate(steps)]
    axes[0][-1].legend(handles=handles, loc="upper left", bbox_to_anchor=(1.02, 1), fontsize=7, frameon=False)
    save(figure, path, title)
