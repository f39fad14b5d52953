"""A page about a run, or about several side by side: one HTML file that any browser opens, without a network.

    tools/report DIR [DIR2 ...] [--output FILE.html] [--figure FILE.png|.pdf|.svg] [--animation FILE.gif|.webp|.mp4]

The scene in words, clinical numbers, waveforms and loops, breaths, the fit of one compartment, sections, regional
ventilation, the moving surface, effects, energy, mesh and solver, and how to run it again. It reads what a run leaves, also
one that is at work, was stopped or failed, and then says so first. Needs Debian's python3-jinja2, python3-matplotlib,
python3-h5py, libjs-chart.js and libjs-three.
"""
import argparse
import os

from shared.common import written_whole
from pulmo.errors import PulmoError

from . import animation
from . import run as of_run
from .page import page
from .pv_curve import describe
from .read import Missing, fail
from .waveforms import draw

FIGURES = (".png", ".pdf", ".svg")


def write_page(runs, path):
    try:
        with written_whole(path) as part, open(part, "w", encoding="utf-8") as out:
            out.write(page(runs))
    except OSError as error:
        fail(f"cannot write {path}: {error.strerror}")


def write_figure(run, path):
    if not run.moving:
        fail(f"{run.directory} holds the start of a run and no step yet: there is nothing to draw")
    try:
        draw(run.signals, run.summary, run.unfinished, path)
    except OSError as error:
        fail(f"cannot write {path}: {error.strerror}")


def write_animation(run, path):
    try:
        with written_whole(path) as part:
            frames = animation.write(run, part, path)
    except Missing as reason:
        fail(f"--animation: {reason}")
    except OSError as error:
        fail(f"cannot write {path}: {error.strerror or error}")
    few = "; give the run -output_fields_every 0.1 for one that moves" if frames < animation.FEW else ""
    print(f"report: wrote {path}, {frames} frames, one for each snapshot{few}")


def main(words):
    parser = argparse.ArgumentParser(prog="tools/report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", nargs="+", help="the -output_dir of a run")
    parser.add_argument("--output", metavar="FILE.html",
                        help="the page (default report.html in the directory; of several runs comparison.html in the first)")
    parser.add_argument("--figure", metavar="FILE", help="waveforms and loop of the (only) run as a figure, by the name's end .png, .pdf "
                        "or .svg, instead of the page; with --output both")
    parser.add_argument("--animation", metavar="FILE", help="the (only) run as a moving picture, .gif, .webp or .png (animated), or with ffmpeg "
                        ".mp4 or .webm, instead of the page; a frame for each snapshot")
    arguments = parser.parse_args(words)
    several = len(arguments.directory) > 1
    if arguments.output and not arguments.output.endswith((".html", ".htm")):
        fail(f"--output {arguments.output} is the page: name a FILE.html (--figure FILE.png draws the waveforms)")
    if arguments.figure and not arguments.figure.endswith(FIGURES):
        fail(f"--figure {arguments.figure}: the name must end in {', '.join(FIGURES)}")
    if arguments.animation and not arguments.animation.endswith(animation.PICTURES + animation.FILMS):
        fail(f"--animation {arguments.animation}: the name must end in {', '.join(animation.PICTURES + animation.FILMS)}")
    for option in "figure", "animation":
        if getattr(arguments, option) and several:
            fail(f"--{option} draws one run: name one directory")
    try:
        runs = of_run.load(arguments.directory)
    except PulmoError as error:
        fail(str(error))
    for run in runs:
        told = f"{run.name}: " if several else ""
        for line in ([run.unfinished] if run.unfinished else []) + describe(run.summary):
            print(f"report: {told}{line}")
    if arguments.figure:
        write_figure(runs[0], arguments.figure)
        print(f"report: wrote {arguments.figure}")
    if arguments.animation:
        write_animation(runs[0], arguments.animation)
    if arguments.output or not (arguments.figure or arguments.animation):
        path = arguments.output or os.path.join(arguments.directory[0], "comparison.html" if several else "report.html")
        write_page(runs, path)
        print(f"report: wrote {path}; open it in a browser")
