"""The command that runs the same again, and all options that were used."""
import shlex

from ..read import Missing

NAME, TITLE = "again", "How to run it again"
OF_THE_PLACE = {"-output_dir", "-output_overwrite", "-restart", "-scene_view", "-scene_view_only", "-effects_view", "-progress",
                "-dry_run", "-dry_run_seconds"}


def quoted(name, value):
    """As a shell and an option file take it."""
    if value == "":
        return name
    return f"{name} {shlex.quote(value)}"


def command(run):
    """One line for each option that was given, as it counted in the end."""
    ranks = run.summary.get("ranks") or run.scene.get("ranks", 1)
    lines = [f"mpiexec -n {ranks} pulmo" if ranks > 1 else "pulmo"]
    lines += [quoted(name, value) for name, value in run.options.items() if name in run.sources and name not in OF_THE_PLACE]
    lines.append("-output_dir results/again")
    return " \\\n  ".join(lines)


def build(run):
    if not run.options:
        raise Missing("The directory says nothing of the options: the run has not ended, and an older version of pulmo made it.")
    return {"command": command(run), "restarted": bool(run.options.get("-restart")), "version": run.summary.get("version") or run.scene.get("version", "?"), "ended": bool(run.summary),
            "options": [(name, value, run.sources.get(name, "default")) for name, value in run.options.items()]}
