"""Where the work went: the balance of the run, closed to its residual, and its growth in time."""
from ..charts import COLOURS, chart, number, series, thinned
from ..read import Missing

NAME, TITLE = "energy", "Energy"
GIVEN = ["ventilator_work", "external", "muscles", "turning_springs", "pleural_pressure"]  # the left side of the balance
WORDS = {
    "ventilator_work": "work of the ventilator", "external": "work of other loads", "muscles": "work of the muscles of breathing",
    "turning_springs": "work of springs that turn with the surface", "pleural_pressure": "work of the pleural pressure",
    "elastic_tissue": "stored in the tissue", "elastic_springs": "stored in the springs of the chest wall",
    "elastic_airways": "stored in the walls of airways", "elastic_surface": "stored in surface tension",
    "elastic_cavity": "stored in the wall of the cavity", "kinetic": "kinetic energy", "resistive": "heat of the flow through the tissue",
    "resistive_tube": "heat in the tube", "resistive_airways": "heat in the airways", "recruitment": "lost as airspaces open and close",
    "viscous_surface": "heat of surface tension", "viscous_tissue": "heat in the viscoelastic tissue",
    "numerical_dissipation": "taken by the time stepping itself"}


def words(key):
    return WORDS.get(key, key.replace("_", " "))


def balance(energy):
    """Rows of one object of the summary, and what is left of their sum."""
    terms = [(key, value) for key, value in energy.items() if not key.startswith("residual") and value is not None]
    left = sum(value if key in GIVEN else -value for key, value in terms)
    return terms, left


def build(run):
    parts = [(title, source) for title, source in (
        ("whole run", run.summary.get("energy_j")), ("last complete breath", run.breath and run.breath.get("energy_j")),
        ("its inspiration", run.breath and run.breath.get("inspiratory_energy_j"))) if source]
    if not parts:
        table = run.energy  # raises Missing
        parts = [("so far", {key: values[-1] for key, values in table.items() if key != "time_s"})]
    keys = [key for key in parts[0][1] if not key.startswith("residual")]
    rows = [{"words": words(key), "sign": "+" if key in GIVEN else "−", "values": [number(source.get(key), 5) for _, source in parts]}
            for key in keys]
    charts, why = [], ""
    try:
        table = run.energy
        last = [(key, values[-1]) for key, values in table.items() if key in keys and values[-1]]
        gone = [(key, value) for key, value in last if key not in GIVEN]
        if gone:
            charts.append(chart(f"energy-went-{run.id}", "Where the work went, whole run", "energy", "what took it", [
                {"label": "energy", "x": [float(f"{value:.6g}") for _, value in gone], "y": [words(key) for key, _ in gone],
                 "colour": COLOURS[0], "dash": []}], "energy by what it went into at the end of the run", x_unit="J", kind="bar",
                height=3 + 1.9 * len(gone)))
        time = table["time_s"]
        rows_drawn = thinned(len(time))
        drawn = [key for key in keys if key in table and any(table[key])]
        charts.append(chart(f"energy-time-{run.id}", "Sums since the start", "time", "energy", [
            series(words(key), [time[i] for i in rows_drawn], [table[key][i] for i in rows_drawn], i) for i, key in enumerate(drawn)],
            "the terms of the balance over time", x_unit="s", y_unit="J", legend=True, hover="x", height=20))
    except Missing as reason:
        why = str(reason)
    return {"heads": [title for title, _ in parts], "rows": rows, "charts": charts, "why": why,
            "left": [number(balance(source)[1], 3) for _, source in parts],
            "residual": [number(source.get("residual"), 3) for _, source in parts],
            "relative": [number(source.get("residual_relative"), 2) for _, source in parts]}
