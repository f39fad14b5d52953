"""Floating-point operations and bytes of residual and Jacobian, counted by executing them under callgrind.

Every instruction that is executed is looked up in the disassembly of its object: a vector addition of four doubles is four
operations, a fused multiply-add of four is eight, whether the lanes are useful or padding. Bytes are lines of 64 bytes
that callgrind's cache simulation moves between a 1 MB cache and what is behind it, both ways. valgrind knows no AVX-512,
so the program is built once more for x86-64-v3: same source, same vectors of four doubles.
"""
import re
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

from .common import SOURCE, environment, fail

CACHE = ["--D1=32768,8,64", "--LL=1048576,8,64"]
FUNCTIONS = {"residual": "pulmo::Model::residual*", "jacobian": "pulmo::Model::jacobian*"}
LANES = {"sd": 1, "pd": 2}
VECTOR = {"ymm": 2, "zmm": 4}  # times the lanes of xmm
PLAIN = re.compile(r"^v?(h?add|h?sub|addsub|mul|div|sqrt|max|min)(sd|pd)$")
FUSED = re.compile(r"^vfn?m(add|sub|addsub|subadd)\d{3}(sd|pd)$")
# where instructions are executed; the first pattern that is found in the name of the function decides
GROUPS = {"insertion": r"add_to_matrix|MatZeroEntries|MatSetValues|MatAssembly|MatZeroRows",
          "element matrices": r"MatrixBuilder|product_(tile|rows)|add_to_vector",
          "gradients and states": r"PointData|make_point|Places|jacobian_minus_one|invariants",
          "laws and fluxes": r"Kernels|volume_(residual|jacobian)|facet_(residual|jacobian)|surface_|tissue|exp|log|pow",
          "rest (gather, scatter, clearing)": r""}


def flops(mnemonic, operands):
    """Floating-point operations (double precision) of one instruction, and whether it divides or takes a root."""
    for pattern, each in ((PLAIN, 1), (FUSED, 2)):
        found = pattern.match(mnemonic)
        if found:
            lanes = LANES[found[2]]
            if found[2] == "pd":
                lanes *= next((times for name, times in VECTOR.items() if name in operands), 1)
            return each * lanes, found[1] in ("div", "sqrt")
    return 0, False


def disassembled(path):
    """{address: (operations, divides)} of the instructions of an object that compute with doubles."""
    text = subprocess.run(["objdump", "-d", "--no-show-raw-insn", path], capture_output=True, text=True).stdout
    found = {}
    for line in text.splitlines():
        words = line.split(None, 2)
        if len(words) > 1 and words[0].endswith(":"):
            count, divides = flops(words[1], words[2] if len(words) > 2 else "")
            if count:
                found[int(words[0][:-1], 16)] = (count, divides)
    return found


def executed(lines):
    """Of a callgrind dump: names of the events, and [(object, function, address, costs)] of what a function does itself."""
    events, entries, place, function, skip = [], [], None, None, False
    for line in lines:
        key, _, value = line.partition("=")
        if line.startswith("events:"):
            events = line.split()[1:]
        elif key == "ob":
            place = value.strip()
        elif key == "fn":
            function = value.strip()
        elif key == "calls":
            skip = True  # the next line is what the callee took
        elif line.startswith("0x"):
            if not skip:
                words = line.split()
                costs = [int(word) for word in words[2:]] + [0] * (len(events) - len(words) + 2)
                entries.append((place, function, int(words[0], 16), costs))
            skip = False
    return events, entries


def totals(lines, disassemble=disassembled):
    """Operations, divisions, instructions and bytes of a dump, and instructions by group."""
    events, entries = executed(lines)
    objects, sums, groups = {}, defaultdict(float), defaultdict(float)
    for place, function, address, costs in entries:
        if place not in objects:
            objects[place] = disassemble(place) if Path(place or "").is_file() else {}
        cost = dict(zip(events, costs))
        count, divides = objects[place].get(address, (0, False))
        sums["flops"] += count * cost["Ir"]
        sums["divisions"] += divides * cost["Ir"]
        sums["instructions"] += cost["Ir"]
        sums["bytes"] += 64 * sum(cost.get(event, 0) for event in ("DLmr", "DLmw", "DLdmr", "DLdmw"))
        groups[next(group for group, pattern in GROUPS.items() if re.search(pattern, function or ""))] += cost["Ir"]
    return dict(sums, groups=dict(groups))


def build(folder):
    """The benchmark program for x86-64-v3 in `folder`."""
    if not shutil.which("valgrind") or not shutil.which("objdump"):
        fail("--count needs valgrind and objdump (apt-get install valgrind binutils)")
    print("building for x86-64-v3 ...", flush=True)
    for command in (["cmake", "-S", SOURCE, "-B", folder, "-DCMAKE_BUILD_TYPE=Release", "-DPULMO_NATIVE=OFF", "-DPULMO_TESTS=OFF",
                     "-DCMAKE_CXX_FLAGS=-march=x86-64-v3 -mtune=native"],
                    ["cmake", "--build", folder, "--parallel", "2", "--target", "pulmo_assembly_benchmark"]):
        if subprocess.run([str(c) for c in command], stdout=subprocess.DEVNULL).returncode:
            fail("the build for x86-64-v3 failed")
    return folder / "pulmo_assembly_benchmark"


def count(program, arguments, folder):
    """{residual, jacobian: `totals`} of the second call of each in one run of the benchmark program."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = ["valgrind", "--tool=callgrind", "--dump-instr=yes", "--compress-pos=no", "--compress-strings=no", "--cache-sim=yes",
               "--simulate-wb=yes", *CACHE, *(f"--dump-after={name}" for name in FUNCTIONS.values()),
               f"--callgrind-out-file={folder / 'dump'}", program, *arguments, "-benchmark_repeats", "1", "-benchmark_stock", "off"]
    run = subprocess.run([str(c) for c in command], capture_output=True, text=True, env=environment())
    if run.returncode:
        fail(f"callgrind failed: {run.stderr.splitlines()[-1] if run.stderr else run.returncode}")
    found = {}
    for dump in sorted(folder.glob("dump.*"), key=lambda path: int(path.suffix[1:])):
        with open(dump) as f:
            lines = f.readlines()
        trigger = next((line for line in lines if line.startswith("desc: Trigger: --dump-after=")), "")
        for which in FUNCTIONS:
            if f"Model::{which}(" in trigger:
                found[which] = lines  # the last call stays: the first also finds positions in the matrix
    if len(found) < len(FUNCTIONS):
        fail(f"callgrind saw no call of residual or Jacobian (see {folder})")
    return {which: totals(lines) for which, lines in found.items()}
