"""The page: sections of one run or several, scripts and data within one file."""
import base64
import datetime
import re
from pathlib import Path

import jinja2

from . import sections
from .read import Missing, fail

TEMPLATES = Path(__file__).parent / "templates"
# name in the template, Debian package, places where the package puts it
LIBRARIES = [("chart_js", "libjs-chart.js", ["chart.js/chart.min.js"]), ("three_js", "libjs-three", ["three/build/three.min.js"]),
             ("orbit_js", "libjs-three", ["three/examples/js/controls/OrbitControls.js"])]
JAVASCRIPT = Path("/usr/share/javascript")
MOST = 5_000_000  # bytes of a page
LARGE = "surface"  # what is left out first


def script(text):
    """A script that may stand within a page: it cannot end its own element."""
    return re.sub(r"<(/script|!--)", r"<\\\1", text, flags=re.IGNORECASE)


def library(package, places):
    for place in places:
        path = JAVASCRIPT / place
        if path.exists():
            return script(path.read_text(encoding="utf-8"))
    fail(f"there is no {JAVASCRIPT / places[0]}; install it: apt-get install {package}")


def context(section, runs, without):
    """A section's blocks: (run or None, context or None, why there is none)."""
    shared = hasattr(section, "compare")
    blocks = []
    for run in [None] if shared else runs:
        try:
            if section.NAME in without:
                raise Missing("Left out to keep the page small: report fewer runs on one page to have it.")
            given, why = section.compare(runs) if shared else section.build(run), ""
        except Missing as reason:
            given, why = None, str(reason)
        except KeyError as key:
            given, why = None, f"The files of the run have no {key}: another version of pulmo wrote them, or they are damaged."
        blocks.append({"run": run, "given": given, "why": why})
    return {"name": section.NAME, "title": section.TITLE, "blocks": blocks, "template": f"sections/{section.NAME}.html.j2"}


def environment():
    made = jinja2.Environment(loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True,
                              undefined=jinja2.StrictUndefined)
    made.globals["own_script"] = lambda name: script((TEMPLATES / name).read_text(encoding="utf-8"))
    return made


def written(runs, without=()):
    made = [context(section, runs, without) for section in sections.ALL]
    title = f"pulmo: {runs[0].name}" if len(runs) == 1 else "pulmo: " + ", ".join(run.name for run in runs)
    return environment().get_template("page.html.j2").render(
        title=title, runs=runs, sections=made, style=(TEMPLATES / "style.css").read_text(encoding="utf-8"),
        icon=base64.b64encode((TEMPLATES / "icon.svg").read_bytes()).decode(), day=datetime.date.today().isoformat(),
        moving=any(block["given"] for s in made if s["name"] == LARGE for block in s["blocks"]),
        **{name: library(package, places) for name, package, places in LIBRARIES})


def page(runs):
    """The page of some runs; the moving surface goes if it would be too large."""
    text = written(runs)
    return text if len(text.encode()) <= MOST else written(runs, [LARGE])
