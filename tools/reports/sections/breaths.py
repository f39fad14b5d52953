"""A row for each breath."""
from ..charts import number
from ..read import Missing
from .numbers import ROWS

NAME, TITLE = "breaths", "Breaths"
COLUMNS = ["peak_inspiratory_pressure_cmH2O", "plateau_pressure_cmH2O", "peep_cmH2O", "auto_peep_cmH2O", "driving_pressure_cmH2O",
           "tidal_volume_ml", "trapped_volume_ml", "peak_flow_ml_per_s", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l",
           "static_compliance_ml_per_cmH2O", "work_j", "mechanical_power_j_per_min"]


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
    keys = list(trial["levels"][0])
    return {"heads": [key.replace("_", " ") for key in keys],
            "rows": [[number(level[key], 5) for key in keys] for level in trial["levels"]],
            "best": number(trial.get("peep_of_best_compliance_cmH2O")), "compliance": number(trial.get("best_compliance_ml_per_cmH2O"))}
