"""Pictures of the lung as PNG within the page: its surface, sections through it, an image as EIT has them."""
import base64
import io
import textwrap

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.collections import PolyCollection  # noqa: E402
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # noqa: E402
from PIL import Image  # noqa: E402

from .cuts import rarer  # noqa: E402

AXES = ["x (mm), right … left", "y (mm), to the front", "z (mm), upwards"]
# name, axis of the normal, axes of the picture
PLANES = [("coronal", 1, (0, 2)), ("sagittal", 0, (1, 2)), ("axial", 2, (0, 1))]
REGION_COLOURS = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#0072b2", "#d55e00"]
PICTURE_TRIANGLES = 4000


def png(figure, dpi=100):
    """The figure as a data address; it is closed."""
    drawn, out = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    plt.close(figure)
    # 256 colours are what a map of colours has: a quarter of the size
    Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def box_of(corners):
    """(middle, half of the longest side) of places (..., 3): what a picture has to show."""
    corners = corners.reshape(-1, 3)
    return (corners.max(0) + corners.min(0)) / 2, np.ptp(corners, axis=0).max() / 2


def shaded(axes, corners, colours, azimuth, box):
    """Draws triangles (n, 3, 3), mm, lit from where one stands; colours (n, 3). box: as of box_of()."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
    towards = np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.3])
    light = 0.35 + 0.65 * np.clip(normals @ (towards / np.linalg.norm(towards)), 0, 1)
    faces = colours * light[:, None]
    axes.add_collection3d(Poly3DCollection(corners, facecolors=faces, edgecolors=faces, linewidths=0.2))
    middle, half = box
    for set_limit, m in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle):
        set_limit(m - half, m + half)
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.view_init(elev=12, azim=azimuth)
    axes.set_axis_off()


def lung(run):
    """The lung at rest as seen from the front and the side, coloured by region: (image, alt text); raises Missing."""
    fields = run.fields
    triangles, cells = rarer(fields.points, *fields.surface, PICTURE_TRIANGLES)
    numbers = fields.values("region_number", 0)
    region = np.zeros(len(cells), int) if numbers is None else numbers[cells].astype(int)
    names = {entry.get("number"): name for name, entry in (run.summary.get("regions") or {}).items()}
    corners = fields.points[triangles]
    present = sorted(set(region))
    colour = {n: np.array(matplotlib.colors.to_rgb(REGION_COLOURS[i % len(REGION_COLOURS)])) for i, n in enumerate(present)}
    figure = plt.figure(figsize=(7, 3.6))
    for place, (title, azimuth) in enumerate((("from the front", 90), ("from the right", 0))):
        axes = figure.add_subplot(1, 2, place + 1, projection="3d", proj_type="ortho")
        shaded(axes, corners, np.array([colour[n] for n in region]), azimuth, box_of(corners))
        figure.text(0.25 + 0.5 * place, 0.01, title, ha="center", fontsize=10)
    if len(present) > 1:
        handles = [plt.Line2D([], [], marker="s", ls="", color=colour[n], label=names.get(n, f"region {n}")) for n in present]
        figure.legend(handles=handles, loc="upper center", ncols=min(len(handles), 5), frameon=False, fontsize=9)
    figure.subplots_adjust(0, 0.05, 1, 0.95, 0, 0)
    parts = ", ".join(names.get(n, f"region {n}") for n in present)
    return png(figure), f"The surface of the mesh at rest from the front and from the right: {parts}."


def sections(run, quantity):
    """A column for each plane, a row for each moment, one scale: (image, alt text, ends of the scale). Shapes are those of the moment."""
    fields = run.fields
    centre = fields.volumes @ fields.points[fields.cells].mean(axis=1) / fields.volumes.sum()
    shapes = {s: fields.shape(s) for _, s in run.moments}
    values = {s: quantity.values(run, s) for s in shapes}
    low, high = quantity.limits(np.concatenate(list(values.values())))
    box = np.array([np.min([x.min(0) for x in shapes.values()], 0), np.max([x.max(0) for x in shapes.values()], 0)])
    box += np.array([[-1], [1]]) * 0.03 * np.ptp(box, axis=0).max()
    through = [widest(fields, axis, centre) for _, axis, _ in PLANES]
    sizes = [np.ptp(box[:, axes], axis=0) for _, _, axes in PLANES]
    inches = min(6.6 / sum(width for width, _ in sizes), 2.3 / max(height for _, height in sizes))  # a mm
    row_height, left, gap, bottom = max(height for _, height in sizes) * inches + 0.25, 1.0, 0.6, 0.45
    total = left + sum(width for width, _ in sizes) * inches + 2 * gap + 1.0, bottom + len(shapes) * row_height + 0.15
    figure = plt.figure(figsize=total)

    def place_of(x, y, width, height):
        return figure.add_axes((x / total[0], y / total[1], width / total[0], height / total[1]))
    for number, (what, snapshot) in enumerate(run.moments):
        last, x, y = number == len(shapes) - 1, left, bottom + (len(shapes) - 1 - number) * row_height
        for (name, normal, (across, up)), place, (width, height) in zip(PLANES, through, sizes):
            axes = place_of(x, y, width * inches, height * inches)
            x += width * inches + gap
            polygons, cells = fields.section(snapshot, normal, place)
            drawn = PolyCollection([p[:, (across, up)] for p in polygons], array=values[snapshot][cells], cmap=quantity.map,
                                   antialiaseds=False, linewidths=0)
            drawn.set_clim(low, high)
            axes.add_collection(drawn)
            axes.set_xlim(*box[:, across][::-1 if across == 0 else 1])  # the right of the body on the left, as in a CT
            axes.set_ylim(*box[:, up])
            axes.tick_params(labelsize=7, labelbottom=last)
            axes.spines[:].set_color("#cccccc")
            if number == 0:
                axes.set_title(f"{name}, {'xyz'[normal]} = {place:.0f} mm", fontsize=9)
            if last:
                axes.set_xlabel(AXES[across], fontsize=8)
            axes.set_ylabel(AXES[up], fontsize=8, labelpad=1)
        words = "\n".join(textwrap.wrap(what, 24)) + f"\nt = {fields.times[snapshot]:g} s"
        figure.text(0.25 / total[0], (y + row_height / 2) / total[1], words, rotation=90, ha="center", va="center", fontsize=8)
    bar = figure.colorbar(drawn, cax=place_of(x - gap + 0.2, bottom + 0.1 * total[1], 0.15, 0.75 * total[1]))
    bar.set_label(quantity.label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    said = "; ".join(f"{what}: mean {np.average(values[s], weights=fields.volumes):.4g}, from {values[s].min():.4g} to {values[s].max():.4g}"
                     for what, s in run.moments)
    return png(figure, 120), f"{quantity.words} in three sections. {said}.", low, high


def widest(fields, axis, centre):
    """A plane through the middle of all of the lung; of two lungs side by side through the larger one."""
    if axis != 0:
        return float(centre[axis])
    x = fields.points[fields.cells].mean(axis=1)[:, 0]
    inside = np.histogram(x, bins=40, weights=fields.volumes)
    return float(inside[1][np.argmax(np.convolve(inside[0], np.ones(5), "same"))] + np.diff(inside[1])[0] / 2)


def eit(image, counted, centre):
    """The image of a belt, the pixels that count, seen from the feet as clinicians do; centre of ventilation as a cross."""
    figure, axes = plt.subplots(figsize=(4.6, 3.9), layout="constrained")
    drawn = axes.imshow(np.ma.masked_where(~counted, image), cmap="viridis", interpolation="nearest", vmin=min(0, image[counted].min()))
    axes.plot(*centre, marker="+", color="white", ms=13, mew=4)
    axes.plot(*centre, marker="+", color="black", ms=12, mew=1.6)
    axes.set_xticks([0, 31], ["right", "left"])
    axes.set_yticks([0, 31], ["front", "back"])
    figure.colorbar(drawn, ax=axes, shrink=0.85).set_label("air that came in (ml per pixel)", fontsize=9)
    return png(figure)
