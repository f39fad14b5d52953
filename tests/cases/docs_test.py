#!/usr/bin/python3
"""The pages for users: commands run, links lead somewhere, options exist, messages are those that the program gives.

Commands are run in a short form: pulmo with -scene_view_only, which reads and checks all that a run does, and the cheapest elements; tools up
to where work would begin. Files that a reader would bring (a mask, a mesh, a programme, finished runs) are stand-ins.
"""
import glob
import importlib.machinery
import importlib.util
import os
import re
import shlex
import shutil
import sys
import unittest
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import input_errors_test
import pulmo_case as pulmo
from breathing import command as breathe
from meshing import lung_command
from reports import command as report_command

PETSC = ("dm_", "fieldsplit_", "ksp_", "log_", "mat_", "npc_", "options_", "pc_", "petscfe_", "petscpartitioner_", "prefix_p", "skip_petscrc", "snes_",
         "ts_", "version")
# of compilers and gmsh; mistakes, gaps and examples that the text speaks of
OTHERS = {"march", "order", "format", "setnumber", "help", "list", "new", "old", "name", "lemon", "peep", "any_option", "drag_viscosity"}
BY_SURFACE = ("support_components_", "support_displacement_")  # -help has them for the surfaces of a scene
# what stands for the options that a page leaves out, with a manoeuvre if the page names none
LEFT_OUT = ["-dm_plex_filename", "meshes/lung_test.msh", "-options_file", "petsc_options/solvers/iterative.opts"]
MANOEUVRE = ["-options_file", "petsc_options/scenes/pcv.opts"]


def page(name):
    with open(os.path.join(pulmo.SOURCE, name), encoding="utf-8") as f:
        return f.read()


def named(*patterns):
    return sorted(os.path.relpath(path, pulmo.SOURCE) for p in patterns for path in glob.glob(os.path.join(pulmo.SOURCE, p), recursive=True))


GUIDES = named("README.md", "docs/*.md", "docs/effects/*.md")
ALL = named("README.md", "docs/**/*.md", "tests/**/*.md", "meshes/*.md")


def without_fences(text):
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)


def commands(text):
    """Command lines of the indented blocks, those that go on in the next line joined."""
    lines = re.sub(r"\\\n\s*", " ", without_fences(text)).splitlines()
    return [line.strip() for line in lines if re.match(r"    (mpiexec -n \d+ )?(build/pulmo|tools/\w+)(\s|$)", line)]


def of_all(tool):
    """(page, words) of each command of a tool, none twice."""
    seen = {}
    for name in GUIDES:
        for line in commands(page(name)):
            words = re.sub(r"^mpiexec -n \d+ ", "", line)
            if words.split()[0] == tool:
                seen.setdefault(tuple(shlex.split(words, comments=True)[1:]), name)
    return [(name, list(words)) for words, name in seen.items()]


def filled(words):
    """With what stands for a gap."""
    for gap in ("...", "$OPTIONS"):
        if gap in words:
            at = words.index(gap)
            whole = any(re.search(r"^-ventilator ", page(w), re.M) for w in words if w.startswith("petsc_options/"))
            words = words[:at] + LEFT_OUT + ([] if whole else MANOEUVRE) + words[at + 1:]
    return words


def door_of(tool):
    """The script of a tool as a module."""
    loader = importlib.machinery.SourceFileLoader(f"door_of_{tool}", os.path.join(pulmo.SOURCE, "tools", tool))
    door = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(door)
    return door


def anchors(text):
    """Of the headings, as GitHub names them, and those that a page sets itself."""
    found = set(re.findall(r'<a (?:name|id)="(.*?)"', text))
    for title in re.findall(r"^#+ +(.*)$", without_fences(text), re.M):
        title = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).lower()
        anchor = re.sub(r"[^\w\- ]", "", title).replace(" ", "-")
        number = 1
        while anchor in found:
            anchor, number = f"{re.sub(r'-[0-9]+$', '', anchor) if number > 1 else anchor}-{number}", number + 1
        found.add(anchor)
    return found


class Links(unittest.TestCase):
    def targets(self, name):
        text = re.sub(r"`[^`\n]*`", "", without_fences(page(name)))
        return [t for t in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"\w+:", t)]

    def test_they_lead_to_files_and_headings(self):
        wrong, count = [], 0
        for name in ALL:
            for target in self.targets(name):
                path, _, anchor = target.partition("#")
                to = os.path.normpath(os.path.join(os.path.dirname(name), path)) if path else name
                count += 1
                if not os.path.exists(os.path.join(pulmo.SOURCE, to)) or (anchor and anchor not in anchors(page(to))):
                    wrong.append(f"{name}: {target}")
        self.assertEqual(wrong, [], "\n".join(wrong))
        self.assertGreater(count, 200)

    def test_the_index_has_every_page(self):
        listed = {os.path.normpath(os.path.join("docs", t.partition("#")[0])) for t in self.targets("docs/README.md")}
        self.assertEqual([name for name in named("docs/*.md") if name not in listed and name != "docs/README.md"], [])


class Commands(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        """A folder with what a reader has: the source tree's, and files of the names that the pages use."""
        cls.here = pulmo.scratch()
        os.makedirs(cls.here)
        for name in ("meshes", "petsc_options", "tools"):
            os.symlink(os.path.join(pulmo.SOURCE, name), os.path.join(cls.here, name))
        os.symlink(pulmo.mesh("lung_test.msh"), cls.path("my.msh"))
        programme = re.search(r"```programme\n(.*?)```", page("docs/ventilator.md"), re.S)[1]
        for name, text in (("mine.txt", programme), ("my_programme.txt", programme), ("labels.nii.gz", "")):
            with open(cls.path(name), "w") as f:
                f.write(text)

    @classmethod
    def path(cls, name):
        return os.path.join(cls.here, name)

    def test_pulmo(self):
        # there is no failed run; replay_test has some
        found = [(name, words) for name, words in of_all("build/pulmo") if "-replay" not in words]
        self.assertGreater(len(found), 20)

        def told(words):
            words = filled(words)
            if "-restart" in words:  # there is no checkpoint; restart_test has one
                at = words.index("-restart")
                words = words[:at] + words[at + 2:]
            return pulmo.Case([w for w in words if w != "-dry_run"] + ["-elements", "P1-P1", "-scene_view_only"], directory="-", cwd=self.here)

        with ThreadPoolExecutor(4) as pool:
            for (name, words), case in zip(found, pool.map(told, [words for _, words in found])):
                with self.subTest(page=name, command=" ".join(words)):
                    self.assertEqual(case.code, 0, case.tail())
                    self.assertIn("In this scene", case.out)
                    self.assertNotIn("was not used", case.out)

    def test_breathe(self):
        """Words, scene and solver are taken; a folder is one that an earlier command of the page makes."""
        found = of_all("tools/breathe")
        self.assertGreater(len(found), 3)
        here, made = os.getcwd(), set()
        os.chdir(self.here)
        try:
            for name, words in found:
                with self.subTest(page=name, command=" ".join(words)):
                    given = breathe.parse(words + ([] if "--" in words else ["--build", os.path.dirname(pulmo.PROGRAM)]))
                    if str(given.source) in made:
                        continue
                    self.assertTrue(given.source.exists(), f"{given.source} is none of the files of this test")
                    self.assertGreater(len(breathe.scene_words(given) + breathe.own_words(given)), 1)
                    self.assertTrue(breathe.solver_file(given.solver).is_file())
                    made.add(str(given.case or f"results/{breathe.stem(given.source)}-{given.mode}"))
        finally:
            os.chdir(here)

    def test_lung_mesh(self):
        found = of_all("tools/lung_mesh")
        self.assertGreater(len(found), 3)
        for name, words in found:
            with self.subTest(page=name, command=" ".join(words)):
                lung_command.check_route(lung_command.parse(words))

    def test_report(self):
        """Runs are read, nothing is drawn."""
        found = of_all("tools/report")
        self.assertGreater(len(found), 3)
        run = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + pulmo.QUIET + ["-ts_max_time", "0.1"])
        drawn, here = [], os.getcwd()
        for name in "write_page", "write_figure", "write_animation":
            patch = mock.patch.object(report_command, name, lambda runs, path: drawn.append(path))
            patch.start()
            self.addCleanup(patch.stop)
        os.chdir(self.here)
        try:
            for name, words in found:
                with self.subTest(page=name, command=" ".join(words)):
                    for folder in [w for w in words if w.startswith("results/") and "." not in w]:
                        if not os.path.isdir(folder):
                            shutil.copytree(run.directory, folder)
                    before = len(drawn)
                    report_command.main(words)
                    self.assertEqual(len(drawn), before + 1)
        finally:
            os.chdir(here)

    def test_export(self):
        """Words are taken, nothing is written."""
        found = [(name, words) for name, words in of_all("tools/export") if words != ["--help"]]
        self.assertGreater(len(found), 3)
        door, taken = door_of("export"), []
        door.export = taken.append
        for name, words in found:
            with self.subTest(page=name, command=" ".join(words)), mock.patch.object(sys, "argv", ["export", *words]):
                door.main()
                self.assertEqual(taken[-1].directory, words[0])

    def test_tools_that_pages_name_are_there(self):
        for name in ALL:
            for tool in set(re.findall(r"(?<![\w/])tools/(\w+)\b(?!/)", page(name))):
                self.assertTrue(os.path.exists(os.path.join(pulmo.SOURCE, "tools", tool)), f"{name}: tools/{tool}")


class Words(unittest.TestCase):
    def test_options_exist(self):
        """In code spans that begin with a dash, and in commands of pulmo; those of surfaces and regions by what they begin with."""
        help_text = pulmo.Case(["-help"], directory="-").out
        known = set(re.findall(r"^  -(\w+) ", help_text, re.M))
        self.assertGreater(len(known), 150)
        by_surface = BY_SURFACE + tuple(name.removesuffix("pleura") for name in known if name.endswith("_pleura"))
        wrong, count = [], 0
        for name in GUIDES:
            text = without_fences(page(name))
            if name.endswith("troubleshooting.md"):  # its messages are those of mistakes
                text = re.sub(r"^\| `.*?` ", "| ", text, flags=re.M)
            spans = [s for s in re.findall(r"`([^`\n]+)`", text) if s.startswith("-")]
            spans += [" ".join(words) for line in commands(text) if "build/pulmo" in line for words in [line.split()]]
            for option in {o for span in spans for o in re.findall(r"(?:^|\s)-([a-z]\w+)(?![\w*…])", span)}:
                count += 1
                if not (option in known or option in OTHERS or option.startswith(PETSC) or option.startswith(by_surface) or option.endswith("_")):
                    wrong.append(f"{name}: -{option}")
        self.assertEqual(wrong, [], "\n".join(wrong))
        self.assertGreater(count, 300)


class Messages(unittest.TestCase):
    """Those of docs/troubleshooting.md: run where the page names a mistake of input_errors_test, else found in the sources."""

    @classmethod
    def setUpClass(cls):
        text = page("docs/troubleshooting.md")
        # "… `message` <!-- mistake --> | what is behind it |"
        cls.messages = re.findall(r"^\| `([^`]+)`(?: <!-- (.*?) -->)? \|", text.partition("## The machine")[0], re.M)

    def test_mistakes(self):
        made = [(message, mistake) for message, mistake in self.messages if mistake]
        self.assertGreater(len(made), 25)
        table = input_errors_test.table(input_errors_test.meshes())
        self.assertEqual([mistake for _, mistake in made if mistake not in table], [])
        with ThreadPoolExecutor(4) as pool:
            cases = pool.map(lambda row: pulmo.Case(table[row[1]][0], directory=pulmo.scratch()), made)
            for (message, mistake), case in zip(made, cases):
                with self.subTest(mistake):
                    pattern = "pulmo: error: " + ".*".join(re.escape(part) for part in message.split("…")) + ("$" if not message.endswith("…") else "")
                    self.assertRegex(case.err, re.compile(pattern, re.M))
                    self.assertEqual(case.code, 1)

    def test_the_others_are_in_the_sources(self):
        sources = "\n".join(page(name) for name in named("src/**/*.cpp", "include/**/*.hpp", "tools/**/*.py"))
        sources = re.sub(r'"\s*f?"', "", sources)  # a literal that goes on in the next line
        others = [message for message, mistake in self.messages if not mistake]
        self.assertGreater(len(others), 15)
        for message in others:
            for part in (part.strip() for part in message.split("…")):
                self.assertTrue(part in sources, f"'{part}' of '{message}' is in no source")


if __name__ == "__main__":
    pulmo.main()
