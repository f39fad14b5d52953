#!/usr/bin/python3
"""Input that runs to its end and cannot be right, or may be wrong: refused, or told. Silence means right."""
import re
import unittest

import pulmo_case as pulmo

CUBE = ["-dm_plex_filename", pulmo.mesh("cube_msh22_ascii.msh"), "-mesh_scale", "10", "-elements", "P1-P1"]  # 1 ml
PCV = pulmo.options_file("scenes/pcv.opts") + pulmo.DIRECT + [
    "-ventilator_pip", "3", "-ventilator_inspiration", "0.2", "-ventilator_expiration", "0.2"] + pulmo.QUIET
BASE = CUBE + PCV


def words(case):
    """Notes and warnings."""
    return re.findall(r"^pulmo: (?:note|warning): .*$", case.out, re.M)


class Plausible(unittest.TestCase):
    def refused(self, options, *expected, ranks=1):
        case = pulmo.Case(options, ranks=ranks)
        self.assertEqual(case.code, 1, f"{case.command}\n{case.tail()}")
        lines = [line for line in case.err.splitlines() if line.startswith("pulmo: error: ")]
        self.assertEqual(len(lines), 1, case.tail())
        for word in expected:
            self.assertIn(word, lines[0])
        self.assertNotIn("PETSC ERROR", case.err)
        self.assertEqual(case.files(), [])

    def told(self, options, *expected):
        case = pulmo.finished(options)
        found = [w for w in words(case) if all(e in w for e in expected)]
        self.assertEqual(len(found), 1, f"{expected}\n{case.command}\n{case.out}")
        return case

    def test_what_is_right_leaves_no_word(self):
        case = pulmo.finished(BASE + ["-ts_dt", "0.02", "-ventilator_ramp_down", "0.1"])
        self.assertEqual(words(case), [])


class Tissue(Plausible):
    def test_a_law_that_is_not_stable_at_rest(self):
        for law, parameters in (("ma", ["-tissue_a", "-0.1"]), ("ma", ["-tissue_a", "0.043"]), ("ma", ["-tissue_b", "0.1"])):
            self.refused(BASE + ["-tissue", law] + parameters, "-tissue ma", *parameters[:1], "not stable at rest")

    def test_in_one_region_of_the_mesh(self):
        path = pulmo.scratch("two.msh")
        with open(pulmo.mesh("cube_msh22_ascii.msh")) as f, open(path, "w") as g:
            text = f.read().replace('3\n2 1 "airway"', '4\n2 1 "airway"').replace('3 3 "body"', '3 3 "left"\n3 4 "right"')
            g.write(re.sub(r"(?m)^(4\d|36) 4 2 3 3 ", r"\1 4 2 4 4 ", text))  # the last cells
        scene = BASE + ["-dm_plex_filename", path, "-tissue", "ma"]
        for ranks in (1, 2):
            self.refused(scene + ["-tissue_a", "0.43,right=0.1"], "-tissue_a 0.43,right=0.1", " at (", ranks=ranks)
        # what no cell has does not matter
        pulmo.finished(scene + ["-tissue_a", "0.1,right=0.43,left=0.43", "-ts_max_time", "0.05"])


if __name__ == "__main__":
    pulmo.main()
