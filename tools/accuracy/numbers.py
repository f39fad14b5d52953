"""The clinical numbers that accuracy is asked of, and questions like C_rs=1%."""
import re

ALIASES = {"V_T": "tidal_volume_ml", "Q_peak": "peak_flow_ml_per_s", "C_rs": "compliance_ml_per_cmH2O",
           "R": "resistance_cmH2O_s_per_l", "PIP": "peak_inspiratory_pressure_cmH2O"}
KEYS = [ALIASES[name] for name in ("V_T", "Q_peak", "C_rs", "R")]  # those that a pressure-controlled breath does not prescribe
SHORT = {key: alias for alias, key in ALIASES.items()}
LEVELS = (0.05, 0.01, 0.001)
NOT_CLINICAL = {"reference_volume_ml", "functional_residual_capacity_ml"}  # of the mesh, not of the breath


def short(key):
    return SHORT.get(key, key)


def clinical(summary):
    """The clinical numbers of a run: those of a breath that are single numbers, with the overall values."""
    keys = summary["breaths"][-1] if summary.get("breaths") else {}
    return {key: float(summary[key]) for key in keys
            if isinstance(summary.get(key), (int, float)) and not isinstance(summary[key], bool) and key not in NOT_CLINICAL}


def percent(share):
    return f"{100 * share:g} %"


def file_name(share):
    """recommended_1percent.opts, recommended_0.1percent.opts."""
    return f"recommended_{100 * share:g}percent.opts"


def question(text):
    """(key, share) of NAME=1% or NAME=0.01."""
    found = re.fullmatch(r"\s*(\w+)\s*=\s*([0-9.eE+-]+)\s*(%?)\s*", text)
    try:
        share = float(found[2]) / (100 if found[3] else 1)
    except (TypeError, ValueError):
        raise ValueError(f"cannot read the question '{text}'; write it like C_rs=1%") from None
    if not 0 < share < 1:
        raise ValueError(f"the question '{text}' asks for a share outside 0 to 100 %")
    return ALIASES.get(found[1], found[1]), share
