#!/usr/bin/python3
"""A run that could not go on says where: everywhere, or in the solver; the same on any number of ranks. At the airway's rim:
stability_test, which makes those runs."""
import unittest

from scipy.optimize import brentq, minimize_scalar

import defaults_test
import pulmo_case as pulmo

WORDS = {"airway rim": "Where: at the airway's rim.", "everywhere": "Where: everywhere. The law ", "inside": "Where: inside the lung",
         "solver": "Where: in the solver. "}
FREE = pulmo.DIRECT + pulmo.BLOCK + pulmo.QUIET + pulmo.STILL


def expect_where(test, case, where, *words):
    """That a run could not go on, and says where and these words; its diagnosis."""
    test.assertEqual(case.code, 2, case.tail())
    found = case.json("failure.json")["diagnosis"]
    test.assertEqual(found["where"], where, case.err)
    for name, text in WORDS.items():
        test.assertEqual(text in case.err, name == where, case.err)
    for word in words:
        test.assertIn(word, case.err)
    return found


def expect_rim(test, case, cell):
    """CM1 swells into its airway where only springs bear the wall; cell: size of the cells there, mm. The runs are those of
    stability_test."""
    found = expect_where(test, case, "airway rim", "What to try: -lumen_pressure (here it is off")
    test.assertLess(found["distance_from_rim_mm"], 2 * 2 * cell)
    test.assertIn(f"That cell is {found['distance_from_rim_mm']:.4g} mm from the edge of the airway", case.err)


class Failure(unittest.TestCase):
    def expect(self, where, options, *words, ranks=1):
        case = pulmo.Case(options, ranks=ranks)
        return case, expect_where(self, case, where, *words)

    def test_limit_point(self):
        """CM4 without springs has no equilibrium above 16.83 cmH2O: dp/dJ vanishes at J = 2.534, and it stays elliptic."""
        scene = FREE + pulmo.ROLLERS + ["-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", "20",
                                        "-ventilator_ramp", "1", "-ts_max_time", "1"]
        for ranks in (1, 2):
            case, found = self.expect("everywhere", scene, "yoshihara has no stiffness left at this stretch: at the mean J = 2.5",
                                      "There is no equilibrium above 16.8", "acoustic tensor", ranks=ranks)
            self.assertAlmostEqual(found["mean_jacobian"], 2.534, delta=0.05)
            self.assertLess(abs(found["inflation_stiffness_cmH2O"]), 0.5)  # 47 at rest
            self.assertAlmostEqual(found["acoustic_stiffness_kPa"], 2 * 1.298, places=6)
            self.assertEqual(found["not_elliptic_volume_share"], 0)
            # p = 2 c (J^(-1/3) - J^(-2 beta - 1)) is largest at J^(2 beta + 2/3) = 3 (2 beta + 1)
            J = 7.5 ** (1 / (1.5 + 2 / 3))
            self.expect_own_limit(case, "pressure", J, 2 * 1.298 * (J ** (-1 / 3) - J**-2.5) / pulmo.KPA_PER_CMH2O,
                                  "holds no more than 16.83 cmH2O (dp/dJ = 0 at J = 2.534)")
            self.assertAlmostEqual(found["law_limit"]["volume_share_there_or_beyond"], 1, places=12)

    def expect_own_limit(self, case, what, J, pressure, *words):
        """Of the law, as failure.json and the message have it."""
        found = case.json("failure.json")["diagnosis"]["law_limit"]
        self.assertEqual(found["what"], what)
        self.assertAlmostEqual(found["jacobian"], J, delta=1e-6 * J)
        self.assertAlmostEqual(found["pressure_cmH2O"], pressure, delta=1e-6 * (1 + abs(pressure)))
        for word in ("The law's own limit: ", f"; {100 * found['volume_share_there_or_beyond']:.4g} % of the lung is there or beyond.", *words):
            self.assertIn(word, case.err)

    def test_limits_count_from_the_prestress(self):
        """The same lung, imaged under 5 cmH2O: J by the volume that it has then, pressures from there."""
        case, _ = self.expect("everywhere", FREE + pulmo.ROLLERS + [
            "-tissue", "yoshihara", "-prestress", "-ventilator", "pcv", "-ventilator_pip", "15", "-ventilator_ramp", "1", "-ts_max_time", "1"])
        p = lambda J: 2 * 1.298 * (J ** (-1 / 3) - J**-2.5) / pulmo.KPA_PER_CMH2O  # noqa: E731
        J = 7.5 ** (1 / (1.5 + 2 / 3))
        self.expect_own_limit(case, "pressure", J / brentq(lambda x: p(x) - 5, 1, J), p(J) - 5, "holds no more than 11.83 cmH2O")

    def test_plateau(self):
        """CM3 beyond the place where dp/dJ of its closed form is least, by volume; then a jump that Newton's method is not given the steps for."""
        scene = FREE + pulmo.ROLLERS + ["-tissue", "birzle", "-snes_max_it", "6", "-ts_adapt_dt_min", "0.05"]
        softest = minimize_scalar(lambda J: pulmo.gas_pressure("birzle", J + 1e-4) - pulmo.gas_pressure("birzle", J - 1e-4), bounds=(2, 3),
                                  method="bounded", options={"xatol": 1e-10}).x
        for flow, beyond in (1000, False), (7000, True):  # J = 1.5 and 4.5
            case = pulmo.Case(scene + pulmo.programme(f"in 0.5 flow {flow}\njump 0.1 pressure 2000\n"))
            self.assertEqual(case.code, 2, case.tail())
            found = case.json("failure.json")["diagnosis"]
            if beyond:
                self.expect_own_limit(case, "plateau", softest, pulmo.gas_pressure("birzle", softest), "has next to no stiffness at J = 2.526 and 5.028 cmH2O")
                self.assertEqual(found["law_limit"]["volume_share_there_or_beyond"], 1)
            else:
                self.assertIsNone(found["law_limit"])
                self.assertNotIn("The law's own limit", case.err)

    def test_ellipticity(self):
        """Suction takes CM2 to J = 0.582, where it loses its stiffness in shear; soft springs on two faces make the state uneven."""
        scene = FREE + ["-chest_wall", "-chest_wall_surfaces", "x0,x1", "-chest_wall_stiffness", "0.001", "-tissue", "ma"]
        case, found = self.expect("everywhere", scene + pulmo.programme("suction 1 pressure -20 ramp 1"),
                               "The law ma has no stiffness left at this stretch")
        self.assertAlmostEqual(found["mean_jacobian"], 0.582, delta=0.04)
        self.assertLess(found["acoustic_stiffness_kPa"], 0.05 * found["acoustic_stiffness_at_rest_kPa"])
        self.assertGreater(found["not_elliptic_volume_share"], 0.1)
        self.assertGreater(found["inflation_stiffness_cmH2O"], 10)  # volume is not what gives way
        # F = s I + g e2 e1^T has d2W/dg2 = 0 at g = 0 where (s^2 - 1) (3 a + b)/2 + ... = 0: tests/unit/failure_test
        self.expect_own_limit(case, "waves", 0.5818631, -5.3564306, "is not elliptic below J = 0.5819")

    def test_solver(self):
        """The tissue is well, and neither the linear solver nor Newton's method is let do its work."""
        scene = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + pulmo.QUIET + ["-tissue", "yoshihara", "-ts_adapt_dt_min", "0.01"]
        for words, flags in (("The linear solver failed", ["-ksp_type", "gmres", "-pc_type", "jacobi", "-ksp_max_it", "1",
                                                           "-ksp_rtol", "1e-10"]),
                             ("Newton's method stalled", ["-snes_max_it", "1", "-snes_rtol", "1e-14", "-snes_stol", "0"])):
            with self.subTest(words):
                _, found = self.expect("solver", scene + flags, words, "-snes_monitor and -ksp_monitor show where it stalls")
                self.assertIsNone(found["worst_cell_mm"])

    def test_shares_of_a_flow(self):
        """A flow that is shared by area and by nothing else is told where a run fails."""
        pair = defaults_test.bodies(large=(50.0, 0.25), small=(40.0, 1.0))
        scene = pulmo.VCV + pair + pulmo.DIRECT + pulmo.QUIET + [
            "-chest_wall_surfaces", "pleura", "-ventilator_tidal_volume", "40", "-ts_adapt_dt_min", "0.01",
            "-snes_max_it", "1", "-snes_rtol", "1e-14", "-snes_stol", "0"]
        told = ("-ventilator_flow_split uniform shares the flow by area: body_1 has 28.1 % of the airway's area and 66.1 % of the volume",
                "What to try: -ventilator_flow_split common_pressure, ")
        self.expect("solver", scene + pulmo.UNIFORM, *told)
        case, _ = self.expect("solver", scene + pulmo.COMMON)
        self.assertNotIn("shares the flow by area", case.err)


if __name__ == "__main__":
    pulmo.main()
