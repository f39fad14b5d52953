#!/usr/bin/python3
"""Parameters that differ from place to place, as a user gives them: by name, from a dataset, over a restart; the scenes that do."""
import unittest

import h5py
import meshio
import numpy as np

import case_meshes
import pulmo_case as pulmo

LENGTHS = (100.0, 50.0, 50.0)
BREATH = pulmo.TIGHT + pulmo.QUIET + ["-tissue", "yoshihara", "-airflow", "-airflow_permeability", "1e3", "-airflow_surfaces", "x1",
                                      "-chest_wall", "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-ventilator", "pcv",
                                      "-ventilator_inspiration", "0.2", "-ventilator_expiration", "0.2", "-ts_dt", "0.05"]
PAIR = ["-dm_plex_filename", pulmo.mesh("lung_pair.msh")]
SIGNALS = ("volume_ml", "flow_ml_per_s", "airway_pressure_cmH2O")


def halves(order=None, counts=(4, 2, 2)):
    """Options of a box whose volumes are left and right of its middle, and the centroids of its tetrahedra as meshio has them; order: of
    the tetrahedra in the file."""
    points, tets = case_meshes.kuhn(counts, LENGTHS)
    facets = case_meshes.boundary(tets)
    names = case_meshes.faces_of_box(points, facets, LENGTHS)
    if order is not None:
        tets = tets[order]
    right = points[tets].mean(axis=1)[:, 0] > 50
    tags = [1 + case_meshes.FACES.index(n) for n in names]
    options = case_meshes.save(points, [("triangle", facets, tags), ("tetra", tets, np.where(right, 8, 7))],
                               {n: (i + 1, 2) for i, n in enumerate(case_meshes.FACES)} | {"left": (7, 3), "right": (8, 3)})
    read = meshio.read(options[1])
    return options, read.points[read.cells_dict["tetra"]].mean(axis=1)


def dataset(values, name="c"):
    path = pulmo.scratch("values.h5")
    with h5py.File(path, "w") as f:
        f[name] = values
    return f"{path}:{name}"


def cell_values(case, name):
    """Centroids of the cells of a run's last snapshot, and a field of them."""
    x, cells, values = pulmo.fields(case)
    return x.reshape(-1, 3)[cells[:, :4]].mean(axis=1), values[name].ravel()


class RegionCase(unittest.TestCase):
    def same(self, a, b, tolerance):
        a, b = a.signals(), b.signals()
        for column in SIGNALS:
            self.assertLess(np.abs(a[column] - b[column]).max(), tolerance * np.abs(a[column]).max(), column)


class Names(RegionCase):
    STIFF = ["-tissue_c", "1.298,right=6", "-airflow_permeability", "1e3,left=2e2", "-chest_wall_stiffness", "0.08,x0=0.3,right=0.05"]

    def test_any_ranks(self):
        mesh, _ = halves()
        one = pulmo.finished(BREATH + mesh + self.STIFF)
        plain = pulmo.finished(BREATH + mesh)
        self.assertGreater(np.abs(one.signals()["volume_ml"] - plain.signals()["volume_ml"]).max(), 0.2 * plain.signals()["volume_ml"].max())
        for ranks in (2, 3):
            self.same(one, pulmo.finished(BREATH + mesh + self.STIFF, ranks=ranks), 1e-9)
        self.same(one, pulmo.finished(BREATH + mesh + self.STIFF + ["-petscfe_type", "basic"]), 1e-9)

    def test_the_softer_part_takes_more(self):
        """A column on rollers at a small pressure: the stress is the same, tissue of three times c has a third of the strain."""
        mesh, _ = halves()
        rollers = ["-support", "-support_surfaces", "x0,y0,y1,z0,z1"]
        for face in ("x0", "y0", "y1", "z0", "z1"):
            rollers += ["-support_components_" + face, face[0]]
        case = pulmo.finished(BREATH + mesh + rollers + ["-tissue_c", "1.298,right=3.894", "-chest_wall", "off", "-lumen_pressure", "off",
                                                         "-airflow", "off", "-ventilator_pip", "1e-3", "-ts_max_time", "0.2"])
        x, J = cell_values(case, "J_mean")
        left, right = (np.mean(J[side]) - 1 for side in (x[:, 0] < 50, x[:, 0] > 50))
        self.assertAlmostEqual(left / right, 3, delta=3e-4)
        # p / W'', W'' = 4 c (1 + beta)
        self.assertAlmostEqual(left / (1e-3 * pulmo.KPA_PER_CMH2O / (4 * 1.298 * 1.75)), 1, delta=1e-4)
        self.assertLessEqual({"left", "right"}, set(case.json()["regions"]))

    def test_restart(self):
        mesh, x = halves()
        start = pulmo.finished(BREATH + mesh + self.STIFF + ["-checkpoint_every", "0.2"])
        kept = ["-restart", start.path("checkpoint_previous.h5")]
        self.same(start, pulmo.finished(BREATH + mesh + self.STIFF + kept), 1e-9)
        for other in (["-tissue_c", "1.298,right=7"], ["-tissue_c", "1.298,left=6"], ["-tissue_c", "1.298"],
                      ["-chest_wall_stiffness", "0.08,x0=0.3"]):
            case = pulmo.Case(BREATH + mesh + self.STIFF + other + kept)
            self.assertEqual(case.code, 1, case.tail())
            for word in ("checkpoint of another scene", other[0], "'" + other[1] + "'"):
                self.assertIn(word, case.err)


class Datasets(RegionCase):
    @staticmethod
    def stiffness(x):
        return 1 + x[:, 0] / 20 + 0.01 * x[:, 1]

    def test_any_ranks_and_any_order_of_the_file(self):
        mesh, x = halves()
        one = pulmo.finished(BREATH + mesh + ["-tissue_c", dataset(self.stiffness(x))])
        wrong = pulmo.finished(BREATH + mesh + ["-tissue_c", dataset(self.stiffness(x)[::-1])])
        self.assertGreater(np.abs(one.signals()["volume_ml"] - wrong.signals()["volume_ml"]).max(), 0.01 * one.signals()["volume_ml"].max())
        for ranks in (2, 3):
            self.same(one, pulmo.finished(BREATH + mesh + ["-tissue_c", dataset(self.stiffness(x), "a/b")], ranks=ranks), 1e-9)
        shuffled, x = halves(np.random.default_rng(2).permutation(len(x)))
        self.same(one, pulmo.finished(BREATH + shuffled + ["-tissue_c", dataset(self.stiffness(x))]), 1e-12)

    def test_numbers_of_another_kind(self):
        mesh, x = halves()
        whole = np.where(x[:, 0] > 50, 6, 2)
        self.same(pulmo.finished(BREATH + mesh + ["-tissue_c", "4,left=2,right=6"]),
                  pulmo.finished(BREATH + mesh + ["-tissue_c", dataset(whole.astype("i2"))]), 1e-14)

    def test_restart(self):
        mesh, x = halves()
        values = self.stiffness(x)
        first = ["-tissue_c", dataset(values)]
        start = pulmo.finished(BREATH + mesh + first + ["-checkpoint_every", "0.2"])
        kept = ["-restart", start.path("checkpoint_previous.h5")]
        # the same values in another file, on other ranks, for a file of another order
        self.same(start, pulmo.finished(BREATH + mesh + ["-tissue_c", dataset(values, "elsewhere")] + kept, ranks=2), 1e-9)
        shuffled, y = halves(np.random.default_rng(3).permutation(len(x)))
        self.same(start, pulmo.finished(BREATH + shuffled + ["-tissue_c", dataset(self.stiffness(y))] + kept), 1e-9)
        # the file holds other values meanwhile
        path, name = first[1].split(":")
        with h5py.File(path, "r+") as f:
            f[name][5] *= 1 + 1e-12
        for other in (first, ["-tissue_c", "2"]):
            case = pulmo.Case(BREATH + mesh + other + kept)
            self.assertEqual(case.code, 1, case.tail())
            for word in ("checkpoint of another scene", "-tissue_c is 'a dataset, hash "):
                self.assertIn(word, case.err)

    def test_refined(self):
        """Pieces of a cell inherit its value: two values that names give as well."""
        mesh, x = halves()
        named, listed = (pulmo.finished(BREATH + mesh + ["-dm_refine", "1", "-ts_max_time", "0.1", "-tissue_c", c])
                         for c in ("4,left=2,right=6", dataset(np.where(x[:, 0] > 50, 6., 2.))))
        self.same(named, listed, 1e-12)


class Krylov(RegionCase):
    def test_counts_stay_low(self):
        """Jumps of 1000 between parts, and of the permeability between cells (docs/regions.md)."""
        mesh, x = halves(counts=(8, 4, 4))
        some = np.random.default_rng(0).random(len(x)) < 0.3
        tight = ["-ksp_rtol", "1e-5", "-snes_lag_jacobian", "1", "-snes_lag_preconditioner", "1"]
        for options, more in ((["-tissue_c", "1.298,left=1298"], tight), (["-tissue_c", "1.298,right=1298"], tight),
                              (["-tissue_c", "1.298,left=1298", "-airflow_permeability", "1e3,left=1"], tight),
                              (["-airflow_permeability", "1e3,right=1"], tight),
                              (["-airflow_permeability", dataset(np.where(some, 1, 1e3))], tight),
                              (["-tissue_c", dataset(np.where(some, 1298, 1.298))], [])):
            with self.subTest(" ".join(options)):
                case = pulmo.finished(pulmo.options_file("solvers/iterative.opts") + BREATH[len(pulmo.TIGHT):] + mesh + options + more)
                numbers = case.json()
                self.assertLessEqual(numbers["krylov_iterations"], 20 * numbers["newton_iterations"])
                self.assertEqual(numbers["rejected_steps"], 0)


class Scenes(RegionCase):
    SHORT = pulmo.options_file("solvers/iterative.opts") + pulmo.QUIET + ["-ts_dt", "0.1", "-ts_max_time", "0.5", "-ventilator_settle", "off"]

    def breathes(self, scene, *more, ranks=1):
        case = pulmo.finished(pulmo.options_file(f"scenes/{scene}.opts") + PAIR + self.SHORT +
                              list(more), ranks=ranks, timeout=900)
        numbers = case.json()
        self.assertLessEqual(numbers["krylov_iterations"], 20 * numbers["newton_iterations"])
        return case, numbers

    def test_one_stiff_lung(self):
        case, _ = self.breathes("one_stiff_lung")
        x, J = cell_values(case, "J_mean")
        right, left = (np.mean(J[side]) - 1 for side in (x[:, 0] > 0, x[:, 0] < 0))
        self.assertGreater(right, 1.5 * left, "the soft lung takes more")
        self.assertGreater(left, 0)

    def test_ards(self):
        case, _ = self.breathes("ards")
        x, J = cell_values(case, "J_mean")
        behind = x[:, 1] < np.quantile(x[:, 1], 0.3)
        self.assertGreater(np.mean(J[~behind]) - 1, 1.5 * (np.mean(J[behind]) - 1))


if __name__ == "__main__":
    pulmo.main()
