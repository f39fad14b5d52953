"""The scene in words, as -scene_view has them, from the options that the run used; and a picture of the lung."""
import os

from .. import options, pictures
from ..charts import number
from ..read import Missing

NAME, TITLE = "scene", "The scene"
MODES = {"pcv": "pressure-controlled ventilation", "vcv": "volume-controlled ventilation", "supersyringe": "inflation and deflation in steps",
         "programme": "phases of a programme"}


def sentence(run, effect):
    """'Tissue: what it is; birzle; porosity 0.99; c 0.3567 kPa.'"""
    if effect == "ventilator":
        parts = [MODES.get(run.options.get("-ventilator"), options.effect(effect))]
    else:
        parts = [words for words in [options.effect(effect)] if words]
    choice = run.options.get(f"-{effect}", "")
    if choice not in ("", "on"):
        parts.append(choice)
    for name, value, unit in options.given(run.options, effect):
        parts.append(" ".join(word for word in (name, value if value else "on", unit) if word))
    return effect.replace("_", " ").capitalize(), "; ".join(parts) + "."


def mesh(run):
    summary = run.summary
    lines = [f"The mesh {run.options.get('-dm_plex_filename', 'of the run')} has {number(summary['reference_volume_ml'])} ml in "
             f"{summary['cells']} tetrahedra; elements {summary['elements']}."]
    areas = summary.get("surface_areas_mm2") or {}
    lines += [f"Surface {name} has {number(area / 100)} cm²." for name, area in areas.items()]
    lines += [f"{'Body' if r.get('connected_body') else 'Volume'} {name} has {number(r['reference_volume_ml'])} ml."
              for name, r in (summary.get("regions") or {}).items()]
    return lines


def build(run):
    if not run.options:
        raise Missing("A run writes its options when it ends, and this one has not ended: signals.csv.part alone does not say "
                      "what the scene is.")
    on = run.summary.get("effects") or []
    off = [name for kind, name in options.table() if kind == "effect" and name not in on]
    try:
        picture = pictures.lung(run)
    except Missing as reason:
        picture, why = None, str(reason)
    else:
        why = ""
    return {"mesh": mesh(run), "on": [sentence(run, effect) for effect in on],
            "off": [(name.replace("_", " ").capitalize(), options.effect(name)) for name in off],
            "file": os.path.basename(run.options.get("-dm_plex_filename", "")), "picture": picture, "why": why}
