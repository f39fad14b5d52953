"""What all benchmarks share: places, environment, machine, tables."""
import csv
import os
import platform
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent.parent
SCENES = SOURCE / "petsc_options/scenes"
SOLVERS = SOURCE / "petsc_options/solvers"


def fail(message):
    """Ends the program with one sentence."""
    sys.exit(f"tools/benchmark: error: {message}")


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


def write_table(folder, name, title, header, rows, notes):
    """Prints a table and writes it to a folder as CSV and Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{name}.csv", "w", newline="") as f:
        csv.writer(f).writerows([header, *rows])
    texts = [[str(v) for v in row] for row in [header, *rows]]
    widths = [max(3, *(len(text[i]) for text in texts)) for i in range(len(header))]
    texts.insert(1, ["-" * 3] * len(header))
    lines = [f"# {title}", "", notes, ""]
    lines += ["| " + " | ".join(text.replace("|", "/") for text in row) + " |" for row in texts]
    (folder / f"{name}.md").write_text("\n".join(lines) + "\n")
    texts[1] = ["-" * w for w in widths]
    print("\n" + notes + "\n")
    for row in texts:
        print("  ".join(text.ljust(w) if i == 0 else text.rjust(w)
                        for i, (text, w) in enumerate(zip(row, widths))).rstrip())
    print(f"\nwrote {folder / name}.csv and .md")
