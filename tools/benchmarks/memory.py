"""`tools/benchmark memory`: peak memory of solver files over a ladder of meshes, and what it is made of.

Each entry runs one time step of the PCV scene, in which its memory peaks. The direct file keeps its first Jacobian and
factors over that step (`-snes_lag_jacobian -2`): more factorisations need the same memory again. Strings of flags after
-- replace the entries; the first is what the others are compared with.
"""
import math
from pathlib import Path

from shared.common import PAPER, SCENES, SOURCE, processor, require, write_table
from shared.keys import make_lung

from . import plots, runs
from .plots import plt
from .strategies import measure, solver_words

ENTRIES = ["@direct -snes_lag_jacobian -2 -snes_max_it 100", "@iterative"]
STEP = 0.05  # s
# event of PETSc's log in which a part is allocated; what is left is the mesh, vectors, program and libraries
PARTS = {"matrix": "DMCreateMat", "preconditioner": "PCSetUp", "Krylov solve": "KSPSolve"}
HEADER = ["mesh", "tetrahedra", "dofs", "flags", "peak MB", "MB per 1000 dofs", *(f"{part} MB" for part in PARTS), "rest MB",
          "share of the first", "Newton", "wall s", "remark"]


def arguments(parser):
    parser.usage = "tools/benchmark memory [options] [-- 'FLAGS' 'FLAGS' ...]"
    parser.add_argument("--cells", type=int, nargs="+", default=[4000, 15000, 60000],
                        help="tetrahedra of the lungs that are made (default 4000 15000 60000)")
    parser.add_argument("--mesh", type=Path, nargs="+", help="meshes of your own instead")
    parser.add_argument("--ranks", type=int, default=1)
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks (default: mpiexec -n)")
    parser.add_argument("--timeout", type=float, help="seconds after which a run is ended")
    parser.add_argument("--results", type=Path, default=SOURCE / "results/memory", help="where runs are kept (default: results/memory)")
    parser.add_argument("--output", type=Path, default=SOURCE / "docs/performance", help="of the table (default: docs/performance)")


def resident_growth(text):
    """MB (10^6 bytes) by which the process grew in each event, from the text of -log_view -log_view_memory."""
    growth, columns = {}, None
    for line in text.splitlines():
        words = line.split()
        if words and words[0] == "Event" and words[-1] == "RMI":
            columns = True
        elif words and words[0].startswith("------"):
            continue
        elif line.startswith("Object Type"):
            break
        elif columns and len(words) > 20 and words[-1].lstrip("-").isdigit():
            growth.setdefault(words[0], int(words[-1]))  # the first stage is the program's
    return growth


def row(mesh, flags, result, first):
    """A line of the table; `first` is the result that the memory is compared with, or None."""
    summary = result.get("summary", {})
    dofs, peak = summary.get("dofs"), result["memory"]
    # PETSc prints the largest of the ranks, so parts of several ranks do not add up
    grown = resident_growth((result["folder"] / "stdout.log").read_text(errors="replace")) if summary.get("ranks") == 1 else {}
    parts = [grown.get(event) for event in PARTS.values()]
    rest = None if None in parts else peak - sum(parts)
    return [mesh.stem, summary.get("cells", "-"), dofs or "-", flags, f"{peak:.0f}", f"{1000 * peak / dofs:.2f}" if dofs else "-",
            *("-" if part is None else f"{part:.0f}" for part in [*parts, rest]),
            f"{peak / first['memory']:.2f}" if first and not first["code"] and not result["code"] else "-",
            summary.get("newton_iterations", "-"), f"{result['wall']:.1f}", result["reason"]]


def growth_exponent(points):
    """Slope of log(memory) over log(dofs) between the two largest of (dofs, MB); None with fewer than two."""
    if len(points) < 2:
        return None
    (n, a), (m, b) = sorted(points)[-2:]
    return math.log(b / a) / math.log(m / n)


def draw(path, title, points):
    """`points`: {flags: [(dofs, MB)]}."""
    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    for flags, found in points.items():
        slope = growth_exponent(found)
        axis.loglog(*zip(*sorted(found)), "o-", label=flags + (f"  (~ dofs^{slope:.2f})" if slope else ""))
    axis.set_xlabel("dofs")
    axis.set_ylabel("peak memory, sum of ranks (MB)")
    axis.grid(True, which="both", alpha=0.3)
    axis.legend(fontsize=8)
    plots.save(figure, path, title)


def run(options):
    require(options.build, options.mesh or [])
    meshes = options.mesh or [make_lung(cells, options.build) for cells in options.cells]
    flags = options.flags or ENTRIES
    entries = {entry: solver_words(entry) for entry in flags}
    options.repeat, options.output, table = 1, options.results, options.output
    rows, points, everything = [], {entry: [] for entry in flags}, []
    for mesh in meshes:
        common = ["-dm_plex_filename", mesh, "-options_file", SCENES / "pcv.opts", *PAPER, "-ts_max_time", f"{STEP:g}",
                  "-log_view", "-log_view_memory"]
        results = measure(entries, common, options)
        for entry, (result,) in results.items():
            everything.append(result)
            rows.append(row(mesh, entry, result, results[flags[0]][0]))
            if not result["code"]:
                points[entry].append((result["summary"]["dofs"], result["memory"]))
    notes = (f"One step of the PCV scene (Birzle, Δt {STEP:g} s), {options.ranks} rank{'s' if options.ranks > 1 else ''} on "
             f"{processor()}, {runs.load_range(everything)}. Peak: largest resident memory, sum of the ranks, 1 MB = 10^6 bytes. "
             "Parts: growth of the process in the events " + ", ".join(f"{event} ({part})" for part, event in PARTS.items()) +
             " of PETSc's log, which sees what MUMPS and hypre take as well (one rank only); rest: mesh, vectors, output, "
             "program and libraries, and what was needed for a while only. Share: of the peak of the first entry on the same mesh. "
             "Growth between the two largest meshes: "
             + "; ".join(f"`{entry}` ~ dofs^{growth_exponent(found):.2f}" for entry, found in points.items() if len(found) > 1) + ".")
    write_table(table, "memory", "Memory", HEADER, rows, notes)
    if any(points.values()):
        draw(table / "memory.png", "Peak memory of one step", {entry: found for entry, found in points.items() if found})
