#!/usr/bin/python3
"""What a scene does that says nothing: the gas presses on the airway wall, several airway patches have one pressure."""
import unittest

import numpy as np

import case_meshes
import pulmo_case as pulmo

PCV = pulmo.options_file("scenes/pcv.opts")
VCV = pulmo.options_file("scenes/vcv.opts")
SHORT = ["-ts_max_time", "0.1"] + pulmo.QUIET
BASE = pulmo.DIRECT + SHORT


def cube(opening):
    """A cube of 125 ml, 384 cells; `opening(x)`: whether a facet with its middle at x, in mm from the corner, is airway."""
    points, tets = case_meshes.kuhn([4] * 3, [50.0] * 3)
    facets = case_meshes.boundary(tets)
    middle = points[facets].mean(axis=1)
    return case_meshes.write(points, tets, facets, ["airway" if opening(x) else "pleura" for x in middle])


def bodies(**openings):
    """Boxes beside each other; of each the side of the cube (mm) and the part of one face that is open."""
    points, tets, facets, names, start = [], [], [], [], 0.0
    for name, (side, open_part) in openings.items():
        x, cells = case_meshes.kuhn([4] * 3, [side] * 3)
        x = x + [start, 0, 0]
        outside = case_meshes.boundary(cells)
        middle = x[outside].mean(axis=1)
        at_top = middle[:, 2] > side * (1 - 1e-9)
        names += ["airway" if top and m[0] - start < open_part * side else "pleura" for top, m in zip(at_top, middle)]
        first = sum(len(p) for p in points)
        points.append(x)
        tets.append(cells + first)
        facets.append(outside + first)
        start += side + 20
    return case_meshes.write(np.concatenate(points), np.concatenate(tets), np.concatenate(facets), names)


def columns(case):
    rows = case.signals()
    return {name: rows[name] for name in ("time_s", "airway_pressure_cmH2O", "volume_ml", "flow_ml_per_s", "min_J")}


class Default(unittest.TestCase):
    def expect_same(self, a, b):
        self.assertEqual(a.keys(), b.keys())
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)

    def expect_other(self, a, b):
        self.assertGreater(np.abs(a["volume_ml"] - b["volume_ml"]).max() + np.abs(a["min_J"] - b["min_J"]).max(),
                           1e-3 * np.abs(a["volume_ml"]).max())


class Wall(Default):
    def test_gas_presses_on_the_wall(self):
        """With and without airflow; `off` and paper.opts are the spring alone."""
        for scene in (PCV + pulmo.LITRE, PCV + pulmo.LITRE + pulmo.STILL):
            with self.subTest(" ".join(scene)):
                bare, asked, off, paper = (pulmo.finished(scene + more + BASE) for more in (
                    [], ["-lumen_pressure"], ["-lumen_pressure", "off"], pulmo.PAPER))
                self.expect_same(columns(bare), columns(asked))
                self.expect_same(columns(off), columns(paper))
                self.expect_other(columns(bare), columns(off))
                for case, on in ((bare, True), (off, False)):
                    summary = case.json()
                    self.assertEqual("lumen_pressure" in summary["effects"], on)
                    self.assertEqual(summary["options"]["-lumen_pressure"], "on" if on else "off")
                self.assertEqual(bare.json()["options"]["-lumen_pressure_surfaces"], "airway")
                self.assertNotIn("-lumen_pressure_surfaces", off.json()["options"])

    def test_the_wall_is_where_the_lung_is_open(self):
        """Under any name, also where air does not flow."""
        scene = PCV + pulmo.BLOCK + ["-chest_wall_surfaces", "x0,y0", "-airflow_surfaces", "x1"] + BASE
        for still in ([], pulmo.STILL):
            a, b = (pulmo.finished(scene + still + more) for more in ([], ["-lumen_pressure_surfaces", "x1"]))
            self.expect_same(columns(a), columns(b))
            self.assertIn("lumen_pressure", a.json()["effects"])

    def test_scenes_without_a_wall(self):
        """No ventilator, or no surface of that name: nothing to press on, and nothing is refused."""
        block = pulmo.BLOCK + ["-chest_wall", "-chest_wall_surfaces", "x0"] + BASE
        ventilated = pulmo.finished(block + ["-ventilator", "pcv"])
        self.assertIn("note: the mesh has no surface airway, so the gas presses on no airway wall", ventilated.out)
        alone = pulmo.finished(block + ["-traction", "-traction_surfaces", "x1", "-traction_value", "0.1,0,0"])
        for case in (ventilated, alone):
            self.assertNotIn("lumen_pressure", case.json()["effects"])
            self.assertEqual(case.json()["options"]["-lumen_pressure"], "off")

    def test_the_fragment_goes_with_every_scene(self):
        block = pulmo.BLOCK + ["-chest_wall", "-chest_wall_surfaces", "x0"] + BASE
        for scene in (block + ["-traction", "-traction_surfaces", "x1", "-traction_value", "0.1,0,0"],
                      PCV + pulmo.CUBE + BASE, PCV + pulmo.CUBE + pulmo.STILL + BASE):
            pulmo.finished(scene + pulmo.PAPER)

    def test_pins_bear_no_load(self):
        """Refused where the gas pushes the lung; a closed wall pushes it nowhere; whatever bears a load is enough."""
        pins = ["-chest_wall_stiffness", "0"] + pulmo.PINS
        case = pulmo.Case(PCV + pulmo.CUBE + pins + BASE)
        self.assertEqual(case.code, 1, case.tail())
        self.assertIn("there is no equilibrium", case.err)
        self.assertIn("-lumen_pressure off", case.err)
        # 10 x 10 mm^2 at 1 cmH2O
        self.assertIn("with 0.00981 N", case.err)
        pulmo.finished(PCV + pulmo.CUBE + pins + BASE + ["-lumen_pressure", "off"])
        pulmo.finished(PCV + pulmo.CUBE + pulmo.PINS + BASE)
        both_ends = cube(lambda x: abs(x[2] - 25) > 24.9)
        pulmo.finished(PCV + both_ends + pins + BASE + ["-ts_max_time", "0.05"])
        pulmo.finished(PCV + both_ends + pins + BASE + ["-ts_max_time", "0.05"], ranks=2)


class Split(Default):
    FLOW = VCV + ["-ventilator_tidal_volume", "20"]

    def patches(self, mesh, **arguments):
        return pulmo.finished(self.FLOW + mesh + BASE, **arguments).json()["options"]["-ventilator_flow_split"]

    def test_one_patch_or_more(self):
        """Patches are joined by edges, over all names and ranks."""
        top = lambda x: x[2] > 49.9
        for name, opening, chosen in (
                ("a face", top, "uniform"), ("two strips of it", lambda x: top(x) and abs(x[0] - 25) > 12.5, "common_pressure"),
                ("two faces with an edge in common", lambda x: top(x) or x[0] > 49.9, "uniform"),
                ("two opposite faces", lambda x: abs(x[2] - 25) > 24.9, "common_pressure")):
            mesh = cube(opening)
            for ranks in (1, 2, 3):
                with self.subTest(name, ranks=ranks):
                    self.assertEqual(self.patches(mesh, ranks=ranks), chosen)

    def test_numbers_are_those_of_the_chosen_split(self):
        one, two = cube(lambda x: x[2] > 49.9), cube(lambda x: abs(x[2] - 25) > 24.9)
        for mesh, chosen, other in ((one, pulmo.UNIFORM, pulmo.COMMON), (two, pulmo.COMMON, pulmo.UNIFORM)):
            bare, same, different = (pulmo.finished(self.FLOW + mesh + BASE + more) for more in ([], chosen, other))
            self.expect_same(columns(bare), columns(same))
            self.assertGreater(np.abs(columns(bare)["airway_pressure_cmH2O"] - columns(different)["airway_pressure_cmH2O"]).max(), 1e-6)

    def test_surfaces_with_two_names_are_one_airway(self):
        scene = self.FLOW + pulmo.BLOCK + ["-chest_wall_surfaces", "x0,y0"] + BASE
        for names, chosen in (("x1,z1", "uniform"), ("z0,z1", "common_pressure")):
            options = pulmo.finished(scene + ["-airflow_surfaces", names]).json()["options"]
            self.assertEqual(options["-ventilator_flow_split"], chosen, names)
            self.assertEqual(options["-lumen_pressure_surfaces"], names)

    def test_a_windpipe_shares_by_volume(self):
        """A lung of 125 ml with a small opening, one of 64 ml with a wide one: with one pressure both stretch much alike, by
        area the small one gets most; asked for, that is told."""
        pair = bodies(large=(50.0, 0.25), small=(40.0, 1.0))
        scene = VCV + pair + pulmo.DIRECT + pulmo.QUIET + [
            "-chest_wall_surfaces", "pleura", "-chest_wall_stiffness", "1e-3", "-ventilator_tidal_volume", "40",
            "-ventilator_inspiration", "1", "-ventilator_pause", "0.5", "-ts_max_time", "1.5", "-ts_dt", "0.1"]
        V = np.array([125.0, 64.0])

        def share(case):
            lungs = [r for r in case.json()["regions"].values() if r["connected_body"]]
            np.testing.assert_allclose([r["reference_volume_ml"] for r in lungs], V, rtol=1e-9)
            return lungs[0]["ventilation_share"]

        windpipe = pulmo.finished(scene)
        self.assertNotIn("warning", windpipe.out)
        self.assertAlmostEqual(share(windpipe), V[0] / V.sum(), delta=0.1)
        area = np.array([0.25 * 50**2, 40.0**2])
        for ranks in (1, 2):
            uniform = pulmo.finished(scene + pulmo.UNIFORM, ranks=ranks)
            self.assertAlmostEqual(share(uniform), area[0] / area.sum(), delta=0.02)
            self.assertEqual(uniform.out.count("warning: -ventilator_flow_split uniform shares the flow by area"), 1, uniform.out)
            for text in (f"has {100 * a:.3g} % of the airway's area and {100 * v:.3g} % of the volume"
                         for a, v in zip(area / area.sum(), V / V.sum())):
                self.assertIn(text, uniform.out)

    def test_like_shares_are_not_told(self):
        pair = bodies(one=(50.0, 1.0), other=(48.0, 1.0))
        case = pulmo.finished(self.FLOW + pair + BASE + pulmo.UNIFORM)
        self.assertNotIn("shares the flow by area", case.out)

    def test_help_says_what_was_chosen(self):
        # PETSc's own part has bytes that were never set, as the default of -dm_plex_boundary_label (3.18)
        case = pulmo.Case(self.FLOW + cube(lambda x: abs(x[2] - 25) > 24.9) + BASE + ["-help"], errors="replace")
        self.assertIn("in this scene -ventilator_flow_split is common_pressure", case.out)


if __name__ == "__main__":
    pulmo.main()
