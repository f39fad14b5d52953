"""What the program tells of itself: options with words, units, ranges and defaults (-help), laws and effects (-list)."""
import os
import re
import subprocess
import tempfile
from typing import NamedTuple

from shared.common import environment

OPTION = re.compile(r"  (-[a-z]\w*)\s+(\S.*?) \[([^\]]*)\](?: (.*?))?(?: \(default (.*)\))$")
EXIT = re.compile(r"Exit code: (.*)$")


class Option(NamedTuple):
    group: str
    name: str  # with its dash
    words: str
    unit: str  # of its value, or of what kind it is: `on/off`, `one of a|b`, `text`, `names, separated by commas`
    range: str
    default: str

    @property
    def choices(self):
        """The words that its value may be, if only some are."""
        return ["on", "off"] if self.unit == "on/off" else self.unit[7:].split("|") if self.unit.startswith("one of ") else []


def ask(program, question):
    """Lines of an answer that no option of the caller's surroundings is in."""
    plain = {name: value for name, value in environment().items() if not name.startswith("PETSC_OPTIONS")}
    with tempfile.TemporaryDirectory() as home:
        alone = {"HOME": home, "OMPI_MCA_ess_singleton_isolated": "1", "OMPI_MCA_orte_tmpdir_base": home}  # starts in half the time
        return subprocess.run([os.path.abspath(program), question], cwd=home, env=plain | alone, capture_output=True, text=True,
                              check=True).stdout.splitlines()


def options(program):
    """(every Option in the order of -help, what it says of exit codes)."""
    found, group, codes = [], None, ""
    for line in ask(program, "-help"):
        match = OPTION.match(line)
        if match and group is not None:
            found.append(Option(group, *(text or "" for text in match.groups())))
        elif line.startswith("pulmo's own options"):
            group = ""
        elif EXIT.match(line):
            codes = EXIT.match(line)[1]
        elif line:
            group = line if group is not None else None
    return found, codes


def listed(program):
    """(kind, names, the rest) of each line of -list."""
    return [tuple(line.split(maxsplit=2)) for line in ask(program, "-list")]
