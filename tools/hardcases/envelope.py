"""The clinical envelope: settings of an intensive-care ward with every tissue law, with and without prestress, on three lungs.

Each breath is to finish within few iterations, or to stop where the law itself ends; what misses both is run again, to tell whether
solver, elements or tissue are at their end. Runs are independent of each other: a call goes on where another one stopped.
"""
import collections
import itertools
import json
import re
import shutil

import nibabel
import numpy as np
from scipy.optimize import brentq, minimize_scalar

from shared import keys
from shared.common import SOURCE, laws_of, markdown, processor, write_csv

from .lab import Lab, children_cpu, first_sentence, pulmo
from .laws import ma_soft_in_shear

NEWTON, KRYLOV = 4, 20  # Newton steps a time step and Krylov iterations a Newton step, means of a run
KG, ML_PER_KG, LUNGS = 70, 8, 2600  # predicted body weight; of volume control; both lungs of that body at the end of a breath out, ml
SETTINGS = {"PCV 15/5": ("pcv", ["-ventilator_pip", 15, "-ventilator_peep", 5]), "PCV 25/10": ("pcv", ["-ventilator_pip", 25, "-ventilator_peep", 10]),
            "VCV, PEEP 5": ("vcv", ["-ventilator_peep", 5]), "VCV, PEEP 10": ("vcv", ["-ventilator_peep", 10])}
PRESTRESS = {False: [], True: ["-prestress"]}
AT_REST = 5  # cmH2O of -prestress_pressure, its default
# rausch has no stiffness against shear at rest: no iterative file is made for it; birzle crosses its plateau
SOLVERS = {"rausch": "reuse", "birzle": "iterative_soft"}
# of a run that misses what is asked
CHECKED = "lung_test"  # the others take too long
CHECKS = {"linear systems by factors": lambda law: pulmo.options_file("solvers/reuse.opts"),
          "P1–P1 elements": lambda law: solver(law) + ["-elements", "P1-P1"]}
LONGEST = 900  # s of a run
# of the tests, on lung_test, and what becomes of them
SLICE = {("PCV 15/5", False, "yoshihara"): "finishes", ("PCV 25/10", False, "ma"): "law's limit", ("PCV 25/10", False, "berger"): "missed"}


def arguments(parser):
    parser.add_argument("--clinical", nargs="*", metavar="LUNG", choices=list(MESHES),
                        help=f"lungs of the clinical envelope ({', '.join(MESHES)}; default: all); nothing else runs")
    parser.add_argument("--laws", nargs="+", metavar="LAW", help="with --clinical: these laws alone (default: all that the program offers)")


def called(options, build):
    """What a call of the tool asks for; its exit code."""
    keys.lock(build / "hard_cases")
    return told(build / "pulmo", options.clinical or list(MESHES), laws_of(options), build / "hard_cases/clinical.jsonl",
                options.output or SOURCE / "docs/hard_cases", processor())


# ---- lungs

def labels(x):
    """Of places (..., 3) in mm, RAS: 1 the right and 2 the left lung, two ellipsoids that the domes of a diaphragm and a heart cut, so that
    they have the sharp lower borders of lungs; 3 a windpipe that forks."""
    made = np.zeros(x.shape[:-1], np.uint8)
    heart = np.sum(((x - (-18, 35, -25)) / (52, 48, 62)) ** 2, axis=-1) < 1
    ends = {1: np.array([33.0, -5, 20]), 2: np.array([-33.0, -5, 16])}
    fork = np.array([0.0, -5, 62])
    for end in [fork + (0, 0, 60), *ends.values()]:
        along = np.clip((x - fork) @ (end - fork) / np.sum((end - fork) ** 2), 0, 1)
        made[np.linalg.norm(x - fork - along[..., None] * (end - fork), axis=-1) < 7] = 3
    for label, side in ((1, 1), (2, -1)):
        lung = np.sum(((x - (side * 72, -5, 10)) / (52, 76, 124)) ** 2, axis=-1) < 1
        dome = np.sum(((x - (side * 72, 0, -118)) / (80, 95, 62)) ** 2, axis=-1) < 1
        made[lung & ~dome & ~heart] = label
    return made


def mask_lung(folder):
    """Path of a pair of lungs that tools/lung_mesh makes of a mask."""
    mask, mesh = folder / "clinical_mask.nii.gz", folder / "clinical_mask.msh"
    spacing, low, shape = 3.0, np.array([-132.0, -90, -122]), (89, 61, 86)
    affine = np.diag([spacing, spacing, spacing, 1])
    affine[:3, 3] = low
    image = nibabel.Nifti1Image(labels(low + spacing * np.moveaxis(np.indices(shape), 0, -1)), affine)
    image.header.set_xyzt_units("mm")
    folder.mkdir(parents=True, exist_ok=True)
    if not mask.exists() or not np.array_equal(nibabel.load(mask).dataobj, image.dataobj):
        nibabel.save(image, mask)
    keys.make_mesh(mesh, "lung_mesh", ["--mask", mask, "--labels", "right=1,left=2,airway=3", "--volume", f"{LUNGS}ml", "--cells", 4500])
    return mesh


# name: its file, given a folder for what is made; ml
MESHES = {"lung_test": (lambda folder: pulmo.mesh("lung_test.msh"), 1350), "lung_pair": (lambda folder: pulmo.mesh("lung_pair.msh"), LUNGS),
          "mask": (mask_lung, LUNGS)}


# ---- the laws' own limits, by the closed forms of the tests

def own_limit(law, prestress):
    """J by the volume of the mesh and pressure (cmH2O) of the gas at which a law ends by itself in free inflation, by its closed form: a
    limit point, a plateau without stiffness, or the loss of ellipticity; None if it does not."""
    p = lambda J: pulmo.gas_pressure(law, J)  # noqa: E731
    slope = lambda J: (p(J * (1 + 1e-5)) - p(J * (1 - 1e-5))) / (2e-5 * J)  # noqa: E731
    softest = minimize_scalar(slope, bounds=(1, 6), method="bounded", options={"xatol": 1e-9}).x
    if slope(softest) < 0:
        J = brentq(slope, 1, softest)
    elif slope(softest) < 0.01 * slope(1):
        J = softest
    elif law == "ma":
        J = ma_soft_in_shear()
    else:
        return None
    rest = brentq(lambda x: p(x) - AT_REST, 1, J if slope(softest) < 0 else 8) if prestress else 1
    return J / rest, p(J) - (AT_REST if prestress else 0)


# ---- runs

def solver(law):
    return pulmo.options_file(f"solvers/{SOLVERS.get(law, 'iterative')}.opts")


def scene(mesh, volume, setting, prestress, law):
    """Options of a breath without those of the solver."""
    mode, own = SETTINGS[setting]
    volume_set = ["-ventilator_tidal_volume", tidal(volume)] if mode == "vcv" else []
    return pulmo.options_file(f"scenes/{mode}.opts") + ["-dm_plex_filename", mesh, "-tissue", law, *own, *volume_set, *PRESTRESS[prestress]]


def numbers(run):
    """What a run cost and gave."""
    if run.summary_file not in run.files():
        return {}
    all_of = run.json(run.summary_file)
    steps, newton = all_of["steps"], all_of["newton_iterations"]
    made = {"steps": steps, "cut": all_of["rejected_steps"], "newton": newton / max(steps, 1), "krylov": all_of["krylov_iterations"] / max(newton, 1),
            "least_J": float(run.signals(run.signals_file)["min_J"].min())}
    clinical = {"V_T": "tidal_volume_ml", "C_rs": "compliance_ml_per_cmH2O", "R": "resistance_cmH2O_s_per_l"}
    return made | {name: all_of.get(key) for name, key in clinical.items()}


def cheap(row):
    """Whether it took few iterations."""
    return row["newton"] <= NEWTON and row["krylov"] <= KRYLOV


def names_limit(run, law, prestress):
    """Whether the message of a run that stopped tells the law's own limit, with the numbers of its closed form."""
    told = re.search(r"The law's own limit: .*?; \S+ % of the lung is there or beyond\.", run.err)
    closed, said = own_limit(law, prestress), (run.json("failure.json")["diagnosis"] if "failure.json" in run.files() else {}).get("law_limit")
    return bool(told and closed and said and abs(said["jacobian"] - closed[0]) < 1e-3 * closed[0]
                and abs(said["pressure_cmH2O"] - closed[1]) < 1e-3 * (1 + abs(closed[1])))


def ended(run):
    """How and where, in short."""
    if run.finished:
        return "finished"
    when = re.search(r"t = (\S+) s \(phase (\w+), airway pressure (\S+) cmH2O", run.err)
    where = run.json("failure.json")["diagnosis"]["where"] if "failure.json" in run.files() else first_sentence(run.err)[:100]
    return f"stops: {where}" + (f", {when[2]}, t = {float(when[1]):.3g} s, {float(when[3]):.3g} cmH2O" if when else "")


def run_one(lab, mesh, volume, setting, prestress, law, checks=True):
    """Row of one breath."""
    options = scene(mesh, volume, setting, prestress, law)

    def made(words):
        before = children_cpu()
        run = lab.run(words + options, timeout=LONGEST, sound=False)
        row = {"end": ended(run), **numbers(run), "cpu_s": round(children_cpu() - before, 1)}
        fault = lab.fault(run)
        if fault:
            row["fault"] = fault
        return run, row

    try:
        run, row = made(solver(law))
    except AssertionError as error:  # no end in time
        return {"end": str(error).split(": /")[0].splitlines()[0][:100], "verdict": "missed", "fault": "no end"}
    row["limit"] = not run.finished and names_limit(run, law, prestress)
    row["said"] = run.sentence
    row["verdict"] = ("missed" if "fault" in row else "finishes" if run.finished and cheap(row) else "costs more" if run.finished
                      else "law's limit" if row["limit"] else "missed")
    shutil.rmtree(run.directory, ignore_errors=True)
    if checks and row["verdict"] in ("missed", "costs more"):
        row["checks"] = {}
        for name, words in CHECKS.items():
            try:
                again, other = made(words(law))
                shutil.rmtree(again.directory, ignore_errors=True)
                row["checks"][name] = other
            except AssertionError:
                row["checks"][name] = {"end": f"no end after {LONGEST} s"}
    return row


def breaths(laws):
    """All that is run on a lung, as keys of rows: the laws one after the other."""
    return [(setting, prestress, law) for law in laws for setting in SETTINGS for prestress in PRESTRESS]


def told(program, lungs, laws, kept, folder, machine):
    """Runs the breaths of some lungs and laws that the file `kept` does not have yet, writes page and CSV of all that it has, and gives
    the exit code: 1 if one of them misses what is asked."""
    lab = Lab(program, False)
    kept.parent.mkdir(parents=True, exist_ok=True)
    old = {row["state"]: row for row in map(json.loads, kept.read_text().splitlines())} if kept.exists() else {}
    rows, everything = [], pulmo.tissue_laws()
    for name, (path, volume) in MESHES.items():
        if name not in lungs and not any(row["mesh"] == name for row in old.values()):
            continue
        mesh = path(kept.parent)
        for setting, prestress, law in breaths(everything):
            words = scene(mesh, volume, setting, prestress, law)
            state = keys.digest([program, *solver(law), *words, *itertools.chain(*(check(law) for check in CHECKS.values()))], pulmo.ENVIRONMENT)
            if state not in old and name in lungs and law in laws:
                old[state] = {"mesh": name, "setting": setting, "prestress": prestress, "law": law} | run_one(
                    lab, mesh, volume, setting, prestress, law, name == CHECKED) | {"state": state}
                with open(kept, "a") as file:
                    file.write(json.dumps(old[state]) + "\n")
                print(f"{name}, {law}, {setting}{', prestress' * prestress}: {old[state]['verdict']}: {old[state]['end']}", flush=True)
            rows += [old[state]] if state in old else []
    write(folder, rows, everything, machine, kept.parent / "clinical_mask.msh")
    return int(any(row["verdict"] not in COUNTED[:2] for row in rows))


# ---- page

HEAD = """# The clinical envelope

`tools/hard_cases --clinical` runs it and writes this page ([hard cases](README.md)); `ctest` runs a slice of it (case_stability).

Every tissue law at four settings of an intensive-care ward, with and without `-prestress`, on three lungs: one breath from rest, with the phase
`settle` before it where there is PEEP. Asked of each: it **finishes** within {newton} Newton steps a time step and {krylov} Krylov iterations a Newton step, both in
the mean over the run; or it stops and its message names **the law's own limit** with the numbers of the law's closed form.

- Pressure control 15/5 and 25/10 (PIP/PEEP, cmH2O), volume control of {ml_per_kg} ml/kg at PEEP 5 and 10: {kg} kg, whose two lungs have {lungs} ml at rest; a lung has its
  share by volume. All else as in `scenes/pcv.opts` and `scenes/vcv.opts`: Δt 0.05 s, springs of 0.08 kPa/mm on pleura and airway, gas on the airway's wall.
- With prestress the mesh is under {at_rest} cmH2O and the ventilator's pressures come on top: 25/10 is a transpulmonary pressure of up to 30 cmH2O.
- Lungs: `lung_test.msh` (1,324 tetrahedra), `lung_pair.msh` (11,645), and a pair that `tools/lung_mesh` makes of a mask of two ellipsoids, cut by a diaphragm and a
  heart, with a windpipe ({mask} tetrahedra).
- Solver: `iterative.opts`; for `rausch`, which has no stiffness against shear at rest, `reuse.opts` (factors; one Krylov iteration a Newton step by nature).
- The law's own limit is that of free inflation, F = J^(1/3) I with p = dW/dJ. The tool holds J and pressure in the message against the closed forms of the tests
  (`tests/cases/pulmo_case.py`), to 0.1 %. The message tells it where a part of the lung is there or beyond; that such a limit is named does not prove that nothing else has
  a share in the stop.
- A breath that misses what is asked on `lung_test` is run again with linear systems that are solved by factors (`reuse.opts`), and with P1–P1 elements.

One rank on {machine}; CPU seconds depend on the machine, and on what else runs on it. Whether a breath is one of a lung is another question: V_T beside the volume of the lung
tells it, and [how far each law goes](../effects/laws.md).
"""
BEGIN, END = "<!-- by hand -->", "<!-- end -->"
COUNTED = ("finishes", "law's limit", "costs more", "missed")
HEADER = ["setting", "prestress", "law", "result", "end", "V_T ml", "C_rs ml/cmH2O", "least J", "steps, cut", "Newton a step", "Krylov a Newton step", "CPU s"]
COLUMNS = ["mesh", "setting", "prestress", "law", "verdict", "end", "V_T", "C_rs", "R", "least_J", "steps", "cut", "newton", "krylov", "cpu_s", "said"]


def short(value, digits="{:.3g}"):
    return "–" if value is None else digits.format(value)


def cells_of(mesh):
    """Number of tetrahedra of a mesh, as words; of one that is not there yet: it has to be made."""
    from meshing.msh import read_mesh
    return f"{len(read_mesh(str(mesh)).tets):,}" if mesh.exists() else "not made yet, about 4,500"


def tidal(volume):
    """ml that volume control gives a lung."""
    return round(ML_PER_KG * KG * volume / LUNGS)


def line(row):
    set_to = tidal(MESHES[row["mesh"]][1])
    other = row["setting"].startswith("VCV") and row.get("V_T") and abs(row["V_T"] - set_to) > 0.05 * set_to
    strong = row["verdict"] if row["verdict"] in COUNTED[:2] else f"**{row['verdict']}**"
    return [row["setting"], "5 cmH2O" if row["prestress"] else "–", row["law"], strong, row["end"], short(row.get("V_T")) + f" (set: {set_to})" * bool(other), short(row.get("C_rs")),
            short(row.get("least_J")), f"{row['steps']}, {row['cut']}" if "steps" in row else "–", short(row.get("newton"), "{:.2f}"),
            short(row.get("krylov"), "{:.1f}"), short(row.get("cpu_s"), "{:.0f}")]


def kept_text(page):
    """Lines of the page that were written by hand, with their marks."""
    lines = page.read_text().splitlines() if page.exists() else []
    return lines[lines.index(BEGIN):lines.index(END) + 1] if BEGIN in lines and END in lines else [BEGIN, "", END]


def counts(rows):
    found = collections.Counter(row["verdict"] for row in rows)
    return ", ".join(f"{found[verdict]} {words}" for verdict, words in zip(COUNTED, (
        "finish within what is asked", "stop at the law's own limit and name it", "finish and cost more", "stop without such a limit")))


def misses(rows):
    """Table of what does not do what is asked, with the runs that tell why."""
    lines = []
    for row in rows:
        if row["verdict"] in COUNTED[:2]:
            continue
        again = [f"{other['end']}" + (f", {other['newton']:.2f} Newton, {other['krylov']:.1f} Krylov" if "newton" in other else "")
                 for other in row.get("checks", {}).values()]
        lines.append([row["mesh"], row["setting"] + ", prestress" * row["prestress"], row["law"],
                      row["end"] + (f", {row['newton']:.2f} Newton, {row['krylov']:.1f} Krylov" if "newton" in row else ""), *again, *["–"] * (len(CHECKS) - len(again))])
    return markdown(["lung", "setting", "law", "as above", *CHECKS], lines) if lines else ["None."]


def write(folder, rows, laws, machine, mask):
    """The page and the CSV of what there is; what stands by hand between the marks of the page stays."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "clinical_envelope.md"
    order = {key: i for i, key in enumerate(breaths(laws))}
    rows = sorted(rows, key=lambda row: (list(MESHES).index(row["mesh"]), order[row["setting"], row["prestress"], row["law"]]))
    text = [HEAD.format(newton=NEWTON, krylov=KRYLOV, ml_per_kg=ML_PER_KG, kg=KG, lungs=LUNGS, at_rest=AT_REST, machine=machine, mask=cells_of(mask)),
            "| lung | runs | " + " | ".join(COUNTED) + " |", "|---|---|" + "---|" * len(COUNTED)]
    for name in MESHES:
        of = [row for row in rows if row["mesh"] == name]
        found = collections.Counter(row["verdict"] for row in of)
        text.append(f"| {name} | {len(of)} of {len(order)} | " + " | ".join(str(found[verdict]) for verdict in COUNTED) + " |")
    text += ["", "## What misses, and why", "", *kept_text(page), "", *misses(rows), ""]
    for name in MESHES:
        of = [row for row in rows if row["mesh"] == name]
        if of:
            text += [f"## {name}", "", f"{counts(of)}.", "", *markdown(HEADER, map(line, of)), ""]
    text.append("Data: [clinical envelope](clinical_envelope.csv), with what each run that stopped said.")
    page.write_text("\n".join(text).rstrip() + "\n")
    print(f"wrote {page}")
    write_csv(folder / "clinical_envelope.csv", COLUMNS, [[row.get(column, "") for column in COLUMNS] for row in rows])
