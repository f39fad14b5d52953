"""Ventilation by lung, lobe, height against gravity, and along the axes of the body."""
import numpy as np

from ..charts import chart, number, series
from ..read import Missing

NAME, TITLE = "regions", "Regional ventilation"
BINS = 10
# name, axis, from, to
PROFILES = [("apex to base", 2, "base", "apex"), ("dorsal to ventral", 1, "dorsal", "ventral"), ("left to right", 0, "left", "right")]


def by_region(run):
    return [{"name": name, "volume": number(r["reference_volume_ml"]), "ventilation": number(r["ventilation_ml"]),
             "share": None if r["ventilation_share"] is None else 100 * r["ventilation_share"], "jacobian": number(r["jacobian_mean"]),
             "spread": number(r["jacobian_sd"], 3), "pressure": number(r["alveolar_pressure_mean_cmH2O"]),
             "pressure_spread": number(r["alveolar_pressure_sd_cmH2O"], 3)}
            for name, r in (run.summary.get("regions") or {}).items()]


def by_gravity(run):
    gravity = run.summary.get("gravity")
    if not gravity:
        return None
    thirds = [{"name": words, "volume": number(third["reference_volume_ml"]), "ventilation": number(third["ventilation_ml"]),
               "share": None if third["ventilation_share"] is None else 100 * third["ventilation_share"],
               "start": number(third["jacobian_mean_at_start"]), "full": number(third["jacobian_mean"])}
              for words, third in ((w, gravity.get(w)) for w in ("nondependent", "middle", "dependent")) if third]
    return {"thirds": thirds, "weight": number(gravity.get("lung_weight_g")),
            "start": number(gravity.get("jacobian_gradient_at_start_per_cm"), 3), "full": number(gravity.get("jacobian_gradient_per_cm"), 3)}


def profile(run, axis):
    """(middles of the bins mm, ventilation ml/ml, volume at rest ml) in bins of equal height."""
    fields, (start, full) = run.fields, run.full
    came = fields.values("J_mean", full) - fields.values("J_mean", start)
    places, cells, volumes = fields.lattice
    edges = np.linspace(places[:, axis].min(), places[:, axis].max(), BINS + 1)
    held = np.histogram(places[:, axis], edges, weights=volumes)[0]
    gained = np.histogram(places[:, axis], edges, weights=volumes * came[cells])[0]
    with np.errstate(invalid="ignore"):
        return (edges[1:] + edges[:-1]) / 2, gained / held, held / 1000


def build(run):
    rows, gravity = by_region(run), by_gravity(run)
    charts, why, between = [], "", ""
    try:
        for words, axis, low, high in PROFILES:
            middle, came, held = profile(run, axis)
            good = held > 0
            charts.append(chart(f"profile-{axis}-{run.id}", f"{words[0].upper()}{words[1:]}", "ventilation", f"{'xyz'[axis]} at rest",
                                [series("ventilation", came[good], middle[good], 0, marks=True,
                                        words=[f"{v:.4g} ml of lung at rest" for v in held[good]])],
                                f"ventilation in {BINS} layers of equal height from {low} to {high}", x_unit="ml/ml", y_unit="mm",
                                from_zero=True))
        between = " to ".join(run.moment(s) for s in run.full)
    except Missing as reason:
        why = str(reason)
    if not rows and not charts:
        raise Missing(why or "The run has no regions.")
    return {"rows": rows, "gravity": gravity, "charts": charts, "why": why, "between": between, "bins": BINS,
            "whole": not run.breath}
