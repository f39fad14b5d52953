"""What a finished run is known by, and who may write where: shared by all tools that keep runs.

A key covers the words of the command, the content of every file that the run reads (programs, modules of scripts, libraries by name,
size and time, meshes, option files and all that those name, to any depth, ~/.petscrc and .petscrc) and the variables that PETSc, MPI
and BLAS listen to. What changes any of them makes a new run.
"""
import fcntl
import functools
import hashlib
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

from .common import SOURCE, fail, written_whole
from .common import environment as plain_environment

LISTENED = ("PETSC_", "OMPI_MCA_", "PMIX_MCA_", "MPICH_", "UCX_", "OMP_", "OPENBLAS_", "GOTO_", "MKL_", "BLIS_", "HDF5_", "LD_", "MALLOC_",
            "GLIBC_TUNABLES", "PULMO_")
OPTION_FILES = ("-options_file", "-options_file_yaml")
RC_FILES = ("~/.petscrc", ".petscrc", "petscrc")  # as PetscInitialize looks for them
_held = {}  # locks of this process


def words_of(text):
    """Words of an option file or of YAML, without quotes; of lists and of FILE:dataset also the parts."""
    found = []
    for line in text.splitlines():
        for quoted, plain in re.findall(r'"([^"]*)"|(\S+)', line):
            word = quoted or plain.strip("'")
            found += [word, *(part for part in re.split(r"[,:=\[\]{}]", word) if part != word)]
    return found


def is_option_file(before, word):
    return before in OPTION_FILES or Path(word).suffix in (".opts", ".yaml", ".yml") or Path(word).name in (".petscrc", "petscrc")


def files_of(words, directory, found=None):
    """All files that words name, also as FILE:dataset, seen from a directory, and those that the option files among them name, in the
    order in which they are met."""
    found = {} if found is None else found
    for before, word in zip([None, *words], words):
        path = os.path.realpath(os.path.join(directory, word))
        if not os.path.isfile(path):
            path = os.path.realpath(os.path.join(directory, word.rpartition(":")[0]))
        if path in found or not os.path.isfile(path):
            continue
        found[path] = None
        if is_option_file(before, word):
            files_of(words_of(Path(path).read_text(errors="replace")), directory, found)
    return list(found)


@functools.cache
def libraries(program):
    """Shared libraries of a program, with size and time; none of a script."""
    with open(program, "rb") as f:
        if f.read(4) != b"\x7fELF":
            return []
    listed = subprocess.run(["ldd", program], capture_output=True, text=True).stdout
    paths = sorted({os.path.realpath(path) for path in re.findall(r"(/\S+)", listed)})
    return [f"{path} {os.stat(path).st_size} {os.stat(path).st_mtime_ns}" for path in paths if os.path.isfile(path)]


def modules(program):
    """Python files that a script runs on: those of the folders beside it, or in `python` there, that it, or one of them, imports from."""
    found, waiting = set(), [Path(program)]
    while waiting:
        text = waiting.pop().read_bytes()
        if found or text.startswith(b"#!"):
            for name in re.findall(rb"^(?:from|import) (\w+)", text, re.MULTILINE):
                new = {path for folder in (".", "python") for path in (Path(program).parent / folder / name.decode()).glob("*.py")} - found
                found |= new
                waiting += new
    return sorted(map(str, found))


def digest(words, environment=None, directory=""):
    """A short name for a command and all that its run depends on. environment and directory: those of the run (default: those of all
    tools, and the current one)."""
    words, environment = [str(word) for word in words], environment or plain_environment()
    variables = {name: value for name, value in environment.items() if name.startswith(LISTENED)}
    programs = list(dict.fromkeys(path for word in words if (path := shutil.which(word))))
    programs += [path for program in programs for path in modules(program)]
    named = [*words, *words_of(environment.get("PETSC_OPTIONS", "")), *words_of(environment.get("PETSC_OPTIONS_YAML", "")),
             *(os.path.expanduser(path) for path in RC_FILES)]
    content = hashlib.sha256()
    for text in [*words, *(f"{name}={variables[name]}" for name in sorted(variables))]:
        content.update(text.encode() + b"\0")
    for path in files_of([*named, *programs], directory):
        with open(path, "rb") as f:
            content.update(hashlib.file_digest(f, "sha256").digest())
    for path in programs:
        content.update("\0".join(libraries(path)).encode())
    return content.hexdigest()[:16]


LOCK = ".lock"  # all that a call leaves in a folder which is refused then


def lock(folder):
    """Keeps other calls out of a folder until this process ends; ends the program if another one is at work there."""
    folder = Path(folder).resolve()
    if folder in _held:
        return
    folder.mkdir(parents=True, exist_ok=True)
    file = open(folder / LOCK, "a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.seek(0)
        fail(f"another call is at work in {folder} ({file.read().strip() or 'who is not known yet'}); wait for it, or name another folder")
    file.truncate(0)
    file.write(f"{Path(sys.argv[0]).name}, process {os.getpid()} on {socket.gethostname()}, started {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
    file.flush()
    _held[folder] = file


def is_made(path, command, environment=None):
    """Whether a file is there as this command makes it now; note_made() remembers by what it was made."""
    note = path.with_name(path.name + ".key")
    return path.exists() and note.exists() and note.read_text() == digest([*command, path], environment)


def note_made(path, command, environment=None):
    path.with_name(path.name + ".key").write_text(digest([*command, path], environment))


def printed(command, path, environment=None, reads=()):
    """What a command prints, kept in a file until the command or a file that it `reads` changes; None if it fails."""
    known = [*map(str, command), *map(str, reads)]
    if not is_made(path, known, environment):
        run = subprocess.run(command, cwd=SOURCE, env=environment or plain_environment(), capture_output=True, text=True)
        if run.returncode:
            return None
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(run.stdout)
        note_made(path, known, environment)
    return path.read_text()


def make_mesh(path, tool, words):
    """Makes a mesh with one of the tools unless it is there as the tool makes it now. Whether it was made."""
    command = [SOURCE / "tools" / tool, *map(str, words)]
    if is_made(path, command):
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    print(f"making {path.name} ...", flush=True)
    with written_whole(path) as part:
        run = subprocess.run([*command, "--output", part], capture_output=True, text=True)
        if run.returncode:
            fail((run.stderr.strip().splitlines() or [f"tools/{tool} failed"])[-1])
    note_made(path, command)
    return True


def make_lung(cells, build):
    """Path of a pair of lungs of about `cells` tetrahedra, made by tools/lung_mesh."""
    mesh = build / f"lung_pair_{cells}.msh"
    make_mesh(mesh, "lung_mesh", ["--side", "both", "--cells", cells])
    return mesh
