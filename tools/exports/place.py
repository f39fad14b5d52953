"""Whether a lung lies on an image, and how it is brought back there if tools/lung_mesh --volume has scaled it."""
from dataclasses import dataclass

import numpy as np

from meshing.label_image import read_labels
from meshing.labels import find_parts
from meshing.mesh import MeshError
from pulmo.errors import PulmoError

LEAST_SHARE = 0.9   # of the lung that lies on the image's lungs, and of these that it covers, below which that is told
LEAST_OUTSIDE = 1e-3  # of the lung's volume outside the image, above which that is told


@dataclass
class Placement:
    """A place x of the mesh lies at `to` + `factor` (x - `middle`) in the image, mm."""

    factor: float = 1.0
    middle: np.ndarray = 0.0
    to: np.ndarray = 0.0

    def of(self, places):
        return self.to + self.factor * (places - self.middle)


@dataclass
class Lungs:
    """The lungs of a label image: `values` are those of a LabelImage, `mine` the numbers that are lung."""

    image: object
    mine: list

    def __post_init__(self):
        voxels = np.isin(self.image.values, self.mine)
        self.is_lung = voxels
        self.volume = np.count_nonzero(voxels) * np.prod(self.image.spacing)  # mm^3
        self.middle = self.image.world((np.array(np.nonzero(voxels)).mean(axis=1) * self.image.spacing)[None])[0]

    def holds(self, places):
        """Whether places, mm, lie in voxels of the lungs."""
        index = np.rint((places - self.image.origin) @ self.image.rotation / self.image.spacing).astype(int)
        there = ((index >= 0) & (index < self.is_lung.shape)).all(axis=1)
        found = np.zeros(len(places), bool)
        found[there] = self.is_lung[tuple(index[there].T)]
        return found


def lungs_of(path, option):
    """The Lungs of a label image; raises PulmoError with the reason if it is none."""
    try:
        image, present = read_labels(path, lambda note: None)
        parts = find_parts(present, image.names, None, lambda note: None)
    except MeshError as error:
        raise PulmoError(str(error).replace("--mask", option).rstrip(".")) from None
    return Lungs(image, [n for part, numbers in parts.items() if part != "airway" for n in numbers])


def text(box):
    return " x ".join(f"{low:.0f} … {high:.0f}" for low, high in zip(*box)) + " mm"


def shares(lungs, places, volumes):
    """(of the lung that lies on the image's lungs, of these that it covers)."""
    common = volumes @ lungs.holds(places)
    return common / volumes.sum(), common / lungs.volume


def fitted(lungs, places, volumes):
    """The Placement that gives the lung at rest the volume and the middle of the image's lungs."""
    placement = Placement((lungs.volume / volumes.sum())**(1 / 3), volumes @ places / volumes.sum(), lungs.middle)
    on, covered = shares(lungs, placement.of(places), volumes * placement.factor**3)
    if on < LEAST_SHARE:
        raise PulmoError(f"--fit: with the volume and the middle of the image's lungs only {100 * on:.0f} % of the lung lies on them: it "
                         "is another one, or only one of the two; leave out --fit, or name the label image that the mesh was made from")
    return placement, on, covered


def check_box(grid, places, volumes, say):
    """Refuses an image that the lung at rest is not in; tells if a part of it is not."""
    index = grid.indices(places)
    outside = volumes @ ((index < -0.5) | (index > np.array(grid.shape) - 0.5)).any(axis=1) / volumes.sum()
    where = f"the lung at rest fills {text((places.min(axis=0), places.max(axis=0)))}, {grid.name} fills {text(grid.box)} (x to the " \
            "right, y to the front, z up)"
    if outside > 0.999:
        raise PulmoError(f"the lung does not lie on the image: {where}; name the image that the mesh was made from, or --labels with --fit")
    if outside > LEAST_OUTSIDE:
        say(f"WARNING: {100 * outside:.1f} % of the lung lies outside the image: {where}")


def check_lungs(lungs, places, volumes, say):
    """Tells if the lung at rest does not lie on the lungs of the labels."""
    on, covered = shares(lungs, places, volumes)
    if on < LEAST_SHARE or covered < LEAST_SHARE:
        say(f"WARNING: {100 * on:.0f} % of the lung at rest lies on the lungs of the labels and covers {100 * covered:.0f} % of them, so it is "
            "not the lung of the image (tools/lung_mesh --volume scales it, other tools move it): --fit brings it back by volume and middle")
