"""Clinical numbers with units, error bars and usual ranges; of several runs side by side."""
from ..charts import number
from ..read import Missing

NAME, TITLE = "numbers", "Numbers"

# key in summary.json: words, unit
ROWS = {
    "peak_inspiratory_pressure_cmH2O": ("Peak inspiratory pressure", "cmH₂O"),
    "plateau_pressure_cmH2O": ("Plateau pressure", "cmH₂O"),
    "peep_cmH2O": ("PEEP", "cmH₂O"),
    "auto_peep_cmH2O": ("Auto-PEEP", "cmH₂O"),
    "total_peep_cmH2O": ("Total PEEP", "cmH₂O"),
    "driving_pressure_cmH2O": ("Driving pressure", "cmH₂O"),
    "tidal_volume_ml": ("Tidal volume", "ml"),
    "trapped_volume_ml": ("Trapped volume", "ml"),
    "peak_flow_ml_per_s": ("Peak inspiratory flow", "ml/s"),
    "peak_expiratory_flow_ml_per_s": ("Peak expiratory flow", "ml/s"),
    "compliance_ml_per_cmH2O": ("Compliance (fit of one compartment)", "ml/cmH₂O"),
    "resistance_cmH2O_s_per_l": ("Resistance (fit of one compartment)", "cmH₂O s/l"),
    "time_constant_s": ("Time constant", "s"),
    "compliance_equal_weights_ml_per_cmH2O": ("Compliance (fit, equal weights and intercept)", "ml/cmH₂O"),
    "resistance_equal_weights_cmH2O_s_per_l": ("Resistance (fit, equal weights and intercept)", "cmH₂O s/l"),
    "static_compliance_ml_per_cmH2O": ("Static compliance", "ml/cmH₂O"),
    "dynamic_compliance_ml_per_cmH2O": ("Dynamic compliance", "ml/cmH₂O"),
    "static_curve_compliance_ml_per_cmH2O": ("Compliance of the static curve", "ml/cmH₂O"),
    "pause_resistance_cmH2O_s_per_l": ("Resistance from the pause", "cmH₂O s/l"),
    "work_j": ("Work of (P − PEEP)", "J"),
    "mechanical_power_j_per_min": ("Mechanical power of (P − PEEP)", "J/min"),
    "functional_residual_capacity_ml": ("Functional residual capacity", "ml"),
    "strain": ("Strain (tidal volume over FRC)", "ml/ml"),
}

# what is usual or held safe in ventilated adults, both lungs with the chest wall
RANGES = {
    "plateau_pressure_cmH2O": "held safe up to 30 (ARDS Network 2000)",
    "driving_pressure_cmH2O": "held safe below 15 (Amato et al. 2015)",
    "tidal_volume_ml": "6 to 8 ml per kg of predicted body weight; in ARDS 6 (ARDS Network 2000)",
    "static_compliance_ml_per_cmH2O": "35 to 100 with normal lungs (after Cairo)",
}
SOURCES = [
    "ARDS Network. Ventilation with lower tidal volumes as compared with traditional tidal volumes for acute lung injury and the "
    "acute respiratory distress syndrome. N Engl J Med 2000; 342: 1301.",
    "Amato MBP et al. Driving pressure and survival in the acute respiratory distress syndrome. N Engl J Med 2015; 372: 747.",
    "Cairo JM. Pilbeam's Mechanical Ventilation: 35 to 50 and up to 100 ml/cmH2O in intubated patients.",
]


def value(run, key):
    """The number and its error bar, as the run wrote them."""
    bars = (run.summary.get("error_estimate") or {}).get("numbers") or {}
    bar = bars.get(key) or {}
    return {"value": run.summary.get(key), "error": bar.get("error"), "has_bar": key in bars}


def difference(first, other):
    """Of a number from that of the first run, in its unit and, up to ten times as much, in percent."""
    if first is None or other is None:
        return ""
    change = other - first
    if not change:
        return "0"
    sign = "+" if change > 0 else "−"
    share = f" ({sign}{100 * abs(change / first):.1f} %)" if abs(change) < 10 * abs(first) else ""
    return f"{sign}{number(abs(change), 3)}{share}"


def compare(runs):
    if not any(run.summary.get(key) is not None for run in runs for key in ROWS):
        raise Missing("No number: " + "; ".join(
            f"{run.name}: {run.summary.get('why_no_numbers') or run.unfinished or 'the run has no breath'}" for run in runs) + ".")
    rows = []
    for key, (words, unit) in ROWS.items():
        cells = [value(run, key) for run in runs]
        if all(cell["value"] is None for cell in cells):
            continue
        for cell in cells:
            cell["text"] = number(cell["value"], 5)
            cell["bar"] = number(cell["error"], 2) if cell["error"] is not None else ""
            cell["difference"] = "" if cell is cells[0] else difference(cells[0]["value"], cell["value"])
        rows.append({"key": key, "words": words, "unit": unit, "cells": cells, "range": RANGES.get(key, "")})
    undefined = [words for key, (words, _) in ROWS.items() if key not in [row["key"] for row in rows]]
    return {"rows": rows, "names": [run.name for run in runs], "undefined": undefined,
            "bars": any(cell["has_bar"] for row in rows for cell in row["cells"]),
            "notes": [note for run in runs for note in notes(run)], "sources": SOURCES,
            "ranges": any(row["range"] for row in rows)}


def notes(run):
    """What a reader of the numbers must know of a run."""
    summary, name = run.summary, run.name
    if summary.get("why_no_numbers"):
        yield f"{name}: no numbers, since {summary['why_no_numbers']}."
    if summary.get("numbers_of_breath"):
        yield (f"{name}: numbers of breath {summary['numbers_of_breath']} of {len(summary['breaths'])}; "
               + ("the breath is steady." if summary.get("steady") else "the breath is not steady yet: more or longer breaths tell "
                  "whether the numbers still change." if summary.get("steady") is False else "whether it is steady is not known."))
    if summary.get("steady_change") is not None:
        yield f"{name}: the largest change that counts for that is {number(100 * summary['steady_change'], 3)} % (steady: up to 1 %)."
    unsettled, tidal = summary.get("unsettled_volume_ml"), summary.get("tidal_volume_ml")
    if unsettled and tidal and abs(unsettled) > 0.003 * tidal:
        yield (f"{name}: the first breath starts before the lung is at rest: at least {number(unsettled, 3)} ml were still to come "
               "and count as breath.")
