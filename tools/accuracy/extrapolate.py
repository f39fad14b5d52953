"""Limits of a number on a ladder of sizes, and how far they may be off.

Richardson's extrapolation with the observed order of the three finest levels (Celik et al. 2008, J Fluids Eng 130:078001; ratios
of sizes need not be equal); where these do not converge monotonically, or with an order half as high again as the formal one (their
last difference is small by chance), a least-squares fit with the formal order (Eca & Hoekstra 2014, J Comput Phys 262:104). The
grid convergence index of the finest value is F_s times its distance from the limit, F_s = 1.25 with an observed order, 3 without one;
seen from the limit that leaves F_s - 1.
"""
import math
from dataclasses import dataclass

import numpy as np

HIGHEST = 1.5    # observed order over the formal one up to which it is believed
ROUNDING = 1e-8  # differences below this share of the number are the solver's, not the ladder's


@dataclass(frozen=True)
class Limit:
    """value at size -> 0; uncertainty: half width of what it may be; order: observed, None if assumed; levels used."""
    value: float
    uncertainty: float
    order: float | None
    levels: int
    how: str


def observed_order(sizes, values):
    """Order p with values = limit + a size^p through three levels (coarse to fine); None unless they converge monotonically."""
    coarse, middle, fine = values
    far, near = coarse - middle, middle - fine
    if near == 0 or far / near <= 0:
        return None
    r32, r21 = sizes[0] / sizes[1], sizes[1] / sizes[2]

    def misfit(p):  # grows with p
        return math.log((r32 ** p - 1) * r21 ** p / (r21 ** p - 1)) - math.log(far / near)

    low, high = 1e-3, 20.0
    if misfit(low) > 0 or misfit(high) < 0:
        return None
    for _ in range(80):
        p = (low + high) / 2
        low, high = (p, high) if misfit(p) < 0 else (low, p)
    return (low + high) / 2


def pair(sizes, values, order):
    """Limit of two levels (coarse, fine) with a given order."""
    return values[1] + (values[1] - values[0]) / ((sizes[0] / sizes[1]) ** order - 1)


def fitted(sizes, values, order):
    """Limit and scatter of a least-squares fit limit + a size^order, finer levels weighing more (1/size)."""
    h, v = np.asarray(sizes), np.asarray(values)
    w = np.sqrt(1 / h / np.sum(1 / h))
    (limit, slope), *_ = np.linalg.lstsq(np.stack([w, w * h ** order], axis=1), w * v, rcond=None)
    scatter = math.sqrt(np.sum((w * (v - limit - slope * h ** order)) ** 2) * len(h) / max(1, len(h) - 2))
    return float(limit), scatter


def three(sizes, values, formal):
    """Observed order, and limits with it and with the formal one; None if the levels tell no order of at least half of that
    (at least 0.4), or one so far above it that the last difference is small by chance."""
    p = observed_order(sizes, values)
    if p is None or p < min(0.4, formal / 2) or p > HIGHEST * formal:
        return None
    return p, pair(sizes[1:], values[1:], p), pair(sizes[1:], values[1:], formal)


def limit(sizes, values, formal):
    """The limit of values on sizes (coarse to fine) of a method of order `formal`."""
    sizes, values = list(map(float, sizes)), list(map(float, values))
    if not values:
        return Limit(math.nan, math.inf, None, 0, "no level was run")
    fine, scale = values[-1], ROUNDING * max(map(abs, values))
    if len(values) == 1:
        return Limit(fine, math.inf, None, 1, "one level only")
    if max(values) - min(values) <= scale:
        return Limit(fine, scale, None, len(values), "the same on all levels")
    if len(values) == 2:
        value = pair(sizes, values, formal)
        return Limit(value, 2 * abs(value - fine), None, 2, f"two levels, order {formal} assumed")
    found = three(sizes[-3:], values[-3:], formal)
    if found:
        p, *others = found
        value = others[0] if p <= formal else others[1]
        if len(values) > 3 and (before := three(sizes[-4:-1], values[-4:-1], formal)):
            others.append(before[1] if before[0] <= formal else before[2])
        spread = max([0.25 * abs(value - fine), *(abs(value - other) for other in others)])
        return Limit(value, max(spread, scale), p, 3, f"order {p:.2f} observed" + (f", {formal} used" if p > formal else ""))
    used = min(4, len(values))
    value, scatter = fitted(sizes[-used:], values[-used:], formal)
    last = abs(values[-1] - values[-2])
    growing = last if last > abs(values[-2] - values[-3]) else 0  # not yet where it converges
    seen = observed_order(sizes[-3:], values[-3:])
    return Limit(value, max(2 * abs(value - fine) + 2 * scatter + growing, scale), None, used,
                 f"order {seen:.2f} observed, {formal} fitted" if seen and seen > HIGHEST * formal else f"no order seen, {formal} fitted")
