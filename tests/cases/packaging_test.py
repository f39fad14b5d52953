#!/usr/bin/python3
"""Debian packages, manual page, completion of bash, one number of the version, recipes (docs/packaging.md).

    packaging_test.py BUILD/pulmo CPACK BUILD

What takes a bare system is shown by tools/packaging/bare_root.py.
"""
import os
import re
import shutil
import stat
import subprocess
import sys
import types
import unittest

import yaml

import pulmo_case as pulmo

CPACK, BUILD = sys.argv[2:4]
PACKAGING = os.path.join(pulmo.SOURCE, "tools/packaging")


def call(*words, code=0, **arguments):
    run = subprocess.run([str(w) for w in words], text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                         **({"env": pulmo.alone()} | arguments))
    if run.returncode != code:
        raise AssertionError(f"code {run.returncode} instead of {code}: {words}\n{run.stdout}")
    return run.stdout


def text_of(*names):
    with open(os.path.join(pulmo.SOURCE, *names), encoding="utf-8") as file:
        return file.read()


def version():
    """The number in its one place."""
    return re.search(r"project\(pulmo VERSION (\d+\.\d+\.\d+)\s", text_of("CMakeLists.txt")).group(1)


def packages_of_setup(heading):
    """Packages of tools/setup below one of its comments, up to the next."""
    return re.search(rf"\n  # {heading}[^\n]*\n((?:  [^#\n]*\n)+)", text_of("tools/setup")).group(1).split()


def options_of_help():
    """{name: (words, default)} of pulmo's own, of a name that laws share the first."""
    found = {}
    for name, words, default in re.findall(r"^  (-\w+) +(.*) \[.*\(default (.*)\)$", pulmo.finished(["-help"]).out.split("pulmo's own options")[1],
                                           re.M):
        found.setdefault(name, (words, default))
    return found


@unittest.skipUnless(shutil.which("dpkg-shlibdeps"), "no Debian: its packages are made there")
class Packages(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder, cls.root, cls.fields, cls.paths = pulmo.scratch("debs"), pulmo.scratch("root"), {}, {}
        # this build, whatever its processor; nothing is built anew
        cls.pack = [CPACK, "-D", "CPACK_CMAKE_GENERATOR=Ninja", "-D", "CPACK_DEBIAN_COMPRESSION_TYPE=none", "-B", cls.folder]
        call(*cls.pack, "-D", "PULMO_PACKAGE_NATIVE=ON", cwd=BUILD)
        for name in os.listdir(cls.folder):
            if name.endswith(".deb"):
                path = os.path.join(cls.folder, name)
                control = call("dpkg-deb", "-f", path)
                fields = dict(re.findall(r"^(\S+): (.*(?:\n .*)*)", control, re.M))
                cls.fields[fields["Package"]] = fields
                listed = [line.split(None, 5) for line in call("dpkg-deb", "-c", path).splitlines()]
                cls.paths[fields["Package"]] = {words[5].split(" -> ")[0]: words for words in listed}
                call("dpkg-deb", "-x", path, cls.root)

    def test_what_they_say(self):
        self.assertEqual(set(self.fields), {"pulmo", "libpulmo-dev"})
        for fields in self.fields.values():
            self.assertEqual(fields["Version"], version())
            self.assertEqual(fields["Architecture"], call("dpkg", "--print-architecture").strip())
            with open(os.path.join(BUILD, "CMakeCache.txt")) as file:
                arch = re.search(r"^PULMO_ARCH:\w+=(.*)$", file.read(), re.M).group(1)
            self.assertIn(f"Compiled for processors of type: {arch}.", fields["Description"])

        def names(package, field):
            return {word.split()[0] for word in self.fields[package][field].split(", ")}

        linked = {name: call("dpkg", "-S", os.path.realpath(path)).split(":")[0]
                  for name, path in re.findall(r"^\s*lib(petsc|metis|muparser|hdf5)\S* => (\S+)", call("ldd", pulmo.PROGRAM), re.M)}
        self.assertEqual(set(linked), {"petsc", "metis", "muparser", "hdf5"})
        self.assertLessEqual(set(linked.values()) | {"openmpi-bin"}, names("pulmo", "Depends"))
        self.assertGreaterEqual(names("pulmo", "Recommends"), set(packages_of_setup("plots") + packages_of_setup("reports")))
        libraries = {name for name in packages_of_setup("solver") + packages_of_setup("expressions") if name.endswith("-dev")}
        self.assertEqual(names("libpulmo-dev", "Depends"), libraries - {"nlohmann-json3-dev"} | {"pkg-config"})

    def test_what_they_hold(self):
        of_program, of_library = (self.paths[name] for name in ("pulmo", "libpulmo-dev"))
        self.assertEqual([p for p in of_program.keys() | of_library.keys() if not p.startswith("./usr/")], [])
        self.assertEqual([p for p in of_program.keys() & of_library.keys() if not p.endswith("/")], [])
        for path, words in {**of_program, **of_library}.items():
            self.assertEqual(words[1], "root/root", path)
            self.assertNotIn("w", words[0][5] + words[0][8] if words[0][0] != "l" else "", path)
        self.assertEqual([p for p in of_program if p.endswith((".pyc", "__pycache__/"))], [])
        for path in ("bin/pulmo", "share/pulmo/tools/report", "share/pulmo/tools/packaging/slurm/pulmo.sbatch", "share/man/man1/pulmo.1",
                     "share/bash-completion/completions/pulmo", "share/pulmo/CITATION.cff"):
            self.assertIn("./usr/" + path, of_program)
        self.assertEqual(len([p for p in of_library if p.endswith(("/libpulmo.a", "/pulmo-config.cmake", "/pkgconfig/pulmo.pc"))]), 3)
        # texts know nothing of the machine that made them
        for where, _, files in os.walk(self.root):
            for name in files:
                if name.endswith((".cmake", ".pc", ".1")) or where.endswith("completions"):
                    with open(os.path.join(where, name)) as file:
                        self.assertNotRegex(file.read(), re.escape(pulmo.SOURCE) + "|" + re.escape(BUILD), name)

    def test_they_run_where_they_are_put(self):
        program, work = os.path.join(self.root, "usr/bin/pulmo"), pulmo.scratch("work")
        os.mkdir(work)
        self.assertIn(f"pulmo {version()} (PETSc", call(program, "-version"))
        said = call(program, cwd=work, code=1)
        example = re.search(r"\n\n  (.*?)\n\n", said, re.S).group(1)
        self.assertEqual(example.count(f"{self.root}/usr/share/pulmo/"), 3, example)
        call("sh", "-c", example + " -ts_max_time 0.05", cwd=work)
        self.assertTrue(os.path.exists(os.path.join(work, "first_breath/summary.json")))
        self.assertTrue(os.path.samefile(os.path.join(self.root, "usr/share/pulmo/build/pulmo"), program))
        for tool in "report", "lung_mesh":
            self.assertIn("usage:", call(os.path.join(self.root, "usr/share/pulmo/tools", tool), "--help"))

    def test_a_program_for_this_processor_alone_is_refused(self):
        with open(os.path.join(BUILD, "CPackConfig.cmake")) as file:
            config = re.sub(r'(set\(CPACK_PULMO_ARCH) ".*"\)', r'\1 "native")', file.read())
        path = pulmo.scratch("CPackConfig.cmake")
        with open(path, "w") as file:
            file.write(config)
        said = " ".join(call(*self.pack, "--config", path, cwd=BUILD, code=1).split())
        self.assertIn("for the processor of this machine", said)
        self.assertIn("-DPULMO_ARCH=x86-64-v2", said)


class Manual(unittest.TestCase):
    """The manual page and the completion, against what the program tells."""

    @classmethod
    def setUpClass(cls):
        cls.folder = pulmo.scratch("manual")
        call(os.path.join(PACKAGING, "manual.py"), pulmo.PROGRAM, cls.folder)
        with open(os.path.join(cls.folder, "pulmo.1"), encoding="utf-8") as file:
            cls.page = file.read().replace("\\-", "-")
        cls.options = options_of_help()

    def complete(self, *words, folder=None):
        """What bash offers for the last word."""
        script = '. "$0"; COMP_WORDS=(pulmo "$@"); COMP_CWORD=$#; _pulmo; printf "%s\\n" "${COMPREPLY[@]}"'
        return set(call("bash", "-c", script, os.path.join(self.folder, "pulmo.bash"), *words, cwd=folder).splitlines()) - {""}

    def test_every_option_is_in_both(self):
        self.assertGreater(len(self.options), 120)
        for name, (words, default) in self.options.items():
            self.assertRegex(self.page, rf"\.TP\n\\fB{name}\\fR .*\n{re.escape(words)}.*default {re.escape(default)}\)\n", name)
        self.assertLessEqual(set(self.options) | {"-options_file", "-dm_plex_filename", "-help", "-list", "-version"}, self.complete(""))
        self.assertEqual(self.complete("-tiss"), {name for name in self.options if name.startswith("-tiss")})

    def test_laws_and_effects_are_in_the_page(self):
        for line in call(pulmo.PROGRAM, "-list").splitlines():
            kind, names, about = line.split(None, 2)
            if kind != "example":
                self.assertTrue(f".B {names.replace('|', ', ')}\n{about}\n" in self.page, names)

    def test_values_are_completed(self):
        laws = {name for law, alias in pulmo.common.offered(pulmo.PROGRAM, "tissue").items() for name in (law, alias) if name}
        self.assertEqual(self.complete("-tissue", ""), laws)
        self.assertEqual(self.complete("-tissue", "yo"), {"yoshihara"})
        self.assertEqual(self.complete("-airflow_permeability_law", ""), set(pulmo.common.offered(pulmo.PROGRAM, "permeability")))
        self.assertEqual(self.complete("-gravity", ""), {"on", "off"})
        self.assertEqual(self.complete("-gravity", "-gravity_a"), {"-gravity_acceleration", "-gravity_air_density"})
        self.assertEqual(self.complete("-ventilator_pip", ""), set())
        folder = pulmo.scratch("files")
        os.mkdir(folder)
        for name in "my scene.opts", "my.msh", "other":
            open(os.path.join(folder, name), "w").close()
        for option in "-options_file", "-dm_plex_filename", "-ventilator_programme", "-restart", "-output_dir":
            self.assertEqual(self.complete(option, "my", folder=folder), {"my scene.opts", "my.msh"})

    @unittest.skipUnless(shutil.which("groff"), "no groff")
    def test_the_page_is_formatted_without_a_complaint(self):
        self.assertEqual(call("groff", "-z", "-ww", "-man", "-Tutf8", os.path.join(self.folder, "pulmo.1")), "")


class Version(unittest.TestCase):
    """One number, in one place; what repeats it is held to it."""

    def test_the_number_is_the_same_everywhere(self):
        self.assertIn(f"pulmo {version()} (PETSc", call(pulmo.PROGRAM, "-version"))
        citation = yaml.safe_load(text_of("CITATION.cff"))
        self.assertEqual(str(citation["version"]), version())
        heading = re.search(r"^## \[(.*?)\] - (\S+)$", text_of("CHANGELOG.md"), re.M)
        self.assertEqual(heading.group(1), version())
        self.assertRegex(heading.group(2), r"^(Unreleased|\d{4}-\d\d-\d\d)$")
        self.assertEqual(str(citation.get("date-released", "Unreleased")), heading.group(2))

    @unittest.skipUnless(os.path.exists(os.path.join(pulmo.SOURCE, ".git")) and shutil.which("git"), "no clone")
    def test_a_tag_is_of_a_version_with_a_date(self):
        """And what is built after it has another number."""
        def tags(*which):
            return call("git", "-C", pulmo.SOURCE, "-c", "safe.directory=*", "tag", "--list", "v*.*.*", *which).split()

        own = f"v{version()}"
        if own in tags():
            self.assertIn(own, tags("--points-at", "HEAD"), f"{own} is out: raise the number in CMakeLists.txt (CONTRIBUTING.md)")
            self.assertNotIn(f"## [{version()}] - Unreleased", text_of("CHANGELOG.md"))
        else:
            self.assertEqual(tags("--points-at", "HEAD"), [])

    def test_the_citation_is_whole(self):
        """The keys that the format's schema (1.2.0) demands, and no key that it does not know."""
        known = {"abstract", "authors", "cff-version", "commit", "contact", "date-released", "doi", "identifiers", "keywords", "license",
                 "license-url", "message", "preferred-citation", "references", "repository", "repository-artifact", "repository-code",
                 "title", "type", "url", "version"}
        citation = yaml.safe_load(text_of("CITATION.cff"))
        self.assertLessEqual({"cff-version", "message", "title", "authors"}, set(citation))
        self.assertLessEqual(set(citation), known)
        self.assertEqual((citation["cff-version"], citation["type"]), ("1.2.0", "software"))
        for entry in [citation, *citation["references"]]:
            self.assertTrue(entry["authors"])
            for author in entry["authors"]:
                self.assertTrue("name" in author or {"family-names", "given-names"} <= set(author), author)
        paper, = citation["references"]
        self.assertLessEqual({"type", "title", "authors"}, set(paper))
        cited = text_of("tools/reports/sections/cite.py")  # what reports say
        for word in (paper["journal"], str(paper["year"]), str(paper["start"]), paper["authors"][0]["family-names"]):
            self.assertIn(word, cited)


class Recipes(unittest.TestCase):
    def test_spack(self):
        """Without Spack: Python takes it, and it asks for what the build asks for."""
        told = []
        module = types.ModuleType("spack.package")

        class CMakePackage:
            def define(self, name, value):
                return f"-D{name}={value}"

        module.CMakePackage = CMakePackage
        for name in "license", "version", "depends_on":
            setattr(module, name, lambda *words, name=name, **more: told.append((name, *words)))
        path = "tools/packaging/spack/packages/pulmo/package.py"
        sys.modules["spack"], sys.modules["spack.package"] = types.ModuleType("spack"), module
        try:
            scope = {}
            exec(compile(text_of(path), path, "exec"), scope)
        finally:
            del sys.modules["spack"], sys.modules["spack.package"]
        self.assertIn(("version", version()), told)
        self.assertIn(f"pulmo@={version()}", scope["__doc__"])
        needs = {re.match(r"[\w-]+", words[1]).group(): words[1] for words in told if words[0] == "depends_on"}
        self.assertLessEqual({"cmake", "pkgconfig", "mpi", "petsc", "hdf5", "metis", "muparser", "nlohmann-json", "cxx", "python"}, set(needs))
        self.assertIn(re.search(r"cmake_minimum_required\(VERSION (\S+)\)", text_of("CMakeLists.txt")).group(1), needs["cmake"])
        least = re.search(r"PETSC_VERSION VERSION_LESS (\S+)\)", text_of("src/cmake/FindPETSc.cmake")).group(1)
        self.assertIn(f"@{least}:", needs["petsc"])
        for package in re.search(r"foreach\(package (.*?)\)", text_of("src/cmake/FindPETSc.cmake")).group(1).lower().split():
            self.assertIn(f"+{package}", needs["petsc"])
        for flag in scope["Pulmo"]().cmake_args():
            self.assertRegex(text_of("CMakeLists.txt"), rf"\b{flag[2:].split('=')[0]}\b")

    def test_container(self):
        """Its first stage installs what a build takes."""
        build = text_of("tools/packaging/container/Containerfile").split("\nFROM")[1]
        installed = set(re.search(r"apt-get install (.*?)\nCOPY", build, re.S).group(1).replace("\\\n", " ").split())
        takes = packages_of_setup("compiler") + packages_of_setup("solver") + packages_of_setup("expressions")
        self.assertLessEqual({name for name in takes if not name.startswith(("openmpi-bin", "libopenblas"))} | {"python3", "file"}, installed)

    def test_slurm(self):
        """A job that is warned before its time is up queues again and goes on, until the run is that of one that had the time."""
        folder = pulmo.scratch("bin")
        os.mkdir(folder)
        work = os.path.dirname(folder)
        # Slurm warns the batch script some steps after the start, as long as that file is there
        tools = {"srun": f'#!/bin/bash\n[ ! -e {work}/late ] || {{ rm {work}/late; (until [ -s {work}/run/signals.csv.part ] && '
                         f'[ $(wc -l < {work}/run/signals.csv.part) -gt 3 ]; do sleep 0.01; done; kill -USR1 $PPID) & }}\nexec "$@"\n',
                 "scontrol": f'#!/bin/bash\necho "$@" >> {work}/requeued\n', "pulmo": f'#!/bin/bash\nexec {pulmo.PROGRAM} "$@"\n'}
        for name, text in tools.items():
            with open(os.path.join(folder, name), "w") as file:
                file.write(text)
            os.chmod(file.name, stat.S_IRWXU)
        scene = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "1.2"]
        environment = pulmo.alone() | dict(PATH=f"{folder}:{os.environ['PATH']}", SLURM_JOB_ID="77")

        def job(code):
            return call("bash", os.path.join(PACKAGING, "slurm/pulmo.sbatch"), os.path.join(work, "run"), *scene, env=environment, code=code)

        open(os.path.join(work, "late"), "w").close()
        self.assertIn("queues again", job(3))
        with open(os.path.join(work, "requeued")) as file:
            self.assertEqual(file.read(), "requeue 77\n")
        job(0)
        whole = pulmo.finished(scene)
        with open(os.path.join(work, "run/signals.csv")) as ours, open(whole.path("signals.csv")) as theirs:
            self.assertEqual(ours.read(), theirs.read())
        job(1)  # a finished run is kept, and no job queues again for that
        with open(os.path.join(work, "requeued")) as file:
            self.assertEqual(file.read(), "requeue 77\n")
        self.assertIn("sbatch [options of sbatch]", call("bash", os.path.join(PACKAGING, "slurm/pulmo.sbatch"), code=1))
        warning = re.search(r"^#SBATCH --signal=B:(\w+)@(\d+)$", text_of("tools/packaging/slurm/pulmo.sbatch"), re.M)
        self.assertEqual(warning.group(1), "USR1")


if __name__ == "__main__":
    pulmo.main()
