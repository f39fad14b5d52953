"""A row for each breath."""
from ..charts import number
from ..read import Missing
from .numbers import ROWS

NAME, TITLE = "breaths", "Breaths"
COLUMNS = ["peak_inspiratory_pressure_cmH2O", "plateau_pressure_cmH2O", "peep_cmH2O", "auto_peep_cmH2O", "driving_pressure_cmH2O",
           "tidal_volume_ml", "trapped_volume_ml", "peak_flow_ml_per_s", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l",
           "static_compliance_ml_per_cmH2O", "work_j", "mechanical_power_j_per_min"]

UNITS = {"_ml_per_cmH2O": "ml/cmH2O", "_cmH2O": "cmH2O", "_ml": "ml"}  # the longest first


def build(run):
    breaths = run.summary.get("breaths") or []
    if not breaths:
        raise Missing("The run is not finished, and breaths are counted at its end." if not run.summary else
                      "The run has no breath" + (f": {run.summary['why_no_numbers']}." if run.summary.get("why_no_numbers") else "."))
    columns = [key for key in COLUMNS if any(breath.get(key) is not None for breath in breaths)]
    trial = run.summary.get("peep_trial")
    return {"heads": [ROWS[key] for key in columns],
            "rows": [{"number": i + 1, "span": f"{number(breath['start_s'], 6)} to {number(breath['end_s'], 6)}",
                      "cut": not breath["complete"], "values": [number(breath.get(key), 5) for key in columns]}
                     for i, breath in enumerate(breaths)],
            "cut": any(not breath["complete"] for breath in breaths), "trial": trial and peep_trial(trial)}


def peep_trial(trial):
    levels = [flat(level) for level in trial["levels"]]
    keys = list(dict.fromkeys(key for level in levels for key in level))
    return {"heads": [head(key) for key in keys],
            "rows": [[number(level.get(key), 5) for key in keys] for level in levels],
            "best": number(trial.get("peep_of_best_compliance_cmH2O")), "compliance": number(trial.get("best_compliance_ml_per_cmH2O"))}


def flat(level):
    """{(key, region or ""): value} of a level; a lung of one region has nothing to add."""
    regions = level.get("regions") or {}
    return {(key, ""): value for key, value in level.items() if key != "regions"} | {
        (key, name): value for name, values in regions.items() if len(regions) > 1 for key, value in values.items()}


def head(key):
    """Words and unit of a column."""
    name, region = key
    words, unit = next(((name.removesuffix(end), f" ({unit})") for end, unit in UNITS.items() if name.endswith(end)), (name, ""))
    words = words.replace("_", " ").replace("peep", "PEEP")
    return words[0].upper() + words[1:] + (f", {region}" if region else "") + unit
