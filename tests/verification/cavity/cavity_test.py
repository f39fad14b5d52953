#!/usr/bin/python3
"""A lung that touches the wall of a rigid cavity: pressure and penetration in closed form, sliding, release, tension, a hollow sphere against
a solution of its own, an ellipsoid, the lung in its own shape moved out.

By hand: tests/verification/cavity/cavity_test.py build/pulmo
"""
import os
import subprocess
import sys
import unittest

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases"), os.path.join(HERE, "..", "hollow_sphere"), HERE]

import pulmo_case as pulmo  # noqa: E402
import walls  # noqa: E402
from case_meshes import boundary  # noqa: E402
from pulmo_case import KPA_PER_CMH2O  # noqa: E402
from radial import Birzle  # noqa: E402

STIFFNESS, ONSET = 50, 0.05  # kPa/mm, mm: the defaults
GAP = 4.0
# a cube of 100 mm that moves along z alone, below a wall that is far wider
SIDES = ["x0", "x1", "y0", "y1", "z0"]
COLUMN = pulmo.BLOCK + pulmo.STILL + pulmo.TIGHT + pulmo.QUIET + ["-tissue", "yoshihara", "-support", "-support_surfaces", ",".join(SIDES)] + [
    o for face in SIDES for o in (f"-support_components_{face}", face[0])]
# of facets, by their corners (Dunavant 1985, degree 4)
POINTS = np.array([np.roll((a, a, 1 - 2 * a), i) for a in (0.091576213509771, 0.445948490915965) for i in range(3)])
UP_AND_DOWN = "up 0.6 pressure 24 ramp 0.6\nhold 0.2 pressure 24\ndown 0.4 pressure 2 ramp 0.4\nhold 0.2 pressure 2\n"


def flat_wall(z=100 + GAP, binary=False):
    return ["-cavity", "-cavity_surfaces", "z1", "-cavity_file", walls.save(walls.box((-150, -130, -120), (250, 230, z)), binary)]


def confined(stretch):
    """P_zz of yoshihara in uniaxial strain, kPa."""
    c, beta = 1.298, 0.75
    return 2 * c * (stretch - stretch ** (-2 * beta - 1))


def push(q, stiffness=STIFFNESS, onset=ONSET):
    return 0 if q <= 0 else stiffness * q * q / 2 / onset if q < onset else stiffness * (q - onset / 2)


def column(pressure, push=push, gap=GAP):
    """Stretch of the cube under a gas pressure, cmH2O."""
    return brentq(lambda s: pressure * KPA_PER_CMH2O - confined(s) - push(100 * (s - 1) - gap), 0.5, 2, xtol=1e-15)


class Column(unittest.TestCase):
    """The wall bears what the tissue does not: p_gas = P_zz + p_wall."""

    def compare(self, rows, push=push, gap=GAP, touches=lambda q: q > 0):
        stretch = np.array([column(p, push, gap) for p in rows["airway_pressure_cmH2O"]])
        q = 100 * (stretch - 1) - gap
        np.testing.assert_allclose(rows["volume_ml"], 1000 * (stretch - 1), atol=1e-6)
        np.testing.assert_allclose(rows["cavity_penetration_mm"], np.where(touches(q), q, 0), atol=1e-8)
        np.testing.assert_allclose(rows["cavity_pressure_cmH2O"], [push(x) / KPA_PER_CMH2O for x in q], atol=1e-5)
        np.testing.assert_allclose(rows["cavity_contact_cm2"], np.where(touches(q), 100, 0), atol=1e-9)
        return q

    def test_touch_and_release(self):
        run = pulmo.finished(COLUMN + flat_wall() + pulmo.programme(UP_AND_DOWN))
        rows = run.signals()
        q = self.compare(rows)
        self.assertGreater(q.max(), ONSET)
        self.assertLess(q[-1], 0)  # free again: no wall holds it
        self.assertTrue(((q > 0) & (q < ONSET)).any())  # a step ends where the stiffness comes
        np.testing.assert_allclose(rows["max_J"], rows["min_J"], atol=1e-9)
        found = run.json()
        self.assertAlmostEqual(found["largest_cavity_penetration_mm"], rows["cavity_penetration_mm"].max(), delta=1e-12)
        self.assertLess(abs(found["energy_j"]["residual_relative"]), 1e-9)
        self.assertLess(abs(found["energy_j"]["elastic_cavity"]), 1e-12)  # all is given back
        self.assertNotIn("warning", run.out)

    def test_stored_energy(self):
        run = pulmo.finished(COLUMN + flat_wall() + pulmo.programme("up 0.6 pressure 24 ramp 0.6\n"))
        q = 100 * (column(24) - 1) - GAP
        stored = STIFFNESS * (q * (q - ONSET) / 2 + ONSET**2 / 6) * 1e4  # kPa mm times mm^2
        self.assertAlmostEqual(run.json()["energy_j"]["elastic_cavity"], stored * 1e-6, delta=1e-10)

    def test_penetration_falls_as_the_stiffness_grows(self):
        """To nothing in its inverse: the pressure that the wall bears hardly changes."""
        beyond = []
        for stiffness in (25, 50, 100):
            run = pulmo.finished(COLUMN + flat_wall() + ["-cavity_stiffness", stiffness] + pulmo.programme("up 0.4 pressure 24 ramp 0.4\n"))
            beyond.append(run.json()["largest_cavity_penetration_mm"] - ONSET / 2)
        np.testing.assert_allclose(np.log2(np.array(beyond[:-1]) / beyond[1:]), 1, atol=0.02)

    def test_schemes_agree(self):
        run = pulmo.finished(COLUMN + flat_wall() + ["-ts_type", "bdf"] + pulmo.programme(UP_AND_DOWN))
        self.compare(run.signals())

    def test_it_slides(self):
        """Held along x by rollers that move 4 mm: the same pressure, the same J everywhere, no shear."""
        shifted = [o for face in ("x0", "x1") for o in (f"-support_displacement_{face}", "4,0,0")]
        run = pulmo.finished(COLUMN + shifted + flat_wall() + pulmo.programme(UP_AND_DOWN))
        rows = run.signals()
        self.compare(rows)
        np.testing.assert_allclose(rows["max_J"], rows["min_J"], atol=1e-9)

    def test_tension(self):
        """Fluid holds it both ways, at its distance at rest."""
        both = ["-cavity_tension", "-cavity_stiffness", 0.3]
        run = pulmo.finished(COLUMN + flat_wall() + both + pulmo.programme("up 0.2 pressure 6 ramp 0.2\ndown 0.4 pressure -4 ramp 0.4\n"))
        q = self.compare(run.signals(), push=lambda q: 0.3 * q, gap=0, touches=lambda q: q == q)
        self.assertLess(q.min(), -0.5)

    def test_files(self):
        """ASCII, binary, a mesh of the volume in other units, more ranks: the same wall."""
        programme = pulmo.programme("up 0.4 pressure 24 ramp 0.4\n")
        ascii = pulmo.finished(COLUMN + flat_wall() + programme).signals()["volume_ml"][-1]
        self.assertAlmostEqual(pulmo.finished(COLUMN + flat_wall(binary=True) + programme).signals()["volume_ml"][-1], ascii, delta=1e-9)
        self.assertAlmostEqual(pulmo.finished(COLUMN + flat_wall() + programme, ranks=2).signals()["volume_ml"][-1], ascii, delta=1e-9)
        cube = ["-cavity", "-cavity_surfaces", "z1", "-cavity_tension", "-cavity_file", pulmo.mesh("cube_coarse.msh"), "-cavity_scale", "100"]
        own = ["-cavity", "-cavity_surfaces", "z1", "-cavity_tension"]
        volumes = [pulmo.finished(COLUMN + wall + programme).signals()["volume_ml"][-1] for wall in (cube, own)]
        self.assertAlmostEqual(*volumes, delta=1e-9)

    def test_a_wall_of_another_size_is_told(self):
        for tension in ([], ["-cavity_tension"]):
            run = pulmo.Case(COLUMN + flat_wall() + ["-cavity_scale", "50", "-scene_view_only"] + tension + pulmo.programme(UP_AND_DOWN))
            self.assertEqual(run.code, 0, run.err)
            self.assertRegex(run.out, "pulmo: warning: -cavity_file .* check -cavity_scale")

    def test_fluid_takes_outlines_that_cross(self):
        """By less than a spacing, but not by more."""
        programme = pulmo.programme("up 0.1 pressure 1 ramp 0.1\n")
        both = ["-cavity_tension", "-cavity_stiffness", 0.3, "-cavity_spacing", 4]
        self.assertNotIn("warning", pulmo.finished(COLUMN + flat_wall(98) + both + programme).out)
        run = pulmo.Case(COLUMN + flat_wall(94) + both + programme)
        self.assertEqual(run.code, 1)
        self.assertIn("the lung is not within the cavity", run.err)

    def test_a_wall_behind_a_support_is_told(self):
        run = pulmo.Case(pulmo.BLOCK + pulmo.STILL + pulmo.TIGHT + ["-tissue", "ma", "-support", "-support_surfaces", "z0,z1", "-cavity", "-cavity_surfaces",
                         "z1,x0", "-scene_view_only"] + pulmo.programme(UP_AND_DOWN))
        self.assertEqual(run.code, 0, run.err)
        self.assertIn("the wall of -cavity on surface 'z1' does nothing: -support_surfaces says where it goes", run.out)
        self.assertNotIn("on surface 'x0'", run.out)

    def test_a_soft_wall_is_told(self):
        run = pulmo.finished(COLUMN + flat_wall() + ["-cavity_stiffness", "0.05"] + pulmo.programme("up 0.4 pressure 24 ramp 0.4\n"))
        self.assertIn("the wall gives way", run.out)


class Sphere(unittest.TestCase):
    """A hollow sphere in a spherical cavity: nothing on its inner wall, p in its pores, its outer radius held once it touches."""
    INNER, OUTER, PRESSURE = 7.5, 72.5, 7

    def radial(self):
        """Gained volume (ml) and force on the wall (cmH2O cm2): equilibrium P_r' + 2 (P_r - P_t) / R = 0 of the law's own P, by collocation."""
        law, p, R_wall = Birzle(), self.PRESSURE * KPA_PER_CMH2O, self.OUTER + GAP

        def slope(R, y):
            r, lr = y
            lt = r / R
            Pr, Pt = law.stress(lr, lt)
            (Crr, Crt), _ = law.tangent(lr, lt)
            return np.array([lr, -(2 * (Pr - Pt) + Crt * (lr - lt)) / R / Crr])

        def ends(inner, outer):
            traction = [law.stress(lr, r / R)[0] - p * (r / R) ** 2 for (r, lr), R in ((inner, self.INNER), (outer, self.OUTER))]
            return np.array([traction[0], traction[1] + push(outer[0] - R_wall)])

        R = np.linspace(self.INNER, self.OUTER, 200)
        found = solve_bvp(slope, ends, R, np.array([R * 1.05, np.full_like(R, 1.05)]), tol=1e-8, max_nodes=20000)
        self.assertTrue(found.success, found.message)
        inner, outer = found.y[0, 0], found.y[0, -1]
        volume = 4 * np.pi / 3 * (outer**3 - inner**3 - self.OUTER**3 + self.INNER**3) / 1000
        return volume, push(outer - R_wall) / KPA_PER_CMH2O * 4 * np.pi * self.OUTER**2 / 100

    def test_against_the_radial_solution(self):
        wall = walls.save(walls.ellipsoid(np.full(3, self.OUTER + GAP), 5))
        mesh = pulmo.scratch("octant.msh")
        subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", "4", "--layers", "12", "--octant", "--output", mesh],
                       check=True, capture_output=True)
        rows = pulmo.finished(["-dm_plex_filename", mesh, "-tissue", "birzle", "-lumen_pressure", "off", "-cavity", "-cavity_file", wall]
                              + pulmo.STILL + pulmo.ROLLERS + pulmo.DIRECT + pulmo.QUIET
                              + pulmo.programme(f"up 0.3 pressure {self.PRESSURE} ramp 0.3\n")).signals()
        volume, force = self.radial()
        found = 8 * rows["volume_ml"][-1], 8 * rows["cavity_pressure_cmH2O"][-1] * rows["cavity_contact_cm2"][-1]
        errors = np.array(found) / [volume, force] - 1
        print(f"\nsphere in a sphere: volume off by {errors[0]:.2e}, force on the wall by {errors[1]:.2e}")
        self.assertLess(abs(errors[0]), 1e-3)
        self.assertLess(abs(errors[1]), 3e-3)


def outside(run):
    """Of the last snapshot: places of all nodes at rest and now, corners and mid-nodes of the triangles of the boundary."""
    x, cells, values = pulmo.fields(run)
    facets = boundary(cells[:, :4])
    middle = {frozenset(edge): node for k, (i, j) in enumerate(((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)))
              for edge, node in zip(cells[:, [i, j]].tolist(), cells[:, 4 + k])}
    between = np.array([[middle[frozenset((t[i], t[(i + 1) % 3]))] for i in range(3)] for t in facets.tolist()])
    return x, x + values["displacement_mm"].reshape(-1, 3), facets, between


class Ellipsoid(unittest.TestCase):
    """An octant of a hollow sphere in an ellipsoid that it touches along x and y, but not along z."""
    AXES = np.array([75.0, 76, 100])

    def test_the_lung_ends_at_the_wall(self):
        mesh = pulmo.scratch("octant.msh")
        subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", "4", "--layers", "8", "--octant", "--output", mesh], check=True,
                       capture_output=True)
        run = pulmo.finished(["-dm_plex_filename", mesh, "-tissue", "ma", "-lumen_pressure", "off", "-cavity", "-cavity_file",
                              walls.save(walls.ellipsoid(self.AXES, 5), True)] + pulmo.STILL + pulmo.ROLLERS + pulmo.DIRECT + pulmo.QUIET
                             + pulmo.programme("up 0.3 pressure 5 ramp 0.3\n"))
        x, place, corners, between = outside(run)
        outer = np.linalg.norm(x[corners], axis=2).min(axis=1) > 72
        far = []
        for L in POINTS:  # of quadratic facets
            y = np.tensordot(L * (2 * L - 1), place[corners[outer]], (0, 1)) + np.tensordot(4 * L * np.roll(L, -1), place[between[outer]], (0, 1))
            beyond = np.linalg.norm(y / self.AXES, axis=1)
            far.append((beyond - 1) * np.linalg.norm(y, axis=1) / beyond)  # along the radius, nearly the normal here
        far, most = np.array(far), run.json()["largest_cavity_penetration_mm"]
        print(f"\nellipsoid: points of facets up to {far.max():.4f} mm beyond the wall, penetration {most:.4f} mm")
        self.assertGreater((far > 0).sum(), 20)
        self.assertGreater((far < -1).sum(), 20)  # and some are far from it
        self.assertLess(abs(far.max() - most), 0.003)


class OwnShape(unittest.TestCase):
    """The built-in lung within its own shape, moved out: distances from the triangles of the mesh, by another program."""

    def test_no_facet_is_farther_out_than_the_gap(self):
        gap, spacing = 3, 1.2
        run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + pulmo.QUIET + ["-elements", "P1-P1", "-tissue", "ma", "-ts_max_time", "1",
                             "-cavity", "-cavity_gap", gap, "-cavity_spacing", spacing])
        self.assertNotIn("warning", run.out)
        x, place, triangles, _ = outside(run)
        points = np.einsum("pi,tid->ptd", POINTS, place[triangles]).reshape(-1, 3)
        far, corners = (walls.distance_from(x[triangles], y) for y in (points, place[np.unique(triangles)]))
        most = run.json()["largest_cavity_penetration_mm"]
        rows = run.signals()
        print(f"\nown shape: points of facets up to {far.max():.4f} mm away, corners {corners.max():.4f}; gap and penetration {gap + most:.4f} mm, "
              f"{rows['cavity_contact_cm2'][-1]:.0f} cm2 touch at {rows['cavity_pressure_cmH2O'][-1]:.2f} cmH2O")
        self.assertGreater(rows["cavity_contact_cm2"][-1], 100)
        self.assertLess(abs(far.max() - gap - most), 0.1 * spacing)
        self.assertLess(corners.max(), gap + 1)  # a wall meets the points of facets: their corners stick out
        self.assertGreater(np.sort(far)[-50], gap)
        self.assertLess(most, 0.1 * gap)
        self.assertLess(abs(run.json()["energy_j"]["residual_relative"]), 1e-6)

    def test_each_part_is_held_to_its_own_gap(self):
        """The lung is all right_lung: the first value of an option is nowhere."""
        scene = (pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + pulmo.QUIET + ["-elements", "P1-P1", "-tissue", "ma", "-ts_max_time", "0.5", "-cavity",
                 "-snes_linesearch_type", "l2", "-cavity_stiffness", "0.5"])
        one, *others = [pulmo.finished(scene + ["-cavity_gap", gap]) for gap in ("1", "100,right_lung=1", "0,right_lung=1", "0.01,right_lung=1")]
        most = one.signals()["cavity_penetration_percent"].max()
        self.assertGreater(most, 20)
        self.assertAlmostEqual(most, 100 * one.json()["largest_cavity_penetration_mm"], delta=1e-9)
        self.assertIn("the wall gives way", one.out)
        for run in others:
            self.assertIn("the wall gives way", run.out)
            self.assertNotIn("the wall is not there", run.out)
            self.assertAlmostEqual(run.json()["largest_cavity_penetration_percent"], most, delta=1e-6)
        wide = pulmo.finished(scene + ["-cavity_gap", "0.01,right_lung=3"])
        self.assertNotIn("the wall gives way", wide.out)

    def test_folds_are_looked_for_where_the_gap_is(self):
        for gap, told in (("100,right_lung=1", False), ("0,right_lung=100", True)):
            run = pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-cavity", "-cavity_gap", gap, "-cavity_spacing", "4", "-scene_view_only"])
            self.assertEqual(run.code, 0, run.err)
            self.assertEqual("the wall is not there" in run.out, told)

    def test_without_a_gap_the_wall_is_the_surface(self):
        run = pulmo.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + pulmo.QUIET + ["-elements", "P1-P1", "-tissue", "ma", "-ts_max_time", "0.2", "-cavity",
                             "-cavity_gap", "0", "-airflow", "off", "-chest_wall_surfaces", "airway", "-snes_linesearch_type", "l2"])
        self.assertNotIn("the wall is not there", run.out)
        self.assertGreater(run.signals()["cavity_contact_cm2"][-1], 700)  # of 821 with the airway

    def test_a_wall_holds_nothing_that_it_does_not_touch(self):
        run = pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-chest_wall", "off", "-cavity"])
        self.assertEqual(run.code, 1)
        self.assertIn("held in place by nothing (a wall holds nothing that it does not touch)", run.err)


if __name__ == "__main__":
    pulmo.main()
