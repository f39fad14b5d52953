"""How all figures look and are written, and their numbers as CSV."""
import csv

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from .messages import say  # noqa: E402

plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.8,
                     "lines.linewidth": 1.5, "legend.frameon": False, "figure.constrained_layout.use": True})
INSPIRATION_SHADE, PAUSE_SHADE = "#eef3f8", "#e4e0ee"


def save(figure, path, colour_maps=()):
    """Write a PNG; with colour maps as an image of 256 colours, most of them from the maps (a third of the size)."""
    figure.savefig(path, dpi=120 if colour_maps else 150, pil_kwargs={"optimize": True})
    plt.close(figure)
    if colour_maps:
        from PIL import Image
        shades = [matplotlib.colormaps[name](np.linspace(0, 1, 112))[:, :3] for name in colour_maps]
        greys = np.repeat(np.linspace(0, 1, 256 - 112 * len(shades))[:, None], 3, axis=1)
        palette = Image.new("P", (1, 1))
        palette.putpalette(list(np.rint(255 * np.concatenate(shades + [greys])).astype(int).ravel()))
        Image.open(path).convert("RGB").quantize(palette=palette, dither=0).save(path, optimize=True)
    say(f"wrote {path}")


def write_csv(path, header, rows):
    """Numbers are written with six digits."""
    with open(path, "w", newline="") as f:
        out = csv.writer(f, lineterminator="\n")
        out.writerow(header)
        out.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)


def letter_panels(axes):
    """A, B, C at the upper left of panels, and a thin line at zero."""
    for panel, letter in zip(axes, "ABC"):
        panel.set_title(letter, loc="left", fontweight="bold", fontsize=10)
        panel.axhline(0, color="#888888", lw=0.6, zorder=1)


def shade_phases(axes, outcome):
    """Inspiration and pause as bands behind the curves."""
    phase, t = outcome.signals["phase"], outcome.time
    for name, colour in (("inspiration", INSPIRATION_SHADE), ("pause", PAUSE_SHADE)):
        inside = np.flatnonzero(phase[1:] == name) + 1
        for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
            if len(run):
                axes.axvspan(t[run[0] - 1], t[run[-1]], color=colour, lw=0, zorder=0)
