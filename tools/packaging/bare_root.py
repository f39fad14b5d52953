#!/usr/bin/python3
"""Shows in bare Debian 12 systems that pulmo installs, runs and goes away. For maintainers: as root, with a network; minutes to an hour.

    tools/packaging/bare_root.py packages    the .deb files: install, breathe, report, another project, remove, nothing is left
    tools/packaging/bare_root.py commands    README's two: tools/quickstart, and tools/test with the tests that --tests names
    tools/packaging/bare_root.py container   the commands of container/Containerfile, one after the other

Each makes a new root by debootstrap, from the archive that this machine's apt uses, and takes it away at the end (--keep: not).
The source is what git tracks here, with its changes.
"""
import argparse
import csv
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent.parent
SUITE = "bookworm"
USER = "tester"
# what the system itself writes, whatever is installed
SYSTEM = ("/proc", "/sys", "/dev", "/run", "/tmp", "/home", "/root", "/packages", "/var/cache", "/var/log", "/var/lib/apt", "/var/lib/dpkg")
RECIPE = SOURCE / "tools/packaging/container/Containerfile"


def say(text):
    print(f"bare_root: {text}", flush=True)


def fail(text):
    sys.exit(f"bare_root: error: {text}")


def apt_says(*words):
    return subprocess.run(words, text=True, stdout=subprocess.PIPE, check=True).stdout


class Root:
    """A Debian in a folder."""

    def __init__(self, folder, base):
        self.folder = folder
        if not (base / "etc/debian_version").exists():
            self.bootstrap(base)
        subprocess.run(["cp", "-a", f"{base}/.", folder], check=True)
        self.started = time.monotonic()

    @staticmethod
    def bootstrap(base):
        """A minimal system that asks what this machine asks; whole, or not there."""
        targets = apt_says("apt-get", "indextargets", "--format", "deb $(SITE) $(CODENAME) $(COMPONENT)", "Created-By: Packages")
        sources = sorted({" ".join(line.split()) for line in targets.splitlines() if line.split()[2].startswith(SUITE)})
        archive = next((line.split()[1] for line in sources if line.split()[2] == SUITE), None)
        if not archive:
            fail(f"apt of this machine knows no archive of Debian {SUITE} (apt-get indextargets)")
        say("making a root (debootstrap)")
        part = base.with_name(base.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run(["debootstrap", "--variant=minbase", SUITE, part, archive], check=True, stdout=subprocess.DEVNULL)
        (part / "etc/apt/sources.list").write_text("\n".join(sources) + "\n")
        (part / "etc/apt/apt.conf.d/00machine").write_text(apt_says("apt-config", "dump", "Acquire"))
        for name in "etc/resolv.conf", "etc/hosts":
            shutil.copy(f"/{name}", part / name)
        (part / "etc/dpkg/dpkg.cfg.d/unsafe-io").write_text("force-unsafe-io\n")  # the root may be lost
        (part / "usr/sbin/policy-rc.d").write_text("#!/bin/sh\nexit 101\n")  # no service starts
        (part / "usr/sbin/policy-rc.d").chmod(0o755)
        subprocess.run(["chroot", part, "useradd", "--create-home", USER], check=True)
        part.rename(base)

    def run(self, command, user="root", directory="/", expect=0):
        """A command line of the shell in the root; what it printed. Ends the program if its code is another one."""
        # without /sys Open MPI's hwloc says at each start that it finds no processors there
        mounts = ("-t proc proc", "/proc"), ("-t tmpfs tmpfs", "/dev/shm"), ("-t sysfs -o ro sysfs", "/sys")
        inside = "".join(f"mount {what} {shlex.quote(str(self.folder) + where)} && " for what, where in mounts)
        words = ["env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "LANG=C.UTF-8", "OPENBLAS_NUM_THREADS=1", "OMPI_ALLOW_RUN_AS_ROOT=1",
                 "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1", "OMPI_MCA_rmaps_base_oversubscribe=1", "DEBIAN_FRONTEND=noninteractive"]
        if user != "root":
            words += ["runuser", "-u", user, "--"]
        home = "/root" if user == "root" else f"/home/{user}"
        words += ["bash", "-c", f"export HOME={home}; cd {directory} && {command}"]
        began = time.monotonic()
        run = subprocess.run(["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c",
                              inside + f"exec chroot {shlex.quote(str(self.folder))} {shlex.join(words)}"],
                             text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        short = command if len(command) < 100 else command[:97] + "..."
        say(f"{time.monotonic() - began:6.1f} s  {user}: {short}")
        if run.returncode != expect:
            fail(f"code {run.returncode} instead of {expect}\n{run.stdout[-4000:]}")
        return run.stdout

    def install(self, *words):
        self.run("apt-get -qq update")
        return self.run("apt-get -y -o Dpkg::Use-Pty=0 " + " ".join(words))

    def files(self):
        """Every path but those that the system keeps for itself."""
        leave = " -o ".join(f"-path {path}" for path in SYSTEM)
        return set(self.run(f"find / -xdev \\( {leave} \\) -prune -o -print").splitlines())

    def put_source(self, place):
        """What git tracks, as it is now."""
        target = self.folder / place.lstrip("/")
        target.mkdir(parents=True)
        names = subprocess.run(["git", "-C", SOURCE, "ls-files", "-z", "--cached"], stdout=subprocess.PIPE, check=True).stdout
        pack = subprocess.Popen(["tar", "-C", SOURCE, "--null", "-T", "-", "-c"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        unpack = subprocess.Popen(["tar", "-C", target, "--no-same-owner", "-x"], stdin=pack.stdout)
        pack.stdin.write(names)
        pack.stdin.close()
        if pack.wait() or unpack.wait():
            fail("the source could not be copied")


def field(package, name):
    return subprocess.run(["dpkg-deb", "-f", package, name], text=True, stdout=subprocess.PIPE, check=True).stdout.strip()


def packages(root, options):
    """From nothing to a report and another project's program, and back to nothing."""
    debs = sorted(Path(options.packages).glob("*.deb"))
    if [field(deb, "Package") for deb in debs] != ["libpulmo-dev", "pulmo"]:
        fail(f"{options.packages} holds {len(debs)} packages; make the two by `cmake --workflow --preset debian`")
    (root.folder / "packages").mkdir()
    for deb in debs:
        shutil.copy(deb, root.folder / "packages")
    # their dependencies first, so that what the packages themselves leave is seen
    needs = [field(deb, name) for deb in debs for name in ("Depends", "Recommends")]
    root.install("satisfy", *(f'"{need}"' for need in needs if need))
    root.install("install g++ cmake make man-db bash-completion")
    before = root.files()
    said = root.run("apt-get -y -o Dpkg::Use-Pty=0 install /packages/*.deb")
    if "0 upgraded, 2 newly installed" not in said:
        fail(f"the packages need more than they say:\n{said}")

    home = f"/home/{USER}"
    example = re.search(r"\n\n  (.*?)\n\n", root.run("pulmo", USER, home, expect=1), re.S)[1]
    root.run(example, USER, home)
    scene = example.split("-output_dir")[0]
    root.run(f"mpiexec -n 2 {scene} -output_dir two_ranks", USER, home)
    root.run("/usr/share/pulmo/tools/report first_breath two_ranks && test -s first_breath/comparison.html", USER, home)
    root.run("/usr/share/pulmo/tools/report first_breath && test -s first_breath/report.html", USER, home)
    root.run("/usr/share/pulmo/tools/lung_mesh --check /usr/share/pulmo/meshes/lung_pair.msh", USER, home)
    root.run("/usr/share/pulmo/tools/sphere_mesh --help && /usr/share/pulmo/tools/reproduce_paper --list", USER, home)
    if "volumetric stiffness" not in root.run("MANWIDTH=120 man pulmo | grep -A 1 -e '-tissue_c3 kPa'", USER, home):
        fail("the manual page does not tell of -tissue_c3")
    if "yoshihara" not in root.run("bash -ic '. /usr/share/bash-completion/bash_completion; _completion_loader pulmo; COMP_WORDS=(pulmo -tissue yo); "
                                   "COMP_CWORD=2; _pulmo; echo ${COMPREPLY[@]}'", USER, home):
        fail("bash does not complete -tissue yo")

    shutil.copytree(SOURCE / "tests/cases/consumer", root.folder / home.lstrip("/") / "project")
    root.run(f"chown -R {USER} project", directory=home)
    root.run("cmake -S project -B build && cmake --build build", USER, home)
    root.run(f"build/consumer {scene.split(' ', 1)[1]} -output_dir of_project -ts_max_time 0.2 -progress off", USER, home)
    root.run("g++ -O1 project/consumer.cpp $(pkg-config --cflags --libs pulmo) -o by_pkg_config", USER, home)
    root.run(f"./by_pkg_config {scene.split(' ', 1)[1]} -output_dir of_other -ts_max_time 0.2 -progress off", USER, home)
    volumes = [[float(row["volume_ml"]) for row in csv.DictReader(open(root.folder / home.lstrip("/") / name / "signals.csv"))][:5]
               for name in ("first_breath", "of_project", "of_other")]
    if any(abs(a / b - 1) > 1e-9 for other in volumes[1:] for a, b in zip(volumes[0][1:], other[1:], strict=True)):
        fail(f"the projects' programs do not get what pulmo gets: {volumes}")

    root.run("apt-get -y purge pulmo libpulmo-dev")
    left = root.files() - before
    if left:
        fail("left behind:\n" + "\n".join(sorted(left)[:20]))
    gone = before - root.files()
    if gone:
        fail("taken away though it was there before:\n" + "\n".join(sorted(gone)[:20]))
    say("removed; nothing is left")


def commands(root, options):
    """README's two commands, as it gives them: root, a fresh system, a clone."""
    root.put_source("/home/tester/pulmo")
    said = root.run("tools/quickstart", directory="/home/tester/pulmo")
    print(said[-1500:])
    said = root.run(f"tools/test {options.tests}", directory="/home/tester/pulmo")
    print("\n".join(said.splitlines()[-12:]))


def container(root, _):
    """The recipe's commands in the roots of its two stages; what a container's own file system does is not shown."""
    text = re.sub(r"^#.*\n", "", RECIPE.read_text(), flags=re.M).replace("\\\n", " ")
    stage, stages, variables = root, 0, {}
    for line in filter(None, map(str.strip, text.splitlines())):
        word, rest = line.split(None, 1)
        if word == "FROM":
            stages += 1
            if stages == 2:
                stage = Root(root.folder.with_name("second"), root.folder.with_name("base"))
        elif word == "ARG":
            name, _, value = rest.partition("=")
            variables[name] = value
        elif word == "COPY" and rest == ". /src":
            stage.put_source("/src")
        elif word == "COPY":
            for path in root.folder.glob(rest.split()[1].lstrip("/")):
                shutil.copy(path, stage.folder / rest.split()[2].lstrip("/"))
        elif word == "RUN":
            stage.run("".join(f"{name}={value}; " for name, value in variables.items()) + rest)
        elif word == "CMD":
            stage.run("pulmo -help", "pulmo", "/data")
            example = re.search(r"\n\n  (.*?)\n\n", stage.run("pulmo", "pulmo", "/data", expect=1), re.S)[1]
            stage.run(f"mpiexec -n 2 {example} && /usr/share/pulmo/tools/report first_breath", "pulmo", "/data")
            say("the image has " + stage.run("du -shx /").split()[0])
    if stages != 2:
        fail(f"{RECIPE} has {stages} stages; this tool knows two")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["packages", "commands", "container"])
    parser.add_argument("--packages", default=SOURCE / "build-debian", metavar="DIR", help="where the .deb files are (default build-debian)")
    parser.add_argument("--tests", default="-R '^unit_(options|programme)$|^case_layout$'", help="arguments of tools/test (default %(default)s)")
    parser.add_argument("--folder", help="where the roots are made, on a disk with 5 GB; its `base` is kept for the next call")
    parser.add_argument("--keep", action="store_true", help="leave the root, to look into it")
    options = parser.parse_args()
    if os.geteuid() != 0:
        fail("a root of its own needs root: call it with sudo")
    if not shutil.which("debootstrap"):
        fail("debootstrap is not here: apt-get install debootstrap")
    folder = Path(options.folder or tempfile.mkdtemp(prefix="pulmo_root_")).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    try:
        for name in "root", "second":
            shutil.rmtree(folder / name, ignore_errors=True)
        globals()[options.what](Root(folder / "root", folder / "base"), options)
    finally:
        if not options.keep:
            for name in ("root", "second") + (() if options.folder else ("base",)):
                shutil.rmtree(folder / name, ignore_errors=True)
    say(f"{options.what}: all is well after {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
