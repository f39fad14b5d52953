"""How to cite the program and its model."""
from shared.common import SOURCE

NAME, TITLE = "cite", "How to cite"
MODEL = ("N. Avilés-Rojas, D. E. Hurtado: Whole-lung finite-element models for mechanical ventilation and respiratory research "
         "applications. Frontiers in Physiology 13 (2022) 984286.")


def compare(runs):
    versions = sorted({run.summary["version"] for run in runs if run.summary.get("version")})
    path = SOURCE / "CITATION.cff"
    return {"versions": versions, "model": MODEL, "file": path.read_text(errors="replace") if path.exists() else "",
            "laws": sorted({run.summary["tissue"] for run in runs if run.summary.get("tissue")})}
