"""The folders of the code: includes run one way, every source says what it is for, and tools are doors to modules."""
import os
import re
import unittest

import pulmo_case as case

# A folder includes itself and those before it.
FOLDERS = ["base", "input", "mesh", "physics", "fem", "solvers", "time", "observers", "adjoint", "program"]
# What a kernel is made of knows no mesh, no options file and no solver.
KERNELS = ["kinematics", "point", "tissue_law", "permeability"]
# A tool reads its command line and calls the modules of a folder beside it.
DOOR = 80  # lines at most
ALONE = {"setup": "one shell script, which runs where nothing is installed yet"}
INCLUDE = re.compile(r'#include "pulmo/([\w/]+)\.hpp"')


def sources():
    """(path, folder) of every header and source of the library."""
    for top in ("include/pulmo", "src"):
        for where, _, files in os.walk(os.path.join(case.SOURCE, top)):
            for name in sorted(files):
                path = os.path.relpath(os.path.join(where, name), case.SOURCE)
                parts = os.path.relpath(path, top).split(os.sep)
                if name.endswith((".hpp", ".cpp")) and parts[0] != "benchmark":
                    yield path, parts[0] if len(parts) > 1 else ""


def text_of(path):
    with open(os.path.join(case.SOURCE, path), encoding="utf-8") as f:
        return f.read()


def folder_of(header):
    """Of a header as it is included; the umbrella pulmo.hpp belongs to the program."""
    return header.split("/")[0] if "/" in header else "program"


class Layout(unittest.TestCase):
    def test_every_file_is_in_a_folder(self):
        loose = [path for path, folder in sources() if folder not in FOLDERS and path != "include/pulmo/pulmo.hpp"]
        self.assertEqual(loose, [])
        self.assertGreater(len(list(sources())), 100)

    def test_no_arrow_runs_back_up(self):
        wrong = []
        for path, folder in sources():
            for header in INCLUDE.findall(text_of(path)):
                if FOLDERS.index(folder_of(header)) > FOLDERS.index(folder or "program"):
                    wrong.append(f"{path} includes {header}.hpp")
        self.assertEqual(wrong, [], "order of the folders: " + ", ".join(FOLDERS))

    def test_kernels_know_no_mesh(self):
        allowed = ("base/", "physics/", "input/options", "input/units")
        wrong = []
        for path, folder in sources():
            name = os.path.splitext(os.path.basename(path))[0]
            if folder == "physics" and (name in KERNELS or "/tissue/" in path or "/permeability/" in path):
                wrong += [f"{path} includes {h}.hpp" for h in INCLUDE.findall(text_of(path)) if not h.startswith(allowed)]
        self.assertEqual(wrong, [])

    def test_laws_and_effects_do_not_know_each_other(self):
        wrong = []
        for path, _ in sources():
            if "/tissue/" in path or "/effects/" in path:
                wrong += [
                    f"{path} includes {h}.hpp"
                    for h in INCLUDE.findall(text_of(path))
                    if h.startswith(("physics/tissue/", "physics/effects/"))
                ]
        self.assertEqual(wrong, [])

    def test_every_file_says_what_it_is_for(self):
        silent = []
        for path, _ in sources():
            text = text_of(path)
            header = os.path.join("include/pulmo", os.path.splitext(os.path.relpath(path, "src"))[0] + ".hpp")
            if path.endswith(".hpp"):
                said = text.startswith("/// @file\n/// ")
            else:
                said = text.startswith("// ") or os.path.isfile(os.path.join(case.SOURCE, header))
            if not said:
                silent.append(path)
        self.assertEqual(silent, [])

    def tools(self):
        """(name, lines) of what a user calls."""
        folder = os.path.join(case.SOURCE, "tools")
        for name in sorted(os.listdir(folder)):
            if os.path.isfile(os.path.join(folder, name)):
                yield name, text_of(os.path.join("tools", name)).splitlines()

    def test_tools_are_doors(self):
        tall = {name: len(lines) for name, lines in self.tools() if len(lines) > DOOR}
        self.assertEqual(sorted(tall), sorted(ALONE), f"more than {DOOR} lines: {tall}; move the work to a folder of modules")

    def test_tools_and_their_modules_say_what_they_are_for(self):
        silent = [name for name, lines in self.tools() if not lines[0].startswith("#!") or lines[1][:2] not in ('""', "# ")]
        for where, _, files in os.walk(os.path.join(case.SOURCE, "tools")):
            for name in files:
                path = os.path.relpath(os.path.join(where, name), case.SOURCE)
                if name.endswith(".py") and not re.match(r'(#!.*\n)?"""', text_of(path)):
                    silent.append(path)
        self.assertEqual(silent, [])


if __name__ == "__main__":
    case.main()
