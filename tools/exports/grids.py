"""Grids of voxels that fields are sampled on: that of an image, or a regular one around the lung."""
import os
from dataclasses import dataclass, field

import numpy as np

from meshing.label_image import UNITS
from pulmo.errors import PulmoError

MOST_VOXELS = 1_000_000_000


@dataclass
class Grid:
    """shape: voxels along its three axes. affine: (4, 4), of indices to places in the world, mm, RAS. name: for messages.
    written: the same in the unit of the image's file; unit and codes: as its header has them."""

    shape: tuple
    affine: np.ndarray
    name: str
    written: np.ndarray = None
    unit: str = "mm"
    codes: tuple = field(default=(1, 1))  # sform, qform

    def __post_init__(self):
        if self.written is None:
            self.written = self.affine

    def indices(self, places):
        """Places (n, 3) in the world, mm, as indices of voxels with fractions."""
        inverse = np.linalg.inv(self.affine)
        return places @ inverse[:3, :3].T + inverse[:3, 3]

    @property
    def voxel(self):
        """Volume of a voxel, mm^3."""
        return abs(np.linalg.det(self.affine[:3, :3]))

    @property
    def box(self):
        """(low, high) corners of what the voxels fill, mm."""
        corners = np.array(list(np.ndindex(2, 2, 2))) * np.array(self.shape) - 0.5
        places = corners @ self.affine[:3, :3].T + self.affine[:3, 3]
        return places.min(axis=0), places.max(axis=0)


def of_image(path, say):
    """The Grid of a NIfTI image; of one with several channels or times that of one of them."""
    import nibabel

    if not os.path.isfile(path):
        raise PulmoError(f"--grid {path}: there is no such file")
    try:
        image = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Image):
            raise ValueError("its format is " + type(image).__name__)
        shape, header, affine = image.shape, image.header, image.affine
    except Exception as error:  # nibabel, gzip and zlib raise many kinds
        raise PulmoError(f"--grid {path} is no NIfTI file that can be read ({str(error) or type(error).__name__})") from None
    if len(shape) < 3:
        raise PulmoError(f"--grid {path} has {len(shape)} dimensions; it takes an image of three")
    codes = int(header["sform_code"]), int(header["qform_code"])
    if codes == (0, 0):
        say(f"WARNING: {path} says nothing about its orientation (qform_code and sform_code are 0): left and right are taken as NIfTI's "
            "default, and what is written says so, too")
    unit = header.get_xyzt_units()[0]
    scaled = np.diag([UNITS[unit]] * 3 + [1.0]) @ affine
    if not np.isfinite(scaled).all() or abs(np.linalg.det(scaled[:3, :3])) < 1e-9:
        raise PulmoError(f"--grid {path}: its affine matrix is singular or not finite, so its voxels have no place")
    if np.prod(np.array(shape[:3], float)) > MOST_VOXELS:
        raise PulmoError(f"--grid {path} has {np.prod(np.array(shape[:3], float)):.2g} voxels; it takes at most {MOST_VOXELS:.0e}")
    return Grid(tuple(int(n) for n in shape[:3]), scaled, path, affine, unit, codes)


def regular(low, high, spacing):
    """A Grid along the world's axes around a box (mm), with a margin of one voxel."""
    low = np.floor(low / spacing) * spacing - spacing
    shape = np.ceil((high - low) / spacing) + 2
    if not np.prod(shape) <= MOST_VOXELS:
        raise PulmoError(f"--spacing {spacing:g} makes {np.prod(shape):.2g} voxels; give a larger one")
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = low
    return Grid(tuple(int(n) for n in shape), affine, f"a grid of {spacing:g} mm")
