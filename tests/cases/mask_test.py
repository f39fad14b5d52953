"""Lung meshes from label images and closed surfaces: volumes against closed forms, sides, names, determinism, errors."""
import contextlib
import filecmp
import io
import json
import os
import sys
import unittest

import nibabel
import numpy as np

import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from meshing import lung_command  # noqa: E402
from meshing.geometry import boundary_facets, facet_areas, tet_volumes  # noqa: E402
from meshing.labels import part_of  # noqa: E402
from meshing.msh import read_mesh  # noqa: E402
from meshing.quality import dihedral_angles, sicn  # noqa: E402

HALF = np.array([42.0, 55.0, 85.0])  # axes of both lungs
MIDDLE = {"right": np.array([62.0, -5.0, 20.0]), "left": np.array([-58.0, -5.0, 20.0])}
VOLUME = 4 / 3 * np.pi * HALF.prod() / 1e3  # ml of each
COARSE = ["--size", "22"]
RIGHT, LEFT, TUBE = 1, 2, 3
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
    tube = near_line(x, FORK + (0, 0, 60), FORK, 7)
    for side in MIDDLE:
        tube |= near_line(x, FORK, end_of(side), 6)
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
    labels[plain == RIGHT] = np.where(z[plain == RIGHT] > 20, 12, np.where(z[plain == RIGHT] > -20, 13, 14))
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


if __name__ == "__main__":
    pulmo.main()
