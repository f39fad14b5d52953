"""Runs of a program that are measured, kept in a folder each, and not repeated when they are there already.

A run is known by its words and by all that it reads (keys.py): a new build, an edited mesh, programme or .petscrc is a new run. A run that failed is finished too; one that was interrupted is not, nor one that was
ended after less time than it is given now.
"""
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

from shared.common import environment
from shared.keys import digest
from shared.signals import whole_rows

STAGES = ["setup", "residual", "jacobian", "solve", "output"]
POLL = 0.05  # s between looks at a running program


def processes(leader):
    """The processes whose ancestor is `leader`, and itself."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, IndexError):
            pass  # it has ended meanwhile
    found = [leader]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def end(leader):
    """Ends a process and those it has started (a launcher's ranks have groups of their own)."""
    for pid in reversed(processes(leader)):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass


def resident_peak(pid):
    """Peak resident memory of a process in MB (10^6 bytes), 0 if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM")), 0)


def last_line(path):
    """Last full line of a log, for the progress."""
    with open(path, "rb") as f:
        f.seek(max(0, os.path.getsize(path) - 500))
        lines = f.read().decode(errors="replace").splitlines()
    return lines[-1].strip()[:100] if lines else ""


def reason(folder, code):
    """Why a run failed, in a sentence; stderr.log beside the result has all of it."""
    lines = (folder / "stderr.log").read_text(errors="replace").splitlines()
    errors = [line.split("error:", 1)[1].strip() for line in lines if "error:" in line]
    if errors:
        return re.split(r"\.\s+(?=[A-Z])", errors[-1])[0]
    petsc = [line.split("]PETSC ERROR:", 1)[1].strip() for line in lines if "]PETSC ERROR:" in line]
    if len(petsc) > 1:
        return petsc[1]  # the first is a rule of dashes
    if code < 0:
        return f"ended by {signal.Signals(-code).name}"
    return lines[-1].strip() if lines else f"exit code {code}"


def execute(command, folder, ranks, timeout):
    """Runs a command in its folder; wall and CPU seconds, peak memory (sum of ranks, MB), exit code, reason."""
    before, peak, late, tty = os.getloadavg()[0], {}, False, sys.stdout.isatty()
    with open(folder / "stdout.log", "w") as out, open(folder / "stderr.log", "w") as err:
        begin = time.monotonic()
        process = subprocess.Popen(command, stdout=out, stderr=err, start_new_session=True,
                                   env=dict(environment(), XDG_CACHE_HOME=str(folder.parent / "cache")))
        shown = begin
        try:
            while True:
                pid, status, used = os.wait4(process.pid, os.WNOHANG)
                if pid:
                    break
                for rank in [process.pid] if ranks == 1 else processes(process.pid)[1:]:
                    peak[rank] = max(peak.get(rank, 0), resident_peak(rank))
                now = time.monotonic()
                if tty and now - shown > 1:
                    shown = now
                    print(f"\r\033[K    {now - begin:.0f} s: {last_line(folder / 'stdout.log')}", end="", flush=True)
                if timeout and now - begin > timeout and not late:
                    late = True
                    end(process.pid)
                time.sleep(POLL)
        except BaseException:
            end(process.pid)
            process.wait()
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
    if tty:
        print("\r\033[K", end="")
    return {"code": process.returncode, "wall": time.monotonic() - begin, "cpu": used.ru_utime + used.ru_stime,
            "memory": sum(peak.values()), "ended_after": timeout if late else None, "load": [before, os.getloadavg()[0]],
            "reason": f"no end after {timeout:g} s" if late else
                      reason(folder, process.returncode) if process.returncode else ""}


def measured(command, folder, repeat=0, ranks=1, timeout=None):
    """The result of a command whose last word is to be its output folder: from an earlier run, or a new one.

    Returns what `execute` and the program's summary tell, and the folder.
    """
    command = [str(word) for word in command]
    place = folder / f"{digest([str(ranks), *command])}_{repeat}"
    kept = place / "result.json"
    result = json.loads(kept.read_text()) if kept.exists() else None
    if result and result.get("ended_after") and (timeout is None or timeout > result["ended_after"]):
        result = None
    if result is None:
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        (place / "command.txt").write_text("\n".join(command) + "\n")
        result = execute([*command, str(place / "run")], place, ranks, timeout)
        part = place / "result.part"
        part.write_text(json.dumps(result, indent=1))
        part.rename(kept)
        result["kept"] = False
    else:
        result["kept"] = True
    for name in ("summary.json", "failure.json"):
        if (place / "run" / name).exists():
            result["summary"] = json.loads((place / "run" / name).read_text())
    result["folder"] = place
    return result


def signals(result):
    """Rows of the accepted steps of a run, as texts by column."""
    for name in ("signals.csv", "signals.csv.part"):
        path = result["folder"] / "run" / name
        if path.exists():
            return whole_rows(path)
    return []


def waveform(result):
    """Volume (ml) and airway pressure (cmH2O) by time (s, rounded to 1 ns) of the steps that were accepted."""
    return {round(float(r["time_s"]), 9): (float(r["volume_ml"]), float(r["airway_pressure_cmH2O"])) for r in signals(result)}


def differences(result, reference):
    """Largest difference of volume and of pressure at the times both have, over the reference's largest; None without."""
    a, b = waveform(result), waveform(reference)
    common = [t for t in a if t in b and t > 0]
    relative = []
    for i in range(2):
        largest = max((abs(b[t][i]) for t in common), default=0)
        relative.append(max(abs(a[t][i] - b[t][i]) for t in common) / largest if largest > 0 else None)
    return relative


def stage_seconds(results):
    """Median seconds of each stage and in total over the repeats that have a summary; the wall time of the process else."""
    told = [r["summary"]["wall_seconds"] for r in results if "wall_seconds" in r.get("summary", {})]
    if not told:
        return {"total": statistics.median(r["wall"] for r in results)}
    return {stage: statistics.median(t[stage] for t in told) for stage in [*STAGES, "total"]}


def warnings(result):
    """What the program warned of (options that nothing used)."""
    text = (result["folder"] / "stdout.log").read_text(errors="replace")
    text += (result["folder"] / "stderr.log").read_text(errors="replace")
    return sorted({line.split("warning:", 1)[1].strip() for line in text.splitlines() if "warning:" in line})


def load_range(results):
    """Sentence on the load average (1 min) while the runs were made; on an idle machine it is about the ranks."""
    loads = [value for r in results for value in r["load"]]
    return f"load average {min(loads):.1f} to {max(loads):.1f} on {os.cpu_count()} cores"
