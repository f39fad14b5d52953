"""A breathing hollow sphere as a problem of one dimension: finite-strain poroelasticity with spherical symmetry.

Independent of pulmo: other language, other discretisation (Chebyshev collocation of the strong form in ln R), the law
in principal stretches. Units mm, s, kPa.

Unknowns: place r(R) and pressure p(R) of a shell inner <= R <= outer. Stretches l_r = r', l_t = r/R, J = l_r l_t^2.
With P_r = dW/dl_r, P_t = dW/dl_t (one of two) and the Piola identity (R^2 l_t^2)' = 2 R J/l_t:

    momentum    P_r' + 2 (P_r - P_t)/R - l_t^2 p' = 0
    mass        R^2 Q = [r^2 r_t]_outer - r^2 r_t,  Q = -k J/l_r^2 p'

The mass balance d/dt J + (R^2 Q)'/R^2 = 0 is written integrated from R to the sealed outer surface, with
J R^2 = (r^3/3)', so a time step conserves the gas whatever its size. Boundaries: springs of the full vector on both
surfaces, traction -K_s (r - R) against the displacement; p = p_aw(t) inside; no flux outside.

In time a stiffly accurate Runge-Kutta method of Radau on v = r^3/3: one stage is backward Euler (the steps of pulmo),
three stages have order 5.
"""
from dataclasses import dataclass

import numpy as np

ML = 1000.0  # mm^3


@dataclass(frozen=True)
class Birzle:
    """CM3: W = c (I1 - 3) + c/beta (I3^-beta - 1) + c1 (I1 I3^-1/3 - 3)^3 + c3 (I3^1/3 - 1)^6 (kPa)."""
    c: float = 0.3567
    beta: float = 1.075
    c1: float = 0.2782
    c3: float = 5.766e-3

    def energy(self, r, t):
        """W of the stretches r, t, t."""
        I1, I3 = r * r + 2 * t * t, (r * t * t) ** 2
        return (self.c * (I1 - 3) + self.c / self.beta * (I3 ** -self.beta - 1) + self.c1 * (I1 * I3 ** (-1 / 3) - 3) ** 3
                + self.c3 * (I3 ** (1 / 3) - 1) ** 6)

    def stress(self, r, t):
        """(dW/dl_r, dW/dl_t of one of the two) at the stretches r, t, t, kPa."""
        I1, I3 = r * r + 2 * t * t, (r * t * t) ** 2
        cube = I3 ** (1 / 3)
        slope1, slope3 = 3 * self.c1 * (I1 / cube - 3) ** 2, 6 * self.c3 * (cube - 1) ** 5

        def along(l):
            return (2 * self.c * (l - I3 ** -self.beta / l) + slope1 * (2 * l - 2 / 3 * I1 / l) / cube
                    + slope3 * 2 / 3 * cube / l)
        return along(r), along(t)

    def tangent(self, r, t, step=1e-30):
        """d(P_r, P_t)/d(l_r, l_t) by complex steps, exact to rounding: rows P_r, P_t."""
        by_r, by_t = self.stress(r + 1j * step, t), self.stress(r, t + 1j * step)
        return [[by_r[0].imag / step, by_t[0].imag / step], [by_r[1].imag / step, by_t[1].imag / step]]


@dataclass(frozen=True)
class Shell:
    """The scene: geometry (mm), permeability (mm^2/(kPa s)), springs (kPa/mm), law."""
    inner: float = 7.5
    outer: float = 72.5
    permeability: float = 1e4
    spring_inner: float = 0.08
    spring_outer: float = 0.08
    law: Birzle = Birzle()


def chebyshev(n):
    """n + 1 points on [-1, 1], ascending, and the matrix of differentiation (Trefethen 2000)."""
    x = -np.cos(np.pi * np.arange(n + 1) / n)
    c = np.hstack([2, np.ones(n - 1), 2]) * (-1) ** np.arange(n + 1)
    dx = x[:, None] - x
    D = np.outer(c, 1 / c) / (dx + np.eye(n + 1))
    return x, D - np.diag(D.sum(axis=1))


# Butcher matrices of Radau IIA by number of stages; the last stage is the end of the step
_ROOT6 = np.sqrt(6)
RADAU = {
    1: np.array([[1.0]]),
    2: np.array([[5 / 12, -1 / 12], [3 / 4, 1 / 4]]),
    3: np.array([[(88 - 7 * _ROOT6) / 360, (296 - 169 * _ROOT6) / 1800, (-2 + 3 * _ROOT6) / 225],
                 [(296 + 169 * _ROOT6) / 1800, (88 + 7 * _ROOT6) / 360, (-2 - 3 * _ROOT6) / 225],
                 [(16 - _ROOT6) / 36, (16 + _ROOT6) / 36, 1 / 9]]),
}


class Radial:
    """A shell at n + 1 points; state (r, p) at these points."""

    def __init__(self, shell, n=24):
        self.shell, self.n = shell, n
        x, D = chebyshev(n)
        half = np.log(shell.outer / shell.inner) / 2
        self.R = shell.inner * np.exp(half * (x + 1))
        self.R[-1] = shell.outer
        self.D = D / (half * self.R[:, None])  # d/dR
        self.r, self.p = self.R.copy(), np.zeros(n + 1)
        self.iterations = 0

    def equations(self, r, p, rate, airway):
        """Residual (momentum, mass) and its derivatives by r, p and rate.

        rate: d/dt (r^3/3). airway: pressure there, kPa.
        """
        s, R, D = self.shell, self.R, self.D
        lr, lt = D @ r, r / R
        Pr, Pt = s.law.stress(lr, lt)
        (Crr, Crt), (Ctr, Ctt) = (np.array(row) for row in s.law.tangent(lr, lt))
        by_r = np.diag(1 / R)  # d l_t / d r
        dPr = Crr[:, None] * D + Crt[:, None] * by_r
        dPt = Ctr[:, None] * D + Ctt[:, None] * by_r
        slope = D @ p
        momentum = D @ Pr + 2 * (Pr - Pt) / R - lt**2 * slope
        momentum_r = D @ dPr + 2 * (dPr - dPt) / R[:, None] - np.diag(2 * lt * slope / R)
        momentum_p = -lt[:, None] ** 2 * D
        for end, spring, sign in ((0, s.spring_inner, 1), (-1, s.spring_outer, -1)):
            # radial stress P_r - p l_t^2 = +- K_s u
            momentum[end] = Pr[end] - p[end] * lt[end] ** 2 - sign * spring * (r[end] - R[end])
            momentum_r[end] = dPr[end]
            momentum_r[end, end] -= 2 * p[end] * lt[end] / R[end] + sign * spring
            momentum_p[end] = 0
            momentum_p[end, end] = -lt[end] ** 2
        g = s.permeability * R**2 * lt**2 / lr  # R^2 k J / l_r^2
        mass = g * slope + rate[-1] - rate
        mass_r = np.diag(2 * g * slope / r) - (g * slope / lr)[:, None] * D
        mass_p = g[:, None] * D
        mass_v = -np.eye(len(R))
        mass_v[:, -1] += 1
        mass[0], mass_r[0], mass_v[0], mass_p[0] = p[0] - airway, 0, 0, 0
        mass_p[0, 0] = 1
        return np.hstack([momentum, mass]), np.block([[momentum_r, momentum_p], [mass_r, mass_p]]), mass_v

    def step(self, dt, airway, stages=1, tolerance=1e-11):
        """One step. airway: the pressure (kPa) as a function of the part of the step that is over."""
        inverse = np.linalg.inv(RADAU[stages])
        parts = RADAU[stages].sum(axis=1)
        m = self.n + 1
        old = self.r**3 / 3
        r, p = np.tile(self.r, (stages, 1)), np.tile(self.p, (stages, 1))
        for _ in range(50):
            F, A = np.zeros(stages * 2 * m), np.zeros((stages * 2 * m, stages * 2 * m))
            rates = inverse @ (r**3 / 3 - old) / dt
            for i in range(stages):
                rows = slice(2 * m * i, 2 * m * (i + 1))
                F[rows], A[rows, rows], mass_v = self.equations(r[i], p[i], rates[i], airway(parts[i]))
                for j in range(stages):
                    A[2 * m * i + m:2 * m * (i + 1), 2 * m * j:2 * m * j + m] += inverse[i, j] / dt * mass_v * r[j] ** 2
            # rows have very different sizes
            change = np.linalg.solve(A / (scale := np.abs(A).max(axis=1))[:, None], -F / scale).reshape(stages, 2, m)
            r, p = r + change[:, 0], p + change[:, 1]
            self.iterations += 1
            if np.abs(change[:, 0]).max() < tolerance * self.shell.outer:
                break
        else:
            raise ArithmeticError(f"Newton did not converge in a step of {dt} s")
        self.rate = (inverse @ (r**3 / 3 - old) / dt)[-1]
        self.r, self.p = r[-1], p[-1]

    def volume(self):
        """int (J - 1), ml."""
        gained = (self.r**3 - self.R**3) / 3
        return 4 * np.pi * (gained[-1] - gained[0]) / ML

    def flow(self):
        """Flow into the shell by Darcy's law at the airway, ml/s (mass is not collocated there)."""
        lr, lt = (self.D @ self.r)[0], self.r[0] / self.R[0]
        return 4 * np.pi * self.R[0] ** 2 * self.shell.permeability * lt**2 / lr * -(self.D @ self.p)[0] / ML

    def jacobian(self):
        """J at the points."""
        return (self.D @ self.r) * (self.r / self.R) ** 2


class Pressure:
    """A pressure-controlled breath from 0: pip kPa after ramp s, held to inspiration s, 0 after ramp_down s."""

    def __init__(self, pip=0.591, ramp=0.1, inspiration=1.0, ramp_down=0.025, period=3.0):
        self.times = [0, ramp, inspiration, inspiration + ramp_down, period]
        self.values = [0, pip, pip, 0, 0]

    def __call__(self, t):
        return np.interp(t, self.times, self.values)

    def steps(self, dt, end=None):
        """Times of steps of at most dt (s) that land on every kink, equal within each piece."""
        end = self.times[-1] if end is None else end
        times = [0.0]
        for a, b in zip(self.times[:-1], self.times[1:]):
            b = min(b, end)
            if b > a:
                times.extend(a + (b - a) * np.arange(1, (n := int(np.ceil((b - a) / dt - 1e-9))) + 1) / n)
        return np.array(times)


def breathe(shell, times, pressure, stages=1, n=24):
    """Signals of a shell over the given times: dict of arrays t (s), V (ml), flow by Darcy's law and rate of V (ml/s)."""
    radial = Radial(shell, n)
    V, darcy, rate = [0.0], [0.0], [0.0]
    for a, b in zip(times[:-1], times[1:]):
        radial.step(b - a, lambda part, a=a, b=b: pressure(a + part * (b - a)), stages)
        V.append(radial.volume())
        darcy.append(radial.flow())
        rate.append(4 * np.pi * (radial.rate[-1] - radial.rate[0]) / ML)
    return {"t": np.asarray(times), "V": np.array(V), "flow": np.array(darcy), "rate": np.array(rate), "end": radial}
