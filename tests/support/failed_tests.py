"""What failed in the last run of ctest, one line for each test, with what in it failed and how to run it alone.

    failed_tests.py BUILD STARTED    STARTED: a file made when the run began
"""
import os
import re
import sys

MOST = 5  # names in one line


def failed(build, started):
    """Names of the failed tests in their order; none if ctest has not written them since `started` was made."""
    path = os.path.join(build, "Testing/Temporary/LastTestsFailed.log")
    if not os.path.exists(path) or os.stat(path).st_mtime_ns < os.stat(started).st_mtime_ns:
        return []
    with open(path) as file:
        return [line.strip().split(":", 1)[1] for line in file if ":" in line]


def outputs(build):
    """Name of a test -> what it printed."""
    path = os.path.join(build, "Testing/Temporary/LastTest.log")
    if not os.path.exists(path):
        return {}
    with open(path, errors="replace") as file:
        parts = re.split(r"^\d+/\d+ Testing: (.*)\n", file.read(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2]))


def inside(output):
    """What a script or a GoogleTest program says that failed in it."""
    found = [" ".join(filter(None, of)) for of in
             re.findall(r"^(?:FAIL|ERROR): (\w+)(?: \(.*?\))?(?: ([\[(].*[\])]))?$", output, re.MULTILINE)]
    found += re.findall(r"^\[  FAILED  \] (\w[\w/]*\.\w[\w/]*)", output, re.MULTILINE)
    return list(dict.fromkeys(found))


def lines(build, started):
    names, printed = failed(build, started), outputs(build)
    if not names:
        return ["test: ctest failed without naming a test; see above"]
    text = [f"test: {len(names)} failed: {' '.join(names)}"]
    for name in names:
        parts = inside(printed.get(name, ""))
        more = f" and {len(parts) - MOST} more" if len(parts) > MOST else ""
        what = f" ({', '.join(parts[:MOST])}{more})" if parts else ""
        text.append(f"test: {name}{what}; alone: tools/test -R '^{name}$'")
    return text


if __name__ == "__main__":
    print("\n".join(lines(*sys.argv[1:3])))
