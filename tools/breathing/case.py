"""The folder of a case: options, the files that they name, and what was done, so that it can be done again."""
import hashlib
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

from shared.common import SOURCE, fail, written_whole

OPTION_FILE = "-options_file"


def read_options(path):
    """[(name, value)] of an option file, those of files that it names in their place."""
    pairs = []
    for line in Path(path).read_text(encoding="utf-8-sig").splitlines():
        words = re.sub(r"(^|\s)#.*", "", line).strip().split(None, 1)
        if not words:
            continue
        value = words[1].strip() if len(words) > 1 else ""
        if value[:1] == value[-1:] and value[:1] in ("'", '"'):
            value = value[1:-1]
        if words[0] == OPTION_FILE:
            pairs += read_options(found(value) or fail(f"{path} names an option file {value} that is not there"))
        else:
            pairs.append((words[0], value))
    return pairs


def pairs_of(words):
    """[(name, value)] of the words of a command line, option files read."""
    pairs, waiting = [], list(words)
    while waiting:
        name = waiting.pop(0)
        if not re.match(r"-[A-Za-z_]", name):
            fail(f"'{name}' after -- belongs to no option")
        value = waiting.pop(0) if waiting and not re.match(r"-[A-Za-z_]", waiting[0]) else ""
        if name == OPTION_FILE:
            pairs += read_options(found(value) or fail(f"{OPTION_FILE} {value}: there is no such file"))
        else:
            pairs.append((name, value))
    return pairs


def found(value):
    """The file that a value names, from here or from the top folder; None if it names none."""
    for place in (Path(value), SOURCE / value):
        if value and place.is_file():
            return place
    return None


def digest(path):
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


class Case:
    """`call`: the words that began it. `done`: what stages left to know, by their names."""

    def __init__(self, folder):
        self.folder = Path(folder)
        try:
            self.known = json.loads((self.folder / "case.json").read_text())
            self.call, self.done = self.known["call"], self.known["done"]
        except (ValueError, KeyError):
            fail(f"{self.folder / 'case.json'} is damaged; give the mask or mesh again with --overwrite")

    @classmethod
    def take(cls, folder, call, scene, solver, overwrite):
        """A new case, or that of an earlier call if it was called the same; else it is replaced only if it may be."""
        if (folder / "case.json").exists():
            if overwrite:
                for path in folder.iterdir():
                    if path.name != ".lock":
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
            else:
                case = cls(folder)
                if case.call != call:
                    fail(f"{folder} holds a case that was called otherwise ({shlex.join(case.call)}); name another --case, or --overwrite")
                return case
        folder.mkdir(parents=True, exist_ok=True)
        case = cls.__new__(cls)
        case.folder, case.call, case.done = folder, call, {}
        case.write_options("scene.opts", pairs_of(scene), "the scene: mode, effects, numbers and options as called")
        case.write_options("solver.opts", read_options(solver), f"the solver, {solver.name}")
        case.save()
        return case

    def write_options(self, name, pairs, what):
        """An option file of the case. Files that options name are copied into inputs/, for the folder to be whole."""
        lines = [f"# {what}"]
        for option, value in pairs:
            path, dataset = found(value), ""
            if not path and ":" in value:
                path, dataset = found(value.rpartition(":")[0]), ":" + value.rpartition(":")[2]
            if path:
                value = self.keep(path) + dataset
            quoted = f'"{value}"' if re.search(r"\s", value) or re.match(r"-[A-Za-z]", value) else value
            lines.append(f"{option} {quoted}".rstrip())
        (self.folder / name).write_text("\n".join(lines) + "\n")

    def keep(self, path):
        """Copies a file into the case; its name from there. Files of one name that differ get a number."""
        inputs = self.folder / "inputs"
        inputs.mkdir(exist_ok=True)
        for number in range(1, 1000):
            to = inputs / (path.name if number == 1 else f"{path.stem}_{number}{path.suffix}")
            if not to.exists():
                shutil.copyfile(path, to)
            if digest(to) == digest(path):
                return str(to.relative_to(self.folder))
        fail(f"too many files are called {path.name}")

    def save(self, **done):
        """Notes what a stage left, whole or not at all."""
        self.done.update(done)
        with written_whole(str(self.folder / "case.json")) as part:
            Path(part).write_text(json.dumps({"call": self.call, "done": self.done, "python": sys.version.split()[0]}, indent=2) + "\n")

    @property
    def options(self):
        """What pulmo is told in this folder, without launcher and output."""
        more = ["-options_file", "accuracy.opts"] if (self.folder / "accuracy.opts").exists() else []
        return ["-dm_plex_filename", self.done["mesh"]["file"], "-options_file", "scene.opts", "-options_file", "solver.opts", *more]

    def inputs(self):
        """Hashes of all that a run reads: what changes any of them makes another run."""
        names = ["scene.opts", "solver.opts", "accuracy.opts", self.done["mesh"]["file"]]
        names += [str(p.relative_to(self.folder)) for p in sorted(self.folder.glob("inputs/*"))]
        return {name: digest(self.folder / name) for name in names if (self.folder / name).exists()}
