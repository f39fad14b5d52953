"""The page of the gallery: table, list of what was missed, figures, CSV."""
import numpy as np

from benchmarks.plots import plt
from shared.common import markdown, write_csv

from .lab import pulmo
from .laws import limit_point

HEAD = """# Hard cases

`tools/hard_cases` runs them and writes this page; `ctest -L stability` runs a small size of each from the same definitions
(`tools/hardcases`); what that leaves out stands with each case. Each demand can fail: it holds a number against a closed form, a scaling law, another
discretisation or conservation. Every run is also held to this: it ends in time; it finishes, or it stops with one sentence
that says what to try; no accepted state has J ≤ 0; no porosity is negative without a warning; no file holds NaN, nor null for
a number that every run has; no PETSc trace. Seconds are CPU time of the runs of a
case{where}; they depend on the machine.

Settings of a ward with every law, with and without prestress, on three lungs: [the clinical envelope](clinical_envelope.md), of
`tools/hard_cases --clinical`.

**{met} of {demands} demands are met, {cases_met} of {cases} cases in full.**{size}
"""
STALE = "Of another program or other definitions than the rest (run `tools/hard_cases`): {names}."
NOT_RUN = "Without a result at this size yet (run `tools/hard_cases`): {names}."


def demand_line(d):
    return f"{'' if d['met'] else '**missed** '}{d['what']}: {d['measured']} ({d['asked']})"


def short(result):
    """Demands of a case for the table: those missed, and how many were met."""
    missed = [d for d in result["demands"] if not d["met"]]
    met = len(result["demands"]) - len(missed)
    return "<br>".join([f"{met} of {len(result['demands'])} met", *map(demand_line, missed)])


def write(folder, results, missing, machine, small, state):
    """`missing`: titles of the cases that have no result; `state`: fingerprint of program and definitions."""
    folder.mkdir(parents=True, exist_ok=True)
    demands = [d for r in results for d in r["demands"]]
    text = [HEAD.format(met=sum(d["met"] for d in demands), demands=len(demands), cases=len(results),
                        cases_met=sum(r["met"] for r in results), where=f" ({machine})",
                        size=" **Small size: not the gallery's figures.**" if small else "")]
    if missing:
        text += [NOT_RUN.format(names="; ".join(missing)), ""]
    stale = [r["title"] for r in results if r["state"] != state]
    if stale:
        text += [STALE.format(names="; ".join(stale)), ""]
    header = ["case", "why it is hard", "what is demanded", "result", "steps, cut", "min J", "recovery path", "CPU s"]
    text += markdown(header, [[f"[{r['title']}](#{r['name']})" + " (old)" * (r["state"] != state), r["why"], r["asked"],
                               short(r), f"{r['steps']}, {r['cut']}" if r["runs"] else "–",
                               "–" if r["min_J"] is None else f"{r['min_J']:.3g}", r["recovery"], f"{r['cpu_s']:.0f}"]
                              for r in results])
    text += ["", *figures(folder, results), "## What is demanded, and what was measured", ""]
    for r in results:
        text += [f'<a id="{r["name"]}"></a>', f"### {r['title']}", "", f"The size of the tests leaves out: {r['left_out']}.", ""]
        text += markdown(["demand", "measured", "asked", ""],
                         [[d["what"], d["measured"], d["asked"], "met" if d["met"] else "**missed**"] for d in r["demands"]])
        text.append("")
    (folder / "README.md").write_text("\n".join(text).rstrip() + "\n")
    print(f"wrote {folder / 'README.md'}")
    write_csv(folder / "hard_cases.csv", ["case", "demand", "measured", "asked", "met"],
              [[r["name"], d["what"], d["measured"], d["asked"], d["met"]] for r in results for d in r["demands"]])


def figures(folder, results):
    """Draws what the cases left; the lines that show it on the page."""
    curves = {r["name"]: r["curves"] for r in results if r["curves"]}
    lines = []
    if "pressure control" in curves.get("limit", {}) and "flow control" in curves["limit"]:
        figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
        J = np.linspace(0.95, 5, 300)
        axis.plot(J, pulmo.gas_pressure("yoshihara", J), color="#999999", label="closed form")
        axis.plot(*curves["limit"]["pressure control"], "o", ms=4, color="#b5403a", label="pressure control: stops")
        axis.plot(*curves["limit"]["flow control"], "x", ms=5, color="#2f6c9e", label="flow control: passes")
        axis.axhline(limit_point()[1], color="#999999", lw=0.7, ls="--")
        axis.set(xlabel="J", ylabel="pressure, cmH2O", title="Limit point of unrestrained CM4")
        axis.legend(fontsize=8)
        figure.savefig(folder / "limit_point.png", dpi=110)
        plt.close(figure)
        lines += ["![Limit point](limit_point.png)", ""]
    if "overshoot" in curves.get("tight", {}):
        figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
        for name, style in (("", "o-"), (" damped", "s--")):
            if "overshoot" + name not in curves["tight"]:
                continue
            share, high, _ = np.array(curves["tight"]["overshoot" + name]).T
            left.semilogx(share, high, style, ms=4, label="P2–P1" + (", -pressure_damping" if name else ""))
            x, p = map(np.array, curves["tight"]["profile" + name])
            right.plot(x, p, "." if not name else "s", ms=3, label="P2–P1" + (", -pressure_damping" if name else ""))
        left.set(xlabel="Δt / (h²/6 c_v)", ylabel="largest p/p0 of the first step")
        right.set(xlabel="X, mm (drained at 100)", ylabel="p/p0 at k = 10⁻⁶", xlim=(60, 101))
        left.legend(fontsize=8)
        right.legend(fontsize=8)
        figure.savefig(folder / "overshoot.png", dpi=110)
        plt.close(figure)
        lines += ["![First step of Terzaghi's column](overshoot.png)", ""]
    return lines
