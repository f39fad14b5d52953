"""Which effects act, and what each of them shows in the numbers of the run."""
from .. import options
from ..charts import number
from ..read import Missing

NAME, TITLE = "effects", "Effects"
# rows of the energy balance that are of one effect
WORK = {"airflow": ["resistive"], "tissue": ["elastic_tissue"], "chest_wall": ["elastic_springs", "turning_springs"],
        "tube": ["resistive_tube"], "airway_tree": ["resistive_airways", "elastic_airways"], "breathing_effort": ["muscles"],
        "prestress": ["pleural_pressure"], "recruitment": ["recruitment"], "surfactant": ["elastic_surface", "viscous_surface"],
        "cavity": ["elastic_cavity"], "inertia": ["kinetic"], "viscoelastic": ["viscous_tissue"], "ventilator": ["ventilator_work"]}


def build(run):
    on = run.summary.get("effects")
    if not on:
        raise Missing("A run names its effects when it ends.")
    energy = run.summary.get("energy_j") or {}
    return {"rows": [{"name": name.replace("_", " "), "what": options.effect(name),
                      "energy": [(key.replace("_", " "), number(energy[key])) for key in WORK.get(name, ()) if key in energy],
                      "given": [f"-{name}_{word.replace(' ', '_')} {value}{' ' + unit if unit else ''}"
                                for word, value, unit in options.given(run.options, name)
                                if f"-{name}_{word.replace(' ', '_')}" in (run.summary.get("option_sources") or {})]}
                     for name in on]}
