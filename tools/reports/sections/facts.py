"""Mass balance, mesh and solver in numbers."""
from ..charts import number
from ..read import Missing

NAME, TITLE = "facts", "Mass, mesh and solver"


def build(run):
    summary = run.summary
    if not summary:
        raise Missing("A run writes these when it ends.")
    seconds = summary.get("wall_seconds") or {}

    def row(words, value, unit="", digits=4):
        text = value if isinstance(value, str) else number(value, digits) if isinstance(value, float) else str(value)
        return (words, text, unit) if value is not None else None

    mass = [row("air lost or made by the numbers (mass balance)", summary.get("mass_balance_error_ml"), "ml", 3),
            row("smallest J", summary.get("min_jacobian")), row("smallest porosity", summary.get("min_porosity"))]
    mesh = [row("tetrahedra", summary.get("cells")), row("unknowns", summary.get("dofs")), row("elements", summary.get("elements")),
            row("volume at rest", summary.get("reference_volume_ml"), "ml"),
            *[row(f"area of surface {name}", area / 100, "cm²") for name, area in (summary.get("surface_areas_mm2") or {}).items()],
            *[row(f"boundary that no effect uses: {part['name'] or 'without a name'}", part["area_mm2"] / 100, "cm²")
              for part in summary.get("free_boundary") or ()]]
    solver = [row("steps", summary.get("steps")), row("steps that were tried again", summary.get("rejected_steps")),
              row("end time", summary.get("end_time_s"), "s"),
              row("Newton iterations", summary.get("newton_iterations")), row("linear iterations", summary.get("krylov_iterations")),
              row("processes", summary.get("ranks")), row("integrator of the cells", summary.get("integration")),
              *[row(f"time, {name}", value, "s", 3) for name, value in seconds.items()], row("version of pulmo", summary.get("version"))]
    return {"groups": [(title, list(filter(None, rows))) for title, rows in (("Mass and deformation", mass), ("Mesh", mesh), ("Solver", solver))]}
