"""Floating-point operations and bytes of residual and Jacobian, counted by executing them under callgrind.

Every instruction that is executed is looked up in the disassembly of its object: a vector addition of four doubles is four
operations, a fused multiply-add of four is eight, whether the lanes are useful or padding. Bytes are lines of 64 bytes
that callgrind's cache simulation moves between a 1 MB cache and what is behind it, both ways. valgrind knows no AVX-512,
so the program is built once more for x86-64-v3: same source, same vectors of four doubles.
"""
import re
import shutil
import subprocess
from pathlib import Path

from shared.common import SOURCE, environment, fail

CACHE = ["--D1=32768,8,64", "--LL=1048576,8,64"]
FUNCTIONS = {"residual": "pulmo::Model::residual*", "jacobian": "pulmo::Model::jacobian*"}
LANES = {"sd": 1, "pd": 2}
VECTOR = {"ymm": 2, "zmm": 4}  # times the lanes of xmm
PLAIN = re.compile(r"^v?(h?add|h?sub|addsub|mul|div|sqrt|max|min)(sd|pd)$")
FUSED = re.compile(r"^vfn?m(add|sub|addsub|subadd)\d{3}(sd|pd)$")
# where the time goes: the first pattern that is found in the name of a function decides; others are no part of it
GROUPS = {"insertion into the matrix": r"MatrixMap::add|MatZeroEntries|MatZeroRows",
          "element matrices and vectors": r"MatrixBuilder|product_(tile|rows)|add_to_vector",
          "gradients and states": r"PointData|interpolate|make_point|invariants|Places",
          "laws and fluxes": r"Kernels|energy_derivatives|volume_(residual|jacobian)|surface_(residual|jacobian)|cofactor|expm1|log1p|_(exp|log|pow)_",
          "gather, scatter, clearing": r"Assembly::(residual|jacobian|for_blocks)|integrate_(vectors|matrices)|memset"}


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
    """Of a callgrind dump: names of the events, and [(object, address, costs)] of what functions do themselves."""
    events, entries, place, skip = [], [], None, False
    for line in lines:
        key, _, value = line.partition("=")
        if line.startswith("events:"):
            events = line.split()[1:]
        elif key == "ob":
            place = value.strip()
        elif key == "calls":
            skip = True  # the next line is what the callee took
        elif line.startswith("0x"):
            if not skip:
                words = line.split()
                costs = [int(word) for word in words[2:]] + [0] * (len(events) - len(words) + 2)
                entries.append((place, int(words[0], 16), costs))
            skip = False
    return events, entries


def totals(lines, disassemble=disassembled):
    """Operations, divisions and bytes of a dump."""
    events, entries = executed(lines)
    objects, sums = {}, {"flops": 0, "divisions": 0, "bytes": 0}
    for place, address, costs in entries:
        if place not in objects:
            objects[place] = disassemble(place) if Path(place or "").is_file() else {}
        cost = dict(zip(events, costs))
        count, divides = objects[place].get(address, (0, False))
        sums["flops"] += count * cost["Ir"]
        sums["divisions"] += divides * cost["Ir"]
        sums["bytes"] += 64 * sum(cost.get(event, 0) for event in ("DLmr", "DLmw", "DLdmr", "DLdmw"))
    return sums


def shares(report):
    """{group: share of the time} from the text of `perf report -F overhead,symbol`; {} without samples."""
    found = dict.fromkeys(GROUPS, 0.0)
    for line in report.splitlines():
        told = re.match(r"\s*([\d.]+)%\s+\[[.k]\]\s+(.*)", line)
        group = told and next((group for group, pattern in GROUPS.items() if re.search(pattern, told[2])), None)
        if group:
            found[group] += float(told[1])
    total = sum(found.values())
    return {group: share / total for group, share in found.items()} if total else {}


def time_shares(program, arguments, folder):
    """`shares` of one run of the benchmark program, sampled by perf; {} where perf is not there or not allowed."""
    if not shutil.which("perf"):
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    data = folder / "perf.data"
    command = ["perf", "record", "-e", "cpu-clock", "-F", "2000", "-o", data, program, *arguments, "-benchmark_repeats", "25",
               "-benchmark_stock", "off"]
    if subprocess.run([str(c) for c in command], capture_output=True, env=environment()).returncode:
        return {}
    return shares(subprocess.run(["perf", "report", "-i", data, "--stdio", "--no-children", "-F", "overhead,symbol"],
                                 capture_output=True, text=True).stdout)


def build(folder):
    """The benchmark program for x86-64-v3 in `folder`."""
    print("building for x86-64-v3 ...", flush=True)
    for command in (["cmake", "-S", SOURCE, "-B", folder, "-DCMAKE_BUILD_TYPE=Release", "-DPULMO_ARCH=x86-64-v3", "-DPULMO_TESTS=OFF",
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
