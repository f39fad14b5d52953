#!/usr/bin/python3
"""Random scenes of all that the program offers: a slice of what tools/hard_cases --fuzz runs.

Every run finishes, or stops with a reason; where it stops, another file of solvers agrees. A restart ends where the whole run does.
"""
import os
import sys
import unittest

import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from hardcases import wide_fuzz  # noqa: E402

SEEDS = 60


class Fuzz(unittest.TestCase):
    def test_every_effect_is_drawn(self):
        self.assertEqual(wide_fuzz.not_drawn(), [], "say in DRAWN of tools/hardcases/wide_fuzz.py how they come into a scene")

    def test_scenes(self):
        rows = wide_fuzz.run_range(pulmo.PROGRAM, 0, SEEDS, None, "", small=True)
        self.assertEqual([f"seed {row['seed']}: {row['fault']}" for row in rows if row["fault"]], [])
        self.assertEqual([f"seed {row['seed']}: {row['disagreement']}" for row in rows if row["disagreement"]], [])
        # scenes that are refused, or that have no equilibrium, test little else
        finished = sum(row["kinds"][0] == "finished" for row in rows)
        self.assertGreater(finished, 0.5 * SEEDS)
        self.assertGreater(SEEDS, finished, "some stop: the reasons are compared")
        self.assertGreater(sum("restart" in row for row in rows), 3)
        self.assertEqual(sum(row["kinds"][0] == "refused" for row in rows), 0)


if __name__ == "__main__":
    pulmo.main()
