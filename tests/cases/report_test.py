#!/usr/bin/python3
"""tools/report: the page of a run, of several, of one that failed or is at work, in a browser and without one."""
import html.parser
import json
import os
import re
import shutil
import subprocess
import sys
import types
import unittest
from unittest import mock

import numpy as np
from PIL import Image

import pulmo_case as pulmo

sys.path.insert(0, os.path.join(pulmo.SOURCE, "tools"))
from reports import animation, charts, cuts, page, pictures, pv_curve, run as of_run, sections  # noqa: E402

COARSE = ["-elements", "P1-P1", "-ts_dt", "0.1"]
WEIGHT = ["-gravity", "-gravity_direction", "0,-1,0", "-tissue_porosity", "0.75"]
EVIL = '"><img src=x onerror=alert(1)></script><script>alert(2)</script>'
VOID = {"meta", "link", "img", "br", "input", "path"}


def tool(*arguments):
    return subprocess.run([os.path.join(pulmo.SOURCE, "tools/report"), *map(str, arguments)], env=pulmo.ENVIRONMENT,
                          capture_output=True, text=True, timeout=300)


def called(*arguments):
    """What tool() gives, without a new Python."""
    return pulmo.tool_called("report", *arguments)


def written(*directories):
    """The page of some runs without the time that pictures take."""
    dot = "data:image/png;base64,AAAA", "a dot in the place of a picture", 0, 1
    with mock.patch.object(pictures, "lung", lambda run: dot), mock.patch.object(pictures, "eit", lambda *_: dot[0]), \
            mock.patch.object(pictures, "sections", lambda run, quantity: dot if run.fields.shape(0) is not None else None):
        return page.page(of_run.load(directories))


class Page(html.parser.HTMLParser):
    """What a browser makes of the text: elements in their order, each with attributes and text."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append({"tag": tag, "text": "", "within": [e["tag"] for e in self.open]} | dict(attributes))
        if tag not in VOID:
            self.open.append(self.elements[-1])

    def handle_endtag(self, tag):
        while self.open and self.open.pop()["tag"] != tag:
            pass

    def handle_data(self, data):
        for element in self.open:
            element["text"] += data

    def all(self, *tags):
        return [e for e in self.elements if e["tag"] in tags]

    def section(self, name):
        return next(e for e in self.all("section") if e["id"] == name)

    def table(self, label):
        """Rows of the table in the region with that label, as texts."""
        begin = next(i for i, e in enumerate(self.elements) if e.get("aria-label") == f"Table: {label}")
        rows = []
        for element in self.elements[begin + 2:]:
            if element["tag"] == "table":
                break
            if element["tag"] == "tr":
                rows.append([])
            elif element["tag"] in ("th", "td") and "table" in element["within"]:
                rows[-1].append(" ".join(element["text"].split()))
        return rows


def number(text):
    return float(text.replace("−", "-"))


class Runs(unittest.TestCase):
    """A lung that breathes once, a litre that breathes otherwise, a run that failed, one that is at work; their pages."""

    @classmethod
    def setUpClass(cls):
        cls.case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + WEIGHT + pulmo.LUNG + COARSE +
                                  ["-output_fields_every", "0.5", "-ventilator_pause", "0.2", "-tube", "-tube_k1", "4"])
        cls.other = pulmo.finished(pulmo.DIRECT + pulmo.VCV + pulmo.LITRE + COARSE +
                                   ["-ventilator_tidal_volume", "80", "-ventilator_peep", "2", "-error_estimate", "-sensitivities",
                                    "C_rs,PIP"])
        cls.failed = pulmo.Case(pulmo.DIRECT + pulmo.CUBE + ["-airflow", "-chest_wall", "-snes_max_it", "1", "-ts_dt", "0.1"] +
                                pulmo.programme("rest 0.2 pressure 0\npush 0.2 pressure 5\n"))
        assert cls.failed.code == 2, cls.failed.tail()
        cls.text = page.page(of_run.load([cls.case.directory]))
        cls.page = Page(cls.text)
        cls.pair = written(cls.case.directory, cls.other.directory)

    def copy(self, case, name="copy"):
        to = pulmo.scratch(name)
        shutil.copytree(case.directory, to)
        return to

    def test_numbers_are_those_of_the_summary(self):
        summary = self.case.json()
        shown = {e["data-key"]: e for e in self.page.all("td") if "data-key" in e}
        defined = {key for key, value in summary["breaths"][0].items() if isinstance(value, float) and not key.endswith(
            ("start_s", "end_s", "end_of_inspiration_s"))} | {"functional_residual_capacity_ml"}
        self.assertGreater(len(defined), 15)
        self.assertEqual(set(shown), defined)
        for key, cell in shown.items():
            self.assertEqual(float(cell["data-value"]), summary[key], key)
            self.assertAlmostEqual(number(cell["text"]), summary[key], delta=1e-4 * abs(summary[key]), msg=key)
        heads, row = self.page.table("breaths of " + os.path.basename(self.case.directory))
        self.assertEqual(len(heads), len(row))
        for head, value in zip(heads[2:], row[2:]):
            words = head.rpartition(" (")[0] if head.count("(") < 2 else head[:head.rindex(" (")]
            key = next(key for key, (name, _) in sections.numbers.ROWS.items() if name == words)
            self.assertAlmostEqual(number(value), summary[key], delta=1e-4 * abs(summary[key]), msg=head)

    def test_regions_energy_and_facts_are_those_of_the_summary(self):
        summary, name = self.case.json(), os.path.basename(self.case.directory)
        rows = self.page.table(f"regions of {name}")[1:]
        self.assertEqual([row[0] for row in rows], list(summary["regions"]))
        for row in rows:
            self.assertAlmostEqual(number(row[2]), summary["regions"][row[0]]["ventilation_ml"], delta=0.05)
        thirds = {row[0]: row for row in self.page.table(f"thirds along gravity of {name}")[1:]}
        for third in "dependent", "middle", "nondependent":
            self.assertAlmostEqual(number(thirds[third][2]), summary["gravity"][third]["ventilation_ml"], delta=0.05)
        rows = self.page.table(f"energy balance of {name}")[1:]
        words = {row[1]: row for row in rows}
        for key, value in summary["energy_j"].items():
            if not key.startswith("residual"):
                shown = words[sections.energy.words(key)]
                self.assertAlmostEqual(number(shown[2]), value, delta=1e-4 * abs(value), msg=key)
        terms = [row for row in rows if row[0] in "+−" and row[0]]
        for column, energy in ((2, summary["energy_j"]), (4, summary["breaths"][0]["inspiratory_energy_j"])):
            total = sum(number(row[column]) * (1 if row[0] == "+" else -1) for row in terms)
            self.assertAlmostEqual(total, 0, delta=1e-4 * energy["ventilator_work"])
        sections_ = {s: Page(self.text).section(s)["text"] for s in ("facts", "scene")}
        self.assertIn(str(summary["cells"]), sections_["facts"])
        self.assertIn(str(summary["dofs"]), sections_["facts"])

    def test_scene_is_what_scene_view_says(self):
        told = pulmo.finished(pulmo.DIRECT + pulmo.PCV + WEIGHT + pulmo.LUNG + COARSE +
                              ["-ventilator_pause", "0.2", "-tube", "-tube_k1", "4", "-scene_view_only"]).out
        told = told[told.index("In this scene\n") + 14:told.index("Not in this scene\n")].strip().splitlines()
        words = lambda text: re.sub(r"\W+", " ", text.replace("₂", "2").replace("²", "^2").replace("³", "^3")).strip()  # noqa: E731
        said = [(e["tag"], words(e["text"])) for e in self.page.elements if e["tag"] in ("dt", "dd") and "section" in e["within"]]
        lines = {name: what for (tag, name), (_, what) in zip(said[:-1], said[1:]) if tag == "dt"}
        self.assertGreaterEqual(len(told), 6)
        for line in told:
            name, _, rest = line.strip().partition(": ")
            self.assertEqual(words(rest), lines[name])

    def test_the_command_gives_the_same_run(self):
        command = next(e["text"] for e in self.page.all("pre"))
        words = command.replace("\\\n", " ").split()
        self.assertEqual(words[0], "pulmo")
        again = pulmo.finished(words[1:words.index("-output_dir")])
        self.assertEqual(again.json()["tidal_volume_ml"], self.case.json()["tidal_volume_ml"])

    def test_fit_misses_what_it_says(self):
        """Against eq. 52 with numpy on the rows of the breath."""
        rows, summary = self.case.signals(), self.case.json()
        breath = summary["breaths"][0]
        start = np.flatnonzero(rows["time_s"] <= breath["start_s"] + 1e-9)[-1]
        t, p = rows["time_s"], rows["ventilator_pressure_cmH2O"]
        fit = breath["peep_cmH2O"] + (rows["volume_ml"] - rows["volume_ml"][start]) / summary["compliance_ml_per_cmH2O"] \
            + summary["resistance_cmH2O_s_per_l"] * rows["flow_ml_per_s"] / 1000
        weights = np.diff(t)[start:]
        rms = np.sqrt(np.average((p - fit)[start + 1:] ** 2, weights=weights))
        said = re.search(r"misses the pressure by ([\d.e-]+)", self.page.section("fit")["text"])
        self.assertAlmostEqual(float(said[1]) / rms, 1, delta=0.01)

    def test_error_bars(self):
        summary = self.other.json()
        shown = Page(written(self.other.directory))
        rows = {row[0]: row for row in shown.table("clinical numbers")}
        for key in "tidal_volume_ml", "compliance_ml_per_cmH2O", "peak_inspiratory_pressure_cmH2O":
            row, bar = rows[sections.numbers.ROWS[key][0]], summary["error_estimate"]["numbers"][key]["error"]
            self.assertAlmostEqual(number(row[2].removeprefix("± ")), bar, delta=0.06 * abs(bar), msg=key)

    def test_sensitivities_are_those_of_the_summary(self):
        told = self.other.json()["sensitivities"]["numbers"]
        shown = Page(page.page(of_run.load([self.other.directory]))).section("sensitivities")["text"]
        parameters = told["compliance_ml_per_cmH2O"]["parameters"]
        self.assertGreater(len(parameters), 5)
        for option, one in parameters.items():
            self.assertIn(option, shown)
            self.assertIn(f"{one['percent_for_one_percent_more']:+.2f}".replace("-", "−"), shown, option)
        self.assertIn("-sensitivities", self.page.section("sensitivities")["text"], "how to get them")

    def test_two_runs_side_by_side(self):
        names = [os.path.basename(os.path.abspath(c.directory)) for c in (self.case, self.other)]
        names = names if names[0] != names[1] else [self.case.directory, self.other.directory]
        shown = Page(self.pair)
        values = {(e["data-run"], e["data-key"]): float(e["data-value"]) for e in shown.all("td") if "data-key" in e}
        for name, case in zip(names, (self.case, self.other)):
            self.assertEqual(values[name, "tidal_volume_ml"], case.json()["tidal_volume_ml"])
        heads, *rows = shown.table("clinical numbers")
        row = next(row for row in rows if row[0] == "Tidal volume")
        column = heads.index(f"Difference from {names[0]}")
        change = self.other.json()["tidal_volume_ml"] - self.case.json()["tidal_volume_ml"]
        self.assertAlmostEqual(number(row[column].split(" ")[0]), change, delta=0.005 * abs(change))
        for data in self.data(shown, "waveform-airway"), self.data(shown, "loop-pressure-volume"):
            self.assertEqual([c["label"] for c in data["curves"] if "ventilator" not in c["label"]], names)
        self.assertEqual(len([e for e in shown.all("details") if e.get("class") == "of-run"]) % 2, 0)

    @staticmethod
    def data(shown, name):
        return json.loads(next(e["text"] for e in shown.all("script") if e.get("data-chart") == name))

    def test_curves_are_those_of_the_signals(self):
        rows = self.case.signals()
        flow = self.data(self.page, "waveform-flow")["curves"][0]
        self.assertTrue(flow["stepped"])
        np.testing.assert_allclose(flow["x"], rows["time_s"], rtol=1e-6)
        np.testing.assert_allclose(flow["y"], rows["flow_ml_per_s"], rtol=1e-6, atol=1e-9)
        pressure = self.data(self.page, "waveform-airway")
        at_machine = next(c for c in pressure["curves"] if "ventilator" in c["label"])
        drawn = [(x, y) for x, y in zip(at_machine["x"], at_machine["y"]) if y is not None]
        np.testing.assert_allclose([y for _, y in drawn], rows["ventilator_pressure_cmH2O"], rtol=1e-6, atol=1e-9)
        self.assertEqual([s[0] for s in pressure["shades"]], list(dict.fromkeys(rows["phase"])))

    def test_a_jump_is_not_drawn(self):
        run = types.SimpleNamespace(signals={"p": [0, 5, 5, 5, 1, 1, 1, 2], "phase": ["a", "a", "a", "a", "b", "b", "b", "b"]})
        self.assertEqual(charts.jumps(run, "p"), [1, 4])
        run.signals["p"] = [0, 1, 2, 3, 4, 5, 6, 7]
        self.assertEqual(charts.jumps(run, "p"), [])

    def test_peep_trial(self):
        """A row for each level; with several regions, columns of theirs."""
        run = pulmo.finished(pulmo.DIRECT + pulmo.options_file("scenes/peep_trial.opts") + pulmo.LUNG + ["-elements", "P1-P1", "-ts_dt", "0.5"])
        levels = run.json()["peep_trial"]["levels"]
        self.assertIn("open_share", levels[0]["regions"]["right_lung"])
        heads, *rows = Page(written(run.directory)).table("PEEP trial")
        self.assertEqual(heads[:4], ["PEEP (cmH2O)", "Breath", "Compliance (ml/cmH2O)", "End expiratory volume (ml)"])
        self.assertEqual([number(row[0]) for row in rows], [level["peep_cmH2O"] for level in levels])
        for row, level in zip(rows, levels):
            self.assertAlmostEqual(number(row[heads.index("Open share")]), level["open_share"], delta=1e-4)
            self.assertAlmostEqual(number(row[2]) / level["compliance_ml_per_cmH2O"], 1, delta=1e-4)
        levels[0]["regions"]["left_lung"] = {"open_share": 0.25}
        told = sections.breaths.peep_trial({"levels": levels})
        self.assertEqual(told["rows"][0][told["heads"].index("Open share, left_lung")], "0.25")
        self.assertEqual(told["rows"][1][told["heads"].index("Open share, left_lung")], "–")

    def test_a_failed_run_and_one_at_work_say_so_first(self):
        for state, words in (("failed", "failed"), ("unfinished", "not finished")):
            with self.subTest(state=state):
                directory = self.copy(self.failed)
                if state == "unfinished":
                    os.remove(os.path.join(directory, "failure.json"))
                    with open(os.path.join(directory, "signals.csv.part"), "a") as f:
                        f.write("0.3,1.5")  # a row at the moment of its writing
                shown = Page(written(directory))
                body = shown.elements[next(i for i, e in enumerate(shown.elements) if e["tag"] == "h1") + 1]
                self.assertIn(f"state {state}", body["class"])
                self.assertIn(words, body["text"])
                self.assertIn("tetrahedra", shown.section("scene")["text"])
                self.assertIn("-ventilator_programme", shown.section("again")["text"])
                self.assertIn("steps only crawl" if state == "failed" else "up to t = 0.2", body["text"])
                self.assertEqual(len(self.data(shown, "waveform-volume")["curves"][0]["x"]), len(self.failed.signals("signals.csv.part")["time_s"])
                                 if state == "failed" else len(of_run.load([directory])[0].time))

    def test_command_line(self):
        directory = self.copy(self.failed)
        made = tool(directory)  # as a user calls it
        self.assertEqual(made.returncode, 0, made.stderr)
        self.assertIn("report: FAILED: steps only crawl", made.stdout)
        self.assertIn("report.html", os.listdir(directory))
        figure = os.path.join(directory, "figure.svg")
        made = called(directory, "--figure", figure)
        self.assertEqual(made.returncode, 0, made.stderr)
        with open(figure) as f:
            self.assertIn("<svg", f.read())
        for arguments, word in (([pulmo.scratch()], "no directory"), ([directory, "--output", "a.png"], "--figure"),
                                ([directory, "--figure", "a.gif"], ".png"), ([directory, directory], "twice"),
                                ([directory, "--output", "/no/such/folder/a.html"], "cannot write")):
            refused = called(*arguments)
            self.assertEqual(refused.returncode, 1, arguments)
            self.assertIn(word, refused.stderr)
            self.assertEqual(len(refused.stderr.splitlines()), 1, refused.stderr)

    def test_animation_shows_each_snapshot_as_long_as_it_was(self):
        path = pulmo.scratch("breath.gif")
        made = called(self.case.directory, "--animation", path)
        self.assertEqual(made.returncode, 0, made.stderr)
        times = of_run.load([self.case.directory])[0].fields.times
        self.assertIn(f"{len(times)} frames", made.stdout)
        with Image.open(path) as picture:
            self.assertEqual(picture.n_frames, len(times))
            for frame, span in enumerate(np.diff(times)):
                picture.seek(frame)
                self.assertAlmostEqual(picture.info["duration"] / 1000, span, delta=0.011)  # GIF counts hundredths of a second
        self.assertFalse(os.path.exists(os.path.join(self.case.directory, "report.html")))

    def test_animation_refuses_what_it_cannot_make(self):
        path = pulmo.scratch("breath.mp4")
        with mock.patch.object(animation.shutil, "which", lambda name: None):
            for words, said in ((["--animation", path], "ffmpeg"), (["--animation", "a.avi"], ".gif"), ([self.other.directory, "--animation", "a.gif"], "one run")):
                refused = called(self.case.directory, *words)
                self.assertEqual((refused.returncode, len(refused.stderr.splitlines())), (1, 1), refused.stderr)
                self.assertIn(said, refused.stderr)
        self.assertEqual(os.listdir(os.path.dirname(path)), [])

    def test_damaged_fields_cost_their_sections_only(self):
        for what, how in (("fields.xdmf", lambda path: os.truncate(path, 200)), ("fields.h5", os.remove), ("fields_00000.h5", os.remove)):
            with self.subTest(what=what):
                directory = self.copy(self.case)
                how(os.path.join(directory, what))
                shown = Page(written(directory))
                self.assertIn(what, shown.section("slices")["text"])
                self.assertIn("Tidal volume", shown.section("numbers")["text"])

    def test_text_of_files_is_escaped(self):
        directory = self.copy(self.case, "a<b>&c")
        summary = self.case.json()
        summary["options"]["-dm_plex_filename"] = summary["version"] = summary["tissue"] = summary["elements"] = EVIL
        summary["option_sources"]["-dm_plex_filename"] = EVIL
        summary["regions"][EVIL] = dict(summary["regions"]["right_lung"], connected_body=False)
        summary["surface_areas_mm2"][EVIL] = 1.0
        summary["ledger"][0]["terms"] = [EVIL]
        with open(os.path.join(directory, "summary.json"), "w") as f:
            json.dump(summary, f)
        scene = self.case.json("scene.json")
        scene["effects"][0] = dict(scene["effects"][0], name=EVIL, words=EVIL, settings=[{"name": EVIL, "value": EVIL, "unit": EVIL}])
        scene["mesh"][0] = scene["breathing"][0] = EVIL
        with open(os.path.join(directory, "scene.json"), "w") as f:
            json.dump(scene, f)
        with open(os.path.join(directory, "signals.csv")) as f:
            text = f.read().replace("inspiration", EVIL.replace('"', "")).replace(",expiration", ",</script>")
        with open(os.path.join(directory, "signals.csv"), "w") as f:
            f.write(text)
        text = written(directory)
        self.assertNotIn("<img src=x", text)
        self.assertNotIn("<script>alert", text)
        shown = Page(text)
        self.assertEqual(len(shown.all("script")), len(self.page.all("script")))
        self.assertEqual([e for e in shown.elements for name in e if name.startswith("on")], [])
        self.assertIn(EVIL, shown.section("scene")["text"])
        self.assertIn("a<b>&c", shown.all("title")[0]["text"])

    def test_page_stands_alone(self):
        self.assertLess(len(self.text.encode()), page.MOST)
        self.assertLess(len(self.pair.encode()), page.MOST)
        for element in Page(self.pair).elements:
            for name in "src", "href", "action", "data", "srcset", "poster":
                if element["tag"] != "details" and name in element:
                    self.assertRegex(element[name], r"^(data:image/|#)", element)
        style = "".join(e["text"] for e in self.page.all("style"))
        self.assertNotRegex(style, r"url\(|@import")
        policy = next(e["content"] for e in self.page.all("meta") if "http-equiv" in e)
        self.assertIn("default-src 'none'", policy)
        self.assertNotIn("http", policy)

    def test_a_page_too_large_goes_without_the_surface(self):
        most, page.MOST = page.MOST, 700000
        try:
            text = written(self.case.directory)
        finally:
            page.MOST = most
        self.assertIn("Left out to keep the page small", Page(text).section("surface")["text"])
        self.assertLess(len(text), 600000)

    def test_for_all_readers(self):
        for text in self.text, self.pair:
            shown = Page(text)
            self.assertEqual(shown.all("html")[0]["lang"], "en")
            self.assertTrue(any(e.get("name") == "viewport" for e in shown.all("meta")))
            levels = [int(e["tag"][1]) for e in shown.all("h1", "h2", "h3", "h4")]
            self.assertEqual(levels.count(1), 1)
            self.assertTrue(all(b - a <= 1 for a, b in zip(levels, levels[1:])), levels)
            for element in shown.all("img"):
                self.assertGreater(len(element["alt"]), 20)
            for element in shown.all("canvas"):
                self.assertTrue(element.get("aria-label") or element.get("aria-hidden") == "true")
            for element in shown.all("th"):
                self.assertIn(element["scope"], ("row", "col"))
                self.assertTrue(element["text"].strip())
            for element in shown.all("select", "input"):
                self.assertIn("label", element["within"])
            ids = [e["id"] for e in shown.elements if "id" in e]
            self.assertEqual(len(ids), len(set(ids)))
            for element in shown.all("a"):
                self.assertIn(element["href"][1:], ids)
            for element in shown.all("code"):  # a browser breaks a line behind a dash, unless it is the line's first
                self.assertTrue("td" not in element["within"] or "td code { display: block; }" in text)
            self.assertEqual({e["tag"] for e in shown.all("header", "nav", "main", "footer")}, {"header", "nav", "main", "footer"})


PROBE = """<script>
window.addEventListener('load', () => setTimeout(() => {
  const drawn = {};
  for (const canvas of document.querySelectorAll('canvas')) {
    const blank = document.createElement('canvas');
    blank.width = canvas.width; blank.height = canvas.height;
    const small = document.createElement('canvas');
    small.width = small.height = 64;
    const pen = small.getContext('2d');
    pen.drawImage(canvas, 0, 0, 64, 64);
    const colours = new Set(new Uint32Array(pen.getImageData(0, 0, 64, 64).data.buffer));
    drawn[canvas.id] = canvas.offsetParent === null ? -1 : colours.size;
  }
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const tell = (axe) => { document.title = JSON.stringify({drawn, wide, axe}); };
  if (!window.axe) { tell(null); return; }
  // the rows of a table are alike: three of each tell axe all, and take it less time
  document.querySelectorAll('tbody').forEach((body) => Array.from(body.rows).slice(3).forEach((row) => row.remove()));
  document.querySelectorAll('details').forEach((one) => { one.open = true; });
  axe.run().then((found) => tell(found.violations.map((v) => v.id + ': ' + v.nodes[0].html.slice(0, 200))));
}, 500));
</script>"""


@unittest.skipUnless(shutil.which("chromium"), "SKIPPED: no chromium here; the page was not opened in a browser")
class Browser(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        if not hasattr(Runs, "text"):
            Runs.setUpClass()

    def opened(self, text, width=1200, height=2500):
        """(what the probe saw, messages of the console, screenshot) of a page in Chromium."""
        axe = os.environ.get("PULMO_AXE", "/usr/share/javascript/axe-core/axe.min.js")
        extra = PROBE
        if os.path.exists(axe):
            with open(axe) as f:
                extra = f"<script>{page.script(f.read())}</script>" + PROBE
        else:
            print("SKIPPED: axe-core is not here (PULMO_AXE names its axe.min.js); only the checks of this test were made", file=sys.stderr)
        directory = os.path.dirname(pulmo.scratch())
        path, picture = os.path.join(directory, "page.html"), os.path.join(directory, "page.png")
        with open(path, "w") as f:
            f.write(text.replace("</body>", extra + "</body>"))
        run = subprocess.run(["chromium", "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                              f"--user-data-dir={directory}/profile", f"--window-size={width},{height}", "--hide-scrollbars",
                              "--virtual-time-budget=6000", "--enable-logging=stderr", f"--screenshot={picture}", "--dump-dom",
                              f"file://{path}"], capture_output=True, text=True, timeout=300)
        title = re.search(r"<title>(.*?)</title>", run.stdout, re.DOTALL)
        self.assertTrue(title, run.stderr[-2000:])
        seen = json.loads(html.unescape(title[1]))
        return seen, re.findall(r"CONSOLE[^\n]*", run.stderr), Image.open(picture).convert("RGB")

    def test_draws_without_a_word_on_the_console(self):
        seen, console, picture = self.opened(Runs.text)
        self.assertEqual(console, [])
        self.assertFalse(seen["axe"])
        visible = {name: colours for name, colours in seen["drawn"].items() if colours >= 0}
        self.assertIn("run1-view", visible)
        self.assertGreaterEqual(len(visible), 10)
        for name, colours in visible.items():
            self.assertGreater(colours, 20 if name == "run1-view" else 4, name)
        self.assertGreater(len(set(picture.resize((300, 600)).getdata())), 50)

    def test_several_runs_on_a_narrow_screen(self):
        seen, console, _ = self.opened(Runs.pair, width=500)
        self.assertEqual(console, [])
        self.assertFalse(seen["axe"])
        self.assertLessEqual(seen["wide"], 0)
        for name, colours in seen["drawn"].items():
            self.assertTrue(colours == -1 or colours > 4, name)


class Geometry(unittest.TestCase):
    """Sections and images of a block whose answers are known."""

    @classmethod
    def setUpClass(cls):
        n = 6
        grid = np.stack(np.meshgrid(*[np.linspace(0, size, n + 1) for size in (120, 80, 100)], indexing="ij"), -1).reshape(-1, 3)
        corner = lambda i, j, k: (i * (n + 1) + j) * (n + 1) + k  # noqa: E731
        cells = []
        for i, j, k in np.ndindex(n, n, n):
            v = [corner(i + a, j + b, k + c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
            cells += [[v[0], v[a], v[b], v[7]] for a, b in ((4, 6), (6, 2), (2, 3), (3, 1), (1, 5), (5, 4))]
        cls.points, cls.cells = grid, np.array(cells)
        edges = grid[cls.cells[:, 1:]] - grid[cls.cells[:, :1]]
        cls.volumes = np.abs(np.linalg.det(edges)) / 6
        cls.middles = grid[cls.cells].mean(axis=1)

    def run_of(self, came):
        values = {0: np.ones(len(self.cells)), 1: 1 + came}
        fields = types.SimpleNamespace(points=self.points, cells=self.cells, volumes=self.volumes, values=lambda name, s: values[s])
        fields.lattice = of_run.fields.Fields.lattice.func(fields)
        return types.SimpleNamespace(fields=fields, full=(0, 1))

    def test_sections_have_the_area_of_the_block(self):
        for axis, place, area in ((0, 33.3, 8000), (1, 40, 12000), (2, 50.1, 9600)):
            polygons, cells = cuts.cut(self.points, self.cells, axis, place)
            total = 0
            for polygon in polygons:
                flat = np.delete(polygon, axis, axis=1) - np.delete(polygon[0], axis)
                x, y = flat.T
                total += abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
                self.assertLess(np.abs(polygon[:, axis] - place).max(), 1e-9)
            self.assertAlmostEqual(total / area, 1, delta=1e-9)

    def test_fewer_triangles_keep_the_shape(self):
        fields = types.SimpleNamespace(points=self.points, cells=self.cells)
        triangles, cells = of_run.fields.Fields.surface.func(fields)
        self.assertEqual(len(triangles), 6 * 2 * 36)

        def volume(triangles):
            a, b, c = (self.points[triangles[:, k]] for k in range(3))
            return np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        self.assertGreater(abs(volume(triangles)), 0.999 * 960000)
        fewer, behind = cuts.rarer(self.points, triangles, cells, 200)
        self.assertLessEqual(len(fewer), 200)
        self.assertEqual(len(fewer), len(behind))
        self.assertGreater(abs(volume(fewer)), 0.8 * 960000)

    def test_image_of_a_belt(self):
        image, shares, thickness = sections.eit.belt(self.run_of(np.full(len(self.cells), 0.25)))
        self.assertAlmostEqual(thickness, 25, delta=1e-9)
        self.assertAlmostEqual(image.sum() / (0.25 * 120 * 80 * 25 / 1000), 1, delta=0.02)
        index, (column, row) = sections.eit.measures(image, shares)
        self.assertLess(index, 0.05)
        self.assertAlmostEqual(column, 15.5, delta=0.2)
        self.assertAlmostEqual(row, 15.5, delta=0.2)
        # all of it at the back, on the right: the first rows of the image are the front, the first columns the right
        came = np.where((self.middles[:, 1] < 40) & (self.middles[:, 0] > 60), 0.25, 0)
        image, shares, _ = sections.eit.belt(self.run_of(came))
        _, (column, row) = sections.eit.measures(image, shares)
        self.assertLess(column, 12)
        self.assertGreater(row, 18)

    def test_global_inhomogeneity_of_two_halves(self):
        image = np.ones((32, 32))
        image[:, 16:] = 3  # median 2, so |v - median| is 1 everywhere
        index, centre = sections.eit.measures(image, np.ones((32, 32)))
        self.assertAlmostEqual(index, 0.5, delta=1e-12)
        self.assertAlmostEqual(centre[0], (7.5 * 1 + 23.5 * 3) / 4, delta=1e-12)
        self.assertAlmostEqual(centre[1], 15.5, delta=1e-12)

    def test_profile_of_a_gradient(self):
        middle, came, held = sections.regions.profile(self.run_of(0.1 + 0.004 * self.middles[:, 2]), 2)
        self.assertEqual(len(middle), sections.regions.BINS)
        self.assertAlmostEqual(held.sum(), 960, delta=1e-6)
        # cells are sixths of the block high: the profile is that of their steps, within one of them
        self.assertLess(np.abs(came - (0.1 + 0.004 * middle)).max(), 0.004 * 100 / 6 / 2 + 1e-9)
        self.assertAlmostEqual(float(came @ held / held.sum()), 0.3, delta=1e-9)


class StaticCurve(unittest.TestCase):
    def test_finds_where_a_static_curve_bends(self):
        pressure = np.linspace(0, 40, 15)

        def said(volume, P=pressure):
            return pv_curve.describe({"static_curve": [{"pressure_cmH2O": p, "volume_ml": v} for p, v in zip(P, volume)]})

        c, d, b = 18.0, 5.0, 2000.0
        whole = pv_curve.sigmoid(pressure, 100, b, c, d)
        back = np.append(whole, np.minimum(whole[-2::-1] + 50, whole[-1] - 1))  # and a deflation limb, which does not count
        for lines in said(whole), said(back, np.append(pressure, pressure[-2::-1])):
            self.assertEqual(lines, ["static curve: largest compliance 100 ml/cmH2O at 18.0 cmH2O", "lower inflection point 8.0 cmH2O",
                                     "upper inflection point 28.0 cmH2O"])
        self.assertIn("no upper inflection point between 0.0 and 20.0 cmH2O", said(whole[:8], pressure[:8]))
        self.assertIn("take these numbers with care", " ".join(said(whole + 100 * np.cos(pressure))))
        self.assertEqual(said(whole[:5], pressure[:5]), [])
        self.assertEqual(said(np.zeros(15)), [])
        self.assertEqual(pv_curve.describe({}), [])


if __name__ == "__main__":
    pulmo.main()
