"""A hard case of contact: a wall that the lung touches and leaves again and again."""
import numpy as np
from scipy.optimize import brentq

from .lab import case, pulmo

WALL = pulmo.options_file("scenes/cavity.opts")
GAP, ONSET, SIDES = 4, 0.05, ["x0", "x1", "y0", "y1", "z0"]
COLUMN = pulmo.BLOCK + pulmo.STILL + pulmo.TIGHT + ["-tissue", "yoshihara", "-support", "-support_surfaces", ",".join(SIDES)] + [
    o for face in SIDES for o in (f"-support_components_{face}", face[0])]


def wide_box(top):
    """Path of an ASCII STL file: a box that is far wider than the cube, and ends at this height."""
    x = np.array(np.meshgrid((-150, 250), (-130, 230), (-120, top), indexing="ij"), float).reshape(3, -1).T
    path = pulmo.scratch("box.stl")
    with open(path, "w") as f:
        f.write("solid box\n")
        for a, b, c, d in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)):
            for t in ((a, b, c), (a, c, d)):
                f.write("facet normal 0 0 0\nouter loop\n" + "".join("vertex {} {} {}\n".format(*x[i]) for i in t) + "endloop\nendfacet\n")
        f.write("endsolid\n")
    return path


def penetration(pressure, stiffness):
    """Of a cube in uniaxial strain under a gas pressure, cmH2O, beyond a wall at GAP (yoshihara): mm."""
    def unbalanced(q):
        stretch = 1 + (GAP + q) / 100
        wall = 0 if q <= 0 else stiffness * q * q / 2 / ONSET if q < ONSET else stiffness * (q - ONSET / 2)
        return 2 * 1.298 * (stretch - stretch**-2.5) + wall - pressure * pulmo.KPA_PER_CMH2O

    return max(brentq(unbalanced, -GAP, 5, xtol=1e-14), 0)


@case("Contact that comes and goes", "penetration beside the closed form in every step; no step cut, few Newton steps; nothing moves while the pressure is held; energy",
      "the lung")
def chatter(lab):
    """A wall a thousand times stiffer than the tissue is there in one step and gone in the next: Newton's method that starts on the wrong side
    of it may jump to and fro, and a point that is let go in one iteration and caught in the next never comes to rest. Each breath of the lung
    touches the wall at other points first."""
    stiffness = 1000
    strokes = "".join(f"in{i} 0.1 pressure 16 ramp 0.1\nout{i} 0.1 pressure 0 ramp 0.1\n" for i in range(5)) + "in 0.1 pressure 16\nstill 0.5 pressure 16\n"
    run = lab.finished(COLUMN + ["-cavity", "-cavity_surfaces", "z1", "-cavity_file", wide_box(100 + GAP), "-cavity_stiffness", stiffness,
                                 "-snes_linesearch_type", "l2"] + pulmo.programme(strokes), "a column, ten times to and from the wall")
    if run:
        rows = run.signals()
        exact = np.array([penetration(p, stiffness) for p in rows["airway_pressure_cmH2O"]])
        lab.below("penetration beside the closed form (mm)", np.abs(rows["cavity_penetration_mm"] - exact).max(), 1e-9)
        lab.demand("times that it is left", int(((exact[1:] == 0) & (exact[:-1] > 0)).sum()), "5", ((exact[1:] == 0) & (exact[:-1] > 0)).sum() == 5)
        lab.demand("steps cut", run.json()["rejected_steps"], "none", run.json()["rejected_steps"] == 0)
        lab.below("most Newton steps of a step", int(rows["newton_iterations"].max()), 20)
        lab.below("energy balance, residual over work", abs(run.json()["energy_j"]["residual_relative"]), 1e-9)
    if lab.small:
        return
    breaths = "".join(f"in{i} 0.1 pressure 6 ramp 0.05\nout{i} 0.1 pressure 0 ramp 0.05\n" for i in range(5)) + "in 0.1 pressure 6 ramp 0.1\nstill 1.5 pressure 6\n"
    run = lab.finished(pulmo.LUNG + pulmo.DIRECT + pulmo.STILL + WALL + ["-chest_wall", "-tissue", "ma", "-elements", "P1-P1", "-cavity_stiffness", 200]
                       + pulmo.programme(breaths), "the lung at five breaths a second, then held")
    if run:
        rows = run.signals()
        touched = rows["cavity_contact_cm2"] > 0
        lab.demand("times that the lung leaves the wall", int((touched[:-1] & ~touched[1:]).sum()), "5", (touched[:-1] & ~touched[1:]).sum() == 5)
        lab.demand("steps of the lung cut", run.json()["rejected_steps"], "none", run.json()["rejected_steps"] == 0)
        still = rows["time_s"] > 1.2
        lab.below("area of contact that changes while the pressure is held (cm2)", float(np.ptp(rows["cavity_contact_cm2"][still])), 1e-6)
        lab.below("largest penetration (mm)", run.json()["largest_cavity_penetration_mm"], 0.1)
        lab.below("energy balance, residual over work", abs(run.json()["energy_j"]["residual_relative"]), 1e-6)
