"""One HTML page about a lung mesh: volumes, areas, shares, airway, quality and a picture; no network, no time in it."""
import base64
import html
import io
import math

import numpy as np

from .geometry import facet_areas
from .picture import figure
from .quality import MIN_DIHEDRAL, MIN_SICN, dihedral_angles, sicn
from .report import bodies, measures, regions

STYLE = """body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem; color: #1a1a1a; background: #fff; }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; } th, td { padding: .2rem .8rem; text-align: right; border-bottom: 1px solid #ccc; }
th:first-child, td:first-child { text-align: left; } img { max-width: 100%; height: auto; } .bad { color: #a00000; font-weight: bold; }
.scroll { overflow-x: auto; }"""


def write_page(path, mesh, title, failures, notes, mask=None):
    """Write the page. mask: {name: ml} of lungs and lobes that the mesh should have."""
    numbers = measures(mesh)
    verdict = ("<p>The mesh passes all checks.</p>" if not failures else
               f'<p class="bad">The mesh fails: {escaped("; ".join(failures))}.</p>')
    parts = [
        f"<h1>{escaped(title)}</h1>", verdict,
        image(picture_bytes(mesh), "The mesh from the front, its front half seen through, and obliquely from below; the airway is blue."),
        "<h2>Volumes</h2>", volumes(mesh, mask),
        "<h2>Surfaces</h2>", surfaces(mesh),
        "<h2>Cells</h2>", table(["", "value", "needed"], [
            ["tetrahedra", numbers["tets"], ""], ["nodes", numbers["nodes"], ""],
            ["worst cell (SICN, 1 is regular)", f"{numbers['min_sicn']:.3f}", f"above {MIN_SICN}"],
            ["smallest angle between faces", f"{numbers['min_dihedral']:.1f}°", f"above {MIN_DIHEDRAL:g}°"],
            ["cells with all corners on the surface", f"{100 * numbers['boundary_share']:.1f} %", ""],
            ["area / volume<sup>2/3</sup> (real pairs: 8.4 to 9.0)", f"{numbers['shape']:.2f}", ""]]),
        image(histograms(mesh), histogram_words(mesh)),
        "<h2>What was told</h2>",
        "<ul>" + "".join(f"<li>{escaped(note)}</li>" for note in notes) + "</ul>" if notes else "<p>Nothing.</p>"]
    with open(path, "w", encoding="utf-8") as file:
        file.write(f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, '
                   f'initial-scale=1"><title>{escaped(title)}</title><style>{STYLE}</style></head>\n<body><main>\n'
                   + "\n".join(parts) + "\n</main></body></html>\n")


def escaped(text):
    """Text as HTML."""
    return html.escape(str(text))


def table(head, rows):
    """An HTML table whose first column names the rows."""
    cells = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    lines = ["<tr>" + f'<th scope="row">{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>" for row in rows]
    return f'<div class="scroll" tabindex="0"><table><thead><tr>{cells}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def image(data, words):
    """A PNG within the page; words: what it shows."""
    return f'<p><img alt="{escaped(words)}" src="data:image/png;base64,{base64.b64encode(data).decode()}"></p>'


def png(drawn):
    """The bytes of a matplotlib figure, the same for the same figure."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def picture_bytes(mesh):
    """The mesh's picture."""
    return png(figure(mesh))


def volumes(mesh, mask):
    """Table of volumes and shares, against the mask if there is one."""
    found = {one.name: one.volume for one in bodies(mesh)}
    total = sum(found.values())
    found |= regions(mesh)
    rows = []
    for name, volume in found.items():
        row = [escaped(name), f"{volume:.1f}", f"{100 * volume / total:.1f} %"]
        if mask:
            wanted = mask.get(name)
            row += [f"{wanted:.1f}", f"{100 * (volume / wanted - 1):+.2f} %".replace("-0.00", "+0.00")] if wanted else ["", ""]
        rows.append(row)
    rows.append(["all", f"{total:.1f}", "100 %"] + (["", ""] if mask else []))
    return table(["", "mesh, ml", "share"] + (["mask, ml", "difference"] if mask else []), rows)


def surfaces(mesh):
    """Table of the surfaces of each body: area, faces, cells across."""
    rows = []
    for one in bodies(mesh):
        for (dimension, tag), name in mesh.names.items():
            mine = mesh.facets[one.facets & (mesh.surfaces == tag)]
            if dimension == 2 and len(mine):
                area = facet_areas(mesh.points, mine)
                edge = math.sqrt(area.mean() * 4 / math.sqrt(3))
                rows.append([f"{escaped(one.name)}: {escaped(name)}", f"{area.sum() / 100:.1f}", len(mine), f"{edge:.1f}",
                             f"{math.sqrt(area.sum()) / edge:.1f}"])
    return table(["", "area, cm²", "faces", "mean edge, mm", "edges across"], rows)


def histograms(mesh):
    """Picture of how many cells have which quality."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 3.2), dpi=84)
    FigureCanvasAgg(drawn)
    left, right = drawn.subplots(1, 2)
    for axes, values, limit, label in ((left, sicn(mesh.points, mesh.tets), MIN_SICN, "SICN of the cells"),
                                       (right, dihedral_angles(mesh.points, mesh.tets).min(axis=1), MIN_DIHEDRAL,
                                        "smallest angle between faces of a cell, degrees")):
        axes.hist(values, bins=40, color="#3b75af")
        axes.axvline(limit, color="#a00000", linestyle="--")
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.7)  # one cell shows
        axes.set_xlabel(label)
        axes.set_ylabel("cells")
    drawn.tight_layout()
    return png(drawn)


def histogram_words(mesh):
    """The histograms in words."""
    worst = np.quantile(sicn(mesh.points, mesh.tets), [0.01, 0.5])
    angle = np.quantile(dihedral_angles(mesh.points, mesh.tets).min(axis=1), [0.01, 0.5])
    return (f"Histograms of the cells' quality. SICN: one cell in a hundred is below {worst[0]:.2f}, half are below {worst[1]:.2f}. Smallest angle "
            f"between faces: one in a hundred is below {angle[0]:.0f} degrees, half are below {angle[1]:.0f}. A dashed line is what a mesh needs.")
