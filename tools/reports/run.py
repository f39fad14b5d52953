"""One run as the page needs it, and several with names that differ."""
import functools
import os

import shared  # noqa: F401: where the module pulmo is
from pulmo.files import RunFiles

from . import fields
from .read import fail


class Run(RunFiles):
    """`name` and `id` tell the runs of a page, `of` in number, apart."""

    def __init__(self, directory, name, number, of):
        super().__init__(directory)
        self.name, self.id, self.of = name, f"run{number + 1}", of

    @functools.cached_property
    def fields(self):
        """Snapshots of the run; raises Missing."""
        return fields.Fields(self.directory)


def name_of(directory):
    """Its last folder; of the run of a case of tools/breathe that of the case."""
    folder, last = os.path.split(os.path.abspath(directory))
    if os.path.isfile(os.path.join(folder, "case.json")):
        case = os.path.basename(folder)
        return case if last == "run" else f"{case}, {last}"
    return last


def load(directories):
    """Runs with names that differ: the last folder (of a case of tools/breathe the case's), or the path as it was given."""
    directories = [os.fspath(d) for d in directories]
    last = [name_of(d) for d in directories]
    if len(set(map(os.path.abspath, directories))) < len(directories):
        fail("a directory is named twice")
    return [Run(d, name if last.count(name) == 1 else d, i, len(last)) for i, (d, name) in enumerate(zip(directories, last))]
