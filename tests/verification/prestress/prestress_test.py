#!/usr/bin/python3
"""A lung that is under pressure in the shape of the mesh: in equilibrium there, and as stiff as the lung it was inflated from.

By hand: tests/verification/prestress/prestress_test.py build/pulmo
"""
import os
import re
import subprocess
import sys
import unittest

import h5py
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases"), os.path.join(HERE, "..", "hollow_sphere")]

import pulmo_case as pulmo  # noqa: E402
from pulmo_case import gas_pressure  # noqa: E402
from radial import Birzle, Pressure, Shell, breathe  # noqa: E402

PRESTRESS = 2  # cmH2O: all five laws carry it
ON = ["-prestress", "-prestress_pressure", PRESTRESS]
# what rounding, and a solve to 1e-9, leave of nothing
NOTHING_ML = 1e-9


def inflation(law, pressure, most=6):
    """J of free tissue of a law under a pressure, cmH2O, on the branch from rest."""
    grid = np.linspace(0.5, most, 20000)
    p = np.array([gas_pressure(law, J) for J in grid])
    start = np.searchsorted(grid, 1)
    first = start + np.argmax(p[start:] > pressure) if pressure > p[start] else start - np.argmax(p[start::-1] < pressure) + 1
    return brentq(lambda J: gas_pressure(law, J) - pressure, grid[first - 1], grid[first], xtol=1e-14)


class Prestressed:
    """A law of the radial solver for a shell that was inflated by J0 to its shape at hand: W(s l) / J0 less the work of p_tp."""

    def __init__(self, law, pressure):
        self.law, self.pressure = law, pressure
        J0 = brentq(lambda J: law.stress(np.cbrt(J), np.cbrt(J))[0] / np.cbrt(J) ** 2 - pressure, 1, 2.5, xtol=1e-15)
        self.s = np.cbrt(J0)

    def stress(self, r, t):
        Pr, Pt = self.law.stress(self.s * r, self.s * t)
        return Pr / self.s**2 - self.pressure * t**2, Pt / self.s**2 - self.pressure * r * t

    tangent = Birzle.tangent


class Block(unittest.TestCase):
    """A litre of tissue on rollers inflates freely: J0 J is what p_tp + p makes of tissue at rest."""

    def test_inflation_goes_on_from_the_prestress(self):
        for law in pulmo.CLOSED_FORMS:
            with self.subTest(law=law):
                run = pulmo.finished(pulmo.BLOCK + pulmo.ROLLERS + pulmo.STILL + pulmo.TIGHT + ON + [
                    "-tissue", law] + pulmo.programme("step 0.1 pressure 0\nstep 0.1 pressure 1\nstep 0.1 pressure -1\n") + pulmo.QUIET)
                rows, J0 = run.signals(), inflation(law, PRESTRESS)
                for p, V in zip(rows["airway_pressure_cmH2O"], rows["volume_ml"]):
                    self.assertAlmostEqual(V, 1000 * (inflation(law, PRESTRESS + p) / J0 - 1), delta=1e-6)
                self.assertEqual({*np.round(rows["airway_pressure_cmH2O"], 12)}, {0, 1, -1})
                found = run.json()["prestress"]
                self.assertAlmostEqual(found["unloaded_volume_ml"], 1000 / J0, delta=1e-8)
                self.assertAlmostEqual(found["unloaded_volume_ratio"], 1 / J0, delta=1e-11)

    def test_the_ways_that_are_wrong(self):
        """Deflation by p_tp is not the inverse of inflation; stress without stretch has another compliance."""
        J0 = inflation("birzle", PRESTRESS)
        self.assertGreater(abs(inflation("birzle", -PRESTRESS) * J0 - 1), 0.02)
        slope = (inflation("birzle", PRESTRESS + 1e-3) - inflation("birzle", PRESTRESS - 1e-3)) / 2e-3 / J0
        at_rest = (inflation("birzle", 1e-3) - inflation("birzle", -1e-3)) / 2e-3
        self.assertGreater(slope / at_rest, 1.2)

    def test_parts_of_other_tissue_have_another_stretch(self):
        c = "0.36,left_lung=0.72"
        run = pulmo.finished(["-dm_plex_filename", pulmo.mesh("lung_pair.msh"), "-elements", "P1-P1"] + pulmo.PCV + pulmo.DIRECT + ON +
                             ["-tissue", "yoshihara", "-tissue_c", c, "-ts_max_time", "0.1", "-ventilator_pip", "0"] + pulmo.QUIET)
        regions = run.json()["regions"]

        def unloaded(c):  # p = 2 c (J^-1/3 - J^(-2 beta - 1))
            return 1 / brentq(lambda J: 2 * c * (J ** (-1 / 3) - J ** (-2.5)) / pulmo.KPA_PER_CMH2O - PRESTRESS, 1, 1.7)

        expected = (regions["right_lung"]["reference_volume_ml"] * unloaded(0.36)
                    + regions["left_lung"]["reference_volume_ml"] * unloaded(0.72))
        self.assertAlmostEqual(run.json()["prestress"]["unloaded_volume_ml"], expected, delta=1e-7)
        self.assertLess(np.abs(run.signals()["volume_ml"]).max(), NOTHING_ML)


class Equilibrium(unittest.TestCase):
    """u = 0 of any mesh, with any boundary, law and effect that lets tissue be."""

    def test_nothing_moves(self):
        for law in pulmo.tissue_laws():
            for more in ([], ["-viscoelastic"] if law != "rausch" else [], ["-airflow", "off"]):
                with self.subTest(law=law, more=more):
                    run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ON + ["-tissue", law, "-elements", "P1-P1", "-ventilator_pip", "0",
                                         "-ts_max_time", "0.1", *more] + pulmo.QUIET)
                    rows = run.signals()
                    self.assertLess(np.abs(rows["volume_ml"]).max(), NOTHING_ML)
                    self.assertLess(np.abs(rows["max_J"] - 1).max(), 1e-11)
                    self.assertNotIn("settle", rows["phase"])

    def test_too_much_is_refused(self):
        run = pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "yoshihara", "-prestress", "-prestress_pressure", "40"])
        self.assertEqual(run.code, 1)
        self.assertIn("-prestress_pressure 40", run.err)
        self.assertIn("takes no more than", run.err)
        region = pulmo.Case(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.PCV + pulmo.DIRECT + ON +
                            ["-tissue", "yoshihara", "-tissue_c", "1.3,left_lung=0.01"])
        self.assertEqual(region.code, 1)
        self.assertIn("some part of the lung", region.err)

    def test_each_part_is_held_to_its_own_tissue(self):
        """What no part has is neither refused nor told; the built-in lung is all right_lung."""
        def told(mesh, *options):
            run = pulmo.Case(["-dm_plex_filename", pulmo.mesh(mesh)] + pulmo.PCV + pulmo.DIRECT + ["-elements", "P1-P1", "-prestress", "-scene_view_only", *options])
            self.assertEqual(run.code, 0, run.err)
            return run.out

        told("lung_pair.msh", "-tissue", "concha", "-tissue_wall_modulus", "1,right_lung=10.33,left_lung=20")
        self.assertIn("nearly neutral", told("lung_test.msh", "-tissue", "concha", "-tissue_wall_modulus", "10.33,right_lung=5.85"))
        self.assertNotIn("neutral", told("lung_test.msh", "-tissue", "concha", "-tissue_wall_modulus", "5.85,right_lung=10.33"))
        self.assertIn("has 0.474 of the volume", told("lung_test.msh", "-tissue", "birzle", "-tissue_c", "1e-3,right_lung=0.3567"))
        one = told("lung_pair.msh", "-tissue", "birzle", "-tissue_c", "0.3567,right_lung=2")
        self.assertRegex(one, r"-tissue birzle \(in 1.22e\+03 ml of it\) is nearly neutral")

    def test_no_lung_has_less_than_its_solid(self):
        """ma at 5 cmH2O leaves 61 % of the volume."""
        for method in ("stretch", "inverse"):
            for mesh, porosity, where in (("lung_test.msh", "0.3", ""), ("lung_pair.msh", "0.9,left_lung=0.3", " (in 1.22e+03 ml of it)"),
                                          ("lung_pair.msh", "0.5", None)):
                with self.subTest(method=method, porosity=porosity):
                    run = pulmo.Case(["-dm_plex_filename", pulmo.mesh(mesh)] + pulmo.PCV + pulmo.DIRECT + ["-elements", "P1-P1", "-prestress",
                                     "-prestress_method", method, "-tissue", "ma", "-tissue_porosity", porosity, "-scene_view_only"])
                    self.assertEqual(run.code, 0, run.err)
                    if where is None:
                        self.assertNotIn("less than its own solid", run.out)
                    else:
                        self.assertIn(f"the unloaded lung{where} has 0.612 of the volume of the mesh, less than its own solid, 1 - Phi0 = 0.7", run.out)

    def test_the_porosity_of_a_law_is_told(self):
        """And that the page's way to have the cell of the unloaded tissue conserves its solid."""
        scene = pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-elements", "P1-P1", "-tissue", "concha", "-prestress", "-ts_max_time", "0.05"] + pulmo.QUIET
        told = re.search(r"of as much solid has ([\d.]+), with ([\d.]+) of the volume", pulmo.finished(scene).out)
        porosity, ratio = map(float, told.groups())
        self.assertAlmostEqual(1 - porosity, (1 - 0.69) / ratio, delta=2e-3)
        cell = ["-tissue_wall_modulus", 10.33 / ratio, "-tissue_joint_stiffness", 10.05 / ratio]
        self.assertAlmostEqual(pulmo.finished(scene + cell).json()["prestress"]["unloaded_volume_ratio"], ratio, delta=1e-3)
        self.assertNotIn("as much solid", pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "ma", "-prestress", "-scene_view_only"]).out)

    def test_nearly_neutral_is_told(self):
        run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "birzle", "-prestress", "-elements", "P1-P1", "-ventilator_pip",
                             "0", "-ts_max_time", "0.1"] + pulmo.QUIET)
        self.assertIn("nearly neutral at -prestress_pressure 5", run.out)
        quiet = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "ma", "-prestress", "-elements", "P1-P1", "-ventilator_pip",
                               "0", "-ts_max_time", "0.1"] + pulmo.QUIET)
        self.assertNotIn("neutral", quiet.out)


class HollowSphere(unittest.TestCase):
    """A breath of a prestressed hollow sphere against the radial solver, at equal steps."""

    def test_breath(self):
        scene = pulmo.options_file("scenes/hollow_sphere.opts") + pulmo.DIRECT + pulmo.ROLLERS + ON + pulmo.QUIET
        levels, volumes = (4, 6), []
        for divisions in levels:
            mesh = pulmo.scratch("octant.msh")
            subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", str(divisions), "--layers", str(3 * divisions),
                            "--octant", "--output", mesh], check=True, capture_output=True)
            rows = pulmo.finished(scene + ["-dm_plex_filename", mesh, "-ts_dt", "0.2", "-ts_max_time", "1", "-ventilator_pip", "4"]).signals()
            volumes.append(8 * rows["volume_ml"])
        shell = Shell(law=Prestressed(Birzle(), PRESTRESS * pulmo.KPA_PER_CMH2O))
        pressure = Pressure(4 * pulmo.KPA_PER_CMH2O)
        np.testing.assert_allclose(rows["airway_pressure_cmH2O"] * pulmo.KPA_PER_CMH2O, [pressure(t) for t in rows["time_s"]], atol=1e-12)
        exact, plain = (breathe(s, rows["time_s"], pressure, n=32)["V"] for s in (shell, Shell()))
        errors = [np.abs(V - exact).max() / exact.max() for V in volumes]
        print("\nprestressed sphere: V off by", ", ".join(f"{e:.2e}" for e in errors), f"; without prestress by {abs(plain[-1] / exact[-1] - 1):.2f}")
        self.assertGreater(np.log(errors[0] / errors[1]) / np.log(levels[1] / levels[0]), 1.7)
        limit = volumes[1] + (volumes[1] - volumes[0]) / ((levels[1] / levels[0]) ** 2 - 1)
        self.assertLess(np.abs(limit - exact).max() / exact.max(), 2e-3)
        self.assertGreater(abs(plain[-1] / exact[-1] - 1), 0.1)  # it matters


class Inverse(unittest.TestCase):
    """The unloaded shape that is solved for, and the lung that is loaded again."""
    INVERSE = ON + ["-prestress_method", "inverse"]
    WEIGHT = ["-gravity", "-tissue_porosity", "0.75"]

    def test_uniform_tissue_without_weight_is_stretched_uniformly(self):
        for law in ("birzle", "patte"):
            with self.subTest(law=law):
                breath = pulmo.LUNG + pulmo.PCV + pulmo.TIGHT + pulmo.STILL + ["-tissue", law, "-elements", "P1-P1", "-ts_max_time", "0.1",
                                                                               "-ventilator_pip", "2"] + pulmo.QUIET
                stretch, inverse = (pulmo.finished(breath + on) for on in (ON, self.INVERSE))
                self.assertGreater(stretch.signals()["volume_ml"][-1], 10)
                np.testing.assert_allclose(inverse.signals()["volume_ml"], stretch.signals()["volume_ml"], atol=1e-8)
                unloaded = [run.json()["prestress"]["unloaded_volume_ratio"] for run in (stretch, inverse)]
                self.assertAlmostEqual(unloaded[0], unloaded[1], delta=1e-11)

    def test_shells_of_two_tissues(self):
        """The unloaded volume against the radial equations, on meshes of a hollow sphere."""
        inner, outer, levels, ratios = 30.0, 72.5, (2, 4), []
        laws = (Birzle(), Birzle(c=3 * Birzle.c))
        for divisions in levels:
            mesh, dataset = pulmo.scratch("shells.msh"), pulmo.scratch("shells.h5")
            subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", str(divisions), "--layers", str(2 * divisions),
                            "--inner", str(inner), "--outer", str(outer), "--output", mesh], check=True, capture_output=True)
            nodes, cells = tetrahedra(mesh)
            radii = np.unique(np.round(np.linalg.norm(nodes, axis=1), 6))
            self.assertEqual(len(radii), 2 * divisions + 1)
            outside = np.linalg.norm(nodes[cells], axis=2).max(axis=1) > radii[divisions] + 1e-3
            between = np.cbrt(inner**3 + 3 / (4 * np.pi) * volumes(nodes, cells)[~outside].sum())  # as inner and outer: those of equal volume
            with h5py.File(dataset, "w") as file:
                file["c"] = np.where(outside, laws[1].c, laws[0].c)
            run = pulmo.finished(["-dm_plex_filename", mesh, "-tissue_c", dataset + ":c", "-ts_max_time", "0.1", "-ventilator", "pcv", "-ventilator_pip", "0",
                                  "-tissue", "birzle", "-chest_wall", "-chest_wall_surfaces", "pleura"] + pulmo.STILL + pulmo.DIRECT + self.INVERSE + pulmo.QUIET)
            ratios.append(run.json()["prestress"]["unloaded_volume_ratio"])
            self.assertLess(np.abs(run.signals()["max_J"] - 1).max(), 1e-8)
        exact = unloaded_ratio(laws, (inner, between, outer), PRESTRESS * pulmo.KPA_PER_CMH2O)
        errors = [abs(r / exact - 1) for r in ratios]
        print("\nunloaded shells: ratio", ratios, "exact", exact, "off by", errors)
        self.assertLess(errors[1], errors[0] / 3)
        self.assertLess(errors[1], 5e-5)

    def test_a_lung_under_its_weight_stays_where_it_is(self):
        """Two lungs of two tissues and densities, on one rank and on two: u = 0 to 1e-8 of a litre, and no settling."""
        ratios = []
        for ranks in (1, 2):
            run = pulmo.finished(pulmo.PCV + pulmo.TIGHT + pulmo.STILL + self.INVERSE + [
                "-dm_plex_filename", pulmo.mesh("lung_pair.msh"), "-elements", "P1-P1", "-ventilator_pip", "0", "-ts_max_time", "0.1", "-tissue", "yoshihara",
                "-tissue_c", "0.36,left_lung=0.72", "-gravity", "-tissue_porosity", "0.75,left_lung=0.7"] + pulmo.QUIET, ranks=ranks)
            rows = run.signals()
            self.assertLess(np.abs(rows["volume_ml"]).max(), 1e-5)
            self.assertLess(np.abs(rows["max_J"] - 1).max(), 1e-8)
            self.assertNotIn("settle", rows["phase"])
            ratios.append(run.json()["prestress"]["unloaded_volume_ratio"])
        self.assertAlmostEqual(*ratios, delta=1e-10)

    def test_a_part_that_is_too_weak_is_named(self):
        run = pulmo.Case(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.PCV + pulmo.DIRECT + ["-elements", "P1-P1", "-prestress",
                         "-prestress_method", "inverse", "-tissue", "concha", "-tissue_wall_modulus", "10,left_lung=2"])
        self.assertEqual(run.code, 1)
        self.assertIn("a part of the lung (1.22e+03 ml) takes no more than 1.72 cmH2O", run.err)
        self.assertIn("give less, or that part other parameters", run.err)
        self.assertNotIn("solver", run.err)

    def test_low_parts_ventilate_more(self):
        """In the supine lung, per volume, as in a living one: with the weight in the unloaded shape, and not with a uniform stretch."""
        scene = (pulmo.LUNG + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + pulmo.STILL + self.WEIGHT + pulmo.QUIET
                 + ["-tissue", "ma", "-elements", "P1-P1", "-chest_wall_surfaces", "pleura", "-chest_wall_direction", "normal", "-prestress", "-ts_dt", "0.2"])

        def low_to_high(method):
            thirds = pulmo.finished(scene + ["-prestress_method", method]).json()["gravity"]
            low, high = (thirds[k] for k in ("dependent", "nondependent"))
            return low["ventilation_ml"] / low["reference_volume_ml"] / (high["ventilation_ml"] / high["reference_volume_ml"])

        self.assertGreater(low_to_high("inverse"), 1.3)
        self.assertLess(low_to_high("stretch"), 1)

    def test_a_weight_off_the_centre_is_told(self):
        dataset, word = pulmo.scratch("porosity.h5"), "from the centre of a lung's volume"
        nodes, cells = tetrahedra(pulmo.mesh("cube_msh22_ascii.msh"))
        with h5py.File(dataset, "w") as file:
            file["even"] = np.full(len(cells), 0.75)
            file["heavy_left"] = np.where(nodes[cells].mean(axis=1)[:, 0] < nodes[:, 0].mean(), 0.7, 0.8)
        for name, told in (("even", False), ("heavy_left", True)):
            run = pulmo.Case(["-dm_plex_filename", pulmo.mesh("cube_msh22_ascii.msh"), "-mesh_scale", "100", "-elements", "P1-P1"] + pulmo.PCV + pulmo.DIRECT
                             + pulmo.STILL + self.INVERSE + ["-tissue", "yoshihara", "-gravity", "-tissue_porosity", f"{dataset}:{name}", "-ts_max_time", "0.05"]
                             + pulmo.QUIET)
            self.assertEqual(word in run.out, told, run.out + run.err)

    def test_newtons_matrix(self):
        """d sigma/d f against finite differences."""
        run = pulmo.Case(pulmo.CUBE + pulmo.PCV + pulmo.TIGHT + pulmo.STILL + self.INVERSE + self.WEIGHT + ["-tissue", "birzle", "-gravity_acceleration", "100",
                         "-mesh_scale", "10", "-elements", "P1-P1", "-ts_max_time", "0.05", "-snes_test_jacobian", "-snes_max_it", "3"] + pulmo.QUIET)
        ratios = [float(line.split("=")[1].split(",")[0]) for line in run.out.splitlines() if "||J - Jfd||_F/||J||_F =" in line]
        self.assertGreater(len(ratios), 2, run.out + run.err)
        self.assertLess(max(ratios), 1e-5)  # one-sided differences leave some 1e-6; a term too few, 1e-2


def tetrahedra(path):
    """(nodes [n, 3], cells [m, 4]) of a mesh in MSH 2.2 whose nodes are numbered from 1."""
    lines = iter(open(path))
    nodes, cells = [], []
    for line in lines:
        if line.startswith("$Nodes"):
            nodes = [next(lines).split()[1:4] for _ in range(int(next(lines)))]
        elif line.startswith("$Elements"):
            rows = [[int(word) for word in next(lines).split()] for _ in range(int(next(lines)))]
            cells = [row[-4:] for row in rows if row[1] == 4]
    return np.array(nodes, float), np.array(cells) - 1


def volumes(nodes, cells):
    corners = nodes[cells]
    return np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6


def unloaded_ratio(laws, radii, pressure):
    """Volume without load over that under @p pressure (kPa) of a hollow sphere of two tissues, loaded inside and outside.

    With r of the loaded sphere and R(r) without load: l_r = 1/R', l_t = r/R, sigma_r = P_r/l_t^2, sigma_t = P_t/(l_r l_t),
    sigma_r' = 2 (sigma_t - sigma_r)/r.
    """
    def across(R0):
        state = np.array([R0, pressure])
        for law, r0, r1 in zip(laws, radii, radii[1:]):
            def slope(r, y):
                t = r / y[0]
                l = brentq(lambda l: law.stress(l, t)[0] / t**2 - y[1], 0.5, 2.5, xtol=1e-14)
                return [1 / l, 2 * (law.stress(l, t)[1] / (l * t) - y[1]) / r]
            state = solve_ivp(slope, (r0, r1), state, rtol=1e-10, atol=1e-12).y[:, -1]
        return state

    R0 = brentq(lambda R0: across(R0)[1] - pressure, 0.8 * radii[0], radii[0], xtol=1e-10)
    return (across(R0)[0] ** 3 - R0**3) / (radii[2] ** 3 - radii[0] ** 3)


if __name__ == "__main__":
    pulmo.main()
