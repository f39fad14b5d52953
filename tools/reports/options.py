#!/usr/bin/python3
"""What options and effects mean, for reports where no program is at hand: options.csv, made by

    tools/reports/options.py build/pulmo

of what the program says of itself. An option or effect that is not in it is shown without unit or words.
"""
import csv
import functools
import re
import subprocess
import sys
from pathlib import Path

TABLE = Path(__file__).parent / "options.csv"


def told(program):
    """[(kind, name, unit, words)] of the program's -help and -list."""
    said = {}
    for line in subprocess.run([program, "-help"], capture_output=True, text=True, check=True).stdout.splitlines():
        match = re.match(r"  -([a-z]\w*)\s{2,}(\S.*?) \[([^\]]*)\]( |$)", line)
        if match:
            unit = match[3] if not re.match(r"-$|on/off|one of|text|names|whole|numbers", match[3]) else ""
            said.setdefault(("option", match[1]), (unit, match[2]))
    for line in subprocess.run([program, "-list"], capture_output=True, text=True, check=True).stdout.splitlines():
        kind, name, words = (line.split(None, 2) + [""])[:3]
        if kind == "effect":
            said[kind, name] = ("", words)
    return [(*key, *value) for key, value in sorted(said.items())]


@functools.cache
def table():
    """{(kind, name): (unit, words)}."""
    with open(TABLE, newline="") as f:
        return {(row["kind"], row["name"]): (row["unit"], row["words"]) for row in csv.DictReader(f)}


def unit(option):
    """Unit of an option's value, of that of a surface or volume too: -chest_wall_stiffness_pleura."""
    words = option.lstrip("-").split("_")
    for length in range(len(words), 0, -1):
        found = table().get(("option", "_".join(words[:length])))
        if found:
            return pretty(found[0])
    return ""


def pretty(unit):
    """A unit as people write it: cmH₂O, mm², kg/m³."""
    return unit.replace("H2O", "H₂O").replace("^2", "²").replace("^3", "³")


def effect(name):
    """What an effect is, in words."""
    return table().get(("effect", name), ("", ""))[1]


def given(options, effect_name):
    """[(name, value, unit)] of an effect's own options as the run used them, defaults included."""
    return [(name[len(effect_name) + 2:].replace("_", " "), value, unit(name)) for name, value in options.items()
            if name.startswith(f"-{effect_name}_") and value != ""]


if __name__ == "__main__":
    with open(TABLE, "w", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(("kind", "name", "unit", "words"))
        writer.writerows(told(sys.argv[1]))
