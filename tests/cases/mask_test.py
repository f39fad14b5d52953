"""Lung meshes from label images and closed surfaces: volumes against closed forms, sides, names, determinism, errors."""
import contextlib
import filecmp
import io
import json
import os
import re
import sys
import unittest

import gmsh
import h5py
import meshio
import nibabel
import numpy as np
from scipy.io import netcdf_file

import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from meshing import lung_command  # noqa: E402
from meshing.geometry import boundary_facets, facet_areas, tet_volumes  # noqa: E402
from meshing.gmsh_model import gmsh_session  # noqa: E402
from meshing.label_image import Label  # noqa: E402
from meshing.labels import find_parts, part_of  # noqa: E402
from meshing.msh import read_mesh  # noqa: E402
from meshing.quality import dihedral_angles, sicn  # noqa: E402
from meshing.sphere import mirrored as octants, octant_directions  # noqa: E402

HALF = np.array([42.0, 55.0, 85.0])  # axes of both lungs
MIDDLE = {"right": np.array([62.0, -5.0, 20.0]), "left": np.array([-58.0, -5.0, 20.0])}
VOLUME = 4 / 3 * np.pi * HALF.prod() / 1e3  # ml of each
COARSE = ["--size", "22"]
RIGHT, LEFT, TUBE = 1, 2, 3
CUTS = np.array([-20.5, 21.5])  # between the right lobes, mm above the middle and between voxels
FORK = np.array([0.0, -5.0, 60.0])  # of the trachea


def in_lung(x, side):
    return np.sum(((x - MIDDLE[side]) / HALF) ** 2, axis=-1) < 1


def near_line(x, start, end, radius):
    along = np.clip((x - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
    return np.linalg.norm(x - start - along[..., None] * (end - start), axis=-1) < radius


def end_of(side):
    """Where a main bronchus meets its lung."""
    return MIDDLE[side] + (-HALF[0] if side == "right" else HALF[0], 0, 12)


def anatomy(x):
    """Labels at places (..., 3) of the world: two ellipsoids, a trachea that runs along the right lung's apex and forks."""
    labels = np.zeros(x.shape[:-1], np.uint8)
    tube = near_line(x, FORK + (52, 0, 50), FORK, 9)
    for side in MIDDLE:
        tube |= near_line(x, FORK, end_of(side), 6)
    tube |= np.linalg.norm(x - MIDDLE["right"] - (HALF[0] + 3, 0, -10), axis=-1) < 6  # a bit at the right lung's outer side
    labels[tube] = TUBE
    labels[in_lung(x, "right")] = RIGHT
    labels[in_lung(x, "left")] = LEFT
    return labels


def lobed(x):
    """TotalSegmentator's numbers: planes cut the same lungs in lobes."""
    labels = np.zeros(x.shape[:-1], np.uint8)
    plain = anatomy(x)
    z = x[..., 2] - MIDDLE["left"][2]
    labels[plain == LEFT] = np.where(oblique(x[plain == LEFT]) > 0, 10, 11)
    labels[plain == RIGHT] = np.where(z[plain == RIGHT] > CUTS[1], 12, np.where(z[plain == RIGHT] > CUTS[0], 13, 14))
    labels[plain == TUBE] = 16
    labels[x[..., 2] > 125] = 1  # something else
    return labels


def oblique(x):
    """Signed distance to the left lung's fissure."""
    return (x - MIDDLE["left"]) @ np.array([0, 0.6, 0.8])


def image(labels=anatomy, spacing=(3, 3, 3), axes=np.eye(3), low=(-115, -75, -80), high=(125, 65, 130), dtype=np.uint8):
    """A NIfTI image of the labels on a grid along the columns of axes that covers a box about the lungs."""
    axes = np.asarray(axes, dtype=float)
    corners = np.array([[(low, high)[b][i] for i, b in enumerate(bits)] for bits in np.ndindex(2, 2, 2)]) @ np.linalg.inv(axes).T
    first, last = corners.min(axis=0), corners.max(axis=0)
    shape = np.ceil((last - first) / spacing).astype(int)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * spacing, axes @ first
    index = np.moveaxis(np.indices(shape), 0, -1)
    values = labels(index @ affine[:3, :3].T + affine[:3, 3])
    made = nibabel.Nifti1Image(values.astype(dtype), affine)
    made.header.set_xyzt_units("mm")
    return made


def ellipsoid(middle, fineness=24):
    """Points and triangles of a lung's surface, seen from outside."""
    points, triangles = octants(*octant_directions(fineness))
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    inwards = np.sum(a * np.cross(b, c), axis=1) < 0
    return points * HALF + middle, np.where(inwards[:, None], triangles[:, ::-1], triangles).astype(np.int32)


def write_exodus(path, mesh):
    """An Exodus file (netCDF 3) of a Mesh: a block for each volume, a side set for each surface, with names."""
    blocks = [(name, np.flatnonzero(mesh.regions == tag)) for (d, tag), name in mesh.names.items() if d == 3]
    order = np.concatenate([cells for _, cells in blocks])
    tets = mesh.tets[order]
    sides = {tuple(sorted(tet[list(face)])): (cell + 1, side + 1) for cell, tet in enumerate(tets)
             for side, face in enumerate(((0, 1, 3), (1, 2, 3), (0, 2, 3), (0, 1, 2)))}
    sets = [(name, np.array([sides[tuple(sorted(facet))] for facet in mesh.facets[mesh.surfaces == tag]]))
            for (d, tag), name in mesh.names.items() if d == 2]
    with netcdf_file(path, "w", version=2) as file:
        file.api_version = file.version = np.float32(5)
        file.floating_point_word_size, file.file_size, file.title = np.int32(8), np.int32(1), "pair"
        for name, size in (("time_step", None), ("len_string", 33), ("len_name", 33), ("num_dim", 3), ("num_nodes", len(mesh.points)),
                           ("num_elem", len(tets)), ("num_el_blk", len(blocks)), ("num_side_sets", len(sets))):
            file.createDimension(name, size)

        def variable(name, values, dimensions, kind):
            file.createVariable(name, kind, dimensions)[:] = values

        def names_of(groups):
            return np.array([list(name.ljust(33, chr(0)).encode("latin1")) for name, _ in groups], dtype="u1").view("S1")

        for axis, letter in enumerate("xyz"):
            variable("coord" + letter, mesh.points[:, axis], ("num_nodes",), "d")
        for kind, dimension, groups in (("eb", "num_el_blk", blocks), ("ss", "num_side_sets", sets)):
            variable(f"{kind}_names", names_of(groups), (dimension, "len_name"), "c")
            variable(f"{kind}_status", np.ones(len(groups)), (dimension,), "i")
            variable(f"{kind}_prop1", np.arange(1, len(groups) + 1), (dimension,), "i")
            file.variables[f"{kind}_prop1"].name = "ID"
        for k, (_, cells) in enumerate(blocks, 1):
            file.createDimension(f"num_el_in_blk{k}", len(cells))
            file.createDimension(f"num_nod_per_el{k}", 4)
            variable(f"connect{k}", mesh.tets[cells] + 1, (f"num_el_in_blk{k}", f"num_nod_per_el{k}"), "i")
            file.variables[f"connect{k}"].elem_type = "TETRA4"
        for k, (_, pairs) in enumerate(sets, 1):
            file.createDimension(f"num_side_ss{k}", len(pairs))
            variable(f"elem_ss{k}", pairs[:, 0], (f"num_side_ss{k}",), "i")
            variable(f"side_ss{k}", pairs[:, 1], (f"num_side_ss{k}",), "i")


def saved(made, name="labels.nii.gz"):
    path = pulmo.scratch(name)
    nibabel.save(made, path)
    return path


def changed(change, **words):
    """The plain image with its voxels changed in place."""
    made = image(**words)
    values = np.asarray(made.dataobj).copy()
    values = change(values) if change(values) is not None else values
    return saved(nibabel.Nifti1Image(values, made.affine, made.header))


def called(*arguments):
    """Exit code, output and errors of lung_mesh."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = lung_command.main([str(a) for a in arguments])
        except SystemExit as end:
            code = end.code
    return code, out.getvalue(), err.getvalue()


class Masks(unittest.TestCase):
    def meshed(self, path, *arguments, route="--mask"):
        """The Mesh of a mask or of surfaces, and what was told."""
        mesh = pulmo.scratch("lung.msh")
        code, out, err = called(*([route, path] if route else []), *(arguments or COARSE), "--output", mesh)
        self.assertEqual(code, 0, out + err)
        self.assertEqual(err, "")
        self.path = mesh
        return read_mesh(mesh), out

    def check(self, mesh, volume=VOLUME, within=0.01):
        """Two lungs of the closed form's volumes and places, good cells, one airway patch at each bronchus."""
        self.assertEqual(sorted(mesh.names.values()), ["airway", "left_lung", "pleura", "right_lung"])
        self.assertGreater(sicn(mesh.points, mesh.tets).min(), 0.15)
        self.assertGreater(dihedral_angles(mesh.points, mesh.tets).min(), 7)
        tags = {name: tag for (_, tag), name in mesh.names.items()}
        for side in MIDDLE:
            tets = mesh.tets[mesh.regions == tags[side + "_lung"]]
            parts = tet_volumes(mesh.points, tets)
            self.assertAlmostEqual(parts.sum() / 1e3 / volume, 1, delta=within)
            middle = parts @ mesh.points[tets].mean(axis=1) / parts.sum()
            np.testing.assert_allclose(middle, MIDDLE[side], atol=0.8)
            facets = boundary_facets(tets)
            self.assertEqual(len(facets) / 2 + 2, len(np.unique(facets)), "closed, of genus 0")
        self.assertEqual(len(mesh.facets), len(boundary_facets(mesh.tets)))
        airway = mesh.facets[mesh.surfaces == tags["airway"]]
        self.assertGreater(len(airway), 4)
        self.assertLess(np.abs(mesh.points[airway, 0]).max(), 45, "on the lungs' inner sides")
        return mesh.points[airway].mean(axis=1), facet_areas(mesh.points, airway)

    def test_two_lungs_and_a_trachea(self):
        """Volumes by closed form, the airway where the bronchi end and not along the trachea, the same bytes twice; pulmo breathes."""
        path = saved(image())
        mesh, out = self.meshed(path, "--labels", "right=1,left=2,airway=3", *COARSE)
        first = self.path
        places, areas = self.check(mesh)
        for side, sign in (("right", 1), ("left", -1)):
            mine = sign * places[:, 0] > 0
            self.assertLess(np.linalg.norm(places[mine] - end_of(side), axis=1).max(), 25)
            self.assertGreater(areas[mine].sum(), 100)
        self.assertIn("right_lung             closed, genus 0, airway patches 1", out)
        self.meshed(path, "--labels", "right=1,left=2,airway=3", *COARSE)
        self.assertTrue(filecmp.cmp(first, self.path, shallow=False))
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + ["-dm_plex_filename", first, "-ts_max_time", "0.05"])
        summary = case.json()
        self.assertAlmostEqual(summary["reference_volume_ml"] / (2 * VOLUME), 1, delta=0.01)
        self.assertGreater(case.signals()["volume_ml"][-1], 0)

    def test_any_orientation_lies_at_the_same_place(self):
        """LPS voxels, a mirrored matrix with swapped axes, oblique thick slices: right stays right, volumes and middles stay."""
        a = 0.3
        oblique_axes = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) @ np.diag([-1, -1, 1])
        swapped = np.array([[0, 1, 0], [0, 0, -1], [1, 0, 0]])
        self.assertLess(np.linalg.det(swapped), 0)
        for what, words in (("LPS, thick slices", dict(axes=oblique_axes, spacing=(2, 2, 6))),
                            ("mirrored and swapped", dict(axes=swapped, spacing=(3.5, 3, 3)))):
            with self.subTest(what):
                mesh, out = self.meshed(saved(image(**words)), *COARSE)
                self.check(mesh, within=0.015)
                self.assertIn("labels as lungmask: right=1, left=2", out)
                self.assertIn("not used: 3 (", out)
                self.assertIn("no airway label", out)
                self.assertEqual("interpolated between slices" in out, "thick" in what)

    def test_lobes_become_volumes(self):
        """TotalSegmentator's numbers; cells on both sides of a fissure share its nodes, which lie on the plane that cuts the mask."""
        mesh, out = self.meshed(saved(image(lobed)), "--size", "11")
        self.assertIn("labels as TotalSegmentator 2: left_upper=10, left_lower=11, right_upper=12, right_middle=13, right_lower=14, airway=16",
                      out)
        self.assertIn("not used: 1 (", out)
        self.assertEqual(sorted(mesh.names.values()), ["airway", "left_lower_lobe", "left_upper_lobe", "pleura", "right_lower_lobe",
                                                       "right_middle_lobe", "right_upper_lobe"])
        self.assertIn("right_lung             closed, genus 0, airway patches 1", out)
        volume = {name: tet_volumes(mesh.points, mesh.tets[mesh.regions == tag]).sum() / 1e3
                  for (dimension, tag), name in mesh.names.items() if dimension == 3}
        t = np.abs(CUTS) / HALF[2]
        lower, upper = VOLUME * (2 / 3 - t + t**3 / 3) * 3 / 4  # of an ellipsoid beyond t half axes
        expected = {"left_upper_lobe": VOLUME / 2, "left_lower_lobe": VOLUME / 2, "right_upper_lobe": upper, "right_lower_lobe": lower,
                    "right_middle_lobe": VOLUME - upper - lower}
        for name, wanted in expected.items():
            self.assertAlmostEqual(volume[name] / wanted, 1, delta=0.025, msg=name)
        tags = {name: tag for (_, tag), name in mesh.names.items()}
        shared = np.intersect1d(*(mesh.tets[mesh.regions == tags[f"left_{lobe}_lobe"]] for lobe in ("upper", "lower")))
        inner = np.setdiff1d(shared, mesh.facets)
        self.assertGreater(len(inner), 10)
        self.assertLess(np.median(np.abs(oblique(mesh.points[inner]))), 1)
        self.assertLess(np.abs(oblique(mesh.points[inner])).mean(), 2)

    def test_one_label_islands_and_touching_lungs(self):
        """Both lungs under one label that touch come apart by position; islands are left out with their volume."""
        def bridged(values):
            values[values == TUBE] = 0
            values[values > 0] = 1
            values[30:48, 21:26, 30:36] = 1  # joins the lungs
            values[2:6, 2:6, 2:6] = 1  # 1.7 ml apart
        mesh, out = self.meshed(changed(bridged), *COARSE)
        self.assertIn("there is only one label: lungs=1", out)
        self.assertIn("cut where they touch", out)
        self.assertRegex(out, r"islands of 1\.\d+ ml left out")
        self.check(mesh, within=0.03)

    def test_lungs_with_a_common_face_are_held_apart(self):
        """Voxels of right and left side by side: the meshes keep their volumes and a gap, which is told."""
        def pressed(x):
            right = x[..., 0] > 1.5  # between voxels
            centre = np.where(right[..., None], (36, -5, 20), (-33, -5, 20))
            return np.where(np.sum(((x - centre) / HALF) ** 2, axis=-1) < 1, np.where(right, RIGHT, LEFT), 0)
        mesh, out = self.meshed(saved(image(pressed)), *COARSE)
        told = float(re.search(r"the lungs touch or nearly do: held ([0-9.]+) mm apart", out)[1])
        tags = {name: tag for (_, tag), name in mesh.names.items()}
        right, left = (mesh.points[mesh.tets[mesh.regions == tags[side + "_lung"]]][..., 0] for side in MIDDLE)
        self.assertGreater(right.min() - left.max(), 0.4 * told)
        self.assertLess(right.min() - left.max(), 1.5 * told)
        for side in MIDDLE:
            self.assertRegex(out, side + r"_lung *[0-9.]+, [0-9.]+, [+]0.00 %")

    def test_another_volume_is_a_uniform_scaling(self):
        """--volume scales about the middle and says what that assumes; --cells counts."""
        mesh, out = self.meshed(saved(image()), "--volume", "1000ml", "--cells", "1500")
        self.assertAlmostEqual(tet_volumes(mesh.points, mesh.tets).sum() / 1e6, 1, delta=1e-6)
        self.assertAlmostEqual(len(mesh.tets) / 1500, 1, delta=0.1)
        self.assertIn("That assumes that the lungs have the same shape", out)
        told = float(re.search(r"times ([0-9.]+) in every direction", out)[1])
        self.assertAlmostEqual(told, (1000 / (2 * VOLUME)) ** (1 / 3), delta=0.002)

    def test_names_of_a_folder_and_of_a_table(self):
        """One file for each organ, named after it; a JSON beside the image; a table in its header; all give the same bytes."""
        folder = os.path.dirname(pulmo.scratch())
        for number, name in ((RIGHT, "lung_right"), (LEFT, "lung_left"), (TUBE, "trachea")):
            nibabel.save(nibabel.Nifti1Image((np.asarray(image().dataobj) == number).astype(np.uint8), image().affine),
                         os.path.join(folder, name + ".nii.gz"))
        saved_image = image()
        beside = saved(image())
        with open(beside.replace(".nii.gz", ".json"), "w", encoding="utf-8") as file:
            json.dump({"labels": {"background": 0, "Right lung": RIGHT, "LL": LEFT, "Left Lung": LEFT, "trachea and bronchi": TUBE}}, file)
        table = "".join(f'<Label Key="{n}"><![CDATA[{name}]]></Label>' for n, name in
                        ((RIGHT, "lung_right"), (LEFT, "lung_left"), (TUBE, "lung_trachea_bronchia"), (9, "rib_left_3")))
        saved_image.header.extensions.append(nibabel.nifti1.Nifti1Extension(
            0, f'<?xml version="1.0" encoding="UTF-8"?> <CaretExtension><LabelTable>{table}</LabelTable></CaretExtension>'.encode()))
        files = []
        for path in (folder, beside, saved(saved_image)):
            mesh, out = self.meshed(path, *COARSE)
            files.append(self.path)
            self.check(mesh)
            self.assertIn("by the names that come with the file", out)
        self.assertTrue(filecmp.cmp(files[0], files[1], shallow=False) and filecmp.cmp(files[0], files[2], shallow=False))

    def test_closed_surfaces(self):
        """An STL file in LPS as 3D Slicer writes it, and others, give the lungs that they enclose; bad ones are refused."""
        right, left = ellipsoid(MIDDLE["right"]), ellipsoid(MIDDLE["left"])
        enclosed = tet_volumes(np.vstack([right[0], MIDDLE["right"]]),
                               np.hstack([right[1], np.full((len(right[1]), 1), len(right[0]))])).sum() / -1e3
        stl, ply, obj = pulmo.scratch("right.stl"), pulmo.scratch("left.ply"), pulmo.scratch("bad.obj")
        meshio.write(stl, meshio.Mesh(right[0] * (-1, -1, 1), [("triangle", right[1])]), "stl", binary=True)
        with open(stl, "r+b") as file:
            file.write(b"3D Slicer output. SPACE=LPS")
        meshio.write(ply, meshio.Mesh(left[0], [("triangle", left[1][:, ::-1])]))  # seen from inside
        mesh, out = self.meshed(f"right={stl}", "--surface", f"left={ply}", *COARSE, route="--surface")
        self.assertIn("its axes are LPS", out)
        self.check(mesh, volume=abs(enclosed), within=0.005)

        both = np.vstack([right[0], right[0] + (20, 0, 0)]), np.vstack([right[1], right[1] + len(right[0])])
        for points, triangles, told in ((*right, "--surface right=none.stl: there is no such file"),
                                        (right[0], right[1][1:], "is open: 3 edges have a triangle on one side only"),
                                        (right[0], np.vstack([right[1], [[0, 1, 2]]]), "edges"),
                                        (*both, "cuts through itself near (")):
            with self.subTest(told):
                meshio.write(obj, meshio.Mesh(points, [("triangle", triangles)]))
                path = "none.stl" if "none" in told else obj
                code, out, err = called("--surface", f"right={path}", "--output", pulmo.scratch("none.msh"))
                self.assertEqual(code, 1, out + err)
                self.assertIn(told, err)
                self.assertEqual(len(err.splitlines()), 1, err)

    def test_other_meshes_are_checked(self):
        """--check: what a file holds and what is wrong with it, on good, left-handed, unnamed, doubled and two-body meshes."""
        good = pulmo.mesh("lung_pair.msh")
        page = pulmo.scratch("page.html")
        code, out, err = called("--check", good, "--report", page)
        self.assertEqual(code, 0, err)
        self.assertIn("passes all checks", out)
        self.assertNotIn("note:", out)
        with open(page, encoding="utf-8") as file:
            text = file.read()
        pair = read_mesh(good)
        for (dimension, tag), name in pair.names.items():
            if dimension == 3:
                volume = tet_volumes(pair.points, pair.tets[pair.regions == tag]).sum() / 1e3
                self.assertIn(f'<th scope="row">{name}</th><td>{volume:.1f}</td>', text)
        self.assertNotIn("http", text)
        read = meshio.read(pulmo.mesh("cube_msh22_ascii.msh"))
        tets, triangles = read.cells_dict["tetra"], read.cells_dict["triangle"]

        def checked(points, tets, triangles, tags, names):
            path = pulmo.scratch("other.msh")
            data = [tags, np.full(len(tets), 9)]
            meshio.write(path, meshio.Mesh(points, [("triangle", triangles), ("tetra", tets)], field_data=names, cell_data={
                "gmsh:physical": data, "gmsh:geometrical": data}), "gmsh22", binary=False)
            return called("--check", path)

        names = {"inlet": np.array([1, 2]), "pleura": np.array([2, 2]), "tissue": np.array([9, 3])}
        points = read.points * 130
        tags = np.where((points[triangles] > 129).all(axis=1)[:, 0], 1, 2)
        code, out, err = checked(points, tets[:, [1, 0, 2, 3]], triangles, tags, names)
        self.assertEqual(code, 1)
        self.assertIn("24 of 24 tetrahedra are left-handed", out)
        self.assertIn("no surface is called airway; there are inlet, pleura", out)
        self.assertIn("tissue is not one closed surface of genus 0 with one airway patch", err)
        self.assertIn("volume                 2197.000 ml", out)
        code, out, err = checked(points / 1000, tets, triangles[tags == 2], tags[tags == 2], names)
        self.assertIn("no adult's lung; if the file is in m, give pulmo -mesh_scale 1000", out)
        self.assertIn("cm2 of the surface have no name", out)
        # a second cube on the first, its nodes not joined
        double = np.vstack([points, points + (130, 0, 0)])
        code, out, err = checked(double, np.vstack([tets, tets + len(points)]), np.vstack([triangles, triangles + len(points)]),
                                 np.concatenate([tags, tags]), names)
        self.assertIn("are not joined (a tear)", out)
        # what pulmo refuses
        code, out, err = checked(points, tets, np.vstack([triangles, [[0, 1, 2]]]), np.append(tags, 2), names)
        self.assertIn("1 triangles are no faces of cells", err)
        curved, twice = pulmo.scratch("curved.msh"), pulmo.scratch("twice.msh")
        with gmsh_session():
            gmsh.model.occ.addBox(0, 0, 0, 130, 130, 130)
            gmsh.model.occ.synchronize()
            gmsh.option.setNumber("Mesh.MeshSizeMax", 70)
            for sides, name in (([2], "airway"), ([1, 3, 4, 5, 6], "pleura"), ([2, 3], "other")):
                gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, sides), name)
            gmsh.model.addPhysicalGroup(3, [1])
            gmsh.model.mesh.generate(3)
            gmsh.write(twice)
            gmsh.model.mesh.setOrder(2)
            gmsh.write(curved)
        self.assertIn("some faces are in 2 groups (airway, other)", called("--check", twice)[2])
        self.assertIn("elements are of higher order", called("--check", curved)[2])
        made = pulmo.scratch("made.msh")
        self.assertEqual(called("--convert", curved, "--output", made)[0], 0)
        self.assertEqual(called("--check", made)[0], 0)
        for path, told in (("none.msh", "there is no file none.msh"), (os.path.join(pulmo.SOURCE, "LICENSE"), "is no mesh that")):
            code, out, err = called("--check", path)
            self.assertEqual(code, 1)
            self.assertIn(told, err)

    def test_other_formats_keep_names_and_volumes(self):
        """A pair of lungs as VTU, as DOLFIN's XDMF and HDF5 and as Exodus comes back as MSH with its volumes, areas and names."""
        pair = read_mesh(pulmo.mesh("lung_pair.msh"))
        wanted = self.groups(pair)
        tri, tet = ("triangle", pair.facets[:, ::-1]), ("tetra", pair.tets)
        numbers = ",".join(f"{'surface' if d == 2 else 'volume'}:{{}}{tag}={name}" for (d, tag), name in pair.names.items())
        vtu = pulmo.scratch("pair.vtu")
        meshio.write(vtu, meshio.Mesh(pair.points, [tri, tet], cell_data={"group": [pair.surfaces, pair.regions]}))
        cells, faces = pulmo.scratch("mesh.xdmf"), pulmo.scratch("faces.xdmf")
        meshio.write(cells, meshio.Mesh(pair.points, [tet], cell_data={"f": [pair.regions]}))
        used, facets = np.unique(pair.facets, return_inverse=True)
        meshio.write(faces, meshio.Mesh(pair.points[used][::-1], [("triangle", len(used) - 1 - facets.reshape(-1, 3))],
                                        cell_data={"f": [pair.surfaces]}))
        dolfin = pulmo.scratch("pair.h5")
        with h5py.File(dolfin, "w") as file:
            inner = np.array([pair.tets[0, :3], pair.tets[1, :3]])
            for name, topology, values in (("mesh", pair.tets, None), ("domains", pair.tets[::-1], pair.regions[::-1]),
                                           ("boundaries", np.vstack([pair.facets, inner]), np.array([*pair.surfaces, 0, 2**64 - 1], dtype="u8"))):
                file[f"{name}/topology"], file[f"{name}/coordinates"] = topology, pair.points
                if values is not None:
                    file[f"{name}/values"] = values
        exodus = pulmo.scratch("pair.e")
        write_exodus(exodus, pair)
        dolfin_names = ",".join(f"{'boundaries' if d == 2 else 'domains'}_{tag}={name}" for (d, tag), name in pair.names.items())
        for files, names in (([vtu], numbers.replace("{}", "")), ([cells, faces], numbers.replace("{}", "")), ([dolfin], dolfin_names),
                             ([exodus], None)):
            with self.subTest(os.path.basename(files[0])):
                made = pulmo.scratch("made.msh")
                code, out, err = called("--convert", *files, "--output", made, *(["--names", names] if names else []))
                self.assertEqual(code, 0, err)
                self.assertNotIn("note:", out)
                found = self.groups(read_mesh(made))
                self.assertEqual(sorted(found), sorted(wanted))
                for name, value in wanted.items():
                    self.assertAlmostEqual(found[name] / value, 1, delta=1e-6, msg=name)
        code, _, err = called("--check", cells, vtu, "--names", "9=airway")
        self.assertIn("'9=airway' names no group", err)
        moved = pulmo.scratch("moved.xdmf")
        meshio.write(moved, meshio.Mesh(pair.points + 1, [tri], cell_data={"f": [pair.surfaces]}))
        self.assertIn("is of another mesh", called("--check", cells, moved)[2])

    def groups(self, mesh):
        """{name: volume or area} of a Mesh."""
        return {name: tet_volumes(mesh.points, mesh.tets[mesh.regions == tag]).sum() if dimension == 3
                else facet_areas(mesh.points, mesh.facets[mesh.surfaces == tag]).sum() for (dimension, tag), name in mesh.names.items()}

    def test_names_and_numbers_together(self):
        """A name for the airway only: the lungs are known by their numbers, or there is one label beside it."""
        def parts(labels, names):
            told = []
            return find_parts({n: Label(v, np.array([x, 0, 0])) for n, (v, x) in labels.items()}, names, None, told.append), told[0]
        self.assertEqual(parts({1: (800, 60), 2: (700, -60), 7: (20, 0)}, {7: "trachea"})[0], {"right": [1], "left": [2], "airway": [7]})
        found, told = parts({1: (1500, 0), 7: (20, 0)}, {7: "trachea"})
        self.assertEqual(found, {"lungs": [1], "airway": [7]})
        self.assertIn("only one label beside the airway's", told)

    def test_what_names_mean(self):
        for name, part in (("lung_upper_lobe_left", "left_upper"), ("Right Middle Lobe", "right_middle"), ("RLL", "right_lower"),
                           ("lung_left", "left"), ("left lung", "left"), ("right", "right"), ("lungs", "lungs"), ("trachea", "airway"),
                           ("lung_trachea_bronchia", "airway"), ("rib_left_3", None), ("lung_vessels", None), ("lung_nodule", None),
                           ("kidney_left", None), ("occipital_lobe", None), ("L", None), ("left lobe", None), ("upper lobe", None), ("", None)):
            self.assertEqual(part_of(name), part, name)

    def test_refusals(self):
        """One sentence each, no file, exit code 1."""
        def two_pieces(values):
            values[values == RIGHT] = 0
            values[50:60, 10:40, 5:25] = RIGHT
            values[50:60, 10:40, 40:60] = RIGHT

        def halves(values):  # of one lung
            values[values != RIGHT] = 0
            values[:, :, 34:][values[:, :, 34:] == RIGHT] = 2

        def tunnel(values):
            values[30:80, 20:30, 25:38] = 0

        ct = saved(image(lambda x: 40 * x[..., 2], dtype=np.int16), "ct.nii.gz")
        four = saved(nibabel.Nifti1Image(np.zeros((4, 4, 4, 2), np.uint8), np.eye(4)), "four.nii.gz")
        none = pulmo.scratch("text.nii.gz")
        with open(none, "w", encoding="utf-8") as file:
            file.write("no image")
        three = changed(lambda v: np.where(v == 0, 0, v + 20).astype(np.uint8))
        unknown = nibabel.Nifti1Image(np.asarray(image().dataobj), None)
        unknown.header["pixdim"][1:4] = 3
        unknown.header.set_qform(None, 0)
        unknown.header.set_sform(None, 0)
        plain = saved(image())
        for words, told in (
                ([changed(lambda v: v * 0)], "is empty: every voxel is 0"),
                ([saved(nibabel.Nifti1Image(np.ones((40, 40, 1), np.uint8), np.eye(4)), "flat.nii.gz")], "is a flat image of 40 x 40 x 1"),
                ([four], "has 4 dimensions (4 x 4 x 4 x 2); it takes one image of three"),
                ([ct], "so it is a CT or the like and no label image"),
                ([saved(nibabel.Nifti1Image(np.random.default_rng(1).random((9, 9, 9)), np.eye(4)), "p.nii.gz")], "values with decimals"),
                ([none], "is no NIfTI file that can be read"),
                (["none.nii.gz"], "there is no such file"),
                ([three], "it cannot be told which labels are the lungs; there are 21 ("),
                ([changed(halves)], "it cannot be told which labels are the lungs; there are 1 ("),
                ([plain, "--labels", "right=1,left=7"], "--labels left=7: no voxel has label 7; there are 1 ("),
                ([plain, "--labels", "right=1,liver=2"], "'liver=2' is no PART=NUMBER"),
                ([plain, "--labels", "right=1,left=1"], "label 1 is named twice"),
                ([plain, "--labels", "right=2,left=1"], "what is named right lies at x = -58 mm and left at 62 mm"),
                ([saved(image(spacing=(14, 14, 14)))], "voxels across; it takes"),
                ([changed(two_pieces), "--labels", "right=1,left=2"], "the right lung is in 2 large pieces"),
                ([changed(two_pieces), "--labels", "lungs=1+2"], "three large pieces"),
                ([changed(tunnel), "--labels", "right=1"], "has holes through it"),
                ([changed(lambda v: np.where(v == LEFT, 0, v).astype(np.uint8)), "--labels", "lungs=1"], "does not come apart in two"),
                ([plain, "--airway", "main"], "--airway has no meaning with --mask"),
                ([plain, "--size", "400"], "--size 400 mm is no size that lungs of"),
                ([plain, "--rim-size", "100"], "--rim-size 100 mm is outside")):
            with self.subTest(told):
                mesh = pulmo.scratch("none.msh")
                code, out, err = called("--mask", *words, "--output", mesh)
                self.assertEqual(code, 1, out + err)
                self.assertIn(told, err)
                self.assertEqual(len(err.splitlines()), 1, err)
                self.assertTrue(err.startswith("lung_mesh: "), err)
                self.assertFalse(os.path.exists(mesh))
        for words in (["--labels", "right=1"], ["--rim-size", "5"]):
            self.assertIn("has no meaning without --mask", called(*words, "--output", mesh)[2])
        self.assertIn("--names has no meaning without --check or --convert", called("--names", "1=airway", "--output", mesh)[2])
        self.assertIn("--mask and --check do not go together", called("--mask", plain, "--check", plain, "--output", mesh)[2])
        # an unknown orientation is told, and its default contradicts labels that are the other way round
        out = called("--mask", saved(unknown), "--labels", "right=1,left=2", "--output", mesh)
        self.assertIn("says nothing about its orientation", out[1])
        self.assertIn("the labels are swapped or the header's orientation is wrong", out[2])


if __name__ == "__main__":
    pulmo.main()
