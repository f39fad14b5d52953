#!/usr/bin/python3
"""The manual page and the completion of bash, made of what the program tells of itself (-help, -list, -version).

    manual.py PROGRAM FOLDER     writes FOLDER/pulmo.1 and FOLDER/pulmo.bash

cmake --install calls it; a new option, law or effect is in both without being told.
"""
import sys
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from shared import help_text  # noqa: E402
from shared.help_text import Option  # noqa: E402

# what nearly each run gives beside pulmo's own options, and what PETSc's help does not tell of pulmo
PETSC = [Option("", *row) for row in (
    ("-dm_plex_filename", "the mesh (gmsh MSH 2.2 or 4.1)", "file", "", ""),
    ("-options_file", "an option file, `-name value` in each line; those that follow override it", "file", "", ""),
    ("-dm_refine", "splits each tetrahedron in eight, as often as that", "-", "", "0"),
    ("-ts_dt", "time step", "s", "", ""),
    ("-ts_max_time", "end of the run (default: that of the last breath)", "s", "", ""),
    ("-ts_type", "beuler: backward Euler; bdf: of second order", "one of beuler|bdf", "", "beuler"))]
KINDS = {"file": "FILE", "text": "TEXT", "-": "NUMBER", "names, separated by commas": "NAME,NAME"}
QUESTIONS = {"-help": "list all options, and end; with a mesh and a solver file also those of PETSc for that scene",
             "-list": "list the laws and effects, and end", "-version": "print the versions of pulmo and PETSc, and end"}
PAGE = """.\\" made by tools/packaging/manual.py of what the program tells
.TH PULMO 1 "" "{version}" "User Commands"
.SH NAME
pulmo \\- whole human lungs under mechanical ventilation
.SH SYNOPSIS
.RB [ "mpiexec \\-n"
.IR RANKS ]
.B pulmo \\-dm_plex_filename
.I MESH.msh
.B \\-options_file
.I SCENE.opts
.B \\-options_file
.I SOLVER.opts
[\\fB\\-NAME\\fR \\fIVALUE\\fR ...]
.PP
.BR "pulmo \\-help" | \\-list | \\-version
.SH DESCRIPTION
Alveolar tissue and alveolar air as one finite-strain poroelastic continuum on a tetrahedral mesh, solved in parallel with PETSc.
Options are read in order: what follows an option file overrides it. They are also read from .petscrc in the home and in the
working directory and from the variable PETSC_OPTIONS.
.PP
.B pulmo
alone prints an example whose files are there. A parameter of a law or an effect may differ from place to place: \
\\fB\\-tissue_c\\fR \\fI0.36,right_lung=0.7\\fR.
.SH QUESTIONS
{questions}
.SH OPTIONS OF PETSC
.PP
Those that most runs have; all of PETSc's time stepping, nonlinear and linear solvers are chosen by its own options.
{petsc}
.SH OPTIONS
{options}
.SH LAWS AND EFFECTS
{listed}
.SH EXIT STATUS
{codes}
.SH FILES
A run leaves these in its
.BR \\-output_dir :
.TP
.I signals.csv
pressure, flow and volume of every step
.TP
.I summary.json
clinical numbers, balances, every option used
.TP
.I energy.csv
where the ventilator's work went
.TP
.IR fields.xdmf , " fields*.h5"
displacement, pressure, stress for ParaView
.TP
.I checkpoint.h5
what
.B \\-restart
goes on from
.PP
Meshes, option files and tools are in share/pulmo beside the folder of the program, the manual in share/doc/pulmo.
"""
COMPLETION = """# Completion of bash for pulmo; made by tools/packaging/manual.py of what the program tells.
_pulmo()
{{
  local word=${{COMP_WORDS[COMP_CWORD]}} option=${{COMP_WORDS[COMP_CWORD - 1]}}
  COMPREPLY=()
  if [[ $word != -* ]]; then
    case $option in
{values}
      {files})
        compopt -o filenames 2> /dev/null
        mapfile -t COMPREPLY < <(compgen -f -- "$word")
        return ;;
      {free})
        return ;; # a number, or names of the mesh
    esac
  fi
  mapfile -t COMPREPLY < <(compgen -W "{names}" -- "$word")
}}
complete -F _pulmo pulmo
"""


def roff(text):
    """Text that the formatter takes as it is."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\\&" + text if text[:1] in ".'" else text


def entry(term, *lines):
    return "\n".join([".TP", term, *(line for line in lines if line)])


def described(option):
    """One option: its value, what it means, its range and default."""
    kind = "|".join(option.choices) or KINDS.get(option.unit, option.unit)
    facts = [option.range] * bool(option.range) + [f"default {option.default}"] * bool(option.default)
    return entry(f"\\fB{roff(option.name)}\\fR \\fI{roff(kind)}\\fR", roff(option.words) + (f" ({roff('; '.join(facts))})" if facts else ""))


def page(version, options, listed, codes):
    """The manual page."""
    told, group = [], None
    for option in options:
        if option.group != group:
            group = option.group
            told.append(f".SS {roff(group)}")
        told.append(described(option))
    kinds = {"tissue": "Tissue laws", "permeability": "Laws of permeability", "effect": "Effects"}
    laws, last = [], None
    for kind, names, about in listed:
        if kind in kinds:
            if kind != last:
                laws.append(f".SS {kinds[kind]}")
            laws.append(entry(f".B {roff(names.replace('|', ', '))}", roff(about)))
            last = kind
    return PAGE.format(version=version, options="\n".join(told), listed="\n".join(laws), petsc="\n".join(map(described, PETSC)),
                       questions="\n".join(entry(f".B {roff(name)}", words) for name, words in QUESTIONS.items()),
                       codes="\n".join(entry(f".B {number}", roff(words)) for number, _, words in
                                       (code.partition(" ") for code in codes.removesuffix(" (docs/running.md)").split(", "))))


def completion(options):
    """What bash sources: names of options, values where they are words, files where they are text."""
    own = {}  # two laws may have an option of one name
    for option in PETSC + options:
        own.setdefault(option.name, option)
    values = {}
    for name, option in own.items():
        if option.choices:
            values.setdefault(" ".join(option.choices), []).append(name)
    cases = "\n".join(f'      {"|".join(names)})\n        mapfile -t COMPREPLY < <(compgen -W "{words}" -- "$word")\n        return ;;'
                      for words, names in values.items())
    files = [name for name, option in own.items() if option.unit in ("file", "text")]
    free = [name for name, option in own.items() if not option.choices and name not in files]
    return COMPLETION.format(values=cases, files="|".join(files), free="|".join(free), names=" ".join([*own, *QUESTIONS]))


def main(program, folder):
    options, codes = help_text.options(program)
    version = " ".join(help_text.ask(program, "-version")[0].split()[:2])
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pulmo.1").write_text(page(version, options, help_text.listed(program), codes), encoding="utf-8")
    (folder / "pulmo.bash").write_text(completion(options), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
