"""What a search leaves in its folder: accuracy.csv, README.md, pictures, option files of the recommended settings."""
import math
import shlex

from benchmarks import runs as benchmark_runs
from shared.common import blas, markdown, processor, write_csv

from . import fields, pictures
from .numbers import file_name, percent, short
from .settings import names_of, plain_options

FIGURES = {"ladders": pictures.ladders, "pareto": pictures.pareto, "costs": pictures.costs, "spectrum": pictures.digits}


def field_errors(search):
    """Errors of the fields by setting against the run on the finest mesh, of those the one with the most unknowns, then with the smallest
    errors (of P3 displacement the files hold the quadratic part alone), at the snapshot with the most gas (runs without one
    at that time are left out); and that run, None if there are no snapshots."""
    done = search.ladder.done
    errors = search.errors()
    if not errors or any(not (run.folder / "fields.xdmf").exists() for run in done.values()):
        return {}, None
    reference = min(done.values(), key=lambda run: (-run.setting.mesh.cells, -run.summary["dofs"], max(e.predicted(run.setting) for e in errors.values())))
    volumes = benchmark_runs.waveform(reference.results[0])
    times = [time for time, *_ in fields.snapshots(reference.folder)]
    time = max(times, key=lambda t: volumes[min(volumes, key=lambda row: abs(row - t))][0])
    compare = fields.Comparison(fields.read(reference.folder, time))
    made = {setting: fields.read(run.folder, time) for setting, run in done.items() if run is not reference}
    return {setting: compare(snapshot) for setting, snapshot in made.items() if snapshot}, (reference, time)


def rows(search, found):
    """Header and rows of accuracy.csv; errors are shares of the limit, negative below it."""
    errors, base = search.all_errors(), search.axes.base
    keys = list(errors)
    header = ["mesh", "elements", "scheme", "dt_s", "step_tolerance", "solver", "varied", "cells", "dofs", "steps", "rejected_steps", "newton_iterations",
              "krylov_iterations", "cpu_s", "wall_s", "memory_mb", *keys, *(f"error_{k}" for k in keys),
              "error_u_l2", "error_u_h1", "error_p_l2", "outside_mesh"]
    table = []
    for setting, run in search.ladder.done.items():
        s = run.summary
        varied = [name for name, part, of_base in (("mesh", setting.mesh, base.mesh), ("steps", setting.steps, base.steps),
                                                   ("solver", setting.solver, base.solver)) if part != of_base]
        field = found.get(setting, {})
        table.append([setting.mesh.name, s["elements"], setting.steps.scheme, f"{setting.steps.dt:.6g}", f"{setting.steps.tolerance:.3g}", setting.solver.name,
                      "+".join(varied) or "base", s["cells"], s["dofs"], s["steps"], s["rejected_steps"], s["newton_iterations"],
                      s["krylov_iterations"], f"{run.cpu:.2f}", f"{run.wall:.2f}", f"{run.memory:.0f}",
                      *(f"{run.numbers[k]:.8g}" if k in run.numbers else "" for k in keys),
                      *(f"{errors[k].of(run.numbers[k]):.3e}" if k in run.numbers else "" for k in keys),
                      *("" if field.get(k) is None else f"{field[k]:.3e}" for k in ("u L2", "u H1", "p L2", "outside"))])
    return header, table


def recommended(path, answer, search, command):
    """The option file of the setting that an answer found."""
    setting, run = answer.run.setting, answer.run
    choice = search.ladder.choice(setting, search.ladder.done[search.axes.base].numbers)
    demand = next(d for d in search.demands() if list(d) == answer.keys and max(d.values()) == answer.share)
    write_setting(path, demand, [f"the cheapest setting that surely meets this, of those tried by\n#   {command}", setting.name,
                                 f"{run.cpu:.3g} s CPU, {run.wall:.3g} s wall, {run.memory:.0f} MB on {processor()}", f"The mesh: {origin(setting.mesh)}"],
                  setting.solver.file, search.ladder.flags, choice)


def write_setting(path, demand, comments, solver_file, flags, choice):
    """An option file of a setting: to be read after the scene and the user's flags, as the run had them: what the flags set is not
    taken from the solver file, mesh and steps are the setting's."""
    solver, given = plain_options(solver_file), names_of(flags)
    words = [*solver, *choice]
    asked = "; ".join(f"{short(k)} within {percent(s)}" for k, s in demand.items())
    lines = [f"# {asked}: {comments[0]}", *(f"# {text}" for text in comments[1:]),
             "# Flags that go with it: " + (shlex.join(map(str, flags)) or "none"),
             "# Give it after the scene's files and these flags; options that follow it override it."]
    for i, word in enumerate(words):
        if is_option(word) and not (i < len(solver) and word in given):
            value = words[i + 1] if i + 1 < len(words) and not is_option(words[i + 1]) else None
            lines.append(word if value is None else f"{word} {value}")
    path.write_text("\n".join(merged(lines)) + "\n")


def origin(mesh):
    """Where a mesh comes from, in words."""
    if mesh.origin:
        return mesh.origin
    return f"{mesh.cells} tetrahedra, " + (f"given as {mesh.words[1]}" if "-dm_plex_filename" in mesh.words else "that of the scene or of the flags")


def is_option(word):
    return word.startswith("-") and word[1:2].isalpha()


def merged(lines):
    """Of an option given twice the last line is kept."""
    last = {line.split()[0]: i for i, line in enumerate(lines) if not line.startswith("#")}
    return [line for i, line in enumerate(lines) if line.startswith("#") or last[line.split()[0]] == i]


def number(value, digits=5):
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def share(value):
    if math.isnan(value):
        return "not examined"
    return f"{100 * value:.2g} %" if math.isfinite(value) else "-"


def anchors(search):
    """Runs that the limits of the asked numbers were taken from, in words."""
    by_run = {}
    for key, e in search.errors().items():
        by_run.setdefault(e.anchor.name, []).append(short(key))
    return "; ".join(f"{name} ({', '.join(keys)})" for name, keys in by_run.items())


def reference_table(search):
    header = ["number", "limit", "± %", "of time", "of space", "of solver", "of coupling", "in time", "in space"]
    table = []
    for key, e in search.all_errors().items():
        if not e.value:
            continue  # no share of nothing
        scale = abs(e.value)
        table.append([f"**{short(key)}**" if key in search.keys else key, number(e.value), share(e.doubt),
                      *(share(e.shares[name] / scale) for name in ("time", "space", "solver", "coupling")),
                      e.limits["time"].how, e.limits["space"].how])
    return markdown(header, table)


def run_table(search, found):
    errors = search.errors()
    header = ["mesh", "steps", "solver", "n", "Newton", "Krylov", "CPU s", "wall s", "MB",
              *(f"{short(k)} %" for k in errors), *(["u L2 %", "u H1 %", "p L2 %"] if found else [])]
    table = []
    for setting, run in sorted(search.ladder.done.items(), key=lambda item: search.ladder.seconds(item[1])):
        texts = []
        for key, e in errors.items():
            if key not in run.numbers:
                texts.append("-")
                continue
            error = e.of(run.numbers[key])
            texts.append(f"(< {100 * e.doubt:.2g})" if abs(error) <= e.doubt else f"{100 * error:+.2g}")
        field = found.get(setting, {})
        if found:
            texts += [number(100 * field[k], 2) if field.get(k) is not None else "-" for k in ("u L2", "u H1", "p L2")]
        s = run.summary
        table.append([setting.mesh.name, setting.steps.name, setting.solver.name, s["steps"], s["newton_iterations"],
                      s["krylov_iterations"], f"{run.cpu:.1f}", f"{run.wall:.1f}", f"{run.memory:.0f}", *texts])
    return markdown(header, table)


def write(search, command):
    """Writes everything; returns the sentences."""
    ladder, options = search.ladder, search.ladder.options
    folder = options.output
    folder.mkdir(parents=True, exist_ok=True)
    if not ladder.done:
        sentences = ["No run finished."]
        found, reference = {}, None
    else:
        found, reference = field_errors(search)
        write_csv(folder / "accuracy.csv", *rows(search, found))
        for name, draw in FIGURES.items():
            draw(folder / f"{name}.png", search)
        sentences = search.sentences()
    for old in folder.glob("recommended_*.opts"):
        old.unlink()
    for answer in search.answers() if ladder.done else []:
        if answer.run:
            recommended(folder / file_name(answer.share), answer, search, command)
    machine = (f"{processor()}, {options.ranks} rank{'s' if options.ranks > 1 else ''}, {blas(options.build / 'pulmo')} with one thread; "
               + ("one run of each setting" if options.repeat == 1 else f"medians of {options.repeat} runs")
               + (f", {benchmark_runs.load_range([r for run in ladder.done.values() for r in run.results])}" if ladder.done else ""))
    lines = ["# What accuracy costs", "", f"    {command}", "", *(f"- {text}" for text in sentences), "",
             f"{machine}. {ladder.spent:.0f} s of a budget of {ladder.budget:.0f} s ({options.clock} time).", "",
             *([f"Not defined or 0 in this scene, hence left out: {', '.join(map(short, search.dropped))}.", ""] if search.dropped else []),
             "## The reference", ""]
    if ladder.done:
        lines += [*reference_table(search), "",
                  "Limit: Richardson's extrapolation of each ladder (observed order; Celik et al. 2008), the parts of time, space and solver "
                  f"taken off the numbers of {anchors(search)}. ±: sum of what the ladders' "
                  "limits may be off and of the coupling between time and space that the joint runs show. It bounds what the ladders can see; an error common to all their levels (the shape of "
                  "a mesh that is refined without following the body) is not among it.", "", "## Runs", "",
                  "Errors in per cent of the limit, in brackets where they are below its uncertainty.", "", *run_table(search, found), ""]
        if reference:
            outside = max((f["outside"] for f in found.values()), default=0)
            lines += [f"Fields at {reference[1]:g} s against {reference[0].setting.name}: relative L2 norms, of u also the H1 seminorm; the "
                      f"reference has errors of its own. " + (f"Up to {100 * outside:.2g} % of its volume lie outside of another mesh: "
                                                            "extrapolated from the nearest cell." if outside > 1e-9 else ""), ""]
        elif not found:
            lines += ["Fields are not compared: a run left none.", ""]
        lines += [line for name in FIGURES if (folder / f"{name}.png").exists() for line in (f"![{name}]({name}.png)", "")]
    lines += ["## Left out", ""]
    left_out = [f"- {s.name}: {why}" for s, why in ladder.skipped.items() if s not in ladder.done]
    left_out += [f"- {s.name}: failed after {seconds:.1f} s: {why}" for s, (why, seconds) in ladder.failed.items()]
    lines += left_out or ["Nothing." if not search.asked else "Nothing but what the question did not need."]
    (folder / "README.md").write_text("\n".join(lines) + "\n")
    print(f"wrote {folder / 'README.md'}\n")
    return sentences


def command_line(words):
    return " ".join(map(shlex.quote, ["tools/accuracy_cost", *words]))
