"""Hard cases of the tissue laws: collapse, limit points, neutral plateaus, overflow, vanishing stiffness."""
import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar

from .lab import case, number, pulmo

FREE = pulmo.DIRECT + pulmo.STILL + pulmo.PINS  # no airflow, no springs: F = J^(1/3) I, p = dW/dJ
FOLDS = ("The tissue turned inside out: J = ", "in the cell at (")


def says_where(run):
    """Whether a run that stopped says where the tissue folds."""
    return all(words in run.err for words in FOLDS)


def inflated(law, pressure, low, high):
    """J of the closed form p = dW/dJ at a pressure (cmH2O)."""
    return brentq(lambda J: pulmo.gas_pressure(law, J) - pressure, low, high, xtol=1e-13)


def ma_soft_in_shear():
    """J of isotropic compression at which CM2 is no longer elliptic: F = λ I, and d²W(F + s a ⊗ N)/ds² = 0 for a ⊥ N."""
    a, b = 0.43, -0.6
    S, shear = 2 * (3 * a + b), -b / 2  # of W: stress per strain (λ² − 1)/2, shear modulus
    return (S / (S + 2 * shear)) ** 1.5


def limit_point():
    """J and p (cmH2O) of CM4's maximum of dW/dJ."""
    top = minimize_scalar(lambda J: -pulmo.gas_pressure("yoshihara", J), bounds=(1, 6), method="bounded",
                          options={"xatol": 1e-10})
    return top.x, -top.fun


@case("Near-collapse: suction of 20 cmH2O, and far beyond", "closed forms of J, also of CM1 at 2000 cmH2O; the porosity and the warning when it is negative; "
      "on the lung CM2 holds until it is no longer elliptic",
      "the lung with CM2, CM4 and CM5")
def suction(lab):
    """J falls towards 1 − Φ0, where no air is left. CM2 to CM5 have no barrier there: nothing in the model keeps the
    porosity positive, so pulmo has to say when it is not. CM2 has no shear stiffness below J = 0.58: on the lung there is nothing left to
    converge to."""
    for law in pulmo.tissue_laws():
        run = lab.finished(FREE + pulmo.BLOCK + ["-tissue", law] + pulmo.programme("suction 1 pressure -20 ramp 1"),
                           f"{law} at −20 cmH2O")
        if run and law not in pulmo.CLOSED_FORMS:
            lab.demand(f"J of {law}, free: not compared, pulmo_case.py has no closed form", run.signals()["min_J"][-1], "any", True)
        elif run:
            J = inflated(law, -20, 0.0101 if law == "berger" else 1e-3, 1)
            lab.within(f"J of {law}, free", run.signals()["min_J"][-1], J, 1e-6)
    # the barrier of CM1: J − (1 − Φ0) beside its closed form
    run = lab.finished(FREE + pulmo.BLOCK + ["-tissue", "berger"] + pulmo.programme("suction 1 pressure -2000 ramp 1"),
                       "berger at −2000 cmH2O")
    if run:
        lab.within("J − (1 − Φ0) of berger at −2000 cmH2O, free", run.signals()["min_J"][-1] - 0.01,
                   inflated("berger", -2000, 0.0101, 1) - 0.01, 1e-6)
    lung = pulmo.DIRECT + pulmo.SCENE + pulmo.LUNG + pulmo.programme("suction 0.3 pressure -20 ramp 0.2")
    for law in ["birzle"] if lab.small else ["birzle", "yoshihara", "rausch"]:
        lab.finished(lung + ["-tissue", law], f"lung with springs and airflow, {law}")
    if not lab.small:
        run = lab.run(lung + ["-tissue", "ma"])
        rows, J = run.signals(run.signals_file), ma_soft_in_shear()
        lab.demand("lung with springs and airflow, ma: least J where it stops, beside that where CM2 loses its shear stiffness",
                   "it finished" if run.finished else float(rows["min_J"][-1]), f"< {number(J)}", not run.finished and rows["min_J"][-1] < J)
    # the same suction on CM4 with little air: J = 0.7835 everywhere, the porosity 1 - (1 - Phi0)/J changes sign
    J = inflated("yoshihara", -20, 1e-3, 1)
    for porosity, alarm in ((0.3, False), (0.2, True)):
        run = lab.finished(pulmo.DIRECT + pulmo.PAPER + pulmo.PINS + pulmo.BLOCK + [
            "-tissue", "yoshihara", "-airflow", "-airflow_surfaces", "x1", "-airflow_permeability", 1e8, "-tissue_porosity", porosity] +
            pulmo.programme("suction 1 pressure -20 ramp 0.5"), f"Φ0 = {porosity}")
        if run:
            lab.within(f"least porosity, Φ0 = {porosity}", run.json().get("min_porosity", np.nan), 1 - (1 - porosity) / J, 1e-4)
            lab.demand(f"warned of it, Φ0 = {porosity}", "yes" if "porosity falls below zero" in run.out else "no",
                       "yes" if alarm else "no", alarm == ("porosity falls below zero" in run.out))
    # CM2 far down: no equilibrium with airflow holds; whatever happens is said
    flat = lab.run(pulmo.DIRECT + pulmo.PAPER + pulmo.PINS + pulmo.BLOCK + [
        "-tissue", "ma", "-airflow", "-airflow_surfaces", "x1", "-airflow_permeability", 1e8] +
        pulmo.programme("suction 4 pressure -150 ramp 4"))
    empty = flat.json(flat.summary_file)["min_jacobian"] < 0.01
    lab.demand("CM2 to −150 cmH2O", f"J {flat.json(flat.summary_file)['min_jacobian']:.2g}, " + (
        "finished" if flat.finished else "stopped") + (", warned" if "porosity falls below zero" in flat.out else ""),
        "a warning if J < 1 − Φ0", empty == ("porosity falls below zero" in flat.out))


@case("Limit point of CM4: no equilibrium above 16.83 cmH2O", "stops at the closed form's maximum and says so; flow control passes along the closed form")
def limit(lab):
    """Unrestrained Yoshihara tissue holds at most 16.83 cmH2O; above there is no state to converge to. Prescribed volume
    goes on where pressure cannot."""
    J_top, p_top = limit_point()
    scene = FREE + pulmo.BLOCK + ["-tissue", "yoshihara"]
    run = lab.stopped(scene + ["-ventilator", "pcv", "-ventilator_pip", 20, "-ventilator_ramp", 1],
                      "a limit point. There is no equilibrium above 16.8", "yoshihara", what="pressure control to 20 cmH2O")
    if run:
        rows = run.signals(run.signals_file)
        lab.within("last pressure held (cmH2O)", rows["airway_pressure_cmH2O"][-1], p_top, 0.02)
        lab.below("J there, beside the limit point's", rows["max_J"][-1], J_top)
        lab.curves["pressure control"] = [rows["max_J"].tolist(), rows["airway_pressure_cmH2O"].tolist()]
    below = lab.finished(scene + ["-ventilator", "pcv", "-ventilator_pip", 16.7, "-ventilator_ramp", 1, "-ts_max_time", 1])
    if below:
        lab.within("J at 16.7 cmH2O", below.signals()["max_J"][-1], inflated("yoshihara", 16.7, 1, J_top), 1e-5)
    flow = lab.finished(scene + pulmo.programme("inflation 1 flow 4000"), "flow control to J = 5")
    if flow:
        rows = flow.signals()
        exact = pulmo.gas_pressure("yoshihara", 1 + rows["volume_ml"] / 1000)
        lab.below("error of its pressure, cmH2O", np.abs(rows["airway_pressure_cmH2O"] - exact).max(), 1e-6)
        lab.within("largest pressure passed (cmH2O)", rows["airway_pressure_cmH2O"].max(), p_top, 0.02)
        lab.below("pressure falls behind it: last over largest",
                  rows["airway_pressure_cmH2O"][-1] / rows["airway_pressure_cmH2O"].max(), 0.97)
        lab.curves["flow control"] = [rows["max_J"].tolist(), rows["airway_pressure_cmH2O"].tolist()]
    gas = lab.finished(pulmo.DIRECT + pulmo.SCENE + ["-chest_wall", "off"] + pulmo.PINS + pulmo.BLOCK + [
        "-tissue", "yoshihara", "-airflow_surfaces", "x1"] + pulmo.programme("inflation 1 flow 2500"),
        "flow control with airflow, to J = 3.5")
    if gas:
        lab.within("volume delivered (ml)", gas.signals()["volume_ml"][-1], 2500, 1e-9)


@case("Neutral plateau of CM3 near 5.03 cmH2O", "pressures along the closed form, to 10⁻⁶ cmH2O",
      "Δt 0.05 and 0.02 s, the jump, the lung")
def plateau(lab):
    """dp/dJ of unrestrained Birzle tissue falls to 10⁻⁵ of its value at rest: J moves from 2 to 3 while the pressure
    changes by a hundredth of a cmH2O, and Newton overshoots by factors."""
    scene = FREE + pulmo.BLOCK + ["-tissue", "birzle"]
    for dt in [0.1] if lab.small else [0.1, 0.05, 0.02]:
        run = lab.finished(scene + ["-ts_dt", dt, "-ventilator", "pcv", "-ventilator_pip", 6, "-ventilator_ramp", 1,
                                    "-ts_max_time", 1], f"ramp to 6 cmH2O, Δt {dt} s")
        if run:
            rows = run.signals()
            J = [inflated("birzle", p, 0.9, 8) for p in rows["airway_pressure_cmH2O"]]
            # beside the plateau dJ/dp is 10^5: compare pressures
            p = pulmo.gas_pressure("birzle", rows["max_J"])
            lab.below(f"error of pressure, Δt {dt} s, cmH2O", np.abs(p - rows["airway_pressure_cmH2O"]).max(), 1e-6)
            lab.within(f"J at 6 cmH2O, Δt {dt} s", rows["max_J"][-1], J[-1], 1e-7)
    flow = lab.finished(scene + pulmo.programme("inflation 1 flow 3000"), "flow control across it")
    if flow:
        rows = flow.signals()
        exact = pulmo.gas_pressure("birzle", 1 + rows["volume_ml"] / 1000)
        lab.below("error of pressure under flow control, cmH2O", np.abs(rows["airway_pressure_cmH2O"] - exact).max(), 1e-6)
    if not lab.small:
        lab.finished(scene + ["-ventilator", "pcv", "-ventilator_pip", 6, "-ventilator_ramp", 0, "-ts_max_time", 0.2],
                     "6 cmH2O in one jump, without springs and airflow")
        lab.finished(pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + ["-tissue", "birzle", "-ventilator_pip", 5.03, "-ts_max_time", 1],
                     "lung with springs and airflow at 5.03 cmH2O")


@case("CM2's exponential at large stretch", "J of the closed form, after a ramp and after a jump", "the ramp to 10000 cmH2O")
def exponential(lab):
    """exp(g (J^(2/3) − 1)²) overflows for J above some 230: a Newton step too far makes infinity, and a line search that
    believes it loses the state."""
    for pressure in [100, 1000, 10000]:
        J = inflated("ma", pressure, 1, 100)
        for ramp in [0] if lab.small and pressure == 10000 else [1, 0]:
            run = lab.finished(FREE + pulmo.BLOCK + ["-tissue", "ma", "-ventilator", "pcv", "-ventilator_pip", pressure,
                                                     "-ventilator_ramp", ramp, "-ts_max_time", 1 if ramp else 0.1],
                               f"{pressure} cmH2O " + ("in 1 s" if ramp else "in one step"))
            if run:
                lab.within(f"J at {pressure} cmH2O, " + ("ramp" if ramp else "one step"), run.signals()["max_J"][-1], J, 1e-6)


@case("CM5's zero shear modulus at F = I", "J of the closed form; no step cut; energy balance", "0.8 s of the lung's breath")
def no_shear(lab):
    """Rausch's isochoric energy grows with the fourth power of the shear strain: the tangent at rest is singular in
    shear, and Newton converges linearly at best."""
    run = lab.finished(FREE + pulmo.BLOCK + ["-tissue", "rausch", "-ventilator", "pcv", "-ventilator_pip", 6, "-ts_max_time", 0.5])
    if run:
        lab.within("J at 6 cmH2O, free", run.signals()["max_J"][-1], inflated("rausch", 6, 1, 2), 1e-6)
    lung = pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + ["-tissue", "rausch"]
    run = lab.finished(lung + ["-ts_max_time", 0.2 if lab.small else 1], "lung with springs and airflow")
    if run:
        rows = run.signals()
        lab.below("most Newton steps of a step", rows["newton_iterations"].max(), 20)
        lab.demand("steps cut", run.json()["rejected_steps"], "0", run.json()["rejected_steps"] == 0)
        lab.below("energy balance, residual over work", run.json()["energy_j"]["residual_relative"], 1e-8)


@case("CM1 at the airway's rim with the paper's traction", "finishes, or stops and says which cell turned inside out",
      "the whole breath, the lung at 20 cmH2O")
def rim(lab):
    """Without gas pressure on the airway wall soft tissue swells into the airway and folds at its rim: a code that trusts
    Newton's convergence accepts J < 0 there."""
    berger = pulmo.DIRECT + pulmo.PCV + ["-tissue", "berger"]
    run = lab.run(berger + pulmo.LUNG + ["-ts_max_time", 0.3])
    lab.demand("6 cmH2O, the paper's traction", f"finished, min J {run.json()['min_jacobian']:.3g}" if run.finished else
               "stopped: " + run.sentence, "finishes with min J > 0, or says where it folds",
               run.finished or says_where(run))
    lab.finished(berger + pulmo.LUNG + ["-lumen_pressure", "-ts_max_time", 0.3 if lab.small else 1.5],
                 "the same with -lumen_pressure")
    lab.stopped(berger + pulmo.CUBE + ["-ventilator_pip", 40, "-airflow_permeability", 10, "-ts_max_time", 0.3],
                "converged to a state with J <= 0", *FOLDS, "-lumen_pressure",
                what="a cube at 40 cmH2O, where Newton converges to J < 0")
    if not lab.small:
        lab.stopped(berger + pulmo.LUNG + ["-ventilator_pip", 20, "-ts_adapt_dt_min", 1e-3, "-ts_max_time", 0.3],
                    *FOLDS, what="the lung at 20 cmH2O")


@case("Volume control of the soft laws CM1 and CM2", "the volume set, to 10⁻⁹; finishes, or says which cell turned inside out",
      "the whole breath, the paper's traction")
def soft_volume_control(lab):
    """The prescribed flux is pushed through the airway's own tissue, which inflates first: CM1 and CM2 fold at the rim
    under the paper's traction."""
    vcv = pulmo.DIRECT + pulmo.VCV + pulmo.LUNG + ["-ventilator_tidal_volume", 250, "-ts_max_time", 0.3 if lab.small else 1.5]
    for law in ("berger", "ma"):
        wall = lab.finished(vcv + ["-tissue", law, "-lumen_pressure"], f"{law} with -lumen_pressure")
        if wall:
            rows = wall.signals()
            last = max(i for i, phase in enumerate(rows["phase"]) if phase != "expiration")
            volume = 250 * min(rows["time_s"][last], 1)
            lab.within(f"volume in, {law} (ml)", rows["volume_ml"][last], volume, 1e-9)
        if not lab.small:
            bare = lab.run(vcv + ["-tissue", law])
            lab.demand(f"{law}, the paper's traction", "finished" if bare.finished else "stopped: " + bare.sentence,
                       "finishes, or says where it folds", bare.finished or says_where(bare))


def network_of_walls(stretches):
    """W (kPa) of the unit cell of concha's default parameters: struts and joints, its least over three places."""
    mu, alpha, d, porosity = 10.33, 10.05, 0.56, 0.69
    v = (1 - porosity) / (12 - 9 * d)

    def W(s):
        x, y = stretches + s, np.roll(stretches, -1) - np.roll(s, -1)
        strut, turn = np.hypot(x, y) / np.sqrt(2), np.arctan2(y, x)
        return (4 * v * mu * (strut**2 / 2 + 1 / strut - 1.5).sum() + 6 * np.sqrt(2) / np.pi * alpha * mu * v**2 * (
            2 * np.cos(2 * turn) ** 2 + 4 * (0.5 - np.sin(turn) * np.cos(np.roll(turn, -1))) ** 2).sum())
    return minimize(W, np.zeros(3), tol=1e-12).fun


@case("Walls that fold: tissue of concha is pressed flat", "energy of the unit cell by another minimiser until there; stops where the law has lost its stiffness, and says so")
def walls(lab):
    """A block is squeezed along z and pulled along x and y. The walls of its cells are pressed until the cell has two states, to either side,
    between which stress jumps: no tissue is in equilibrium there."""
    moved = "0.5*t*x,0.5*t*y,-0.55*t*z"
    scene = FREE[:-len(pulmo.PINS)] + pulmo.BLOCK + ["-tissue", "concha", "-ts_dt", 0.05, "-support", "-support_surfaces", "x0,x1,y0,y1,z0,z1"]
    for face in ("x0", "x1", "y0", "y1", "z0", "z1"):
        scene += [f"-support_displacement_{face}", moved]
    run = lab.finished(scene + ["-ts_max_time", 0.6], "to stretches of 1.3, 1.3, 0.67")
    if run:
        energy = pulmo.columns(run.path("energy.csv"))
        exact = [network_of_walls(np.array([1 + 0.5 * t, 1 + 0.5 * t, 1 - 0.55 * t])) for t in energy["time_s"]]  # of a litre: J
        lab.below("error of the stored energy over it", np.abs(energy["elastic_tissue_j"] - exact).max() / exact[-1], 1e-7)
    lab.stopped(scene + ["-ts_max_time", 1], "The law concha has no stiffness left at this stretch", "concha", what="to 1.5, 1.5, 0.45")
