"""From labels to lungs on one isotropic grid: whole, in one piece each, apart, as smooth distances; lobes and airway with them."""
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from skimage.segmentation import watershed

from .label_image import LabelImage
from .labels import LOBES, is_pair, side_of
from .mesh import MeshError

GRID = 2.25             # mm between points for a lung of GRID_VOLUME; its surface has about 40,000 triangles
GRID_VOLUME = 1500      # ml
STEPS = (2, 6)          # of the grid along a cell's edge, least and most
FEWEST_ACROSS = 12      # voxels across a lung (cube root of its volume) below which it is refused
FEW_ACROSS = 30         # and below which this is told
ISLAND = 0.1            # share of a lung's volume above which a second piece is no island
LARGEST_WEAR = 0.3      # of the cube root of their volume, that two touching lungs are worn away to tell them apart
MARGIN = 6              # grid points around the lungs


@dataclass
class Lung:
    """One lung on the grid. distance: mm to its border, positive inside; volume: ml of its voxels; both for its lobes by name, too."""

    side: str
    distance: np.ndarray
    volume: float
    lobes: dict = field(default_factory=dict)
    lobe_volumes: dict = field(default_factory=dict)


@dataclass
class Scan:
    """The lungs and the airway of an image on one grid.

    image: gives the world's places. step: mm between grid points. start: of the first one, mm along the image's axes.
    coarsest: mm, the longest edge of the voxels that it was made of. lungs: in the order right, left.
    airway: distance to it (mm, positive inside) or None.
    """

    image: LabelImage
    step: float
    start: np.ndarray
    coarsest: float
    lungs: list
    airway: np.ndarray

    def sampled(self, field, points):
        """A field of the grid, interpolated at points (n, 3) in mm along the image's axes."""
        return ndimage.map_coordinates(field, ((points - self.start) / self.step).T, order=1, mode="nearest")

    def world(self, points):
        """Those points in the world, mm, RAS."""
        return self.image.world(points)


def read_scan(image, parts, size, say):
    """The Scan of a LabelImage; parts: {part: numbers}; size: edge of the mesh's cells, mm in the image."""
    numbers = np.arange(int(image.values.max()) + 1)
    wanted = np.isin(numbers, sum(parts.values(), []))
    lungs_only = np.isin(numbers, sum((labels for part, labels in parts.items() if part != "airway"), []))
    box = ndimage.find_objects(lungs_only[image.values].astype(np.uint8))[0]
    if any(side.start == 0 or side.stop == count for side, count in zip(box, image.values.shape)):
        say("the lungs reach the image's edge, where they may be cut off: look whether all of them is there.")
    voxels = np.count_nonzero(lungs_only[image.values[box]])
    volume = voxels * np.prod(image.spacing) / 1e3
    each = volume / (2 if is_pair(parts) else 1)
    check_resolution(each, image.spacing, say)
    grid = GRID * (each / GRID_VOLUME) ** (1 / 3)
    grid = np.clip(grid, size / STEPS[1], size / STEPS[0])
    factors = np.maximum(np.floor(grid / image.spacing + 0.01), 1).astype(int)
    shares, start = averaged(image, parts, box, factors, wanted)
    step = image.spacing * factors
    lungs = [one_lung(side, wholes, step, say) for side, wholes in sides_of(shares, step, say).items()]
    airway = shares.get("airway")
    if airway is not None and airway.max() == 0:
        say("the airway's label lies apart from the lungs, above or below all of them, so it is left out.")
        airway = None
    if airway is not None:
        airway = signed_distance(below_trachea(airway >= min(0.5, airway.max()), step, say), step)
    for lung in lungs:
        lung.distance = on_grid(lung.distance, step, grid)
        lung.lobes = {name: on_grid(distance, step, grid) for name, distance in lung.lobes.items()}
    return Scan(image, grid, start, max(step), lungs, None if airway is None else on_grid(airway, step, grid))


def check_resolution(volume, spacing, say):
    """Refuses voxels that are too coarse for a lung of a volume (ml), tells those that are nearly so."""
    across = (volume * 1e3) ** (1 / 3) / spacing
    if across.min() < FEWEST_ACROSS:
        raise MeshError(f"a lung of {volume:.3g} ml in voxels of {' x '.join(f'{s:.3g}' for s in spacing)} mm is only "
                        f"{across.min():.1f} voxels across; it takes {FEWEST_ACROSS} to have a shape.")
    if across.min() < FEW_ACROSS:
        say(f"the voxels are coarse for a lung of {volume:.3g} ml ({across.min():.0f} across): thin borders and fissures are lost.")


def averaged(image, parts, box, factors, wanted):
    """{part: share of each coarse voxel} around the lungs, and the place of the first coarse voxel, mm."""
    low = np.array([b.start for b in box]) - MARGIN * factors
    count = -(-(np.array([b.stop for b in box]) + MARGIN * factors - low) // factors)
    high = low + count * factors
    inner_low, inner_high = np.maximum(low, 0), np.minimum(high, image.values.shape)
    inner = image.values[tuple(slice(a, b) for a, b in zip(inner_low, inner_high))]
    values = np.zeros(high - low, image.values.dtype)
    values[tuple(slice(a, b) for a, b in zip(inner_low - low, inner_high - low))] = np.where(wanted[inner], inner, 0)
    blocks = values.reshape(np.stack([count, factors], axis=1).ravel())
    shares = {}
    for part, numbers in parts.items():
        mine = np.isin(np.arange(len(wanted)), numbers)
        shares[part] = mine[blocks].mean(axis=(1, 3, 5), dtype=np.float32)
    return shares, (low + (factors - 1) / 2) * image.spacing


def sides_of(shares, step, say):
    """{side: {lobe or whole: share}} of {part: share}; lungs under one label are told apart."""
    found = {}
    if "lungs" in shares:
        for side, mine in split(shares["lungs"], step, say).items():
            found[side] = {"whole": np.where(mine, shares["lungs"], 0)}
    for side in LOBES:
        mine = {part: share for part, share in shares.items() if side_of(part) == side and part != "airway"}
        if mine:
            found[side] = {"whole": mine[side]} if side in mine else mine
    return found


def split(share, step, say):
    """{side: boolean} of two lungs under one label, by position; they may touch a little."""
    inside = share >= 0.5
    depth = ndimage.distance_transform_edt(inside, sampling=step)
    width = (inside.sum() * np.prod(step)) ** (1 / 3)
    for wear in np.arange(0, LARGEST_WEAR * width, step.min()):
        seeds, _ = ndimage.label(depth > wear)
        sizes = np.bincount(seeds.ravel())[1:]
        order = np.argsort(-sizes, kind="stable")
        if len(sizes) > 2 and sizes[order[2]] > ISLAND * sizes.sum():
            raise MeshError("the lungs' label has three large pieces or more; give each lung a label of its own.")
        if len(sizes) > 1 and sizes[order[1]] > ISLAND * sizes.sum():
            two = [seeds == order[k] + 1 for k in range(2)]
            x = [np.argwhere(one)[:, 0].mean() for one in two]
            if abs(x[0] - x[1]) * step[0] < 0.25 * width:
                raise MeshError("the lungs' label has two large pieces that do not lie side by side, so they cannot be a right and a "
                                "left lung; give each lung a label of its own.")
            right = int(np.argmax(x))
            markers = np.where(two[right], 1, 0) + np.where(two[1 - right], 2, 0)
            around = ndimage.binary_dilation(inside)  # with the voxels that are partly lung
            grown = watershed(-depth, markers, mask=around)  # they part where the neck between them is thinnest
            say("both lungs have one label: told apart by position" + (
                f", cut where they touch (worn away by {wear:.1f} mm to find the two)." if wear > 0 else "."))
            loose = share[(grown == 0) & around].sum() * np.prod(step) / 1e3
            if loose > 0:
                say(f"the lungs: islands of {loose:.3g} ml left out.")
            return {"right": grown == 1, "left": grown == 2}
    raise MeshError("the lungs' label is one piece that does not come apart in two; if it is one lung only, say which with --labels "
                    "right=NUMBER or left=NUMBER, else give each lung a label of its own.")


def one_lung(side, shares, step, say):
    """The Lung of the shares of its lobes (or of its whole): one piece without holes; what is left out is told."""
    cell = np.prod(step) / 1e3
    share = np.minimum(sum(shares.values()), 1)
    inside = share >= 0.5
    if len(shares) > 1:  # fissures that belong to no lobe
        inside = ndimage.binary_closing(inside)
    if not inside.any():
        raise MeshError(f"the {side} lung is smaller than a voxel of {' x '.join(f'{s:.3g}' for s in step)} mm.")
    pieces, _ = ndimage.label(inside)
    sizes = np.bincount(pieces.ravel())[1:] * cell
    largest = int(np.argmax(sizes))
    others = np.delete(sizes, largest)
    if len(others) and others.max() > ISLAND * sizes.sum():
        raise MeshError(f"the {side} lung is in {1 + np.sum(others > ISLAND * sizes.sum())} large pieces ("
                        + ", ".join(f"{v:.3g} ml" for v in sorted(sizes, reverse=True)[:3]) + "); a mesh takes one: join or "
                        "name them apart.")
    if len(others):
        say(f"the {side} lung: {len(others)} island{'s' if len(others) > 1 else ''} of {others.sum():.3g} ml left out.")
    inside = pieces == largest + 1
    filled = ndimage.binary_fill_holes(inside)
    hollow = filled & ~inside
    mine = ndimage.binary_dilation(filled) & (pieces * ~filled == 0)
    share = np.where(mine, np.where(hollow | (filled & (share < 0.5)), 1, share), 0)
    if hollow.any():
        say(f"the {side} lung: holes of {hollow.sum() * cell:.3g} ml inside it filled.")
    lung = Lung(side, signed_distance(filled, step), float(share.sum() * cell))
    if len(shares) > 1:
        lung.lobes = {name: signed_distance(one >= min(0.5, one.max()), step) for name, one in shares.items()}
        lung.lobe_volumes = {name: float(np.where(mine, one, 0).sum() * cell) for name, one in shares.items()}
        between = lung.volume - sum(lung.lobe_volumes.values())
        if between > 0.01 * lung.volume:
            say(f"the {side} lung: gaps of {between:.3g} ml between its lobes are counted with it.")
    return lung


def below_trachea(airway, step, say):
    """The airway (boolean) without the trachea, which touches the lungs above their roots.

    The trachea is followed downwards from its top until it forks.
    """
    heights = np.flatnonzero(airway.any(axis=(0, 1)))[::-1]
    trachea, kept = None, airway.copy()
    for z in heights:
        pieces, _ = ndimage.label(airway[:, :, z], np.ones((3, 3)))
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        if trachea is None:
            trachea = pieces == np.argmax(sizes)
            if np.sum(sizes > 0.25 * sizes.max()) > 1:  # it begins with two: bronchi only
                return airway
        else:
            below = np.unique(pieces[ndimage.binary_dilation(trachea) & (pieces > 0)])
            if np.sum(sizes[below] > 0.25 * sizes[below].sum()) > 1:
                return kept
            if not len(below):
                break
            trachea = pieces == below[np.argmax(sizes[below])]
        kept[:, :, z] &= ~trachea
    # no fork: what is lowest is nearest to it
    say("the airway's label does not fork, so its lowest end counts as the place where the bronchi are.")
    lowest = airway.copy()
    lowest[:, :, heights.min() + int(np.ceil(15 / step[2])):] = False
    return lowest


def on_grid(values, step, grid):
    """Values on a grid of the three steps (mm), interpolated on one that starts at the same place with one step."""
    if np.allclose(step, grid, rtol=1e-3):
        return values
    for axis in range(3):
        count = int(np.ceil((values.shape[axis] - 1) * step[axis] / grid)) + 1
        places = np.minimum(np.arange(count) * grid / step[axis], values.shape[axis] - 1)
        below = np.minimum(places.astype(int), values.shape[axis] - 2)
        weight = (places - below).reshape([-1 if i == axis else 1 for i in range(3)]).astype(np.float32)
        values = values.take(below, axis) * (1 - weight) + values.take(below + 1, axis) * weight
    return values


def signed_distance(inside, step):
    """Distance (mm) to the border of a set of voxels, positive inside."""
    return (ndimage.distance_transform_edt(inside, sampling=step)
            - ndimage.distance_transform_edt(~inside, sampling=step)).astype(np.float32)
