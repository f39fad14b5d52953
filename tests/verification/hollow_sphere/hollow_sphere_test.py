#!/usr/bin/python3
"""The hollow sphere: a radial solver of its own is checked first, then pulmo against it at equal steps.

By hand: tests/verification/hollow_sphere/hollow_sphere_test.py build/pulmo
"""
import os
import subprocess
import sys
import unittest

import numpy as np
from scipy.optimize import brentq

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [HERE, os.path.join(HERE, "..", "..", "cases")]

import pulmo_case as pulmo  # noqa: E402
from radial import ML, Birzle, Pressure, Radial, Shell, breathe  # noqa: E402

BREATH = Pressure()
SCENE = pulmo.options_file("scenes/hollow_sphere.opts")
# one factorisation serves five Newton steps as preconditioner
SOLVER = pulmo.DIRECT + ["-snes_rtol", "1e-7", "-ksp_type", "fgmres", "-ksp_rtol", "1e-4", "-snes_lag_preconditioner", "5",
                         "-snes_lag_preconditioner_persists"]
DT = 0.2
LEVELS = (4, 6, 9)  # divisions of an octant's edge; three times as many layers
WHOLE = (4, 12)     # divisions and layers of meshes/hollow_sphere.msh


def inflation_pressure(J):
    """Pressure (kPa) that holds CM3 at F = J^(1/3) I (MODEL's closed form)."""
    k, s = Birzle(), J ** (2 / 3)
    return 2 * k.c * (J ** (-1 / 3) - J ** (-2 * k.beta - 1)) + 4 * k.c3 * (s - 1) ** 5 * J ** (-1 / 3)


def linear_volume(shell, t, terms=24):
    """Volume (ml) at time t (s) after a step of 1 kPa at the airway, of the linear theory: Laplace transform inverted.

    div u = e solves c e_xx = e_t with c = k M, M = lambda + 2 mu; p = M e + constant (div u is all that flow feels).
    """
    a, b = shell.inner, shell.outer
    M, lame2 = shell.law.tangent(1.0, 1.0)[0]
    mu = (M - lame2 / 2) / 2

    def transformed(s):
        q = np.sqrt(s / (shell.permeability * M))
        e = lambda R: np.array([np.exp(q * (R - b)), np.exp(-q * (R - a))]) / R
        slope = lambda R: np.array([q, -q]) * e(R) - e(R) / R
        # integral of R^2 e from a
        part = lambda R: np.array([np.exp(q * (R - b)) * (R / q - 1 / q**2), np.exp(-q * (R - a)) * (-R / q - 1 / q**2)])
        # unknown: two of e, C of R^2 u = int R^2 e + C, constant of p
        u = lambda R: np.append((part(R) - part(a)) / R**2, [1 / R**2, 0])
        stress = lambda R: np.append(M * e(R), [0, 0]) - 4 * mu / R * u(R)
        p = lambda R: np.append(M * e(R), [0, 1])
        A = np.array([stress(a) - p(a) - shell.spring_inner * u(a), stress(b) - p(b) + shell.spring_outer * u(b), p(a),
                      np.append(slope(b), [0, 0])])
        x = np.linalg.solve(A, [0, 0, 1 / s, 0])
        return 4 * np.pi * (b**2 * u(b) - a**2 * u(a)) @ x / ML

    # Talbot's contour with Weideman's parameters
    theta = np.pi * (2 * np.arange(terms) + 1 - terms) / terms
    z = terms / t * (0.5017 * theta / np.tan(0.6407 * theta) - 0.6122 + 0.2645j * theta)
    dz = terms / t * (0.5017 / np.tan(0.6407 * theta) - 0.5017 * 0.6407 * theta / np.sin(0.6407 * theta) ** 2 + 0.2645j)
    return sum((np.exp(s * t) * transformed(s) * d).real for s, d in zip(z, dz / 1j)) / terms


def largest(a, b):
    """Largest difference as a share of the largest value of b."""
    return np.abs(a - b).max() / np.abs(b).max()


def orders(sizes, errors):
    """Observed orders between successive levels."""
    return [np.log(e / f) / np.log(n / m) for m, n, e, f in zip(sizes, sizes[1:], errors, errors[1:])]


class RadialSolver(unittest.TestCase):
    """The reference itself."""

    def test_stress_is_the_slope_of_the_energy(self):
        law, step = Birzle(), 1e-30
        for r, t in ((0.8, 1.1), (1.3, 1.2), (1.7, 0.9)):
            Pr, Pt = law.stress(r, t)
            self.assertAlmostEqual(Pr, law.energy(r + 1j * step, t).imag / step, delta=1e-13)
            self.assertAlmostEqual(Pt, law.energy(r, t + 1j * step).imag / step / 2, delta=1e-13)

    def test_free_inflation(self):
        """Without springs, held long enough: F = J^(1/3) I, p = dW/dJ."""
        pip = 6 * pulmo.KPA_PER_CMH2O
        J = brentq(lambda J: inflation_pressure(J) - pip, 3.5, 5)
        self.assertAlmostEqual(J, 4.2169, delta=5e-5)
        sphere = Radial(Shell(spring_inner=0, spring_outer=0))
        for k in range(40):
            sphere.step(0.1, lambda part, k=k: pip * min(1, (k + part) / 10))
        for _ in range(60):
            sphere.step(5, lambda part: pip)
        np.testing.assert_allclose(sphere.jacobian(), J, rtol=1e-8)

    def test_small_steps_of_pressure_follow_the_linear_theory(self):
        shell, small = Shell(), 1e-6
        step = Pressure(small, ramp=1e-9, inspiration=0.3)
        times = np.concatenate([[0, 1e-9], np.geomspace(1e-5, 0.3, 120)])
        V = breathe(shell, times, step, stages=3, n=48)["V"] / small
        for t in (0.01, 0.05, 0.15, 0.3):
            self.assertAlmostEqual(np.interp(t, times, V) / linear_volume(shell, t), 1, delta=2e-4, msg=f"at {t} s")
        self.assertAlmostEqual(V[-1] / linear_volume(shell, 0.3), 1, delta=5e-6)

    def test_gas_is_conserved(self):
        """Darcy's law at the airway gives the rate of the volume, though the points there do not demand it."""
        signals = breathe(Shell(), BREATH.steps(0.05), BREATH, n=32)
        self.assertLess(largest(signals["flow"], signals["rate"]), 1e-6)
        np.testing.assert_allclose(signals["rate"][1:], np.diff(signals["V"]) / np.diff(signals["t"]), rtol=1e-9, atol=1e-7)

    def test_volume_at_one_second_as_dt_goes_to_zero(self):
        """Settles the volume of two spheres: 517.4453 ml."""
        def volume(dt, n, stages=3):
            return 2 * breathe(Shell(), BREATH.steps(dt, 1.0), BREATH, stages, n)["V"][-1]
        best = volume(0.0125, 40)
        self.assertAlmostEqual(best, 517.4453, delta=1e-4)
        self.assertLess(abs(volume(0.025, 32) / best - 1), 1e-8)  # other steps and other points
        self.assertLess(abs(volume(0.0125, 40, stages=2) / best - 1), 1e-6)  # another method
        steps = np.array([0.05, 0.025, 0.0125, 0.00625])
        euler = np.array([volume(dt, 24, stages=1) for dt in steps])
        low = 1 - euler / best
        np.testing.assert_allclose(orders(1 / steps, low), 1, atol=0.1)
        self.assertAlmostEqual((2 * euler[-1] - euler[-2]) / best, 1, delta=1e-4)  # Richardson
        print("\nbackward Euler, V(1 s) of two spheres low by " +
              ", ".join(f"{100 * e:.3f} % at {dt:g} s" for dt, e in zip(steps, low)) + f"; dt -> 0: {best:.5f} ml")


class PulmoAgainstRadial(unittest.TestCase):
    """Octants with their planes of symmetry on rollers, refined in both directions at once; the same steps."""

    @classmethod
    def setUpClass(cls):
        cls.signals = []
        for divisions in LEVELS:
            rows = cls.run_octant(divisions, 3 * divisions, ["-ts_dt", DT])
            cls.signals.append((8 * rows["volume_ml"], 8 * rows["flow_ml_per_s"]))
        cls.rows = rows
        cls.exact = breathe(Shell(), rows["time_s"], BREATH, n=32)
        cls.at_1s = int(np.abs(rows["time_s"] - 1).argmin())

    @staticmethod
    def run_octant(divisions, layers, more):
        mesh = pulmo.scratch("octant.msh")
        subprocess.run([os.path.join(pulmo.SOURCE, "tools", "sphere_mesh"), "--divisions", str(divisions), "--layers",
                        str(layers), "--octant", "--output", mesh], check=True, capture_output=True)
        return pulmo.finished(SOLVER + SCENE + pulmo.ROLLERS + ["-dm_plex_filename", mesh] + more).signals()

    def test_scene(self):
        """The scene file is the breath that the radial solver takes."""
        t, P = self.rows["time_s"], self.rows["airway_pressure_cmH2O"]
        np.testing.assert_allclose(P * pulmo.KPA_PER_CMH2O, BREATH(t), atol=1e-12)
        for kink in BREATH.times:
            self.assertLess(np.abs(t - kink).min(), 1e-9)
        self.assertEqual(self.rows["phase"].count("expiration"), sum(t > 1 + 1e-9))

    def test_waveforms_converge(self):
        exact, errors = self.exact, []
        print("\ndivisions  V(1 s)    V         flow   (share of the largest)")
        for n, (V, flow) in zip(LEVELS, self.signals):
            errors.append((abs(V[self.at_1s] / exact["V"][self.at_1s] - 1), largest(V, exact["V"]),
                           largest(flow, exact["rate"])))
            print(f"{n:9d}  " + "  ".join(f"{e:.2e}" for e in errors[-1]))
        for name, column in zip(("V(1 s)", "V", "flow"), np.transpose(errors)):
            observed = orders(LEVELS, column)
            print(f"order of {name}: " + ", ".join(f"{o:.2f}" for o in observed))
            for order in observed:
                self.assertGreater(order, 1.7, name)
        self.assertLess(errors[-1][0], 0.005)
        self.assertLess(errors[-1][1], 0.01)
        self.assertLess(errors[-1][2], 0.01)

    def test_limit_of_the_meshes(self):
        """Waveforms extrapolated from the two finest meshes with order 2."""
        coarse, fine = LEVELS[-2:]
        weight = 1 / ((fine / coarse) ** 2 - 1)
        (V, flow), (V_fine, flow_fine) = self.signals[-2:]
        found = (largest(V_fine + weight * (V_fine - V), self.exact["V"]),
                 largest(flow_fine + weight * (flow_fine - flow), self.exact["rate"]))
        print("\nextrapolated: V {:.2e}, flow {:.2e}".format(*found))
        self.assertLess(found[0], 1e-3)
        self.assertLess(found[1], 2e-3)

    def test_rollers_stand_for_the_rest_of_the_sphere(self):
        """One step of the whole sphere (held by its springs alone) is eight times that of the octant."""
        one_step = ["-ts_max_time", 0.1]
        octant = self.run_octant(*WHOLE, one_step)["volume_ml"][-1]
        whole = pulmo.finished(SOLVER + SCENE + ["-dm_plex_filename", pulmo.mesh("hollow_sphere.msh")] + one_step).signals()
        # the prisms of the octants are not cut as mirror images
        self.assertAlmostEqual(8 * octant / whole["volume_ml"][-1], 1, delta=2e-3)


if __name__ == "__main__":
    pulmo.main()
