"""Hard cases of what the tissue rests on: prestress where the law is nearly neutral, airspaces that all open within a step, a film that collapses it."""
import numpy as np
from scipy.optimize import minimize_scalar

from .lab import case, pulmo
from .laws import inflated

FREE = pulmo.BLOCK + pulmo.ROLLERS + pulmo.STILL + pulmo.TIGHT


@case("Prestress where the law is nearly neutral", "the mesh stays as it is without load; volumes of free tissue beside the closed form; a sentence where no unloaded lung exists",
      "the breath of the lung")
def neutral(lab):
    """CM3 grows by a factor of two under 5 cmH2O, where dp/dJ is a hundredth of that at rest: an error of pressure of a hundredth of a cmH2O moves
    the unloaded volume by several per cent, and the tangent that Newton's method starts with says little about where a breath ends."""
    on = ["-tissue", "birzle", "-prestress"]
    still = lab.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + on + ["-elements", "P1-P1", "-ventilator_pip", 0, "-ts_max_time", 0.2], "the lung without load")
    if still:
        lab.below("volume that comes or goes without load (ml)", np.abs(still.signals()["volume_ml"]).max(), 1e-9)
        lab.demand("told of it", "yes" if "nearly neutral" in still.out else "no", "yes", "nearly neutral" in still.out)
    J0 = inflated("birzle", 5, 1, 4)
    run = lab.finished(FREE + on + pulmo.programme("up 0.2 pressure 0.5 ramp 0.1\ndown 0.4 pressure -2 ramp 0.4\n"), "free tissue, 0.5 and −2 cmH2O")
    if run:
        rows = run.signals()
        for p in (0.5, -2):
            at = np.abs(rows["airway_pressure_cmH2O"] - p).argmin()
            lab.within(f"volume of a litre at {p:g} cmH2O (ml)", rows["volume_ml"][at], 1000 * (inflated("birzle", 5 + p, 1, 4.5) / J0 - 1), 1e-6)
    refused = pulmo.Case(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + ["-tissue", "yoshihara", "-prestress", "-prestress_pressure", 20])
    lab.demand("yoshihara at 20 cmH2O: exit code, and the largest pressure is told", str(refused.code), "1",
               refused.code == 1 and "-prestress_pressure 20" in refused.err and "takes no more than" in refused.err)
    if not lab.small:
        breath = lab.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + on + ["-ventilator_pip", 3, "-ts_max_time", 2], "a breath of 3 cmH2O")
        if breath:
            lab.below("energy balance, residual over work", abs(breath.json()["energy_j"]["residual_relative"]), 1e-6)


@case("All airspaces open within a step", "open shares beside backward Euler by hand; volumes beside the closed form; energy", "the lung")
def avalanche(lab):
    """At 200 1/(cmH2O s) the open share goes from 0 to 1 while the pressure rises by a tenth of a cmH2O: the volume jumps by half in a step, its
    derivative by the pressure is nearly infinite between the ends and none beyond them, and in a lung each point gets there at a time of its own."""
    on = ["-tissue", "ma", "-recruitment", "-recruitment_opening_pressure", 4, "-recruitment_opening_rate", 200, "-recruitment_closing_pressure", 2,
          "-recruitment_closing_rate", 200]
    run = lab.finished(FREE + on + pulmo.programme("up 0.5 pressure 8 ramp 0.5\ndown 0.5 pressure 0 ramp 0.5\n"), "free tissue")
    if run:
        rows, x = run.signals(), [0.0]
        for dt, p in zip(rows["dt_s"][1:], rows["airway_pressure_cmH2O"][1:]):
            x.append(min(max(x[-1] + dt * 200 * (max(p - 4, 0) - max(2 - p, 0)), 0), 1))
        lab.below("open share beside backward Euler by hand", np.abs(rows["open_share"] - x).max(), 1e-9)
        J = [(1 + 0.5 * s) * inflated("ma", p, 0.9, 3) for s, p in zip(x, rows["airway_pressure_cmH2O"])]
        lab.below("volume of a litre beside the closed form (ml)", np.abs(rows["volume_ml"] - 1000 * (np.array(J) - 1)).max(), 1e-5)
    if not lab.small:
        breath = pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + on + ["-ventilator_pip", 6, "-ts_max_time", 1.5]
        run = lab.finished(breath + ["-lumen_pressure"], "a breath of the lung")
        if run:
            lab.below("energy balance, residual over work", abs(run.json()["energy_j"]["residual_relative"]), 1e-6)
            lab.demand("all is open at the end of inspiration", float(run.signals()["open_share"].max()), "> 0.99", run.signals()["open_share"].max() > 0.99)
        # tissue as soft as CM2 that opened by half swells into an airway whose wall bears no gas
        lab.stopped(breath, "The tissue turned inside out", what="the same with the paper's traction: it folds at the airway's rim, and says so")


def with_film(J, gamma):
    """Pressure (cmH2O) of free tissue, CM3 with a film of constant tension (mN/m) on 30 /mm: W'(J) + p_rest (J^(-1/3) - 1)."""
    return pulmo.gas_pressure("birzle", J) + 2 / 3 * 30e-3 * gamma * (J ** (-1 / 3) - 1) / pulmo.KPA_PER_CMH2O


@case("A film of constant tension on soft tissue: γ collapse", "by volume, the falling branch of the closed form up and down; by pressure, an end at the closed limit point with the "
      "sentence that says so; warned of before; what springs hold goes on", "the lung")
def film_collapse(lab):
    """Without its hysteresis a film pulls less the larger the alveoli are: with 50 mN/m, that of a lung short of surfactant, the pressure of CM3 turns at
    J = 1.63, 3.1 cmH2O. Beyond, a larger alveolus empties a smaller one, pressure has no equilibrium and volume has one whose stiffness is negative."""
    gamma = 50
    on = ["-tissue", "birzle", "-surfactant", "-surfactant_gamma", "constant", "-surfactant_gamma_eq", gamma]
    top = minimize_scalar(lambda J: -with_film(J, gamma), bounds=(1.05, 2.5), method="bounded", options={"xatol": 1e-10})
    J_top, p_top = top.x, -top.fun
    by_volume = lab.finished(FREE + on + pulmo.programme("up 1 flow 1500\ndown 1.2 flow -1500\n"), "by volume to J = 2.5 and 0.7")
    if by_volume:
        rows = by_volume.signals()
        p = np.array([with_film(1 + V / 1000, gamma) for V in rows["volume_ml"]])
        lab.below("pressure beside the closed form, both branches and J < 1 (cmH2O)", np.abs(rows["airway_pressure_cmH2O"] - p).max(), 1e-6)
        lab.above("fall of the pressure beyond the turn, J 1.63 to 2.5 (cmH2O)",
                  rows["airway_pressure_cmH2O"].max() - rows["airway_pressure_cmH2O"][rows["volume_ml"].argmax()], 0.5)
        lab.true("warned of it", "falls beyond" in by_volume.out)
        lab.below("energy balance, residual over work", abs(by_volume.json()["energy_j"]["residual_relative"]), 1e-6)
    by_pressure = lab.stopped(FREE + on + pulmo.programme("up 1 pressure 4 ramp 1\n"), "with its film, has no stiffness left",
                              "a limit point. There is no equilibrium above", what="by pressure to 4 cmH2O: film and limit point are named")
    if by_pressure:
        rows = by_pressure.signals(by_pressure.signals_file)
        lab.within("where it ends (cmH2O)", rows["airway_pressure_cmH2O"].max(), p_top, 1e-3)
        lab.within("J there", rows["max_J"][-1], J_top, 0.02)
    if not lab.small:
        held = lab.finished(pulmo.LUNG + pulmo.PCV + pulmo.DIRECT + on + ["-elements", "P1-P1", "-ventilator_pip", 10, "-ts_max_time", 1.5],
                            "a breath of 10 cmH2O of the lung on springs")
        if held:
            lab.below("the same breath: energy balance, residual over work", abs(held.json()["energy_j"]["residual_relative"]), 1e-6)
            lab.above("the same breath: largest J, beyond the turn", held.signals()["max_J"].max(), J_top)
