#!/usr/bin/python3
"""Every file in petsc_options/solvers gives the same waveform, with and without airflow, under pressure and under flow;
Krylov counts of the iterative files stay low whatever the permeability and the step.
"""
import glob
import itertools
import os
import unittest

import numpy as np

import pulmo_case as pc

SPRINGS = ["-chest_wall", "-tissue", "yoshihara"]
PCV = ["-ventilator", "pcv", "-ventilator_inspiration", "0.2", "-ventilator_expiration", "0.1"]
VCV = ["-ventilator", "vcv", "-ventilator_tidal_volume", "40", "-ventilator_inspiration", "0.2", "-ventilator_pause", "0.1",
       "-ventilator_expiration", "0.1"]
SCENES = {
    "pcv": SPRINGS + ["-airflow"] + PCV,
    "vcv": SPRINGS + ["-airflow"] + VCV,
    "vcv, common pressure": SPRINGS + ["-airflow"] + VCV + ["-ventilator_flow_split", "common_pressure"],
    "pcv without airflow": SPRINGS + PCV,
    "vcv without airflow": SPRINGS + VCV,
    "pcv on pins": ["-tissue", "yoshihara", "-support", "-support_rigid", "-airflow"] + PCV,
}
ON_TWO_RANKS = ("pcv", "vcv, common pressure", "pcv without airflow")


def run(solver, options, ranks=1):
    return pc.finished(pc.options_file(f"solvers/{solver}") + pc.LUNG + pc.PAPER + options, ranks=ranks)


def solver_files():
    return sorted(os.path.basename(f) for f in glob.glob(os.path.join(pc.SOURCE, "petsc_options/solvers/*.opts")))


def usable(files):
    """Those of the files that this PETSc can do."""
    return [f for f in files if f != "iterative_ml.opts" or pc.has_ml()]


def text_of(*path):
    with open(os.path.join(pc.SOURCE, *path)) as f:
        return f.read()


class Solvers(unittest.TestCase):
    def test_same_waveforms(self):
        self.assertGreaterEqual(len(solver_files()), 7)
        files = usable(solver_files())
        for name, options in SCENES.items():
            reference = run("tight.opts", options).signals()
            for file, ranks in itertools.product(files, (1, 2) if name in ON_TWO_RANKS else (1,)):
                if (file, ranks) == ("tight.opts", 1):
                    continue  # the reference itself
                with self.subTest(scene=name, solver=file, ranks=ranks):
                    signals = run(file, options, ranks).signals()
                    for column in ("airway_pressure_cmH2O", "volume_ml"):
                        error = np.abs(signals[column] - reference[column]).max()
                        self.assertLess(error, 1e-6 * np.abs(reference[column]).max(), column)

    def test_old_jacobians_cost_no_step(self):
        """Where a kept Jacobian serves badly or fails, new ones come before any step is cut."""
        jump = SPRINGS + ["-airflow"] + PCV + ["-ventilator_pip", "25", "-ventilator_ramp", "0", "-ts_dt", "0.1"]
        flags = ["-snes_lag_jacobian", "1000", "-snes_lag_preconditioner", "1000"]
        plain = run("tight.opts", jump)
        for file in ("iterative.opts", "reuse.opts"):
            with self.subTest(solver=file):
                case = run(file, jump + flags)
                self.assertEqual(len(case.signals()["time_s"]), len(plain.signals()["time_s"]))
                error = np.abs(case.signals()["volume_ml"] - plain.signals()["volume_ml"]).max()
                self.assertLess(error, 1e-6 * np.abs(plain.signals()["volume_ml"]).max())

    def test_iterations_stay_low(self):
        new = ["-ksp_rtol", "1e-5", "-snes_lag_jacobian", "1", "-snes_lag_preconditioner", "1"]
        for file in usable(("iterative.opts", "iterative_hypre.opts", "iterative_ml.opts")):
            for ranks, k, dt in [(1, "1e4", "1e-3"), (1, "1e4", "0.2"), (2, "1e4", "0.05"), (1, "1e2", "0.05"), (1, "1", "0.05"),
                                 (1, "1e-4", "0.05"), (1, "1e-4", "1e-3")]:
                with self.subTest(file=file, ranks=ranks, permeability=k, dt=dt):
                    case = run(file, SPRINGS + ["-airflow", "-airflow_permeability", k, "-ventilator", "pcv", "-ts_dt", dt,
                                                "-ts_max_time", str(2 * float(dt))] + new, ranks)
                    numbers = case.json()
                    self.assertGreater(numbers["newton_iterations"], 0)
                    self.assertLessEqual(numbers["krylov_iterations"], 15 * numbers["newton_iterations"])

    def test_iterations_stay_low_where_the_tissue_is_neutral(self):
        """Birzle's tissue crosses its plateau, where dp/dJ all but vanishes: a pressure preconditioner that counts on the bulk
        modulus takes 13 iterations a Newton step there."""
        case = pc.finished(pc.options_file("solvers/iterative.opts") + pc.LUNG + pc.options_file("scenes/pcv.opts") + [
            "-tissue", "birzle", "-ventilator_pip", "15", "-ventilator_settle", "off", "-ts_max_time", "0.5"])
        numbers = case.json()
        self.assertGreater(case.signals()["max_J"].max(), 3)
        self.assertLessEqual(numbers["krylov_iterations"], 10 * numbers["newton_iterations"])

    def test_no_copy_of_the_displacement_changes_nothing(self):
        """The same iterations as with PETSc's copy; where PETSc changes the matrix, or makes it by differences, it copies anyway."""
        short = SPRINGS + ["-airflow"] + PCV + ["-ts_max_time", "0.1"]
        for ranks, more in (1, []), (2, []), (1, ["-ksp_diagonal_scale"]), (
                1, ["-snes_fd_color", "-pc_fieldsplit_schur_precondition", "selfp", "-ts_max_time", "0.05"]):
            with self.subTest(ranks=ranks, options=more):
                view, copy = (run("iterative.opts", short + more + other, ranks) for other in ([], ["-fieldsplit_displacement_pmg_copy"]))
                for count in ("newton_iterations", "krylov_iterations"):
                    self.assertAlmostEqual(view.json()[count], copy.json()[count], delta=1 if ranks > 1 else 0)
                a, b = (case.signals()["volume_ml"] for case in (view, copy))
                self.assertLess(np.abs(a - b).max(), 1e-7 * np.abs(b).max())

    def test_each_file_names_its_blocks_and_is_documented(self):
        page = text_of("docs/performance/solvers.md")
        for file in solver_files():
            with self.subTest(solver=file):
                self.assertIn(f"`petsc_options/solvers/{file}`", page)
                if file != "tight.opts":  # direct.opts with other tolerances
                    header = [line.split()[1] for line in text_of("petsc_options/solvers", file).splitlines()
                              if line.startswith("#   ") and line[4] != " "]
                    self.assertEqual(header, ["TS", "SNES", "KSP", "PC"])

    def test_variants_differ_in_their_coarse_solver_only(self):
        def options(file):
            return [line for line in text_of("petsc_options/solvers", file).splitlines()
                    if not line.startswith(("#", "-fieldsplit_displacement_pmg_coarse_"))]

        for file in ("iterative_hypre.opts", "iterative_ml.opts"):
            self.assertEqual(options(file), options("iterative.opts"), file)
        spares = ("-snes_lag_", "-newton_refresh", "-predictor_increments", "-ksp_rtol")
        soft, plain = (text_of("petsc_options/solvers", file).splitlines() for file in ("iterative_soft.opts", "iterative.opts"))
        self.assertEqual(*([line for line in lines if not line.startswith(("#", *spares))] for lines in (soft, plain)))
        self.assertEqual([line for line in soft if line.startswith(spares)], ["-predictor_increments 2", "-ksp_rtol 1e-3"])

        def but_for_the_displacement(file):
            return [line for line in options(file) if not line.startswith("-fieldsplit_displacement_")]

        self.assertEqual(but_for_the_displacement("iterative_flat.opts"), but_for_the_displacement("iterative.opts"))


if __name__ == "__main__":
    pc.main()
