"""What tools/export does: reads the run, chooses times, lets a format write, and keeps what it wrote only if all of it is whole."""
import contextlib
import os
import shutil
import tempfile
from pathlib import Path

from pulmo.errors import PulmoError
from pulmo.files import RunFiles

FORMATS = ["nifti", "vtu", "paraview", "ventilator_csv"]
NEAR = 1e-6  # s
LIST = ".made_by_export"  # names of the files in a folder that may be replaced


def say(text):
    print(f"export: {text}", flush=True)


def check(given):
    """Refuses options that the formats have no use for."""
    without = [] if "nifti" in given.format else ["grid", "spacing", "labels", "fit", "shape", "fields", "outside"]
    if not {"nifti", "vtu"} & set(given.format):
        without.append("times")
    for option in without:
        if getattr(given, option):
            raise PulmoError(f"--{option} has no meaning with --format {' '.join(given.format)}")
    if given.grid and given.spacing:
        raise PulmoError("--grid and --spacing both say where the voxels are; leave out one")
    if given.spacing is not None and not 0 < given.spacing < float("inf"):
        raise PulmoError(f"--spacing {given.spacing:g} is no size of voxels (mm)")
    given.shape, given.outside = given.shape or "reference", given.outside or "0"


def read(directory, unfinished):
    """The run, unless it did not reach its end."""
    run = RunFiles(directory)
    if run.unfinished and not unfinished:
        raise PulmoError(f"{directory}: {run.unfinished if run.state == 'unfinished' else 'FAILED: ' + run.failure}; --unfinished "
                         "exports what is there")
    if run.unfinished:
        say(f"WARNING: {run.unfinished}")
    return run


def moments_of(run, text, kind):
    """Snapshots of --times; by default the start and the end of inspiration for images, all for a series."""
    times = run.fields.times
    if text == "all" or not text and kind == "vtu":
        return list(range(len(times)))
    if not text:
        try:
            moments = list(run.full)
        except PulmoError:
            moments = [len(times) - 1]
        what = dict((snapshot, word) for word, snapshot in run.moments)
        say("times: " + "; ".join(f"{times[s]:g} s ({what.get(s, 'the last')})" for s in moments))
        return moments
    found = []
    for word in text.split(","):
        try:
            wanted = float(word)
        except ValueError:
            raise PulmoError(f"--times: '{word}' is no time; give seconds with commas between them, or all") from None
        near = [s for s, time in enumerate(times) if abs(time - wanted) < NEAR]
        if not near:
            raise PulmoError(f"--times {word}: there is no snapshot at {word} s, only at {', '.join(f'{t:g}' for t in times)} s "
                             "(a run keeps more with -output_fields_every)")
        found += near
    return sorted(set(found))


@contextlib.contextmanager
def scratch(output, read):
    """A folder within `output` whose files go there when all is done, and away if not. Files that stand there are replaced if an
    export made them (LIST names those), and no file that was `read`."""
    new = not os.path.isdir(output)
    try:
        os.makedirs(output, exist_ok=True)
        part = tempfile.mkdtemp(prefix="part_", dir=output)
    except OSError as error:
        raise PulmoError(f"cannot write {output}: {error.strerror}") from None
    try:
        yield part
        made, listed = sorted(os.listdir(part)), os.path.join(output, LIST)
        earlier = Path(listed).read_text().splitlines() if os.path.isfile(listed) else []
        for name in made:
            to = os.path.join(output, name)
            if os.path.lexists(to) and (name not in earlier or os.path.isdir(to) or any(os.path.exists(r) and os.path.samefile(to, r) for r in read)):
                raise PulmoError(f"{to} is there and no export made it: move it, or name another --output")
        Path(part, LIST).write_text("".join(f"{name}\n" for name in sorted({*earlier, *made})))
        for name in [LIST, *made]:
            os.replace(os.path.join(part, name), os.path.join(output, name))
    except OSError as error:
        raise PulmoError(f"cannot write {output}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if new:
            with contextlib.suppress(OSError):
                os.rmdir(output)  # unless something was written


def export(given):
    """Carries out a command line; raises PulmoError."""
    check(given)
    run = read(given.directory, given.unfinished)
    given.output = given.output or os.path.join(given.directory, "export")
    made = []
    with scratch(given.output, [path for path in (given.grid, given.labels) if path]) as folder:
        for kind in dict.fromkeys(given.format):
            if kind == "nifti":
                from .nifti import export as write
            elif kind == "vtu":
                from .vtu import export as write
            elif kind == "paraview":
                from .paraview import export as write
            else:
                from .ventilator_csv import export as write
            moments = moments_of(run, given.times, kind) if kind in ("nifti", "vtu") else []
            made += write(run, given, moments, folder, say)
    for name in made:
        say(f"wrote {os.path.join(given.output, name)}")
