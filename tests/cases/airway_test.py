#!/usr/bin/python3
"""The airway: a tube obeys its own equation, two bodies on one airway share the flow as they should, and an iterative
solver finds the same."""
import unittest

import numpy as np
from scipy.optimize import brentq

import pulmo_case as pulmo
from case_meshes import bodies

ITERATIVE = pulmo.options_file("solvers/iterative.opts")


def fields(case, step=-1):
    """Of a snapshot: vertices' coordinates and pressures, volume and J of each cell and its middle."""
    x, cells, values = pulmo.fields(case, step)
    cells, p, J = cells[:, :4], values.get("alveolar_pressure_cmH2O"), values["J_mean"]
    a, b, c, d = (x[cells[:, i]] for i in range(4))
    volume = np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)) / 6
    return x, cells, p, volume, J, (a + b + c + d) / 4


class Tube(unittest.TestCase):
    K1, K2 = 6.0, 9.0  # cmH2O s/l, cmH2O s^2/l^2
    TUBE = ["-tube", "-tube_k1", K1, "-tube_k2", K2]
    BREATH = ["-ventilator", "pcv", "-ventilator_pip", "9", "-ventilator_peep", "2", "-ventilator_inspiration", "0.5",
              "-ventilator_pause", "0.1", "-ventilator_expiration", "0.6", "-ventilator_ramp", "0.1"]

    def drop(self, Q):
        return self.K1 * Q / 1000 + self.K2 * abs(Q) * Q / 1e6

    def expect_drop(self, rows, atol=1e-12):
        difference = rows["ventilator_pressure_cmH2O"] - rows["airway_pressure_cmH2O"]
        np.testing.assert_allclose(difference[1:], [self.drop(Q) for Q in rows["flow_ml_per_s"][1:]], rtol=1e-12,
                                   atol=atol)

    def machine(self, t):
        """The pressure that BREATH asks of the machine."""
        return np.interp(t, [0, 0.1, 0.7, 0.8, 1.3], [0, 2, 2, 9, 9]) if t <= 1.3 + 1e-9 else 2.0

    def test_single_compartment(self):
        """Without airflow the lung is one compartment: K1 V' + K2 |V'| V' + P(V) = P_ventilator by backward Euler."""
        for law, support in (("yoshihara", pulmo.PINS), ("birzle", pulmo.ROLLERS), ("ma", pulmo.PINS)):
            with self.subTest(law):
                breath = self.BREATH if law != "birzle" else self.BREATH + ["-ventilator_pip", "4.8"]
                rows = pulmo.finished(pulmo.TIGHT + pulmo.BLOCK + pulmo.QUIET + support + self.TUBE + breath +
                                      ["-tissue", law]).signals()
                V = 0.0
                asked = np.array([self.machine(t) for t in rows["time_s"]])
                if law == "birzle":
                    asked = np.where(asked > 2, 2 + (asked - 2) * 2.8 / 7, asked)
                np.testing.assert_allclose(rows["ventilator_pressure_cmH2O"], asked, atol=1e-9)
                worst = 0
                for i in range(1, len(asked)):
                    dt = rows["dt_s"][i]
                    V = brentq(lambda v: self.drop((v - V) / dt) + pulmo.gas_pressure(law, 1 + v / 1000) - asked[i],
                               -100, 4000, xtol=1e-12, rtol=1e-14)
                    worst = max(worst, abs(V - rows["volume_ml"][i]))
                self.assertLess(worst, 1e-10 * rows["volume_ml"].max())
                self.assertLess(rows["flow_ml_per_s"].min(), -100, "both directions of flow are tried")
                self.expect_drop(rows)

    def test_with_airflow(self):
        vcv = ["-ventilator", "vcv", "-ventilator_tidal_volume", "200", "-ventilator_inspiration", "0.4",
               "-ventilator_expiration", "0.4"]
        for ventilator, pressures in ((self.BREATH, True), (vcv, False)):
            with self.subTest(ventilator[1]):
                case = pulmo.finished(pulmo.TIGHT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + self.TUBE + ventilator)
                rows = case.signals()
                self.expect_drop(rows)
                asked = np.array([self.machine(t) for t in rows["time_s"]])
                if pressures:
                    np.testing.assert_allclose(rows["ventilator_pressure_cmH2O"], asked, rtol=0, atol=1e-9)
                else:
                    expiration = np.array(rows["phase"]) == "expiration"
                    np.testing.assert_allclose(rows["ventilator_pressure_cmH2O"][expiration], 0, atol=1e-9)
                    self.assertGreater(np.abs(rows["airway_pressure_cmH2O"][expiration]).max(), 1)
                self.assertLess(case.json()["mass_balance_error_ml"], 1e-7)

    def test_a_linear_tube_adds_its_resistance(self):
        """R of the single-compartment fit (eq. 52) with the machine's pressure rises by K1, within 2 %. Pressure goes
        up and down slowly: in a jump the lung's own R, that of a diffusing field, depends on how steep the flow is."""
        def resistance(options, pressure):
            r = pulmo.finished(pulmo.DIRECT + pulmo.SCENE + pulmo.LITRE + pulmo.QUIET + [
                "-ventilator", "pcv", "-ventilator_ramp", "0.8", "-ventilator_expiration", "1.2",
                "-ventilator_ramp_down", "0.8"] + options).signals()
            w = np.sqrt(r["dt_s"][1:])
            A = np.column_stack([r["volume_ml"][1:], r["flow_ml_per_s"][1:] / 1000]) * w[:, None]
            return np.linalg.lstsq(A, r[pressure][1:] * w, rcond=None)[0][1]

        bare = resistance([], "airway_pressure_cmH2O")
        K1 = 5.0
        tubed = resistance(["-tube", "-tube_k1", K1], "ventilator_pressure_cmH2O")
        self.assertAlmostEqual((tubed - bare) / K1, 1, delta=0.02, msg=f"R {bare} -> {tubed}")


class TwoBodies(unittest.TestCase):
    """Two lungs, one windpipe: a stiff one of 125 ml and a soft one of 64 ml, apart from each other."""
    SPRINGS = {"stiff": "0.2", "soft": "0.01"}
    AREA = {"stiff": 2500.0, "soft": 1600.0}

    @classmethod
    def setUpClass(cls):
        cls.both, cls.alone = bodies("stiff", "soft"), {name: bodies(name) for name in cls.SPRINGS}

    def options(self, bodies):
        springs = ["-chest_wall_surfaces", ",".join(bodies)]
        for name in bodies:
            springs += [f"-chest_wall_stiffness_{name}", self.SPRINGS[name]]
        return pulmo.TIGHT + pulmo.SCENE + springs + pulmo.QUIET

    @staticmethod
    def at_airway(x):
        return (np.abs(x[:, 0] - 50) < 1e-6) | (np.abs(x[:, 0] - 140) < 1e-6)

    def volumes(self, case, step=-1):
        _, _, _, volume, J, middle = fields(case, step)
        change = volume * (J - 1) / 1000
        return {"stiff": change[middle[:, 0] < 75].sum(), "soft": change[middle[:, 0] > 75].sum()}

    def test_common_pressure(self):
        """Each body alone, driven by the pressure that was found, takes what it took; together the set volume."""
        for scene in ([], pulmo.STILL):
            with self.subTest(scene):
                flow = [o for o in pulmo.FLOW_OF_TWO if not scene or o not in pulmo.FLOW_OF_TWO[-2:]]
                base = self.options(["stiff", "soft"]) + self.both + flow + pulmo.COMMON + scene
                case = pulmo.finished(base)
                rows = case.signals()
                single = {name: pulmo.finished(self.options([name]) + self.alone[name] + pulmo.replay(rows) + scene +
                                               ([] if scene else ["-airflow_permeability", "2e3"])).signals()
                          for name in self.SPRINGS}
                np.testing.assert_allclose(single["stiff"]["volume_ml"] + single["soft"]["volume_ml"],
                                           rows["volume_ml"], rtol=0, atol=1e-9 * 40)
                strain = {name: r["volume_ml"].max() / (125 if name == "stiff" else 64) for name, r in single.items()}
                self.assertGreater(strain["soft"], 1.5 * strain["stiff"])
                if scene:
                    continue
                flows = single["stiff"]["flow_ml_per_s"] + single["soft"]["flow_ml_per_s"]
                np.testing.assert_allclose(flows, rows["flow_ml_per_s"], rtol=0, atol=1e-8 * np.abs(flows).max())
                # pause: nothing goes in, but the bodies exchange gas
                pause = np.array(rows["phase"]) == "pause"
                self.assertLess(np.abs(rows["flow_ml_per_s"][pause]).max(), 1e-7)
                self.assertGreater(np.abs(single["soft"]["flow_ml_per_s"][pause]).max(), 1)
                # one pressure on all of the airway, at each snapshot
                for step in (1, 2, 3):
                    x, _, p, *_ = fields(case, step)
                    at = self.at_airway(x)
                    end = [int(np.abs(rows["time_s"] - t).argmin()) for t in (0.3, 0.5, 0.8)][step - 1]
                    P = rows["airway_pressure_cmH2O"][end]
                    mine = np.unique(p[at & np.isfinite(p)])
                    self.assertLessEqual(np.ptp(mine), 1e-14 * max(1, abs(P)), "no spread over the airway")
                    self.assertAlmostEqual(mine[0], P, delta=1e-11)

    def test_uniform(self):
        """By area: each body takes its share of the volume whatever its stiffness; the airway pressure is the mean."""
        case = pulmo.finished(self.options(["stiff", "soft"]) + self.both + pulmo.FLOW_OF_TWO + pulmo.UNIFORM)
        rows = case.signals()
        flowing = np.array([p != "expiration" for p in rows["phase"]])
        single, mean, total = {}, 0, sum(self.AREA.values())
        for name, area in self.AREA.items():
            share = area / total
            single[name] = pulmo.finished(self.options([name]) + self.alone[name] + pulmo.FLOW_OF_TWO + pulmo.UNIFORM + [
                "-ventilator_tidal_volume", repr(40 * share), "-ts_max_time", "0.5"]).signals()
            mean = mean + share * single[name]["airway_pressure_cmH2O"]
        np.testing.assert_allclose(rows["airway_pressure_cmH2O"][flowing], mean, rtol=1e-9)
        apart = single["stiff"]["airway_pressure_cmH2O"] - single["soft"]["airway_pressure_cmH2O"]
        self.assertGreater(np.abs(apart).max(), 1, "the bodies' pressures differ")
        for name, volume in self.volumes(case, 2).items():
            self.assertAlmostEqual(volume, 40 * self.AREA[name] / total, delta=1e-6 * 40)
        # eq. 48 from the fields: the mean over the facets of the airway
        x, cells, p, *_ = fields(case, 2)
        integral = area = 0
        for cell in cells:
            low = cell[self.at_airway(x[cell])]
            if len(low) == 3:
                a, b, c = x[low]
                facet = np.linalg.norm(np.cross(b - a, c - a)) / 2
                area += facet
                integral += facet * p[low].mean()
        self.assertAlmostEqual(area, total, delta=1e-9 * total)
        end = int(np.abs(rows["time_s"] - 0.5).argmin())
        self.assertAlmostEqual(integral / area, rows["airway_pressure_cmH2O"][end], delta=1e-9)


class Iterative(unittest.TestCase):
    def test_same_breath(self):
        """solvers/iterative.opts gives direct.opts' waveforms to Newton's tolerance."""
        breath = pulmo.VCV + pulmo.LITRE + pulmo.QUIET + ["-ventilator_tidal_volume", 200, "-ventilator_inspiration", "0.4",
                                        "-ventilator_expiration", "0.6"]
        for name, options in (("uniform", pulmo.UNIFORM), ("common", pulmo.COMMON), ("still", pulmo.STILL),
                              ("tube", ["-tube", "-tube_k1", "4"])):
            with self.subTest(name):
                a, b = (pulmo.finished(solver + breath + options).signals() for solver in (pulmo.TIGHT, ITERATIVE))
                for c in ("time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml"):
                    np.testing.assert_allclose(a[c], b[c], rtol=0, atol=1e-6 * np.abs(a[c]).max(), err_msg=c)
                newton, krylov = b["newton_iterations"].sum(), b["krylov_iterations"].sum()
                print(f"{name}: {krylov:.0f} Krylov iterations in {newton:.0f} Newton steps")
                self.assertLess(krylov, (30 if name in ("common", "tube") else 15) * newton)


if __name__ == "__main__":
    pulmo.main()
