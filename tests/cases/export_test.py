#!/usr/bin/python3
"""tools/export: images, VTU, ParaView's script and the CSV of ventilators, against closed forms, HDF5 and signals."""
import os
import runpy
import shutil
import sys
import types
import unittest
import xml.etree.ElementTree as ElementTree
from unittest import mock

import h5py
import meshio
import nibabel
import numpy as np

import made_run
import pulmo_case as pulmo

COARSE = ["-elements", "P1-P1", "-ts_dt", "0.1"]
NEAR = 0.01  # mm: VTK's tolerance for what lies in a cell is a thousandth of it
DEFAULT = ["J_mean", "alveolar_pressure_cmH2O", "displacement_mm", "ventilation_since_breath_start"]


def export(*arguments):
    """(exit code, output, errors) of tools/export."""
    made = pulmo.tool_called("export", *arguments)
    return made.returncode, made.stdout, made.stderr


def files_in(folder):
    """Names in their order, but for the list of what an export made."""
    return sorted(name for name in os.listdir(folder) if name != ".made_by_export")


def image(values, affine, unit="mm"):
    """Path of a new NIfTI image."""
    made = nibabel.Nifti1Image(values, affine)
    made.header.set_xyzt_units(unit)
    path = pulmo.scratch("image.nii.gz")
    nibabel.save(made, path)
    return path


def turned(angle, spacing, origin):
    """An affine whose first axis runs to the left and whose others are turned about it."""
    c, s = np.cos(angle), np.sin(angle)
    affine = np.eye(4)
    affine[:3, :3] = np.array([[-1, 0, 0], [0, c, -s], [0, s, c]]) @ np.diag(spacing)
    affine[:3, 3] = origin
    return affine


def places(affine, shape):
    """(nx, ny, nz, 3) of the voxels' centres in the world."""
    return np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]


def in_box(x, margin=0.0):
    """Whether places lie in the box of made_run, by at least a margin."""
    return ((x > made_run.LOW + margin) & (x < made_run.LOW + made_run.LENGTHS - margin)).all(axis=-1)


class Made(unittest.TestCase):
    """On a box with an affine displacement and a linear pressure."""

    @classmethod
    def setUpClass(cls):
        cls.made = made_run.write()

    def export(self, *arguments, run=None):
        """(folder, what was said)."""
        folder = pulmo.scratch("export")
        code, out, err = export(run or self.made, "--output", folder, "--format", *arguments)
        self.assertEqual(code, 0, err)
        self.assertEqual(files_in(folder), sorted(os.path.basename(line.split()[-1]) for line in out.splitlines() if " wrote " in line))
        return folder, out

    def read(self, folder, name):
        return nibabel.load(os.path.join(folder, name + ".nii.gz"))

    def test_exact_on_an_oblique_grid(self):
        affine = turned(0.4, (2.0, 1.5, 3.0), (90.0, -25.0, -15.0))
        grid = image(np.zeros((45, 60, 25), np.int16), affine)
        folder, said = self.export("nifti", "--grid", grid)
        self.assertIn("times: 0 s (start of the breath); 1 s (end of inspiration)", said)
        self.assertIn("only the boxes of lung and image were compared", said)
        self.assertEqual(files_in(folder), sorted(["lung.nii.gz", *(f"{n}_{t}s.nii.gz" for n in DEFAULT for t in (0, 1))]))
        x = places(affine, (45, 60, 25))
        lung = self.read(folder, "lung")
        self.assertEqual(lung.get_data_dtype(), np.uint8)
        inside = lung.get_fdata() > 0
        clear = in_box(x, NEAR) | ~in_box(x, -NEAR)
        np.testing.assert_array_equal(inside[clear], in_box(x)[clear])
        self.assertGreater(inside.sum(), 5000)
        u = self.read(folder, "displacement_mm_1s")
        self.assertEqual(u.shape, (45, 60, 25, 1, 3))
        self.assertEqual(u.header.get_intent()[0], "displacement vector")
        np.testing.assert_allclose(u.get_fdata()[inside][:, 0], made_run.displacement(x[inside]), atol=2e-5)
        p = self.read(folder, "alveolar_pressure_cmH2O_1s").get_fdata()
        np.testing.assert_allclose(p[inside], made_run.pressure(x[inside]), atol=1e-5)
        J, side = self.read(folder, "J_mean_1s").get_fdata(), x[..., 0] - made_run.LOW[0] - made_run.LENGTHS[0] / 2
        sure = inside & (np.abs(side) > NEAR)
        np.testing.assert_allclose(J[sure], np.where(side > 0, 1.5, 1.1)[sure], atol=1e-6)
        for name in DEFAULT:
            self.assertEqual(np.abs(self.read(folder, name + "_1s").get_fdata()[~inside]).max(), 0)
        for name in files_in(folder):
            made = nibabel.load(os.path.join(folder, name))
            np.testing.assert_allclose(made.affine, nibabel.load(grid).affine, atol=1e-5)
            np.testing.assert_allclose(made.get_qform(), nibabel.load(grid).affine, atol=1e-4)
            self.assertEqual(made.shape[:3], (45, 60, 25))

    def test_deformed(self):
        affine = turned(0.0, (2.0, 2.0, 2.0), (110.0, -40.0, -5.0))
        folder, _ = self.export("nifti", "--grid", image(np.zeros((60, 40, 40), np.int16), affine), "--shape", "deformed", "--outside", "nan",
                                "--times", "1,2")
        for time, share in ((1, 1.0), (2, 0.25)):
            moved = places(affine, (60, 40, 40))
            F = np.eye(3) + share * made_run.GRADIENT
            rest = (moved - share * made_run.SHIFT) @ np.linalg.inv(F).T
            inside = self.read(folder, f"lung_{time}s").get_fdata() > 0
            clear = in_box(rest, NEAR) | ~in_box(rest, -NEAR)
            np.testing.assert_array_equal(inside[clear], in_box(rest)[clear])
            u = self.read(folder, f"displacement_mm_{time}s").get_fdata()[..., 0, :]
            np.testing.assert_allclose(u[inside], made_run.displacement(rest[inside], share), atol=2e-5)
            self.assertTrue(np.isnan(u[~inside]).all())
            volume = np.prod(made_run.LENGTHS) * np.linalg.det(F)
            self.assertAlmostEqual(inside.sum() * 8 / volume, 1, delta=0.02)

    def test_voxels_on_faces_belong_to_a_cell(self):
        """The cells are cubes of 10 mm cut in six: with this grid most voxels lie on their faces, and on those of the box."""
        folder, _ = self.export("nifti", "--spacing", "2.5", "--fields", "J")
        lung = self.read(folder, "lung")
        x = places(lung.affine, lung.shape)
        self.assertTrue((lung.get_fdata() > 0)[in_box(x, 1e-3)].all())
        self.assertFalse((lung.get_fdata() > 0)[~in_box(x, -1e-3)].any())
        self.assertEqual(lung.get_fdata().sum() * 2.5**3, np.prod(made_run.LENGTHS))
        self.assertEqual(files_in(folder), ["J_mean_0s.nii.gz", "J_mean_1s.nii.gz", "lung.nii.gz"])

    def test_an_image_in_metres(self):
        affine = turned(0.0, (0.002, 0.002, 0.002), (0.09, -0.03, 0.0))
        folder, _ = self.export("nifti", "--grid", image(np.zeros((45, 30, 20), np.int16), affine, "meter"), "--times", "1")
        x = 1000 * places(affine, (45, 30, 20))
        made = self.read(folder, "alveolar_pressure_cmH2O_1s")
        self.assertEqual(made.header.get_xyzt_units()[0], "meter")
        np.testing.assert_allclose(made.affine, affine, atol=1e-8)
        inside = in_box(x, 0.01)
        np.testing.assert_allclose(made.get_fdata()[inside], made_run.pressure(x[inside]), atol=1e-4)

    def labels(self, factor, shift):
        """Path of a label image whose only label is the box, `factor` times as large about its middle and moved."""
        affine = turned(0.0, (2.0, 2.0, 2.0), (151.0, -71.0, -50.0))
        x = places(affine, (90, 70, 70)) - shift
        middle = made_run.LOW + made_run.LENGTHS / 2
        return image(in_box(middle + (x - middle) / factor).astype(np.uint8), affine)

    def test_fit_undoes_a_scaling(self):
        shift = np.array([6.0, 4.0, -3.0])
        labels = self.labels(1.6, shift)
        _, said = self.export("nifti", "--grid", labels, "--fields", "J", "--times", "1")
        self.assertRegex(said, r"WARNING: .* covers 2[0-9] % of them, so it is not the lung of the image .*--fit brings it back")
        folder, said = self.export("nifti", "--grid", labels, "--fit", "--times", "1")
        self.assertNotIn("WARNING", said)
        self.assertRegex(said, r"made 1\.(59|60|61)\d+ times as large")
        factor = float(said.split(" times as large")[0].split()[-1])
        mine, lung = self.read(folder, "lung").get_fdata() > 0, nibabel.load(labels).get_fdata() > 0
        self.assertGreater(2 * (mine & lung).sum() / (mine.sum() + lung.sum()), 0.98)
        middle = made_run.LOW + made_run.LENGTHS / 2
        x = places(nibabel.load(labels).affine, lung.shape)
        to = x[lung].mean(axis=0)
        rest = middle + (x[mine & lung] - to) / factor
        u = self.read(folder, "displacement_mm_1s").get_fdata()[..., 0, :][mine & lung]
        np.testing.assert_allclose(u, factor * made_run.displacement(rest), atol=2e-3)

    def test_a_lung_that_lies_on_its_image_is_not_warned_of(self):
        labels = self.labels(1.0, np.zeros(3))
        for words in (["--grid", labels], ["--grid", image(np.zeros((45, 30, 20), np.int16), turned(0, (2.0, 2.0, 2.0), (90, -30, 0))),
                                           "--labels", labels]):
            self.assertNotIn("WARNING", self.export("nifti", *words, "--times", "1", "--fields", "J")[1])

    def test_what_reaches_out_of_the_image_is_told(self):
        affine = turned(0.0, (2.0, 2.0, 2.0), (60.0, -30.0, 0.0))  # x up to 61 mm of 70
        said = self.export("nifti", "--grid", image(np.zeros((45, 30, 20), np.int16), affine), "--times", "1", "--fields", "J")[1]
        self.assertRegex(said, "WARNING: 1[0-9].[0-9] % of the lung lies outside the image")

    def test_snapshots_after_a_restart_on_other_ranks(self):
        """They number nodes and cells anew; the files keep the first numbering."""
        folders = [self.export("vtu", run=run)[0] for run in (self.made, made_run.write(shuffled=True))]
        for number in range(3):
            mine, other = (meshio.read(os.path.join(folder, f"fields_{number:05d}.vtu")) for folder in folders)
            np.testing.assert_array_equal(mine.points, other.points)
            for name, values in mine.point_data.items():
                np.testing.assert_array_equal(values, other.point_data[name])
            for name, values in mine.cell_data.items():
                np.testing.assert_array_equal(values[0], other.cell_data[name][0])

    def test_refusals(self):
        far, flat, text = (image(np.zeros(shape, np.int16), turned(0, (2.0, 2.0, 2.0), (900, 0, 0))) for shape in
                           ((9, 9, 9), (9, 9), (9, 9, 9)))
        with open(text, "w") as out:
            out.write("no image")
        huge = pulmo.scratch("huge.nii")  # a header alone
        head = nibabel.Nifti1Header()
        head.set_data_shape((30000, 30000, 3000))
        head.set_data_dtype(np.uint8)
        head.set_sform(np.eye(4), 1)
        with open(huge, "wb") as out:
            head.write_to(out)
        failed, working, empty = (self.copy() for _ in range(3))
        for folder in failed, working:
            os.rename(os.path.join(folder, "signals.csv"), os.path.join(folder, "signals.csv.part"))
            os.remove(os.path.join(folder, "summary.json"))
        with open(os.path.join(failed, "failure.json"), "w") as out:
            out.write('{"failure": "steps only crawl at t = 1 s."}')
        for name in os.listdir(empty):
            os.remove(os.path.join(empty, name))
        without = made_run.write(breaths=False)
        damaged = self.copy()
        os.remove(os.path.join(damaged, "fields_00001.h5"))
        wrong = [([pulmo.scratch(), "--format", "vtu"], "there is no directory"), ([empty, "--format", "vtu"], "no directory of a run"),
                 ([failed, "--format", "nifti"], "FAILED: steps only crawl at t = 1 s"),
                 ([working, "--format", "ventilator_csv"], "NOT FINISHED"), ([damaged, "--format", "vtu"], "fields_00001.h5"),
                 ([without, "--format", "ventilator_csv"], "no complete breath"),
                 ([self.made, "--format", "nifti", "--grid", far], "does not lie on the image: the lung at rest fills 1[0-9] … [67]"),
                 ([self.made, "--format", "nifti", "--grid", flat], "2 dimensions"),
                 ([self.made, "--format", "nifti", "--grid", text], "no NIfTI file"),
                 ([self.made, "--format", "nifti", "--grid", "gone.nii"], "no such file"),
                 ([self.made, "--format", "nifti", "--grid", far, "--fit"], "--fit needs the lungs of a label image"),
                 ([self.made, "--format", "nifti", "--fit"], "--fit needs a label image"),
                 ([self.made, "--format", "nifti", "--labels", far], "--labels .* is empty"),
                 ([self.made, "--format", "nifti", "--times", "0.7"], "only at 0, 1, 2 s"),
                 ([self.made, "--format", "nifti", "--times", "x"], "'x' is no time"),
                 ([self.made, "--format", "nifti", "--fields", "j"], "no such field; it has displacement_mm,"),
                 ([self.made, "--format", "nifti", "--spacing", "0"], "no size of voxels"),
                 ([self.made, "--format", "nifti", "--spacing", "1e-3"], "give a larger one"),
                 ([self.made, "--format", "nifti", "--spacing", "2", "--grid", far], "leave out one"),
                 ([self.made, "--format", "vtu", "--grid", far], "--grid has no meaning with --format vtu"),
                 ([self.made, "--format", "paraview", "--times", "1"], "--times has no meaning")]
        for words, reason in wrong:
            with self.subTest(words[1:]):
                folder = pulmo.scratch("export")
                code, _, err = export(*words, "--output", folder)
                self.assertEqual(code, 1)
                self.assertRegex(err, "^tools/export: error: .*" + reason)
                self.assertEqual(len(err.splitlines()), 1, err)
                self.assertFalse(os.path.exists(folder))
        # the second format fails: the first one's files go, too
        folder = pulmo.scratch("export")
        self.assertEqual(export(without, "--format", "vtu", "ventilator_csv", "--output", folder)[0], 1)
        self.assertFalse(os.path.exists(folder))
        said = self.export("vtu", "--unfinished", run=failed)[1]
        self.assertIn("WARNING: FAILED: steps only crawl", said)

    def test_files_of_the_user_stay(self):
        folder = pulmo.scratch("export")
        os.makedirs(folder)
        mine = os.path.join(folder, "lung.nii.gz")
        os.rename(image(np.zeros((45, 30, 20), np.int16), turned(0, (2.0, 2.0, 2.0), (90, -30, 0))), mine)
        with open(mine, "rb") as f:
            before = f.read()
        for grid in ["--grid", mine], ["--spacing", "5"]:
            code, _, err = export(self.made, "--format", "nifti", *grid, "--fields", "J", "--output", folder)
            self.assertEqual((code, os.listdir(folder)), (1, ["lung.nii.gz"]), err)
            self.assertIn("lung.nii.gz is there and no export made it", err)
        with open(mine, "rb") as f:
            self.assertEqual(f.read(), before)
        os.remove(mine)
        for _ in range(2):  # its own files are replaced
            self.assertEqual(export(self.made, "--format", "nifti", "--spacing", "5", "--fields", "J", "--output", folder)[0], 0)

    def copy(self):
        folder = pulmo.scratch("copy")
        shutil.copytree(self.made, folder)
        return folder


class Breath(unittest.TestCase):
    """Of a run of the test lung with a tube: the volume of an image, VTU, CSV, ParaView's script."""

    @classmethod
    def setUpClass(cls):
        cls.case = pulmo.finished(pulmo.DIRECT + pulmo.VCV + pulmo.LUNG + COARSE + ["-ventilator_tidal_volume", "200",
                                  "-ventilator_breaths", "2", "-ventilator_peep", "3", "-tube", "-tube_k1", "8"])
        cls.signals, cls.summary = cls.case.signals(), cls.case.json()
        cls.folder = os.path.join(cls.case.directory, "export")
        code, cls.said, err = export(cls.case.directory, "--format", "nifti", "vtu", "paraview", "ventilator_csv", "--spacing", "3",
                                     "--fields", "ventilation")
        assert code == 0, err

    def test_image_holds_the_volume_that_came(self):
        breath = self.summary["breaths"][1]
        volume = dict(zip(self.signals["time_s"].round(6), self.signals["volume_ml"]))
        came = volume[round(breath["end_of_inspiration_s"], 6)] - volume[round(breath["start_s"], 6)]
        image = nibabel.load(os.path.join(self.folder, f"ventilation_since_breath_start_{breath['end_of_inspiration_s']:g}s.nii.gz"))
        self.assertAlmostEqual(image.get_fdata().sum() * 27 / 1e3 / came, 1, delta=0.02)

    def test_vtu_is_what_hdf5_holds(self):
        entries = ElementTree.parse(os.path.join(self.folder, "fields.pvd")).getroot().findall(".//DataSet")
        index = ElementTree.parse(self.case.path("fields.xdmf")).getroot().findall(".//Time")
        self.assertEqual([float(e.get("timestep")) for e in entries], [float(t.get("Value")) for t in index])
        for step in range(len(entries)):
            x, cells, values = pulmo.fields(self.case, step)
            mesh = meshio.read(os.path.join(self.folder, entries[step].get("file")))
            np.testing.assert_array_equal(mesh.points, x)
            np.testing.assert_array_equal(mesh.cells_dict["tetra10"], cells)
            found = mesh.point_data | {name: v[0] for name, v in mesh.cell_data.items()}
            with h5py.File(self.case.path("fields.h5")) as file:
                np.testing.assert_array_equal(found.pop("region_number"), file["region_number"][()])
            self.assertEqual(set(found), set(values))
            for name in values:
                np.testing.assert_array_equal(found[name], values[name], err_msg=name)

    def test_vtu_names_regions_and_time(self):
        from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader
        reader = vtkXMLUnstructuredGridReader()
        reader.SetFileName(os.path.join(self.folder, "fields_00001.vtu"))
        reader.Update()
        data = reader.GetOutput().GetFieldData()
        for name, region in self.summary["regions"].items():
            self.assertEqual(data.GetArray(f"region_number_of_{name}").GetValue(0), region["number"])
        self.assertEqual(data.GetArray("TimeValue").GetValue(0), float(self.case_times()[1]))

    def case_times(self):
        return [t.get("Value") for t in ElementTree.parse(self.case.path("fields.xdmf")).getroot().findall(".//Time")]

    def breaths(self):
        """{number: (flow, pressure)} by the words of ventMAP's readme: BS, S:number, lines of two values, BE."""
        found, rows, number = {}, None, None
        with open(os.path.join(self.folder, "ventilator.csv")) as file:
            for line in file:
                if line.startswith("BS"):
                    self.assertIsNone(rows)
                    self.assertRegex(line, r"^BS, S:\d+,\n$")
                    rows, number = [], int(line.split("S:")[1].rstrip(",\n"))
                elif line.startswith("BE"):
                    found[number], rows = np.array(rows).T, None
                else:
                    flow, pressure = line.split(",")
                    rows.append((float(flow), float(pressure)))
        return found

    def test_csv_holds_the_breaths(self):
        breaths = self.breaths()
        self.assertEqual(list(breaths), [1, 2])
        rounding = 0.01 / 0.06 * 0.02
        for number, (flow, pressure) in breaths.items():
            of = self.summary["breaths"][number - 1]
            self.assertEqual(len(flow), int((of["end_s"] - of["start_s"]) / 0.02 + 1e-6))
            volume = flow / 0.06 * 0.02  # ml
            self.assertAlmostEqual(volume.cumsum().max(), of["tidal_volume_ml"], delta=rounding)
            came = np.interp(of["start_s"] + 0.02 * np.arange(len(flow) + 1), self.signals["time_s"], self.signals["volume_ml"])
            np.testing.assert_allclose(volume.cumsum(), came[1:] - came[0], atol=rounding)
            self.assertAlmostEqual(pressure.max(), of["peak_inspiratory_pressure_cmH2O"], delta=0.005)
            self.assertAlmostEqual(flow.max() / 0.06, of["peak_flow_ml_per_s"], delta=0.1)
            # the machine's side of the tube, sample by sample: at the end of each step the row's own value
            time, machine = self.signals["time_s"], self.signals["ventilator_pressure_cmH2O"]
            for i, value in enumerate(pressure):
                row = np.flatnonzero(np.abs(time - (of["start_s"] + 0.02 * (i + 1))) < 1e-7)
                if len(row):
                    self.assertAlmostEqual(value, machine[row[0]], delta=0.0051)

    def test_pressure_that_jumps_is_not_smeared(self):
        """Flow begins with a jump at the start of the breath, and with it the pressure over the tube."""
        flow, pressure = self.breaths()[1]
        start = self.summary["breaths"][0]["start_s"]
        first = int(np.searchsorted(self.signals["time_s"], start + 1e-7))
        inside = self.signals["ventilator_pressure_cmH2O"][first]
        before = self.signals["ventilator_pressure_cmH2O"][first - 1]
        self.assertGreater(inside - before, 1)
        self.assertAlmostEqual(pressure[0], inside, delta=0.0051)

    def test_paraview_script(self):
        """With a paraview.simple that notes what is called; ParaView itself is not here."""
        script = os.path.join(self.folder, "views.py")
        calls = []

        class Proxy(types.SimpleNamespace):
            def __getattr__(self, name):
                if name.startswith("__"):
                    raise AttributeError(name)
                made = Proxy(called=name)
                setattr(self, name, made)
                return made

            def __call__(self, *words, **named):
                calls.append((self.called, words, named))
                return Proxy(called=f"{self.called}()", given=named)

        simple = Proxy(called="simple")
        package = types.ModuleType("paraview")
        package.simple = simple
        with mock.patch.dict(sys.modules, {"paraview": package}), mock.patch.object(sys, "argv", [script, "picture.png"]):
            runpy.run_path(script)
        by_name = {}
        for name, words, named in calls:
            by_name.setdefault(name, []).append((words, named))
        (_, named), = by_name["Xdmf3ReaderS"]
        self.assertTrue(os.path.samefile(named["FileName"][0], self.case.path("fields.xdmf")))
        self.assertEqual([words[1] for words, _ in by_name["ColorBy"]], [("CELLS", "ventilation_since_breath_start")] +
                         3 * [("POINTS", "alveolar_pressure_cmH2O")] + [("POINTS", "displacement_mm"), None])
        self.assertEqual(len(by_name["Slice"]), 3)
        self.assertEqual(len(by_name["CreateRenderView"]), 3)
        spans = [words for words, _ in by_name["RescaleTransferFunction"]]
        values = [pulmo.fields(self.case, step)[2] for step in range(len(self.case_times()))]
        air = [v["ventilation_since_breath_start"] for v in values]
        np.testing.assert_allclose(spans[0], [np.min(air), np.max(air)])
        length = [np.linalg.norm(v["displacement_mm"], axis=1) for v in values]
        np.testing.assert_allclose(spans[-1], [np.min(length), np.max(length)])
        self.assertEqual(by_name["SaveScreenshot"][0][0][0], "picture.png")


if __name__ == "__main__":
    pulmo.main()
