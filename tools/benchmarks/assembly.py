"""`tools/benchmark assembly`: residual and Jacobian of the PCV scene for each law, fast against stock."""
import json
import subprocess

from .common import SOURCE, environment, fail, make_lung, processor, write_table

LAWS = ["berger", "ma", "birzle", "yoshihara", "rausch"]


def arguments(parser):
    parser.add_argument("--cells", type=int, default=15000, help="tetrahedra of the lung that is made (default 15000)")
    parser.add_argument("--mesh", help="a mesh of your own instead")
    parser.add_argument("--laws", nargs="+", default=LAWS, choices=LAWS)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--no-stock", action="store_true", help="leave out PETSc's integrator (minutes)")


def run(options):
    program = options.build / "pulmo_assembly_benchmark"
    if not program.exists():
        fail(f"{options.build} holds no build; run tools/setup first")
    mesh = options.mesh or make_lung(options.cells, options.build)
    header = ["law", "residual µs/cell", "Jacobian µs/cell", "stock residual µs/cell", "stock Jacobian µs/cell",
              "residual ratio", "Jacobian ratio", "residual difference", "Jacobian difference"]
    rows = []
    cells = 0
    for law in options.laws:
        print(f"{law} ...", flush=True)
        command = [program, "-dm_plex_filename", mesh, "-tissue", law,
                   "-options_file", SOURCE / "petsc_options/scenes/pcv.opts",
                   "-options_file", SOURCE / "petsc_options/solvers/direct.opts", "-tissue", law,
                   "-benchmark_repeats", str(options.repeats), "-benchmark_stock", "off" if options.no_stock else "on"]
        out = subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True, env=environment())
        r = json.loads(out.stdout.splitlines()[-1])
        cells = r["cells"]
        row = [law, f"{r['residual_us']:.2f}", f"{r['jacobian_us']:.2f}"]
        if options.no_stock:
            row += ["-"] * 6
        else:
            row += [f"{r['stock_residual_us']:.1f}", f"{r['stock_jacobian_us']:.0f}",
                    f"{r['stock_residual_us'] / r['residual_us']:.1f}", f"{r['stock_jacobian_us'] / r['jacobian_us']:.1f}",
                    f"{r['residual_difference']:.1e}", f"{r['jacobian_difference']:.1e}"]
        rows.append(row)
    notes = (f"{cells} tetrahedra, PCV scene (tissue, airflow, springs), 8-point rule, one process on {processor()}; "
             f"CPU time, median of {options.repeats}. Stock: `-petscfe_type basic` with the same rule, once; its rows "
             "include PETSc's own loop over cells and insertion into the matrix, as pulmo's include its own. "
             "Differences: relative 2-norm (residual) and Frobenius norm (Jacobian) between both.")
    write_table(SOURCE / "docs/performance", "assembly", "Assembly", header, rows, notes)
