#!/usr/bin/python3
"""What cmake --install leaves works by itself, and the PETSc that a user names is the one that is taken, or none.

    install_test.py BUILD/pulmo CMAKE BUILD
"""
import glob
import os
import re
import subprocess
import sys
import unittest

import pulmo_case as pulmo

CMAKE, BUILD = sys.argv[2:4]
OF_PULMO = os.path.join(pulmo.SOURCE, "src/cmake")
PLAIN = {name: value for name, value in os.environ.items() if not name.startswith("PETSC_") and name != "LD_LIBRARY_PATH"}
SCENE = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + pulmo.QUIET + ["-ventilator_pip", "6", "-ts_max_time", "0.1"]


def call(*words, environment=PLAIN, **arguments):
    return subprocess.run([str(w) for w in words], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          **arguments)


def cached(name, folder=BUILD):
    with open(os.path.join(folder, "CMakeCache.txt")) as file:
        return next((line.split("=", 1)[1].strip() for line in file if line.startswith(name + ":")), None)


class Install(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.prefix = pulmo.scratch("prefix")
        run = call(CMAKE, "--install", BUILD, "--prefix", cls.prefix)
        assert run.returncode == 0, run.stdout

    def path(self, *names):
        return os.path.join(self.prefix, *names)

    def finished(self, program, directory, **arguments):
        run = call(program, *SCENE, "-output_dir", directory, environment=PLAIN | dict(OPENBLAS_NUM_THREADS="1"), **arguments)
        self.assertEqual(run.returncode, 0, run.stdout)
        with open(os.path.join(directory, "signals.csv")) as file:
            return file.read()

    def test_a_project_links_the_library_and_gets_what_the_program_gets(self):
        build, source = pulmo.scratch("consumer"), os.path.join(pulmo.SOURCE, "tests/cases/consumer")
        for words in (["-S", source, "-B", build, f"-DCMAKE_PREFIX_PATH={self.prefix}", f"-DCMAKE_CXX_COMPILER={cached('CMAKE_CXX_COMPILER')}"],
                      ["--build", build]):
            run = call(CMAKE, *words)
            self.assertEqual(run.returncode, 0, run.stdout)
        # a project without CMake: the file for pkg-config goes with its prefix
        folders = [self.path(cached("CMAKE_INSTALL_LIBDIR"), "pkgconfig")]
        if cached("PULMO_PETSC_DIR"):
            folders.append(os.path.join(cached("PULMO_PETSC_DIR"), cached("PULMO_PETSC_ARCH"), "lib/pkgconfig"))
        said = call("pkg-config", "--cflags", "--libs", "pulmo", environment=PLAIN | dict(PKG_CONFIG_PATH=":".join(folders)))
        self.assertEqual(said.returncode, 0, said.stdout)
        flags = said.stdout.split()
        run = call(cached("CMAKE_CXX_COMPILER"), "-std=c++17", os.path.join(source, "consumer.cpp"), *flags,
                   *(f"-Wl,-rpath,{flag[2:]}" for flag in flags if flag.startswith("-L")), "-o", os.path.join(build, "by_pkg_config"))
        self.assertEqual(run.returncode, 0, run.stdout)
        # kernels in headers are compiled once more, with the project's own flags: the last digit may be another
        first, second, ours = (self.finished(program, pulmo.scratch()).splitlines() for program in
                               (os.path.join(build, "consumer"), os.path.join(build, "by_pkg_config"), self.path("bin/pulmo")))
        for theirs in first, second:
            self.assertEqual(len(theirs), len(ours))
            self.assertEqual(theirs[0], ours[0])
            for row, own in zip(theirs[1:], ours[1:]):
                for value, expected in zip(row.split(","), own.split(","), strict=True):
                    if value != expected:
                        self.assertAlmostEqual(float(value) / float(expected), 1, delta=1e-12)

    def test_the_program_finds_its_libraries_and_tools_find_the_program(self):
        def run_path(program):
            text = call("readelf", "-d", program).stdout
            return re.search(r"R(?:UN)?PATH\)\s.*\[(.*)\]", text).group(1).strip(":").split(":")

        self.assertNotIn("not found", call("ldd", self.path("bin/pulmo")).stdout)
        self.assertLessEqual(set(run_path(pulmo.PROGRAM)), set(run_path(self.path("bin/pulmo"))))
        data = self.path("share/pulmo")
        there = set(glob.glob(data + "/**", recursive=True))
        tool = call(os.path.join(data, "tools/reproduce_paper"), "--list", cwd=pulmo.scratch("..")).stdout
        self.assertIn("table2", tool)
        for name in "tools/export", "tools/report", "tools/lung_mesh", "tools/sphere_mesh", "tools/cell_values", "tools/accuracy_cost":
            run = call(os.path.join(data, name), "--help")
            self.assertEqual(run.returncode, 0, run.stdout)
        self.assertEqual(set(glob.glob(data + "/**", recursive=True)), there, "left in a folder that may not be the user's")
        self.assertTrue(os.path.samefile(os.path.join(data, "build/pulmo"), self.path("bin/pulmo")))
        for name in "README.md", "LICENSE", "docs/ventilator.md":
            self.assertTrue(os.path.exists(self.path("share/doc/pulmo", name)), name)


class PETSc(unittest.TestCase):
    """src/cmake/FindPETSc.cmake and Dependencies.cmake in a project of their own."""

    def configure(self, source=None, languages="NONE", file="FindPETSc", show=(), **environment):
        source = source or pulmo.scratch("project")
        os.makedirs(source, exist_ok=True)
        with open(os.path.join(source, "CMakeLists.txt"), "w") as out:
            out.write(f"cmake_minimum_required(VERSION 3.25)\nproject(p LANGUAGES {languages})\ninclude({OF_PULMO}/{file}.cmake)\n")
            out.writelines(f'message("{name}=${{{name}}}")\n' for name in show)
        run = call(CMAKE, "-S", source, "-B", os.path.join(source, "build"), environment=PLAIN | environment)
        run.stdout = " ".join(run.stdout.split())  # cmake breaks lines
        return run

    def test_a_petsc_that_is_not_there_is_not_replaced_by_another(self):
        folder = pulmo.scratch("")
        os.makedirs(os.path.join(folder, "arch"))
        gone = os.path.join(folder, "gone")
        for environment, words in (
                (dict(PETSC_DIR=gone), ["PETSC_DIR is", gone, "no such folder"]),
                (dict(PETSC_DIR=folder, PETSC_ARCH="other"), ["PETSC_ARCH is 'other'", folder, "no such folder"]),
                (dict(PETSC_DIR=folder, PETSC_ARCH="arch"), ["There is no PETSc in", folder + "/arch", "build PETSc first"]),
                (dict(PETSC_DIR=folder), ["There is no PETSc in", folder]),
                (dict(PETSC_ARCH="arch"), ["PETSC_ARCH is 'arch' but PETSC_DIR is not set"])):
            with self.subTest(environment):
                run = self.configure(**environment)
                self.assertNotEqual(run.returncode, 0, run.stdout)
                for word in words:
                    self.assertIn(word, run.stdout)

    def fake(self):
        """This build's PETSc under another roof, whose makefiles name an MPI and an HDF5 there."""
        folder = pulmo.scratch("petsc")
        for name in "arch/lib/pkgconfig", "arch/lib/petsc/conf", "mpi", "hdf5/include", "hdf5/lib":
            os.makedirs(os.path.join(folder, name))
        module = cached("PETSC_MODULE_NAME")
        found = call("pkg-config", "--variable=pcfiledir", module).stdout.strip()
        if cached("PULMO_PETSC_DIR"):
            found = os.path.join(cached("PULMO_PETSC_DIR"), cached("PULMO_PETSC_ARCH"), "lib/pkgconfig")
        with open(os.path.join(found, module + ".pc")) as file:
            text = file.read()
        libraries = re.search(r"^libdir=(.*)$", text, re.MULTILINE).group(1)
        text = text.replace("${libdir}", libraries).replace("libdir=" + libraries, f"libdir={folder}/arch/lib")
        text = re.sub("^cxxcompiler=.*$", f"cxxcompiler={folder}/mpi/mpicxx", text, flags=re.MULTILINE)
        with open(os.path.join(folder, "arch/lib/pkgconfig", module + ".pc"), "w") as file:
            file.write(text)
        with open(os.path.join(folder, "arch/lib/petsc/conf/petscvariables"), "w") as file:
            file.write(f"X = 1\nHDF5_INCLUDE = -I{folder}/hdf5/include\nHDF5_LIB = -Wl,-rpath,/x -L{folder}/hdf5/lib -lhdf5\n"
                       f"MPIEXEC = {folder}/mpi/mpiexec --oversubscribe\n")
        os.symlink(cached("MPI_CXX_COMPILER"), os.path.join(folder, "mpi/mpicxx"))
        os.symlink(cached("MPIEXEC_EXECUTABLE"), os.path.join(folder, "mpi/mpiexec"))
        for name in os.listdir(cached("HDF5_INCLUDE_DIR")):
            os.symlink(os.path.join(cached("HDF5_INCLUDE_DIR"), name), os.path.join(folder, "hdf5/include", name))
        os.symlink(cached("HDF5_LIBRARY"), os.path.join(folder, "hdf5/lib/libhdf5.so"))
        return folder

    def test_mpi_and_hdf5_are_those_of_that_petsc(self):
        folder = self.fake()
        names = ["MPI_CXX_COMPILER", "MPIEXEC_EXECUTABLE", "HDF5_INCLUDE_DIR", "HDF5_LIBRARY"]
        project = pulmo.scratch("project")
        run = self.configure(project, "CXX", "Dependencies", names, PETSC_DIR=folder, PETSC_ARCH="arch")
        self.assertEqual(run.returncode, 0, run.stdout)
        for name, file in zip(names, ["mpi/mpicxx", "mpi/mpiexec", "hdf5/include", "hdf5/lib/libhdf5.so"]):
            self.assertIn(f"{name}={folder}/{file}", run.stdout)
        # and the folder stays with it
        run = self.configure(project, "CXX", "Dependencies", PETSC_DIR=os.path.dirname(folder))
        self.assertNotEqual(run.returncode, 0)
        self.assertIn("This build folder is configured for PETSC_DIR=", run.stdout)


if __name__ == "__main__":
    pulmo.main()
