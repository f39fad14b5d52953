#!/usr/bin/python3
"""A mesh is its cells and its names: however a file writes them, the signals are the same to the last digit."""
import contextlib
import io
import itertools
import os
import re
import sys
import unittest

import gmsh
import h5py
import meshio
import numpy as np

import case_meshes
import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from meshing import lung_command  # noqa: E402

SCENE = pulmo.DIRECT + pulmo.PCV + ["-ventilator_pip", "3"]
FLAVOURS = [(2.2, False), (2.2, True), (4.1, False), (4.1, True)]


class Parts:
    """Cells and named facets of a mesh, to be numbered and grouped anew and written as MSH 2.2 or 4.1 in letters."""

    def __init__(self, name="cube_lung.msh"):
        m = meshio.read(pulmo.mesh(name))
        self.points = m.points
        self.cells, self.facets = m.cells_dict["tetra"].copy(), m.cells_dict["triangle"].copy()
        tags = m.cell_data_dict["gmsh:physical"]
        name_of = {(dim, tag): text for text, (tag, dim) in m.field_data.items()}
        # of each element: the names of its groups
        self.cell_names = [[name_of[3, t]] for t in tags["tetra"]]
        self.facet_names = [[name_of[2, t]] for t in tags["triangle"]]

    def permute(self, random):
        order = random.permutation(len(self.points))
        number = np.empty_like(order)
        number[order] = np.arange(len(order))
        self.points = self.points[order]
        for kind in "cells", "facets":
            mix = random.permutation(len(getattr(self, kind)))
            setattr(self, kind, number[getattr(self, kind)[mix]])
            names = getattr(self, kind[:-1] + "_names")
            setattr(self, kind[:-1] + "_names", [names[i] for i in mix])
        for row in self.facets:
            random.shuffle(row)
        for row in self.cells:  # even and odd: half of the cells become left-handed
            random.shuffle(row)

    def write(self, tag_of, entity=lambda dim, tag: tag, names=None):
        """MSH 2.2. tag_of: (dim, name) -> physical tag; an element of several groups is written for each."""
        rows = []
        for dim, kind, elements, groups in ((2, 2, self.facets, self.facet_names), (3, 4, self.cells, self.cell_names)):
            for element, its in zip(elements, groups):
                for tag in [tag_of[dim, g] for g in its] or [0]:
                    rows.append(f"{kind} 2 {tag} {entity(dim, tag)} " + " ".join(str(n + 1) for n in element))
        named = {(dim, abs(tag)): text for (dim, text), tag in tag_of.items()} if names is None else names
        path = pulmo.scratch("mesh.msh")
        with open(path, "w") as f:
            f.write(f"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n{len(named)}\n")
            f.writelines(f'{dim} {tag} "{text}"\n' for (dim, tag), text in named.items())
            f.write(f"$EndPhysicalNames\n$Nodes\n{len(self.points)}\n")
            f.writelines(f"{i} {x:.17g} {y:.17g} {z:.17g}\n" for i, (x, y, z) in enumerate(self.points, 1))
            f.write(f"$EndNodes\n$Elements\n{len(rows)}\n")
            f.writelines(f"{i} {row}\n" for i, row in enumerate(rows, 1))
            f.write("$EndElements\n")
        return path


TAGS = {(2, "airway"): 1, (2, "pleura"): 2, (3, "lung"): 3}


def in_gmsh(name, change, version, binary):
    """The mesh `name` as gmsh writes it after change()."""
    path = pulmo.scratch("mesh.msh")
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(pulmo.mesh(name))
        change()
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.write(path)
    finally:
        gmsh.finalize()
    return path


def partition(topology):
    gmsh.option.setNumber("Mesh.PartitionCreateTopology", topology)
    gmsh.option.setNumber("Mesh.PartitionCreatePhysicals", topology)
    gmsh.option.setNumber("Mesh.PartitionCreateGhostCells", 1)
    gmsh.model.mesh.partition(2)


def group_again(tag_of, sign):
    """The same groups with other tags; sign -1: their entities have the other orientation, which makes tags negative."""
    groups = [(dim, tag, gmsh.model.getPhysicalName(dim, tag), gmsh.model.getEntitiesForPhysicalGroup(dim, tag))
              for dim, tag in gmsh.model.getPhysicalGroups()]
    gmsh.model.removePhysicalGroups()
    for dim, tag, name, entities in groups:
        gmsh.model.removePhysicalName(name)
    for dim, tag, name, entities in groups:
        gmsh.model.addPhysicalGroup(dim, [sign * e for e in entities], tag_of(tag))
        gmsh.model.setPhysicalName(dim, tag_of(tag), name)


def short_run(path, more=()):
    return pulmo.finished(SCENE + ["-dm_plex_filename", path, "-ts_max_time", "0.15"] + list(more))


def content(case):
    with open(case.path("signals.csv"), "rb") as f:
        return f.read()


class TheSameMesh(unittest.TestCase):
    def expect_same(self, path, reference, what, more=()):
        with self.subTest(what):
            case = short_run(path, more)
            self.assertEqual(content(case), content(reference))
            self.assertEqual(case.json()["surface_areas_mm2"], reference.json()["surface_areas_mm2"])
            return case

    def check_flavours(self, name):
        plain = short_run(pulmo.mesh(name))
        changes = {"plain": lambda: None, "partitioned": lambda: partition(0), "with the partitions' borders": lambda: partition(1),
                   "reversed": lambda: group_again(lambda tag: tag, -1),
                   # groups have the numbers of one another's entities
                   "renumbered groups": lambda: group_again(lambda tag: tag % 3 + 1, 1)}
        for version, binary in FLAVOURS if name == "cube_lung.msh" else FLAVOURS[:1] + FLAVOURS[-1:]:
            for what, change in changes.items():
                self.expect_same(in_gmsh(name, change, version, binary), plain, (name, version, binary, what))
        mesh = meshio.read(pulmo.mesh(name))
        for binary in False, True:
            path = pulmo.scratch("mesh.msh")
            meshio.write(path, mesh, file_format="gmsh22", binary=binary)
            self.expect_same(path, plain, (name, "meshio", binary))

    def test_the_cube(self):
        self.check_flavours("cube_lung.msh")

    def test_a_lung(self):
        self.check_flavours("lung_test.msh")

    def test_numbers_order_and_handedness(self):
        plain = short_run(pulmo.mesh("cube_lung.msh"))
        for seed in range(2):
            parts = Parts()
            parts.permute(np.random.default_rng(seed))
            case = self.expect_same(parts.write(TAGS, entity=lambda dim, tag: tag % 3 + 1), plain, seed)
            note = re.search(r"pulmo: note: (\d+) of 100 cells of the mesh are left-handed .*turned", case.out)
            self.assertTrue(note, case.out)
            self.assertTrue(30 < int(note.group(1)) < 70)

    def test_groups(self):
        """One lung in two groups, an airway in two groups of one name, tags with the sign of an orientation."""
        plain = short_run(pulmo.mesh("cube_lung.msh"))
        parts = Parts()
        parts.cell_names = [["left"] if parts.points[c].mean(axis=0)[0] < 5 else ["right"] for c in parts.cells]
        tags = TAGS | {(3, "left"): 7, (3, "right"): -9}
        case = self.expect_same(parts.write(tags), plain, "two volumes")
        regions = {name: r["reference_volume_ml"] for name, r in case.json()["regions"].items()}
        x = parts.points[parts.cells]
        volumes = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / 6e3
        left = np.array([names == ["left"] for names in parts.cell_names])
        self.assertAlmostEqual(regions["left"], volumes[left].sum(), places=12)
        self.assertAlmostEqual(regions["right"], volumes[~left].sum(), places=12)

        parts = Parts()
        parts.facet_names[0] = ["second"]
        name = parts.facet_names[1][0]
        tags = TAGS | {(2, "second"): 11}
        path = parts.write(tags, names={(2, 1): "airway", (2, 2): "pleura", (3, 3): "lung", (2, 11): name})
        self.assertEqual(name, "airway")
        self.expect_same(path, plain, "two groups of one name")
        self.expect_same(Parts().write({key: -tag for key, tag in TAGS.items()}), plain, "negative tags")

    def test_a_group_without_a_name_is_its_number(self):
        path = Parts().write(TAGS, names={(2, 2): "pleura"})
        case = short_run(path, ["-airflow_surfaces", "1", "-chest_wall_surfaces", "1,pleura"])
        self.assertEqual(set(case.json()["surface_areas_mm2"]), {"1", "pleura"})

    def test_names_of_digits_are_told(self):
        path = Parts().write(TAGS, names={(2, 1): "airway", (2, 2): "pleura", (3, 3): "5"})
        case = short_run(path)
        self.assertIn("pulmo: note: volume group 3 of the mesh has the name '5', not its number", case.out)


class SeveralNames(unittest.TestCase):
    def test_an_option_says_which_name_wins(self):
        parts = Parts()
        for names in parts.facet_names:
            if "pleura" not in names:
                names.append("pleura")
        plain = short_run(pulmo.mesh("cube_lung.msh"))
        case = short_run(parts.write(TAGS), ["-mesh_prefer", "airway"])
        self.assertEqual(content(case), content(plain))
        self.assertIn("14 facets (100 mm^2) in both 'airway' and 'pleura' are taken as 'airway'", case.out)
        self.assertAlmostEqual(case.json()["surface_areas_mm2"]["pleura"], 500, places=9)

    def test_a_cell_in_two_volumes_is_told(self):
        parts = Parts()
        for names in parts.cell_names[:10]:
            names.append("lobe")
        tags = TAGS | {(3, "lobe"): 9}
        plain = short_run(pulmo.mesh("cube_lung.msh"))
        case = short_run(parts.write(tags))
        self.assertEqual(content(case), content(plain))
        self.assertRegex(case.out, r"pulmo: note: 10 cells \(.* ml\) of the mesh are in several volumes \('lobe' and 'lung'\)")
        regions = {name: r["reference_volume_ml"] for name, r in case.json()["regions"].items()}
        self.assertAlmostEqual(regions["lung"], 1, places=12)
        x = parts.points[parts.cells[:10]]
        self.assertAlmostEqual(regions["lobe"], np.abs(np.linalg.det(x[:, 1:] - x[:, :1])).sum() / 6e3, places=12)


class Cube22(unittest.TestCase):
    """gmsh's own MSH 2.2, whose entities have the numbers of other groups."""

    def test_entities_are_no_groups(self):
        parts = Parts()
        path = parts.write(TAGS, entity=lambda dim, tag: {2: {1: 2, 2: 1}, 3: {3: 1}}[dim][tag])
        case = pulmo.finished(SCENE + ["-ventilator_expiration", "0.5", "-dm_plex_filename", path])
        areas = case.json()["surface_areas_mm2"]
        self.assertAlmostEqual(areas["airway"], 100, places=9)
        self.assertAlmostEqual(areas["pleura"], 500, places=9)
        self.assertAlmostEqual(case.json()["resistance_cmH2O_s_per_l"], 48.1, delta=0.05)


class Torn(unittest.TestCase):
    """Faces within the lung that lie on one another without being joined: gas and forces do not pass there."""

    def torn(self, gap):
        """The cube with a crack in its middle: cells on the left have nodes of their own there, moved by a gap in mm."""
        parts = Parts()
        left = parts.points[parts.cells].mean(axis=1)[:, 0] < 5
        twin = np.intersect1d(parts.cells[left], parts.cells[~left])
        twin = twin[parts.points[twin, 2] < 6]  # further up both sides are still one body
        number = np.arange(len(parts.points))
        number[twin] = len(parts.points) + np.arange(len(twin))
        faces = {tuple(sorted(f)) for c in parts.cells[left] for f in itertools.combinations(c, 3)}
        parts.facets = np.array([number[f] if tuple(sorted(f)) in faces else f for f in parts.facets])
        parts.cells[left] = number[parts.cells[left]]
        parts.points = np.concatenate([parts.points, parts.points[twin] - [gap, 0, 0]])
        return parts

    def refused(self, options, *words):
        case = pulmo.Case(SCENE + options + ["-ts_max_time", "0.15"])
        self.assertEqual(case.code, 1, case.tail())
        self.assertEqual(case.err.count("pulmo: error: "), 1, case.err)
        for word in words:
            self.assertIn(word, case.err)
        self.assertEqual(case.files(), [])
        return case.err

    def test_nodes_that_are_nearly_the_same(self):
        plain = short_run(pulmo.mesh("cube_lung.msh")).signals()
        for gap in 1e-12, 1e-8, 1e-4, -1e-4:
            with self.subTest(gap=gap):
                path = self.torn(gap).write(TAGS)
                said = self.refused(["-dm_plex_filename", path], path, "is torn: ", "where nodes ", "join them (gmsh: ")
                # what it says helps
                tolerance = float(re.search(r"Geometry.Tolerance = (\S+), then Coherence Mesh", said)[1])
                gmsh.initialize()
                try:
                    gmsh.option.setNumber("General.Terminal", 0)
                    gmsh.open(path)
                    gmsh.option.setNumber("Geometry.Tolerance", tolerance)
                    gmsh.model.mesh.removeDuplicateNodes()
                    joined = pulmo.scratch("joined.msh")
                    gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)
                    gmsh.write(joined)
                finally:
                    gmsh.finalize()
                rows = short_run(joined).signals()
                for column in "volume_ml", "flow_ml_per_s":
                    np.testing.assert_allclose(rows[column], plain[column], rtol=1e-4, atol=1e-4 * np.abs(plain[column]).max())

    def test_a_mesh_that_is_scaled(self):
        parts = self.torn(1e-4)
        parts.points *= 1e-3
        path = parts.write(TAGS)
        self.refused(["-dm_plex_filename", path, "-mesh_scale", "1000"], "is torn: ", "mm apart")

    def blocks(self, counts, gap=0.0):
        """Two cubes of 10 mm beside one another, cut as they like; what is outside has a name, either end is an airway."""
        (a, left), (b, right) = (case_meshes.kuhn(n, (10, 10, 10)) for n in counts)
        points, tets = np.concatenate([a, b + [10 + gap, 0, 0]]), np.concatenate([left, right + len(a)])
        facets = case_meshes.boundary(tets)
        x = points[facets].mean(axis=1)[:, 0]
        outside = np.abs(x - 10 - gap / 2) > 0.6 * gap + 1e-9
        names = ["airway" if abs(v - 10 - gap / 2) > 9.999 + gap / 2 else "pleura" for v in x[outside]]
        return case_meshes.write(points, tets, facets[outside], names)

    def test_blocks_that_were_meshed_apart(self):
        for gap in 0, 1e-7:
            with self.subTest(gap=gap):
                self.refused(self.blocks([(3, 3, 3), (2, 4, 4)], gap), "has parts that meet without being joined: ",
                             "the first at (10, ", "mesh the parts together")

    def test_slits_that_are_meant(self):
        parts = self.torn(0)
        faces, times = np.unique(np.sort(np.concatenate([parts.cells[:, list(c)] for c in itertools.combinations(range(4), 3)]), axis=1),
                                 axis=0, return_counts=True)
        named = {tuple(sorted(f)) for f in parts.facets}
        slit = [f for f in faces[times == 1] if tuple(f) not in named]
        parts.facets, parts.facet_names = np.concatenate([parts.facets, slit]), parts.facet_names + [["slit"]] * len(slit)
        case = short_run(parts.write(TAGS | {(2, "slit"): 5}))
        self.assertRegex(case.out, rf"pulmo: note: {len(slit)} faces \(.* mm\^2\) of 'slit', .*taken for a slit")

    def test_narrow_gaps(self):
        counts = [(3, 3, 3), (3, 3, 3)]
        self.assertRegex(pulmo.finished(SCENE + self.blocks(counts, 0.03) + ["-ts_max_time", "0.05"]).out,
                         r"pulmo: note: 36 faces \(100 mm\^2\), .* are at most 0.03 mm from others .*taken for a gap")
        self.assertNotIn("taken for", pulmo.finished(SCENE + self.blocks(counts, 0.1) + ["-ts_max_time", "0.05"]).out)


class Distribution(unittest.TestCase):
    def test_names_survive_ranks_and_refinement(self):
        for name, airway, pleura in (("cube_lung.msh", 100, 500),):
            for ranks, more in (2, ["-dm_refine", "1"]), (3, ["-dm_refine_pre", "1"]), (2, ["-petscpartitioner_type", "simple"]):
                with self.subTest(name, ranks=ranks, more=more):
                    case = pulmo.finished(SCENE + ["-dm_plex_filename", pulmo.mesh(name), "-ts_max_time", "0.05"] + more,
                                          ranks=ranks)
                    areas = case.json()["surface_areas_mm2"]
                    self.assertAlmostEqual(areas["airway"], airway, places=9)
                    self.assertAlmostEqual(areas["pleura"], pleura, places=9)


def lung_mesh(*words):
    """Exit code of tools/lung_mesh and all that it says."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = lung_command.main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
    return code, said.getvalue()


class Read:
    """A mesh file as meshio reads it, and the worst mean ratio of its cells (Liu & Joe), 1 for a regular one."""

    def __init__(self, path):
        with contextlib.redirect_stdout(io.StringIO()):  # meshio prints empty lines
            mesh = meshio.read(path)
        tags = mesh.cell_data_dict["gmsh:physical"]
        self.points, self.tets, self.facets = mesh.points, mesh.cells_dict["tetra"], mesh.cells_dict["triangle"]
        self.names = {name: tuple(key) for name, key in mesh.field_data.items()}
        a, b, c = (self.points[self.facets[:, i]] for i in range(3))
        self.areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        self.volumes = np.abs(np.linalg.det(self.points[self.tets[:, 1:]] - self.points[self.tets[:, :1]])) / 6
        self.content = {name: (self.areas[tags["triangle"] == tag] if dimension == 2 else self.volumes[tags["tetra"] == tag]).sum()
                        for name, (tag, dimension) in self.names.items()}
        self.nodes_of = {name: np.unique(self.facets[tags["triangle"] == tag]) for name, (tag, dimension) in self.names.items() if dimension == 2}
        self.whole_faces = {tuple(face) for face in np.sort(self.facets, axis=1)}
        pairs = np.array(list(itertools.combinations(range(4), 2)))
        edges = self.points[self.tets[:, pairs[:, 0]]] - self.points[self.tets[:, pairs[:, 1]]]
        self.worst = (12 * (3 * self.volumes) ** (2 / 3) / np.sum(edges ** 2, axis=(1, 2))).min()

    def faces(self):
        """Faces of all tetrahedra, and how many of these each belongs to."""
        return np.unique(np.sort(self.tets[:, list(itertools.combinations(range(4), 3))], axis=2).reshape(-1, 3), axis=0, return_counts=True)


SWEPT = ["-dm_plex_filename", pulmo.mesh("cube_lung.msh"), "-ventilator_inspiration", "0.4", "-ventilator_ramp_down", "0.1",
         "-ventilator_expiration", "0.4", "-error_estimate", "-error_estimate_method", "sweep", "-error_estimate_numbers", "V_T"]


class Refined(unittest.TestCase):
    """tools/lung_mesh --refine: finer cells of any mesh, held against what meshio reads."""

    def same_body(self, coarse, fine):
        self.assertEqual(fine.names, coarse.names)
        for name, content in coarse.content.items():
            self.assertLessEqual(abs(fine.content[name] / content - 1), 1e-12, name)
        faces, times = fine.faces()
        self.assertLessEqual(times.max(), 2)
        self.assertTrue({tuple(face) for face in faces[times == 1]} <= fine.whole_faces, "boundary without a name, or hanging nodes")
        self.assertTrue(fine.whole_faces <= {tuple(face) for face in faces})

    def walled(self):
        """The cube of two volumes, the faces between which have a name; in another unit, far from the origin."""
        parts = Parts()
        left = parts.points[parts.cells].mean(axis=1)[:, 0] < 5
        parts.cell_names = [["left" if side else "right"] for side in left]
        faces = np.sort(parts.cells[:, list(itertools.combinations(range(4), 3))], axis=2)
        shared = {tuple(f) for f in faces[left].reshape(-1, 3)} & {tuple(f) for f in faces[~left].reshape(-1, 3)}
        parts.facets = np.concatenate([parts.facets, np.array(sorted(shared))])
        parts.facet_names += [["wall"]] * len(shared)
        parts.points = parts.points + [20, -30, 40]
        return parts.write(TAGS | {(2, "wall"): 7, (3, "left"): 4, (3, "right"): 9}, names={
            (2, 1): "airway", (2, 2): "pleura", (2, 7): "wall", (3, 4): "left", (3, 9): "right"})

    def test_round_after_round(self):
        """Six rounds from file to file: names and shape stay, cells follow --near, and none gets flat."""
        path = self.walled()
        first = before = Read(path)
        for number, (version, binary) in enumerate([*FLAVOURS, *FLAVOURS[:2]]):
            size, made = 2.4 / 1.5 ** number, pulmo.scratch("refined.msh")
            code, said = lung_mesh("--refine", path, "--near", "airway", "--size", size, "--format", version, "--binary" if binary else "--ascii",
                                   "--output", made)
            self.assertEqual(code, 0, said)
            now = Read(made)
            self.same_body(first, now)
            at = np.isin(now.tets, now.nodes_of["airway"]).any(axis=1)
            self.assertLess((now.volumes[at] * 6 * 2 ** 0.5).max() ** (1 / 3), 2 * size)  # larger ones have their centre further away
            self.assertGreater(len(now.tets), len(before.tets))
            np.testing.assert_allclose(now.points[now.nodes_of["airway"], 0], 30, atol=1e-12)
            self.assertIn(f"{len(now.tets)}, before {len(before.tets)}", said)
            path, before = made, now
        print(f"{len(first.tets)} to {len(now.tets)} cells, worst mean ratio {first.worst:.3f} to {now.worst:.3f}")
        self.assertGreater(now.worst, 0.5 * first.worst)
        far = now.points[now.tets].mean(axis=1)[:, 0] < 22
        self.assertGreater(now.volumes[far].mean(), 100 * now.volumes[~far].min())

    def test_a_lung_everywhere(self):
        made = pulmo.scratch("refined.msh")
        code, said = lung_mesh("--refine", pulmo.mesh("lung_test.msh"), "--cells", 5000, "--output", made)
        self.assertEqual(code, 0, said)
        coarse, fine = Read(pulmo.mesh("lung_test.msh")), Read(made)
        self.same_body(coarse, fine)
        self.assertAlmostEqual(len(fine.tets) / 5000, 1, delta=0.1)
        self.assertGreater(fine.worst, 0.5 * coarse.worst)

    def test_by_errors(self):
        """Cells are cut where V_T lacks most, also if the file has another unit than the run; the program finds the same lung."""
        coarse = pulmo.finished(SCENE + SWEPT)
        errors, points = coarse.path("errors.xdmf"), meshio.read(pulmo.mesh("cube_lung.msh")).points
        for scale in 1, 1e-3:
            path, made = case_meshes.scaled("cube_lung.msh", scale)[1], pulmo.scratch("refined.msh")
            code, said = lung_mesh("--refine", path, "--size-field", errors, "--cells", 400, "--output", made)
            self.assertEqual(code, 0, said)
            self.same_body(Read(path), Read(made))
            fine = short_run(made, ["-mesh_scale", f"{1 / scale:g}"])
            self.assertAlmostEqual(fine.json()["cells"], 400, delta=40)
            for name, area in coarse.json()["surface_areas_mm2"].items():
                self.assertAlmostEqual(fine.json()["surface_areas_mm2"][name] / area, 1, places=12)
        with h5py.File(coarse.path("fields.h5")) as mesh, h5py.File(coarse.path("errors.h5")) as file:
            x, cells = mesh["geometry"][:], mesh["topology"][:].reshape(-1, 10)
            error = np.abs(file["lacks_in_space_tidal_volume_ml"][:])
        self.assertEqual(len(points), len(np.unique(cells[:, :4])))
        mesh = meshio.read(made)
        centres = mesh.points[mesh.cells_dict["tetra"]].mean(axis=1) / scale
        nearest = np.linalg.norm(x[cells[:, :4]].mean(axis=1)[:, None] - centres, axis=2).argmin(axis=1)
        volumes = [np.abs(np.linalg.det(p[t[:, 1:4]] - p[t[:, :1]])) for p, t in ((x, cells), (mesh.points / scale, mesh.cells_dict["tetra"]))]
        change = volumes[1][nearest] / volumes[0]
        self.assertLess(change[error > np.quantile(error, 0.9)].mean(), 0.5 * change[error < np.quantile(error, 0.3)].mean())

    def test_refuses(self):
        cube, made = pulmo.mesh("cube_lung.msh"), pulmo.scratch("made.msh")
        own = case_meshes.scaled("cube_lung.msh", 1)[1]
        twice = in_gmsh("cube_lung.msh", lambda: gmsh.model.addPhysicalGroup(3, [gmsh.model.getEntities(3)[0][1]], 77), 4.1, False)
        second = in_gmsh("cube_lung.msh", lambda: gmsh.model.mesh.setOrder(2), 4.1, False)
        errors = pulmo.finished(SCENE + SWEPT).path("errors.xdmf")
        for words, said in (([cube], "--refine needs"), ([cube, "--near", "airway"], "--size of the cells"), ([cube, "--near", "wall", "--size", 1], "airway, pleura"),
                            ([cube, "--cells", 50], "--cells 50"), ([cube, "--cells", 10 ** 9], "GB"), ([cube, "--size", 1, "--side", "left"], "--side"),
                            ([cube, "--size", 0.001], "GB"),
                            ([own, "--size", 1, "--output", own], "--output"), (["none.msh", "--size", 1], "none.msh"), ([twice, "--size", 1], "2 groups"),
                            ([second, "--size", 1], "higher order"), ([pulmo.mesh("column.msh"), "--size-field", errors], "another body"),
                            ([cube, "--size-field", "none.xdmf"], "none.xdmf"), ([cube, "--size-field", errors, "--size", 1], "--size "),
                            ([cube, "--size", 1, "--check", cube], "--check")):
            with self.subTest(words=words):
                code, text = lung_mesh("--output", made, "--refine", *words)
                self.assertNotEqual(code, 0)
                self.assertIn(said, text)
                self.assertFalse(os.path.exists(made))
        code, text = lung_mesh("--near", "airway", "--output", made)
        self.assertIn("--near has no meaning without --refine", text)


if __name__ == "__main__":
    pulmo.main()
