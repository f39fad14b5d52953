"""The breath as a moving picture: the lung from the front, coloured by the air that it gained, over its waveforms."""
import io
import os
import shutil

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib import animation  # noqa: E402
from PIL import Image  # noqa: E402

from .cuts import rarer  # noqa: E402
from .pictures import PICTURE_TRIANGLES, box_of, shaded  # noqa: E402
from .read import Missing  # noqa: E402
from .waveforms import CURVES  # noqa: E402

PICTURES, FILMS = (".gif", ".webp", ".png"), (".mp4", ".webm")  # animated pictures, and what ffmpeg makes
SHORTEST, LONGEST = 20, 2000  # ms that a frame stands
FEW = 8  # frames: fewer do not move


class Frames:
    """Draws the moments of a run one after the other into one figure."""

    def __init__(self, run):
        self.run, fields = run, run.fields
        if len(fields.times) < 2:
            raise Missing("The run kept one snapshot of its fields only: nothing moves.")
        self.triangles, self.cells = rarer(fields.points, *fields.surface, PICTURE_TRIANGLES)
        gained = [fields.values("J_mean", s) - 1 for s in range(len(fields.times))]
        self.gained = [g[self.cells] for g in gained]
        low, high = np.quantile(np.concatenate(self.gained), (0.005, 0.995))
        self.scale = matplotlib.colors.Normalize(low, high if high - low > 1e-9 else low + 1)
        shapes = np.array([fields.shape(s)[self.triangles] for s in (0, int(np.argmax([g.mean() for g in gained])))])
        self.box = box_of(shapes)
        self.figure = plt.figure(figsize=(7.2, 6))
        self.axes = self.figure.add_axes((0.02, 0.4, 0.8, 0.56), projection="3d", proj_type="ortho")
        bar = self.figure.colorbar(matplotlib.cm.ScalarMappable(self.scale, "viridis"), cax=self.figure.add_axes((0.84, 0.49, 0.025, 0.4)))
        bar.set_label("volume gained since rest, J − 1 (ml/ml)", fontsize=8)
        self.lines = []
        for place, name in enumerate([name for name in ("airway_pressure_cmH2O", "volume_ml") if name in run.signals]):
            label, colour = CURVES[name]
            curve = self.figure.add_axes((0.12, 0.08 + 0.165 * place, 0.8, 0.125))
            curve.plot(run.time, run.signals[name], color=colour, lw=1.3)
            curve.set_ylabel(label.replace(" (", "\n("), fontsize=7)
            curve.tick_params(labelsize=7, labelbottom=place == 0)
            curve.set_xlim(run.time[0], run.time[-1])
            self.lines.append(curve.axvline(0, color="black", lw=1))
            if place == 0:
                curve.set_xlabel("time (s)", fontsize=8)

    def __len__(self):
        return len(self.gained)

    def durations(self):
        """ms that each frame stands: until the next one, as it was; the last as long as the one before it."""
        gaps = np.diff(self.run.fields.times) * 1000
        return np.clip(np.append(gaps, gaps[-1]), SHORTEST, LONGEST).round().astype(int).tolist()

    def draw(self, snapshot):
        t = self.run.fields.times[snapshot]
        self.axes.clear()
        colours = matplotlib.colormaps["viridis"](self.scale(self.gained[snapshot]))[:, :3]
        shaded(self.axes, self.run.fields.shape(snapshot)[self.triangles], colours, 90, self.box)
        self.axes.set_title(f"{self.run.name}, t = {t:.2f} s", fontsize=10)
        for line in self.lines:
            line.set_xdata([t, t])

    def picture(self, snapshot):
        self.draw(snapshot)
        out = io.BytesIO()
        self.figure.savefig(out, format="png", dpi=100)
        return Image.open(out).convert("RGB")


def write(run, path, to):
    """Writes the animation of a run to the file `path`, by the end of the name `to`; returns the number of frames. Raises Missing."""
    frames = Frames(run)
    try:
        if to.endswith(FILMS):
            film(frames, path, os.path.splitext(to)[1])
        else:
            pictures = [frames.picture(s) for s in range(len(frames))]
            pictures[0].save(path, format={".gif": "GIF", ".webp": "WEBP", ".png": "PNG"}[os.path.splitext(to)[1]], save_all=True,
                             append_images=pictures[1:], duration=frames.durations(), loop=0)
    finally:
        plt.close(frames.figure)
    return len(frames)


def film(frames, path, kind):
    """By ffmpeg, which gives all frames the same time: the mean of what they have."""
    if not shutil.which("ffmpeg"):
        raise Missing(f"a film ({kind}) is made by ffmpeg, which is not here: apt-get install ffmpeg, or name a .gif or .webp")
    writer = animation.FFMpegWriter(fps=1000 / np.mean(frames.durations()), codec="libvpx-vp9" if kind == ".webm" else "libx264",
                                    extra_args=["-f", kind[1:], "-pix_fmt", "yuv420p"])
    with writer.saving(frames.figure, path, dpi=100):
        for snapshot in range(len(frames)):
            frames.draw(snapshot)
            writer.grab_frame()
