#!/usr/bin/python3
"""A breath of a lung that has weight, as users run it: what the summary says of it, off, by region, after a restart.

By hand: tests/verification/gravity/gravity_test.py build/pulmo
"""
import os
import sys
import unittest

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [os.path.join(HERE, "..", "..", "cases")]

import pulmo_case as pulmo  # noqa: E402

BREATH = ["-ventilator_inspiration", "0.3", "-ventilator_expiration", "0.3"]
LIGHT = pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + BREATH + pulmo.QUIET + [
    "-chest_wall_direction", "normal", "-chest_wall_surfaces", "pleura"]
SCENE = LIGHT + pulmo.LUNG + ["-elements", "P1-P1"]
POSTURES = {"supine": "prone", "prone": "supine", "upright": None, "left_lateral": None}
THIRDS = ("dependent", "middle", "nondependent")


class Postures(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.cases = {p: pulmo.finished(SCENE + pulmo.options_file(f"scenes/{p}.opts")) for p in POSTURES}
        cls.numbers = {p: c.json()["gravity"] for p, c in cls.cases.items()}

    def test_weight(self):
        for posture, case in self.cases.items():
            volume = case.json()["reference_volume_ml"]
            # g/ml: a quarter is tissue
            self.assertAlmostEqual(self.numbers[posture]["lung_weight_g"], volume * (0.25 * 1.05 + 0.75 * 0.0012), delta=1e-9 * volume)
            self.assertNotIn("almost nothing", case.out)
            self.assertIn("Along gravity", case.out)

    def test_thirds_are_the_whole(self):
        for posture, case in self.cases.items():
            g, whole = self.numbers[posture], case.json()
            thirds = [g[t] for t in THIRDS]
            self.assertAlmostEqual(sum(t["reference_volume_ml"] for t in thirds), whole["reference_volume_ml"], places=6)
            self.assertAlmostEqual(sum(t["ventilation_share"] for t in thirds), 1, places=9)
            self.assertAlmostEqual(sum(t["ventilation_ml"] for t in thirds), whole["regions"]["right_lung"]["ventilation_ml"],
                                   places=6)
            mean = sum(t["reference_volume_ml"] * t["jacobian_mean"] for t in thirds) / whole["reference_volume_ml"]
            self.assertAlmostEqual(mean, whole["regions"]["right_lung"]["jacobian_mean"], places=9)

    def test_what_lies_low_is_compressed(self):
        for posture in POSTURES:
            g = self.numbers[posture]
            self.assertGreater(g["jacobian_gradient_at_start_per_cm"], 0, posture)
            J = [g[t]["jacobian_mean_at_start"] for t in THIRDS]
            self.assertLess(J[0], J[2], posture)

    def test_prone_is_supine_upside_down(self):
        for mine, other in (("dependent", "nondependent"), ("middle", "middle"), ("nondependent", "dependent")):
            self.assertAlmostEqual(self.numbers["supine"][mine]["reference_volume_ml"],
                                   self.numbers["prone"][other]["reference_volume_ml"], places=8)

    def test_the_lung_settles_before_it_breathes(self):
        for case in self.cases.values():
            self.assertIn("A phase 'settle'", case.out)
            self.assertLess(case.json()["energy_j"]["residual_relative"], 1e-6)


class Others(unittest.TestCase):
    def test_off_adds_no_key(self):
        plain = pulmo.finished(LIGHT + pulmo.CUBE)
        off = pulmo.finished(LIGHT + pulmo.CUBE + pulmo.options_file("scenes/upright.opts") + ["-gravity", "off", "-tissue_porosity", "0.99"])
        self.assertNotIn("gravity", plain.json())
        self.assertNotIn("Along gravity", plain.out)
        self.assertEqual(plain.json().keys(), off.json().keys())
        with open(plain.path("signals.csv")) as a, open(off.path("signals.csv")) as b:
            self.assertEqual(a.read(), b.read())

    def test_a_lung_without_weight_is_told(self):
        case = pulmo.finished(LIGHT + pulmo.CUBE + ["-gravity"])
        self.assertIn("-tissue_porosity 0.99", case.out)
        self.assertIn("weighs 0.0117 g", case.out)  # 1 ml: 0.01 * 1.05 + 0.99 * 0.0012
        self.assertIn("give -tissue_porosity 0.75", case.out)

    def test_porosity_of_a_region(self):
        options = LIGHT + pulmo.CUBE + ["-ventilator_expiration", "0.1"]
        mine, whole = (pulmo.finished(options + ["-tissue_porosity", p]) for p in ("0.99,lung=0.4", "0.4"))
        self.assertAlmostEqual(mine.json()["functional_residual_capacity_ml"], 0.4, places=12)
        self.assertAlmostEqual(mine.json()["min_porosity"], 1 - 0.6 / mine.json()["min_jacobian"], places=9)
        self.assertAlmostEqual(mine.json()["min_porosity"], whole.json()["min_porosity"], places=12)
        self.assertAlmostEqual(mine.json()["strain"], mine.json()["tidal_volume_ml"] / 0.4, places=12)
        values = [pulmo.fields(case)[2]["porosity"] for case in (mine, whole)]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-13)

    def test_restart(self):
        scene = LIGHT + pulmo.CUBE + pulmo.options_file("scenes/supine.opts") + ["-tissue_porosity", "0.9,lung=0.7"]
        whole = pulmo.finished(scene)
        half = pulmo.finished(scene + ["-checkpoint_every", "0.2", "-ts_max_time", "0.65"])
        rest = pulmo.finished(scene + ["-restart", half.path("checkpoint.h5")])
        # both to what the solver leaves
        mine, all_ = rest.json(), whole.json()
        self.assertAlmostEqual(mine["min_porosity"], all_["min_porosity"], places=6)
        self.assertEqual(mine["gravity"]["lung_weight_g"], all_["gravity"]["lung_weight_g"])
        for third in THIRDS:
            for key, value in all_["gravity"][third].items():
                self.assertAlmostEqual(mine["gravity"][third][key], value, places=6, msg=f"{third} {key}")


if __name__ == "__main__":
    pulmo.main()
