"""`tools/benchmark assembly`: residual and Jacobian of the PCV scene for each law, fast against stock, and how far from the
limits of the machine.

Where valgrind is installed, the operations and bytes of each law are counted (operations.py) and held against the
measured peak and bandwidth of one core: the roofline. Where perf is, it tells where the time goes.
"""
import json
import shlex
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from shared.common import PAPER, SCENES, SOLVERS, SOURCE, environment, fail, laws_of, markdown, processor, show, write_csv, write_table
from shared.keys import make_lung

from . import operations

COUNTED = SOURCE / "meshes/lung_test.msh"
ROOFLINE = ["law", "of", "µs/cell", "flops/cell", "divisions/cell", "bytes/cell", "flops/byte", "µs at peak", "µs at bandwidth",
            "attainable µs", "times the attainable", "Gflop/s"]


def arguments(parser):
    parser.add_argument("--cells", type=int, default=15000, help="tetrahedra of the lung that is made (default 15000)")
    parser.add_argument("--mesh", help="a mesh of your own instead")
    parser.add_argument("--laws", nargs="+", metavar="LAW", help="default: all that the program offers")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--no-stock", action="store_true", help="leave out PETSc's integrator (minutes)")
    parser.add_argument("--no-count", action="store_true", help="leave out the roofline (minutes)")
    parser.add_argument("--launcher", default="mpiexec -n", help="words before the number of ranks of the machine's probe")
    parser.add_argument("--results", type=Path, default=SOURCE / "results/assembly", help="of the counting (default: results/assembly)")
    parser.add_argument("--output", type=Path, default=SOURCE / "docs/performance", help="of the page (default: docs/performance)")


def scene(mesh, law):
    """Options of the benchmark program."""
    return ["-dm_plex_filename", mesh, "-tissue", law, "-options_file", SCENES / "pcv.opts", *PAPER, "-options_file", SOLVERS / "direct.opts",
            "-tissue", law]


def measure(command):
    """What a program says in its last line."""
    out = subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True, env=environment())
    return json.loads(out.stdout.splitlines()[-1])


def roofline(seconds_us, counted, machine):
    """Row of the roofline, from µs per cell, operations and bytes per cell, and 10^9 operations and bytes per second."""
    at_peak = 1e-3 * counted["flops"] / machine["gflops"]
    at_bandwidth = 1e-3 * counted["bytes"] / machine["triad_gb"]
    attainable = max(at_peak, at_bandwidth)
    return [f"{seconds_us:.2f}", f"{counted['flops']:.0f}", f"{counted['divisions']:.0f}", f"{counted['bytes']:.0f}",
            f"{counted['flops'] / counted['bytes']:.1f}", f"{at_peak:.2f}", f"{at_bandwidth:.2f}", f"{attainable:.2f}",
            f"{seconds_us / attainable:.1f}", f"{1e-3 * counted['flops'] / seconds_us:.1f}"]


def limits(options, program, mesh, measured):
    """Lines of the page on the limits, and the rows of the roofline."""
    probe = options.build / "pulmo_machine_benchmark"
    machines = [measure([*shlex.split(options.launcher), str(ranks), probe]) for ranks in (1, 2)]
    counter = operations.build(options.results / "build")
    print("counting ...", flush=True)

    def counted(law):
        return operations.count(counter, scene(COUNTED, law), options.results / law)

    with ThreadPoolExecutor(2) as two:  # counts do not depend on how busy the machine is
        found = dict(zip(options.laws, two.map(counted, options.laws)))
    cells = measure([program, *scene(COUNTED, options.laws[0]), "-benchmark_repeats", "1", "-benchmark_stock", "off"])["cells"]
    rows = [[law, which, *roofline(measured[law][f"{which}_us"], {k: v / cells for k, v in found[law][which].items()}, machines[0])]
            for law in options.laws for which in ("residual", "jacobian")]
    lines = ["", "## The limit", "",
             f"Measured peak of one core: {machines[0]['gflops']:.1f} Gflop/s (fused multiply-add on four doubles, the vectors of the kernels; "
             f"two cores {machines[1]['gflops']:.1f}). Bandwidth: {machines[0]['triad_gb']:.1f} GB/s (STREAM triad, arrays of "
             f"{machines[0]['array_mb']:.0f} MB; two cores {machines[1]['triad_gb']:.1f}), reading alone {machines[0]['read_gb']:.1f} "
             f"(two cores {machines[1]['read_gb']:.1f}). Operations are counted by executing every instruction under callgrind "
             f"({COUNTED.name}, {cells} tetrahedra, facets included; padded lanes count); bytes are what crosses from a simulated 1 MB "
             "cache to the memory behind it, both ways. Attainable: the larger of operations at peak and bytes at the triad's bandwidth.",
             "", *markdown(ROOFLINE, rows)]
    shares = {law: operations.time_shares(program, scene(mesh, law), options.results / law) for law in options.laws}
    if any(shares.values()):
        lines += ["", "Where the time goes (residual and Jacobian together, sampled by perf):", "",
                  *markdown(["law", *operations.GROUPS], [[law, *(f"{100 * found.get(group, 0):.0f} %" for group in operations.GROUPS)]
                                                          for law, found in shares.items()])]
    else:
        lines += ["", "perf is not there or not allowed: where the time goes is left out."]
    return lines, rows


def run(options):
    program = options.build / "pulmo_assembly_benchmark"
    if not program.exists():
        fail(f"{options.build} holds no build; run tools/setup first")
    options.laws = laws_of(options)
    mesh = options.mesh or make_lung(options.cells, options.build)
    header = ["law", "residual µs/cell", "Jacobian µs/cell", "stock residual µs/cell", "stock Jacobian µs/cell",
              "residual ratio", "Jacobian ratio", "residual difference", "Jacobian difference"]
    rows, measured = [], {}
    for law in options.laws:
        print(f"{law} ...", flush=True)
        r = measured[law] = measure([program, *scene(mesh, law), "-benchmark_repeats", options.repeats,
                                     "-benchmark_stock", "off" if options.no_stock else "on"])
        row = [law, f"{r['residual_us']:.2f}", f"{r['jacobian_us']:.2f}"]
        if options.no_stock:
            row += ["-"] * 6
        else:
            row += [f"{r['stock_residual_us']:.1f}", f"{r['stock_jacobian_us']:.0f}",
                    f"{r['stock_residual_us'] / r['residual_us']:.1f}", f"{r['stock_jacobian_us'] / r['jacobian_us']:.1f}",
                    f"{r['residual_difference']:.1e}", f"{r['jacobian_difference']:.1e}"]
        rows.append(row)
    notes = (f"{measured[options.laws[0]]['cells']} tetrahedra, PCV scene (tissue, airflow, springs), 8-point rule, one process on "
             f"{processor()}; CPU time, median of {options.repeats}. Stock: `-petscfe_type basic` with the same rule, once; its rows "
             "include PETSc's own loop over cells and insertion into the matrix, as pulmo's include its own. "
             "Differences: relative 2-norm (residual) and Frobenius norm (Jacobian) between both.")
    lines, limit_rows = [], []
    if options.no_count:
        print("the roofline is left out (--no-count)")
    elif not (shutil.which("valgrind") and shutil.which("objdump")):
        print("the roofline is left out: it needs valgrind and objdump (apt-get install valgrind binutils)")
    else:
        lines, limit_rows = limits(options, program, mesh, measured)
    write_table(options.output, "assembly", "Assembly", header, rows, notes, lines)
    if limit_rows:
        show(ROOFLINE, limit_rows)
        write_csv(options.output / "assembly_limit.csv", ROOFLINE, limit_rows)
