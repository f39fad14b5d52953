"""Hard cases of the permeability laws: pores that close, and pores that open a hundredfold."""
import numpy as np

from .lab import case, pulmo
from .laws import inflated

ITERATIVE = pulmo.options_file("solvers/iterative.opts")
# options, and k at J over k at rest where Φ0 = 0.75
LAWS = {"power": (["-airflow_permeability_exponent", 3], lambda J: ((J - 0.25) / 0.75) ** 3),
        "kozeny_carman": ([], lambda J: ((J - 0.25) / 0.75) ** 3 / J),
        "holmes_mow": (["-airflow_permeability_exponent", 2, "-airflow_permeability_growth", 2],
                       lambda J: ((J - 0.25) / 0.75) ** 2 * np.exp(J**2 - 1)),
        "exponential": (["-airflow_permeability_growth", 3], lambda J: np.exp(3 * (J - 1) / 0.75))}
OPENING = ["-airflow_permeability", 1e6, "-tissue_porosity", 0.75] + pulmo.programme("inflation 1 flow 1000\npause 0.5 flow 0")


def lost(run):
    """Pressure that falls away when the flow stops: what the pores took, cmH2O."""
    rows = run.signals()
    return np.interp(1, rows["time_s"], rows["airway_pressure_cmH2O"]) - rows["airway_pressure_cmH2O"][-1]


@case("Pores that close under suction, and open a hundredfold", "closed forms of J where air is left; a sentence where none is; volumes and energy where k grows a hundredfold",
      "two of the four laws; the lung")
def pores(lab):
    """Where gas is sucked out the pores close, k falls and keeps the rest of the gas in: next to the airway stands a thin layer of
    nearly no air. Where the law of the tissue asks for less than none, J <= 1 − Φ0, k is not defined at all. In inflation k grows by up to
    a hundredfold within a breath, and the tangent with it."""
    free = pulmo.DIRECT + pulmo.PAPER + pulmo.PINS + pulmo.BLOCK + ["-tissue", "yoshihara", "-airflow", "-airflow_surfaces", "x1"]
    J = inflated("yoshihara", -20, 1e-3, 1)  # 0.7835
    constant = lab.finished(free + OPENING, "constant, to J = 2")
    for law, (more, grown) in list(LAWS.items())[:2 if lab.small else 4]:
        chosen = ["-airflow_permeability_law", law, *more]
        suction = free + chosen + ["-airflow_permeability", 1e8] + pulmo.programme("suction 1 pressure -20 ramp 0.5")
        run = lab.finished(suction + ["-tissue_porosity", 0.3], f"{law}, Φ0 = 0.3, −20 cmH2O")
        if run:
            lab.within(f"least J, {law}, Φ0 = 0.3", run.signals()["min_J"][-1], J, 1e-4)
            lab.demand(f"warned of less than no air, {law}, Φ0 = 0.3", "yes" if "porosity falls below zero" in run.out else "no", "no",
                       "porosity falls below zero" not in run.out)
        run = lab.stopped(suction + ["-tissue_porosity", 0.2], "There was no air left: J = ", "1 - Phi0 = 0.8", "-tissue_porosity",
                          what=f"{law}, Φ0 = 0.2, −20 cmH2O")
        if run:
            rows = run.signals(run.signals_file)
            lab.demand(f"least J of the last good state, {law}, Φ0 = 0.2", float(rows["min_J"][-1]), "> 0.8 and < 0.81",
                       0.8 < rows["min_J"][-1] < 0.81)
        run = lab.finished(free + chosen + OPENING, f"{law}, to J = 2")
        if run and constant:
            rows, numbers = run.signals(), run.json()
            lab.within(f"volume in, {law} (ml)", rows["volume_ml"][-1], 1000, 1e-9)
            lab.below(f"energy balance, {law}, residual over work", abs(numbers["energy_j"]["residual_relative"]), 1e-6)
            lab.within(f"k at J = 2 over k at rest, from the pressure lost in the pores, {law}", lost(constant) / lost(run), grown(2), 0.02)
    if not lab.small:
        for law in LAWS:  # with their default parameters
            lab.finished(ITERATIVE + pulmo.options_file("scenes/pcv.opts") + pulmo.LUNG + [
                "-elements", "P1-P1", "-ventilator_pip", 12, "-tissue_porosity", 0.75, "-airflow_permeability_law", law,
                "-ts_max_time", 1.5], f"the lung at 12 cmH2O, {law}")
