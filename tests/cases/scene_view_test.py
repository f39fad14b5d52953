#!/usr/bin/python3
"""-scene_view: the scene in words, every effect in it or not in it, and how far its tissue goes against closed forms."""
import os
import re
import unittest

import numpy as np
from scipy.optimize import brentq, minimize_scalar

import pulmo_case as pulmo

ONLY = ["-scene_view_only"]
LUNG = pulmo.LUNG + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT
FREE = ["-chest_wall", "off", "-lumen_pressure", "off", "-support", "-support_rigid"]
SECTIONS = ["The mesh", "In this scene", "Not in this scene", "How far the tissue goes", "How it breathes", "How it is solved"]


def told(options, **arguments):
    """{title: lines} of the scene in words."""
    case = pulmo.finished(options + ONLY, **arguments)
    found, title = {}, None
    for line in case.out.splitlines():
        if line in SECTIONS:
            title = line
            found[title] = []
        elif title and line.startswith("  "):
            found[title].append(line.strip())
    return found, case


def after(text, words):
    """The number that follows some words."""
    match = re.search(re.escape(words) + r"\s*(-?[\d.e+-]*\d)", text)
    assert match, f"'{words}' is not in: {text}"
    return float(match[1])


class Words(unittest.TestCase):
    def test_every_scene_file_is_a_scene(self):
        """As README gives them: those that are no manoeuvre after one."""
        folder = os.path.join(pulmo.SOURCE, "petsc_options", "scenes")
        names = sorted(name for name in os.listdir(folder) if name.endswith(".opts"))
        self.assertGreater(len(names), 20)
        for name in names:
            with self.subTest(scene=name):
                with open(os.path.join(folder, name)) as file:
                    manoeuvre = re.search("^-ventilator ", file.read(), re.M)
                before = [] if manoeuvre else pulmo.options_file("scenes/pcv.opts")
                after = pulmo.programme("breath 1 pressure 5\n") if name == "programme.opts" else []
                scene, _ = told(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + before + pulmo.DIRECT + pulmo.options_file("scenes/" + name)
                                + ["-elements", "P1-P1"] + after)
                self.assertEqual(list(scene), SECTIONS)

    def test_each_effect_is_in_it_or_not(self):
        """Those of -list, so that a new one is told as well."""
        scene, _ = told(LUNG + ["-gravity", "-tube", "-tube_k1", "4"])
        on = {"tissue", "airflow", "ventilator", "chest_wall", "lumen_pressure", "gravity", "tube"}
        every = pulmo.common.offered(pulmo.PROGRAM, "effect")
        for effect in every:
            words = effect.replace("_", " ")
            inside = [line for line in scene["In this scene"] if line.startswith(words.capitalize() + ":")]
            outside = [line for line in scene["Not in this scene"] if line.startswith(f"No {words}:") and f"(-{effect})" in line]
            self.assertEqual((len(inside), len(outside)), (1, 0) if effect in on else (0, 1), effect)
        self.assertGreater(len(every), len(on))

    def test_numbers_have_their_units(self):
        scene, _ = told(pulmo.LUNG + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT +
                        ["-gravity", "-gravity_tissue_density", "1050,right_lung=1100", "-ventilator_peep", "5", "-ts_dt", "0.02"])
        text = {title: " ".join(lines) for title, lines in scene.items()}
        self.assertEqual(list(scene), SECTIONS)
        for title, words in (("The mesh", "has 1350 ml in 1324 tetrahedra"), ("The mesh", "Surface airway has 7.263 cm^2."),
                             ("In this scene", "; tissue density 1050,right_lung=1100 kg/m^3"), ("In this scene", "; stiffness 0.08 kPa/mm"),
                             ("How it breathes", "Phase inspiration of breath 1, 2.1 to 3.1 s: pressure of 6 cmH2O, reached within 0.1 s."),
                             ("How it is solved", "backward Euler in steps of 0.02 s"), ("How it is solved", "-pc_type lu"),
                             ("How it is solved", "direct.opts")):
            self.assertIn(words, text[title])

    def test_it_prints_and_goes_on_or_stops(self):
        case = pulmo.finished(LUNG + ["-scene_view", "-ts_max_time", "0.05"])
        self.assertIn("Not in this scene", case.out)
        self.assertIn("summary.json", case.files())
        self.assertEqual(told(LUNG)[1].files(), [])
        self.assertNotIn("Not in this scene", pulmo.finished(LUNG + ["-ts_max_time", "0.05"]).out)

    def test_ranks_tell_the_same_once(self):
        scene = pulmo.options_file("scenes/ards.opts") + pulmo.DIRECT
        one, two = (told(scene, ranks=ranks)[1].out for ranks in (1, 2))
        self.assertEqual(one, two)
        self.assertEqual(one.count("Not in this scene"), 1)

    def test_a_restart_may_ask_for_it(self):
        first = pulmo.finished(LUNG + ["-ts_max_time", "0.05", "-checkpoint_every", "0.05"])
        pulmo.finished(LUNG + ["-ts_max_time", "0.1", "-scene_view", "-restart", first.path("checkpoint.h5")])


class Range(unittest.TestCase):
    """Against p = dW/dJ of the case tests' own closed forms."""

    def lines(self, options):
        return told(LUNG + options)[0]["How far the tissue goes"]

    def test_a_limit_of_pressure(self):
        peak = minimize_scalar(lambda J: -pulmo.gas_pressure("yoshihara", J), bounds=(1, 10), method="bounded")
        text = " ".join(self.lines(["-tissue", "yoshihara", "-ventilator_pip", "20", "-ventilator_peep", "5"]))
        self.assertAlmostEqual(after(text, "holds no more than"), -peak.fun, delta=0.06)
        self.assertAlmostEqual(after(text, "cmH2O, at J ="), peak.x, delta=0.01)
        J = brentq(lambda J: pulmo.gas_pressure("yoshihara", J) - 5, 1, peak.x)
        self.assertAlmostEqual(after(text, "lowest pressure of the ventilator, 5 cmH2O: J ="), J, delta=0.006)
        self.assertIn("at the highest, 20 cmH2O: beyond what it holds", text)

    def test_prestress_moves_it(self):
        """What the tissue bears in the mesh already, 5 cmH2O, is not there to be borne again."""
        J0 = brentq(lambda J: pulmo.gas_pressure("patte", J) - 5, 1, 4)
        J = brentq(lambda J: pulmo.gas_pressure("patte", J) - 20, 1, 4) / J0
        slope = minimize_scalar(lambda J: pulmo.gas_pressure("patte", J + 1e-4) - pulmo.gas_pressure("patte", J - 1e-4),
                                bounds=(1, 3), method="bounded")
        text = " ".join(self.lines(["-tissue", "patte", "-ventilator_pip", "15", "-prestress", "-prestress_pressure", "5"]))
        self.assertAlmostEqual(after(text, "at the highest, 15 cmH2O: J ="), J, delta=0.006)
        self.assertAlmostEqual(after(text, "softest at J ="), slope.x / J0, delta=0.006)
        self.assertAlmostEqual(after(text, f"softest at J = {slope.x / J0:.3g} ("), pulmo.gas_pressure("patte", slope.x) - 5, delta=0.06)

    def test_recruitment_comes_on_top(self):
        """What opens has its volume without stress."""
        text = " ".join(self.lines(["-tissue", "ma", "-recruitment", "-recruitment_gain", "0.5", "-recruitment_start", "0.2"]))
        self.assertAlmostEqual(after(text, "J is up to"), 1.5 / 1.1, delta=0.006)
        self.assertAlmostEqual(after(text, "once all is open, and"), 1 / 1.1, delta=0.006)
        self.assertNotIn("-recruitment", " ".join(self.lines(["-tissue", "ma"])))

    def test_each_lung_by_its_parameters(self):
        scene = told(["-dm_plex_filename", pulmo.mesh("lung_pair.msh")] + pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT +
                     ["-tissue", "yoshihara", "-tissue_c", "1.298,left_lung=2.596"])[0]
        limits, volumes = [], []
        for line in scene["How far the tissue goes"]:
            if line.startswith("-tissue"):
                limits.append(after(line, "holds no more than"))
                volumes.append(after(line, "in the"))
        self.assertEqual(len(limits), 2)
        self.assertAlmostEqual(limits[1] / limits[0], 2, delta=0.01)
        parts = dict(re.findall(r"Volume (\w+) has ([\d.]+) ml", " ".join(scene["The mesh"])))
        np.testing.assert_allclose(volumes, [float(parts["right_lung"]), float(parts["left_lung"])], rtol=2e-3)

    def test_a_prescribed_volume(self):
        text = " ".join(told(pulmo.LUNG + pulmo.options_file("scenes/supersyringe.opts") + pulmo.DIRECT +
                             ["-tissue", "patte"])[0]["How far the tissue goes"])
        J = 1 + 800 / 1350
        self.assertAlmostEqual(after(text, "spread evenly, J ="), J, delta=0.006)
        self.assertAlmostEqual(after(text, f"J = {J:.3g} at"), pulmo.gas_pressure("patte", J), delta=0.06)

    def test_certain_failure_is_told_unasked(self):
        """Nothing but tissue, and more pressure than it holds; silence where it holds it, or something else may."""
        words = "held there the lung fills without end"
        for options, warned in ((FREE + ["-ventilator_pip", "17"], True), (FREE + ["-ventilator_pip", "16.5"], False),
                                (["-ventilator_pip", "17"], False), (FREE + ["-ventilator_pip", "17", "-viscoelastic"], False)):
            with self.subTest(options):
                self.assertEqual(words in told(LUNG + ["-tissue", "yoshihara", *options])[1].out, warned)


if __name__ == "__main__":
    pulmo.main()
