"""What the labels of a segmented CT mean: by option, by the names that come with the file, by the numbers of known programs."""
import json
import re
import xml.etree.ElementTree

from .mesh import MeshError

LOBES = {"right": ["upper", "middle", "lower"], "left": ["upper", "lower"]}
PARTS = ["right", "left"] + [f"{side}_{lobe}" for side, lobes in LOBES.items() for lobe in lobes] + ["lungs", "airway"]
SHORT = {f"{side[0]}{lobe[0]}l": f"{side}_{lobe}" for side, lobes in LOBES.items() for lobe in lobes}  # rul, lll, ...
WORDS = {"right": "right", "rt": "right", "r": "right", "left": "left", "lt": "left", "l": "left", "upper": "upper",
         "superior": "upper", "middle": "middle", "lower": "lower", "inferior": "lower"}
AIRWAY = {"airway", "airways", "trachea", "bronchi", "bronchus", "bronchia", "bronchial", "bronchus_tree"}
PLAIN = {"lung", "lungs", "lobe", "pulmonary", "main", "tree", "and", "of", "the"}
EXAMPLE = "--labels right=1,left=2,airway=3+4"

# Numbers of known programs: {part: number}. TotalSegmentator's task `total` in its two versions (map_to_binary.py), lungmask.
NUMBERS = {
    "TotalSegmentator 2": dict(left_upper=10, left_lower=11, right_upper=12, right_middle=13, right_lower=14, airway=16),
    "TotalSegmentator 1": dict(left_upper=13, left_lower=14, right_upper=15, right_middle=16, right_lower=17, airway=43),
    "lungmask's lobes": dict(left_upper=1, left_lower=2, right_upper=3, right_middle=4, right_lower=5),
    "lungmask": dict(right=1, left=2),
}


def part_of(name):
    """The part that a name means (one of PARTS), or None: 'lung_upper_lobe_left' is left_upper, 'rib_left_3' nothing."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
    if not words:
        return None
    if set(words) & AIRWAY:
        return "airway" if set(words) <= AIRWAY | PLAIN | {"right", "left"} else None
    if len(words) == 1 and words[0] in SHORT:
        return SHORT[words[0]]
    if not set(words) <= PLAIN | set(WORDS):
        return None
    found = [WORDS[word] for word in words if word in WORDS]
    part = "_".join(sorted(found, key=lambda word: word not in LOBES))
    if not found and set(words) & {"lung", "lungs"}:
        return "lungs"
    if part in LOBES and ("lobe" in words or not set(words) & PLAIN and len(words[0]) < 3):
        return None  # a lobe, but which; or a lone letter
    return part if part in PARTS else None


def side_of(part):
    """right, left or None."""
    return next((side for side in LOBES if part.startswith(side)), None)


def is_pair(parts):
    """Whether the parts are those of both lungs."""
    return "lungs" in parts or {side_of(part) for part in parts} >= set(LOBES)


def listed(present):
    """What there is, for a message. present: the Labels of an image."""
    shown = sorted(present, key=lambda number: -present[number].volume)[:12]
    more = f" and {len(present) - len(shown)} more" if len(present) > len(shown) else ""
    return ", ".join(f"{n} ({present[n].volume:.3g} ml)" for n in shown) + more


def from_option(text, present, names):
    """{part: numbers} of --labels."""
    parts = {}
    for word in text.split(","):
        name, equals, numbers = word.partition("=")
        part = name.strip() if name.strip() in PARTS else part_of(name)
        if not equals or not part or part in parts:
            raise MeshError(f"--labels: '{word}' is no PART=NUMBER, or the part is there twice; parts are {', '.join(PARTS)}, "
                            f"as in {EXAMPLE}.")
        parts[part] = []
        for number in numbers.split("+"):
            number = number.strip()
            known = [n for n, other in names.items() if other == number]
            if not known and not re.fullmatch(r"[0-9]+", number):
                raise MeshError(f"--labels: '{number}' in '{word}' is neither the number nor the name of a label; there are "
                                f"{listed(present)}.")
            value = known[0] if known else int(number)
            if value not in present:
                raise MeshError(f"--labels {word}: no voxel has label {value}; there are {listed(present)}.")
            parts[part].append(value)
    return parts


def from_names(names, present, say):
    """{part: numbers} of {number: name}; numbers that no voxel has are left out, which is told."""
    parts = {}
    for number, name in names.items():
        part = part_of(name)
        if part and number in present:
            parts.setdefault(part, []).append(number)
        elif part:
            say(f"no voxel has the label of {name} ({number}).")
    return parts


def fits(numbers, present):
    """Whether the numbers of a program can be meant: all lungs or lobes are there, none tiny, and each on its side."""
    lungs = {part: present.get(number) for part, number in numbers.items() if part != "airway"}
    if not all(lungs.values()):
        return False
    total = sum(label.volume for label in lungs.values())
    middle = {side: [label.centre[0] for part, label in lungs.items() if side_of(part) == side] for side in LOBES}
    apart = min(middle["right"]) - max(middle["left"])
    return min(label.volume for label in lungs.values()) > 0.02 * total and apart > 0.25 * (total * 1e3) ** (1 / 3)


def from_numbers(present):
    """{part: numbers} by the numbers of the one known program that fits, and its name; or nothing."""
    fitting = [program for program, numbers in NUMBERS.items() if fits(numbers, present)]
    if len(fitting) == 1:
        numbers = NUMBERS[fitting[0]]
        return {part: [number] for part, number in numbers.items() if number in present}, fitting[0]
    return {}, None


def find_parts(present, names, asked, say):
    """{part: numbers of labels} of an image.

    present: {number: Label}. names: {number: name} that came with the file. asked: --labels or None. say: tells a note.
    """
    if asked:
        return checked(from_option(asked, present, names))
    named = from_names(names, present, say)
    parts, how = named, "labels by the names that come with the file"
    others = [number for number in present if number not in named.get("airway", [])]
    if set(named) <= {"airway"}:
        parts, program = from_numbers(present)
        how = f"labels as {program}"
    if not parts and len(others) == 1:
        parts, how = {"lungs": others}, "there is only one label" + (" beside the airway's" if named else "")
    if parts:
        parts |= named
    else:
        raise MeshError(f"it cannot be told which labels are the lungs; there are {listed(present)}: say it, as in {EXAMPLE}.")
    say(how + ": " + ", ".join(f"{part}={'+'.join(map(str, numbers))}" for part, numbers in parts.items()) + ".")
    used = sum(parts.values(), [])
    unused = {number: label for number, label in present.items() if number not in used}
    if unused:
        hint = "" if "airway" in parts else "; if some are bronchi or trachea, name them with --labels ...,airway=NUMBER"
        say(f"not used: {listed(unused)}{hint}.")
    return checked(parts)


def checked(parts):
    """The parts, unless they contradict one another."""
    lungs = [part for part in parts if part != "airway"]
    if not lungs:
        raise MeshError(f"--labels names no lung; parts are {', '.join(PARTS)}, as in {EXAMPLE}.")
    for side in LOBES:
        if side in lungs and any(part.startswith(side + "_") for part in lungs):
            raise MeshError(f"the labels name the {side} lung and lobes of it; name the lobes only, or the lung only.")
    if "lungs" in lungs and len(lungs) > 1:
        raise MeshError("the labels name `lungs` (both under one number) and others; name right and left, or `lungs` only.")
    numbers = [number for part in parts.values() for number in part]
    twice = {number for number in numbers if numbers.count(number) > 1}
    if twice:
        raise MeshError(f"label {min(twice)} is named twice; each label is part of one thing.")
    return parts


def names_in(header):
    """{number: name} of a NIfTI header's table of labels (that of TotalSegmentator), if it has one."""
    names = {}
    for extension in header.extensions:
        content = extension.get_content()
        text = content.decode("utf-8", "replace") if isinstance(content, bytes) else str(content)
        try:
            root = xml.etree.ElementTree.fromstring(text.strip("\0 \n"))
        except xml.etree.ElementTree.ParseError:
            continue
        names |= {int(label.get("Key")): (label.text or "").strip() for label in root.iter("Label")
                  if (label.get("Key") or "").isdigit()}
    return names


def names_of_json(path):
    """{number: name} of a JSON file: {"1": "right lung"}, {"right lung": 1}, or one of these under "labels"."""
    try:
        with open(path, encoding="utf-8") as file:
            table = json.load(file)
        table = table.get("labels", table)
        names = {}
        for key, value in table.items():
            number, name = (key, value) if str(key).isdigit() else (value, key)
            for one in number if isinstance(number, list) else [number]:
                if str(one).isdigit() and isinstance(name, str):
                    names[int(one)] = name
    except (OSError, ValueError, AttributeError) as error:
        raise MeshError(f"{path} is not a JSON file of label names ({error}).") from error
    return names
