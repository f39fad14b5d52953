#!/usr/bin/python3
"""A mesh that -mesh_save wrote and ranks read together is the mesh of its file, whatever it names; what cannot be is refused."""
import itertools
import os
import re
import shutil
import unittest

import h5py
import numpy as np

import pulmo_case as pulmo
from mesh_test import TAGS, Parts

SHORT = pulmo.TIGHT + pulmo.PCV + ["-ts_max_time", "0.1"]
# what Newton did may differ by an iteration at the rounding floor
COMPARED = ["time_s", "airway_pressure_cmH2O", "flow_ml_per_s", "volume_ml", "dt_s", "min_J", "max_J"]


def saved(path, *words, ranks=1):
    """The file of -mesh_save, and what was said."""
    file = pulmo.scratch("saved.h5")
    case = pulmo.finished(["-dm_plex_filename", path, "-mesh_save", file, *words], ranks=ranks)
    return file, case.out


def content_of(path):
    with open(path, "rb") as f:
        return f.read()


def notes(text):
    return re.findall(r"pulmo: note: (.*mesh.*|.*facets.*)", text)


class Same(unittest.TestCase):
    def expect_same(self, plain, other, tolerance=1e-9):
        a, b = plain.signals(), other.signals()
        self.assertEqual(a["phase"], b["phase"])
        for column in COMPARED:
            scale = np.abs(a[column]).max()
            self.assertGreater(scale, 0, f"{column} is all zero: nothing was compared")
            self.assertLess(np.abs(a[column] - b[column]).max() / scale, tolerance, column)
        a, b = plain.json(), other.json()
        for key in "cells", "dofs":
            self.assertEqual(a[key], b[key])
        self.expect_numbers(a["surface_areas_mm2"], b["surface_areas_mm2"])
        volumes = [{name: region["reference_volume_ml"] for name, region in s["regions"].items()} for s in (a, b)]
        self.expect_numbers(*volumes)
        self.expect_numbers({"": a["reference_volume_ml"]}, {"": b["reference_volume_ml"]})

    def expect_numbers(self, a, b):
        self.assertEqual(list(a), list(b), "names")
        for name in a:
            self.assertLess(abs(a[name] / b[name] - 1), 1e-12, name)

    def test_lungs_on_ranks(self):
        for mesh, ranks in (("lung_test.msh", (1, 2, 3)), ("lung_pair.msh", (2,))):
            plain = pulmo.finished(SHORT + ["-dm_plex_filename", pulmo.mesh(mesh)])
            self.assertGreater(plain.signals()["volume_ml"].max(), 0.01 * plain.json()["reference_volume_ml"], "the lung hardly moved")
            file, _ = saved(pulmo.mesh(mesh))
            for n in ranks:
                with self.subTest(mesh, ranks=n):
                    other = pulmo.finished(SHORT + ["-dm_plex_filename", file], ranks=n)
                    self.assertEqual(other.json()["ranks"], n)
                    self.assertNotIn("was not used", other.out)
                    self.expect_same(plain, other)

    def odd(self):
        """A cube of half left-handed cells, in another unit, with a wall within it that has a name, volumes that overlap, facets
        and cells without a name, facets of two names, a node that no cell uses, and a name of more than ASCII."""
        parts = Parts()
        parts.permute(np.random.default_rng(3))
        middle = parts.points[parts.cells].mean(axis=1)[:, 0]
        parts.cell_names = [[n for n, has in (("left", x < 5), ("c\u00f6re", 3 < x < 7)) if has] for x in middle]
        for names in parts.facet_names[:40]:
            if names == ["pleura"]:
                names.append("patch")
        faces = np.sort(parts.cells[:, list(itertools.combinations(range(4), 3))], axis=2)
        shared = {tuple(f) for f in faces[middle < 5].reshape(-1, 3)} & {tuple(f) for f in faces[middle >= 5].reshape(-1, 3)}
        parts.facets = np.concatenate([parts.facets, np.array(sorted(shared))])
        parts.facet_names += [["wall"]] * len(shared)
        parts.points = np.concatenate([parts.points, [[50, 50, 50]]]) / 10
        path = parts.write(TAGS | {(2, "wall"): 7, (2, "patch"): 8, (3, "left"): 4, (3, "c\u00f6re"): 9})
        return path, sum(max(1, len(names)) for names in parts.cell_names)  # tetrahedra of the file: one for each group

    def test_all_that_a_file_says(self):
        """With a parameter for each cell, refined, on other ranks."""
        path, n = self.odd()
        values = pulmo.scratch("values.h5")
        with h5py.File(values, "w") as f:
            f["c"] = np.random.default_rng(4).uniform(0.2, 2, n)
        settled = ["-mesh_scale", "100", "-mesh_prefer", "patch"]
        words = SHORT + ["-tissue", "yoshihara", "-tissue_c", f"{values}:c", "-chest_wall_surfaces", "pleura,patch,airway", "-ts_max_time", "0.05"]
        file, said = saved(path, *settled, ranks=2)
        plain = pulmo.finished(words + settled + ["-dm_plex_filename", path])
        self.assertEqual(len(notes(plain.out)), 3, plain.out)  # hands, two volumes, two surfaces
        self.assertEqual(notes(said), notes(plain.out))
        for ranks, refined in (3, []), (2, ["-dm_refine", "1"]), (2, ["-dm_refine_pre", "1"]):
            with self.subTest(ranks=ranks, refined=refined):
                reference = pulmo.finished(words + settled + ["-dm_plex_filename", path] + refined) if refined else plain
                # the options that settled the mesh may be given again
                other = pulmo.finished(words + (settled if refined else []) + ["-dm_plex_filename", file] + refined, ranks=ranks)
                self.assertEqual(notes(other.out), notes(plain.out))
                self.expect_same(reference, other)
        case = pulmo.Case(words + ["-dm_plex_filename", file, "-chest_wall_surfaces", "wall"], ranks=2)
        self.assertEqual(case.code, 1)
        self.assertIn("facets of 'wall', which -chest_wall_surfaces asks for, lie inside the volume", case.err)

    def test_restart_across(self):
        file, _ = saved(pulmo.mesh("cube_lung.msh"), "-mesh_scale", "10")
        words = pulmo.TIGHT + pulmo.PCV
        plain = pulmo.finished(words + pulmo.LITRE + ["-ts_max_time", "0.2"])
        first = pulmo.finished(words + ["-dm_plex_filename", file, "-ts_max_time", "0.1", "-checkpoint_every", "0.1"], ranks=3)
        second = pulmo.finished(words + pulmo.LITRE + ["-ts_max_time", "0.15", "-checkpoint_every", "0.05", "-restart", first.path("checkpoint.h5")])
        third = pulmo.finished(words + ["-dm_plex_filename", file, "-ts_max_time", "0.2", "-restart", second.path("checkpoint.h5")], ranks=2)
        a, b = plain.signals(), third.signals()
        self.assertLess(abs(a["volume_ml"][-1] / b["volume_ml"][-1] - 1), 1e-9)
        other, _ = saved(pulmo.mesh("cube_lung.msh"), "-mesh_scale", "11")
        case = pulmo.Case(words + ["-dm_plex_filename", other, "-restart", first.path("checkpoint.h5")])
        self.assertEqual(case.code, 1)
        self.assertIn("is a checkpoint of another mesh", case.err)

    def test_a_few_cells_on_many_ranks(self):
        file, _ = saved(pulmo.mesh("cube_msh41_binary.msh"), "-mesh_scale", "100")
        words = SHORT + ["-chest_wall_stiffness", "1", "-dm_plex_filename"]
        self.expect_same(pulmo.finished(words + [pulmo.mesh("cube_msh41_binary.msh"), "-mesh_scale", "100"]),
                         pulmo.finished(words + [file], ranks=7))


class Refused(unittest.TestCase):
    def refused(self, options, *said, ranks=1):
        case = pulmo.Case(options, ranks=ranks)
        self.assertEqual(case.code, 1, case.tail())
        errors = [line for line in case.err.splitlines() if line.startswith("pulmo: error: ")]
        self.assertEqual(len(errors), 1, case.err)
        for words in said:
            self.assertIn(words, errors[0])
        self.assertNotIn("HDF5-DIAG", case.err)
        self.assertNotIn("PETSC ERROR", case.err)
        return case

    @classmethod
    def setUpClass(cls):
        cls.file, _ = saved(pulmo.mesh("cube_lung.msh"))

    def test_what_cannot_be_saved(self):
        mesh = ["-dm_plex_filename", pulmo.mesh("cube_lung.msh")]
        before = content_of(self.file)
        self.refused(mesh + ["-mesh_save", self.file], "there is such a file", "-output_overwrite", ranks=2)
        self.assertEqual(content_of(self.file), before)
        again = pulmo.scratch("again.h5")
        with open(again, "w") as f:
            f.write("something else")
        pulmo.finished(mesh + ["-mesh_save", again, "-output_overwrite"])
        with h5py.File(self.file) as a, h5py.File(again) as b:
            for name in a:
                self.assertTrue(np.array_equal(a[name], b[name]), name)
        new = pulmo.scratch("new.h5")
        for words, said in (["-mesh_save", pulmo.scratch("new.msh")], "ends in .h5"), (["-mesh_save", "/no/such/new.h5"], "there is no folder"), \
                (["-mesh_save", new, "-dm_refine", "1"], "give -dm_refine when it is read"), (["-mesh_save", new, "-restart", "x.h5"], "leave it or -restart out"), \
                (["-mesh_save", new, "-mesh_prefer", "x"], "has no surface 'x'"), (["-mesh_save", new, "-mesh_sacle", "2"], "-mesh_scale"):
            with self.subTest(said):
                self.refused(mesh + words, said)
        self.refused(["-dm_plex_filename", self.file, "-mesh_save", new], "copy it")
        self.assertFalse(os.path.exists(new))
        self.refused(["-dm_plex_filename", pulmo.scratch("none.msh"), "-mesh_save", new], "there is no such file")

    def test_options_that_a_saved_mesh_settles(self):
        for words, said in ((["-mesh_scale", "10"], "was saved with 1, which it keeps"), (["-mesh_prefer", "pleura"], "every facet has one name"),
                            (["-dm_plex_reorder", "rcm"], "in a good order already"),
                            (["-petscpartitioner_type", "ptscotch"], "METIS then makes the parts")):
            with self.subTest(said):
                self.refused(SHORT + ["-dm_plex_filename", self.file] + words, said, ranks=2)
        # the cube holds 1 ml: in metres it is none
        small, _ = saved(pulmo.mesh("cube_lung.msh"), "-mesh_scale", "1e-3")
        pulmo.finished(SHORT + ["-dm_plex_filename", small, "-scene_view_only"])
        parts = Parts()
        parts.points = parts.points / 1e4
        self.refused(SHORT + ["-dm_plex_filename", saved(parts.write(TAGS))[0]], "save it anew with -mesh_scale 1000")

    def test_another_mesh_file_is_asked_for(self):
        self.refused(SHORT + pulmo.LITRE + ["-cavity", "-cavity_file", self.file], "only -dm_plex_filename takes it")

    def changed(self, change):
        path = pulmo.scratch("changed.h5")
        shutil.copy(self.file, path)
        with h5py.File(path, "r+") as f:
            change(f)
        return path

    def test_damaged_files(self):
        about = bytes(h5py.File(self.file)["about"][:])

        def say(old, new):
            def change(f):
                self.assertIn(old, about)
                del f["about"]
                f["about"] = np.frombuffer(about.replace(old, new), np.uint8)
            return change

        def put(name, at, value):
            return lambda f: f[name].__setitem__(at, value)

        cases = {
            "another version": (lambda f: f.attrs.modify("pulmo_mesh", 99), "format 99, and this pulmo reads format 1"),
            "a name less": (say(b'"name"', b'"mane"'), "says of the mesh is not what was written"),
            "no parts": (say(b'"parts"', b'"marts"'), "says of the mesh is not what was written"),
            "a cell": (put("cells", (5, 1), 3), "its cells are not those that were written"),
            "a node": (put("nodes", (2, 1), 0.5), "its nodes are not those that were written"),
            "the last node": (put("nodes", (-1, 2), 0.5), "its nodes are not those that were written"),
            "a facet": (put("facets", (slice(None), 0), -1), "its facets are not those that were written"),
            "a volume": (put("volumes", 7, 5), "its volumes are not those that were written"),
            "a place": (put("places", 7, 5), "its places are not those that were written"),
            "no nodes": (lambda f: f.__delitem__("nodes"), "its nodes cannot be read"),
            "no cells": (lambda f: f.__delitem__("cells"), "its cells cannot be read"),
            "not what is said": (lambda f: f.__delitem__("about"), "what it says of the mesh is gone"),
            "an area": (say(b'"measure": 500.', b'"measure": 501.'), "is not what was written"),
            "no mark": (lambda f: f.attrs.__delitem__("pulmo_mesh"), "is not a readable mesh"),
        }
        for what, (change, said) in cases.items():
            with self.subTest(what):
                self.refused(SHORT + ["-dm_plex_filename", self.changed(change)], said, ranks=2 if "node" in what else 1)

    def test_no_mesh_of_ours(self):
        whole = content_of(self.file)
        for share in 0.02, 0.5, 0.999:
            path = pulmo.scratch("cut.h5")
            with open(path, "wb") as f:
                f.write(whole[:int(share * len(whole))])
            self.refused(SHORT + ["-dm_plex_filename", path], "is not a readable mesh", ranks=2 if share == 0.5 else 1)
        self.refused(SHORT + ["-dm_plex_filename", pulmo.mesh("lung_pair_ards.h5")], "is not a readable mesh")


if __name__ == "__main__":
    pulmo.main()
