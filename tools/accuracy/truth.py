"""The hollow sphere by the radial solver: BDF2 beside its own schemes, and its clinical numbers as dt -> 0."""
import functools
import sys

import numpy as np

from shared.common import KPA_PER_CMH2O, SOURCE

sys.path.insert(0, str(SOURCE / "tests/verification/hollow_sphere"))
from radial import Pressure, Radial, Shell, breathe  # noqa: E402

BREATH = Pressure()
POINTS = 24  # of the radial solver; 32 and 40 differ below 1e-8 (docs/verification/hollow_sphere.md)


class RadialBDF2:
    """BDF2 on v = r^3/3 as pulmo makes it: after a kink half a step of backward Euler, then BDF2 over unequal steps."""

    def __init__(self):
        self.radial = Radial(Shell(), POINTS)
        self.restart(0.0)

    def restart(self, t):
        self.past = [(t, self.radial.r ** 3 / 3)]

    def advance(self, t):
        """To the time t by BDF2; by backward Euler with one value of the past."""
        (t0, v0), *older = self.past
        if older:
            (t1, v1), = older
            dt, w = t - t0, (t - t0) / (t0 - t1)
            a0 = (1 + 2 * w) / (1 + w) / dt
            start = ((1 + w) ** 2 * v0 - w ** 2 * v1) / (1 + 2 * w)  # rate = a0 (v - start)
        else:
            a0, start = 1 / (t - t0), v0
        self.radial.r = np.cbrt(3 * start)
        self.radial.step(1 / a0, lambda part: BREATH(t))
        self.past = [(t, self.radial.r ** 3 / 3), (t0, v0)]


def bdf2_volume(dt, end=1.0):
    """Volume at `end` (ml, one sphere)."""
    scheme, times = RadialBDF2(), BREATH.steps(dt, end)
    for a, b in zip(times[:-1], times[1:]):
        if any(abs(a - kink) < 1e-12 for kink in BREATH.times):
            scheme.restart(a)
            scheme.advance((a + b) / 2)
        scheme.advance(b)
    return scheme.radial.volume()


def euler_volume(dt, end=1.0):
    return breathe(Shell(), BREATH.steps(dt, end), BREATH, 1, POINTS)["V"][-1]


@functools.cache
def limit_volume():
    """V(1 s) as dt -> 0 (ml, one sphere): Radau of three stages."""
    return breathe(Shell(), BREATH.steps(0.0125, 1.0), BREATH, 3, 40)["V"][-1]


def numbers(dt=0.0025):
    """The clinical numbers of a breath of one sphere as dt -> 0; rows dt apart (s), sums by the trapezoid rule."""
    made = breathe(Shell(), BREATH.steps(dt), BREATH, 3, POINTS)
    half = np.diff(made["t"]) / 2
    return of_rows(made, np.append(0, half) + np.append(half, 0))


def euler_numbers(dt):
    """The same of backward Euler with the step dt, summed as pulmo does: what is left to pulmo's runs is the error in space."""
    made = breathe(Shell(), BREATH.steps(dt), BREATH, 1, POINTS)
    return of_rows(made, np.append(0, np.diff(made["t"])))


def of_rows(made, w):
    """Clinical numbers of rows with weights w (s)."""
    V, Q, P = made["V"], made["rate"], BREATH(made["t"]) / KPA_PER_CMH2O
    E, R = np.linalg.solve([[w @ (V * V), w @ (V * Q)], [w @ (V * Q), w @ (Q * Q)]], [w @ (P * V), w @ (P * Q)])
    return {"tidal_volume_ml": V.max() - V[0], "peak_flow_ml_per_s": Q.max(), "compliance_ml_per_cmH2O": 1 / E,
            "resistance_cmH2O_s_per_l": 1000 * R, "peak_expiratory_flow_ml_per_s": -Q.min(), "trapped_volume_ml": V[-1] - V[0],
            "time_constant_s": R / E}
