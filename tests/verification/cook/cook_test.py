#!/usr/bin/python3
"""Cook's membrane filled with gas that cannot leave (undrained: J = 1), against elements of high degree in two dimensions.

By hand: tests/verification/cook/cook_test.py build/pulmo
"""
import functools
import os
import sys
import unittest

import numpy as np
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [HERE, os.path.join(HERE, "..", "..", "cases")]

import case_meshes  # noqa: E402
import pulmo_case as pulmo  # noqa: E402
from output_test import read_fields  # noqa: E402
from plane_strain import CORNERS, SHEAR, TIPS, TRACTION, Membrane  # noqa: E402

LEVELS = (4, 8, 16)  # bricks along each side
SMALL = 1e-5  # share of the load of the linear problem
# a closed airway: no gas flows in or out; within the tissue next to none in the second that the step takes
SCENE = pulmo.PAPER + ["-tissue", "yoshihara", "-tissue_c", SHEAR / 2, "-support", "-support_surfaces", "clamped,faces",
         "-support_components_clamped", "xyz", "-support_components_faces", "z", "-traction", "-traction_surfaces", "loaded",
         "-airflow", "-airflow_surfaces", "free", "-airflow_permeability", 1e-9, "-ts_dt", 1, "-mesh_scale", 1]


def mesh(n):
    """n x n x 1 bricks of six tetrahedra each."""
    points, cells = case_meshes.kuhn((n, n, 1), (1, 1, 1))
    facets = case_meshes.boundary(cells)
    side = {"x0": "clamped", "x1": "loaded", "y0": "free", "y1": "free", "z0": "faces", "z1": "faces"}
    x, y, z = points.T
    shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], -1)
    return case_meshes.write(np.column_stack([shape @ CORNERS, 48 / n * z]), cells, facets,
                             [side[f] for f in case_meshes.faces_of_box(points, facets, (1, 1, 1))], "body")


def run(n, share):
    """Vertical displacement at TIPS over the share of the load, mm; fails if the gas in the membrane changes."""
    case = pulmo.finished(pulmo.DIRECT + SCENE + pulmo.programme("closed 1 hold\n") + pulmo.QUIET +
                          ["-snes_atol", 1e-9 * share, "-traction_value", f"0,{TRACTION * share:.17g},0"] + mesh(n))
    points, _, steps = read_fields(case)
    assert abs(case.signals()["volume_ml"][-1]) < 1e-8 * share * case.json()["reference_volume_ml"]
    u = steps[-1][1]["displacement_mm"][:, 1]
    return np.array([u[np.linalg.norm(points[:, :2] - tip, axis=1) < 1e-9].mean() for tip in TIPS]) / share


@functools.cache
def best_small():
    return np.array(Membrane(12, 4, grading=3).solve(SMALL, 1))


@functools.cache
def best_full():
    return np.array(Membrane(8, 4, grading=2).solve())


class Reference(unittest.TestCase):
    def test_two_formulations_agree(self):
        """Degree 4 with a pressure, degree 5 with one, and nearly incompressible displacement alone."""
        best = best_small()
        for other in (Membrane(8, 5, grading=3), Membrane(12, 4, mixed=False, grading=3)):
            np.testing.assert_allclose(other.solve(SMALL, 1), best, rtol=2e-4)

    def test_finite_strain(self):
        best = best_full()
        for other in (Membrane(8, 4), Membrane(8, 3, grading=1.5)):
            np.testing.assert_allclose(other.solve(), best, rtol=2e-3)


class PulmoAgainstReference(unittest.TestCase):
    def converge(self, share, exact, bound):
        """Errors over n; the stress at the upper clamped corner is singular as r^(l - 1), so the best order is 2 l."""
        w = np.pi / 2 + np.arctan(16 / 48)
        best = 2 * brentq(lambda l: np.sin(l * w)**2 - 1 + (l * np.sin(w))**2, 0.2, 0.9)  # clamped and free, J = 1
        found = np.array([run(n, share) for n in LEVELS])
        errors = np.abs(found / exact - 1)
        print(f"\nshare {share:g} of the load: reference {exact[0]:.4f}, {exact[1]:.4f} mm; best order {best:.2f}")
        for k, n in enumerate(LEVELS):
            locked = Membrane(n, 1, mixed=False).solve(share)[0] / share / exact[0]
            order = np.log2(errors[k - 1] / errors[k]) if k else (np.nan, np.nan)
            print(f"n {n:2d}: {found[k, 0]:.4f} ({errors[k, 0]:.2e}, order {order[0]:.2f}), {found[k, 1]:.4f} ({errors[k, 1]:.2e}, "
                  f"{order[1]:.2f}); bilinear displacement alone reaches {100 * locked:.0f} %")
            self.assertLess(locked, 0.4)
            if k:
                self.assertGreater(min(order), 0.92 * best)
        self.assertLess(errors[0].max(), 0.08)
        self.assertLess(errors[-1].max(), bound)

    def test_small_load(self):
        self.converge(SMALL, best_small() / SMALL, 0.015)

    def test_full_load(self):
        self.converge(1.0, best_full(), 0.013)


if __name__ == "__main__":
    pulmo.main()
