"""Which effects act, what each of them adds to the equations, what it costs, and its part of the energy."""
from ..charts import number
from ..read import Missing

NAME, TITLE = "effects", "Effects"
# rows of the energy balance that are of one effect
WORK = {"airflow": ["resistive"], "tissue": ["elastic_tissue"], "chest_wall": ["elastic_springs", "turning_springs"],
        "tube": ["resistive_tube"], "airway_tree": ["resistive_airways", "elastic_airways"], "breathing_effort": ["muscles"],
        "prestress": ["pleural_pressure"], "recruitment": ["recruitment"], "surfactant": ["elastic_surface", "viscous_surface"],
        "cavity": ["elastic_cavity"], "inertia": ["kinetic"], "viscoelastic": ["viscous_tissue"], "ventilator": ["ventilator_work"]}


def build(run):
    on = [effect for effect in run.scene.get("effects", ()) if effect["active"]]
    if not on:
        raise Missing("The directory has no scene.json, in which a run names its effects: an older version of pulmo made it.")
    energy = run.summary.get("energy_j") or {}
    ledger = {entry["effect"]: entry for entry in run.summary.get("ledger") or ()}

    def row(effect):
        name, entry = effect["name"], ledger.get(effect["name"])
        given = [(f"-{name}_{s['name']}".rstrip("_").replace(" ", "_"), s) for s in effect["settings"]]
        return {"name": name.replace("_", " "), "what": effect["words"],
                "energy": [(key.replace("_", " "), number(energy[key])) for key in WORK.get(name, ()) if key in energy],
                "given": [f"{option} {s['value']} {s['unit']}".rstrip() for option, s in given if option in run.sources],
                "adds": ([*(f"field {field}" for field in entry["fields"]), *entry["terms"]] if entry else []),
                "seconds": number(entry["seconds"], 3) if entry else None}

    return {"rows": [row(effect) for effect in on], "ended": bool(ledger)}
