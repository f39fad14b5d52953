#!/usr/bin/python3
"""Branching airways: two compartments in closed form, networks against an evaluation of their own, thirty terminals.

By hand: tests/verification/airway_tree/airway_tree_test.py build/pulmo
"""
import math
import os
import sys
import unittest

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import case_meshes  # noqa: E402
import pulmo_case as pulmo  # noqa: E402

J_PER_CMH2O_ML = pulmo.KPA_PER_CMH2O * 1e-3
# of the two bodies of case_meshes.bodies: 125 and 64 ml
WALL = ["-chest_wall_surfaces", "stiff,soft", "-chest_wall_stiffness_stiff", "0.2", "-chest_wall_stiffness_soft", "0.02"]
VCV = pulmo.options_file("scenes/vcv.opts") + pulmo.FLOW_OF_TWO + pulmo.QUIET + WALL
PCV = pulmo.options_file("scenes/pcv.opts") + pulmo.QUIET + WALL + [
    "-ventilator_inspiration", "0.4", "-ventilator_expiration", "0.4", "-airflow_permeability", "2e3"]
TRACHEA = [
    {"name": "trachea", "length_mm": 60, "diameter_mm": 6, "compliance_ml_per_cmH2O": 0.05},
    {"name": "right", "parent": "trachea", "length_mm": 20, "diameter_mm": 3, "surface": "airway", "region": "body_1"},
    {"name": "left", "parent": "trachea", "resistance_cmH2O_s_per_l": 60, "compliance_ml_per_cmH2O": 0.02,
     "surface": "airway", "region": "body_2"}]


def tree(branches):
    """Options of a table of branches, each a mapping of columns."""
    columns = ["name", "parent", "length_mm", "diameter_mm", "resistance_cmH2O_s_per_l", "compliance_ml_per_cmH2O", "surface", "region"]
    path = pulmo.scratch("tree.csv")
    with open(path, "w") as f:
        f.write(",".join(columns) + "\n")
        for b in branches:
            f.write(",".join(str(b.get(c, "")) for c in columns) + "\n")
    return ["-airway_tree", path]


def star(right, left):
    """Two branches from the opening, cmH2O s/l."""
    return tree([{"name": name, "resistance_cmH2O_s_per_l": R, "surface": "airway", "region": region}
                 for name, R, region in (("right", right, "body_1"), ("left", left, "body_2"))])


def pressure_drop(branch, q, viscosity=1.8e-5, density=1.2):
    """Along a branch at flow q, ml/s, in cmH2O: Poiseuille with Pedley's factor, in SI units."""
    if "resistance_cmH2O_s_per_l" in branch:
        return branch["resistance_cmH2O_s_per_l"] * q / 1000
    L, d, Q = branch["length_mm"] / 1e3, branch["diameter_mm"] / 1e3, np.abs(q) * 1e-6
    reynolds = 4 * density * Q / (math.pi * viscosity * d)
    factor = np.maximum(1, 1.85 / (4 * math.sqrt(2)) * np.sqrt(reynolds * d / L))
    return np.sign(q) * factor * 128 * viscosity * L * Q / (math.pi * d**4) / 98.0665


class Network:
    """What the signals of a run with backward Euler say of each branch, from its children and its surface."""

    def __init__(self, branches, rows):
        self.branches, self.dt = {b["name"]: b for b in branches}, rows["dt_s"][1:]
        self.opening = rows["airway_pressure_cmH2O"]
        self.pressure = {name: rows[f"pressure_{name}_cmH2O"] for name in self.branches}
        self.leaves = {name: rows[f"flow_{name}_ml_per_s"][1:] for name, b in self.branches.items() if "surface" in b}
        self.flow = {name: self.flow_of(name) for name in self.branches}

    def walls(self, name):
        return self.branches[name].get("compliance_ml_per_cmH2O", 0) * np.diff(self.pressure[name]) / self.dt

    def flow_of(self, name):
        children = [c for c, b in self.branches.items() if b.get("parent") == name]
        return self.leaves.get(name, 0) + self.walls(name) + sum(self.flow_of(c) for c in children)

    def above(self, name):
        parent = self.branches[name].get("parent")
        return (self.pressure[parent] if parent else self.opening)[1:]

    def residual(self):
        """By how much the law of any branch is missed, cmH2O."""
        return max(np.abs(self.above(name) - self.pressure[name][1:] - pressure_drop(b, self.flow[name])).max()
                   for name, b in self.branches.items())

    def opening_flow(self):
        return sum(self.flow[name] for name, b in self.branches.items() if not b.get("parent"))


class TwoCompartments(unittest.TestCase):
    """Two lungs of unequal time constants at so small a breath that they are linear: V_i' R_i + E_i V_i = P."""
    P = 0.02  # cmH2O
    LUNGS = pulmo.TIGHT + pulmo.SCENE + WALL + pulmo.QUIET + pulmo.COMMON + ["-airflow_permeability", "1e9", "-ts_type", "bdf"]

    @classmethod
    def setUpClass(cls):
        cls.mesh = case_meshes.bodies("stiff", "soft")
        still = pulmo.finished(cls.LUNGS + cls.mesh + pulmo.programme(f"hold 0.2 pressure {cls.P} ramp 0.1\n") + ["-ts_dt", "0.05"])
        regions = still.json()["regions"]
        volume = np.array([regions[b]["ventilation_ml"] for b in ("body_1", "body_2")])
        cls.E = cls.P / volume  # cmH2O/ml
        cls.R = np.array([0.1, 0.4]) / (1 / cls.E)  # cmH2O s/ml: time constants 0.1 s and 0.4 s
        cls.tree = star(*(1000 * cls.R))

    def volumes(self, programme, dt):
        rows = pulmo.finished(self.LUNGS + self.mesh + self.tree + pulmo.programme(programme) + ["-ts_dt", dt]).signals()
        flows = np.array([rows["flow_right_ml_per_s"], rows["flow_left_ml_per_s"]])
        return rows, flows

    def test_filling_at_constant_pressure(self):
        rows, flows = self.volumes(f"rise 0.8 pressure {self.P} from {self.P} ramp 0.001 dt 0.01\n", 0.01)
        t = rows["time_s"]
        exact = np.array([self.P / E * (1 - np.exp(-t * E / R)) for E, R in zip(self.E, self.R)])
        np.testing.assert_allclose(rows["volume_ml"], exact.sum(axis=0), rtol=0, atol=3e-3 * exact.sum(axis=0).max())

    def test_pendelluft_in_the_pause(self):
        """Flow Q for T, then a pause: V1 + V2 stays and the difference dies with (R1 + R2) / (E1 + E2)."""
        T, volume = 0.2, 0.6 * self.P * (1 / self.E).sum()
        rows, flows = self.volumes(f"inspiration {T} flow {volume / T:.17g} dt 0.005\npause 0.6 hold dt 0.01\n", 0.01)
        t, (E1, E2), (R1, R2) = rows["time_s"], self.E, self.R
        tau, Q = (R1 + R2) / (E1 + E2), volume / T
        # V1' (R1 + R2) + (E1 + E2) V1 = E2 V + R2 V' with V = Q t, then V = Q T
        ramp = lambda s: E2 * Q / (E1 + E2) * (s - tau) + R2 * Q / (E1 + E2)  # noqa: E731
        filled = np.where(t <= T, ramp(t) - ramp(0) * np.exp(-t / tau), 0)
        end = ramp(T) - ramp(0) * np.exp(-T / tau)
        rest = E2 * Q * T / (E1 + E2)
        V1 = np.where(t <= T, filled, rest + (end - rest) * np.exp(-(t - T) / tau))
        exact = np.where(t <= T, E2 * Q / (E1 + E2) + ramp(0) / tau * np.exp(-t / tau), -(V1 - rest) / tau)
        pause = t > T + 0.02
        np.testing.assert_allclose(flows[0][pause], exact[pause], rtol=0, atol=6e-3 * np.abs(exact).max())
        np.testing.assert_allclose(flows.sum(axis=0)[pause], 0, rtol=0, atol=1e-6 * Q)
        self.assertLess(flows[0][pause].max(), 0, "the fast lung gives")
        self.assertGreater(flows[1][pause].min(), 0, "the slow lung takes")


    def test_walls_that_store_gas(self):
        """A trachea of resistance R0 and compliance C before the two: C p' = Q - Q1 - Q2, second order in time."""
        R0, C, Q = 0.05, 0.3 / self.E.sum(), 0.6 * self.P * (1 / self.E).sum() / 0.2
        table = tree([{"name": "trachea", "resistance_cmH2O_s_per_l": 1000 * R0, "compliance_ml_per_cmH2O": C}] + [
            {"name": n, "parent": "trachea", "resistance_cmH2O_s_per_l": 1000 * R, "surface": "airway", "region": b}
            for n, R, b in (("right", self.R[0], "body_1"), ("left", self.R[1], "body_2"))])
        # of (p, V1, V2)
        G, (E1, E2) = 1 / self.R, self.E
        A = np.array([[-G.sum() / C, G[0] * E1 / C, G[1] * E2 / C], [G[0], -G[0] * E1, 0], [G[1], 0, -G[1] * E2]])
        forced = np.array([Q / C, 0, 0])
        rates, modes = np.linalg.eig(A)
        with np.errstate(divide="ignore", invalid="ignore"):
            grown = np.where(np.abs(rates) < 1e-9, 0.2, np.expm1(rates * 0.2) / rates)
        exact = (modes @ (grown * np.linalg.solve(modes, forced))).real[0]
        ends = []
        for dt in ("0.02", "0.01", "0.005"):
            rows = pulmo.finished(self.LUNGS + self.mesh + table + pulmo.programme(f"inspiration 0.2 flow {Q:.17g}\n") + [
                "-ts_dt", dt]).signals()
            ends.append(rows["pressure_trachea_cmH2O"][-1])
            self.assertAlmostEqual(rows["airway_pressure_cmH2O"][-1] - ends[-1], R0 * Q, delta=1e-9)
        self.assertAlmostEqual(ends[-1], exact, delta=6e-3 * exact)
        self.assertGreater(math.log2(abs(ends[0] - ends[1]) / abs(ends[1] - ends[2])), 1.7, ends)


class Branches(unittest.TestCase):
    """Two lungs on a trachea with walls that store gas."""

    @classmethod
    def setUpClass(cls):
        cls.mesh = case_meshes.bodies("stiff", "soft")
        cls.base = pulmo.TIGHT + VCV + cls.mesh
        cls.case = pulmo.finished(cls.base + tree(TRACHEA))
        cls.rows = cls.case.signals()
        cls.network = Network(TRACHEA, cls.rows)

    def test_every_branch(self):
        self.assertLess(self.network.residual(), 1e-10)
        flows = self.rows["flow_ml_per_s"]
        np.testing.assert_allclose(sum(self.network.leaves.values()), flows[1:], rtol=0, atol=1e-8 * flows.max())
        self.assertGreater(np.abs(self.network.walls("trachea")).max(), 1e-3 * flows.max(), "the walls take part")

    def test_the_ventilator_moves_what_it_was_set_to(self):
        inspiration = np.array([p == "inspiration" for p in self.rows["phase"]])[1:]
        self.assertAlmostEqual((self.network.opening_flow() * self.network.dt)[inspiration].sum(), 40, delta=1e-8)
        pause = np.array([p == "pause" for p in self.rows["phase"]])[1:]
        np.testing.assert_allclose(self.network.opening_flow()[pause], 0, rtol=0, atol=1e-7)

    def test_each_lung_alone(self):
        """With the pressure of its branch each body moves as it did in the tree: a second, uncoupled run of each."""
        for name, body in (("right", "stiff"), ("left", "soft")):
            pressures = dict(self.rows, airway_pressure_cmH2O=self.rows[f"pressure_{name}_cmH2O"])
            alone = pulmo.finished(pulmo.TIGHT + pulmo.QUIET + case_meshes.bodies(body) + pulmo.replay(pressures) + [
                "-airflow", "-airflow_permeability", "2e3", "-chest_wall", "-chest_wall_surfaces", body,
                f"-chest_wall_stiffness_{body}", WALL[WALL.index(f"-chest_wall_stiffness_{body}") + 1]]).signals()
            np.testing.assert_allclose(alone["flow_ml_per_s"], self.rows[f"flow_{name}_ml_per_s"], rtol=0, atol=1e-7)

    def test_energy(self):
        with open(self.case.path("energy.csv")) as f:
            columns = f.readline().strip().split(",")
        energy = self.case.signals("energy.csv")
        names = {c.split("_j")[0]: c for c in columns}
        lost = sum((pressure_drop(b, self.network.flow[n]) * self.network.flow[n] * self.network.dt).sum()
                   for n, b in self.network.branches.items()) * J_PER_CMH2O_ML
        given = (self.network.opening[1:] * self.network.opening_flow() * self.network.dt).sum() * J_PER_CMH2O_ML
        self.assertAlmostEqual(energy[names["resistive_airways"]][-1] / lost, 1, delta=1e-9)
        self.assertAlmostEqual(energy[names["ventilator_work"]][-1] / given, 1, delta=1e-9)
        self.assertLess(np.abs(energy[names["residual"]]).max(), 1e-9 * given)

    def test_any_number_of_ranks_and_a_restart(self):
        for ranks in (2, 3):
            other = pulmo.finished(self.base + tree(TRACHEA), ranks=ranks).signals()
            for column in ("airway_pressure_cmH2O", "volume_ml", "pressure_left_cmH2O", "flow_right_ml_per_s"):
                np.testing.assert_allclose(other[column], self.rows[column], rtol=0, atol=1e-8, err_msg=column)
        for scheme in ([], ["-ts_type", "bdf"]):
            table = tree(TRACHEA)
            whole = self.rows if not scheme else pulmo.finished(self.base + table + scheme).signals()
            first = pulmo.finished(self.base + table + scheme + ["-ts_max_time", "0.4", "-checkpoint_every", "0.1"], ranks=2)
            second = pulmo.finished(self.base + table + scheme + ["-restart", first.path("checkpoint.h5")]).signals()
            for column in ("airway_pressure_cmH2O", "volume_ml", "pressure_left_cmH2O", "flow_right_ml_per_s"):
                np.testing.assert_allclose(second[column], whole[column], rtol=0, atol=1e-8, err_msg=column)

    def test_other_branches_are_another_run(self):
        table = tree(TRACHEA)
        first = pulmo.finished(self.base + table + ["-ts_max_time", "0.2", "-checkpoint_every", "0.1"])
        with open(table[1]) as f:
            text = f.read()
        with open(table[1], "w") as f:
            f.write(text.replace("60,6,", "60,5,"))
        again = pulmo.Case(self.base + table + ["-restart", first.path("checkpoint.h5")])
        self.assertEqual(again.code, 1, again.tail())
        self.assertIn("-airway_tree", again.err)


class Limits(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.mesh = case_meshes.bodies("stiff", "soft")

    def test_no_resistance_is_a_common_pressure(self):
        nothing = [dict(b) for b in TRACHEA]
        for b in nothing:
            for column in ("length_mm", "diameter_mm", "compliance_ml_per_cmH2O"):
                b.pop(column, None)
            b["resistance_cmH2O_s_per_l"] = 0
        tube = ["-tube", "-tube_k1", "20", "-tube_k2", "30"]
        limited = pulmo.programme("inspiration 0.4 flow 150 limit 6 breath\npause 0.2 hold\nexpiration 0.4 pressure 1\n")
        for scene in (VCV, PCV, PCV + tube, pulmo.SCENE + pulmo.COMMON + WALL + pulmo.QUIET + limited):
            lung = pulmo.TIGHT + self.mesh + scene
            one, split = (pulmo.finished(lung + o).signals() for o in (tree(nothing), pulmo.COMMON if scene is VCV else []))
            for column in split:
                if column in ("phase", "newton_iterations", "krylov_iterations"):
                    continue
                scale = np.abs(split[column]).max()
                np.testing.assert_allclose(one[column], split[column], rtol=0, atol=1e-10 * max(1, scale), err_msg=column)
            for name in ("trachea", "right", "left"):
                np.testing.assert_allclose(one[f"pressure_{name}_cmH2O"], one["airway_pressure_cmH2O"], rtol=0, atol=1e-10)

    def test_a_trachea_alone_is_a_tube(self):
        K1 = 40.0
        lung = pulmo.TIGHT + self.mesh + PCV
        tube = pulmo.finished(lung + ["-tube", "-tube_k1", K1]).signals()
        branches = pulmo.finished(lung + tree([
            {"name": "trachea", "resistance_cmH2O_s_per_l": K1},
            {"name": "right", "parent": "trachea", "resistance_cmH2O_s_per_l": 0, "surface": "airway", "region": "body_1"},
            {"name": "left", "parent": "trachea", "resistance_cmH2O_s_per_l": 0, "surface": "airway", "region": "body_2"}])).signals()
        np.testing.assert_allclose(branches["airway_pressure_cmH2O"], tube["ventilator_pressure_cmH2O"], rtol=0, atol=1e-8)
        np.testing.assert_allclose(branches["pressure_trachea_cmH2O"], tube["airway_pressure_cmH2O"], rtol=0, atol=1e-8)
        np.testing.assert_allclose(branches["volume_ml"], tube["volume_ml"], rtol=0, atol=1e-8)


class ThirtyTerminals(unittest.TestCase):
    """A lung of a litre with 6 x 5 openings in one face, on a tree that forks in twos."""

    @classmethod
    def setUpClass(cls):
        counts = (3, 11, 9)
        points, cells = case_meshes.kuhn(counts, (100, 100, 100))
        facets = case_meshes.boundary(cells)
        faces = case_meshes.faces_of_box(points, facets, (100, 100, 100))
        names = []
        for facet, face in zip(facets, faces):
            y, z = points[facet].mean(axis=0)[1:] * np.array(counts[1:]) / 100
            open_here = face == "x1" and int(y) % 2 == 0 and int(z) % 2 == 0
            names.append(f"patch_{int(y) // 2}_{int(z) // 2}" if open_here else "pleura")
        cls.mesh = case_meshes.write(points, cells, facets, names)
        cls.patches = sorted(set(names) - {"pleura"})
        assert len(cls.patches) == 30
        cls.branches = cls.fork(cls.patches, "trachea", None, 100, 16)
        cls.case = pulmo.finished(pulmo.DIRECT + pulmo.options_file("scenes/vcv.opts") + pulmo.QUIET + cls.mesh + tree(cls.branches) + [
            "-airflow_surfaces", ",".join(cls.patches), "-chest_wall_surfaces", "pleura", "-elements", "P1-P1",
            "-ventilator_tidal_volume", "100", "-ventilator_inspiration", "0.2", "-ts_max_time", "0.3", "-effects_view"])

    @classmethod
    def fork(cls, patches, name, parent, length, diameter):
        own = {"name": name, "length_mm": length, "diameter_mm": round(diameter, 6)}
        own |= {"parent": parent} if parent else {}
        if len(patches) == 1:
            return [own | {"surface": patches[0]}]
        half = len(patches) // 2
        child = lambda part, letter: cls.fork(part, f"{name}{letter}", name, length * 0.8, diameter * 2 ** (-1 / 3))  # noqa: E731
        return [own] + child(patches[:half], "a") + child(patches[half:], "b")

    def test_every_branch(self):
        self.assertEqual(len(self.branches), 59)
        rows = self.case.signals()
        network = Network(self.branches, rows)
        scale = rows["airway_pressure_cmH2O"].max()
        self.assertLess(network.residual(), 1e-7 * scale)
        np.testing.assert_allclose(network.opening_flow(), rows["flow_ml_per_s"][1:], rtol=0, atol=1e-6 * 500)
        self.assertLess(max(rows["newton_iterations"]), 8)
        self.assertEqual(self.case.out.count("one more solve"), 30)


class Wrong(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.mesh = case_meshes.bodies("stiff", "soft")

    def refused(self, options, words):
        case = pulmo.Case(pulmo.TIGHT + VCV + self.mesh + options)
        self.assertEqual(case.code, 1, case.tail())
        self.assertEqual(case.err.count("pulmo: error:"), 1, case.tail())
        self.assertIn(words, case.err)

    def test_tables(self):
        right, left = TRACHEA[1:]
        trachea = TRACHEA[0]
        for branches, words in (
                ([trachea, right], "fed by no branch"),
                ([trachea, dict(right, parent="trachae"), left], "'trachae'"),
                ([dict(trachea, parent="trachea"), right, left], "does not lead to the opening"),
                ([trachea, right, left, left], "two branches are named 'left'"),
                ([trachea, dict(right, surface=""), left], "must end either"),
                ([dict(trachea, surface="airway"), right, left], "must end either"),
                ([trachea, dict(right, surface="airways"), left], "'airways'"),
                ([trachea, dict(right, region="body_3"), left], "body_1, body_2"),
                ([trachea, dict(right, region=""), left], "touch"),
                ([trachea, dict(right, resistance_cmH2O_s_per_l=3), left], "alone"),
                ([trachea, dict(right, length_mm=""), left], "needs length_mm and diameter_mm"),
                ([trachea, dict(right, diameter_mm="-1"), left], "diameter_mm is -1"),
                ([trachea, dict(right, diameter_mm="1,5"), left], "cells"),
                ([trachea, dict(right, diameter_mm="nan"), left], "must be a number"),
                ([trachea, dict(right, diameter_mm="1e-90"), left], "no finite number"),
                ([trachea, dict(right, compliance_ml_per_cmH2O="1e308"), left], "no finite number"),
                ([trachea, dict(right, name="r\u00e4chts"), left], "one word"),
                ([trachea, right, left, dict(left, name="dead", surface="soft_wall")], "'soft_wall'"),
                ([dict(trachea, name="main stem"), dict(right, parent="main stem"), left], "one word")):
            with self.subTest(words):
                self.refused(tree(branches), words)

    def test_branches_that_end_nowhere(self):
        dead = {"name": "dead", "parent": "trachea", "resistance_cmH2O_s_per_l": 5, "surface": "stiff", "region": "body_2"}
        self.refused(tree(TRACHEA + [dead]) + ["-airflow_surfaces", "airway,stiff"], "'dead' ends at 'stiff' of 'body_2'")

    def test_scenes(self):
        table = tree(TRACHEA)
        self.refused(["-airway_tree", pulmo.scratch("none.csv")], "cannot read")
        self.refused(table + ["-airflow", "off"], "-airflow")
        self.refused(table + pulmo.UNIFORM, "-ventilator_flow_split uniform")
        self.refused(table + ["-airway_tree_resistance", "3"], "-airway_tree star")
        self.refused(table + ["-snes_type", "newtontr"], "-airway_tree")


if __name__ == "__main__":
    pulmo.main()
