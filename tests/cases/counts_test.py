#!/usr/bin/python3
"""The work of the solver does not grow unnoticed: totals of Newton and Krylov iterations of small scenes beside counts.csv, and
what an integral costs beside PETSc's own integration.

Counts do not depend on the machine, times do: so times are compared only within one process.
After a change that is meant to change the counts: tests/cases/counts_test.py build/pulmo --renew, and look at the difference in Git.
"""
import csv
import json
import os
import statistics
import subprocess
import sys
import unittest

import pulmo_case as pulmo

TABLE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "counts.csv")
COUNTS = ["steps", "newton_iterations", "krylov_iterations"]
MARGIN = 0.15  # above the table: the solver has become worse
STALE = 0.5  # below this share of it: the table would no longer notice

ITERATIVE = pulmo.options_file("solvers/iterative.opts") + pulmo.QUIET
BIRZLE = ["-tissue", "birzle"]
SCENES = {
    "pcv": pulmo.PCV + pulmo.LUNG + BIRZLE + ["-ts_max_time", "0.6"],
    "vcv": pulmo.VCV + pulmo.LUNG + BIRZLE + ["-ventilator_tidal_volume", "250", "-ts_max_time", "0.6"],
    "vcv_common_pressure": pulmo.VCV + pulmo.COMMON + pulmo.LUNG + BIRZLE + [
        "-lumen_pressure", "-ventilator_tidal_volume", "250", "-ts_max_time", "0.6"],
    "pcv_ma": pulmo.PCV + pulmo.LUNG + ["-tissue", "ma", "-lumen_pressure", "-ts_max_time", "0.6"],
    "pcv_viscoelastic_recruitment": pulmo.PCV + pulmo.LUNG + BIRZLE + [
        "-viscoelastic", "-recruitment", "-recruitment_opening_pressure", "0.4", "-recruitment_closing_pressure", "0.2",
        "-recruitment_gain", "0.2", "-recruitment_start", "0.3", "-ts_max_time", "0.6"],
    "upright_yoshihara": pulmo.PCV + pulmo.LUNG + ["-tissue", "yoshihara", "-gravity", "-gravity_direction", "0,0,-1", "-ts_max_time", "0.6"],
}


def counted(name):
    summary = pulmo.finished(ITERATIVE + SCENES[name], timeout=120).json()
    return {count: summary[count] for count in COUNTS}


def stated():
    with open(TABLE, newline="") as file:
        return {row["scene"]: {count: int(row[count]) for count in COUNTS} for row in csv.DictReader(file)}


def renew():
    """Writes the table anew, and prints what was and what is."""
    old = stated() if os.path.exists(TABLE) else {}
    new = {name: counted(name) for name in SCENES}
    with open(TABLE, "w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["scene", *COUNTS])
        for name, counts in new.items():
            rows.writerow([name, *counts.values()])
            print(f"{name}: {old.get(name, 'none')} -> {counts}")


class Counts(unittest.TestCase):
    def test_table_is_of_these_scenes(self):
        self.assertEqual(list(stated()), list(SCENES), "counts.csv is not of these scenes: --renew")

    def expect_counts(self, name):
        found, table = counted(name), stated()[name]
        said = f"{found} beside {table} in counts.csv"
        for count in COUNTS:
            self.assertGreater(table[count], 0)
            self.assertLessEqual(found[count], (1 + MARGIN) * table[count], f"more {count} than there were: {said}")
            self.assertGreaterEqual(found[count], STALE * table[count], f"counts.csv is stale, renew it (--renew): {said}")


def add(name):
    setattr(Counts, "test_" + name, lambda self: self.expect_counts(name))


for _name in SCENES:
    add(_name)


class Integration(unittest.TestCase):
    def test_integrals_beside_those_of_petsc(self):
        """CPU time per cell, both in one process. Medians of some processes: others share the cores, and PETSc's is timed once in each."""
        program = os.path.join(os.path.dirname(pulmo.PROGRAM), "pulmo_assembly_benchmark")
        ratios = {"residual": [], "jacobian": []}
        for _ in range(3):
            run = subprocess.run([program] + pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + BIRZLE + ["-benchmark_repeats", "7"],
                                 env=pulmo.ENVIRONMENT, capture_output=True, text=True, timeout=120, check=True)
            times = json.loads(run.stdout.splitlines()[-1])
            for what, all_ratios in ratios.items():
                self.assertLess(times[f"{what}_difference"], 1e-12, "not the same integral: times mean nothing")
                all_ratios.append(times[f"stock_{what}_us"] / times[f"{what}_us"])
        for what, least in (("residual", 8), ("jacobian", 40)):  # measured: 17 and 120 here, 13 to 17 and 72 to 90 on larger meshes
            self.assertGreater(statistics.median(ratios[what]), least, f"PETSc's time over pulmo's, {what}: {ratios[what]}")


if __name__ == "__main__":
    if "--renew" in sys.argv:
        pulmo.PROGRAM = os.path.abspath(sys.argv[1])
        renew()
    else:
        pulmo.main()
