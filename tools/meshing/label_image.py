"""Reads label images (NIfTI, one file or a folder of one file per organ) for meshing: voxels, place in the world, labels."""
import os
import re
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from .labels import listed, names_in, names_of_json, part_of
from .mesh import MeshError

ENDINGS = (".nii", ".nii.gz")
UNITS = {"meter": 1e3, "mm": 1.0, "micron": 1e-3, "unknown": 1.0}  # in mm
SKEW = 1e-3             # cosine between two voxel axes above which they count as oblique to one another
LABELS = 100_000        # largest label; more is a measured quantity


@dataclass
class Label:
    """One label of an image: its volume (ml) and the middle of its voxels (mm)."""

    volume: float
    centre: np.ndarray


@dataclass
class LabelImage:
    """Whole numbers on a grid whose axes point right, front and up as nearly as they can.

    values: (nx, ny, nz). spacing: mm between voxels. rotation, origin: world = rotation @ (spacing * index) + origin, mm, RAS.
    names: {number: name} that came with the file.
    """

    values: np.ndarray
    spacing: np.ndarray
    rotation: np.ndarray
    origin: np.ndarray
    names: dict

    def world(self, local):
        """Places (n, 3) in mm from the first voxel along the image's axes, in the world."""
        return local @ self.rotation.T + self.origin

    def labels(self):
        """{number: Label} of all voxels that are not 0."""
        voxel = np.prod(self.spacing) / 1e3
        found = {}
        for number, box in enumerate(ndimage.find_objects(self.values), 1):
            if box:
                mine = self.values[box] == number
                count = np.count_nonzero(mine)
                middle = [np.arange(box[i].start, box[i].stop) @ mine.sum(axis=tuple({0, 1, 2} - {i})) / count for i in range(3)]
                found[number] = Label(count * voxel, self.world(np.array(middle) * self.spacing))
        return found


def stem(path):
    """A file's name without folder and .nii.gz."""
    return re.sub(r"\.nii(\.gz)?$", "", os.path.basename(path))


def load(path, say):
    """The nibabel image of a NIfTI file of three dimensions, its axes turned to right, front, up."""
    import nibabel

    if not os.path.isfile(path):
        raise MeshError(f"--mask {path}: there is no such file.")
    try:
        image = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Image):
            raise ValueError("its format is " + type(image).__name__)
        if image.header.get_data_dtype().names:
            raise MeshError(f"--mask {path} holds colours, not labels.")
        shape = image.shape
        if len(shape) > 3 and np.prod(shape[3:]) == 1:
            image = nibabel.Nifti1Image(np.asanyarray(image.dataobj).reshape(shape[:3]), image.affine, image.header)
        elif len(shape) != 3:
            raise MeshError(f"--mask {path} has {len(shape)} dimensions ({' x '.join(map(str, shape))}); it takes one image of "
                            "three, so save one time or one channel.")
        if min(shape[:3]) < 3:
            raise MeshError(f"--mask {path} is a flat image of {' x '.join(map(str, shape[:3]))} voxels; it takes a whole chest.")
        if image.header["qform_code"] == 0 and image.header["sform_code"] == 0:
            say(f"{path} says nothing about its orientation (qform_code and sform_code are 0): left and right are taken as NIfTI's "
                "default (voxels stored from right to left); check them.")
        return nibabel.as_closest_canonical(image)
    except MeshError:
        raise
    except Exception as error:  # nibabel, gzip and zlib raise many kinds
        raise MeshError(f"--mask {path} is no NIfTI file that can be read ({str(error) or type(error).__name__}); save the labels "
                        "as NIfTI (.nii.gz).") from error


def whole_numbers(image, path):
    """The voxels of an image as unsigned integers, unless they are no labels."""
    try:
        values = np.asanyarray(image.dataobj)
    except Exception as error:  # a file that ends early, for example
        raise MeshError(f"--mask {path} cannot be read to its end ({str(error) or type(error).__name__}).") from error
    if not np.isfinite(values).all():
        raise MeshError(f"--mask {path} holds voxels that are no numbers (NaN or infinite), so it is no label image.")
    least, largest = values.min(), values.max()
    if np.issubdtype(values.dtype, np.floating) and not np.array_equal(values, np.round(values)):
        raise MeshError(f"--mask {path} holds values with decimals ({least:g} to {largest:g}), so it is no label image; threshold "
                        "a probability map, or segment a CT first.")
    if least < 0 or largest > LABELS:
        raise MeshError(f"--mask {path} holds values from {least:g} to {largest:g}, so it is a CT or the like and no label image; "
                        "segment it first, for example with TotalSegmentator or lungmask.")
    return values.astype(np.uint32 if largest > 65535 else np.uint16 if largest > 255 else np.uint8, copy=False)


def place(image, path, say):
    """Spacing, rotation and origin (mm) of an image."""
    unit = image.header.get_xyzt_units()[0]
    factor = UNITS[unit]
    if factor != 1:
        say(f"the file's unit of length is {unit}: turned into mm.")
    axes = image.affine[:3, :3] * factor
    spacing = np.linalg.norm(axes, axis=0)
    if not (np.isfinite(image.affine).all() and (spacing > 0).all() and abs(np.linalg.det(axes / spacing)) > 0.1):
        raise MeshError(f"--mask {path}: its affine matrix is singular or not finite, so its voxels have no place.")
    return spacing, axes / spacing, image.affine[:3, 3] * factor


def unsheared(values, spacing, rotation, origin):
    """The same labels on a grid along the world's axes, by nearest voxels."""
    step = spacing.min()
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(values.shape) - 1)
    corners = corners * spacing @ rotation.T + origin
    low, high = corners.min(axis=0), corners.max(axis=0)
    shape = np.ceil((high - low) / step).astype(int) + 1
    to_index = np.linalg.inv(rotation * spacing)
    values = ndimage.affine_transform(values, to_index * step, to_index @ (low - origin), tuple(shape), order=0)
    return values, np.full(3, step), np.eye(3), low


def read_file(path, say):
    """The LabelImage of one NIfTI file."""
    image = load(path, say)
    values = whole_numbers(image, path)
    spacing, rotation, origin = place(image, path, say)
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > SKEW:
        say("the image's axes are not at right angles (a tilted gantry): resampled along the body's axes.")
        values, spacing, rotation, origin = unsheared(values, spacing, rotation, origin)
    if spacing.max() > 2 * spacing.min():
        say(f"the voxels are {' x '.join(f'{s:.3g}' for s in spacing)} mm: the surface is interpolated between slices.")
    names = names_in(image.header)
    table = os.path.join(os.path.dirname(path), stem(path) + ".json")
    if os.path.isfile(table):
        names |= names_of_json(table)
    return LabelImage(values, spacing, rotation, origin, names)


def read_folder(folder, say):
    """The LabelImage of a folder that holds one NIfTI file for each organ, named after it (TotalSegmentator's way)."""
    files = [os.path.join(folder, name) for name in sorted(os.listdir(folder)) if name.endswith(ENDINGS) and part_of(stem(name))]
    if not files:
        raise MeshError(f"--mask {folder}: no file in this folder is named after a lung, such as lung_upper_lobe_left.nii.gz.")
    whole = None
    for number, path in enumerate(files, 1):
        one = read_file(path, say if whole is None else lambda note: None)
        if whole is None:
            whole = LabelImage(np.zeros(one.values.shape, np.uint8), one.spacing, one.rotation, one.origin, {})
        elif one.values.shape != whole.values.shape or not np.allclose(
                [*one.spacing, *one.origin, *one.rotation.ravel()], [*whole.spacing, *whole.origin, *whole.rotation.ravel()], atol=1e-3):
            raise MeshError(f"--mask {folder}: {os.path.basename(path)} is not on the grid of {os.path.basename(files[0])}.")
        if not one.values.any():
            say(f"{os.path.basename(path)} is empty.")
        whole.values[(one.values > 0) & (whole.values == 0)] = number
        whole.names[number] = stem(path)
    return whole


def read_labels(path, say):
    """The LabelImage of a file or folder, and its Labels."""
    image = read_folder(path, say) if os.path.isdir(path) else read_file(path, say)
    present = image.labels()
    if not present:
        raise MeshError(f"--mask {path} is empty: every voxel is 0.")
    return image, present


def check_sides(parts, present, source):
    """Refuses an image whose right lung lies to the left of its left lung."""
    x = {side: np.average([present[n].centre[0] for part, numbers in parts.items() if part.startswith(side) for n in numbers],
                          weights=[present[n].volume for part, numbers in parts.items() if part.startswith(side) for n in numbers])
         for side in ("right", "left") if any(part.startswith(side) for part in parts)}
    if len(x) == 2 and x["right"] <= x["left"]:
        raise MeshError(f"{source}: what is named right lies at x = {x['right']:.0f} mm and left at {x['left']:.0f} mm, but x grows "
                        f"to the subject's right; the labels are swapped or the header's orientation is wrong ({listed(present)}).")
