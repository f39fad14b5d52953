"""Manufactured finite-strain solutions: what tests/verification/mms prints, and whether the tool's limits hold the known ones.

The norm of a known error is a number of the solution whose limit is 0: the tool's extrapolation has to find that within its
uncertainty, from the errors at finite sizes alone.
"""
import re
from pathlib import Path

from benchmarks.plots import law_colours, plt, save
from shared.common import SOURCE, fail, markdown, write_csv
from shared.keys import printed

from .extrapolate import limit
from .pictures import logarithmic

SPACE = re.compile(r"^  (\w+) +cube\w* +J [\d.]+  u (\S+)  Grad u (\S+)  p (\S+)  Grad p (\S+)", re.M)
TIME = re.compile(r"^  (backward Euler|BDF2), (\w+) +dt 1/(\d+) +J [\d.]+  u (\S+)  p (\S+)", re.M)
CASE = re.compile(r"^\[ RUN +\] (?:Pairs/)?Manufactured\w+(?:/\w+)?\.(\w+?)(?:/(P\d)(P\d))?\n(.*?)^\[ ", re.M | re.S)
CASES = {"DiscretisationError": "u and p of waves", "DiscretisationErrorOfDisplacement": "u of waves, p linear"}
FORMAL = {"": {"u": 2, "Grad u": 2, "p": 2, "Grad p": 1}, "P1-P1": {"u": 2, "Grad u": 1, "p": 2, "Grad p": 1},
          "P3-P2": {"u": 3, "Grad u": 3, "p": 3, "Grad p": 2}}
LINEAR = {"": {"u": 3, "Grad u": 2, "p": 3}, "P1-P1": {"u": 2, "Grad u": 1, "p": 2}, "P3-P2": {"u": 4, "Grad u": 3, "p": 4}}  # p in its space


def output(build, results):
    """What the program prints, kept."""
    program, kept = build / "tests/verification/verification_mms", results / "mms.txt"
    if not program.exists():
        fail(f"{program} is not there; build the tests first: cmake --build {build} --target verification_mms")
    text = printed([program, "--gtest_filter=ManufacturedRun*:*ManufacturedElements*"], kept, reads=sorted((SOURCE / "meshes").glob("*.msh")))
    if text is None:
        fail("verification_mms fails; run it alone to see why")
    return text


def read(text):
    """(what, law, field) -> [(size, error)], coarse to fine, and the formal order of each."""
    ladders, formal = {}, {}
    for case, *degrees, body in CASE.findall(text):
        pair = "-".join(filter(None, degrees))
        for law, *errors in SPACE.findall(body):
            orders = (LINEAR if case.endswith("Displacement") else FORMAL)[pair]
            for field, error in zip(("u", "Grad u", "p", "Grad p"), errors):
                if field in orders:
                    key = (f"h, {pair and pair + ', '}{CASES[case]}", law, field)
                    ladder = ladders.setdefault(key, [])
                    ladder.append((0.5 ** (len(ladder) + 1), float(error)))
                    formal[key] = orders[field]
        for scheme, law, steps, *errors in TIME.findall(body):
            for field, error in zip(("u", "p"), errors):
                key = (f"Δt, {scheme}", law, field)
                ladders.setdefault(key, []).append((1 / int(steps), float(error)))
                formal[key] = 1 if scheme == "backward Euler" else 2
    if not ladders:
        fail("no error is found in what verification_mms prints; has its form changed?")
    return ladders, formal


def run(folder, results, build):
    ladders, formal = read(output(Path(build[1]) if build else Path("build"), results))
    folder.mkdir(parents=True, exist_ok=True)
    header = ["ladder", "law", "error of", "levels", "errors", "order", "extrapolated", "±", "holds 0"]
    rows = []
    for key, ladder in ladders.items():
        for count in range(2, len(ladder) + 1):
            found = limit(*zip(*ladder[:count]), formal[key])
            rows.append([*key, count, " ".join(f"{e:.2e}" for _, e in ladder[:count]), "-" if found.order is None else f"{found.order:.2f}",
                         f"{found.value:+.1e}", f"{found.uncertainty:.1e}", "yes" if abs(found.value) <= found.uncertainty else "**no**"])
    write_csv(folder / "manufactured.csv", header, rows)
    colours = law_colours(law for _, law, _ in ladders)
    kinds = list(dict.fromkeys(key[0] for key in ladders))
    figure, axes = plt.subplots(1, len(kinds), figsize=(3.4 * len(kinds), 3.8), layout="constrained", squeeze=False)
    for axis, kind in zip(axes[0], kinds):
        for (what, law, field), ladder in ladders.items():
            if what == kind:
                axis.plot(*zip(*ladder), {"u": "o-", "p": "s--", "Grad u": "^-", "Grad p": "v--"}[field], ms=4, lw=0.8, color=colours[law],
                          label=f"{field}, {law}" if law == "yoshihara" else None)
        logarithmic(axis, xlabel=kind.split(",")[0], title=kind.split(", ", 1)[1])
        axis.legend(fontsize=7)
    axes[0][0].set_ylabel("error, L2")
    save(figure, folder / "manufactured.png", "Manufactured solutions at finite strain (blue, green, red, orange: yoshihara, birzle, berger, ma)")
    finest = [row for i, row in enumerate(rows) if i + 1 == len(rows) or rows[i + 1][3] <= row[3]]
    held = {n: [row[-1] == "yes" for row in rows if row[3] == n] for n in sorted({row[3] for row in rows})}
    lines = ["# Manufactured solutions: known errors", "", "    tools/accuracy_study manufactured", "",
             "Errors that `tests/verification/mms` prints (yoshihara, birzle, berger, ma; strains of 10 to 30 %), and the tool's "
             "extrapolation of them, which has to hold the known limit 0 within its uncertainty: "
             + "; ".join(f"{n} levels {sum(h)} of {len(h)}" for n, h in held.items()) + f"; together {sum(map(sum, held.values()))} of "
             f"{len(rows)} (manufactured.csv).", "", "![errors](manufactured.png)", "", *markdown(header, finest)]
    (folder / "README.md").write_text("\n".join(lines) + "\n")
