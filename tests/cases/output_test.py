#!/usr/bin/python3
"""The contract of what a run leaves: signals.csv, summary.json, fields.xdmf, the ledger, -help, exit codes.

Numbers are worked out again here from the signals and fields, with formulas of their own.
"""
import math
import os
import re
import unittest

import h5py
import meshio
import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkIdList, vtkPoints
from vtkmodules.vtkCommonDataModel import VTK_QUADRATIC_TETRA, vtkQuadraticTetra, vtkUnstructuredGrid

import pulmo_case as pulmo

COLUMNS = ["time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml", "phase", "dt_s", "newton_iterations",
           "krylov_iterations", "min_J", "max_J"]
PIP, PEEP, INSPIRATION, PAUSE, EXPIRATION, RAMP, RAMP_DOWN, BREATHS, DT = 7.0, 2.0, 0.3, 0.12, 0.4, 0.08, 0.06, 2, 0.05
BREATHING = ["-ventilator_pip", PIP, "-ventilator_peep", PEEP, "-ventilator_inspiration", INSPIRATION,
             "-ventilator_pause", PAUSE, "-ventilator_expiration", EXPIRATION, "-ventilator_ramp", RAMP,
             "-ventilator_ramp_down", RAMP_DOWN, "-ventilator_breaths", BREATHS, "-ts_dt", DT]
# numbers of a breath that need the fields (audit_test.py)
NUMBERS_OF_FIELDS = {"auto_peep_cmH2O", "total_peep_cmH2O", "static_compliance_ml_per_cmH2O", "energy_j",
                     "inspiratory_energy_j"}
EXTENT = {"complete", "start_s", "end_of_inspiration_s", "end_s"}
# slow enough to leave some gas behind
GAS = ["-airflow_permeability", "300"]


def schedule():
    """(phase, breath, begin, end, from, to, ramp) of BREATHING."""
    phases, t = [], 0.0
    for name, breath, duration, a, b, ramp in [("settle", 0, RAMP + EXPIRATION, 0, PEEP, RAMP)] + [
            phase for breath in range(1, BREATHS + 1) for phase in (
                ("inspiration", breath, INSPIRATION, PEEP, PIP, RAMP), ("pause", breath, PAUSE, PIP, PIP, 0),
                ("expiration", breath, EXPIRATION, PIP, PEEP, RAMP_DOWN))]:
        phases.append((name, breath, t, t + duration, a, b, ramp))
        t += duration
    return phases


def phase_of(t):
    """The phase with t in (begin, end]."""
    return next(p for p in schedule() if t <= p[3] + 1e-9)


def quadratic_shapes(x):
    """Gradients (10 x 3) of the quadratic tetrahedron in VTK's order at the reference point x."""
    l = np.array([1 - sum(x), *x])
    d = np.array([[-1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    corner = [(4 * l[i] - 1) * d[i] for i in range(4)]
    edge = [4 * (l[i] * d[j] + l[j] * d[i]) for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    return np.array(corner + edge)


def tetrahedron_rule(n=4):
    """Collapsed Gauss-Legendre rule, exact to degree 2n - 3."""
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = (x + 1) / 2, w / 2
    for a, wa in zip(x, w):
        for b, wb in zip(x, w):
            for c, wc in zip(x, w):
                yield (a, b * (1 - a), c * (1 - a) * (1 - b)), wa * wb * wc * (1 - a) ** 2 * (1 - b)


def jacobians(x, u, cells):
    """Volume of each cell, integral of J over it and the least J at the points of a rule of its own."""
    volume, integral, least = np.zeros(len(cells)), np.zeros(len(cells)), math.inf
    for point, weight in tetrahedron_rule():
        g = quadratic_shapes(point)
        dX = np.einsum("cni,nj->cij", x[cells], g)
        dx = np.einsum("cni,nj->cij", (x + u)[cells], g)
        D = np.linalg.det(dX)
        volume += weight * D
        integral += weight * np.linalg.det(dx)
        least = min(least, (np.linalg.det(dx) / D).min())
    return volume, integral, least


def fit(rows, peep, start=None):
    """C_rs (ml/cmH2O) and R (cmH2O s/l) by numpy's least squares over rows (time, P, V, flow, dt); start: V_0."""
    P, V, Q, dt = (rows[c] for c in ("airway_pressure_cmH2O", "volume_ml", "flow_ml_per_s", "dt_s"))
    w = np.sqrt(dt[1:])
    A = np.column_stack([(V[1:] - (V[0] if start is None else start)) * w, Q[1:] * w])
    (E, R), *_ = np.linalg.lstsq(A, (P[1:] - peep) * w, rcond=None)
    return 1 / E, 1000 * R


def cut(rows, first, last):
    return {c: (v[first:last + 1]) for c, v in rows.items()}


def read_fields(case):
    """Points, cells and for each snapshot (time, point data, cell data), through fields.xdmf."""
    with meshio.xdmf.TimeSeriesReader(case.path("fields.xdmf")) as reader:
        points, cells = reader.read_points_cells()
        steps = [reader.read_data(k) for k in range(reader.num_steps)]
        assert len(cells) == 1 and cells[0].type == "tetra10", cells
        return np.asarray(points), np.asarray(cells[0].data), [
            (t, {n: np.asarray(v) for n, v in p.items()}, {n: np.asarray(v[0]) for n, v in c.items()})
            for t, p, c in steps]


OF_CELLS = {"J_mean", "J_min", "hydrostatic_stress_kPa", "von_mises_stress_kPa", "region_number"}


class Breaths(unittest.TestCase):
    """PEEP, settling, pause, ramps up and down, two breaths; airflow with a permeability that traps some gas."""

    @classmethod
    def setUpClass(cls):
        cls.case = pulmo.finished(pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + BREATHING + GAS + ["-effects_view"])
        cls.rows, cls.summary = cls.case.signals(), cls.case.json()
        time = cls.rows["time_s"]
        cls.breaths = []  # first and last row of each: a breath starts at the row where the phase before it ends
        for breath in range(1, BREATHS + 1):
            begin = min(p[2] for p in schedule() if p[1] == breath)
            end = max(p[3] for p in schedule() if p[1] == breath)
            cls.breaths.append((int(np.abs(time - begin).argmin()), int(np.abs(time - end).argmin())))

    def test_files(self):
        snapshots = len(schedule()) + 1
        self.assertEqual(self.case.files(), sorted(
            ["signals.csv", "scene.json", "summary.json", "energy.csv", "fields.xdmf", "fields.h5"] + [f"fields_{i:05d}.h5" for i in range(snapshots)]))
        self.assertEqual(self.case.code, 0)

    def test_columns_and_first_row(self):
        self.assertEqual(self.case.columns(), COLUMNS)
        first = {c: v[0] for c, v in self.rows.items()}
        self.assertEqual(first, {"time_s": 0, "airway_pressure_cmH2O": 0, "flow_ml_per_s": 0, "volume_ml": 0,
                                 "phase": "settle", "dt_s": 0, "newton_iterations": 0, "krylov_iterations": 0,
                                 "min_J": 1, "max_J": 1})

    def test_phases_are_open_on_the_left(self):
        time = self.rows["time_s"]
        for phase in schedule():
            at_end = np.abs(time - phase[3]) < 1e-9
            self.assertEqual(at_end.sum(), 1, f"{phase[0]} ends at {phase[3]} s in exactly one row")
            self.assertEqual(self.rows["phase"][int(at_end.argmax())], phase[0], "the row at a switch is the old phase's")
            ramp = np.abs(time - phase[2] - phase[6]) < 1e-9
            self.assertEqual(ramp.sum(), 1, "a row where the ramp ends")
        expected = ["settle"] + [phase_of(t)[0] for t in time[1:]]
        self.assertEqual(self.rows["phase"], expected)
        self.assertTrue((np.diff(time) > 0).all())
        np.testing.assert_allclose(np.diff(time), self.rows["dt_s"][1:], rtol=1e-10)
        self.assertLessEqual(self.rows["dt_s"].max(), DT * (1 + 1e-9))

    def test_pressure_is_the_programme(self):
        for t, P in zip(self.rows["time_s"][1:], self.rows["airway_pressure_cmH2O"][1:]):
            _, _, begin, _, a, b, ramp = phase_of(t)
            expected = b if t - begin >= ramp - 1e-9 else a + (b - a) * (t - begin) / ramp
            self.assertAlmostEqual(P, expected, places=9, msg=f"at {t} s")
        self.assertGreater(max(self.rows["airway_pressure_cmH2O"]), PIP - 1e-9)

    def test_flow_is_the_change_of_volume(self):
        V, Q, dt = self.rows["volume_ml"], self.rows["flow_ml_per_s"], self.rows["dt_s"]
        scale = np.abs(Q).max()
        self.assertGreater(scale, 0.1)
        self.assertLess(np.abs(Q[1:] - np.diff(V) / dt[1:]).max() / scale, 1e-9)
        inspiration = [i for i, p in enumerate(self.rows["phase"]) if p == "inspiration"]
        self.assertTrue((Q[inspiration] > 0).all(), "flow into the lung is positive")

    def test_mass_balance(self):
        reference = self.summary["reference_volume_ml"]
        self.assertAlmostEqual(reference, 1, places=9)
        self.assertLessEqual(self.summary["mass_balance_error_ml"], 1e-9 * reference)
        V, Q, dt = self.rows["volume_ml"], self.rows["flow_ml_per_s"], self.rows["dt_s"]
        self.assertLessEqual(np.abs(V - np.cumsum(dt * Q)).max(), 1e-9 * reference)
        self.assertGreater(V.max(), 0.1 * reference)

    def test_overall_fit(self):
        """Over the last breath's rows, with the volume above the first breath's start."""
        first, last = self.breaths[-1]
        C, R = fit(cut(self.rows, first, last), PEEP, self.rows["volume_ml"][self.breaths[0][0]])
        self.assertAlmostEqual(self.summary["compliance_ml_per_cmH2O"] / C, 1, places=9)
        self.assertAlmostEqual(self.summary["resistance_cmH2O_s_per_l"] / R, 1, places=9)
        self.assertAlmostEqual(self.summary["time_constant_s"] / (C * R / 1000), 1, places=9)

    def test_numbers_of_each_breath(self):
        self.assertEqual(len(self.summary["breaths"]), BREATHS)
        for (first, last), n in zip(self.breaths, self.summary["breaths"]):
            rows = cut(self.rows, first, last)
            P, V, Q = rows["airway_pressure_cmH2O"], rows["volume_ml"], rows["flow_ml_per_s"]
            C, R = fit(rows, PEEP)
            plateau = [p for p, name in zip(P[1:], rows["phase"][1:]) if name == "pause"][-1]
            work = np.trapz(P - PEEP, V) * pulmo.KPA_PER_CMH2O * 1e-3
            # each row once, with an intercept
            samples = np.column_stack([V[1:], Q[1:], np.ones(len(V) - 1)])
            E_even, R_even, _ = np.linalg.lstsq(samples, P[1:], rcond=None)[0]
            expected = {
                "compliance_equal_weights_ml_per_cmH2O": 1 / E_even,
                "resistance_equal_weights_cmH2O_s_per_l": 1000 * R_even, "compliance_ml_per_cmH2O": C, "resistance_cmH2O_s_per_l": R, "time_constant_s": C * R / 1000,
                "peak_inspiratory_pressure_cmH2O": P.max(), "plateau_pressure_cmH2O": plateau,
                "driving_pressure_cmH2O": plateau - PEEP, "tidal_volume_ml": V.max() - V[0],
                "trapped_volume_ml": V[-1] - V[0], "peak_flow_ml_per_s": Q[1:].max(), "work_j": work,
                "mechanical_power_j_per_min": work * 60 / (INSPIRATION + PAUSE + EXPIRATION), "peep_cmH2O": PEEP,
                "peak_expiratory_flow_ml_per_s": -Q[1:].min(),
                "dynamic_compliance_ml_per_cmH2O": (V.max() - V[0]) / (PIP - PEEP), "strain": (V.max() - V[0]) / 0.99,
                "pause_resistance_cmH2O_s_per_l": None, "static_curve_compliance_ml_per_cmH2O": None}
            self.assertEqual(set(n), set(expected) | NUMBERS_OF_FIELDS | EXTENT)
            self.assertIs(n["complete"], True)
            np.testing.assert_allclose([n["start_s"], n["end_s"]], rows["time_s"][[0, -1]], rtol=1e-14)
            pause = [t for t, name in zip(rows["time_s"], rows["phase"]) if name == "pause"]
            self.assertAlmostEqual(n["end_of_inspiration_s"], pause[-1], places=12)
            for name, value in expected.items():
                if value is None:
                    self.assertIsNone(n[name], name)
                else:
                    self.assertAlmostEqual(n[name], value, delta=1e-9 * max(1, abs(value)), msg=name)
        last = self.summary["breaths"][-1]
        for name in set(last) - EXTENT - {"compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "time_constant_s",
                                 "energy_j", "inspiratory_energy_j"}:
            self.assertEqual(self.summary[name], last[name], name)
        self.assertGreater(abs(self.summary["breaths"][0]["trapped_volume_ml"]), 1e-6)

    def test_static_curve(self):
        """The end of each pause, with the phase that it follows."""
        curve = self.summary["static_curve"]
        ends = [(p[3], before[0]) for before, p in zip(schedule(), schedule()[1:]) if p[0] == "pause"]
        self.assertEqual([point["phase"] for point in curve], [name for _, name in ends])
        for point, (end, _) in zip(curve, ends):
            row = int(np.abs(self.rows["time_s"] - end).argmin())
            self.assertEqual(set(point), {"time_s", "phase", "volume_ml", "pressure_cmH2O"})
            self.assertAlmostEqual(point["time_s"], end, places=9)
            self.assertAlmostEqual(point["volume_ml"], self.rows["volume_ml"][row], places=12)
            self.assertAlmostEqual(point["pressure_cmH2O"], PIP, places=9)

    def test_summary_keys(self):
        s = self.summary
        for name in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "reference_volume_ml", "airway_area_mm2",
                     "surface_area_mm2", "peak_inspiratory_pressure_cmH2O", "plateau_pressure_cmH2O",
                     "driving_pressure_cmH2O", "tidal_volume_ml", "trapped_volume_ml", "peak_flow_ml_per_s",
                     "time_constant_s", "mechanical_power_j_per_min", "mass_balance_error_ml", "min_jacobian",
                     "end_time_s"):
            self.assertIsInstance(s[name], float, name)
            self.assertTrue(math.isfinite(s[name]), name)
        for name in ("steps", "rejected_steps", "newton_iterations", "krylov_iterations", "cells", "dofs", "ranks"):
            self.assertIsInstance(s[name], int, name)
        self.assertIs(s["finished"], True)
        self.assertAlmostEqual(s["airway_area_mm2"], 100, places=9)
        self.assertAlmostEqual(s["surface_area_mm2"], 600, places=9)
        self.assertAlmostEqual(s["surface_areas_mm2"]["pleura"], 500, places=9)
        self.assertEqual(s["steps"], len(self.rows["time_s"]) - 1)
        self.assertEqual(s["newton_iterations"], self.rows["newton_iterations"].sum())
        self.assertEqual(s["krylov_iterations"], self.rows["krylov_iterations"].sum())
        self.assertGreater(s["newton_iterations"], s["steps"])
        self.assertEqual(s["cells"], 100)
        self.assertEqual(s["ranks"], 1)
        self.assertEqual(s["rejected_steps"], 0)
        self.assertAlmostEqual(s["end_time_s"], schedule()[-1][3], places=9)
        self.assertEqual(s["tissue"], "birzle")
        self.assertEqual(s["effects"], ["tissue", "airflow", "ventilator", "chest_wall"])
        self.assertRegex(s["version"], r"^\d+\.\d+\.\d+$")
        self.assertGreater(s["min_jacobian"], 0)
        self.assertAlmostEqual(s["min_jacobian"], self.rows["min_J"].min(), places=12)
        for stage in ("setup", "residual", "jacobian", "solve", "output", "total"):
            self.assertGreater(s["wall_seconds"][stage], 0, stage)
        self.assertAlmostEqual(sum(v for k, v in s["wall_seconds"].items() if k != "total"), s["wall_seconds"]["total"],
                               delta=0.02 * s["wall_seconds"]["total"])
        self.assertEqual(float(s["options"]["-ventilator_pip"]), PIP)
        self.assertEqual(s["options"]["-airflow_permeability"], "300")
        self.assertEqual(s["options"]["-snes_atol"], "1e-12")

    def test_unknowns(self):
        """3 displacements a node, 1 pressure a vertex."""
        points, cells, _ = read_fields(self.case)
        vertices = np.unique(cells[:, :4])
        self.assertEqual(self.summary["dofs"], 3 * len(points) + len(vertices))

    def test_fields(self):
        points, cells, steps = read_fields(self.case)
        self.assertEqual(cells.shape, (100, 10))
        self.assertEqual(sorted(np.unique(cells)), list(range(len(points))), "every node belongs to a cell")
        self.assertEqual(len(np.unique(np.round(points, 9), axis=0)), len(points), "no node twice")
        ends = [0] + [p[3] for p in schedule()]
        np.testing.assert_allclose([t for t, _, _ in steps], ends, atol=1e-9)
        for k, (t, nodal, cellwise) in enumerate(steps):
            self.assertEqual(set(nodal), {"displacement_mm", "alveolar_pressure_cmH2O"})
            self.assertEqual(set(cellwise), OF_CELLS | {"porosity", "ventilation_since_breath_start"})
            self.assertEqual(nodal["displacement_mm"].shape, (len(points), 3))
            self.assertEqual(nodal["alveolar_pressure_cmH2O"].shape, (len(points),))
            for name, values in {**nodal, **cellwise}.items():
                self.assertTrue(np.isfinite(values).all(), name)
                if name in cellwise:
                    self.assertEqual(values.shape, (100,), name)
            row = int(np.abs(self.rows["time_s"] - t).argmin())
            volume, integral, least = jacobians(points, nodal["displacement_mm"], cells)
            self.assertTrue((volume > 0).all(), "VTK's orientation")
            self.assertAlmostEqual(volume.sum(), 1000, places=8)
            self.assertAlmostEqual((integral - volume).sum() / 1000, self.rows["volume_ml"][row], delta=1e-11)
            np.testing.assert_allclose(cellwise["J_mean"], integral / volume, rtol=1e-11)
            np.testing.assert_allclose(cellwise["porosity"], 1 - 0.01 / (integral / volume), rtol=1e-11)
            self.assertGreater(least, 0)
            self.assertTrue((cellwise["J_min"] <= cellwise["J_mean"] * (1 + 1e-14)).all())
            self.assertAlmostEqual(cellwise["J_min"].min(), self.rows["min_J"][row], delta=1e-12)
            # what the cells took in since the breath began is what the signals say
            begun = max([first for first, _ in self.breaths if first < row], default=0)
            self.assertAlmostEqual((cellwise["ventilation_since_breath_start"] * volume).sum() / 1000,
                                   self.rows["volume_ml"][row] - self.rows["volume_ml"][begun], delta=1e-11)
            self.assertEqual(set(cellwise["region_number"]), {self.summary["regions"]["lung"]["number"]})
            airway = np.abs(points[:, 0] - 10) < 1e-9
            self.assertGreater(airway.sum(), 4)
            ventilator = self.rows["airway_pressure_cmH2O"][row]
            np.testing.assert_allclose(nodal["alveolar_pressure_cmH2O"][airway], ventilator, atol=1e-12, rtol=1e-12)
            if k == 0:
                self.assertEqual(np.abs(nodal["displacement_mm"]).max(), 0)
            else:
                self.assertGreater(np.abs(nodal["displacement_mm"]).max(), 0.1)
                self.assertGreater(cellwise["von_mises_stress_kPa"].min(), 0)
        self.assertGreater(np.abs(steps[2][1]["alveolar_pressure_cmH2O"]).min(), 0)

    def test_pressure_between_the_corners_is_linear(self):
        _, cells, steps = read_fields(self.case)
        p = steps[2][1]["alveolar_pressure_cmH2O"]
        for node, (a, b) in zip(range(4, 10), ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))):
            np.testing.assert_allclose(p[cells[:, node]], (p[cells[:, a]] + p[cells[:, b]]) / 2, rtol=1e-12)
        self.assertGreater(np.ptp(p), 1e-3)

    def test_vtk_takes_the_cells(self):
        """VTK itself finds its quadratic tetrahedra upright: a point inside each, with positive volume."""
        points, cells, _ = read_fields(self.case)
        where = vtkPoints()
        where.SetData(numpy_to_vtk(points, deep=True))
        grid = vtkUnstructuredGrid()
        grid.SetPoints(where)
        for cell in cells:
            ids = vtkIdList()
            for node in cell:
                ids.InsertNextId(int(node))
            grid.InsertNextCell(VTK_QUADRATIC_TETRA, ids)
        self.assertEqual(grid.GetNumberOfCells(), 100)
        total = 0.0
        for c in range(grid.GetNumberOfCells()):
            cell = grid.GetCell(c)
            self.assertIsInstance(cell, vtkQuadraticTetra)
            derivative = np.zeros((3, 3))
            gradients = [0.0] * 30
            vtkQuadraticTetra.InterpolationDerivs([0.25, 0.25, 0.25], gradients)
            for i in range(10):
                x = np.array(cell.GetPoints().GetPoint(i))
                derivative += np.outer(x, [gradients[i], gradients[10 + i], gradients[20 + i]])
            self.assertGreater(np.linalg.det(derivative), 0)
            total += np.linalg.det(derivative) / 6  # straight edges: constant
        self.assertAlmostEqual(total, 1000, places=8)

    def test_ledger(self):
        text = self.case.out[self.case.out.index("Effects of this scene"):]
        effects = re.findall(r"^(\w+) .*%$", text, re.M)
        self.assertEqual(effects, self.summary["effects"])
        for word in ("displacement P2", "pressure P1", "airway pressure prescribed on airway", "K_s u . eta on pleura",
                     "[pressure, displacement]", "[displacement, displacement]"):
            self.assertIn(word, text)
        for word in ("lumen_pressure", "support", "traction"):
            self.assertNotIn(word, text)

    def test_numbers_in_words(self):
        self.assertAlmostEqual(self.summary["functional_residual_capacity_ml"], 0.99, places=9)
        for number in (f"{self.summary['compliance_ml_per_cmH2O']:.4g} ml/cmH2O",
                       f"{self.summary['resistance_cmH2O_s_per_l']:.4g} cmH2O s/l",
                       f"{self.summary['tidal_volume_ml']:.4g} ml", self.case.path("summary.json"),
                       self.case.path("signals.csv"), self.case.path("fields.xdmf")):
            self.assertIn(number, self.case.out)


class OtherScenes(unittest.TestCase):
    def test_without_airflow(self):
        """No pressure field and nothing that derives from it."""
        case = pulmo.finished(pulmo.TIGHT + pulmo.CUBE + pulmo.PAPER + [
            "-chest_wall", "-ventilator", "pcv", "-ventilator_inspiration", "0.3", "-ventilator_expiration", "0.3",
            "-effects_view"])
        self.assertEqual(case.columns(), COLUMNS)  # the flow of a ventilated scene is the change of volume
        points, cells, steps = read_fields(case)
        for _, nodal, cellwise in steps:
            self.assertEqual(set(nodal), {"displacement_mm"})
            self.assertEqual(set(cellwise), OF_CELLS | {"ventilation_since_breath_start"})
        for name in case.files():
            if name.endswith(".h5"):
                with h5py.File(case.path(name)) as f:
                    self.assertFalse({"alveolar_pressure_cmH2O", "porosity"} & set(f), name)
        summary = case.json()
        self.assertNotIn("mass_balance_error_ml", summary)
        self.assertEqual(summary["effects"], ["tissue", "ventilator", "chest_wall"])
        self.assertEqual(summary["dofs"], 3 * len(points))
        self.assertNotIn("pressure P1", case.out)
        self.assertNotIn("airflow", case.out)
        rows = case.signals()
        _, integral, _ = jacobians(points, steps[1][1]["displacement_mm"], cells)
        peak = int(np.abs(rows["time_s"] - 0.3).argmin())
        self.assertAlmostEqual(integral.sum() / 1000 - 1, rows["volume_ml"][peak], delta=1e-11)
        # without flow through the tissue the volume follows the pressure at once
        held = [i for i, p in enumerate(rows["phase"]) if p == "inspiration" and rows["time_s"][i] > 0.1 + 1e-9]
        self.assertLess(np.abs(rows["flow_ml_per_s"][held][1:]).max(), 1e-6)

    def test_without_ventilator(self):
        case = pulmo.finished(pulmo.TIGHT + pulmo.CUBE + [
            "-chest_wall", "-airflow", "-traction", "-traction_surfaces", "airway", "-traction_value", "0.05,0,0",
            "-ts_max_time", "0.2"])
        self.assertEqual(case.columns(), [c for c in COLUMNS if c not in ("airway_pressure_cmH2O", "phase")])
        summary = case.json()
        for name in ("compliance_ml_per_cmH2O", "breaths", "tidal_volume_ml"):
            self.assertNotIn(name, summary)
        self.assertIn("mass_balance_error_ml", summary)
        self.assertEqual(summary["effects"], ["tissue", "airflow", "chest_wall", "traction"])
        self.assertGreater(case.signals()["volume_ml"][-1], 1e-3)

    def test_neither_airflow_nor_ventilator(self):
        case = pulmo.finished(pulmo.TIGHT + pulmo.CUBE + [
            "-support", "-support_surfaces", "pleura", "-traction", "-traction_surfaces", "airway", "-traction_value",
            "0.2,0,0", "-ts_max_time", "0.1"])
        self.assertEqual(case.columns(), [c for c in COLUMNS
                                          if c not in ("airway_pressure_cmH2O", "phase", "flow_ml_per_s")])
        self.assertEqual(case.json()["effects"], ["tissue", "support", "traction"])
        points, _, steps = read_fields(case)
        held = (points[:, 0] < 1e-9) | (np.abs(points[:, 1:] - 5).max(axis=1) > 5 - 1e-9)  # the pleura's five faces
        u = steps[-1][1]["displacement_mm"]
        self.assertEqual(np.abs(u[held]).max(), 0)
        self.assertGreater(u[~held][:, 0].max(), 1e-3)

    def test_output_never_changes_the_steps(self):
        base = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ventilator_inspiration", "0.3", "-ventilator_expiration", "0.2"]
        plain = pulmo.finished(base)
        often = pulmo.finished(base + ["-output_fields_every", "0.07", "-progress", "off"])
        with open(plain.path("signals.csv")) as a, open(often.path("signals.csv")) as b:
            self.assertEqual(a.read(), b.read())
        self.assertEqual([round(t, 9) for t, _, _ in read_fields(plain)[2]], [0, 0.3, 0.5])
        # the first step at or after each multiple of 0.07 s
        self.assertEqual([round(t, 9) for t, _, _ in read_fields(often)[2]], [0, 0.1, 0.15, 0.25, 0.3, 0.35, 0.45, 0.5])
        self.assertIn("Newton", plain.out)
        self.assertNotIn("Newton", often.out, "-progress off")

    def test_overwriting_leaves_nothing_of_the_earlier_run(self):
        base = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.1"]
        first = pulmo.finished(base + ["-output_fields_every", "0.05"])
        self.assertIn("fields_00002.h5", first.files())
        with open(first.path("notes.txt"), "w") as f:
            f.write("the user's own\n")
        again = pulmo.finished(base + ["-airflow", "off", "-output_overwrite"], directory=first.directory)
        self.assertEqual(again.files(), sorted(["energy.csv", "fields.h5", "fields.xdmf", "fields_00000.h5", "fields_00001.h5",
                                                "notes.txt", "scene.json", "signals.csv", "summary.json"]))

    def test_several_runs_share_no_file(self):
        """The output directory may be several levels deep and is made."""
        case = pulmo.finished(pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.05"],
                              directory=os.path.join(pulmo.scratch(), "a", "b c"))
        self.assertIn("summary.json", case.files())
        self.assertEqual(len(read_fields(case)[2]), 2)
        self.assertEqual(case.json()["options"]["-output_dir"], case.directory)


class Remembered(unittest.TestCase):
    """-output_fields_memory; what facets remember: tests/unit/point_memory_test.cpp."""

    # the gas inflates the cube evenly
    EVEN = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + pulmo.STILL + [
        "-chest_wall", "off", "-support", "-support_rigid", "-lumen_pressure", "off", "-tissue", "yoshihara", "-viscoelastic",
        "-ts_max_time", "0.2", "-output_fields_every", "0.1"]
    NAMES = ["elastic_stress_xx_kPa", "elastic_stress_yz_kPa", "overstress_2_zz_kPa"]

    def test_stress_of_an_even_inflation(self):
        for ranks in (1, 2):
            _, _, steps = read_fields(pulmo.finished(self.EVEN + ["-output_fields_memory", ",".join(self.NAMES)], ranks=ranks))
            for time, _, cellwise in steps:
                self.assertEqual(set(self.NAMES), {name for name in cellwise if "stress_" in name} - OF_CELLS)
                # F = a I: S = (a / J) a sigma, J = a^3
                elastic, shear, viscous = (cellwise[name] for name in self.NAMES)
                expected = cellwise["hydrostatic_stress_kPa"] * np.cbrt(cellwise["J_mean"])
                np.testing.assert_allclose(elastic, expected, rtol=1e-7, atol=1e-12)
                np.testing.assert_allclose(shear, 0, atol=1e-9)
                self.assertEqual(viscous.min() > 0, time > 0)
            self.assertGreater(steps[-1][2]["elastic_stress_xx_kPa"].min(), 0.01)

    def test_all(self):
        _, _, steps = read_fields(pulmo.finished(self.EVEN + ["-output_fields_memory", "all", "-viscoelastic_moduli", "0.1",
                                                              "-viscoelastic_times", "2"]))
        names = {f"{what}_{c}_kPa" for what in ("elastic_stress", "overstress_1") for c in ("xx", "yy", "zz", "yz", "xz", "xy")}
        self.assertEqual({name for name in steps[-1][2] if "stress_" in name} - OF_CELLS, names)


class ErrorIndicator(unittest.TestCase):
    """-output_fields_error_indicator; against true errors: tests/unit/error_indicator_test.cpp, tests/verification/mms."""

    SHORT = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.2", "-output_fields_error_indicator"]
    NAMES = ["error_indicator_J", "error_indicator_flux_W"]

    def test_any_number_of_ranks(self):
        def by_place(case):
            points, cells, steps = read_fields(case)
            order = np.lexsort(np.round(points[cells[:, :4]].mean(axis=1), 6).T)
            return [steps[-1][2][name][order] for name in self.NAMES]

        one = by_place(pulmo.finished(self.SHORT))
        for ranks in (2, 3):
            for name, a, b in zip(self.NAMES, one, by_place(pulmo.finished(self.SHORT, ranks=ranks))):
                self.assertEqual(a.shape, (100,))
                self.assertGreater(a.min(), 0)
                np.testing.assert_allclose(a, b, rtol=1e-6, err_msg=f"{name}, {ranks} ranks")

    def test_without_airflow(self):
        _, _, steps = read_fields(pulmo.finished(self.SHORT + pulmo.STILL))
        self.assertEqual(set(steps[0][2]), OF_CELLS | {"ventilation_since_breath_start", "error_indicator_J"})
        self.assertEqual(np.abs(steps[0][2]["error_indicator_J"]).max(), 0, "at rest")
        self.assertGreater(steps[-1][2]["error_indicator_J"].min(), 0)

    def test_earlier_snapshots_keep_what_they_have(self):
        """The option may come with a restart; fields.xdmf names what each file holds."""
        plain = [o for o in self.SHORT if o != "-output_fields_error_indicator"]
        case = pulmo.finished(plain + ["-checkpoint_every", "0.1", "-output_fields_every", "0.1"])
        pulmo.finished(self.SHORT + ["-ts_max_time", "0.3", "-output_fields_every", "0.1", "-restart", case.path("checkpoint.h5"),
                                     "-output_overwrite"], directory=case.directory)
        _, _, steps = read_fields(case)
        self.assertEqual(["error_indicator_J" in cellwise for _, _, cellwise in steps], [False, False, False, True])

    def test_large_at_the_rim_of_the_airway(self):
        case = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + pulmo.PCV + pulmo.LUNG + [
            "-ts_max_time", "0.1", "-output_fields_error_indicator"])
        mesh = meshio.read(pulmo.mesh("lung_test.msh"))
        points, cells, steps = read_fields(case)
        corners = points[cells[:, :4]]
        volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
        nodes = [set(mesh.cells_dict["triangle"][mesh.cell_data_dict["gmsh:physical"]["triangle"] == tag].ravel())
                 for tag in (mesh.field_data["airway"][0], mesh.field_data["pleura"][0])]
        rim = mesh.points[sorted(nodes[0] & nodes[1])]
        self.assertGreater(len(rim), 5)
        at_rim = (np.abs(corners[:, :, None] - rim).max(axis=-1) < 1e-6).any(axis=(1, 2))
        self.assertLess(at_rim.sum(), 0.1 * len(cells))
        for name, times in zip(self.NAMES, (5, 30)):
            density = steps[-1][2][name] / volume
            self.assertGreater(np.median(density[at_rim]), times * np.median(density[~at_rim]), name)


class Help(unittest.TestCase):
    # contract: option and unit (None: none of its own)
    OPTIONS = {
        "-mesh_scale": "-", "-predictor_increments": "-", "-newton_refresh": "-",
        "-tissue": None, "-tissue_mu": "kPa", "-tissue_lambda": "kPa", "-tissue_phi0": "-",
        "-tissue_a": "-", "-tissue_b": "-", "-tissue_c": "kPa", "-tissue_beta": "-", "-tissue_c1": "kPa",
        "-tissue_c3": "kPa", "-tissue_d1": "-", "-tissue_d3": "-", "-tissue_c_q": "kPa", "-tissue_c_c": "kPa",
        "-tissue_kappa": "kPa", "-airflow": "on/off", "-airflow_permeability": "mm^2/(kPa s)", "-tissue_porosity": "-",
        "-airflow_surfaces": None, "-chest_wall": "on/off", "-chest_wall_surfaces": None,
        "-chest_wall_stiffness": "kPa/mm", "-chest_wall_stiffness_pleura": "kPa/mm",
        "-chest_wall_stiffness_airway": "kPa/mm", "-chest_wall_direction": None, "-ventilator": None,
        "-ventilator_pip": "cmH2O", "-ventilator_peep": "cmH2O", "-ventilator_inspiration": "s",
        "-ventilator_pause": "s", "-ventilator_expiration": "s", "-ventilator_ramp": "s", "-ventilator_ramp_down": "s",
        "-ventilator_breaths": "-", "-lumen_pressure": "on/off", "-lumen_pressure_surfaces": None, "-support": "on/off",
        "-support_rigid": "on/off", "-support_surfaces": None, "-traction": "on/off", "-traction_surfaces": None,
        "-traction_value": "kPa", "-quadrature_degree": "-", "-output_dir": "text", "-output_overwrite": "on/off",
        "-output_fields_every": "s", "-output_fields_memory": None, "-output_fields_error_indicator": "on/off", "-progress": "on/off", "-effects_view": "on/off", "-energy_audit": "on/off",
        "-gravity": "on/off", "-gravity_direction": "-", "-gravity_acceleration": "m/s^2", "-gravity_tissue_density": "kg/m^3",
        "-gravity_air_density": "kg/m^3"}

    def test_every_option_with_its_unit(self):
        case = pulmo.finished(["-help"])
        self.assertEqual(case.files(), [], "-help writes nothing")
        own = case.out[case.out.index("pulmo's own options"):]
        listed = {}
        for line in own.splitlines():
            found = re.match(r"\s+(-\w+)\s+(.+) \[([^\]]+)\](.*) \(default (.+)\)$", line)
            if line.startswith("  -"):
                self.assertIsNotNone(found, f"no unit, no help or no default: {line}")
                listed.setdefault(found[1], []).append(found[3])
        for option, unit in self.OPTIONS.items():
            self.assertIn(option, listed)
            if unit:
                self.assertIn(unit, listed[option], option)

    def test_what_the_scene_files_use_is_listed(self):
        own = pulmo.finished(["-help"]).out
        scenes = os.path.join(pulmo.SOURCE, "petsc_options", "scenes")
        used = set()
        for name in os.listdir(scenes):
            with open(os.path.join(scenes, name)) as f:
                used |= set(re.findall(r"^(-(?!options_file)\w+)", f.read(), re.M))
        self.assertGreater(len(used), 5)
        for option in used - {"-dm_plex_filename", "-snes_linesearch_type", "-ts_dt"}:  # PETSc's own
            self.assertRegex(own, rf"(?m)^  {option} ")


if __name__ == "__main__":
    pulmo.main()
