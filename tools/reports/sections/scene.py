"""The scene in words, as the run told them when it began, and a picture of the lung."""
import os

from .. import pictures
from ..read import Missing

NAME, TITLE = "scene", "The scene"


def pretty(unit):
    """A unit as people write it: cmH₂O, mm², kg/m³."""
    return unit.replace("H2O", "H₂O").replace("^2", "²").replace("^3", "³")


def called(name):
    return name.replace("_", " ").capitalize()


def settings(effect):
    """['porosity 0.99', 'c 0.3567 kPa']: an effect's options as the run used them, defaults included."""
    return [" ".join(word for word in (s["name"], s["value"], pretty(s["unit"])) if word) for s in effect["settings"]]


def build(run):
    scene = run.scene
    if not scene:
        raise Missing("The directory has no scene.json, in which a run says what its scene is: an older version of pulmo made it.")
    try:
        picture, why = pictures.lung(run), ""
    except Missing as reason:
        picture, why = None, str(reason)
    effects = scene["effects"]
    return {"mesh": [pretty(line) for line in scene["mesh"]],
            "on": [(called(e["name"]), "; ".join([e["words"], *settings(e)]) + ".") for e in effects if e["active"]],
            "off": [(called(e["name"]), e["words"]) for e in effects if not e["active"]],
            "more": [(title, [pretty(line) for line in scene[key]])
                     for title, key in (("How far the tissue goes", "tissue_range"), ("How it breathes", "breathing"), ("How it is solved", "numerics"))
                     if scene[key]],
            "file": os.path.basename(run.options.get("-dm_plex_filename", "")), "picture": picture, "why": why}
