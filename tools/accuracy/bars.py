"""Error bars of -error_estimate held against true errors.

Scenes and their truth:
  block         24 cells, every tissue law; in time: steps 32 times as short with BDF2, in space: cells a quarter of the size
  sphere        an octant of the hollow sphere; in all: the radial solver
  lung          one lung of 1,324 cells; in time and in space as the block
  manufactured  a manufactured finite-strain breath; in all: its closed form (tests/verification/manufactured_breath)
"""
import json
import statistics
from pathlib import Path

from benchmarks import runs
from shared.common import PAPER, SCENES, SOLVERS, SOURCE, environment, fail, markdown, require, tissue_laws, write_csv
from shared.keys import printed

from . import truth
from .numbers import short
from .sphere import ROLLERS, exact, octant

NUMBERS = ["tidal_volume_ml", "peak_flow_ml_per_s", "peak_expiratory_flow_ml_per_s", "compliance_ml_per_cmH2O",
           "resistance_cmH2O_s_per_l", "time_constant_s", "work_j", "auto_peep_cmH2O",
           "trapped_volume_ml"]  # none is another one up to a factor
METHODS = ["runs", "sweep"]
SCHEMES = {"backward Euler": [], "BDF2": ["-ts_type", "bdf"]}
QUIET = ["-progress", "off", "-energy_audit", "off"]


class Study:
    def __init__(self, build, folder):
        self.build, self.folder, self.rows, self.unresolved = build, folder, [], 0

    def run(self, options):
        """The summary of a run."""
        command = [self.build / "pulmo", *options, *QUIET, "-output_dir"]
        result = runs.measured(command, self.folder / "runs")
        print(f"  {result['cpu']:6.1f} s CPU{' (kept)' if result['kept'] else ''}  {' '.join(map(str, options[-8:]))}", flush=True)
        if result["code"]:
            fail(f"{result['reason']}; see {result['folder']}")
        return result["summary"]

    def compare(self, method, scene, part, bars, true):
        """A row for each number that the scene leaves free: bars[key] -> (value, bar), true[key] -> value. Of a sweep a number may have no
        bar: it counts as not resolved."""
        for key in NUMBERS:
            if key not in bars or true.get(key) is None:
                continue
            value, bar = bars[key]
            error = abs(value - true[key])
            if bar is None and method == "sweep" and error > 1e-9 * abs(value):
                self.unresolved += 1
            if bar is not None and max(bar, error) > 1e-9 * abs(value):
                self.rows.append({"method": method, "scene": scene, "part": part, "number": key, "value": value, "error": error, "bar": bar,
                                  "effectivity": bar / error if error else float("inf"), "held": bar >= error})

    def against_finer(self, scene, options, dt, steps=True, cells=True):
        """Both parts for both schemes (space: once), against runs far finer in that direction alone."""
        for scheme, words in SCHEMES.items():
            runs_of, sweep = (self.estimate([*options, "-ts_dt", str(dt), *words], method) for method in METHODS)
            if steps:
                true = self.run([*options, "-ts_dt", str(dt / 32), *SCHEMES["BDF2"]])
                for method, estimate in zip(METHODS, (runs_of, sweep)):
                    self.compare(method, f"{scene}, {scheme}", "time", {k: (b["value"], b["time"]) for k, b in estimate.items()}, true)
            if cells and scheme == "backward Euler":
                coarse = self.run([*options, "-ts_dt", str(4 * dt)])
                true = self.run([*options, "-ts_dt", str(4 * dt), "-dm_refine", "2"])
                self.compare("runs", scene, "space", {k: (coarse[k], b["space"]) for k, b in runs_of.items()}, true)
                swept = self.estimate([*options, "-ts_dt", str(4 * dt)], "sweep")
                self.compare("sweep", scene, "space", {k: (b["value"], b["space"]) for k, b in swept.items()}, true)

    def estimate(self, options, method):
        """The numbers of a run with their bars."""
        return self.run([*options, "-error_estimate", "-error_estimate_method", method])["error_estimate"]["numbers"]


def block(study):
    for law in tissue_laws(study.build / "pulmo"):
        mesh = ["-dm_plex_filename", SOURCE / "meshes/cube_coarse.msh", "-mesh_scale", "100"]
        study.against_finer(f"block, {law}", ["-options_file", SOLVERS / "direct.opts", *mesh, "-tissue", law, "-airflow",
                            "-airflow_permeability", "100", "-airflow_surfaces", "x1", "-chest_wall", "-chest_wall_surfaces",
                            "x0,y0,y1,z0,z1", "-lumen_pressure", "-lumen_pressure_surfaces", "x1", "-ventilator", "pcv",
                            "-ventilator_pip", "8", "-ventilator_inspiration", "0.8", "-ventilator_expiration", "0.8",
                            "-ventilator_ramp", "0.2", "-ventilator_ramp_down", "0.2"], 0.05)


def lung(study):
    study.against_finer("lung, birzle", ["-options_file", SCENES / "pcv.opts", *PAPER, "-options_file",
                        SOLVERS / "iterative.opts", "-ventilator_ramp_down", "0.1", "-dm_plex_filename",
                        SOURCE / "meshes/lung_test.msh"], 0.05)


def sphere(study):
    numbers = truth.numbers()
    true = {key: exact(key, numbers) for key in numbers}
    meshes = {divisions: octant(study.folder, divisions)[0] for divisions in (4, 6)}
    for scheme, words in SCHEMES.items():
        for dt in (0.1, 0.05):
            for divisions, other in ((6, 4), (4, 6)):
                options = ["-options_file", SOLVERS / "direct.opts", "-options_file", SCENES / "hollow_sphere.opts", *ROLLERS,
                           "-dm_plex_filename", meshes[divisions], "-ts_dt", str(dt), *words, "-error_estimate"]
                for method, more in (("runs", ["-error_estimate_mesh", meshes[other]]), ("sweep", ["-error_estimate_method", "sweep"])):
                    summary = study.run([*options, *more])
                    bars = {k: (b["value"], b["error"]) for k, b in summary["error_estimate"]["numbers"].items()}
                    beside = f"{summary['cells']} cells" + (f" beside {other} divisions" if method == "runs" else "")
                    study.compare(method, f"sphere, {beside}, {dt} s, {scheme}", "all", bars, true)


def manufactured(study):
    for mesh in ("cube_coarse", "cube"):
        kept, program = study.folder / f"manufactured_{mesh}.txt", study.build / "tests/verification/verification_manufactured_breath"
        if not program.exists():
            fail(f"{program} is not there; build the tests first")
        text = printed([program], kept, dict(environment(), PULMO_MANUFACTURED_MESH=mesh), [SOURCE / f"meshes/{mesh}.msh"])
        if text is None:
            fail(f"{program} fails; run it alone to see why")
        for line in text.splitlines():
            if line.startswith("row "):
                row = json.loads(line[4:])
                if row["number"] in NUMBERS:
                    study.rows.append({**row, "scene": "manufactured, " + row["scene"], "part": "all",
                                       "effectivity": row["bar"] / row["error"], "held": row["bar"] >= row["error"]})


def tables(rows):
    """Lines of two tables: the scenes, and all that is not held."""
    groups = {}
    for row in rows:
        groups.setdefault((row["scene"], row["part"]), []).append(row)
    table = []
    for (scene, part), group in groups.items():
        ratios = sorted(r["effectivity"] for r in group)
        worst = max(group, key=lambda r: r["error"] / abs(r["value"]))
        table.append([scene, part, f"{sum(r['held'] for r in group)} of {len(group)}", f"{ratios[0]:.2g}",
                      f"{statistics.median(ratios):.2g}", f"{ratios[-1]:.2g}",
                      f"{100 * worst['error'] / abs(worst['value']):.2g} % ({short(worst['number'])})"])
    lines = markdown(["scene", "part", "held", "least", "median", "largest effectivity", "largest true error"], table)
    misses = [r for r in rows if not r["held"]]
    if misses:
        lines += ["", "Not held:", "", *markdown(["scene", "part", "number", "value", "error", "bar"],
                  [[r["scene"], r["part"], short(r["number"]), f"{r['value']:.5g}", f"{r['error']:.2g}", f"{r['bar']:.2g}"]
                   for r in misses])]
    return lines


def run(folder, results, build):
    study = Study(Path(build[1]).resolve() if build else SOURCE / "build", results.resolve())
    require(study.build, [])
    study.folder.mkdir(parents=True, exist_ok=True)
    for scene in (block, sphere, lung, manufactured):
        scene(study)
    header = ["method", "scene", "part", "number", "value", "error", "bar", "effectivity", "held"]
    write_csv(folder / "bars.csv", header,
              [[r["method"], r["scene"], r["part"], r["number"], *(f"{r[c]:.6g}" for c in header[4:8]), r["held"]] for r in study.rows])
    lines = ["# Error bars against true errors", "", "    tools/accuracy_study bars", ""]
    for method, title in (("sweep", "One sweep back"), ("runs", "More runs")):
        rows = [r for r in study.rows if r["method"] == method]
        held, ratios = sum(r["held"] for r in rows), [r["effectivity"] for r in rows]
        lines += [f"**{title}** (`-error_estimate_method {method}`): **{held} of {len(rows)} bars ({100 * held / len(rows):.0f} %) hold the true error**; "
                  f"effectivity (bar over error): median {statistics.median(ratios):.2g}, within 0.75 and 3 in {sum(0.75 <= x <= 3 for x in ratios)}."
                  + (f" {study.unresolved} further errors have no bar: not resolved." if method == "sweep" else ""), ""]
    lines += ["How the bars are made: [error bars](../error_bars.md). All rows: bars.csv.", "",
              "Part: in `time` the truth is a run of BDF2 with steps 32 times as short; in `space` one of cells a quarter of the size "
              "(bars and errors at steps of 4 Δt); in `all` the radial solver or the closed form.", ""]
    for method, title in (("sweep", "One sweep back"), ("runs", "More runs")):
        lines += [f"## {title}", "", *tables([r for r in study.rows if r["method"] == method]), ""]
    (folder / "README.md").write_text("\n".join(lines[:-1]) + "\n")
