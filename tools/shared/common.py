"""What all tools share: places, environment, what the program offers, machine, tables."""
import contextlib
import csv
import functools
import os
import platform
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent.parent
# an installed tool leaves its results where it is called
RESULTS = (SOURCE if (SOURCE / "CMakeLists.txt").exists() else Path.cwd()) / "results"
SCENES = SOURCE / "petsc_options/scenes"
PAPER = ["-options_file", SCENES / "paper.opts"]  # the readings that the studies were made with
SOLVERS = SOURCE / "petsc_options/solvers"
KPA_PER_CMH2O = 0.0980665
PLAIN = "-predictor_increments 0 -snes_lag_jacobian 1 -snes_lag_preconditioner 1"  # Newton's method with nothing spared


def fail(message):
    """Ends the program with one sentence."""
    sys.exit(f"tools/{Path(sys.argv[0]).name}: error: {message}")


@contextlib.contextmanager
def written_whole(path):
    """A name beside that of a file: what is written there gets the file's own name when it is whole, else it goes away."""
    part = os.path.join(os.path.dirname(path), f"part_{os.getpid()}_{os.path.basename(path)}")
    try:
        yield part
        os.replace(part, path)
    finally:
        if os.path.exists(part):
            os.remove(part)


def processor():
    """Model name of this machine's processor."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


def blas(program):
    """File name of the BLAS library that a program runs with."""
    for line in subprocess.run(["ldd", program], capture_output=True, text=True).stdout.splitlines():
        if line.split()[0].startswith(("libblas.so", "libopenblas")):
            real = os.path.realpath(line.split()[2])
            return "OpenBLAS" if "openblas" in real else os.path.basename(real)
    return "an unknown BLAS"


def environment():
    """One BLAS thread; Open MPI may run as root in containers."""
    return dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", OMPI_ALLOW_RUN_AS_ROOT="1",
                OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1")


@functools.cache
def listed(program):
    """(kind, names, the rest) of each line of a program's -list."""
    run = subprocess.run([program, "-list"], capture_output=True, text=True, env=environment())
    if run.returncode:
        fail(f"{program} -list ends with code {run.returncode}: {run.stderr.strip()}")
    return [tuple(line.split(maxsplit=2)) for line in run.stdout.splitlines()]


def offered(program, kind):
    """What a program offers of a kind (`tissue` or `permeability` laws, `effect`): {name: alias, or nothing}."""
    return {name: alias for this, names, _ in listed(program) if this == kind for name, _, alias in [names.partition("|")]}


def examples(program):
    """{effect: options that bring it into a scene}."""
    return {name: words for kind, name, words in listed(program) if kind == "example"}


def tissue_laws(program):
    """Names of the tissue laws that a program offers, CM1 to CM5 first."""
    laws = offered(program, "tissue")
    return sorted(laws, key=lambda law: (not laws[law], laws[law]))


def laws_of(options):
    """The tissue laws that a call names with --laws, or all that its build offers."""
    there = tissue_laws(options.build / "pulmo")
    unknown = [law for law in options.laws or [] if law not in there]
    if unknown:
        fail(f"--laws {unknown[0]} is not offered by {options.build / 'pulmo'}, which has {', '.join(there)}")
    return options.laws or there


def require(build, meshes):
    """Ends the program unless `build` holds pulmo and all `meshes` are files."""
    if not (build / "pulmo").exists():
        fail(f"{build} holds no build; run tools/setup first")
    for mesh in meshes:
        if not mesh.is_file():
            fail(f"there is no mesh {mesh}")


def markdown(header, rows):
    """Lines of a table in Markdown."""
    texts = [[str(v).replace("|", "/") for v in row] for row in [header, ["---"] * len(header), *rows]]
    return ["| " + " | ".join(row) + " |" for row in texts]


def write_csv(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as f:
        csv.writer(f).writerows([header, *rows])
    print(f"wrote {path}")


def show(header, rows):
    """Prints a table with the columns aligned."""
    texts = [[str(v) for v in row] for row in [header, *rows]]
    widths = [max(3, *(len(text[i]) for text in texts)) for i in range(len(header))]
    texts.insert(1, ["-" * w for w in widths])
    for row in texts:
        print("  ".join(text.ljust(w) if i == 0 else text.rjust(w)
                        for i, (text, w) in enumerate(zip(row, widths))).rstrip())


def write_table(folder, name, title, header, rows, notes, more=()):
    """Prints a table and writes it to a folder as CSV and Markdown; `more`: lines that follow it in the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text("\n".join([f"# {title}", "", notes, "", *markdown(header, rows), *more]) + "\n")
    print("\n" + notes + "\n")
    show(header, rows)
    print(f"\nwrote {folder / name}.md")
    write_csv(folder / f"{name}.csv", header, rows)
