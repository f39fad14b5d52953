"""The static pressure-volume curve of a run as a sigmoid, and its inflection points.

V = a + b / (1 + exp(-(P - c) / d)) (Venegas, Harris & Simon 1998, eq. 1): c is the pressure of the largest compliance
b / (4 d), and the curve bends most near c - 2 d and c + 2 d, the lower and upper inflection point.
"""
import warnings

import numpy as np
from scipy.optimize import OptimizeWarning, curve_fit

LEAST_POINTS = 6  # of four unknowns
POOR = 0.02  # rms distance of the points from the curve, over the range of volumes


def sigmoid(P, a, b, c, d):
    return a + b / (1 + np.exp(-(P - c) / d))


def inflation_limb(summary):
    """(pressure, volume) of the pauses up to the fullest one, cmH2O and ml."""
    points = summary.get("static_curve") or []
    volume = np.array([p["volume_ml"] for p in points])
    pressure = np.array([p["pressure_cmH2O"] for p in points])
    end = int(np.argmax(volume)) + 1 if len(volume) else 0
    return pressure[:end], volume[:end]


def fit(pressure, volume):
    """Parameters (a, b, c, d) of the sigmoid and its rms distance over the range of volumes; None if the points give none."""
    if len(pressure) < LEAST_POINTS or np.ptp(pressure) <= 0 or np.ptp(volume) <= 0:
        return None
    P0, V0, dP, dV = pressure.min(), volume.min(), np.ptp(pressure), np.ptp(volume)
    best = None
    for middle in (0.25, 0.5, 0.75):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", OptimizeWarning)
                found, _ = curve_fit(sigmoid, (pressure - P0) / dP, (volume - V0) / dV, p0=(0, 1, middle, 0.2), maxfev=5000)
        except (RuntimeError, OptimizeWarning):
            continue
        rms = float(np.sqrt(np.mean((sigmoid((pressure - P0) / dP, *found) - (volume - V0) / dV) ** 2)))
        if found[3] > 0 and found[1] > 0 and (best is None or rms < best[1]):
            best = found, rms
    if best is None:
        return None
    (a, b, c, d), rms = best
    return (V0 + a * dV, b * dV, P0 + c * dP, d * dP), rms


def describe(summary):
    """What the static curve says, in lines; none if the run has no curve."""
    pressure, volume = inflation_limb(summary)
    found = fit(pressure, volume)
    if found is None:
        return []
    (_, b, c, d), rms = found
    lines = [f"static curve: largest compliance {b / (4 * d):.4g} ml/cmH2O at {c:.1f} cmH2O"]
    for name, point in (("lower", c - 2 * d), ("upper", c + 2 * d)):
        inside = pressure.min() <= point <= pressure.max()
        lines.append(f"{name} inflection point {point:.1f} cmH2O" if inside else
                     f"no {name} inflection point between {pressure.min():.1f} and {pressure.max():.1f} cmH2O")
    if rms > POOR:
        lines.append(f"the points are {100 * rms:.0f} % of the volume off a sigmoid: take these numbers with care")
    return lines
