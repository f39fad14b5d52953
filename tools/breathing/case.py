"""The folder of a case: options, the files that they name, and what was done, so that it can be done again."""
import hashlib
import json
import re
import shlex
import shutil
from pathlib import Path

from shared.common import SOURCE, fail, written_whole

OPTION_FILE = "-options_file"
OPTION_FILES = {"scene": "the scene: mode and effects", "solver": "the solver", "own": "numbers and options of the call, which override what stands before"}
# what a call leaves in its folder; anything else is the user's
MADE = ("case.json", "lung.msh", "mesh.html", "mesh.txt", "inputs", "accuracy", "accuracy.txt", "accuracy.opts", "dry_run.txt", "run", "run.sh",
        "pulmo.log", "report.html", *(f"{name}.opts" for name in OPTION_FILES))
# what breathe gives itself, or what would make no run
MESH = "-dm_plex_filename"
OURS = (MESH, "-output_dir", "-output_overwrite", "-restart", "-dry_run", "-scene_view_only", "-help", "-list", "-version", "-progress")


def read_options(path, within=()):
    """[(name, value)] of an option file, those of files that it names in their place. A line without a dash (alias) is a name of its own.
    within: the files that name this one."""
    pairs, within = [], (*within, Path(path).resolve())
    if len(set(within)) < len(within):
        fail(f"{path} names itself as an option file, at once or by others")
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (UnicodeDecodeError, OSError) as error:
        fail(f"{path} is no option file: {'it is no text in UTF-8' if isinstance(error, UnicodeDecodeError) else error.strerror}")
    for line in lines:
        line = line.strip()
        if not line.startswith("-"):
            pairs += [(re.sub(r"\s#.*", "", line), "")] if line and line[0] != "#" else []
            continue
        name, value = re.match(r"""(\S+)\s*("[^"]*"|'[^']*'|.*?)\s*(?:(?<=\s)#.*)?$""", line).groups()
        if len(value) > 1 and value[:1] == value[-1:] and value[:1] in ("'", '"'):
            value = value[1:-1]
        elif re.search(r"\s-[A-Za-z]", value):
            fail(f"{path}: '{name} {value}' holds two options; give each a line of its own, or put the value in quotes")
        pairs += option(name, value, within, f"{path} names an option file {value}, which is not there")
    return pairs


def pairs_of(words):
    """[(name, value)] of the words of a command line, option files read."""
    pairs, waiting = [], list(words)
    while waiting:
        name = waiting.pop(0)
        if not re.match(r"-[A-Za-z_]", name):
            fail(f"'{name}' after -- belongs to no option")
        value = waiting.pop(0) if waiting and not re.match(r"-[A-Za-z_]", waiting[0]) else ""
        pairs += option(name, value, (), f"{OPTION_FILE} {value}: there is no such file")
    return pairs


def option(name, value, within, missing):
    """[(name, value)], or what the option file holds that it names; PETSc's YAML stays a file. within: the files that it stands in, whose mesh
    does not count. missing: what to say where there is none."""
    if name == MESH and within:
        print(f"breathe: {within[-1]} names the mesh {value}; the one of the call counts", flush=True)
        return []
    if name in OURS:
        fail(f"{name} is given by tools/breathe itself: leave it out of its options and option files")
    if name != OPTION_FILE or Path(value).suffix in (".yaml", ".yml", ".json"):
        return [(name, value)]
    return read_options(found(value) or fail(missing), within)


def found(value):
    """The file that a value names, from here or from the top folder; None if it names none."""
    for place in (Path(value), SOURCE / value):
        if value and place.is_file():
            return place
    return None


def file_of(option, value):
    """(file, rest) of an option's value that names a file as FILE or FILE:dataset; (None, value) else. A word without a dot or a slash is
    a name, though a file may be called so, unless the option wants a file."""
    for name, rest in ((value, ""), (value.rpartition(":")[0], ":" + value.rpartition(":")[2])):
        if (re.search(r"[./]", name) or option.endswith(("_programme", "_file"))) and found(name):
            return found(name), rest
    return None, value


def digest(path):
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def digest_of_source(path):
    """Of a mask or a mesh; of a folder all files in it."""
    if path.is_file():
        return digest(path)
    return hashlib.sha256("".join(f"{p.name} {digest(p)}\n" for p in sorted(path.iterdir()) if p.is_file()).encode()).hexdigest()


def digest_of_options(pairs):
    """Of options and of the files that they name."""
    lines = [f"{name} {value} {digest(file_of(name, value)[0]) if file_of(name, value)[0] else ''}\n" for name, value in pairs]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


class Case:
    """`call`: the words that began it, `made_of`: hashes of what they named. `done`: what stages left to know, by their names."""

    def __init__(self, folder):
        self.folder = Path(folder)
        try:
            known = json.loads((self.folder / "case.json").read_text())
            self.call, self.made_of, self.done = known["call"], known["made_of"], known["done"]
        except (ValueError, KeyError, TypeError, OSError):
            fail(f"{self.folder / 'case.json'} is damaged, or not of tools/breathe: name another --case")

    @classmethod
    def take(cls, folder, call, source, words, overwrite):
        """A new case, or that of an earlier call if it was called the same with the same files; else it is replaced only if it may be.

        words: of a command line, for each of OPTION_FILES.
        """
        options = {name: pairs_of(words[name]) for name in OPTION_FILES}
        made_of = {"source": digest_of_source(source)} | {name: digest_of_options(pairs) for name, pairs in options.items()}
        if (folder / "case.json").exists() and not overwrite:
            case = cls(folder)
            if case.call != call:
                fail(f"{folder} holds a case that was called otherwise ({shlex.join(case.call)}); name another --case, or --overwrite")
            changed = [source if name == "source" else f"a file that {name}.opts was made of" for name in made_of if made_of[name] != case.made_of.get(name)]
            if changed:
                fail(f"{changed[0]} has changed since {folder} was made of it; name another --case, or --overwrite")
            return case
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "case.json").exists():
            cls(folder)  # of breathe, or no word of replacing it
        named = [source, *(file_of(name, value)[0] for pairs in options.values() for name, value in pairs)]
        inside = [path for path in named if path and folder.resolve() in Path(path).resolve().parents]
        if inside:
            fail(f"{inside[0]} lies in {folder}, which is made anew: name another --case")
        for path in map(folder.joinpath, MADE):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        case = cls.__new__(cls)
        case.folder, case.call, case.made_of, case.done = folder, call, made_of, {}
        for name, what in OPTION_FILES.items():
            case.write_options(f"{name}.opts", options[name], what)
        case.save()
        return case

    def write_options(self, name, pairs, what):
        """An option file of the case. Files that options name are copied into inputs/, for the folder to be whole."""
        lines = [f"# {what}"]
        for option, value in pairs:
            path, dataset = file_of(option, value)
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
            Path(part).write_text(json.dumps({"call": self.call, "made_of": self.made_of, "done": self.done}, indent=2) + "\n")

    @property
    def options(self):
        """What pulmo is told in this folder, without launcher and output."""
        files = [f"{name}.opts" for name in (*OPTION_FILES, "accuracy") if (self.folder / f"{name}.opts").exists()]
        return ["-skip_petscrc", *(word for name in files for word in (OPTION_FILE, name)), "-dm_plex_filename", self.done["mesh"]["file"]]

    def names(self, option):
        """Whether one of the option files of this folder gives an option."""
        return any(name == option for path in self.folder.glob("*.opts") for name, _ in read_options(path))

    def inputs(self, program):
        """Hashes of all that a run is made of, the program's own with them: what changes any of them makes another run."""
        files = [program, self.folder / self.done["mesh"]["file"], *sorted(self.folder.glob("*.opts")), *sorted(self.folder.glob("inputs/*"))]
        return {path.name if path == program else str(path.relative_to(self.folder)): digest(path) for path in files}
