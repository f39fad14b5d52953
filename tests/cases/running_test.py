#!/usr/bin/python3
"""What surrounds a run (docs/running.md): where options come from, the exit code."""
import os
import re
import signal
import subprocess
import time
import unittest

import pulmo_case as pulmo

BARE = pulmo.CUBE + pulmo.PCV + ["-airflow_surfaces", "airway", "-progress", "off"]  # no solver yet
GOOD = BARE + pulmo.DIRECT
SHORT = ["-ts_max_time", "0.1"]
# a pull that no step survives
TOO_MUCH = ["-ventilator_pip", "1e6", "-ts_adapt_dt_min", "0.01"]
LONG = ["-ventilator_expiration", "5000"]


class ExitCodes(unittest.TestCase):
    """0 finished, 1 wrong input, 2 could not go on, 3 stopped by a signal and restartable."""

    def codes(self, options, ranks=2, stop=None):
        """The exit code of each rank, of the launcher, and what was said. `stop`: a signal, once there are rows."""
        folder = pulmo.scratch("codes")
        os.mkdir(folder)
        # so that no rank is stopped by the launcher before its code is known
        run = '"$@"; echo $? > ' + folder + "/$OMPI_COMM_WORLD_RANK; exit 0"
        command = pulmo.LAUNCHER + [str(ranks), "sh", "-c", run, "sh", pulmo.PROGRAM] + options
        process = subprocess.Popen(command + ["-output_dir", folder + "/run"], cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT,
                                   text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if stop:
            self.send_in_time(stop, folder + "/run", command[-len(options) - 1])
        _, err = process.communicate(timeout=120)
        found = {}
        for rank in range(ranks):
            with open(os.path.join(folder, str(rank))) as f:
                found[rank] = int(f.read())
        return [found[rank] for rank in range(ranks)], err

    @staticmethod
    def wait_for_rows(directory):
        path, end = os.path.join(directory, "signals.csv.part"), time.monotonic() + 60
        while time.monotonic() < end:
            if os.path.exists(path):
                with open(path) as f:
                    if len(f.readlines()) > 3:
                        return
            time.sleep(0.01)
        raise AssertionError("no rows")

    def send_in_time(self, stop, directory, program):
        self.wait_for_rows(directory)
        listed = subprocess.run(["ps", "-eo", "pid=,args="], text=True, stdout=subprocess.PIPE).stdout.splitlines()
        ranks = [line.split()[0] for line in listed if line.split()[1] == program and directory in line]
        self.assertTrue(ranks)
        os.kill(int(ranks[0]), stop)

    def test_every_rank_ends_with_the_code_of_the_kind(self):
        for options, code, stop in ((SHORT, 0, None), (["-tissue", "jelly"], 1, None), (TOO_MUCH, 2, None),
                                    (LONG, 3, signal.SIGUSR1)):
            with self.subTest(code):
                codes, err = self.codes(GOOD + options, stop=stop)
                self.assertEqual(codes, [code, code], err)
                self.assertEqual(err.count("pulmo: error:"), code > 0, err)

    def test_the_launcher_passes_it_on(self):
        for options, code in ((SHORT, 0), (["-tissue", "jelly"], 1), (TOO_MUCH, 2)):
            for ranks in (1, 2):
                with self.subTest(code, ranks=ranks):
                    case = pulmo.Case(GOOD + options, ranks=ranks, launch=True)
                    self.assertEqual(case.code, code, case.tail())
        directory = pulmo.scratch()
        process = subprocess.Popen(pulmo.LAUNCHER + ["2", pulmo.PROGRAM] + GOOD + LONG + ["-output_dir", directory],
                                   cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT, text=True, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE)
        self.wait_for_rows(directory)
        process.send_signal(signal.SIGUSR1)
        _, err = process.communicate(timeout=60)
        self.assertEqual(process.returncode, 3, err)
        self.assertIn("checkpoint.h5", os.listdir(directory))

    def test_a_crash_is_could_not_go_on(self):
        """Signals that a fault of the program raises, and those that arrive before a run heeds any."""
        for sent in (signal.SIGSEGV, signal.SIGFPE, signal.SIGABRT):
            with self.subTest(sent):
                directory = pulmo.scratch()
                process = subprocess.Popen([pulmo.PROGRAM] + GOOD + LONG + ["-output_dir", directory], cwd=pulmo.SOURCE,
                                           env=pulmo.ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                                           text=True)
                self.wait_for_rows(directory)
                process.send_signal(sent)
                _, err = process.communicate(timeout=60)
                self.assertEqual(process.returncode, 2, err)
                self.assertIn("signal %d" % sent, err)

    def test_help_tells_them(self):
        case = pulmo.finished(["-help"])
        self.assertIn("0 finished, 1 wrong input, 2 could not go on, 3 stopped by a signal", case.out)


class Sources(unittest.TestCase):
    """Options from files, the environment, .petscrc and YAML are read like those of the command line."""

    @classmethod
    def setUpClass(cls):
        cls.home = pulmo.scratch("home")
        cls.work = pulmo.scratch("work")
        os.mkdir(cls.home)
        os.mkdir(cls.work)

    def file(self, content, name="some.opts"):
        path = pulmo.scratch(name)
        with open(path, "wb") as f:
            f.write(content if isinstance(content, bytes) else content.encode())
        return path

    def run_with(self, options, ranks=1, **environment):
        """A run in an empty folder and home."""
        kept = dict(pulmo.ENVIRONMENT)
        pulmo.ENVIRONMENT.update(HOME=self.home, **environment)
        try:
            return pulmo.Case(GOOD + SHORT + options, ranks=ranks, cwd=self.work)
        finally:
            pulmo.ENVIRONMENT.clear()
            pulmo.ENVIRONMENT.update(kept)

    def expect(self, case, **used):
        self.assertEqual(case.code, 0, case.tail())
        options = case.json()["options"]
        for name, value in used.items():
            self.assertEqual(options["-" + name], value)
        return case.json()["option_sources"]

    def refused(self, case, *words):
        self.assertEqual(case.code, 1, case.tail())
        self.assertEqual(case.err.count("pulmo: error:"), 1, case.tail())
        self.assertEqual(len(case.err.strip().splitlines()), 1, case.tail())
        for word in words:
            self.assertIn(word, case.err)
        self.assertFalse(os.path.exists(case.directory))

    def test_line_ends_and_byte_order_marks(self):
        for end in "\r", "\n", "\r\n":
            text = f"# my patient{end}-ventilator_pip 3{end}-ventilator_peep 1{end}"
            for mark in b"", b"\xef\xbb\xbf":
                with self.subTest(end=end, mark=mark):
                    path = self.file(mark + text.encode())
                    sources = self.expect(self.run_with(["-options_file", path]), ventilator_pip="3", ventilator_peep="1")
                    self.assertEqual(sources["-ventilator_pip"], path)
                    self.assertEqual(sources["-airflow_surfaces"], "command line")
        self.refused(self.run_with(["-options_file", self.file("-ventilator_pip 3\n".encode("utf-16"))]), "some.opts", "UTF-16")
        self.refused(self.run_with(["-options_file", self.file("-ventilator_pip 3\n".encode("utf-16-le"))]), "line 1", "UTF-16")
        self.refused(self.run_with(["-options_file", self.file("-ventilator_pip\u00a03\n")]), "no-break space")

    def test_values_with_blanks_and_dashes(self):
        for name in "pcv -peep", "-x y", "run#3", "l'air", "Lunge \u00fc", "trailing/":
            with self.subTest(name):
                folder = os.path.join(pulmo.scratch("of"), name)
                parent = os.path.dirname(folder.rstrip("/"))
                os.mkdir(parent)
                os.chdir(parent)
                case = pulmo.Case(GOOD + SHORT + ["-checkpoint_every", "0.05", "-output_dir", folder], directory="-")
                self.assertEqual(case.code, 0, case.tail())
                case.directory = folder
                self.assertEqual(case.json()["options"]["-output_dir"], folder)
                again = pulmo.Case(GOOD + ["-ts_max_time", "0.15", "-output_overwrite", "-restart", folder + "/checkpoint.h5"] +
                                   ["-output_dir", folder], directory="-")
                self.assertEqual(again.code, 0, again.tail())
        # in a file, relative to the working directory
        case = self.run_with(["-options_file", self.file('-output_overwrite # "no"\n-output_dir "-a \'b"  # "x"\n')] +
                             ["-output_dir", pulmo.scratch()])
        self.assertEqual(case.code, 0, case.tail())
        path = self.file('-output_dir "-a \'b"  # "x"\n')
        case = pulmo.Case(GOOD + SHORT + ["-options_file", path], directory="-", cwd=self.work)
        self.assertEqual(case.code, 0, case.tail())
        self.assertIn("summary.json", os.listdir(os.path.join(self.work, "-a 'b")))
        case = pulmo.Case(GOOD + SHORT + ["-output_dir", "-x"], directory="-", cwd=self.work)
        self.assertEqual(case.code, 1)
        self.refused(self.run_with(["-options_file", self.file('-tissue "ma"x\n')]), "line 1", "closing quote")

    def test_long_folders(self):
        """Longer than what Open MPI 4.1 bears of a file that ranks write together."""
        for length in 230, 600:
            for ranks in 1, 2:
                with self.subTest(length, ranks=ranks):
                    folder = pulmo.scratch("x")
                    while len(folder) < length:
                        folder += "/" + "y" * min(200, length - len(folder))
                    case = pulmo.Case(GOOD + SHORT + ["-output_dir", folder, "-checkpoint_every", "0.1"], directory="-",
                                      ranks=ranks)
                    self.assertEqual(case.code, 0, case.tail())
                    for name in "summary.json", "fields_00001.h5", "checkpoint.h5":
                        self.assertIn(name, os.listdir(folder))

    def test_surfaces_with_blanks(self):
        with open(pulmo.mesh("cube_lung.msh"), "rb") as f:
            path = self.file(f.read().replace(b'"airway"', b'"left airway"'), "blank.msh")
        plain = pulmo.finished(GOOD + SHORT + ["-chest_wall_stiffness_airway", "0.3"])
        named = ["-dm_plex_filename", path, "-airflow_surfaces", "left airway", "-chest_wall_surfaces", "pleura,left airway"]
        for given in (named + ["-chest_wall_stiffness_left_airway", "0.3"],
                      ["-options_file", self.file(f'-dm_plex_filename {path}\n-airflow_surfaces "left airway"\n'
                                                  "-chest_wall_surfaces 'pleura,left airway'\n"
                                                  "-chest_wall_stiffness_left_airway 0.3\n")]):
            case = pulmo.finished(GOOD + SHORT + given)
            self.assertEqual(case.signals()["volume_ml"][-1], plain.signals()["volume_ml"][-1])
        self.refused(self.run_with(named + ["-chest_wall_stiffness_left airway", "0.3"]), "holds a blank", "as _")
        self.refused(self.run_with(["-chest_wall_surfaces", "pleura,Pleura"]), "rename one of the surfaces")

    def test_environment_and_petscrc(self):
        rc = os.path.join(self.home, ".petscrc")
        here = os.path.join(self.work, ".petscrc")
        try:
            with open(rc, "w") as f:
                f.write("-ventilator_pip 4\r-ventilator_peep 2\r")
            with open(here, "w") as f:
                f.write("-ventilator_peep 1\n")
            # scene files of the command line come last: only what they leave alone counts
            for ranks in 1, 2:
                case = self.run_with(["-options_string_yaml", "ventilator_pause: 0.1"], ranks=ranks,
                                     PETSC_OPTIONS="-ventilator_ramp_down 0.05 -tissue 'ma'",
                                     PETSC_OPTIONS_YAML="ventilator: {breaths: 2}")
                sources = self.expect(case, ventilator_peep="1", ventilator_ramp_down="0.05", ventilator_pause="0.1",
                                      ventilator_breaths="2", tissue="birzle", ventilator_pip="6")
                self.assertEqual(sources["-ventilator_peep"], ".petscrc")
                self.assertEqual(sources["-ventilator_ramp_down"], "PETSC_OPTIONS")
                self.assertEqual(sources["-ventilator_breaths"], "PETSC_OPTIONS_YAML")
                self.assertTrue(sources["-ventilator_pip"].endswith("pcv.opts"))
                for source in rc, ".petscrc", "PETSC_OPTIONS", "PETSC_OPTIONS_YAML":
                    self.assertEqual(case.out.count(f"pulmo: note: options were also read from {source}\n"), 1, case.out)
            sources = self.expect(self.run_with(["-skip_petscrc"]), ventilator_peep="0")
            self.assertNotIn("-skip_petscrc", sources)
            with open(rc, "w") as f:
                f.write("-ventilator_pip 4 stray\n")
            self.refused(self.run_with([]), ".petscrc: line 1", "stray")
        finally:
            os.remove(rc)
            os.remove(here)
        for text, words in (("stray -ts_dt 0.1", ["'stray'", "PETSC_OPTIONS"]), ("-tissue 'ma", ["PETSC_OPTIONS", "quote"]),
                            ("-ventilator_pipp 3", ["-ventilator_pip"]), ("-options_file none.opts", ["none.opts", "cannot be read"])):
            with self.subTest(text):
                self.refused(self.run_with([], PETSC_OPTIONS=text), *words)

    def test_yaml(self):
        path = self.file("\ufeffventilator:\r  pip: 3\r  peep: 1\rchest_wall_surfaces: [pleura, airway]\rlumen_pressure:\r", "a.yaml")
        sources = self.expect(self.run_with(["-options_file", path]), ventilator_pip="3", ventilator_peep="1",
                              chest_wall_surfaces="pleura,airway", lumen_pressure="")
        self.assertEqual(sources["-ventilator_pip"], path)
        for text in "a: [b", "- x", "just words", "\tx: 1\n y: 2":
            for option, given in (("-options_file", self.file(text, "b.yaml")), ("-options_file_yaml", self.file(text)),
                                  ("-options_string_yaml", text)):
                with self.subTest(text, option=option):
                    self.refused(self.run_with([option, given]), option, "YAML")
        self.refused(self.run_with(["-options_string", "-ventilator_pip 3"]), "-options_string")
        self.refused(self.run_with([], PETSC_OPTIONS_YAML="- a"), "PETSC_OPTIONS_YAML")

    def test_nested_files_prefixes_and_aliases(self):
        inner = self.file("-ventilator_peep 1\n", "inner.opts")
        outer = self.file(f"alias -push -ventilator_pip\n-options_file {inner}\n-push 3\n", "outer.opts")
        sources = self.expect(self.run_with(["-options_file", outer, "-prefix_push", "ventilator_", "-pause", "0.1", "-prefix_pop"]),
                              ventilator_pip="3", ventilator_peep="1", ventilator_pause="0.1")
        self.assertEqual(sources["-ventilator_peep"], inner)
        self.assertEqual(sources["-ventilator_pip"], outer)
        self.refused(self.run_with(["-prefix_push", "x_"]), "-prefix_pop")
        self.refused(self.run_with(["-prefix_pop"]), "-prefix_push")
        self.refused(self.run_with(["-help", "me"]), "-help", "'me'")

    def test_words_with_other_dashes_and_capitals(self):
        self.refused(self.run_with(["\u2013ts_dt", "0.1"]), "an en dash")
        self.refused(self.run_with(["-TS_adapt_dt_min", "0.01"]), "-TS_adapt_dt_min", "small letters")

    def test_what_nothing_used_is_told_after_the_first_step(self):
        for solver in "iterative", "iterative_hypre", "iterative_ml", "reuse":
            if solver == "iterative_ml" and not pulmo.has_ml():
                continue
            for extra in [], pulmo.STILL, ["-elements", "P1-P1"]:
                with self.subTest(solver, extra=extra):
                    case = pulmo.finished(BARE + SHORT + pulmo.options_file(f"solvers/{solver}.opts") + extra)
                    self.assertNotIn("not used", case.out)
        slips = ["-fieldsplit_presure_pc_type", "hypre", "-pc_fieldsplit_shur_fact_type", "lower", "-snes_mx_it", "4",
                 "-fieldsplit_displacement_ksp_tpye", "preonly"]
        for extra, told in ([], slips[::2]), (pulmo.STILL, slips[:-2:2]):
            case = pulmo.finished(BARE + pulmo.options_file("solvers/iterative.opts") + slips + extra +
                                  ["-progress", "on", "-ts_max_time", "0.2"])
            warned = re.findall(r"^pulmo: warning: option (\S+) was not used", case.out, re.M)
            self.assertEqual(sorted(warned), sorted(told), case.out)
            self.assertLess(case.out.index("was not used"), case.out.index("   0.1000 "), "after the first step")
        # nothing is left to solve before the load sets in
        late = ["-traction", "-traction_surfaces", "pleura", "-traction_value", "0.02*(t>0.15),0,0", "-chest_wall_surfaces", "airway"]
        case = pulmo.finished(pulmo.CUBE + pulmo.DIRECT + late +
                              ["-tissue", "birzle", "-chest_wall", "-ts_dt", "0.1", "-ts_max_time", "0.3"])
        self.assertNotIn("not used", case.out)
        case = pulmo.finished(BARE + SHORT + pulmo.options_file("solvers/iterative.opts") + ["-pc_type", "lu"])
        self.assertEqual(case.out.count("nothing uses the"), 1, case.out)
        self.assertEqual(case.out.count("not used"), 0, case.out)

    def test_the_other_mesh_is_tried_before_the_run(self):
        with open(pulmo.mesh("cube_lung.msh"), "rb") as f:
            renamed = self.file(f.read().replace(b'"airway"', b'"mouth"'), "mouth.msh")
        estimate = ["-error_estimate", "-error_estimate_mesh"]
        self.refused(self.run_with(estimate + [renamed]), "mouth.msh", "'airway'")
        self.refused(self.run_with(estimate + [pulmo.mesh("lung_test.msh")]), "another lung")
        self.refused(self.run_with(estimate + [pulmo.mesh("cube_lung.msh")]), "times as large")

    def test_versions_and_help(self):
        for flag in "-version", "--version":
            case = pulmo.Case([flag], directory="-", cwd=self.work)
            self.assertEqual(case.code, 0, case.tail())
            self.assertRegex(case.out, r"^pulmo \d+\.\d+\S* \(PETSc \d+\.\d+\.\d+\)\n$")
        for flag in "-help", "--help", "-h", "-?":
            case = pulmo.Case([flag], directory="-", cwd=self.work)
            self.assertEqual(case.code, 0, case.tail())
            self.assertIn("-ventilator_pip ", case.out)
        for flag in "-list", "--list":  # what -help describes at length, in the same order
            listed = pulmo.Case([flag], directory="-", cwd=self.work, ranks=2 if flag == "-list" else 1)
            self.assertEqual(listed.code, 0, listed.tail())
            of = {}
            for line in listed.out.splitlines():
                kind, names, about = line.split(maxsplit=2)
                of.setdefault(kind, {})[names] = about
            self.assertEqual(list(of), ["tissue", "permeability", "effect", "example"])
            self.assertEqual([n for n, words in of["example"].items() if not words.startswith("-" + n)], [])
            self.assertEqual(list(of["example"]), [n for n in of["effect"] if n not in ("tissue", "airflow", "ventilator")])
            self.assertIn(f"tissue law [one of {'|'.join(of['tissue'])}]", case.out)
            self.assertIn(f"[one of {'|'.join(of['permeability'])}]", case.out)
            for about in of["effect"].values():
                self.assertIn(f"\n{about}\n", case.out)
            self.assertEqual([n for n in of["effect"] if f"\n  -{n} " not in case.out], [])
        for flag, stray in ("-list", "laws"), ("--list", "-tissue"), ("-version", "2"):
            self.refused(pulmo.Case([flag, stray], directory="-", cwd=self.work), f"-{flag.strip('-')} stands alone")
        self.assertNotIn("results", os.listdir(self.work))

    def test_without_a_word_pulmo_tells_how_it_is_called(self):
        """By an example that runs as it stands, wherever one is; code 1, so that a script sees what it forgot."""
        folder = pulmo.scratch("anywhere")
        os.mkdir(folder)
        for ranks in 1, 2:
            case = pulmo.Case([], ranks=ranks, directory="-", cwd=folder)
            self.assertEqual((case.code, case.out), (1, ""), case.tail())
            self.assertEqual(case.err.count("usage: "), 1, case.tail())
        for where in folder, pulmo.SOURCE:
            said = pulmo.Case([], directory="-", cwd=where).err
            example = re.search(r"\n\n  (.*?)\n\n", said, re.S).group(1)
            self.assertIn(" meshes/lung_test.msh" if where == pulmo.SOURCE else f" {pulmo.SOURCE}/meshes/lung_test.msh", example)
            run = subprocess.run(example.replace("-output_dir first_breath", f"-output_dir {folder}/run -output_overwrite -ts_max_time 0.05"),
                                 shell=True, cwd=where, env=pulmo.alone(), capture_output=True, text=True)
            self.assertEqual(run.returncode, 0, run.stderr)
            self.assertIn("summary.json", os.listdir(os.path.join(folder, "run")))
        for given in dict(options=["-options_file", self.file("# none")]), dict(options=[], PETSC_OPTIONS="-tissue ma"):
            self.assertIn("no mesh", self.run_bare(folder, **given).stderr)

    def run_bare(self, folder, options, **environment):
        return subprocess.run([pulmo.PROGRAM, *options], cwd=folder, env=pulmo.alone() | dict(HOME=self.home) | environment,
                              capture_output=True, text=True)


if __name__ == "__main__":
    pulmo.main()
