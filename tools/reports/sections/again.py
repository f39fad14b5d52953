"""The command that runs the same again, and all options that were used."""
import shlex

from ..read import Missing

NAME, TITLE = "again", "How to run it again"
OF_THE_PLACE = {"-output_dir", "-output_overwrite", "-restart", "-scene_view", "-scene_view_only", "-effects_view", "-progress"}


def quoted(name, value):
    """As a shell and an option file take it."""
    if value == "":
        return name
    return f"{name} {shlex.quote(value)}"


def command(run):
    """One line for each option that was given, as it counted in the end."""
    given = run.summary.get("option_sources") or {}
    lines = [f"mpiexec -n {run.summary['ranks']} pulmo" if run.summary.get("ranks", 1) > 1 else "pulmo"]
    lines += [quoted(name, value) for name, value in run.options.items() if name in given and name not in OF_THE_PLACE]
    lines.append("-output_dir results/again")
    return " \\\n  ".join(lines)


def build(run):
    if not run.options:
        raise Missing("A run writes its options when it ends, and this one has not ended.")
    sources = run.summary.get("option_sources") or {}
    return {"command": command(run), "restarted": bool(run.options.get("-restart")), "version": run.summary.get("version", "?"),
            "options": [(name, value, sources.get(name, "default")) for name, value in run.options.items()]}
