#!/usr/bin/python3
"""Ranks, partitioner and integrator change nothing but the time it takes."""
import unittest

import h5py
import numpy as np

import pulmo_case as pulmo

PINS = ["-chest_wall", "off", "-support", "-support_rigid"]
# what the step control and Newton did may differ by an iteration at the rounding floor
COMPARED = ["time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml", "dt_s", "min_J", "max_J"]

SCENES = {
    "airflow": [],
    "no airflow": ["-airflow", "off"],
    "lumen pressure": ["-lumen_pressure"],
    "pins": PINS + ["-ventilator_pip", "4"],
    "no airflow, lumen pressure": ["-airflow", "off", "-lumen_pressure", "-tissue", "yoshihara"],
    "no airflow, pins": PINS + ["-airflow", "off", "-tissue", "ma"],
    "quadrature degree 4": ["-quadrature_degree", "4"],
    "P1-P1": ["-elements", "P1-P1", "-pressure_damping"],
    "P3-P2": ["-elements", "P3-P2", "-lumen_pressure", "-ventilator_ramp_down", "0.2"],
}

VENTILATORS = {
    "vcv, uniform": ["-ventilator_flow_split", "uniform"],
    "vcv, common pressure": ["-ventilator_flow_split", "common_pressure"],
    "vcv, uniform, P3-P2": ["-ventilator_flow_split", "uniform", "-elements", "P3-P2"],
    "vcv, common pressure, P3-P2": ["-ventilator_flow_split", "common_pressure", "-elements", "P3-P2"],
    "vcv, no airflow": ["-airflow", "off"],
    "vcv, no airflow, pins": PINS + ["-airflow", "off", "-tissue", "yoshihara"],
    "vcv, tube, lumen pressure": ["-tube", "-tube_k1", "2", "-tube_k2", "1000", "-lumen_pressure"],
    "tube on pressure control": ["-ventilator", "pcv", "-ventilator_pip", "5", "-tube", "-tube_k1", "2000"],
}


class Parallel(unittest.TestCase):
    def expect_same(self, reference, other, tolerance=1e-8):
        a, b = reference.signals(), other.signals()
        self.assertEqual(list(a), list(b))
        self.assertEqual(len(a["time_s"]), len(b["time_s"]), "number of steps")
        self.assertEqual(a.get("phase"), b.get("phase"))
        for column in COMPARED:
            scale = np.abs(a[column]).max()
            self.assertGreater(scale, 0, f"{column} is all zero: nothing was compared")
            self.assertLess(np.abs(a[column] - b[column]).max() / scale, tolerance, column)

    def expect_scenes_same(self, base, variants, scenes):
        for name in scenes:
            options = base + {**SCENES, **VENTILATORS}[name]
            reference = pulmo.finished(options)
            self.assertEqual(reference.json()["ranks"], 1)
            self.assertEqual(reference.json()["integration"], "pulmo")
            self.assertGreater(reference.signals()["volume_ml"].max(),
                               0.01 * reference.json()["reference_volume_ml"], "the lung hardly moved")
            for ranks, more in variants:
                with self.subTest(scene=name, ranks=ranks, options=" ".join(more)):
                    other = pulmo.finished(options + more, ranks=ranks)
                    self.assertEqual(other.json()["ranks"], ranks)
                    self.assertEqual(other.json()["dofs"], reference.json()["dofs"])
                    self.assertEqual(other.json()["cells"], reference.json()["cells"])
                    self.assertNotIn("was not used", other.out)
                    self.expect_same(reference, other)

    def test_cube_full_breath(self):
        breath = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + [
            "-ventilator_inspiration", "0.3", "-ventilator_expiration", "0.3"]
        self.expect_scenes_same(breath, [(2, []), (3, [])], SCENES)

    # phases of flow, a pause and expiration; the cube holds 1 ml
    BREATH = ["-ventilator_inspiration", "0.1", "-ventilator_pause", "0.05", "-ventilator_expiration", "0.05"]
    VCV = ["-ventilator", "vcv", "-ventilator_tidal_volume", "0.2"]

    def test_flow_phases(self):
        for name in VENTILATORS:
            vcv = [] if name == "tube on pressure control" else self.VCV
            self.expect_scenes_same(pulmo.TIGHT + pulmo.SCENE + pulmo.CUBE + self.BREATH + vcv, [(2, []), (3, [])],
                                    [name])

    def test_flow_phases_of_the_stock_integrator(self):
        for name, ranks in (("vcv, uniform", 1), ("vcv, uniform", 2), ("vcv, common pressure", 2),
                            ("tube on pressure control", 1)):
            with self.subTest(scene=name, ranks=ranks):
                vcv = [] if name == "tube on pressure control" else self.VCV
                breath = pulmo.TIGHT + pulmo.SCENE + pulmo.CUBE + self.BREATH + vcv + VENTILATORS[name]
                own = pulmo.finished(breath)
                stock = pulmo.finished(breath + ["-petscfe_type", "basic"], ranks=ranks)
                self.assertEqual(stock.json()["integration"], "basic")
                self.expect_same(own, stock)

    def test_cube_partitioners(self):
        short = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.2"]
        self.expect_scenes_same(short, [(3, ["-petscpartitioner_type", "metis"]), (2, ["-petscpartitioner_type", "ptscotch"])],
                                ["lumen pressure", "no airflow, pins"])

    def test_lung_few_steps(self):
        short = pulmo.TIGHT + pulmo.PCV + pulmo.LUNG + ["-ts_max_time", "0.1"]
        self.expect_scenes_same(short, [(2, ["-petscpartitioner_type", "ptscotch"]), (3, ["-petscpartitioner_type", "metis"])],
                                ["airflow"])
        self.expect_scenes_same(short, [(3, [])], ["pins"])

    def test_the_stock_integrator(self):
        short = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.1"]
        for name, ranks in (("airflow", 1), ("lumen pressure", 2), ("pins", 1), ("no airflow", 2),
                            ("no airflow, pins", 1), ("quadrature degree 4", 1), ("P3-P2", 2)):
            with self.subTest(scene=name, ranks=ranks):
                own = pulmo.finished(short + SCENES[name])
                explicit = pulmo.finished(short + SCENES[name] + ["-petscfe_type", "pulmo"])
                stock = pulmo.finished(short + SCENES[name] + ["-petscfe_type", "basic"], ranks=ranks)
                self.assertEqual(stock.json()["integration"], "basic")
                self.assertEqual(explicit.json()["integration"], "pulmo")
                self.expect_same(own, explicit, 1e-13)
                self.expect_same(own, stock)

    def test_the_stock_integrator_on_the_lung(self):
        one = pulmo.TIGHT + pulmo.PCV + pulmo.LUNG + ["-airflow", "off", "-ventilator_pip", "2", "-ventilator_ramp", "0",
                                                      "-ts_max_time", "0.05"]
        self.expect_same(pulmo.finished(one), pulmo.finished(one + ["-petscfe_type", "basic"], ranks=2))

    def test_quadrature_is_not_ignored(self):
        """The rule of degree 4 gives a slightly different answer, or the comparison above proves nothing."""
        short = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.1"]
        a = pulmo.finished(short).signals()["volume_ml"]
        b = pulmo.finished(short + ["-quadrature_degree", "4"]).signals()["volume_ml"]
        change = np.abs(a - b).max() / a.max()
        self.assertGreater(change, 1e-12)
        self.assertLess(change, 1e-2)

    def test_fields(self):
        """Displacement and pressure of every node, found by its coordinates, and J of every cell."""
        short = pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", "0.2"]

        def fields(case):
            with h5py.File(case.path("fields.h5")) as f:
                x, cells = f["geometry"][:], f["topology"][:].reshape(-1, 10)
            with h5py.File(case.path("fields_00001.h5")) as f:
                u, p, J = f["displacement_mm"][:].reshape(-1, 3), f["alveolar_pressure_cmH2O"][:], f["J_mean"][:]
            order = np.lexsort(np.round(x, 6).T)
            middles = np.round(x[cells[:, :4]].mean(axis=1), 6)
            cell_order = np.lexsort(middles.T)
            return x[order], u[order], p[order], middles[cell_order], J[cell_order]

        for pair in ("P2-P1", "P1-P1", "P3-P2"):
            one = fields(pulmo.finished(short + ["-elements", pair]))
            three = fields(pulmo.finished(short + ["-elements", pair], ranks=3))
            for name, a, b in zip(("coordinates", "displacement", "pressure", "cells", "J"), one, three):
                with self.subTest(pair, values=name):
                    self.assertEqual(a.shape, b.shape)
                    self.assertGreater(np.abs(a).max(), 0)
                    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * np.abs(a).max())


if __name__ == "__main__":
    pulmo.main()
